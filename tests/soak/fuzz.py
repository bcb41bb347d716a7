"""Hostile inputs at random: files that we read, damaged or made up, and options, names and streams that nobody meant.

Each case is one command line, run in a process of its own with a second Blender that is none. It must end within 10
seconds with an exit code that is right for it, without a signal, a traceback or a leftover, and say in a line or a few
what is wrong; where it refuses its arguments, it must not have touched a file. Part of `make soak`; a few cases are
part of `make test`. Needs Linux.

python tests/soak/fuzz.py [--cases N] [--seed S] [--kind KIND] [--first N]
"""

import argparse
import contextlib
import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # processes with threads are not to be forked

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import fake_scene  # noqa: E402

from ltsh_addon import cli, imaging  # noqa: E402
from ltsh_addon.blender.process import bake, blender_process  # noqa: E402
from ltsh_addon.pipeline import batch, tasks  # noqa: E402
from ltsh_addon.scene import SceneError  # noqa: E402

SECONDS = 10.0
# Of a message: lines, and letters of one.
MOST_LINES, MOST_LETTERS = 60, 1500
MOST_MEMORY = 6 << 30
SMALL = ["--techniques", "ltc", "--passes", "diffuse", "--quiet"]
SHADE = ["shade", "room.blend", *SMALL]
COMPARE = ["compare", "room.blend", *SMALL, "--cycles-samples", "4"]
DONE, WORLD, MISUSE = 0, 1, 2
WRONG = ("Traceback", "unexpected error", "Exception ignored", "Fatal Python", "Warning:")


@dataclass(frozen=True)
class Case:
    """Arguments, and the exit codes that are right for them."""

    arguments: list[str]
    codes: tuple[int, ...]
    set_up: object = None  # called in the process before the command, for what a shell would do
    is_silent: bool = False  # nothing that it says can be read
    folder: str = "."  # in which it runs
    environment: dict = field(default_factory=dict)
    signal_after: tuple[int, float] | None = None  # a real process then, which gets this signal


# What is damaged, and how; nothing may name a device, or a place outside of the folder of all cases:

TEXTS = [
    "", " ", ".", "-", "--", "~", "\n", "a\nb", "\0", "\ufeff", "é" * 90, "x" * 300, "%s%n", "{}", "\\",
    "nan", "inf", "1e999", "-1", "0", "9" * 30, "9" * 5000, "0x10", "1_0", "٣", "../x", "a/../b", "con",
    "\x1b[2J", "$HOME", "`id`", "\ud800", "🦆" * 60, "A" * 20000,
]  # fmt: skip
# Those that may be words of a command line.
WORDS = [text for text in TEXTS if "\0" not in text and "\ud800" not in text]
VALUES = [
    None, True, False, 0, -1, 1, 2**31, 2**63, -(2**63), 10**400, 0.5, -0.0, 1e308, [], {}, [[]], [None], {"": None},
    {"a": {"b": []}}, [1, "2", 3.0], *TEXTS,
]  # fmt: skip
TOKENS = [
    b"[" * 3000, b"{" * 3000, b'{"a":' * 3000, b"9" * 6000, b"1e999", b"NaN", b"null", b'"\\ud800"', b"\\", b'"', b"\0",
    b"\xef\xbb\xbf", b"\xff\xfe", b"\r", b"-", b",", b"]]", b"=", b"'''", b'"""', b"a.a." * 3000, b"[[job]]\n" * 3000,
]  # fmt: skip


def choose(generator, items):
    return items[generator.integers(len(items))]


def damaged(generator, content: bytes) -> bytes:
    """A few bytes changed, lost or repeated, or something put in."""
    for _ in range(generator.integers(1, 4)):
        at, count = (int(generator.integers(0, len(content) + 1)) for _ in range(2))
        kind = generator.integers(5)
        if kind == 0:
            content = content[:at]
        elif kind == 1:
            content = content[:at] + generator.bytes(count % 9 + 1) + content[at + count % 9 + 1 :]
        elif kind == 2:
            content = content[:at] + content[at + count % 99 :]
        elif kind == 3:
            content = content[:at] + content[count : count + 99] + content[at:]
        else:
            content = content[:at] + choose(generator, TOKENS) + content[at:]
    return content


