"""Runs pytest inside a real Blender, with its own Python; `make test-blender BLENDER=path` calls it.

    blender -b --factory-startup --python tests/run_in_blender.py -- [pytest arguments]

Without arguments it runs tests/blender. LTSH_TEST_PACKAGES names a folder with what requirements/blender.txt lists and
Blender does not bring along. Blender's exit code is pytest's.
"""

import os
import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(arguments: list[str]) -> int:
    packages = os.environ.get("LTSH_TEST_PACKAGES")
    if packages:
        sys.path.insert(0, packages)
    try:
        import pytest
    except ImportError as error:
        found = f"LTSH_TEST_PACKAGES is {packages!r}, expected a folder that holds requirements/blender.txt"
        print(f"run_in_blender: no pytest in {sys.version.split()[0]} ({error}); {found}", file=sys.stderr)
        return 2
    # Worker processes of `shade` and programs that tests start look for packages there too.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [packages, os.environ.get("PYTHONPATH")]))
    os.chdir(ROOT)
    return int(pytest.main(arguments or ["tests/blender"]))


def main() -> None:
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    code = 1
    try:
        code = run(arguments)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    # Blender has an exit code of its own for scripts, and takes its time to free what the last test left.
    os._exit(code)


if __name__ == "__main__":
    main()
