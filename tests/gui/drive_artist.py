"""An artist's first hour, by mouse and keys: a new scene, the preview, lights and objects with their materials, solo,
mute, undo; save, compare, wipe, bake, apply, reload. Its pictures stand beside those of EEVEE and Cycles.

Materials are made in the Properties editor during the preview, as artists do. Set by their properties are only names,
colors, directions of lights, and what is smooth.
"""

import bpy
import eyes
import hands
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d

SECONDS = 2400
SIZE = "1600x900"
# From the right and upper end of the sidebar, see `hands`: name, star and eye of the first light of the list.
NAME, STAR, EYE, ROW = 225, 78, 58, 174
# The same of the menu of presets, and, while a light is chosen during the preview, of its fields.
PRESETS, DRAFT = (90, 15), (102, 53)
LIGHT_FIELDS = {"power": (103, 345), "size": (103, 433)}
# From the right and upper end of the Properties editor: its tab of materials, and what is in it.
MATERIAL_TAB, NEW = (12, 406), (97, 137)
FIELDS = {"metallic": (82, 287), "roughness": (82, 312), "transmission": (82, 527)}
TRANSMISSION = (211, 497)
BAKE_HEADER, BAKE, APPLY = (223, 477), (149, 625), (159, 654)
SOLID_SECONDS = 3.0


def main(rig):
    hands.patient(rig)
    yield from new_scene(rig)
    yield from previewed(rig)
    yield from lights_added(rig)
    yield from objects_added(rig)
    yield from looked_at(rig)
    yield from lights_changed(rig)
    yield from beside_others(rig)
    yield from saved_as(rig)
    yield from compared(rig)
    yield from wiped(rig)
    yield from baked(rig)
    yield from saved(rig)


def new_scene(rig):
    """File > New by its shortcut; delete the point light."""
    yield from hands.typed(rig, "ctrl+n", "g")
    yield 3
    rig.check(set(bpy.data.objects.keys()) == {"Cube", "Light", "Camera"}, "File > New gives Blender's own scene")
    yield from hands.typed(rig, "n")
    yield 1
    rig.tab("LTSH")
    yield 2
    rig.shot("artist_01_new.png")
    yield from click_light(rig, 0)
    rig.check(bpy.context.view_layer.objects.active.name == "Light", "a click in the list selects the light")
    rig.shot("artist_01_selected.png")
    yield from hands.typed(rig, "Delete")
    rig.check("Light" not in bpy.context.scene.objects, "Delete removes it")
    hands.select(rig, bpy.data.objects["Cube"])
    yield from hands.typed(rig, "Delete")


def click_light(rig, row, right=NAME):
    """Click in a row of the list of lights."""
    yield from hands.click(rig, *hands.to_window(rig, "VIEW_3D", "UI", right, ROW + 20 * row))


def added(rig, words):
    """Add an object by typing its name into the menu Add."""
    before = set(bpy.data.objects)
    yield from hands.typed(rig, "shift+a")
    rig.xdo("type", words)
    yield 1.5
    rig.xdo("key", "Return")
    yield from hands.until(lambda: set(bpy.data.objects) - before, 10)
    found = set(bpy.data.objects) - before
    rig.check(len(found) == 1, f"Add > {words} adds an object")
    return found.pop()


def moved(rig, **axes):
    """Move the selected object by typing."""
    for axis, value in axes.items():
        yield from hands.typed(rig, "g", axis)
        rig.xdo("type", "--", str(value))
        yield hands.CLICK_SECONDS
        yield from hands.keys(rig, "Return")


def lights_added(rig):
    lights = (("Key", {"x": 2.5, "y": -2, "z": 3}, "300", (1.0, 0.8, 0.6)),
              ("Fill", {"x": -3, "y": -2, "z": 2.5}, "120", (0.5, 0.7, 1.0)),
              ("Rim", {"x": 0, "y": 3.5, "z": 2.5}, "200", (1.0, 1.0, 1.0)))  # fmt: skip
    for name, place, power, tint in lights:
        ob = yield from added(rig, "area")
        ob.name, ob.data.shape, ob.data.color = name, "RECTANGLE", tint
        yield from moved(rig, **place)
        rig.check(abs(ob.location.z - place["z"]) < 1e-3, f"typing moves {name}")
        ob.rotation_euler = (-ob.location).to_track_quat("-Z", "Y").to_euler()
        yield 1
        yield from hands.field(rig, LIGHT_FIELDS["power"], power)
        yield from hands.field(rig, LIGHT_FIELDS["size"], "2")
        rig.check((ob.data.energy, ob.data.size) == (float(power), 2.0), f"the panel sets {name}: {ob.data.energy} W")
    rig.shot("artist_02_lights.png")


