"""Temporary folders go with the process that made them, however it ends."""

import subprocess
import sys
from pathlib import Path

import pytest

from ltsh_addon.files import RUN_PREFIX, temporary_folder

ROOT = Path(__file__).resolve().parents[1]
# Makes a folder with a file, and waits for a line or is killed.
MAKER = """
import sys
from ltsh_addon.files import temporary_folder
with temporary_folder() as folder:
    (folder / "file").write_bytes(b"x")
    print("made", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


def maker():
    process = subprocess.Popen([sys.executable, "-c", MAKER], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"made\n"
    return process


@pytest.mark.skipif(sys.platform == "win32", reason="no locks there")
def test_folders_of_the_killed_are_removed_and_those_of_the_living_stay(root):
    killed, living = maker(), maker()
    killed.kill()
    killed.communicate()
    (root / "ltsh-else").mkdir()
    assert len(list(root.glob(f"{RUN_PREFIX}*"))) == 2
    with temporary_folder() as own, temporary_folder() as other:
        (kept,) = set(root.glob(f"{RUN_PREFIX}*")) - {own, other}
        assert own != other and (kept / "file").is_file()
    assert list(root.glob(f"{RUN_PREFIX}*")) == [kept]
    living.communicate(b"end\n")
    assert [path.name for path in root.iterdir()] == ["ltsh-else"]


def test_an_exception_removes_the_folder(root):
    with pytest.raises(KeyError), temporary_folder() as folder:
        (folder / "file").write_bytes(b"x")
        raise KeyError
    assert list(root.iterdir()) == []
