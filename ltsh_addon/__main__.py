"""`python -m ltsh_addon ...`: the command line, with pip's bpy."""

# Not signal: while that is imported, Ctrl-C would be a traceback.
import _signal as signal
import os
import sys

# What a signal says until the command line takes over, and after it; there is nothing to clear up then.
WORDS = {signal.SIGINT: b"ltsh: interrupted\n", signal.SIGTERM: b"ltsh: terminated\n"}


def _end(number, frame):
    """An exception would be a traceback of the import that it hit."""
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