def objects_added(rig):
    for words, name, place, scale, smooth, values in (
        ("plane", "Floor", {}, "6", False, {"roughness": "0.35", "color": (0.35, 0.33, 0.3, 1.0)}),
        ("uv sphere", "Ball", {"x": -1.2, "z": 0.7}, "0.7", True,
         {"metallic": "1", "roughness": "0.2", "color": (1.0, 0.75, 0.3, 1.0)}),
        ("cylinder", "Cylinder", {"x": 1.3, "y": -0.8, "z": 0.6}, "0.5", False,
         {"roughness": "0.05", "transmission": "1", "color": (0.7, 0.9, 1.0, 1.0)}),
        ("monkey", "Monkey", {"x": 0.4, "y": 0.6, "z": 0.75}, "0.7", True, {"color": (0.7, 0.25, 0.2, 1.0)}),
    ):  # fmt: skip
        ob = yield from added(rig, words)
        ob.name = name
        yield from moved(rig, **place)
        yield from hands.typed(rig, "s")
        rig.xdo("type", scale)
        yield hands.CLICK_SECONDS
        yield from hands.keys(rig, "Return")
        rig.check(abs(ob.scale.x - float(scale)) < 1e-3, f"typing scales {name}")
        if smooth:
            bpy.ops.object.shade_smooth()
        yield from material(rig, ob, values)
    bpy.data.objects["Monkey"].rotation_euler = (-0.5, 0.0, 0.6)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 480, 270
    rig.camera_view()
    yield 2
    rig.shot("artist_02_objects.png")


def material(rig, ob, values):
    """A new material for the active object, by the Properties editor."""
    editor = {"kind": "PROPERTIES", "which": "WINDOW"}
    yield from hands.click(rig, *hands.to_window(rig, "PROPERTIES", "NAVIGATION_BAR", *MATERIAL_TAB))
    yield from hands.click(rig, *hands.to_window(rig, *editor.values(), *NEW))
    yield from hands.until(lambda: ob.material_slots)
    rig.check(len(ob.material_slots) == 1, f"New gives {ob.name} a material")
    yield 1
    if "transmission" in values:
        yield from hands.click(rig, *hands.to_window(rig, *editor.values(), *TRANSMISSION))
        yield 1
    for name in FIELDS.keys() & values.keys():
        yield from hands.field(rig, FIELDS[name], values[name], **editor)
    rig.shot(f"artist_02_{ob.name.lower()}.png")
    inputs = ob.material_slots[0].material.node_tree.nodes["Principled BSDF"].inputs
    names = {"metallic": "Metallic", "roughness": "Roughness", "transmission": "Transmission Weight"}
    found = {key: round(inputs[name].default_value, 3) for key, name in names.items() if key in values}
    wanted = {key: float(values[key]) for key in found}
    rig.check(found == wanted, f"the Properties editor sets its material during the preview: {found}")
    inputs["Base Color"].default_value = values["color"]


def previewed(rig):
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: bpy.context.scene.render.engine == "LTSH")
    rig.check(bpy.context.scene.render.engine == "LTSH", "a click on the large button starts the preview")


def looked_at(rig):
    pixels = yield from at_rest(rig, "artist_03_preview.png")
    rig.check(pixels.std() > 0.05, "the preview shows a picture")


def at_rest(rig, name, seconds=25):
    """What the view shows after a while, in which it is refined."""
    yield seconds
    return eyes.view_pixels(rig, name)


def brightness(rig, name, seconds=6):
    pixels = yield from at_rest(rig, name, seconds)
    return float(pixels[100:, 100:900].mean())


