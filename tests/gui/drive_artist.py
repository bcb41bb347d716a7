"""An artist's first hour: a new scene, lights, objects and materials by mouse and keys; preview, solo, mute, undo;
compare, wipe, bake, apply, save, reload. Its pictures stand beside those of EEVEE and Cycles.

Only the values of materials are set by their properties; all else is clicked or typed.
"""

import bpy
import eyes
import hands
import numpy as np

SECONDS = 2400
SIZE = "1600x900"
# From the right and upper end of the sidebar, see `hands`: name, star and eye of the first light of the list.
NAME, STAR, EYE, ROW = 225, 78, 58, 174
SOLID_SECONDS = 3.0


def main(rig):
    yield from new_scene(rig)
    yield from lights_added(rig)
    yield from objects_added(rig)
    yield from previewed(rig)
    yield from lights_changed(rig)
    yield from beside_others(rig)
    yield from compared(rig)
    yield from baked(rig)
    yield from saved(rig)


def typed(rig, *names):
    """Press keys with the mouse over the 3D view."""
    yield from hands.over(rig)
    yield from hands.keys(rig, *names)


def new_scene(rig):
    """File > New by its shortcut; delete the point light."""
    yield from typed(rig, "ctrl+n", "g")
    yield 3
    rig.check(set(bpy.data.objects.keys()) == {"Cube", "Light", "Camera"}, "File > New gives Blender's own scene")
    yield from typed(rig, "n")
    yield 1
    rig.tab("LTSH")
    yield 2
    rig.shot("artist_01_new.png")
    yield from click_light(rig, 0)
    rig.check(bpy.context.view_layer.objects.active.name == "Light", "a click in the list selects the light")
    rig.shot("artist_01_selected.png")
    yield from typed(rig, "Delete")
    rig.check("Light" not in bpy.context.scene.objects, "Delete removes it")
    hands.select(rig, bpy.data.objects["Cube"])
    yield from typed(rig, "Delete")


def click_light(rig, row, right=NAME):
    """Click in a row of the list of lights."""
    yield from hands.click(rig, *hands.to_window(rig, "VIEW_3D", "UI", right, ROW + 20 * row))


def added(rig, words):
    """Add an object by typing its name into the menu Add."""
    before = set(bpy.data.objects)
    yield from typed(rig, "shift+a")
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
        yield from typed(rig, "g", axis)
        rig.xdo("type", str(value))
        yield hands.CLICK_SECONDS
        yield from hands.keys(rig, "Return")


def lights_added(rig):
    lights = (("Key", {"x": 2.5, "y": -2, "z": 3}, 300.0, (1.0, 0.8, 0.6)),
              ("Fill", {"x": -3, "y": -2, "z": 2.5}, 120.0, (0.5, 0.7, 1.0)),
              ("Rim", {"x": 0, "y": 3.5, "z": 2.5}, 200.0, (1.0, 1.0, 1.0)))  # fmt: skip
    for name, place, power, color in lights:
        ob = yield from added(rig, "area")
        ob.name, ob.data.shape, ob.data.size, ob.data.size_y = name, "RECTANGLE", 2.0, 1.0
        ob.data.energy, ob.data.color = power, color
        yield from moved(rig, **place)
        rig.check(abs(ob.location.z - place["z"]) < 1e-3, f"typing moves {name}")
        track = ob.constraints.new("TRACK_TO")
        track.target, track.track_axis, track.up_axis = bpy.data.objects["Camera"], "TRACK_NEGATIVE_Z", "UP_Y"
        bpy.context.view_layer.update()
        ob.constraints.remove(track)
        ob.rotation_euler = (-ob.location).to_track_quat("-Z", "Y").to_euler()


def objects_added(rig):
    floor = yield from added(rig, "plane")
    floor.scale = (6.0, 6.0, 1.0)
    ball = yield from added(rig, "uv sphere")
    ball.location, ball.scale = (-1.2, 0.0, 0.7), (0.7, 0.7, 0.7)
    bpy.ops.object.shade_smooth()
    glass = yield from added(rig, "cylinder")
    glass.location, glass.scale = (1.3, -0.8, 0.6), (0.4, 0.4, 0.6)
    monkey = yield from added(rig, "monkey")
    monkey.location, monkey.rotation_euler = (0.4, 0.6, 0.75), (-0.5, 0.0, 0.6)
    monkey.scale = (0.7, 0.7, 0.7)
    bpy.ops.object.shade_smooth()
    floor.name, ball.name, glass.name, monkey.name = "Floor", "Ball", "Cylinder", "Monkey"
    material(floor, "Floor", Roughness=0.35, Base_Color=(0.35, 0.33, 0.3, 1.0))
    material(ball, "Gold", Roughness=0.2, Metallic=1.0, Base_Color=(1.0, 0.75, 0.3, 1.0))
    material(glass, "Glass", Roughness=0.05, Transmission_Weight=1.0, Base_Color=(0.7, 0.9, 1.0, 1.0))
    material(monkey, "Clay", Roughness=0.5, Base_Color=(0.7, 0.25, 0.2, 1.0))
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 480, 270
    rig.camera_view()
    yield 2
    rig.shot("artist_02_objects.png")


