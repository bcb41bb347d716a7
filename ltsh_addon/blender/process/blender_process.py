"""The second Blender as a process: its start, its messages, its end, and which .blend it can open. Imports no bpy.

The parent writes a job to a file, whose path is the last argument of the command; paths of further jobs go to stdin.
The child answers with messages: lines of stdout that consist of LTSH and JSON. The last of its other lines are kept
for error texts. The end of stdin tells the child that the parent is gone.
"""

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

from ...reading import check_name
from ...scene import Cancelled, Progress, SceneError
from ...workers.pool import BACKGROUND, lower_priority

WORKER = Path(__file__).with_name("worker.py")
BPY_FOR_PYTHON = {(3, 11): "4.5.15", (3, 13): "5.2.3"}
MESSAGE = "LTSH "
LISTENER = "ltsh-parent"
OUTPUT_LINES_KEPT = 12
# How a child deletes its folders. DELETIONS: tries. DELETION_SECONDS: how long the process waits for them at most.
DELETIONS, DELETION_SECONDS = 40, 60.0


def tell(message: dict, stream=None) -> None:
    """Send a message to the parent. If the parent is gone, this waits until `listen_to_parent` ends this process."""
    stream = stream or sys.stdout
    try:
        stream.write(MESSAGE + json.dumps(message) + "\n")
        stream.flush()
    except OSError:
        # If this error ended the process now, folders that the listener is deleting would remain.
        for thread in threading.enumerate():
            if thread.name == LISTENER:
                thread.join(DELETION_SECONDS)
        raise


def messages(lines: Iterable[str], others: deque[str]) -> Iterator[dict]:
    """The messages in the `lines` that a child prints; all other lines are added to `others`."""
    for line in lines:
        message = None
        if line.startswith(MESSAGE):
            with contextlib.suppress(ValueError):
                message = json.loads(line[len(MESSAGE) :])
        if isinstance(message, dict):
            yield message
        elif line.strip():
            others.append(line.strip())


def ended(code: int, others: Iterable[str]) -> str:
    """Error text for a child that ended too early; `others` are the last lines that it printed."""
    return f"Blender ended with code {code}; its last output: {' | '.join(others) or 'none'}"


def listen_to_parent(temporary: list[Path], take: Callable[[str], None] = lambda line: None) -> None:
    """In a child: start a thread that calls `take` for each line of stdin.

    When the parent is gone and cannot do it, the thread deletes the `temporary` folders and ends this process.
    """

    def listen():
        for line in iter(sys.stdin.buffer.readline, b""):
            take(line.decode("utf-8", "surrogateescape").removesuffix("\n"))
        # A Blender that is just starting would create the folders again.
        for child in list(_started):
            _kill(child)
        for _ in range(DELETIONS):  # a process that still writes there can make a try fail
            for folder in temporary:
                shutil.rmtree(folder, ignore_errors=True)
            if not any(folder.exists() for folder in temporary):
                break
            time.sleep(0.05)
        os._exit(3)

    threading.Thread(target=listen, name=LISTENER, daemon=True).start()


_started: weakref.WeakSet[subprocess.Popen] = weakref.WeakSet()


def _kill(child: subprocess.Popen) -> None:
    """End `child` and the processes that it has started, and wait for it."""
    if child.poll() is None:
        if hasattr(os, "killpg"):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()
        child.wait()