def lights_changed(rig):
    """Drag, resize, recolor, mute, solo, undo. The buttons of the view have moved the list down."""
    yield from click_light(rig, 1 + ROWS_LOWER)
    active = bpy.context.view_layer.objects.active
    rig.check(active is not None and active.type == "LIGHT", f"the list selects {active and active.name}")
    key = bpy.data.objects["Key"]
    hands.select(rig, key)
    hands.operate(rig, bpy.ops.ed.undo_push, message="Selected")
    place, size = key.location.copy(), key.data.size
    x, y = hands.view_middle(rig)
    yield from hands.over(rig, x=0.4)
    yield from hands.keys(rig, "g")
    for step in range(1, 5):
        rig.xdo("mousemove", x - 40 * step, y)
        yield hands.CLICK_SECONDS
        if step == 3:
            rig.shot("artist_04_dragging.png")
    rig.xdo("click", 1)
    yield hands.CLICK_SECONDS
    rig.check((key.location - place).length > 0.1, "the mouse drags the light")
    yield from hands.typed(rig, "s")
    rig.xdo("type", "1.5")
    yield hands.CLICK_SECONDS
    yield from hands.keys(rig, "Return")
    rig.check(abs(key.scale.x - 1.5) < 1e-3 and key.data.size == size, "typing resizes it")
    yield from at_rest(rig, "artist_05_dragged.png")
    yield from hands.typed(rig, "ctrl+z", "ctrl+z")
    key = bpy.data.objects["Key"]
    rig.check((key.location - place).length < 1e-4 and abs(key.scale.x - 1.0) < 1e-4, "undo takes both back")
    full = yield from brightness(rig, "artist_06_all.png")
    names = sorted(ob.name for ob in bpy.context.scene.objects if ob.type == "LIGHT")
    shown = [ob for ob in bpy.context.scene.objects if ob.type == "LIGHT"]
    row = shown.index(bpy.data.objects["Fill"]) + ROWS_LOWER
    yield from click_light(rig, row, STAR)
    rig.check(bpy.data.objects["Fill"].ltsh_light.solo, "a click on the star is solo")
    hidden = [name for name in names if bpy.data.objects[name].hide_render]
    rig.check(hidden == [name for name in names if name != "Fill"], f"which hides the others: {hidden}")
    alone = yield from brightness(rig, "artist_07_solo.png")
    yield from hands.typed(rig, "ctrl+z")
    rig.check(not any(bpy.data.objects[name].hide_render for name in names), "undo brings them back")
    yield from click_light(rig, row, EYE)
    rig.check(bpy.data.objects["Fill"].hide_render, "a click on the eye mutes")
    muted = yield from brightness(rig, "artist_08_muted.png")
    yield from hands.typed(rig, "ctrl+z")
    rig.check(not bpy.data.objects["Fill"].hide_render, "and undo unmutes")
    again = yield from brightness(rig, "artist_09_again.png")
    rig.fact("brightness of all, solo, muted, again", [round(value, 3) for value in (full, alone, muted, again)])
    rig.check(alone < 0.9 * full and muted < full and abs(again - full) < 0.02 * full, "the view follows")
    bpy.data.objects["Key"].data.color = (1.0, 0.4, 0.2)
    yield from at_rest(rig, "artist_10_recolored.png", 10)


# By so many rows the list is lower where the view has its settings above it.
ROWS_LOWER = 2


def beside_others(rig):
    """The same view as EEVEE and Cycles show it."""
    rig.space.overlay.show_overlays = False
    yield from at_rest(rig, "artist_11_ltsh.png", 40)
    scene = bpy.context.scene
    yield from hands.click_button(rig, hands.PREVIEW)
    rig.check(scene.render.engine != "LTSH", "the same button ends the preview")
    scene.cycles.preview_samples = 64
    # EEVEE compiles its shaders first.
    for engine, seconds in (("BLENDER_EEVEE", 90), ("CYCLES", 40)):
        scene.render.engine = engine
        rig.space.shading.type = "RENDERED"
        yield seconds
        rig.shot(f"artist_11_{engine.rpartition('_')[2].lower()}.png")
    rig.space.shading.type = "SOLID"
    rig.space.overlay.show_overlays = True
    yield SOLID_SECONDS


def saved_as(rig):
    """Ctrl S asks for a name."""
    yield from hands.typed(rig, "ctrl+s")
    yield from hands.saved_in(rig, rig.out, "artist.blend", "artist_12_saving.png")


def click_in_view(rig, name, right=0, up=0, key=""):
    """Click an object in the 3D view, with a key held; its origin is (right, up) pixels from there."""
    region, ob = rig.region(), bpy.data.objects[name]
    x, y = location_3d_to_region_2d(region, rig.space.region_3d, ob.matrix_world.translation)
    rig.xdo("mousemove", round(region.x + x + right), round(rig.size[1] - region.y - y - up))
    yield hands.CLICK_SECONDS
    if key:
        rig.xdo("keydown", key)
        yield 0.3
    rig.xdo("click", 1)
    yield hands.CLICK_SECONDS
    if key:
        rig.xdo("keyup", key)
        yield 0.3


