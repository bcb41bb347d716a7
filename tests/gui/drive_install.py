"""Installing by the mouse: the zip dropped onto the window, then from the preferences; in between uninstalled."""

import subprocess
from pathlib import Path

import bpy
import hands
from blender_state import difference, state

INSTALL = False
SIZE = "1280x900"
SECONDS = 1800
NAME = "bl_ext.user_default.ltsh"
HERE = Path(__file__).resolve().parent
# The window of the preferences is put there; places are pixels from its upper left corner.
PREFERENCES = (100, 60)
CHECKBOX, EXTENSION_MENU, MENU, INSTALL_FROM_DISK, UNINSTALL = (211, 55), (851, 240), (856, 19), (748, 141), (730, 313)


def main(rig):
    rig.check(not installed(), "nothing is installed at the start")
    before = state()
    yield from dropped(rig)
    yield from used(rig)
    yield from open_preferences(rig)
    yield from disabled_and_enabled(rig, before)
    yield from uninstalled(rig, before)
    yield from installed_from_disk(rig)


def installed():
    return NAME in bpy.context.preferences.addons


def folder():
    return Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default" / "ltsh"


def zip_file():
    return next(HERE.glob("ltsh-*.zip"))


def dropped(rig):
    x, y = hands.view_middle(rig)
    source = subprocess.Popen(["python3", HERE / "drag_file.py", zip_file(), str(x), str(y)])
    yield from hands.until(lambda: source.poll() is not None, 60)
    rig.check(source.poll() == 0, f"the window takes the zip: {source.poll()}")
    yield 2
    rig.shot("1_dropped.png")
    rig.xdo("key", "Return")
    yield from hands.comes(rig, installed, "the zip that was dropped is installed and enabled", 60)
    rig.check((folder() / "blender_manifest.toml").is_file(), f"in {folder().parent.name}")


def used(rig):
    """What works after a restart works at once."""
    hands.settings().resolution_percentage = 25
    yield from hands.open_panel(rig)
    yield 2
    yield from hands.click_button(rig, hands.SHADE)
    yield from hands.job_started(rig, "a click starts a job")
    yield from hands.wait_for_job(rig, 300)
    rig.check(len(hands.image_pixels("LTSH ltsh4c.combined")) > 0, "shading the camera view shows an image")
    yield 3
    yield from hands.click_button(rig, hands.PREVIEW)
    yield 5
    rig.check(bpy.context.scene.render.engine == "LTSH", "the preview is on")
    rig.shot("2_used.png")


def open_preferences(rig):
    bpy.ops.screen.userpref_show()
    yield 2
    rig.xdo("search", "--name", "Preferences", "windowmove", *PREFERENCES)
    yield 1
    yield from section("ADDONS")


def section(name):
    bpy.context.preferences.active_section = name
    bpy.context.window_manager.addon_search = "LTSH"
    yield 2


def click_there(rig, place):
    yield from hands.click(rig, PREFERENCES[0] + place[0], PREFERENCES[1] + place[1])
    yield 1


def disabled_and_enabled(rig, before):
    """By the checkbox, while the preview is seen."""
    yield from click_there(rig, CHECKBOX)
    yield from hands.comes(rig, lambda: not installed(), "the checkbox disables the add-on", 30)
    yield 2
    rig.shot("3_disabled.png")
    seen = bpy.context.scene.render.engine, rig.space.shading.type
    rig.check(seen == ("CYCLES", "SOLID"), f"the view shows what it did before the preview: {seen}")
    rig.check(not left(before), f"the disabled add-on leaves nothing: {left(before)}")
    yield from click_there(rig, CHECKBOX)
    yield from hands.comes(rig, installed, "the checkbox enables it again", 30)


def left(before):
    """What is there that was not; Blender itself keeps its path of wheels."""
    return {kind: change for kind, change in difference(before, state()).items() if kind != "paths"}


def uninstalled(rig, before):
    yield from section("EXTENSIONS")
    yield from click_there(rig, EXTENSION_MENU)
    rig.shot("4_menu.png")
    yield from click_there(rig, UNINSTALL)
    yield from hands.until(lambda: not folder().exists() and not installed(), 60)
    rig.check(not installed() and not folder().exists(), "Uninstall takes the add-on and its folder away")
    yield 2
    rig.shot("5_uninstalled.png")
    rig.check(not left(before), f"it leaves nothing: {left(before)}")
    files = [
        path for path in folder().parents[1].rglob("*") if "ltsh" in path.name.lower() or "exr" in path.name.lower()
    ]
    rig.check(not files, f"nor files: {files}")


def installed_from_disk(rig):
    yield from click_there(rig, MENU)
    yield from click_there(rig, INSTALL_FROM_DISK)
    yield from hands.until(lambda: hands.browser()[1] is not None, 30)
    yield 2
    window, area = hands.browser()
    parameters = area.spaces.active.params
    parameters.directory, parameters.filename = str(HERE).encode(), zip_file().name
    yield 2
    rig.shot("6_from_disk.png")
    yield from hands.click(rig, window.x + window.width - 70, rig.size[1] - window.y - 21)
    yield from hands.comes(rig, installed, "Install from Disk installs and enables it", 60)
    yield 2
    rig.shot("7_installed.png")
