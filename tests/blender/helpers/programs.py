"""Programs that tests start, with the Blender that runs the tests: pip's bpy, or a real Blender.

In a real Blender this file is what runs, between Blender's arguments and ours.
"""

import json
import os
import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def command_line(*arguments) -> list[str]:
    """The command of `python -m ltsh_addon ARGUMENTS`, to be run in the root of the tree."""
    return _in_blender("ltsh", *arguments) or [sys.executable, "-m", "ltsh_addon", *map(str, arguments)]


def python(code: str) -> list[str]:
    """The command that runs `code`, to be run in the root of the tree."""
    return _in_blender("code", code) or [sys.executable, "-c", code]


def document(stdout: str) -> dict:
    """The JSON document on the stdout of `command_line`, where only a real Blender may say something before."""
    import bpy

    return json.loads(stdout[stdout.index("{\n") :] if bpy.app.binary_path else stdout)


def said_nothing(stdout: str) -> bool:
    """True for an empty stdout of `command_line`; what a real Blender says before it comes to us does not count."""
    import bpy

    return stdout == "" or bool(bpy.app.binary_path)


def _in_blender(*arguments) -> list[str] | None:
    import bpy

    if not bpy.app.binary_path:
        return None
    options = ["--quiet", "--background", "--factory-startup", "--disable-autoexec", "--python", __file__, "--"]
    return [bpy.app.binary_path, *options, *map(str, arguments)]


def _main(kind: str, *arguments: str) -> int:
    sys.path[:0] = [str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    try:
        if kind == "ltsh":
            from ltsh_addon import cli

            return cli.main(list(arguments))
        exec(compile(arguments[0], "<code>", "exec"), {"__name__": "__main__"})
    except SystemExit as stop:
        return int(stop.code or 0)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    code = _main(*sys.argv[sys.argv.index("--") + 1 :])
    sys.stdout.flush()
    sys.stderr.flush()
    # Blender would end with an exit code of its own, and print.
    os._exit(code)
