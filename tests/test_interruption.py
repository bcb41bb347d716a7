"""Signals become exceptions in the command line's process, once, and it ends even where nothing can be interrupted."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ltsh_addon import interruption

ROOT = Path(__file__).resolve().parents[1]
NUMBERS = [signal.SIGINT, signal.SIGTERM]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.mark.parametrize("number", NUMBERS)
def test_the_first_signal_raises_and_the_next_ones_do_not_disturb(number, monkeypatch):
    monkeypatch.setattr(interruption, "PATIENCE_SECONDS", 600.0)  # on a busy machine this process shall live on
    before = [signal.getsignal(each) for each in NUMBERS]
    cleared = []
    with pytest.raises(interruption.Interrupted) as caught, interruption.raised("ltsh"):
        try:
            signal.raise_signal(number)
        finally:
            for each in NUMBERS:
                signal.raise_signal(each)
            cleared.append(True)
    assert cleared and interruption.exit_code(caught.value) == 128 + number
    assert [signal.getsignal(each) for each in NUMBERS] == before


def test_what_ends_in_time_goes_on():
    """The process lives on where the caller takes the exception; the thread that watches ends."""
    code = (
        "import signal, time\nfrom ltsh_addon import interruption\ninterruption.PATIENCE_SECONDS = 0.5\n"
        "try:\n    with interruption.raised('ltsh'):\n        signal.raise_signal(signal.SIGTERM)\n"
        "except KeyboardInterrupt:\n    time.sleep(1.0)\n    print('alive')\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True)
    assert (done.stdout, done.stderr) == ("alive\n", "")


def test_one_within_another_changes_nothing():
    with interruption.raised("outer"):
        handler = signal.getsignal(signal.SIGTERM)
        with interruption.raised("inner"):
            assert signal.getsignal(signal.SIGTERM) is handler
        assert signal.getsignal(signal.SIGTERM) is handler


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interruption.raised("ltsh"):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_are_left_alone():
    found = []

    def inside():
        with interruption.raised("ltsh"):
            found.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert found == [before]


@pytest.mark.parametrize("number", NUMBERS)
def test_what_cannot_be_interrupted_is_left_where_it_is(number):
    """A call into C that takes a minute and does not come back to Python before."""
    code = (
        "import hashlib, os, threading\nfrom ltsh_addon import interruption\n"
        "interruption.PATIENCE_SECONDS = 0.2\n"
        "with interruption.raised('ltsh'):\n"
        "    threading.Timer(0.5, os.write, (1, b'begun\\n')).start()\n"
        "    hashlib.pbkdf2_hmac('sha512', b'', b'', 100_000_000)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "begun\n"
            process.send_signal(number)
            _, stderr = process.communicate(timeout=600)
        finally:
            process.kill()
    text = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}[number]
    assert (process.returncode, stderr) == (128 + number, f"ltsh: {text}\n")
