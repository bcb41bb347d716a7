"""Lights that the mouse drags by their highlight, and lights that must stay."""

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from bl_ui.space_toolsystem_toolbar import VIEW3D_PT_tools_active
from mathutils import Matrix, Vector

from ltsh_addon.blender.evaluated import EmitterTraits
from ltsh_addon.blender.lights.area import area_light
from ltsh_addon.blender.lights.groups import reason_to_stay
from ltsh_addon.blender.lights.linking import Receivers
from ltsh_addon.blender.lights.textures import ShownTextures
from ltsh_addon.blender.ui import gestures
from ltsh_addon.blender.ui.highlight_place import (
    NO_HIGHLIGHT,
    HitsAround,
    note_by_pixels,
    place_of,
    prepare_view,
    samples_of,
)
from ltsh_addon.blender.ui.light_pose import LightLook, LightPose, locked_place, reason_to_keep_look
from ltsh_addon.blender.ui.lit_point import SceneLights, shipped_table, surface_hits
from ltsh_addon.shading import shade
from ltsh_addon.shading.highlight import STENCIL

EYE, PIXEL = Vector((0.3, -4.0, 2.2)), 0.003


@pytest.fixture
def scene():
    """A smooth ball, squeezed and turned, on a floor, and a light."""
    scene = parts.empty_scene()
    ball = parts.principled("Ball", Roughness=0.25)[0]
    parts.add_sphere(ball, segments=64, location=(0.0, 0.0, 0.8), rotation=(0.3, 0.2, 0.0), scale=(1.2, 0.8, 0.7))
    parts.add_plane(parts.principled("Floor", Roughness=0.45, Metallic=1.0)[0])
    parts.add_area_light("Key", location=(-2.0, -2.0, 3.0))
    return scene