def places(document, path=()):
    """Paths to all values below a document."""
    found = []
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        found.append((*path, key))
        if isinstance(value, dict | list):
            found += places(value, (*path, key))
    return found


def altered(generator, document):
    """The document with one or two of its values replaced, left out, renamed or repeated."""
    document = json.loads(json.dumps(document))
    for _ in range(generator.integers(1, 3)):
        known = places(document)
        if not known:
            return document
        *above, key = choose(generator, known)
        parent = document
        for step in above:
            parent = parent[step]
        kind = generator.integers(8)
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, dict):
            parent[choose(generator, TEXTS)] = parent.pop(key)
        elif kind == 2:
            parent[key] = [parent[key]]
        elif kind == 3:
            parent[key] = {"a": parent[key]}
        elif kind == 4:
            parent[key] = str(parent[key])
        else:
            parent[key] = choose(generator, VALUES)
    return document


def spoil_json(generator, path: Path) -> None:
    """Damage a JSON file: its bytes, its values, or all of it."""
    kind = generator.integers(8)
    if kind == 0:
        path.write_bytes(damaged(generator, path.read_bytes()))
    elif kind == 1:
        path.write_text(json.dumps(choose(generator, VALUES)), encoding="ascii")
    elif kind == 2:
        replace_file(generator, path)
    else:
        path.write_text(json.dumps(altered(generator, json.loads(path.read_text())), allow_nan=True), encoding="ascii")


def replace_file(generator, path: Path) -> None:
    """Something else has that name."""
    path.unlink()
    kind = generator.integers(9)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    elif kind == 2:
        path.symlink_to("nothing")
    elif kind == 3:
        path.symlink_to(path.name)
    else:
        path.write_bytes(
            choose(generator, [b"", b"\0" * 5000, b"[" * 200000, b"[[]," * 3_000_000, generator.bytes(3000)])
        )


# Kinds of cases: each takes a generator and the folder, changes files there, and returns a Case.


def name_patterns(generator, folder):
    parts = ["{frame}", "{frame:04d}", "{scene}", "{camera}", "{object}", "x", "/", "{", "}", "{{", "}}", "{0}", "{}",
             "{frame:0999999999d}", "{frame:05000000d}", "{frame!r}", "{frame.real}", "{scene[0]}", "{scene:>9}",
             "{frame:x}", "{frame:_}", "{frame:99d}", "{frame:099d}", "{frame:{scene}}", *WORDS]  # fmt: skip
    pattern = "".join(choose(generator, parts) for _ in range(generator.integers(1, 5)))
    return Case([*SHADE, "--frames", "1-2", "-o", "new", f"--name={pattern}"], (DONE, MISUSE))


def option_values(generator, folder):
    command = choose(generator, ["shade", "compare", "bake"])
    options = {
        "shade": ["--aa", "--resolution", "--frames", "--camera", "--shard", "--techniques", "--passes"],
        "compare": ["--cycles-samples", "--reference-samples", "--tolerance", "--resolution", "--frames", "--camera"],
        "bake": ["--size", "--margin", "--view", "--uv", "--object", "--passes", "--cycles-samples"],
    }
    numbers = ["1", "4", "1-3", "64x48", "ltc", "specular", "A", "1/2", "0,0,1", "10%"]
    count = generator.integers(1, 3)
    words = [f"{choose(generator, options[command])}={choose(generator, [*WORDS, *numbers])}" for _ in range(count)]
    # A second Blender that is none bakes nothing: only what is refused before is tried.
    allowed = (DONE, MISUSE) if command != "bake" else (DONE, WORLD, MISUSE)
    allowed = (*allowed, WORLD) if any(word.endswith(".npz") for word in words) else allowed
    small = SMALL if command != "bake" else ["--techniques", "ltc", "--quiet"]
    return Case([command, "room.blend", "-o", "new", *small, *words], allowed)


def loose_words(generator, folder):
    known = "shade compare bake run merge demo room.blend -o new --json --resume --overwrite --quiet --log "
    known = [*known.split(), "--help", "--version", "job.toml", "single", "--name"]
    count = generator.integers(0, 7)
    words = [choose(generator, known if generator.random() < 0.7 else WORDS) for _ in range(count)]
    return Case(words, (DONE, WORLD, MISUSE))


