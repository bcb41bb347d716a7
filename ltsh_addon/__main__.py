"""`python -m ltsh_addon ...`: the command line, with pip's bpy."""

import sys

from . import interruption


def main() -> int:
    """Run the command line with the arguments of this process; its exit code."""
    try:
        with interruption.raised("ltsh"):
            from .cli import main as command_line

            return command_line(sys.argv[1:])
    except KeyboardInterrupt as error:  # while the modules were loaded
        print(f"ltsh: {interruption.message(error)}", file=sys.stderr)
        return interruption.exit_code(error)


if __name__ == "__main__":
    sys.exit(main())
