"""Gestures by the mouse, in Solid shading and in the preview: shares where it rests, a highlight, the edge of a shadow
and a brightness dragged; Escape and the right button put back, a release is one step of undo. Then Match and Move."""

import bpy
import hands
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Vector

SIZE = "1400x1000"
SECONDS = 1500
MATCH_SECONDS = 400
# Points of the floor: lit by both lights, at the edge of the box's shadow, and where that edge is dragged.
LIT, EDGE, NEW_EDGE = Vector((-1.2, 0.8, 0.0)), Vector((0.9, 0.0, 0.0)), Vector((1.4, 0.3, 0.0))
KEY, RIM = 100.0, 40.0  # W
ASIDE = Vector((0.3, 0.0, 0.1))  # m, from the light's place in the target of Match and Move


def main(rig):
    hands.patient(rig)
    told = heard()
    built()
    bpy.context.scene.ltsh_view.bounces = False
    yield from hands.open_panel(rig)
    hands.operate(rig, bpy.ops.ed.undo_push, message="Built")
    yield 1
    for shading in ("SOLID", "preview"):
        if shading == "preview":
            yield from hands.click_button(rig, hands.PREVIEW)
            yield 20
        rig.shot(f"00_{shading}.png")
        yield from brightness(rig, told, shading)
        yield from moved(rig, told, shading, "drag_shadow", EDGE, NEW_EDGE)
        yield from moved(rig, told, shading, "drag_highlight", LIT, Vector((-0.9, -0.6, 0.0)))
    yield from by_tool(rig)
    yield from by_keys(rig, told)
    yield from numbers(rig, told)
    yield from refused(rig, told)
    yield from second_view(rig)
    yield from matched(rig)


def heard():
    """What the headers are told, a list."""
    told, gesture = [], hands.module("ui.gestures").Gesture
    tell = gesture._tell

    def heard_tell(self, context, text):
        told.append(text)
        tell(self, context, text)

    gesture._tell = heard_tell
    return told


def built():
    """A box on a glossy floor, two lights and a camera."""
    for ob in list(bpy.data.objects):
        bpy.data.objects.remove(ob)
    glossy = bpy.data.materials.new("Glossy")
    glossy.use_nodes = True
    glossy.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.35
    for name, corners, location in (("Floor", 6.0, (0.0, 0.0, 0.0)), ("Box", 0.5, (0.0, 0.0, 0.5))):
        mesh = bpy.data.meshes.new(name)
        x = corners
        if name == "Floor":
            mesh.from_pydata([(-x, -x, 0), (x, -x, 0), (x, x, 0), (-x, x, 0)], [], [(0, 1, 2, 3)])
        else:
            faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
            mesh.from_pydata([(a, b, c) for a in (-x, x) for b in (-x, x) for c in (-x, x)], [], faces)
        mesh.materials.append(glossy)
        ob = bpy.data.objects.new(name, mesh)
        ob.location = location
        bpy.context.scene.collection.objects.link(ob)
    # From the key light, at a height of 4, the upper edge of the box at x = 0.5 casts its shadow at x = 0.9.
    for name, location, power in (("Key", (-0.7, 0.0, 4.0), KEY), ("Rim", (2.5, 3.0, 3.0), RIM)):
        light = bpy.data.objects.new(name, bpy.data.lights.new(name, "AREA"))
        light.location, light.data.energy, light.data.size = location, power, 0.15
        light.rotation_euler = Vector(location).to_track_quat("Z", "Y").to_euler()
        bpy.context.scene.collection.objects.link(light)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (1.0, -6.0, 4.5)
    camera.rotation_euler = (camera.location - Vector((0.3, 0.0, 0.2))).to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera, bpy.context.scene.world = camera, None
    bpy.context.view_layer.objects.active = bpy.data.objects["Key"]


def pixel(rig, point, area=None):
    """X11 coordinates of a point in the 3D view, or in that of an area."""
    region, space = rig.region(), rig.space
    if area is not None:
        region, space = next(one for one in area.regions if one.type == "WINDOW"), area.spaces.active
    x, y = view3d_utils.location_3d_to_region_2d(region, space.region_3d, point)
    return round(region.x + x), round(rig.size[1] - region.y - y)


def at(rig, point, dy=0):
    x, y = pixel(rig, point)
    rig.xdo("mousemove", x, y + dy)
    yield hands.CLICK_SECONDS


def power():
    return round(bpy.data.objects["Key"].data.energy, 3)


def place():
    # That of the world is old until the scene is evaluated after an undo.
    return np.array(bpy.data.objects["Key"].matrix_basis).round(5).tolist()


def begun(rig, name):
    bpy.context.view_layer.objects.active = bpy.data.objects["Key"]
    hands.operate(rig, getattr(bpy.ops.ltsh, name), "INVOKE_DEFAULT")