def child_command(job: Path, script: Path = WORKER) -> list[str]:
    """The command that runs `script` on `job`: this Blender's own binary, or this Python with pip's bpy."""
    bpy = sys.modules.get("bpy")
    binary = bpy.app.binary_path if bpy is not None else ""
    if binary:
        return [
            *(binary, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1"),
            *("--python", str(script), "--", str(job)),
        ]
    if bpy is None and importlib.util.find_spec("bpy") is None:
        wanted = BPY_FOR_PYTHON.get(sys.version_info[:2])
        other = "use Python 3.13 and pip install bpy==5.2.3, or run inside Blender"
        remedy = f"pip install bpy=={wanted}" if wanted else other
        raise SceneError(f"{sys.executable} has no module bpy, which opens .blend files: {remedy}")
    return [sys.executable, str(script), str(job)]


def packages() -> list[str]:
    """The folder of OpenEXR, if this process has it: a Blender without extensions does not find it by itself."""
    spec = importlib.util.find_spec("OpenEXR")
    return [str(Path(spec.origin).parent)] if spec is not None and spec.origin else []


# Where Blender and pip's bpy keep libraries on Linux, Windows and macOS, relative to the binary or the module.
LIBRARY_PATTERNS = ("lib/lib{}*", "blender.shared/{}*.dll", "{}*.dll", "../Resources/lib/lib{}*")


def embree_libraries() -> list[Path]:
    """Files of the Embree 4 that comes with this Blender or pip's bpy; [] if they use that of the system."""
    return _brought_along("embree4")


def denoiser_libraries() -> list[Path]:
    """As `embree_libraries`, for Open Image Denoise 2. The first is the library to call: it sorts before all others."""
    return _brought_along("OpenImageDenoise")


def _brought_along(name: str) -> list[Path]:
    bpy = sys.modules.get("bpy")
    program = bpy.app.binary_path if bpy is not None else ""
    if not program:
        spec = importlib.util.find_spec("bpy")
        program = spec.origin if spec is not None and spec.origin else ""
    folder, patterns = Path(program).parent, (pattern.format(name) for pattern in LIBRARY_PATTERNS)
    return [path for pattern in patterns for path in sorted(folder.glob(pattern))] if program else []


def start(command: list[str], folder: Path, *, background: bool = False) -> subprocess.Popen:
    """Start `command` as a process whose own files go to `folder`.

    In the `background` it has a lower priority than this process, and so have the processes that it starts.
    """
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        cwd=folder,
        # The user's preferences and start-up files must not affect the result. Blender leaves its temporary folder
        # behind when it is killed, so that folder is put into ours.
        env={
            **os.environ,
            **dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder)),
            "BLENDER_USER_RESOURCES": str(folder / "user"),
            "PYTHONUNBUFFERED": "1",
        },
        # Ctrl-C goes only to the parent, which ends the child. A group, not a session: Linux shares the processor
        # between sessions first, and niceness counts only within a session.
        process_group=0,
        creationflags=BACKGROUND if background else 0,
    )
    _started.add(process)
    if background:
        lower_priority(process)
    return process


class BlenderProcess:
    """A Blender that runs worker.py, started by the first job; `folder` takes the files that Blender itself writes.

    For `background` see `start`.
    """

    def __init__(self, folder: Path, *, background: bool = False):
        self._background = background
        self.temporary = [folder]  # folders that it deletes if this process is gone; it writes to the first
        self._child: subprocess.Popen | None = None
        self.second: BlenderProcess | None = None  # see `second_blender`

    def do(self, job, folder: Path, progress: Progress | None) -> dict:
        """Do `job`, see `run_job`, in `folder` and report its progress. An error ends this Blender."""
        job_path = folder / "job.json"
        record = {"job": type(job).__name__, "fields": dataclasses.asdict(job), "temporary": self.temporary}
        record["path"] = packages()
        job_path.write_text(json.dumps(record, default=str), encoding="utf-8")
        try:
            self._hand_over(job_path)
            self._follow(progress)
            return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        except BaseException:
            self.end()
            raise

    def _hand_over(self, job_path: Path) -> None:
        """Give the job to the waiting Blender, or to a new one."""
        if self._child is not None:
            try:
                self._child.stdin.write(f"{job_path}\n")
                self._child.stdin.flush()
                return
            except OSError:  # it is gone
                self.end()
        self._child = start(child_command(job_path), self.temporary[0], background=self._background)

    def _follow(self, progress) -> None:
        """Report progress until the job is done. Raises SceneError, and Cancelled if `progress` returns False."""
        others: deque[str] = deque(maxlen=OUTPUT_LINES_KEPT)
        for message in messages(self._child.stdout, others):
            if "done" in message:
                return
            if "error" in message:
                raise SceneError(message["error"])
            if progress is not None and progress(message["stage"], message["fraction"]) is False:
                raise Cancelled(f"cancelled at {message['stage']}")
        raise SceneError(ended(self._child.wait(), others))

    def end(self) -> None:
        """End Blender, whatever it is doing; it has nothing to save."""
        if self.second is not None:
            self.second.end()
        child, self._child = self._child, None
        if child is None:
            return
        _kill(child)
        with contextlib.suppress(OSError):  # unsent input cannot be delivered
            child.stdin.close()
        child.stdout.close()


