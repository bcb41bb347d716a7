"""Files that appear complete or not at all, and what killed processes leave of them."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ltsh_addon.files import check_takes_files, replacing, replacing_by_copy, write_bytes

ROOT = Path(__file__).resolve().parents[1]
# Writes half a file and ends as a killed process does, or waits for a line before it goes on.
HALF = """
import os, sys
from ltsh_addon.files import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    print("half", flush=True)
    if not sys.stdin.readline():
        os.kill(os.getpid(), 9)
    temporary.write_bytes(b"whole")
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def half_written(path):
    """A process that has written half of the file `path`."""
    command = [sys.executable, "-c", HALF, str(path)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "half\n"
    return process


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such names there")
def test_devices_and_names_that_are_no_utf8_are_left_alone(tmp_path):
    """A link to /dev/null is such a device; OpenEXR ends the process when it gets such a name."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name, reason in (("link", "a device or a pipe has that name"), ("a\udcff", "not UTF-8")):
        with pytest.raises(OSError, match=reason):
            write_bytes(tmp_path / name, b"new")
    with pytest.raises(OSError, match="not UTF-8"):
        check_takes_files(tmp_path / "d\udcff")
    assert names(tmp_path) == ["link", "pipe"] and (tmp_path / "pipe").is_fifo()


def test_what_another_process_is_writing_stays(tmp_path):
    process = half_written(tmp_path / "a")
    write_bytes(tmp_path / "a", b"first")
    assert len(names(tmp_path)) == 2
    process.communicate("go on\n")
    assert (tmp_path / "a").read_bytes() == b"whole" and names(tmp_path) == ["a"]


def test_a_file_that_a_program_puts_in_place_itself_stays_while_others_write(tmp_path):
    """As Blender saves: to a name with @, which it renames at the end."""
    for content in (b"first", b"second"):
        with replacing_by_copy(tmp_path / "a") as made:
            unfinished = made.with_name(f"{made.name}@")
            unfinished.write_bytes(content)
            half_written(tmp_path / "a").communicate()
            write_bytes(tmp_path / "a", b"another's")
            unfinished.rename(made)
            write_bytes(tmp_path / "a", b"another's")
            assert made.read_bytes() == content
        assert (tmp_path / "a").read_bytes() == content and names(tmp_path) == ["a"]


def test_a_program_that_puts_nothing_in_place_is_told(tmp_path):
    write_bytes(tmp_path / "a", b"old")
    with pytest.raises(OSError, match="a: cannot be written"), replacing_by_copy(tmp_path / "a"):
        pass
    assert (tmp_path / "a").read_bytes() == b"old" and names(tmp_path) == ["a"]


def test_names_as_long_as_may_be_can_be_written(tmp_path):
    for name in ("x" * 255, "鍵" * 85):
        write_bytes(tmp_path / name, b"whole")
        assert names(tmp_path) == [name]
        (tmp_path / name).unlink()


def test_an_exception_leaves_what_was_there(tmp_path):
    write_bytes(tmp_path / "a", b"old")
    with pytest.raises(KeyError), replacing(tmp_path / "a") as temporary:
        temporary.write_bytes(b"new")
        raise KeyError
    assert (tmp_path / "a").read_bytes() == b"old" and names(tmp_path) == ["a"]


def test_of_files_within_one_another_the_one_that_failed_is_named(tmp_path):
    with pytest.raises(OSError) as raised, replacing(tmp_path / "outer"), replacing(tmp_path / "absent" / "inner"):
        pass
    expected = f"{tmp_path}/absent/inner: cannot be written: the folder {tmp_path}/absent does not exist"
    assert str(raised.value) == expected
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "reason"),
    [("absent/a", "absent does not exist"), ("file/a", "file is not a folder"), ("folder", "a folder has that name")],
)
def test_what_cannot_be_written_is_named(tmp_path, name, reason):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match=f"{name}: cannot be written: .*{reason}"):
        write_bytes(tmp_path / name, b"new")
    assert names(tmp_path) == ["file", "folder"]


def test_many_that_check_a_folder_at_the_same_time_all_find_that_it_takes_files(tmp_path):
    folder = tmp_path / "new" / "folder"
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(check_takes_files, [folder] * 2000)) == [None] * 2000
    assert names(folder) == []