def brightness(rig, told, shading):
    scale = bpy.context.preferences.system.ui_scale
    for end in ("Escape", "right", "release"):
        begun(rig, "drag_brightness")
        yield from at(rig, LIT)
        yield from hands.comes(
            rig, lambda: told and told[-1] and told[-1].startswith("Key ") and "Rim " in told[-1],
            lambda end=end: f"{shading}, {end}: shares are told where the mouse rests: {told[-1:]}",
        )  # fmt: skip
        rig.shot(f"01_{shading}_shares.png")
        rig.xdo("mousedown", 1)
        yield hands.CLICK_SECONDS
        yield from at(rig, LIT, -round(100 * scale))
        yield from hands.comes(
            rig, lambda: power() > 2.0 * KEY, lambda: f"a stop takes more than twice its power: {power()}"
        )
        # With Ctrl in thirds of a stop: 60 of 100 pixels are 2/3.
        rig.xdo("keydown", "ctrl")
        yield from at(rig, LIT, -round(60 * scale))
        yield from hands.comes(rig, lambda: "+0.67 stops" in (told[-1] or ""), lambda: f"Ctrl snaps: {told[-1:]}")
        rig.xdo("keyup", "ctrl")
        yield from at(rig, LIT, -round(61 * scale))
        yield 1
        rig.shot(f"02_{shading}_brighter_{end}.png")
        if end != "release":
            rig.xdo(*(("key", "Escape") if end == "Escape" else ("click", 3)))
            yield from hands.comes(rig, lambda: power() == KEY, lambda end=end: f"{end} puts it back: {power()}")
            rig.check(told[-1] is None, "the header is Blender's again")
        rig.xdo("mouseup", 1)
        yield 1
    rig.check(power() > 1.3 * KEY and told[-1] is None, f"{shading}: a release leaves it: {power()}")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: power() == KEY, lambda: f"{shading}: one undo takes it back: {power()}")
    yield from hands.keys(rig, "ctrl+shift+z")
    yield from hands.comes(rig, lambda: power() > 1.3 * KEY, lambda: f"and redo brings it: {power()}")
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.until(lambda: power() == KEY)


def moved(rig, told, shading, name, start, end):
    """Drag from one point of the floor to another."""
    before = place()
    for way in ("Escape", "release"):
        begun(rig, name)
        yield from at(rig, start)
        rig.xdo("mousedown", 1)
        yield hands.CLICK_SECONDS
        yield from at(rig, start.lerp(end, 0.5))
        yield from at(rig, end)
        yield from hands.comes(rig, lambda: place() != before, f"{shading}, {name}, {way}: the light follows")
        yield 4 if shading == "preview" else 1
        rig.shot(f"03_{shading}_{name}_{way}.png")
        if way == "Escape":
            rig.fact(f"{shading}, {name}", told[-1])
            rig.xdo("key", "Escape")
            yield from hands.comes(
                rig, lambda: place() == before, lambda: f"{shading}, {name}: Escape puts {before} back: {place()}"
            )
        rig.xdo("mouseup", 1)
        yield 1
    if name == "drag_shadow":
        rig.check(on_edge(end), f"{shading}: the edge of the shadow is where it was dragged: {place()}")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(
        rig, lambda: place() == before, lambda: f"{shading}, {name}: one undo takes {before} back: {place()}"
    )


def by_tool(rig):
    """The tools of the toolbar: each drag is a gesture, without a click on a button. Also where Alt makes the left
    button the middle one."""
    bpy.context.preferences.inputs.use_mouse_emulate_3_button = True
    hands.operate(rig, bpy.ops.wm.tool_set_by_id, name="ltsh.drag_brightness_tool")
    for step in (1, 2):
        yield from at(rig, LIT)
        rig.xdo("mousedown", 1)
        yield hands.CLICK_SECONDS
        yield from at(rig, LIT, -50)
        rig.xdo("mouseup", 1)
        yield from hands.comes(
            rig, lambda step=step: power() > 1.3**step * KEY, lambda: f"a drag by the tool: {power()}"
        )
    rig.shot("04_tool.png")
    yield from hands.typed(rig, "ctrl+z", "ctrl+z")
    yield from hands.comes(rig, lambda: power() == KEY, lambda: f"two drags are two steps of undo: {power()}")
    before = place()
    hands.operate(rig, bpy.ops.wm.tool_set_by_id, name="ltsh.aim_light_tool")
    bpy.context.view_layer.objects.active = bpy.data.objects["Key"]
    yield from hands.drag(rig, pixel(rig, LIT), pixel(rig, EDGE))
    key = bpy.data.objects["Key"].matrix_world
    way = (EDGE - key.translation).normalized()
    rig.check(-key.col[2].xyz.normalized().dot(way) > 0.9999, f"the light is aimed: {place()}")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, "one undo takes it back")
    hands.operate(rig, bpy.ops.wm.tool_set_by_id, name="builtin.select_box")
    bpy.context.preferences.inputs.use_mouse_emulate_3_button = False


