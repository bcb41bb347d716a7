"""Runs inside a real Blender: enables, disables and uninstalls the extension; what each leaves is printed as JSON.

To call: blender -b --python enable_and_disable.py -- FOLDER_OF_BLENDER_STATE
"""

import json
import sys

import addon_utils
import bpy

ADDON = "bl_ext.user_default.ltsh"


def changes(before: dict) -> dict:
    from blender_state import difference, state

    return difference(before, state())


def modules() -> list[str]:
    return sorted(name for name in sys.modules if name == ADDON or name.startswith(ADDON + "."))


def main() -> None:
    sys.path.append(sys.argv[-1])
    from blender_state import counted_draw_handlers, state

    report = {"python": sys.version.split()[0], "blender": bpy.app.version_string}
    enabled_at_start = ADDON in bpy.context.preferences.addons
    addon_utils.disable(ADDON)
    before = state()
    with counted_draw_handlers() as left:
        for turn in ("first", "second"):
            module = addon_utils.enable(ADDON, default_set=True)
            preferences = bpy.context.preferences.addons[ADDON].preferences
            report[turn] = {
                "enabled": module is not None,
                "preferences": sorted(preferences.bl_rna.properties.keys()),
                "added": sorted(changes(before)),
            }
            addon_utils.disable(ADDON, default_set=True)
            report[turn]["left"] = changes(before)
        addon_utils.enable(ADDON, default_set=True)
        bpy.ops.extensions.package_uninstall(repo_index=_repository(), pkg_id="ltsh")
        bpy.ops.wm.save_userpref()
        paths = [path for path in before["paths"] if path not in sys.path]
        report["uninstalled"] = {"left": {kind: found for kind, found in changes(before).items() if kind != "paths"},
                                 "paths": paths, "modules": modules(), "handlers": len(left)}  # fmt: skip
    report["enabled_at_start"] = enabled_at_start
    print("LTSH-REPORT " + json.dumps(report))


def _repository() -> int:
    names = [repository.module for repository in bpy.context.preferences.extensions.repos]
    return names.index("user_default")


main()