def hits_at(scene, pixels, target):
    """What rays through `pixels` (P, 2) around a target meet."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    toward = (target - EYE).normalized()
    right = toward.cross(Vector((0.0, 0.0, 1.0))).normalized()
    above = right.cross(toward)
    rays = [(toward + PIXEL * (x * right + y * above)).normalized() for x, y in pixels.tolist()]
    return surface_hits(scene, depsgraph, [(EYE, ray) for ray in rays])


@pytest.mark.parametrize("target", [(0.2, -0.5, 1.1), (-0.4, -0.4, 0.9), (1.3, -0.8, 0.0), (-1.0, -1.4, 0.0)])
def test_the_highlight_is_where_the_mouse_is(scene, target):
    light = bpy.data.objects["Key"]
    hits = hits_at(scene, 2.0 * STENCIL, Vector(target))
    matrix, note = place_of(light, LightPose.of(light), HitsAround(hits, 2.0 * STENCIL, True), 2.5, ShownTextures())
    assert not note
    middle = hits[0]
    assert (matrix.translation - middle.position).length == pytest.approx(2.5, rel=1e-5)
    facing = -matrix.col[2].xyz
    assert facing.dot((middle.position - matrix.translation).normalized()) == pytest.approx(1.0, abs=1e-5)
    # All pixels around, by the radiance itself.
    grid = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), axis=-1).reshape(-1, 2)
    around = [(pixel, hit) for pixel, hit in zip(grid, hits_at(scene, grid, Vector(target)), strict=True)
              if hit is not None and hit.material == middle.material]  # fmt: skip
    pixels, seen = np.array([pixel for pixel, _ in around]), [hit for _, hit in around]
    lamp = area_light(light, np.array(matrix), EmitterTraits("", True, True), Receivers([]))
    samples = samples_of(seen, HitsAround(hits, 2.0 * STENCIL, True).lobe, ShownTextures())
    radiance = shade(samples, [lamp], passes=("specular",), workers=1).specular.sum(axis=(0, 2))
    lost = 1.0 - radiance[(pixels == 0).all(axis=-1)][0] / radiance.max()
    # Facets of 64 segments bend the interpolated normals by a little.
    assert lost < 0.01 or np.linalg.norm(pixels[np.argmax(radiance)]) <= 2.0


def test_normals_are_those_of_the_smooth_surface(scene):
    (hit,) = hits_at(scene, np.zeros((1, 2)), Vector((0.2, -0.5, 1.1)))
    ob = bpy.data.objects["Sphere"]
    inside = ob.matrix_world.inverted() @ hit.position
    expected = (ob.matrix_world.to_3x3().inverted().transposed() @ inside).normalized()
    # Interpolated over facets of 64 segments: some 1e-3.
    assert hit.normal.dot(expected) > 1.0 - 1e-4
    assert hit.material.name == "Ball" and hit.view.dot((EYE - hit.position).normalized()) == pytest.approx(1.0)
    assert hits_at(scene, np.zeros((1, 2)), Vector((0.0, 0.0, 4.0))) == [None]


def test_dull_surfaces_say_so_and_a_sun_stays_where_it_is(scene):
    key = bpy.data.objects["Key"]
    for kind in ("Diffuse", "Refraction", "Transparent"):
        dull = parts.bsdf_material(f"ShaderNodeBsdf{kind}", Color=(0.9, 0.4, 0.2, 1.0))[0]
        bpy.data.objects["Plane"].data.materials[0] = dull
        hits = hits_at(scene, 2.0 * STENCIL, Vector((1.3, -0.8, 0.0)))
        _, note = place_of(key, LightPose.of(key), HitsAround(hits, 2.0 * STENCIL, True), 2.0, ShownTextures())
        assert note == NO_HIGHLIGHT, kind
    sun = parts.link(bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN")), (1.0, 2.0, 3.0))
    bpy.context.view_layer.update()
    hits = hits_at(scene, 2.0 * STENCIL, Vector((0.2, -0.5, 1.1)))
    matrix, note = place_of(sun, LightPose.of(sun), HitsAround(hits, 2.0 * STENCIL, True), 2.0, ShownTextures())
    assert not note and matrix.translation == sun.matrix_world.translation


def test_lights_that_something_holds_stay(scene):
    light = bpy.data.objects["Key"]
    assert reason_to_stay(light) == ""
    light.lock_location[2] = True
    assert "locked" in reason_to_stay(light)
    light.lock_location[2] = False
    constraint = light.constraints.new("TRACK_TO")
    constraint.name = "Aim"
    assert "its constraint 'Aim' moves it" in reason_to_stay(light)
    constraint.enabled = False
    assert reason_to_stay(light) == ""
    light.keyframe_insert("location", frame=1)
    assert reason_to_stay(light) == "it is animated or driven"


@pytest.mark.parametrize("mode", ["XYZ", "QUATERNION", "AXIS_ANGLE"])
def test_a_light_under_a_sheared_parent_faces_the_point_and_comes_back_to_the_last_bit(scene, mode):
    outer = parts.link(bpy.data.objects.new("Outer", None), (0.3, 0.1, 0.2), (0.3, 0.5, 0.9), (1.0, 3.0, 0.4))
    inner = parts.link(bpy.data.objects.new("Inner", None), (0.1, 0.0, 0.2), (0.7, 0.1, 0.3), (0.8, 1.0, 2.0))
    inner.parent, light = outer, bpy.data.objects["Key"]
    light.parent, light.rotation_mode = inner, mode
    light.rotation_euler, light.scale, light.delta_location = (0.1, 7.0, 0.3), (1.0, 1.3, 0.7), (0.1, 0.2, 0.3)
    light.rotation_quaternion, light.rotation_axis_angle = (0.7, 0.1, -0.5, 0.4), (0.4, 0.1, 0.9, 0.2)
    bpy.context.view_layer.update()
    names = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
    before, world = [tuple(getattr(light, name)) for name in names], light.matrix_world.copy()
    pose, point, direction = LightPose.of(light), Vector((0.4, 0.2, 0.1)), Vector((0.36, 0.48, 0.8))
    matrix = pose.facing(point, direction, 2.5)
    pose.put(light, matrix)
    bpy.context.view_layer.update()
    # Rounding of single precision through matrices with scales from 0.4 to 3.
    assert np.abs(np.array(light.matrix_world) - np.array(matrix)).max() < 1e-4
    assert (light.matrix_world.translation - (point + 2.5 * direction)).length < 1e-4
    assert light.matrix_world.col[2].xyz.normalized().dot(direction) == pytest.approx(1.0, abs=1e-6)
    pose.put_back(light)
    bpy.context.view_layer.update()
    assert before == [tuple(getattr(light, name)) for name in names] and light.matrix_world == world


def test_a_light_is_aimed_where_it_is(scene):
    light, kind = bpy.data.objects["Key"], gestures.LTSH_OT_aim_light
    (hit,) = hits_at(scene, np.zeros((1, 2)), Vector((1.3, -0.8, 0.0)))
    pose = LightPose.of(light)
    this = SimpleNamespace(
        hit_under=lambda context, event: hit,
        _pose=pose,
        _put=lambda matrix: pose.put(light, matrix),
        _noted=str,
    )
    assert kind.follow(this, bpy.context, None)
    bpy.context.view_layer.update()
    assert (light.matrix_world.translation - Vector((-2.0, -2.0, 3.0))).length < 1e-5
    way = (hit.position - light.matrix_world.translation).normalized()
    assert way.dot(-light.matrix_world.col[2].xyz.normalized()) == pytest.approx(1.0, abs=1e-6)
    bpy.context.view_layer.objects.active = light
    assert kind.reason_against(bpy.context) == ""
    light.data.type = "POINT"
    assert kind.reason_against(bpy.context) == "A point light shines everywhere"


def test_each_gesture_is_a_tool_that_says_why_it_cannot_begin(addon):
    groups = [item for item in VIEW3D_PT_tools_active._tools["OBJECT"] if isinstance(item, tuple)]
    (ours,) = [group for group in groups if getattr(group[0], "idname", "") == "ltsh.drag_highlight_tool"]
    assert [tool.idname for tool in ours] == [f"{gesture.bl_idname}_tool" for gesture in gestures.GESTURES]
    texts = []
    layout = SimpleNamespace(label=lambda text: texts.append(text))
    ours[0].draw_settings(bpy.context, layout, None)
    light = parts.add_area_light("Key")
    bpy.context.view_layer.objects.active = None
    for tool in ours[:2]:
        tool.draw_settings(bpy.context, layout, None)
    bpy.context.view_layer.objects.active = light
    ours[0].draw_settings(bpy.context, layout, None)
    light.lock_rotation[0] = True
    ours[1].draw_settings(bpy.context, layout, None)
    assert texts == [
        "No light is active", f"Drag the highlight of {gestures.MOST_GLOSSY}    {gestures.MOVING_KEYS}",
        "No light is active", f"Drag the highlight of Key    {gestures.MOVING_KEYS}",
        "Key: its location or rotation is locked: unlock it in the tab Item",
    ]  # fmt: skip


def event(kind, value="PRESS", mouse=(0, 0), **held):
    """An event of a key or the mouse; `held`: shift, ctrl."""
    held = {"shift": False, "ctrl": False, "alt": False, **held}
    ascii = {"PERIOD": ".", "MINUS": "-"}.get(kind, kind if kind.isdigit() else "")
    return SimpleNamespace(type=kind, value=value, mouse_x=mouse[0], mouse_y=mouse[1], ascii=ascii, **held)


class Recorded(gestures.Gesture):
    """A gesture that notes what is asked of it."""

    KEYS, bl_label = "Keys", "Gesture"

    def __init__(self, can_press=True):
        self.asked, self._can_press = [], can_press

    def press(self, context, event):
        self.asked.append("press")
        self._note = "pressed"
        return self._can_press

    def follow(self, context, event):
        if event.type == "RIGHT_CTRL":
            raise RuntimeError("broken")
        self.asked.append("follow")
        return True

    def wheel(self, factor):
        self.asked.append(f"wheel {factor:.3g}")

    def put_back(self):
        self.asked.append("put back")

    def _hover(self, context, event):
        self.asked.append("hover")
        return True

    def report(self, kind, text):
        self.asked.append(text)


def window():
    """A context that counts what a gesture leaves in the window; (context, what is there)."""
    there = {"timers": 0, "handlers": 0, "cursors": 0, "status": None, "header": None}

    def more(name, step):
        return lambda *_, **__: there.update({name: there[name] + step})

    area = SimpleNamespace(type="VIEW_3D", header_text_set=lambda text: there.update(header=text))
    context = SimpleNamespace(
        window_manager=SimpleNamespace(
            event_timer_add=more("timers", 1), event_timer_remove=more("timers", -1),
            modal_handler_add=more("handlers", 1),
        ),
        window=SimpleNamespace(
            cursor_modal_set=more("cursors", 1), cursor_modal_restore=more("cursors", -1),
            screen=SimpleNamespace(areas=[area]),
        ),
        workspace=SimpleNamespace(status_text_set=lambda text: there.update(status=text)),
        preferences=bpy.context.preferences, scene=bpy.context.scene,
    )  # fmt: skip
    return context, there


@pytest.mark.parametrize(("events", "asked", "result"), [
    # (type, value) of events; what is asked; what the last event returns.
    (["press", "move", "release"], ["press", "follow"], "FINISHED"),
    (["press", "move", "ESC"], ["press", "follow", "put back"], "CANCELLED"),
    (["press", "RIGHTMOUSE"], ["press", "put back"], "CANCELLED"),
    (["move", "ESC"], [], "CANCELLED"),
    (["release", "double", "move", "release"], ["press", "follow"], "FINISHED"),
    (["press", "LEFT_CTRL", "WHEELUPMOUSE", "release"], ["press", "follow", "wheel 1.1", "follow"], "FINISHED"),
    # Shares are told once where the mouse rests, and not during a drag.
    (["move", "TIMER", "TIMER", "TIMER", "move", "TIMER", "ESC"], ["hover"], "CANCELLED"),
    (["move", "TIMER", "press", "TIMER", "TIMER", "release"], ["press"], "FINISHED"),
])  # fmt: skip
def test_a_gesture_lasts_from_a_press_to_a_release(events, asked, result):
    button = {"press": "PRESS", "release": "RELEASE", "double": "DOUBLE_CLICK"}
    words = {name: ("LEFTMOUSE", value) for name, value in button.items()} | {"move": ("MOUSEMOVE", "NOTHING")}
    gesture, (context, there) = Recorded(), window()
    assert gesture.invoke(context, event("LEFTMOUSE", "RELEASE")) == {"RUNNING_MODAL"}
    assert there["status"] == "Keys    Esc: Cancel"
    for name in events:
        kind, value = words.get(name, (name, "PRESS"))
        returned = gesture.modal(context, event(kind, value))
    assert gesture.asked == asked and returned == {result}
    assert there == {"timers": 0, "handlers": 1, "cursors": 0, "status": None, "header": None}


def test_a_gesture_of_a_tool_begins_with_the_press_and_says_why_it_cannot():
    press = event("LEFTMOUSE", "PRESS")
    gesture, (context, there) = Recorded(), window()
    assert gesture.invoke(context, press) == {"RUNNING_MODAL"} and there["header"] == "pressed"
    assert gesture.modal(context, event("LEFTMOUSE", "RELEASE")) == {"FINISHED"}
    gesture, (context, there) = Recorded(can_press=False), window()
    assert gesture.invoke(context, press) == {"CANCELLED"} and gesture.asked == ["press", "pressed"]
    assert there == {"timers": 0, "handlers": 0, "cursors": 0, "status": None, "header": None}


def test_why_a_drag_cannot_begin_is_told_until_the_mouse_moves():
    gesture, (context, there) = Recorded(can_press=False), window()
    gesture.invoke(context, event("LEFTMOUSE", "RELEASE"))
    for what in ("LEFTMOUSE", "TIMER", "TIMER", "TIMER"):
        gesture.modal(context, event(what))
    assert gesture.asked == ["press"] and there["header"] == "pressed"
    gesture.modal(context, event("MOUSEMOVE", "NOTHING"))
    for _ in range(2):
        gesture.modal(context, event("TIMER"))
    assert gesture.asked == ["press", "hover"]


def test_no_tool_needs_alt_which_may_make_the_left_button_the_middle_one():
    """*Emulate 3 Button Mouse* turns Alt and the left button into the middle one, before an operator sees it."""
    for gesture in gestures.GESTURES:
        ((_, keys, _),) = gestures._tool_of(gesture).bl_keymap
        assert keys == {"type": "LEFTMOUSE", "value": "PRESS"}
    # Alt that is held changes nothing of a drag.
    gesture, (context, _) = Recorded(), window()
    gesture.invoke(context, event("LEFTMOUSE", alt=True))
    for what in (("MOUSEMOVE", "NOTHING"), ("LEFT_ALT", "PRESS"), ("LEFTMOUSE", "RELEASE")):
        answer = gesture.modal(context, event(*what, alt=True))
    assert gesture.asked == ["press", "follow"] and answer == {"FINISHED"}


def test_a_gesture_that_fails_puts_everything_back():
    gesture, (context, there) = Recorded(), window()
    gesture.invoke(context, event("LEFTMOUSE", "PRESS"))
    assert gesture.modal(context, event("RIGHT_CTRL", "PRESS")) == {"CANCELLED"}
    assert gesture.asked == ["press", "put back", "Gesture: broken"]
    assert there == {"timers": 0, "handlers": 1, "cursors": 0, "status": None, "header": None}


class Moved(gestures.MovingGesture):
    """A gesture that notes the mouse and its distance."""

    KEYS, bl_label = "Keys of {}", "Moved"

    def press(self, context, event):
        self.distance = 2.0
        return self.follow(context, event)

    def follow(self, context, event):
        self._note = self._noted(self.distance)
        return True

    def wheel(self, factor):
        assert type(factor) is float  # numbers of numpy make arrays of vectors
        self.distance *= factor

    def set_distance(self, distance):
        self.distance = distance


@pytest.fixture
def moved(scene):
    """A drag of the active light that has begun; (it, a function that sends an event and returns the answer)."""
    bpy.context.view_layer.objects.active = bpy.data.objects["Key"]
    gesture, (context, _) = Moved(), window()
    context.view_layer = bpy.context.view_layer
    gesture.invoke(context, event("LEFTMOUSE"))
    gesture._scale = 1.0
    return gesture, lambda *what, **held: gesture.modal(context, event(*what, **held))


def test_keys_change_distance_size_and_color_and_escape_puts_all_back(moved):
    (gesture, send), data = moved, bpy.data.objects["Key"].data
    before = data.size, data.size_y, tuple(data.color)
    stop = gestures.STOP
    send("MOUSEMOVE", "NOTHING", (10, 0))
    mouse = gesture._mouse
    send("D")
    send("MOUSEMOVE", "NOTHING", (10 + stop, 0))
    assert gesture.distance == pytest.approx(4.0) and "the mouse changes the distance" in gesture._note
    send("S")
    send("MOUSEMOVE", "NOTHING", (10 + 2 * stop, 0))
    assert (data.size, data.size_y) == pytest.approx((2.0 * before[0], 2.0 * before[1]))
    send("C")
    send("MOUSEMOVE", "NOTHING", (10 + 2 * stop, 0.5 * gestures.HUES))
    assert sorted(data.color) == pytest.approx([0.5, 0.5, 1.0]) and "color: 1, 0.5, 0.5" in gesture._note
    # What is dragged is still where it was.
    assert (gesture._mouse == mouse).all()
    send("C")
    send("MOUSEMOVE", "NOTHING", (20 + 2 * stop, 0.5 * gestures.HUES))
    assert (gesture._mouse - mouse).tolist() == [10.0, 0.0]
    assert send("ESC") == {"CANCELLED"}
    assert (data.size, data.size_y, tuple(data.color)) == before


def test_a_typed_number_is_the_distance_or_the_size_until_it_is_erased(moved):
    (gesture, send), data = moved, bpy.data.objects["Key"].data
    ratio = data.size_y / data.size
    for key in ("1", "PERIOD", "PERIOD", "MINUS", "5"):
        send(key)
    assert gesture.distance == 1.5 and gesture._typed == "1.5"
    mouse = gesture._mouse
    send("MOUSEMOVE", "NOTHING", (50, 0))
    assert (gesture._mouse == mouse).all()
    for _ in range(3):
        send("BACK_SPACE")
    send("MOUSEMOVE", "NOTHING", (60, 0))
    assert (gesture._mouse - mouse).tolist() == [10.0, 0.0] and gesture.distance == 1.0
    for key in ("S", "2"):
        send(key)
    assert (data.size, data.size_y) == pytest.approx((2.0, 2.0 * ratio)) and gesture.distance == 1.0
    send("C")
    send("3")
    assert data.size == 2.0 and gesture.distance == 1.0
    assert send("RET") == {"FINISHED"} and data.size == 2.0


@pytest.mark.parametrize(("kind", "size", "name"), [
    ("SUN", math.radians(2.0), "angle"), ("POINT", 2.0, "shadow_soft_size"), ("AREA", 2.0, "size"),
])  # fmt: skip
def test_a_typed_size_is_in_meters_or_degrees(kind, size, name):
    ob = parts.link(bpy.data.objects.new("Light", bpy.data.lights.new("Light", kind)))
    LightLook.of(ob).resize(ob, 2.0)
    assert getattr(ob.data, name) == pytest.approx(size)


def test_a_move_is_tried_in_a_view_and_changes_nothing(scene):
    """What a tool does once it is chosen, so that the first move need not read the table."""
    light, view = bpy.data.objects["Key"], Matrix.LocRotScale(EYE, EYE.to_track_quat("Z", "Y"), None).inverted()
    camera = parts.add_camera(EYE)
    lens = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=96, y=54)
    data = SimpleNamespace(is_perspective=True, view_matrix=view, perspective_matrix=lens @ view)
    before, users = LightPose.of(light), len(bpy.data.objects)
    shipped_table.cache_clear()
    prepare_view(bpy.context, SimpleNamespace(width=96, height=54, data=data))
    assert shipped_table.cache_info().currsize == 1
    assert LightPose.of(light) == before and len(bpy.data.objects) == users
    # Also where nothing is shown, or no light is there.
    for ob in list(bpy.data.objects):
        bpy.data.objects.remove(ob)
        bpy.context.view_layer.update()
        prepare_view(bpy.context, SimpleNamespace(width=96, height=54, data=data))


def test_without_an_active_light_the_one_with_the_most_glossy_light_is_taken(addon, scene):
    far = parts.add_area_light("Far", location=(2.0, 3.0, 2.0), energy=1000.0)
    bpy.context.view_layer.objects.active = None
    bpy.context.view_layer.update()
    (hit,) = hits_at(scene, np.zeros((1, 2)), Vector((1.3, -0.8, 0.0)))
    lights = SceneLights.of(bpy.context)
    shares = lights.shares_at(hit)
    lights.close()
    glossy = {share.name: share.glossy for share in shares}
    most, least = sorted(glossy, key=glossy.get, reverse=True)
    this = SimpleNamespace(hit_under=lambda *_: hit, shares_at=lambda *_: shares, _light=None, _taken=[])
    this._take = this._taken.append
    kind = gestures.LTSH_OT_drag_highlight
    assert kind._choose(this, bpy.context, None) and this._taken == [bpy.data.objects[most]]
    bpy.data.objects[most].lock_location[0] = True
    assert not kind._choose(this, bpy.context, None) and f"{most}: its location" in this._note
    this.shares_at = lambda *_: []
    assert not kind._choose(this, bpy.context, None) and this._note == "No light has a highlight here: choose one"
    this.hit_under = lambda *_: None
    assert not kind._choose(this, bpy.context, None) and this._note == gestures.NO_SURFACE
    assert glossy[most] > glossy[least] >= 0.0 and far.name in glossy


def test_with_shift_the_mouse_goes_a_tenth_of_its_way(moved):
    gesture, send = moved
    send("MOUSEMOVE", "NOTHING", (100, 0), shift=True)
    send("LEFT_SHIFT", "RELEASE", (100, 0))
    send("MOUSEMOVE", "NOTHING", (110, 20))
    assert gesture._mouse.tolist() == [20.0, 20.0]


def test_size_and_color_of_data_that_others_share_stay(moved):
    (gesture, send), light = moved, bpy.data.objects["Key"]
    parts.link(bpy.data.objects.new("Other", light.data))
    before = light.data.size
    send("S")
    send("MOUSEMOVE", "NOTHING", (50, 0))
    assert light.data.size == before and "has 2 users: make it single-user first" in gesture._note


def test_keys_lock_axes(moved):
    gesture, send = moved
    send("Z")
    assert gesture._free == (False, False, True) and "along Z" in gesture._note
    send("X", shift=True)
    assert gesture._free == (False, True, True) and "along YZ" in gesture._note
    send("X", shift=True)
    assert gesture._free == (True, True, True)


def test_a_locked_light_moves_along_its_axes_alone_and_is_seen_where_it_should_be():
    start, point = Vector((2.0, -2.0, 3.0)), Vector((0.5, 0.2, 0.1))
    toward = Vector((0.4, -0.5, 0.7)).normalized()
    for number in range(3):
        in_plane = locked_place(start, point, point + toward, tuple(axis != number for axis in range(3)))
        assert in_plane[number] == start[number]
        assert (in_plane - point).normalized().dot(toward) == pytest.approx(1.0, abs=1e-6)
        axis = Vector([float(one == number) for one in range(3)])
        along = locked_place(start, point, point + toward, tuple(one == number for one in range(3)))
        assert (along - start).cross(axis).length < 1e-6
        # No other place of the axis is nearer to the ray.
        here, *beside = ((along + way * axis - point).cross(toward).length for way in (0.0, 0.01, -0.01))
        assert here < min(beside) and (along - point).dot(toward) > 0.0


def test_driven_linked_and_unlinked_lights_say_so(scene, tmp_path):
    light = bpy.data.objects["Key"]
    curve = light.driver_add("location", 2)
    curve.driver.expression = "2.0"
    assert reason_to_stay(light) == "it is animated or driven"
    light.driver_remove("location", 2)
    assert reason_to_stay(light) == ""
    light.data.driver_add("size")
    assert reason_to_keep_look(light, "size") == "its size is animated or driven"
    assert reason_to_keep_look(light, "color") == ""
    light.data.driver_remove("size")
    # Light linking stays, and is told.
    hits = hits_at(scene, 2.0 * STENCIL, Vector((0.2, -0.5, 1.1)))
    light.light_linking.receiver_collection = receivers = bpy.data.collections.new("Lit")
    receivers.objects.link(bpy.data.objects["Plane"])
    matrix, note = place_of(light, LightPose.of(light), HitsAround(hits, 2.0 * STENCIL, True), 2.5, ShownTextures())
    assert note == "Key does not light Sphere, by light linking"
    assert note_by_pixels(light, matrix, HitsAround(hits, 2.0 * STENCIL, True), ShownTextures()) == note
    assert light.light_linking.receiver_collection == receivers
    # Of another file.
    bpy.data.libraries.write(str(tmp_path / "lights.blend"), {light})
    with bpy.data.libraries.load(str(tmp_path / "lights.blend"), link=True) as (_, wanted):
        wanted.objects = ["Key"]
    linked = next(ob for ob in bpy.data.objects if ob.library is not None and ob.type == "LIGHT")
    assert reason_to_stay(linked) == "it is linked from another file"
    assert reason_to_keep_look(linked, "size") == "its size is linked from another file"
    own = parts.link(bpy.data.objects.new("Own", linked.data))
    assert reason_to_stay(own) == "" and "linked" in reason_to_keep_look(own, "color")
