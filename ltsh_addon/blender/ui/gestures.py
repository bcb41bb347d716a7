"""Gestures: lights by what they do. The mouse drags a light's highlight or shadow, or how bright a surface is."""

import logging
import math
from dataclasses import replace

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector

from ...scene import error_line
from ...shading.highlight import QUICK, THOROUGH
from ..lights.groups import reason_to_stay
from ..lights.textures import ShownTextures
from . import highlight_place
from .light_pose import LightLook, LightPose, locked_place, power_for, reason_to_keep_look, reason_to_keep_power
from .lit_point import LightShare, SceneLights, SurfaceHit, hit_at, hits_at, share_line
from .preview import PASSED_ON, LTSHOperator, active_light, lights_of, pointer, view_under
from .shadow_edge import NEAR_EDGE, OccluderRays, shadow_edge_near

# FARTHER: the factor of the distance by a step of the wheel.
FARTHER = 1.1
# STOP: pixels, at interface scale 1, of a factor of 2 of a brightness, distance or size; HUES: of all hues. PRECISE:
# the factor of the mouse's way with Shift. SNAPS: steps of a stop of a brightness with Ctrl.
STOP, HUES, PRECISE, SNAPS = 100.0, 400.0, 0.1, 3
# AXES: the keys that lock one. MODES: keys after which the mouse changes something else, until they come again.
AXES, MODES = "XYZ", {"D": "distance", "S": "size", "C": "color"}
# REST_SECONDS: after so long without a move the shares of the lights at the mouse are told, which may take a while.
REST_SECONDS = 0.2
# MOVING_KEYS: what the status bar says of keys while a light is moved.
MOVING_KEYS = "Wheel, D, number: distance    S: size    C: color    X, Y, Z: lock    Shift: precise    Ctrl: corners"
# FOLLOWED: what a drag follows.
FOLLOWED = ("MOUSEMOVE", "LEFT_SHIFT", "LEFT_CTRL", "RIGHT_SHIFT", "RIGHT_CTRL")
# LIVE, AT_REST: how long highlights are searched during a move of the mouse, and after it.
LIVE, AT_REST = replace(QUICK, seconds=0.03), replace(THOROUGH, seconds=1.0)
# MOST_GLOSSY: the light whose highlight is dragged if none is active.
MOST_GLOSSY = "the light that gives the pressed point the most glossy light"
LEAST_DISTANCE = 1e-3  # m, of a light from what it faces
NO_SURFACE = "there is no surface under the mouse"


_logger = logging.getLogger(__name__)