def on_edge(point):
    """True if the line from the light to a point of the floor passes the box by less than 2 cm, or enters it by less:
    the slabs of the box, made larger and smaller."""
    center = np.array(bpy.data.objects["Key"].matrix_world.translation)
    start, way = np.array(point) + 1e-9, center - np.array(point) + 1e-9
    meets = []
    for more in (0.02, -0.02):
        low, high = np.array([-0.5, -0.5, 0.0]) - more, np.array([0.5, 0.5, 1.0]) + more
        ends = np.sort([(low - start) / way, (high - start) / way], axis=0)
        meets.append(ends[0].max() < ends[1].min())
    return meets == [True, False]


def by_keys(rig, told):
    """Keys during a drag: Shift, D, S, C, axes; Escape gives all of it back, a release is one step of undo."""
    key = bpy.data.objects["Key"]
    before, size, color = place(), key.data.size, tuple(key.data.color)
    for end in ("Escape", "release"):
        begun(rig, "drag_highlight")
        yield from at(rig, LIT)
        rig.xdo("mousedown", 1)
        yield from hands.comes(rig, lambda: place() != before, f"by keys, {end}: the light follows")
        for name, word in (("d", "distance"), ("s", "size"), ("c", "color")):
            was = place(), key.data.size, tuple(key.data.color)
            rig.xdo("key", name)
            yield from at(rig, LIT, -1)
            rig.xdo("mousemove_relative", 60, 30)
            yield from hands.comes(
                rig, lambda word=word: f"the mouse changes the {word}" in (told[-1] or ""), f"{name}: {told[-1:]}"
            )
            yield from hands.comes(
                rig, lambda was=was: was != (place(), key.data.size, tuple(key.data.color)), f"{word} changes"
            )
            rig.shot(f"06_key_{name}.png")
            rig.xdo("key", name)
            yield hands.CLICK_SECONDS
            yield from at(rig, LIT)
        height = place()[2][3]
        rig.xdo("keydown", "shift")
        rig.xdo("key", "z")
        yield hands.CLICK_SECONDS
        rig.xdo("keyup", "shift")
        yield from at(rig, Vector((-0.9, -0.6, 0.0)))
        yield from hands.comes(rig, lambda: "along XY" in (told[-1] or ""), lambda: f"Shift Z locks: {told[-1:]}")
        rig.check(abs(place()[2][3] - 4.0) < 1e-3, f"its height is that of the start: {height} to {place()[2][3]}")
        yield 1
        rig.shot("07_locked.png")
        if end == "Escape":
            rig.xdo("key", "Escape")
            yield from hands.comes(
                rig, lambda: (place(), key.data.size, tuple(key.data.color)) == (before, size, color), "all is back"
            )
        rig.xdo("mouseup", 1)
        yield 1
    yield from hands.typed(rig, "ctrl+z")
    key = bpy.data.objects["Key"]
    yield from hands.comes(
        rig, lambda: (place(), bpy.data.objects["Key"].data.size) == (before, size), "one undo takes all of it back"
    )


def second_view(rig):
    """A drag in each of two views moves the light, and both pictures change."""
    hands.operate(rig, bpy.ops.screen.area_split, direction="VERTICAL", factor=0.5)
    yield 2
    areas = [area for area in rig.window.screen.areas if area.type == "VIEW_3D"]
    rig.check(len(areas) == 2, "there are two views")
    other = areas[1].spaces.active
    other.region_3d.view_perspective = "PERSP"
    other.region_3d.view_location, other.region_3d.view_distance = (0.0, 0.0, 0.2), 9.0
    other.region_3d.view_rotation = Vector((-3.0, -4.0, 5.0)).to_track_quat("Z", "Y")
    for area in areas:
        area.spaces.active.shading.type, area.spaces.active.show_region_ui = "RENDERED", False
    yield 15
    start = place()
    for number, area in enumerate(areas):
        before = place()
        rig.shot(f"08_views_{number}_before.png")
        begun(rig, "drag_highlight")
        rig.xdo("mousemove", *pixel(rig, LIT, area))
        yield hands.CLICK_SECONDS
        rig.xdo("mousedown", 1)
        yield hands.CLICK_SECONDS
        rig.xdo("mousemove", *pixel(rig, Vector((-1.0, -0.9 + 0.5 * number, 0.0)), area))
        yield from hands.comes(rig, lambda before=before: place() != before, f"view {number}: the light follows")
        yield 8
        rig.shot(f"08_views_{number}_dragged.png")
        changed = [differs(rig, f"08_views_{number}", region_of(one)) for one in areas]
        rig.fact(f"view {number}: shares of pixels that change", changed)
        rig.check(min(changed) > 0.01, f"a drag in view {number} changes both pictures: {changed}")
        rig.xdo("mouseup", 1)
        yield 1
    for _ in areas:
        yield from hands.keys(rig, "ctrl+z")
        yield 1
    yield from hands.comes(rig, lambda: place() == start, "a step of undo for each")


