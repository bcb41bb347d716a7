"""`python -m ltsh_addon ...`: the command line, with pip's bpy."""

import os
import signal
import sys

# What a signal says until the command line takes over, and after it; there is nothing to clear up then.
WORDS = {"SIGINT": b"ltsh: interrupted\n", "SIGTERM": b"ltsh: terminated\n"}


def _end(number, frame):
    """An exception would be a traceback of the import that it hit."""
    os.write(2, WORDS[signal.Signals(number).name])
    os._exit(128 + number)


def main() -> int:
    """Run the command line with the arguments of this process; its exit code."""
    for name in WORDS:
        number = getattr(signal, name)
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)
    from .cli import main as command_line

    return command_line(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
