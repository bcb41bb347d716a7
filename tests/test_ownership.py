"""Temporary files and folders of several processes and machines: nobody removes what another one still writes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ltsh_addon import files

ROOT = Path(__file__).resolve().parents[1]
OTHER = "0123456789ab"
LONG = files.ABANDONED_SECONDS + 60.0
# Makes a file, one that belongs to it and a folder, as a process of a machine, and waits for a line.
MAKER = """
import sys
from pathlib import Path
from ltsh_addon import files
folder, machine = Path(sys.argv[1]), sys.argv[2]
if machine:
    files.machine = lambda: machine
file, directory = files.new_file(folder, ".a.", ".tmp")[0], files.new_folder(folder, "run-")[0]
Path(f"{file}.saved").write_bytes(b"x")
(directory / "below").mkdir()
(directory / "below" / "file").write_bytes(b"x")
print("made", flush=True)
sys.stdin.readline()
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no locks there")


@pytest.fixture
def maker(tmp_path):
    """A function that starts such a process on a machine, "" for this one; all of them end with the test."""
    processes = []

    def start(machine=""):
        command = [sys.executable, "-c", MAKER, str(tmp_path), machine]
        processes.append(subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        assert processes[-1].stdout.readline() == b"made\n"
        return processes[-1]

    yield start
    for process in processes:
        kill(process)


def kill(process):
    process.kill()
    process.communicate()


def everything(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def age(folder, seconds, names="**/*"):
    """Make all that is in `folder` older."""
    for path in folder.glob(names):
        modified = path.stat().st_mtime - seconds
        os.utime(path, (modified, modified))


def make_and_remove(folder):
    """What every process does that writes a file and needs a folder."""
    file, lock = files.new_file(folder, ".a.", ".tmp")
    directory, other_lock = files.new_folder(folder, "run-")
    file.unlink()
    directory.rmdir()
    os.close(lock), os.close(other_lock)


def test_of_this_machine_what_killed_processes_left_goes_and_the_rest_stays(tmp_path, maker):
    killed = maker()
    of_killed = everything(tmp_path)
    maker()
    of_living = set(everything(tmp_path)) - set(of_killed)
    age(tmp_path, LONG)
    kill(killed)
    make_and_remove(tmp_path)
    assert len(of_killed) == 5 and set(everything(tmp_path)) == of_living


def test_of_another_machine_whose_locks_cannot_be_seen_only_what_is_old_goes(tmp_path, maker):
    """A killed process holds no lock, as one that lives has none here where locks stay within machines."""
    kill(maker(OTHER))
    before = everything(tmp_path)
    age(tmp_path, files.ABANDONED_SECONDS - 60.0)
    make_and_remove(tmp_path)
    assert len(before) == 5 and everything(tmp_path) == before
    age(tmp_path, 120.0)
    make_and_remove(tmp_path)
    assert everything(tmp_path) == []


@pytest.mark.parametrize("fresh", ["**/*.saved", "run-*/below/file"])
def test_what_has_anything_fresh_in_it_is_not_old(tmp_path, maker, fresh):
    kill(maker(OTHER))
    before = everything(tmp_path)
    age(tmp_path, LONG)
    age(tmp_path, -LONG, fresh)
    make_and_remove(tmp_path)
    kind = ".a." if "saved" in fresh else "run-"
    assert len(before) == 5 and everything(tmp_path) == [name for name in before if name.startswith(kind)]


def test_what_another_machine_has_locked_stays_however_old(tmp_path, maker):
    maker(OTHER)
    before = everything(tmp_path)
    age(tmp_path, LONG)
    make_and_remove(tmp_path)
    assert len(before) == 5 and everything(tmp_path) == before


def test_age_is_by_the_clock_of_the_file_system(tmp_path, maker, monkeypatch):
    """That of this machine is days ahead."""
    kill(maker(OTHER))
    before = everything(tmp_path)
    monkeypatch.setattr("time.time", lambda: os.stat(tmp_path).st_mtime + 9 * LONG)
    make_and_remove(tmp_path)
    assert len(before) == 5 and everything(tmp_path) == before


def test_without_locks_only_what_is_old_goes(tmp_path, maker, monkeypatch):
    def refuse(*arguments):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(files.fcntl, "flock", refuse)
    kill(maker())
    before = everything(tmp_path)
    make_and_remove(tmp_path)
    assert len(before) == 5 and everything(tmp_path) == before
    age(tmp_path, LONG)
    make_and_remove(tmp_path)
    assert everything(tmp_path) == []


def test_names_that_are_nearly_ours_stay(tmp_path):
    mark = f"{files.machine()}-01234567"
    names = [f".a.{mark}", f".a.{mark[:-1]}.tmp", f".a.{mark[1:]}.tmp", f".a.x{mark}.tmp", f".b.{mark}.tmp", ".a.tmp"]
    for name in names:
        (tmp_path / name).touch()
    age(tmp_path, LONG)
    make_and_remove(tmp_path)
    assert everything(tmp_path) == sorted(names)


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(FileNotFoundError):
        files.new_file(tmp_path / "absent", ".a.", ".tmp")
    with pytest.raises(FileNotFoundError):
        files.new_folder(tmp_path / "absent", "run-")


def test_a_machine_has_one_name():
    code = "from ltsh_addon import files; print(files.machine())"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == files.machine() and len(files.machine()) == 12