class Gesture(LTSHOperator):
    """A modal operator: a drag with the left button over surfaces changes a light, until the button is released.

    Subclasses have `press`, `follow`, `put_back`, KEYS and the ICON of their tool. The headers of the 3D views tell the
    share of each light where the mouse rests, during a drag what `follow` notes.
    """

    KEYS, NEEDS_OBJECT_MODE = "", True  # KEYS: what the status bar says

    def invoke(self, context, event):
        self._is_dragged, self._note, self._scene_lights, self._textures = False, "", None, ShownTextures()
        self._typed = ""
        self._scale, self._is_told, self._is_still = context.preferences.system.ui_scale, False, False
        self._mouse = self._last = pointer(event)
        self._timer = context.window_manager.event_timer_add(REST_SECONDS, window=context.window)
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set(f"{self.words(context)}    Esc: Cancel")
        highlight_place.warm_up(context.scene)
        # A tool starts it by the press itself, a button by its release.
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            try:
                self._is_dragged = self._do(context, event, self.press)
            except Exception as error:
                return self._failed(context, error)
            if not self._is_dragged:
                self._end(context)
                self.report({"WARNING"}, self._note)
                return {"CANCELLED"}
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    @classmethod
    def words(cls, context) -> str:
        """KEYS, with the name of the light."""
        return cls.KEYS

    def modal(self, context, event):
        try:
            return self._answer(context, event)
        except Exception as error:
            return self._failed(context, error)

    def _failed(self, context, error: Exception) -> set[str]:
        _logger.exception("%s failed", self.bl_label)
        self.cancel(context)
        self.report({"ERROR"}, f"{self.bl_label}: {error_line(error)}")
        return {"CANCELLED"}

    def _answer(self, context, event) -> set[str]:
        if not self._is_dragged:
            self._mouse = self._last = pointer(event)
        if event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return {"CANCELLED"}
        is_confirmed = event.type in ("RET", "NUMPAD_ENTER") and event.value == "PRESS"
        if event.type == "LEFTMOUSE" or is_confirmed:
            if (event.value == "RELEASE" or is_confirmed) and self._is_dragged:
                if not self._is_told and (warning := self.warning(context, event)):
                    self.report({"WARNING"}, warning)
                self._end(context)
                return {"FINISHED" if self.is_changed() else "CANCELLED"}
            if event.value in ("PRESS", "DOUBLE_CLICK") and not is_confirmed:
                self._is_dragged = self._do(context, event, self.press)
                # Why a drag cannot begin is told until the mouse moves.
                self._is_told = not self._is_dragged
        elif self._is_dragged and event.type in ("WHEELUPMOUSE", "WHEELDOWNMOUSE"):
            self.wheel(FARTHER if event.type == "WHEELUPMOUSE" else 1.0 / FARTHER)
            self._do(context, event, self.follow)
        elif self._is_dragged and event.type in FOLLOWED:
            now = pointer(event)
            way, self._last = (PRECISE if event.shift else 1.0) * (now - self._last), now
            self._is_told = self._is_still = False
            if not self._typed:
                self.move(way)
                self._do(context, event, self.follow)
        elif self._is_dragged and event.value == "PRESS" and (self._type(event) or self.key(event)):
            self._do(context, event, self.follow)
        elif event.type == "MOUSEMOVE":
            self._is_told = self._is_still = False
        elif event.type.startswith(PASSED_ON):
            if event.type == "TIMER" and not self._is_told:
                step = self._rest if self._is_dragged else self._hover
                self._is_told = self._is_still and self._do(context, event, step)
                self._is_still = True
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Put the light back; also called by Blender when the window is closed."""
        self._end(context)
        if self._is_dragged:
            self.put_back()

    def wheel(self, factor: float) -> None:
        """A step of the wheel while dragging."""

    def move(self, way: np.ndarray) -> None:
        """The mouse has gone a `way` (2,) in pixels while dragging; with Shift it is a tenth of it."""
        self._mouse = self._mouse + way

    def key(self, event) -> bool:
        """Take a key that is pressed while dragging; False if it has no meaning."""
        return False

    def number(self, value: float) -> None:
        """Take a number, not below 0, that is typed while dragging. Until it is erased the mouse changes nothing."""

    def _type(self, event) -> bool:
        """Take a key of a number; False if it is none."""
        typed = self._typed[:-1] if event.type == "BACK_SPACE" else self._typed + event.ascii
        if typed == self._typed or typed.strip("0123456789.") or typed.count(".") > 1:
            return False
        self._typed = typed
        if typed.strip("."):
            self.number(float(typed))
        return True

    def warning(self, context, event) -> str:
        """What is wrong with what the drag has reached, if telling takes longer than a move may; "" if nothing."""
        return ""

    def is_changed(self) -> bool:
        """True if the drag needs a step of undo."""
        return True

    def _end(self, context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        context.window.cursor_modal_restore()
        self._tell(context, None)
        if self._scene_lights is not None:
            self._scene_lights.close()

    def _tell(self, context, text: str | None) -> None:
        for area in context.window.screen.areas:
            if area.type == "VIEW_3D":
                area.header_text_set(text)

    def _do(self, context, event, step) -> bool:
        is_done = step(context, event)
        self._tell(context, f"[{self._typed}]    {self._note}" if self._typed else self._note)
        return is_done

    def _rest(self, context, event) -> bool:
        """Note what is wrong with what a drag has reached, where the mouse rests."""
        if warning := self.warning(context, event):
            self._note = warning
        return True

    def _hover(self, context, event) -> bool:
        """Note the share of each light at the mouse."""
        hit = self.hit_under(context, event)
        self._note = NO_SURFACE if hit is None else self.share_line(hit, self.shares_at(context, hit))
        return True

    def shares_at(self, context, hit: SurfaceHit) -> list[LightShare]:
        """What each light gives the point of `hit`."""
        if self._scene_lights is None:
            self._scene_lights = SceneLights.of(context)
        return self._scene_lights.shares_at(hit)

    def share_line(self, hit: SurfaceHit, shares: list[LightShare]) -> str:
        """They as one line, which says where they are not those of a picture."""
        return ("" if self._scene_lights.is_exact_at(hit) else "About ") + share_line(shares)

    def hit_under(self, context, event) -> SurfaceHit | None:
        """The surface under the mouse."""
        region, mouse = view_under(context, self._mouse)
        return None if region is None else hit_at(context, region, mouse)


class MovingGesture(Gesture):
    """A gesture that moves the active light. LOCKS: axes may be locked. CHOOSES: without an active light its `press`
    takes another."""

    LOCKS, CHOOSES = True, False

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        light = active_light(context)
        if light is None and not (cls.CHOOSES and lights_of(context.scene)):
            return "No light is active"
        reason = "" if light is None else reason_to_stay(light)
        return super().reason_against(context) or (f"{light.name}: {reason}" if reason else "")

    @classmethod
    def words(cls, context) -> str:
        """As `Gesture.words`."""
        light = active_light(context)
        return cls.KEYS.format(MOST_GLOSSY if light is None else light.name)

    def invoke(self, context, event):
        self._light, self._distance, self._free, self._mode = active_light(context), 0.0, (True, True, True), ""
        if self._light is not None:
            self._take(self._light)
        return super().invoke(context, event)

    def _take(self, light) -> None:
        self._light, self._pose, self._look = light, LightPose.of(light), LightLook.of(light)

    def put_back(self) -> None:
        """Put the light back where it was, as it was."""
        self._pose.put_back(self._light)
        self._look.put_back(self._light)

    def is_changed(self) -> bool:
        """As `Gesture.is_changed`."""
        is_moved = LightPose.of(self._light).channels != self._pose.channels
        return is_moved or LightLook.of(self._light) != self._look

    def key(self, event) -> bool:
        """As `Gesture.key`: X, Y and Z lock, D, S and C change what the mouse does."""
        if event.type in AXES and self.LOCKS and not self._pose.is_sun:
            free = tuple((axis == event.type) != event.shift for axis in AXES)
            self._free = (True, True, True) if free == self._free else free
        elif event.type in MODES:
            self._mode, self._typed = "" if self._mode == event.type else event.type, ""
        else:
            return False
        return True

    def number(self, value: float) -> None:
        """As `Gesture.number`: the distance, after S the size."""
        if self._mode == "S" and not reason_to_keep_look(self._light, "size"):
            self._look.resize(self._light, value)
        elif self._mode in ("", "D"):
            self.set_distance(max(value, LEAST_DISTANCE))

    def set_distance(self, distance: float) -> None:
        """Take a distance that is typed."""

    def move(self, way: np.ndarray) -> None:
        """As `Gesture.move`; after a key of MODES it changes what that says."""
        factor = 2.0 ** (float(way[0]) / (STOP * self._scale))
        if not self._mode:
            super().move(way)
        elif self._mode == "D":
            self.wheel(factor)
        elif not reason_to_keep_look(self._light, MODES[self._mode]):
            if self._mode == "S":
                self._look.scale(self._light, factor)
            else:
                self._look.tint(self._light, *(way / (HUES * self._scale)).tolist())

    def hit_under(self, context, event) -> SurfaceHit | None:
        """As `Gesture.hit_under`, with Ctrl at a corner or the middle of the face."""
        self._snap(context, event)
        return super().hit_under(context, event)

    def _snap(self, context, event) -> None:
        """With Ctrl let the mouse be at the nearest corner of the face under it, or at its middle."""
        region, mouse = view_under(context, self._mouse)
        hit = hit_at(context, region, mouse) if self._is_dragged and event.ctrl and region is not None else None
        if hit is None or hit.face is None:
            return
        places = (hit.matrix @ Vector(place) for place in (*hit.face.corners, np.mean(hit.face.corners, axis=0)))
        pixels = [view3d_utils.location_3d_to_region_2d(region, region.data, place) for place in places]
        pixels = np.array([pixel for pixel in pixels if pixel is not None])
        if len(pixels):
            self._mouse = pixels[np.argmin(np.linalg.norm(pixels - mouse, axis=-1))] + (region.x, region.y)

    def _put(self, matrix: Matrix) -> None:
        self._pose.put(self._light, matrix)

    def _noted(self, distance: float, *notes: str) -> str:
        """What the header says: the distance, what is locked, what the mouse changes, and notes."""
        texts = [] if math.isinf(distance) else [f"Distance {distance:.3g} m"]
        if not all(self._free):
            free = "".join(axis for axis, is_free in zip(AXES, self._free, strict=True) if is_free)
            texts.append(f"along {free}")
        if self._mode:
            changed = MODES[self._mode]
            reason = "" if self._mode == "D" else reason_to_keep_look(self._light, changed)
            texts.append(reason or f"the mouse changes the {changed}{self._look.text(self._light, self._mode)}")
        return "    ".join(filter(None, [*texts, *notes]))


class LTSH_OT_drag_highlight(MovingGesture, bpy.types.Operator):
    """Drag the highlight of the active light, or without one of the light that gives the pressed point the most glossy
    light, over surfaces in a 3D view: the light follows, keeps its distance and faces them"""

    bl_label = "Drag Highlight"
    bl_options = {"UNDO"}
    KEYS, ICON, CHOOSES = f"Drag the highlight of {{}}    {MOVING_KEYS}", "ops.transform.tosphere", True

    def wheel(self, factor: float) -> None:
        """Change the distance."""
        self._distance *= factor

    def set_distance(self, distance: float) -> None:
        """As `MovingGesture.set_distance`."""
        self._distance = distance

    def press(self, context, event) -> bool:
        """Move the light so that its highlight is at the mouse; False where no surface is, or no light to choose."""
        return (self._light is not None or self._choose(context, event)) and self.follow(context, event)

    def _choose(self, context, event) -> bool:
        """Take the light that gives the pressed point the most glossy light."""
        hit = self.hit_under(context, event)
        shares = [] if hit is None else [share for share in self.shares_at(context, hit) if share.is_lamp]
        first = max(shares, key=lambda share: share.glossy, default=None)
        if first is None or first.glossy <= 0.0:
            self._note = NO_SURFACE if hit is None else "No light has a highlight here: choose one"
            return False
        light = context.scene.objects.get(first.name) or bpy.data.objects[first.name]
        if reason := reason_to_stay(light):
            self._note = f"{light.name}: {reason}"
            return False
        self._take(light)
        return True

    def follow(self, context, event) -> bool:
        """As `press`."""
        around = self._hits(context, event, highlight_place.DISK)
        if around is None:
            self._note = NO_SURFACE
            return False
        middle = around.hits[0].position
        self._distance = self._distance or max((self._pose.matrix.translation - middle).length, LEAST_DISTANCE)
        matrix, note = highlight_place.place_of(self._light, self._pose, around, self._distance, self._textures, LIVE)
        if not all(self._free):
            way = locked_place(self._pose.matrix.translation, middle, matrix.translation, self._free) - middle
            matrix = self._pose.facing(middle, way.normalized(), way.length)
        self._matrix = matrix
        self._put(matrix)
        self._note = f"{self._light.name}    {self._noted((matrix.translation - middle).length, note)}"
        return True

    def warning(self, context, event) -> str:
        """As `Gesture.warning`: by all pixels around the mouse."""
        around = self._hits(context, event, highlight_place.PIXELS)
        if around is None:
            return NO_SURFACE
        if not all(self._free):
            return highlight_place.note_by_pixels(self._light, self._matrix, around, self._textures)
        self._matrix, note = highlight_place.place_by_pixels(
            self._light, self._pose, self._matrix, around, self._textures, AT_REST
        )
        self._put(self._matrix)
        return note

    def _hits(self, context, event, disk) -> highlight_place.HitsAround | None:
        self._snap(context, event)
        region, mouse = view_under(context, self._mouse)
        if region is None:
            return None
        return highlight_place.hits_around(lambda offsets: hits_at(context, region, mouse + offsets), disk)


class LTSH_OT_drag_brightness(Gesture, bpy.types.Operator):
    """Press on a surface in a 3D view and drag up or down: the light that gives it the most changes its power"""

    bl_label = "Drag Brightness"
    bl_options = {"UNDO"}
    KEYS = (
        "Press on a surface, drag up or down: its brightness follows    Number: so many times    Shift: precise    "
        "Ctrl: thirds of a stop"
    )
    ICON = "ops.curve.radius"

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        return super().reason_against(context) or ("" if lights_of(context.scene) else "The scene has no light")

    def press(self, context, event) -> bool:
        """Choose the light; False where none may be changed."""
        hit = self.hit_under(context, event)
        if hit is None:
            self._note = NO_SURFACE
            return False
        shares = self.shares_at(context, hit)
        whole = sum(share.luminance for share in shares)
        first = next((one for one in shares if one.is_lamp and one.luminance > 0.0), None)
        if first is None or whole <= 0.0:
            self._note = f"No light that can be changed arrives here    {self.share_line(hit, shares)}"
            return False
        self._light = context.scene.objects.get(first.name) or bpy.data.objects[first.name]
        if reason := reason_to_keep_power(self._light):
            self._note = f"{self._light.name}: {reason}"
            return False
        self._power, self._share = self._light.data.energy, first.luminance / whole
        self._start, self._shares = self._mouse, self.share_line(hit, shares)
        return self.follow(context, event)

    def follow(self, context, event) -> bool:
        """Change the power by the way of the mouse."""
        stops = (self._mouse - self._start)[1] / (STOP * self._scale)
        stops = round(SNAPS * stops) / SNAPS if event.ctrl else stops
        factor = float(self._typed) if self._typed.strip(".") else 2.0**stops
        power = power_for(factor, self._power, self._share)
        self._light.data.energy = power
        unit = "W/m²" if self._light.data.type == "SUN" else "W"
        text = f"{self._light.name}: {self._power:.4g} to {power:.4g} {unit}"
        if power > 0.0 or factor >= 1.0:
            text += f"    here {factor:.3g} times the direct light"
            text += f", {math.log2(factor):+.2f} stops" if factor > 0.0 else ""
        else:
            text += f"    off: the other lights leave {1.0 - self._share:.3g} times the direct light here"
        self._note = f"{text}    before: {self._shares}"
        return True

    def is_changed(self) -> bool:
        """As `Gesture.is_changed`."""
        return self._light.data.energy != self._power

    def put_back(self) -> None:
        """Give the light its power back."""
        self._light.data.energy = self._power


class LTSH_OT_drag_shadow(MovingGesture, bpy.types.Operator):
    """Drag the edge of a shadow of the active light over surfaces in a 3D view: the light follows, keeps its distance
    from what it faces, and goes on facing it"""

    bl_label = "Drag Shadow"
    bl_options = {"UNDO"}
    KEYS, ICON = f"Drag the edge of a shadow of {{}}    {MOVING_KEYS}", "ops.transform.shear"

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        reason, light = super().reason_against(context), active_light(context)
        return reason or ("" if light.data.use_shadow else f"{light.name}: its shadows are off")

    def wheel(self, factor: float) -> None:
        """Change the distance from what the light faces."""
        self._edge = replace(self._edge, distance=factor * self._edge.distance)

    def set_distance(self, distance: float) -> None:
        """As `MovingGesture.set_distance`."""
        if not self._pose.is_sun:
            self._edge = replace(self._edge, distance=distance)

    def press(self, context, event) -> bool:
        """Choose the edge of a shadow near the mouse; False where there is none."""
        region, mouse = view_under(context, self._mouse)
        if region is None:
            self._note = NO_SURFACE
            return False
        depsgraph = context.evaluated_depsgraph_get()
        self._edge, self._note = shadow_edge_near(
            OccluderRays(context.scene, depsgraph, self._light),
            lambda offset: hit_at(context, region, mouse + offset),
            self._pose.matrix, self._light.data.type, NEAR_EDGE * self._scale,
        )  # fmt: skip
        return self._edge is not None and self.follow(context, event)

    def follow(self, context, event) -> bool:
        """Move the light so that the edge is at the mouse."""
        hit = self.hit_under(context, event)
        if hit is None:
            self._note = NO_SURFACE
            return False
        rays = OccluderRays(context.scene, context.evaluated_depsgraph_get(), self._light)
        place, note = self._edge.light_for(rays, hit)
        if place is not None:
            if not all(self._free):
                aim, direction, distance = place
                target = aim + distance * direction
                way = locked_place(self._pose.matrix.translation, hit.position, target, self._free) - aim
                place = aim, way.normalized(), way.length
            self._put(self._pose.facing(*place))
        kind = "Shadow" if self._edge.across is None else "Edge of the shadow"
        distance = self._edge.distance if place is None or self._pose.is_sun else place[2]
        self._note = f"{kind} of {self._edge.ob.name}    {self._noted(distance, note)}"
        return True


class LTSH_OT_aim_light(MovingGesture, bpy.types.Operator):
    """Turn the active light, where it is, to face the point of a surface under the mouse in a 3D view"""

    bl_label = "Aim Light"
    bl_options = {"UNDO"}
    KEYS = "Press where {} shall shine, and drag    S: size    C: color    Shift: precise    Ctrl: corners"
    ICON, LOCKS = "ops.transform.tilt", False

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        reason = super().reason_against(context)
        return reason or ("A point light shines everywhere" if active_light(context).data.type == "POINT" else "")

    def press(self, context, event) -> bool:
        """Turn the light to the mouse; False where no surface is."""
        return self.follow(context, event)

    def follow(self, context, event) -> bool:
        """As `press`."""
        hit = self.hit_under(context, event)
        if hit is None:
            self._note = NO_SURFACE
            return False
        way = self._pose.matrix.translation - hit.position
        self._put(self._pose.facing(hit.position, way.normalized(), way.length))
        self._note = self._noted(way.length)
        return True


GESTURES = (LTSH_OT_drag_highlight, LTSH_OT_drag_shadow, LTSH_OT_drag_brightness, LTSH_OT_aim_light)
# A tool for each of them, in one group of the toolbar.
_tools: list[type] = []


def _tool_of(gesture) -> type:
    def draw_settings(context, layout, tool):
        highlight_place.warm_up(context.scene)
        layout.label(text=gesture.reason_against(context) or gesture.words(context))

    return type(f"{gesture.__name__}_tool", (bpy.types.WorkSpaceTool,), {
        "bl_space_type": "VIEW_3D", "bl_context_mode": "OBJECT", "bl_idname": f"{gesture.bl_idname}_tool",
        "bl_label": gesture.bl_label, "bl_description": gesture.__doc__.replace("\n    ", " "),
        "bl_icon": gesture.ICON, "draw_settings": staticmethod(draw_settings),
        "bl_keymap": ((gesture.bl_idname, {"type": "LEFTMOUSE", "value": "PRESS"}, None),),
    })  # fmt: skip


def register() -> None:
    """Add the tools."""
    for gesture in GESTURES:
        _tools.append(_tool_of(gesture))
        place = {"separator": True, "group": True} if len(_tools) == 1 else {"after": {_tools[-2].bl_idname}}
        bpy.utils.register_tool(_tools[-1], **place)


def unregister() -> None:
    """Take them away."""
    while _tools:
        bpy.utils.unregister_tool(_tools.pop())