def region_of(area):
    return next(region for region in area.regions if region.type == "WINDOW")


def differs(rig, name, region):
    """The share of the pixels of a region that differ between two screenshots."""
    first, second = (shown(rig.out / f"{name}_{when}.png", region) for when in ("before", "dragged"))
    return round(float((np.abs(first - second).max(axis=-1) > 0.02).mean()), 3)


def shown(path, region):
    """The colors (H, W, 4) of a region in a screenshot."""
    image = bpy.data.images.load(str(path), check_existing=False)
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(image.size[1], image.size[0], 4)
    bpy.data.images.remove(image)
    return pixels[region.y : region.y + region.height, region.x : region.x + region.width]


def refused(rig, told):
    """A light whose power something holds says so, and stays."""
    key = bpy.data.objects["Key"]
    key.data.keyframe_insert("energy", frame=1)
    begun(rig, "drag_brightness")
    yield from at(rig, LIT)
    rig.xdo("mousedown", 1)
    yield hands.CLICK_SECONDS
    rig.check(told[-1] == "Key: its power is animated or driven", f"it says why not: {told[-1:]}")
    rig.shot("05_refused.png")
    rig.xdo("mouseup", 1)
    yield hands.CLICK_SECONDS
    yield from hands.keys(rig, "Escape")
    yield from hands.comes(rig, lambda: told[-1] is None, "Escape ends it")
    rig.check(power() == KEY, f"its power stays: {power()}")


def numbers(rig, told):
    """No light is active: the one with the most glossy light is taken, and goes to a typed distance."""
    before = place()
    bpy.context.view_layer.objects.active = None
    hands.operate(rig, bpy.ops.ltsh.drag_highlight, "INVOKE_DEFAULT")
    yield from at(rig, LIT)
    rig.xdo("mousedown", 1)
    yield from hands.comes(rig, lambda: (told[-1] or "").startswith("Key    "), lambda: f"Key is taken: {told[-1:]}")
    yield from hands.keys(rig, "2", "period", "5")
    yield from hands.comes(
        rig, lambda: "[2.5]" in (told[-1] or "") and "Distance 2.5 m" in told[-1], lambda: f"2.5 m: {told[-1:]}"
    )
    rig.shot("09_typed.png")
    yield from hands.keys(rig, "Return")
    yield from hands.comes(rig, lambda: told[-1] is None, "Enter ends the drag")
    rig.xdo("mouseup", 1)
    yield 1
    rig.check(abs((Vector([row[3] for row in place()][:3]) - LIT).length - 2.5) < 0.02, f"it is there: {place()}")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, "one undo takes it back")


def matched(rig):
    """A target of Cycles, with the light elsewhere."""
    bpy.data.objects["Key"].data.animation_data_clear()
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.engine = 96, 64, "CYCLES"
    scene.cycles.samples, scene.render.image_settings.file_format = 128, "OPEN_EXR"
    scene.render.filepath = str(rig.out / "target.exr")
    hands.operate(rig, bpy.ops.render.render, write_still=True)
    scene.ltsh.match_target = bpy.data.images.load(scene.render.filepath)
    true = bpy.data.objects["Key"].location.copy()
    bpy.data.objects["Key"].location += ASIDE
    yield 1
    hands.operate(rig, bpy.ops.ed.undo_push, message="Moved")
    before = place()
    hands.operate(rig, bpy.ops.ltsh.match_move, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "Match and Move starts a job")
    yield 4
    rig.shot("10_job.png")
    yield from hands.typed(rig, "Escape")
    yield from hands.comes(rig, lambda: hands.job() is None and place() == before, "Escape ends it, and nothing moved")
    hands.operate(rig, bpy.ops.ltsh.match_move, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "it starts again")
    yield from hands.wait_for_job(rig, MATCH_SECONDS)
    yield 1
    off = (bpy.data.objects["Key"].location - true).length
    rig.fact("how far the light is from where it was, in m", round(off, 4))
    rig.check(off < 0.03 * 4.0, f"the light is back within 3 % of its distance: {off:.3f} m")
    rig.shot("11_matched.png")
    yield from hands.typed(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, "one undo takes it back")