def file_names(generator, folder):
    raw = bytes(byte for byte in generator.bytes(generator.integers(1, 12)) if byte not in b"\0/")
    raw = choose(
        generator, [raw, b"\xff", b"o\xff\xfe", "é".encode("latin-1"), "ok é".encode(), b"-", b"x" * 300, b"a\nb"]
    )
    name = os.fsdecode(raw or b"\xff")
    where = generator.integers(4)
    if where == 0:
        return Case([*SHADE, f"-o{name}"], (DONE, WORLD, MISUSE))
    if where == 1:
        with contextlib.suppress(OSError):
            shutil.copyfile(folder / "room.blend", folder / name)
        return Case(["shade", f"./{name}", "-o", "new", *SMALL], (DONE, WORLD, MISUSE))
    with contextlib.suppress(OSError):
        (folder / name).mkdir()
        shutil.copyfile(folder / "room.blend", folder / name / "room.blend")
    if not os.path.isdir(folder / name):
        return Case([*SHADE, "-o", "new"], (DONE,))
    if where == 2:
        return Case([*SHADE, "-o", "new"], (DONE, WORLD), folder=name)
    return Case([*SHADE, "-o", "new"], (DONE, WORLD), environment={"TMPDIR": str(folder / name)})


def tables(generator, folder):
    path, content = folder / "t.npz", (ROOT / "tables" / f"{choose(generator, ['ltc', 'ltsh2'])}.npz").read_bytes()
    kind = generator.integers(6)
    if kind == 0:
        path.write_bytes(damaged(generator, content))
    elif kind == 1:
        path.write_bytes(content)
        replace_file(generator, path)
    else:
        write_table(generator, path, content)
    return Case(
        ["shade", "room.blend", "-o", "new", "--quiet", "--passes", "diffuse", "--techniques=t.npz"], (DONE, WORLD)
    )


def write_table(generator, path, content):
    """A table with one of its arrays changed, or with a header or an entry that claims something else."""
    with zipfile.ZipFile(io.BytesIO(content)) as source:
        entries = {name: source.read(name) for name in source.namelist()}
    name = choose(generator, list(entries))
    kind = generator.integers(7)
    if kind == 0:
        del entries[name]
    elif kind == 1:
        entries[name] = damaged(generator, entries[name])
    elif kind == 2 and name != "metadata.npy":
        array = np.load(io.BytesIO(entries[name]))
        change = choose(generator, [lambda a: a[:1], lambda a: a[:0], lambda a: a[None], lambda a: a.astype("S9"),
                                    lambda a: a * np.nan, lambda a: a * -1.0, lambda a: a * 1e30, np.zeros_like,
                                    lambda a: a.astype(np.float16), lambda a: a.astype(">f8"), lambda a: a[..., :1],
                                    lambda a: a.astype(complex), lambda a: np.asfortranarray(a)])  # fmt: skip
        with np.errstate(over="ignore"):
            entries[name] = npy(change(array))
    elif kind == 3:
        with np.load(io.BytesIO(content)) as arrays:
            document = json.loads(str(arrays["metadata"]))
        entries["metadata.npy"] = npy(np.array(json.dumps(altered(generator, document))))
    elif kind == 4:
        shapes = [(16384, 16384, 3), (2**40,), (-1, 4), (0,), (2**62, 2**62), (1,) * 40, (10**30,)]
        entries[name] = header(choose(generator, shapes), choose(generator, ["<f4", "|O", "<f8", "V99999999", "|b1"]))
    elif kind == 5:
        entries[name] = header((5000, 5000, 3), "<f4") + bytes(5000 * 5000 * 3 * 4)
    else:
        entries |= {f"more {number}": b"" for number in range(generator.integers(1, 9000))}
    method = choose(generator, [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
    with zipfile.ZipFile(path, "w", method, compresslevel=1) as archive:
        for key, value in entries.items():
            archive.writestr(key, value)


def npy(array) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array))
    return stream.getvalue()


def header(shape, descr) -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}".encode()
    return b"\x93NUMPY\x01\x00" + (len(text) + 1).to_bytes(2, "little") + text + b"\n"


