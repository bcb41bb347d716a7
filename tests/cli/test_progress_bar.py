"""The progress bar on a terminal, in a log, and quiet; a clock of our own moves the time."""

import io

import pytest

from ltsh_addon.cli import progress
from ltsh_addon.cli.progress import ProgressBar, duration


class Stream(io.StringIO):
    def __init__(self, terminal):
        super().__init__()
        self._terminal = terminal

    def isatty(self):
        return self._terminal


class Clock:
    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def shown_lines(stream):
    """What a terminal shows: the last text of every line."""
    return [line.rpartition("\r")[2].rstrip() for line in stream.getvalue().split("\n")]


def test_a_terminal_redraws_one_line_per_stage(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    for stage in ("samples", "Cycles A"):
        for step in range(11):
            clock.now += 1.0
            bar(stage, step / 10.0)
    bar.finish()
    lines = shown_lines(stream)
    assert [line.split()[0] for line in lines[:-1]] == ["samples", "Cycles"] and lines[-1] == ""
    assert all("100 %" in line and "-" not in line and "(10.0 s)" in line for line in lines[:-1])
    assert stream.getvalue().count("\r") == 22


def test_redrawn_lines_cover_each_other(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    for step in range(101):
        clock.now += 1000.0
        bar("a stage with a name longer than there is room for", step / 100.0)
    drawn = stream.getvalue().split("\r")[1:]
    assert len({len(text) for text in drawn}) == 1 and len(drawn[0]) < 80


def test_a_terminal_is_not_flooded(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    for step in range(1000):
        clock.now += 0.001
        bar("samples", step / 1000.0)
    assert 2 <= stream.getvalue().count("\r") <= 12


def test_time_left_follows_from_the_pace(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    bar("Cycles A", 0.0)
    clock.now += 30.0
    bar("Cycles A", 0.25)
    assert "25 % (90 s left)" in shown_lines(stream)[-1]


def test_a_stage_that_ended_without_a_word_is_shown_as_done(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    bar("open scene", 0.0)
    clock.now += 3.0
    bar("samples", 0.0)
    assert "100 %" in shown_lines(stream)[0] and "(3.0 s)" in shown_lines(stream)[0]


def test_a_stage_that_failed_is_not_shown_as_done(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    bar("samples", 0.5)
    bar.finish()
    bar.finish()
    assert "50 %" in shown_lines(stream)[0] and stream.getvalue().count("\n") == 1


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


def test_a_stream_without_isatty_is_a_log(clock):
    class Plain:
        text = ""

        def write(self, text):
            self.text += text

    stream = Plain()
    ProgressBar(stream)("samples", 1.0)
    assert stream.text == "samples: 100 % (0.0 s)\n"


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_writes_nothing(terminal):
    stream = Stream(terminal)
    bar = ProgressBar(stream, quiet=True)
    assert all(bar(stage, fraction) is True for stage in ("a", "b") for fraction in (0.0, 0.5, 1.0))
    bar.finish()
    assert stream.getvalue() == ""


def test_a_closed_stream_is_quiet(capsys):
    """sys.stderr is None in a program started without one, and print would write to stdout instead."""
    ProgressBar(None)("samples", 1.0)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("terminal", [True, False])
def test_the_bar_never_stops_the_work(clock, terminal):
    bar = ProgressBar(Stream(terminal))
    assert all(bar("samples", fraction) is True for fraction in (-1.0, 0.0, 1.0, 2.0))


def test_a_job_shows_where_it_stands_as_a_whole(clock):
    stream = Stream(terminal=True)
    bar = ProgressBar(stream)
    for number in range(1, 5):
        bar.begin_task(number, 4)
        for stage in ("samples", "LTC"):
            clock.now += 10.0
            bar(stage, 0.5)
        bar.end_task(f"shade_{number}", 20.0)
    bar("afterwards", 1.0)
    bar.finish()
    drawn = [text.rstrip() for text in stream.getvalue().replace("\n", "\r").split("\r") if text]
    assert drawn[4].startswith("2 of 4 LTC") and "25 %" in drawn[4] and "(120 s" not in drawn[4]
    assert "(2 min left)" in drawn[4]  # a quarter in 40 s
    assert drawn[-2].startswith("4 of 4 shade_4") and "100 % (80.0 s)" in drawn[-2]
    assert len(shown_lines(stream)) == 3 and drawn[-1].startswith("afterwards")


def test_a_job_in_a_file_is_a_line_per_task(clock):
    stream = Stream(terminal=False)
    bar = ProgressBar(stream)
    for number in (1, 2):
        bar.begin_task(number, 2)
        clock.now += 30.0
        bar("samples", 1.0)
        bar.end_task(f"shade_{number}", 30.0)
    assert stream.getvalue().splitlines() == ["1 of 2: shade_1 in 30.0 s (30 s left)", "2 of 2: shade_2 in 30.0 s"]


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (99.4, "99 s"), (100.0, "2 min"), (12000.0, "3.3 h")])
def test_durations_are_short(seconds, text):
    assert duration(seconds) == text
