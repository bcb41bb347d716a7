"""Temporary files and folders of several processes and machines: nobody deletes what another one still writes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ltsh_addon import files

ROOT = Path(__file__).resolve().parents[1]
OTHER = "01234567"
# Makes a file, one that belongs to it and a folder, as a process of a machine, and waits for a line.
MAKER = """
import sys
from pathlib import Path
from ltsh_addon import files
files.MACHINE = sys.argv[1] or files.MACHINE
with files.replacing_by_copy("a") as made, files.temporary_folder() as directory:
    made.write_bytes(b"x")
    (directory / "below").mkdir()
    (directory / "below" / "file").write_bytes(b"x")
    print("made", flush=True)
    sys.stdin.readline()
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no locks there")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Takes temporary files and folders alike."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


@pytest.fixture
def maker(folder):
    """A function that starts such a process on a machine, "" for this one; all of them end with the test."""
    processes = []

    def start(machine=""):
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        process = subprocess.Popen([sys.executable, "-c", MAKER, machine], cwd=folder, env=environment, **pipes)
        processes.append(process)
        assert process.stdout.readline() == b"made\n"
        return process

    yield start
    for process in processes:
        kill(process)


def kill(process):
    process.kill()
    process.communicate()


def everything(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def write(folder):
    """What every process does that writes the file and needs a folder; leaves nothing itself."""
    files.write_bytes(folder / "a", b"x")
    (folder / "a").unlink()
    with files.temporary_folder():
        pass


def test_of_this_machine_what_killed_processes_left_goes_and_the_rest_stays(folder, maker):
    killed = maker()
    of_killed = everything(folder)
    maker()
    of_living = set(everything(folder)) - set(of_killed)
    kill(killed)
    write(folder)
    assert len(of_killed) == 5 and set(everything(folder)) == of_living


@pytest.mark.parametrize("machine", [OTHER, ""])
def test_what_is_of_another_machine_or_may_be_stays(folder, maker, monkeypatch, machine):
    """A killed process of another machine holds no lock here; without locks nobody knows who lives."""

    def refuse(*arguments):
        raise OSError(95, "Operation not supported")

    if not machine:
        monkeypatch.setattr(files.fcntl, "flock", refuse)
    kill(maker(machine))
    before = everything(folder)
    write(folder)
    assert len(before) == 5 and everything(folder) == before


def test_names_that_are_nearly_ours_stay(folder):
    mark = f"{files.MACHINE}-01234567"
    names = [f".a.{mark}", f".a.{mark[:-1]}.tmp", f".a.{mark}0.tmp", f".a.x{mark}.tmp", f".b.{mark}.tmp", ".a.tmp"]
    for name in names:
        (folder / name).touch()
    write(folder)
    assert everything(folder) == sorted(names)


def test_an_exception_removes_the_folder(folder):
    with pytest.raises(KeyError), files.temporary_folder() as made:
        (made / "file").write_bytes(b"x")
        raise KeyError
    assert everything(folder) == []


def test_a_process_that_may_open_no_more_files_leaves_no_folder(folder, monkeypatch):
    opened = os.open

    def refuse(path, *arguments, **options):
        if Path(path).parent == folder:
            raise OSError(24, "Too many open files", str(path))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(OSError, match="cannot hold temporary files: Too many open files"), files.temporary_folder():
        pass
    assert everything(folder) == []