def compared(rig):
    yield from hands.click_button(rig, PRESETS)
    yield 1
    rig.shot("artist_12_presets.png")
    yield from hands.click_button(rig, DRAFT)
    yield from hands.comes(rig, lambda: hands.settings().cycles_samples == 64, "the menu of presets has Draft")
    # The menu stays open, and would take the next click.
    yield from hands.keys(rig, "Escape")
    yield 1
    hands.settings().resolution_percentage = 100
    rig.area("DOPESHEET_EDITOR").ui_type = "IMAGE_EDITOR"
    yield 2
    yield from click_in_view(rig, "Ball")
    rig.check(bpy.context.view_layer.objects.active.name == "Ball", "a click in the view selects the ball")
    yield 1
    yield from hands.click_button(rig, hands.COMPARE)
    yield from hands.job_started(rig, "a click on Compare with Cycles starts a job")
    yield from hands.wait_for_job(rig, 600, ["artist_12_comparing.png"])
    image = rig.area("IMAGE_EDITOR").spaces.active.image
    rig.check(image is not None and image.name == "LTSH Comparison", "the pictures open by themselves")
    yield 2
    rig.shot("artist_13_compared.png")
    rig.check(len(bpy.context.window_manager.windows) == 1, "in the editor that was free")


def wiped(rig):
    """Drag the line in the Image Editor; without one the pictures open in a window of their own."""
    yield from hands.results_opened(rig)
    yield 1
    region = rig.region("IMAGE_EDITOR")
    (x, y), (end, _) = (region.view2d.view_to_region(split, 0.4) for split in (hands.settings().split, 0.3))
    height = rig.size[1] - region.y - y
    yield from hands.drag(rig, (region.x + x, height), (region.x + end, height))
    yield from hands.line_at(rig, 0.3, 0.05)
    rig.shot("artist_13_wiped.png")
    hands.operate(rig, bpy.ops.screen.area_close, kind="IMAGE_EDITOR")
    yield 2
    hands.operate(rig, bpy.ops.ltsh.open_results)
    yield 4
    windows = bpy.context.window_manager.windows
    rig.check(len(windows) == 2, "without one, in a window of their own")
    rig.shot("artist_14_window.png")
    hands.close_window(windows[1])
    yield 1


def baked(rig):
    hands.settings().bake_size, hands.settings().bake_view = "256", "above"
    yield from click_in_view(rig, "Floor", up=-150)
    yield from click_in_view(rig, "Monkey", key="shift")
    chosen = {ob.name for ob in bpy.context.selected_objects}
    rig.check(chosen == {"Floor", "Monkey"}, f"clicks in the view select both: {chosen}")
    yield 1
    yield from hands.click_button(rig, BAKE_HEADER)
    yield 2
    rig.shot("artist_15_bake.png")
    yield from hands.click_button(rig, BAKE)
    yield from hands.job_started(rig, "a click on Bake Selected starts a job")
    yield from hands.wait_for_job(rig, 600)
    for window in list(bpy.context.window_manager.windows)[1:]:
        hands.close_window(window)
    yield 3
    rig.shot("artist_15_baked.png")
    yield from hands.click_button(rig, APPLY)
    yield 2
    slots = [bpy.data.objects[name].material_slots[0].material.name for name in ("Floor", "Monkey")]
    rig.check(all("(baked" in name for name in slots), f"a click on Apply Bake shows the textures: {slots}")
    rig.space.shading.type = "MATERIAL"
    yield 40
    rig.shot("artist_16_applied.png")
    rig.space.shading.type = "SOLID"
    yield 1


def saved(rig):
    yield from hands.typed(rig, "ctrl+s")
    yield 2
    rig.check(not bpy.data.is_dirty, "Ctrl S saves")
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    yield 3
    material = bpy.data.objects["Floor"].material_slots[0].material
    rig.check("(baked" in material.name, "after loading the texture is shown")
    image = next(image for image in bpy.data.images if image.name.startswith("Floor"))
    rig.check(image.size[0] == 256 and np.ptp(np.array(image.pixels)) > 0.0, "from its file")
    hands.operate(rig, bpy.ops.ltsh.restore_materials)
    name = bpy.data.objects["Floor"].material_slots[0].material.name
    rig.check("(baked" not in name, f"Restore Materials gives it back: {name}")
    yield 1
    rig.shot("artist_17_reloaded.png")