def material(ob, name, **values):
    made = bpy.data.materials.new(name)
    if not made.use_nodes:
        made.use_nodes = True
    inputs = made.node_tree.nodes["Principled BSDF"].inputs
    for key, value in values.items():
        inputs[key.replace("_", " ")].default_value = value
    ob.data.materials.append(made)


def previewed(rig):
    yield from hands.click_button(rig, hands.PREVIEW)
    pixels = yield from at_rest(rig, "artist_03_preview.png")
    rig.check(bpy.context.scene.render.engine == "LTSH", "a click on the large button starts the preview")
    rig.check(pixels.std() > 0.05, "and shows a picture")


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
    yield from typed(rig, "s")
    rig.xdo("type", "1.5")
    yield hands.CLICK_SECONDS
    yield from hands.keys(rig, "Return")
    rig.check(abs(key.scale.x - 1.5) < 1e-3 and key.data.size == size, "typing resizes it")
    yield from at_rest(rig, "artist_05_dragged.png")
    yield from typed(rig, "ctrl+z", "ctrl+z")
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
    yield from typed(rig, "ctrl+z")
    rig.check(not any(bpy.data.objects[name].hide_render for name in names), "undo brings them back")
    yield from click_light(rig, row, EYE)
    rig.check(bpy.data.objects["Fill"].hide_render, "a click on the eye mutes")
    muted = yield from brightness(rig, "artist_08_muted.png")
    yield from typed(rig, "ctrl+z")
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


def compared(rig):
    bpy.ops.wm.save_as_mainfile(filepath=str(rig.out / "artist.blend"))
    hands.settings().cycles_samples, hands.settings().anti_aliasing, hands.settings().shadow_rays = 64, 1, 64
    rig.area("DOPESHEET_EDITOR").ui_type = "IMAGE_EDITOR"
    yield 2
    hands.operate(rig, bpy.ops.ltsh.compare, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "Compare with Cycles starts a job")
    yield from hands.wait_for_job(rig, 600, ["artist_12_comparing.png"])
    image = rig.area("IMAGE_EDITOR").spaces.active.image
    rig.check(image is not None and image.name == "LTSH Comparison", "the pictures open by themselves")
    yield 2
    rig.shot("artist_13_compared.png")
    hands.settings().split = 0.3
    rig.check(len(bpy.context.window_manager.windows) == 1, "in the editor that was free")
    rig.area("IMAGE_EDITOR").ui_type = "DOPESHEET"
    yield 1
    hands.operate(rig, bpy.ops.ltsh.open_results)
    yield 4
    windows = bpy.context.window_manager.windows
    rig.check(len(windows) == 2, "without one, in a window of their own")
    rig.shot("artist_14_window.png")
    hands.close_window(windows[1])
    yield 1


def baked(rig):
    hands.settings().bake_size, hands.settings().bake_view = "256", "above"
    for name in ("Floor", "Monkey"):
        hands.select(rig, bpy.data.objects[name])
    bpy.data.objects["Floor"].select_set(True)
    yield 1
    hands.operate(rig, bpy.ops.ltsh.bake, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "Bake Selected starts a job")
    yield from hands.wait_for_job(rig, 600)
    for window in list(bpy.context.window_manager.windows)[1:]:
        hands.close_window(window)
    yield 1
    hands.operate(rig, bpy.ops.ltsh.apply_bake)
    slots = [bpy.data.objects[name].material_slots[0].material.name for name in ("Floor", "Monkey")]
    rig.check(all("(baked" in name for name in slots), f"Apply Bake shows the textures: {slots}")
    rig.space.shading.type = "MATERIAL"
    yield 25
    rig.shot("artist_15_applied.png")
    rig.space.shading.type = "SOLID"


def saved(rig):
    yield from typed(rig, "ctrl+s")
    yield 2
    rig.check(not bpy.data.is_dirty, "Ctrl S saves")
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    yield 3
    material = bpy.data.objects["Floor"].material_slots[0].material
    rig.check("(baked" in material.name, "after loading the texture is shown")
    image = next(image for image in bpy.data.images if image.name.startswith("Floor"))
    rig.check(image.size[0] == 256 and np.ptp(np.array(image.pixels)) > 0.0, "from its file")
    hands.operate(rig, bpy.ops.ltsh.restore_materials)
    rig.check(bpy.data.objects["Floor"].material_slots[0].material.name == "Floor", "Restore Materials gives it back")
    yield 1
    rig.shot("artist_16_reloaded.png")