GOOD_JOB = {"command": "shade", "scene": "room.blend", "output": "new", "techniques": "ltc", "passes": "diffuse"}


def job_files(generator, folder):
    path, kind = folder / "job.toml", generator.integers(5)
    if kind == 0:
        path.write_bytes(damaged(generator, path.read_bytes()))
    elif kind == 1:
        replace_file(generator, path)
    elif kind == 2:
        good = toml(GOOD_JOB)
        texts = [b".".join([b"a"] * 200000) + b"=1", b"a=" + b"[" * 200000, b"[[job]]\n" * 50000, b"#" * 2_000_000,
                 b"a=0x" + b"f" * 9000, b"\xef\xbb\xbf" + good, good.replace(b"\n", b"\r\n"), b"x='" * 90]  # fmt: skip
        path.write_bytes(choose(generator, texts))
    else:
        job = {
            **GOOD_JOB,
            choose(generator, ["frames", "aa", "resolution", "camera", "name", "enable-autoexec", "log"]): 1,
        }
        for key in [choose(generator, list(job)) for _ in range(generator.integers(1, 3))]:
            job[key] = choose(generator, VALUES)
        path.write_bytes(toml(job))
    return Case([choose(generator, ["run", "run", "merge"]), "job.toml", "--quiet"], (DONE, WORLD, MISUSE))


def toml(job: dict) -> bytes:
    """A job, as near as TOML comes to its values."""
    lines = ["[[job]]"]
    for key, value in job.items():
        text = json.dumps(value, ensure_ascii=False).replace("null", "nan").replace(": ", " = ")
        lines.append(f"{key} = {text}")
    return "\n".join([*lines, ""]).encode(errors="surrogatepass")


def documents_of(folder, *names):
    return sorted(path for name in names for path in (folder / name).rglob("*.json") if path.is_file())


def merged(generator, folder):
    """The documents of a finished job, of which one is not what it was."""
    name = choose(generator, ["frames", "pictures", "single", "bake"])
    path = choose(generator, documents_of(folder, f"{name}/.ltsh"))
    spoil_json(generator, path)
    words = choose(generator, [[], ["--json"], ["--baseline", "pictures/report.json"]])
    codes = (DONE, WORLD) if words[:1] == ["--baseline"] or "timing" not in path.parts else (DONE,)
    return Case(["merge", name, *words], codes)


def resumed(generator, folder):
    """What is not whole is done again, whatever it is."""
    for path in documents_of(folder, "frames/.ltsh"):
        if generator.random() < 0.4:
            spoil_json(generator, path)
    words = choose(generator, [["--resume"], ["--skip-existing"], ["--resume", "--json"]])
    # Other versions are not mixed, and a folder may have the name of a record.
    return Case([*SHADE, "--frames", "1-3", "-o", "frames", *words], (DONE, WORLD))


def baselines(generator, folder):
    path = folder / choose(generator, ["single", "pictures"]) / "report.json"
    spoil_json(generator, path)
    frames = ["--frames", "1-2"] if path.parent.name == "pictures" else []
    words = choose(generator, [[], ["--json"], ["--tolerance", "10%"]])
    return Case([*COMPARE, *frames, "-o", "new", "--baseline", str(path.relative_to(folder)), *words], (DONE, WORLD))


def results(generator, folder):
    """What the panels read."""
    spoil_json(generator, folder / "images" / "index.json")
    return Case(["read_index", "images"], (DONE, WORLD))


def streams(generator, folder):
    """Streams that are full, closed or gone; the exit code is 1 where what was asked for could not be printed."""
    commands = [["merge", "single"], ["merge", "frames", "--json"], [*SHADE, "-o", "new"], ["--help"]]
    commands += [[*SHADE, "-o", "new", "--json"], ["run", "job.toml", "--json"], ["--version"]]
    command = choose(generator, commands)
    kind = choose(generator, ["full", "pipe", "closed", "error", "log", "folder"])
    if kind in ("log", "folder") and not command[0].startswith("-"):
        return Case([*command, "--log", "/dev/full" if kind == "log" else "images"], (WORLD,))
    if kind == "error":
        return Case(command, (DONE,), lambda: onto(2, "/dev/full"), is_silent=True)
    if kind == "closed":
        return Case(command, (DONE,), lambda: setattr(sys, "stdout", None), is_silent=True)
    if kind == "pipe":
        return Case(command, (WORLD,), broken_pipe)
    return Case(command, (WORLD,), lambda: onto(1, "/dev/full"))


