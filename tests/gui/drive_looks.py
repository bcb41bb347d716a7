"""How the panels look: light and dark theme, twice the scale, a narrow sidebar; for the eye above all."""

from pathlib import Path

import bpy
from hands import close_window, module, narrow, operate, over, results_opened, select, settings

SECONDS = 1200
SIZE = "1600x900"


def main(rig):
    rig.camera_view()
    settings().techniques, settings().cycles_samples = {"ltc", "ltsh2", "ltsh4"}, 4
    settings().anti_aliasing = 1
    # Nobody measures them here.
    settings().resolution_percentage, settings().bake_size, settings().bake_error = 20, "256", True
    bpy.data.objects["floor"].select_set(True)
    with rig.override():
        bpy.ops.ltsh.bake()
        bpy.ops.ltsh.compare()
    rig.panel()
    yield 1
    rig.tab("LTSH")
    yield from results_opened(rig)
    yield 2
    rig.check(rig.region("IMAGE_EDITOR", "UI").active_panel_category == "LTSH", "the tab of the Image Editor is open")
    rig.shot("1_dark.png")
    operate(rig, bpy.ops.ltsh.preview)
    select(rig, bpy.data.objects["Sunset"])
    yield from at_rest()
    rig.shot("1_dark_preview.png")
    quiet_line_is_clear(rig, "beside the sidebar")
    theme("Blender_Light")
    yield 3
    rig.shot("2_light.png")
    theme("Blender_Dark")
    yield from narrow(rig)
    rig.shot("3_narrow.png")
    settings().mode = "ERROR"
    bpy.context.preferences.view.ui_scale = 2.0
    yield from at_rest()
    rig.shot("4_twice_the_scale.png")
    quiet_line_is_clear(rig, "at twice the scale")
    # Those that are further down.
    yield from over(rig, "VIEW_3D", "UI")
    rig.xdo("click", "--repeat", 20, 5)
    yield 3
    rig.shot("4_further_down.png")
    bpy.context.preferences.view.ui_scale = 1.0
    operate(rig, bpy.ops.ltsh.preview)
    rig.area("PROPERTIES").spaces.active.context = "RENDER"
    yield 1
    operate(rig, bpy.ops.screen.screen_full_area, kind="PROPERTIES")
    yield 2
    # Our panel is the last one.
    yield from over(rig, "PROPERTIES")
    rig.xdo("click", "--repeat", 60, 5)
    yield 3
    rig.shot("5_render_properties.png")
    operate(rig, bpy.ops.screen.back_to_previous, kind="PROPERTIES")
    yield 1
    yield from two_windows(rig)
    yield from preferences(rig)


def at_rest(redraws=8):
    """Wait until panels have moved to their new places: that takes some redraws, which a busy machine makes slowly."""
    for _ in range(redraws):
        yield 1


def two_windows(rig):
    """Two views of a scene, the preview in the second."""
    operate(rig, bpy.ops.screen.area_dupli, "INVOKE_DEFAULT")
    yield 3
    second = bpy.context.window_manager.windows[-1]
    area = next(area for area in second.screen.areas if area.type == "VIEW_3D")
    with bpy.context.temp_override(window=second, area=area):
        bpy.ops.ltsh.preview()
    yield 6
    rig.check(area.spaces.active.shading.type == "RENDERED", "the preview is in the second window")
    rig.check(rig.space.shading.type == "SOLID", "and in that alone")
    rig.shot("7_two_windows.png")
    with bpy.context.temp_override(window=second, area=area):
        bpy.ops.ltsh.preview()
    close_window(second)
    yield 1


def quiet_line_is_clear(rig, where):
    """What the view leaves out stands beside Blender's own regions."""
    view, region = module("engine.overlay"), rig.region()
    sides = view.covered(rig.area("VIEW_3D"), region)
    place = view._quiet_lines.get(region.as_pointer())
    if not view._texts[region.as_pointer()].quiet.text:
        rig.fact(f"quiet line {where}", "nothing is left out, and no bounces are coming")
        return
    rig.fact(f"quiet line {where}: left and right, px", place and (round(place[0]), round(place[2])))
    left, right = max(sides["LEFT"], sides["FLOAT"]), region.width - sides["RIGHT"]
    rig.fact(f"room for it {where}, px", (left, right))
    rig.check(place is not None and left <= place[0] and place[2] <= right, f"the quiet line is clear {where}")


def theme(name):
    """Choose one of Blender's own themes."""
    folder = Path(bpy.utils.resource_path("LOCAL")) / "scripts" / "presets" / "interface_theme"
    folders = [folder, *(Path(path) / "interface_theme" for path in bpy.utils.preset_paths(""))]
    path = next(path for folder in folders if (path := folder / f"{name}.xml").exists())
    bpy.ops.script.execute_preset(filepath=str(path), menu_idname="USERPREF_MT_interface_theme_presets")


def preferences(rig):
    """The preferences of the add-on."""
    bpy.ops.screen.userpref_show()
    yield 1
    window = bpy.context.window_manager.windows[-1]
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "LTSH"
    import addon_utils

    addon_utils.modules_refresh()
    for addon in addon_utils.modules():
        if addon.__name__ == "bl_ext.user_default.ltsh":
            addon_utils.module_bl_info(addon)["show_expanded"] = True
    yield 2
    rig.shot("6_preferences.png")
    close_window(window)
    yield 1
