"""The progress bar on a terminal, in a log, and quiet, a clock of our own moves the time; the log of runs."""

import io
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from ltsh_addon.cli import progress
from ltsh_addon.cli.progress import ProgressBar, RunLog


class Stream(io.StringIO):
    def __init__(self, terminal):
        super().__init__()
        self.isatty = lambda: terminal

    def lines(self):
        """What a terminal shows: the last text of every line."""
        return [line.rpartition("\r")[2].rstrip() for line in self.getvalue().split("\n")]


class Clock:
    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


@pytest.fixture
def terminal():
    return Stream(terminal=True)


@pytest.fixture
def bar(clock, terminal):
    return ProgressBar(terminal)


def test_a_terminal_redraws_one_line_per_stage(clock, terminal, bar):
    for stage in ("samples", "Cycles A"):
        for step in range(11):
            clock.now += 1.0
            bar(stage, step / 10.0)
    bar.finish()
    lines = terminal.lines()
    assert [line.split()[0] for line in lines[:-1]] == ["samples", "Cycles"] and lines[-1] == ""
    assert all("100 %" in line and "-" not in line and "(10.0 s)" in line for line in lines[:-1])
    assert terminal.getvalue().count("\r") == 22


def test_redrawn_lines_cover_each_other(clock, terminal, bar):
    for step in range(101):
        clock.now += 1000.0
        bar("a stage with a name longer than there is room for", step / 100.0)
    drawn = terminal.getvalue().split("\r")[1:]
    assert len({len(text) for text in drawn}) == 1 and len(drawn[0]) < 80


def test_a_terminal_is_not_flooded(clock, terminal, bar):
    for step in range(1000):
        clock.now += 0.001
        bar("samples", step / 1000.0)
    assert 2 <= terminal.getvalue().count("\r") <= 12


def test_a_stage_that_ended_without_a_word_is_shown_as_done_and_time_left_follows_from_the_pace(clock, terminal, bar):
    bar("open scene", 0.0)
    clock.now += 3.0
    bar("Cycles A", 0.0)
    clock.now += 30.0
    bar("Cycles A", 0.25)
    first, second = terminal.lines()
    assert "100 %" in first and "(3.0 s)" in first and "25 % (90 s left)" in second


def test_a_stage_that_failed_is_not_shown_as_done(terminal, bar):
    bar("samples", 0.5)
    bar.finish()
    bar.finish()
    assert "50 %" in terminal.lines()[0] and terminal.getvalue().count("\n") == 1


def test_a_log_gets_whole_lines_and_few(clock):
    stream = Stream(terminal=False)
    bar = ProgressBar(stream)
    for step in range(101):
        bar("Cycles A", step / 100.0)
        clock.now += 0.5
    bar.finish()
    lines = stream.getvalue().splitlines()
    assert "\r" not in stream.getvalue() and "#" not in stream.getvalue()
    assert lines[0] == "Cycles A: 0 %" and lines[-1] == "Cycles A: 100 % (50.0 s)"
    assert 3 < len(lines) < 9  # 50 s, one line in 10 s


@pytest.mark.parametrize("stream", [None, Stream(True), Stream(False)])
def test_quiet_and_closed_streams_get_nothing_and_the_work_goes_on(capsys, stream):
    """sys.stderr is None in a program started without one, and print would write to stdout instead."""
    bar = ProgressBar(stream, quiet=stream is not None)
    assert all(bar(stage, fraction) is True for stage in ("a", "b") for fraction in (-1.0, 0.0, 0.5, 2.0))
    bar.finish()
    assert capsys.readouterr() == ("", "") and (stream is None or stream.getvalue() == "")


def test_a_job_shows_where_it_stands_as_a_whole(clock, terminal, bar):
    for number in range(1, 5):
        bar.begin_task(number, 4)
        for stage in ("samples", "LTC"):
            clock.now += 10.0
            bar(stage, 0.5)
        bar.end_task(f"shade_{number}", 20.0)
    bar("afterwards", 1.0)
    bar.finish()
    drawn = [text.rstrip() for text in terminal.getvalue().replace("\n", "\r").split("\r") if text]
    assert drawn[4].startswith("2 of 4 LTC") and "25 %" in drawn[4]
    assert "(2 min left)" in drawn[4]  # a quarter in 40 s
    assert drawn[-2].startswith("4 of 4 shade_4") and "100 % (80.0 s)" in drawn[-2]
    assert len(terminal.lines()) == 3 and drawn[-1].startswith("afterwards")


def test_a_job_in_a_file_is_a_line_per_task(clock):
    stream = Stream(terminal=False)
    bar = ProgressBar(stream)
    for number in (1, 2):
        bar.begin_task(number, 2)
        clock.now += 30.0
        bar("samples", 1.0)
        bar.end_task(f"shade_{number}", 30.0)
    assert stream.getvalue().splitlines() == ["1 of 2: shade_1 in 30.0 s (30 s left)", "2 of 2: shade_2 in 30.0 s"]


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


def test_a_note_is_one_line_that_cannot_speak_to_the_terminal():
    stream = io.StringIO()
    ProgressBar(stream).note("warning: light 'a\x1b[2J\nb'" + "x" * 5000 + " is not shaded")
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("warning: light 'a\\x1b[2J b'xx") and line.endswith("x is not shaded") and len(line) < 1100