def onto(number, path):
    os.dup2(os.open(path, os.O_WRONLY), number)


def broken_pipe():
    reading, writing = os.pipe()
    os.close(reading)
    os.dup2(writing, 1)


def limits(generator, folder):
    """Few open files, files that may not grow, folders that are gone."""
    command = choose(
        generator, [[*SHADE, "-o", "new"], ["merge", "frames"], ["run", "job.toml"], [*COMPARE, "-o", "new"]]
    )
    kind = generator.integers(4)
    if kind == 0:
        count = int(generator.integers(5, 24))
        return Case(command, (DONE, WORLD), lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (count, count)))
    if kind == 1:
        size = int(generator.integers(0, 3000))
        return Case(command, (DONE, WORLD), lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))
    if kind == 2:
        return Case(command, (DONE, WORLD), environment={"TMPDIR": choose(generator, ["/proc", "/none", "room.blend"])})
    return Case(command, (DONE, WORLD, MISUSE), lambda: (os.mkdir("gone"), os.chdir("gone"), os.rmdir("../gone")))


def signals(generator, folder):
    """Ctrl-C and SIGTERM at any moment of a real process; before our first line runs, Python says what it likes."""
    command = choose(generator, [["shade", "none.blend", "-o", "new"], ["--help"]])
    number = choose(generator, [signal.SIGINT, signal.SIGTERM])
    return Case(command, (DONE, WORLD, -number, 128 + number), signal_after=(number, generator.uniform(0.0, 0.7)))


KINDS = {
    kind.__name__: kind
    for kind in (name_patterns, option_values, loose_words, file_names, tables, job_files, merged, resumed, baselines,
                 results, streams, limits, signals)
}  # fmt: skip
SEQUENCE = [*KINDS.values(), merged, baselines, job_files, tables, merged]


# The folder that cases begin with:


def build(folder: Path) -> None:
    """Finished jobs of pictures and of a bake, and what goes with them."""
    (folder / "room.blend").write_bytes(b"BLENDER")
    (folder / "job.toml").write_bytes(toml(GOOD_JOB) + b"[defaults]\naa = 1\n")
    os.chdir(folder)
    stand_in()
    for words in ([*SHADE, "--frames", "1-3", "-o", "frames"], [*COMPARE, "--frames", "1-2", "-o", "pictures"],
                  [*COMPARE, "-o", "single"]):  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert cli.main(words) == 0
    build_bake(folder / "bake")
    (folder / "images").mkdir()
    group = {"size": [4, 4], "names": ["ltc"], "labels": {"ltc": "LTC"}, "passes": ["diffuse"],
             "figures": {"diffuse": {"noise": 0.1, "techniques": {"ltc": {"relative_l2": 0.2, "bias": None}}}},
             "files": {"ltc.diffuse": "a.exr"}, "scales": {"diffuse": 0.5}}  # fmt: skip
    imaging.report.write_index(
        folder / "images", {"command": "shade", "partial": "", "report": {}, "groups": {"": group}}
    )


def build_bake(output: Path) -> None:
    """The folder of a finished bake of two objects, without its pictures' pixels."""
    versions = {"ltsh": "0.1.0", "blender": "5.2.3"}
    job_tasks, records = [], tasks.Records(output, "tasks", tasks.TASK_RECORD)
    for name in ("Floor", "Wall"):
        output.mkdir(exist_ok=True)
        (output / f"{name}.exr").write_bytes(name.encode())
        errors = {
            "diffuse": {"noise": 0.01, "techniques": {"ltc": {"unbiased_squared_error": 1e-4, "unbiased_error": 0.01}}}
        }
        tile = {"file": f"{name}.exr", "texels": 9, "covered_times": 9, "overlapping_texels": 0, "errors": errors}
        tile |= {"unshaded_texels": 0, "unbaked_texels": 0, "is_lit": True}
        found = {"name": name, "uv": "UVMap", "outside": 0.0, "tiles": {"1001": tile}}
        report = {"scene": "room.blend", "frame": 1, "size": [64, 64], "view": "camera", "problems": [], "warnings": [],
                  "versions": versions, "objects": [found]}  # fmt: skip
        task = tasks.BatchTask("room.blend", None, None, name, name, "key")
        job_tasks.append(vars(task))
        records.write(name, "key", vars(task), [f"{name}.exr"], report=report)
        tasks.write_record(
            batch._timing_path(output, task), {"blender": {"start": 0.1}, f"{name}.exr": 0.2, "total": 0.3}
        )
    document = {"format": tasks.FORMAT, "command": "bake", "single": True, "any_key": False, "applied_layer": None}
    tasks.write_record(output / ".ltsh" / "job.json", {**document, "tasks": job_tasks})


