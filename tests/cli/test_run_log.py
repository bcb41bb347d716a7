"""The log of runs, into which several processes write at the same time."""

import os
from concurrent.futures import ThreadPoolExecutor

from ltsh_addon.cli.progress import RunLog


def lines_of(path):
    return [line.split(" ", 1)[1] for line in path.read_text(encoding="utf-8").splitlines()]


def test_lines_of_many_that_write_at_the_same_time_stay_whole(tmp_path):
    """Longer than any buffer, as a command line with many files is."""
    path = tmp_path / "log"
    expected = [letter * length for letter in "abcdef" for length in (5, 9_000, 70_000)]

    def write(text):
        with RunLog(path) as log:
            log.line(text)
            log.line(text)

    with ThreadPoolExecutor(6) as threads:
        list(threads.map(write, expected))
    assert sorted(lines_of(path)) == sorted(2 * expected)


def test_names_that_are_no_utf8_can_be_logged(tmp_path):
    path = tmp_path / "log"
    with RunLog(path) as log:
        log.line(f"shade {os.fsdecode(b'caf')}{chr(0xDCE9)}.blend\nBücher")
    assert lines_of(path) == ["shade caf\\udce9.blend Bücher"]
