"""`python -m ltsh_addon ...`: the command line, with pip's bpy."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