class Patch:
    """As pytest's monkeypatch, for processes that end soon."""

    setattr = staticmethod(setattr)


def stand_in() -> None:
    """Put a second Blender in place that is none; what it cannot do is an error of the scene."""
    fake_scene.FakeChild().install(Patch)

    def cannot(*arguments, **options):
        raise SceneError("this second Blender is none")

    blender_process.run_job = bake.run_job = cannot
    facts = {"frame": 1, "camera": "Camera", "objects": ["Floor"], "tiles": {}, "lights": 1}
    bake.scene_facts = lambda job, **options: [{**facts, "digests": {}, "not_judged": ""} for _ in job.frames]


# Running:


@dataclass(frozen=True)
class Ended:
    """How a process ended, what it printed, and the seconds and bytes that it took."""

    code: int
    stdout: str
    stderr: str
    seconds: float
    memory: int


def run(case: Case, folder: Path, temporary: Path) -> Ended:
    """Run the case in `folder`; a signal that ended it is a negative code."""
    environment = {"TMPDIR": str(temporary), **case.environment}
    files = [temporary.parent / name for name in ("stdout", "stderr")]
    if case.signal_after is not None:
        return real_process(case, folder, environment)
    start = time.monotonic()
    process = os.fork()
    if process == 0:
        in_child(case, folder, environment, files)
    try:
        while (found := os.wait4(process, os.WNOHANG))[0] == 0 and time.monotonic() - start < SECONDS:
            time.sleep(0.002)
        if found[0] == 0:
            os.kill(process, signal.SIGKILL)
            found = os.wait4(process, 0)
    except BaseException:
        os.kill(process, signal.SIGKILL)
        raise
    texts = [path.read_text(encoding="utf-8", errors="backslashreplace") for path in files]
    seconds = time.monotonic() - start
    return Ended(os.waitstatus_to_exitcode(found[1]), *texts, seconds, found[2].ru_maxrss << 10)