_shared: ContextVar[BlenderProcess | None] = ContextVar("shared Blender", default=None)


@contextlib.contextmanager
def shared_blender(folder: Path):
    """Within this context one Blender does all jobs of this thread; `folder` is its temporary folder.

    This saves starting more of them. Within another `shared_blender` its Blender does the jobs.
    """
    if (outer := _shared.get()) is not None:
        outer.temporary.append(folder)
        try:
            yield
        finally:
            outer.temporary.remove(folder)
        return
    process = BlenderProcess(folder)
    token = _shared.set(process)
    try:
        yield
    finally:
        _shared.reset(token)
        process.end()


@contextlib.contextmanager
def second_blender():
    """Within this context, inside a `shared_blender`, another Blender does all jobs, so that both keep their scenes."""
    first = _shared.get()
    if first.second is None:
        first.second = BlenderProcess(first.temporary[0])
        first.second.temporary = first.temporary
    token = _shared.set(first.second)
    try:
        yield
    finally:
        _shared.reset(token)


def run_job(job, folder: Path, progress: Progress | None) -> dict:
    """Do `job` in `folder`, in the shared Blender or in a new one; returns its manifest.

    A job is an instance of a dataclass that `worker.JOBS` names, with fields of paths and JSON. Raises SceneError with
    a message of one line, and Cancelled if `progress(stage, fraction)` returned False.
    """
    with shared_blender(folder):
        return _shared.get().do(job, folder, progress)


# In a child:

_job_start = [0.0]


def job_start() -> float:
    """The processor time at which the last job ended; 0 for the first job, which includes the start of Blender."""
    return _job_start[0]


def end_job() -> float:
    """The processor seconds since `job_start`; the next job starts now."""
    before, _job_start[0] = _job_start[0], time.process_time()
    return _job_start[0] - before


# The first bytes of a .blend: uncompressed, compressed by Blender since 3.0, and compressed before.
MAGIC_BYTES = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
# The header: pointer size, byte order and version; since 5.0 also the size of the header and the version of the format.
_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\dv(\d{4}))")
_HEADER_BYTES = 17

Version = tuple[int, int]


def run_scene_job(job, folder: Path, progress: Progress | None) -> dict:
    """Do `job`, which opens the .blend `job.scene`, as `run_job` does. First check that the file can be opened."""
    scene = Path(job.scene).absolute()
    check_readable(scene)
    return run_job(replace(job, scene=scene), folder, progress)


def check_readable(scene: Path) -> None:
    """Raise SceneError if a look at the file is enough to tell that it cannot be opened; Blender need not start."""
    try:
        check_name(scene)
        if not scene.exists():
            raise SceneError(f"{scene}: no such file, expected a .blend")
        if scene.is_dir():
            raise SceneError(f"{scene}: is a folder, expected a .blend")
        if not scene.is_file():  # reading a pipe or a device might never end
            raise SceneError(f"{scene}: is a device or a pipe, expected a .blend")
        with scene.open("rb") as file:
            start = file.read(_HEADER_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"{str(scene)[:200]!r}: cannot be read: {reason}") from None
    if not start:
        raise SceneError(f"{scene}: the file is empty, expected a .blend")
    if not start.startswith(MAGIC_BYTES):
        raise SceneError(f"{scene}: is no .blend, it starts with {start[:7]!r}")
    saved, here = saved_with(start), running()
    if saved and here and saved > here:
        raise SceneError(newer(scene, saved, here))


def saved_with(start: bytes) -> Version | None:
    """Major and minor version of the Blender that saved a file with this `start`; None if it is compressed."""
    match = _HEADER.match(start)
    return divmod(int(match[1] or match[2]), 100) if match else None


def running() -> Version | None:
    """Major and minor version of the Blender that will open files; None if there is none."""
    bpy = sys.modules.get("bpy")
    if bpy is not None:
        return tuple(bpy.app.version[:2])
    try:
        version = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        return None
    return tuple(int(number) for number in version.split(".")[:2])


def newer(path: Path, saved: Version, here: Version) -> str:
    """Error text for a file that was `saved` by a newer Blender than the one that is `here`."""
    saved, here = (".".join(map(str, version)) for version in (saved, here))
    return (
        f"{path}: was saved by Blender {saved}, but this is Blender {here}, which may miss parts of it: use Blender "
        f"{saved}, or save the file with {here}"
    )
