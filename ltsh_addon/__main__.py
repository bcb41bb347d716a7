"""`python -m ltsh_addon ...`: the command line, with pip's bpy."""

# Not `signal`: Ctrl-C while that is imported would print a traceback.
import _signal as signal
import os
import sys

# Messages of signals before and after the command line handles them itself; there is nothing to clean up then.
WORDS = {signal.SIGINT: b"ltsh: interrupted\n", signal.SIGTERM: b"ltsh: terminated\n"}


def _end(number, frame):
    """End the process at once: an exception would print the traceback of an import."""
    os.write(2, WORDS[number])
    os._exit(128 + number)


def main() -> int:
    """Run the command line with the arguments of this process; its exit code."""
    for number in WORDS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)
    from .cli import main as command_line

    return command_line(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