def in_child(case, folder, environment, files):
    """Never returns."""
    code = 99
    try:
        for number, path in enumerate(files, 1):
            os.dup2(os.open(path, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
        # As a new process has them.
        for name, number in (("stdout", 1), ("stderr", 2)):
            setattr(
                sys, name, open(number, "w", encoding="utf-8", errors="backslashreplace" if number == 2 else "strict")
            )
        os.environ.update(environment)
        tempfile.tempdir = None
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
        os.closerange(3, 64)
        os.chdir(folder / case.folder)
        if case.set_up is not None:
            case.set_up()
        code = command(case.arguments)
        try:
            if sys.stdout is not None:
                sys.stdout.flush()
        except OSError:
            code = 120  # as Python's own at the end
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)


def command(words) -> int:
    if words[:1] != ["read_index"]:
        return cli.main(words)
    try:
        imaging.report.read_index(Path(words[1]))
    except (OSError, ValueError) as error:
        print(f"ltsh: {error}", file=sys.stderr)
        return WORLD
    return DONE


def real_process(case, folder, environment) -> Ended:
    start = time.monotonic()
    words = [sys.executable, "-m", "ltsh_addon", *case.arguments]
    environment = {**os.environ, **environment, "PYTHONPATH": str(ROOT)}
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(words, cwd=folder, env=environment, **pipes) as process:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(case.signal_after[1])
        process.send_signal(case.signal_after[0])
        try:
            texts = process.communicate(timeout=SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            texts = process.communicate()
    stdout, stderr = (text.decode(errors="backslashreplace") for text in texts)
    if "ltsh_addon" not in stderr and any(word in stderr for word in WRONG):
        stderr = ""  # Python's own, before our first line has run
        if process.returncode == 1:
            return Ended(-case.signal_after[0], stdout, stderr, time.monotonic() - start, 0)
    return Ended(process.returncode, stdout, stderr, time.monotonic() - start, 0)


def complaints(case: Case, ended: Ended, before: dict, after: dict, left: list) -> list[str]:
    """What is wrong about how a case ended; nothing where all is well."""
    found = [f"says {word!r}" for word in WRONG if word in ended.stderr]
    if ended.seconds >= SECONDS:
        found.append(f"took {ended.seconds:.1f} s")
    elif ended.code not in case.codes:
        found.append(f"exit code {ended.code}, expected one of {case.codes}")
    lines = ended.stderr.splitlines()
    if ended.code > 0 and not lines and not case.is_silent:
        found.append("says nothing")
    if len(lines) > MOST_LINES or max(map(len, lines), default=0) > MOST_LETTERS:
        found.append(f"{len(lines)} lines of up to {max(map(len, lines))} letters")
    is_json = "--json" in case.arguments and not {"--help", "-h", "--version"} & set(case.arguments)
    if is_json and ended.code in (DONE, WORLD) and ended.stdout:
        try:
            json.loads(ended.stdout)
        except ValueError:
            found.append("stdout is not one JSON document")
    if ended.code == MISUSE and before != after:
        found.append(f"refused, but {sorted(before.keys() ^ after.keys()) or 'files'} changed")
    left += [name for name in after.keys() - before.keys() if name.endswith(".tmp")]
    return found + ([f"left {left}"] if left else [])


def contents(folder: Path) -> dict:
    """Names, sizes and times of all files below a folder."""
    found = {}
    for path, folders, files in os.walk(folder):
        for name in folders + files:
            status = os.lstat(os.path.join(path, name))
            found[os.path.relpath(os.path.join(path, name), folder)] = (
                status.st_mode,
                status.st_mtime_ns * (name in files),
            )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS)
    options = parser.parse_args()
    counts, slowest, failures, start = Counter(), defaultdict(float), [], time.monotonic()
    memory = 0
    with tempfile.TemporaryDirectory(prefix="ltsh-fuzz-") as name:
        work = Path(name)
        template, folder, temporary = work / "template", work / "case", work / "temporary"
        template.mkdir()
        build(template)
        for number in range(options.first, options.first + options.cases):
            generator = np.random.default_rng([options.seed, number])
            kind = KINDS[options.kind] if options.kind else SEQUENCE[number % len(SEQUENCE)]
            shutil.copytree(template, folder, symlinks=True)
            temporary.mkdir()
            case = kind(generator, folder)
            before = contents(folder)
            ended = run(case, folder, temporary)
            left = os.listdir(temporary)
            wrong = complaints(case, ended, before, contents(folder), left)
            counts[kind.__name__, ended.code] += 1
            slowest[kind.__name__] = max(slowest[kind.__name__], ended.seconds)
            memory = max(memory, ended.memory)
            if wrong:
                failures.append(number)
                said = " | ".join(ended.stderr.splitlines()[-3:])[:600]
                print(
                    f"case {number} ({kind.__name__}): {'; '.join(wrong)}\n  {case.arguments!r:.300}\n  {said}",
                    flush=True,
                )
            shutil.rmtree(folder)
            shutil.rmtree(temporary)
            if (number + 1) % 500 == 0:
                print(f"  {number + 1} cases, {time.monotonic() - start:.0f} s", flush=True)
    for kind in dict.fromkeys(kind for kind, _ in counts):
        codes = ", ".join(
            f"{count} ended with {code}" for (name, code), count in sorted(counts.items()) if name == kind
        )
        print(f"  {kind:<14} {codes}; slowest {slowest[kind]:.1f} s")
    took = f"{time.monotonic() - start:.0f} s, at most {memory >> 20} MiB"
    print(f"{options.cases} cases of seed {options.seed}, {len(failures)} wrong {failures[:20]}, {took}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
