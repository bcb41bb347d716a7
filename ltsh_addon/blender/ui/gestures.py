"""Gestures: lights by what they do. The mouse drags a light's highlight or shadow, or how bright a surface is."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector

from ...scene import SurfaceSamples, error_line
from ...shading import shade
from ...shading.highlight import STENCIL, mirrored, place_for_highlight
from ..evaluated import EmitterTraits
from ..lights.area import area_light
from ..lights.groups import is_animated, is_linked, reason_to_stay
from ..lights.linking import Receivers
from ..lights.textures import ShownTextures
from ..materials.preview_material import COAT, METALS, PreviewMaterial, preview_of
from .lit_point import LightShare, SceneLights, SurfaceHit, share_line, shipped_table, surface_hit, value_at_hit
from .preview import PASSED_ON, active_light, lights_of, region_under
from .shadow_edge import NEAR_EDGE, OccluderRays, shadow_edge_near

# SPACING: pixels between the rays around the cursor. FARTHER: the factor of the distance by a step of the wheel.
SPACING, FARTHER = 2.0, 1.1
# Of drags of the brightness: STOP: pixels, at interface scale 1, of a factor of 2. PRECISE: the factor of the mouse's
# way with Shift. SNAPS: steps of a stop with Ctrl.
STOP, PRECISE, SNAPS = 100.0, 0.1, 3
# REST_SECONDS: after so long without a move the shares of the lights at the mouse are told, which may take a while.
REST_SECONDS = 0.2
# RING: pixels from the mouse, in steps of SPACING, where a highlight may not be brighter by more than BRIGHTER.
_TURNS = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
RING = np.concatenate([radius * np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=-1) for radius in (3.0, 6.0, 10.0)])
BRIGHTER = 0.01
# Kinds of lobes without a highlight.
DULL = ("diffuse", "sheen", "velvet", "translucent")
# FOLLOWED: what a drag follows.
FOLLOWED = ("MOUSEMOVE", "LEFT_SHIFT", "LEFT_CTRL", "RIGHT_SHIFT", "RIGHT_CTRL")
NO_PEAK = "no peak of the highlight here: the surface is seen too flat, or is too rough"
BESIDE = "the surface bends: its highlight beside the mouse is brighter"
NO_SURFACE = "there is no surface under the mouse"


_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LightPose:
    """How a light object stood before a drag, and where its channels may put it."""

    channels: dict[str, tuple]
    basis: Matrix
    parent: Matrix  # of the world, from what the channels say
    is_sun: bool

    @classmethod
    def of(cls, ob) -> LightPose:
        """That of the light object `ob` now."""
        names = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
        channels = {name: tuple(getattr(ob, name)) for name in names}
        basis = ob.matrix_basis.copy()
        parent = Matrix() if ob.parent is None else ob.matrix_world @ basis.inverted_safe()
        return cls(channels, basis, parent, ob.data.type == "SUN")

    @property
    def matrix(self) -> Matrix:
        """In the world."""
        return self.parent @ self.basis

    def put_back(self, ob) -> None:
        """Give `ob` its channels back, to the last bit: a matrix would come back through a parent's rounding."""
        for name, values in self.channels.items():
            setattr(ob, name, values)

    def facing(self, point: Vector, direction: Vector, distance: float) -> Matrix:
        """The matrix in the world of the light in `direction` from a point, which it faces, turned no further than it
        must; a sun stays where it is. Also under a parent of uneven scale the light faces the point exactly."""
        location, rotation, scale = self.basis.decompose()
        if not self.is_sun:
            location = self.parent.inverted_safe() @ (point + distance * direction)
        backward = self.parent.to_3x3().inverted_safe() @ direction * math.copysign(1.0, scale.z)
        turn = (rotation @ Vector((0.0, 0.0, 1.0))).rotation_difference(backward.normalized())
        return self.parent @ Matrix.LocRotScale(location, turn @ rotation, scale)

    def put(self, ob, matrix: Matrix) -> None:
        """Put `ob` there; `matrix` is one of `facing`."""
        ob.matrix_basis = self.parent.inverted_safe() @ matrix


def reason_to_keep_power(ob) -> str:
    """Why the mouse may not change the power of a light; "" if it may."""
    if is_linked(ob.data):
        return "its power is linked from another file"
    if is_animated(ob.data, "energy"):
        return "its power is animated or driven"
    users = ob.data.users - ob.data.use_fake_user
    if users > 1:
        return f"its data {ob.data.name!r} has {users} users: make it single-user first"
    return ""


def glossy_lobe(material) -> PreviewMaterial | None:
    """The first lobe of a material that has highlights."""
    lobes = preview_of(None if material is None else material.original).lobes
    return next((lobe for lobe in lobes if lobe.kind not in DULL and not lobe.is_clear), None)


def samples_of(hits: list[SurfaceHit], lobe: PreviewMaterial, textures: ShownTextures) -> SurfaceSamples:
    """Samples at `hits` of the reflection of one lobe, with its values at the middle one."""
    count, white, middle = len(hits), np.ones((len(hits), 3)), hits[len(hits) // 2]
    position, view, normal = (np.array([getattr(hit, name) for hit in hits]) for name in ("position", "view", "normal"))
    coat = lobe.coat if lobe.kind == COAT else None

    def at_middle(name: str) -> float:
        return float(np.mean(value_at_hit(lobe.value(name), middle, textures)))

    roughness = float(np.clip(coat.roughness if coat is not None else at_middle("roughness"), 0.0, 1.0))
    is_metal = coat is None and (lobe.kind in METALS or at_middle("metallic") > 0.5)
    ior = coat.ior if coat is not None else max(at_middle("ior"), 1.01)
    return SurfaceSamples(
        position=position, view=view, normal=normal, diffuse_normal=normal, roughness=np.full(count, roughness),
        specular_f0=0.8 * is_metal * white, specular_f90=float(is_metal) * white,
        dielectric=(1.0 - is_metal) * white, ior=np.full(count, ior), diffuse_albedo=0.0 * white,
    )  # fmt: skip


def place_of(ob, pose: LightPose, hits: list[SurfaceHit], distance: float, textures: ShownTextures) -> tuple:
    """The matrix of the light object `ob` for a highlight at the middle one of the nine `hits`, which others of the
    same surface around may follow, or at the only one by its mirrored view; and what there is to say about it."""
    hits, others = hits[: len(STENCIL)], hits[len(STENCIL) :]
    hit = hits[len(hits) // 2]
    lobe, receivers = glossy_lobe(hit.material), Receivers([])

    def matrix_at(direction: np.ndarray) -> Matrix:
        return pose.facing(hit.position, Vector(direction), distance)

    def light_at(direction: np.ndarray):
        return area_light(ob, np.array(matrix_at(direction)), EmitterTraits("", True, True), receivers)

    if lobe is None or len(hits) < len(STENCIL):
        matrix = matrix_at(mirrored(np.array(hit.view), np.array(hit.normal)))
        return matrix, "this surface has no highlight" if lobe is None else ""
    place, note = place_for_highlight(samples_of(hits, lobe, textures), light_at, shipped_table()), ""
    if not place.is_peak:
        note = NO_PEAK
    elif others:
        samples = samples_of([hit, *others], lobe, textures)
        lights = [light_at(place.direction)]
        shining = shade(samples, lights, shipped_table(), passes=("specular",), workers=1, dtype=np.float64)
        here, *around = shining.specular.sum(axis=(0, 2)).tolist()
        note = BESIDE if max(around) > (1.0 + BRIGHTER) * here else ""
    return matrix_at(place.direction), note


def power_for(factor: float, power: float, share: float) -> float:
    """The power of a light with which a point gets `factor` times its light, of which a light of this `power` gives
    the `share`, over 0; never below 0."""
    return max(0.0, power * (1.0 + (factor - 1.0) / share))


def view_under(context, event) -> tuple:
    """The region of the 3D view under the mouse, None where there is none, and the pixel (2,) in it."""
    region = region_under(context, event.mouse_x, event.mouse_y)
    corner = (0, 0) if region is None else (region.x, region.y)
    return region, np.array([event.mouse_x, event.mouse_y]) - corner


class Gesture:
    """A modal operator: a drag with the left button over surfaces changes a light, until the button is released.

    Subclasses have `press`, `follow`, `put_back`, KEYS and the ICON of their tool. The headers of the 3D views tell the
    share of each light where the mouse rests, during a drag what `follow` notes.
    """

    KEYS = ""  # what the status bar says

    def invoke(self, context, event):
        self._is_dragged, self._note, self._scene_lights, self._textures = False, "", None, ShownTextures()
        self._scale, self._is_told, self._is_still = context.preferences.system.ui_scale, False, False
        self._timer = context.window_manager.event_timer_add(REST_SECONDS, window=context.window)
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set(f"{self.words(context)}    Esc: Cancel")
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
    def poll(cls, context):
        if reason := cls.reason_against(context):
            cls.poll_message_set(reason)
        return not reason

    @classmethod
    def reason_against(cls, context) -> str:
        """Why the gesture cannot begin; "" if it can."""
        return "" if context.mode == "OBJECT" else "Lights are dragged in Object Mode"

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
        if event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "LEFTMOUSE":
            if event.value == "RELEASE" and self._is_dragged:
                self._end(context)
                return {"FINISHED" if self.is_changed() else "CANCELLED"}
            if event.value in ("PRESS", "DOUBLE_CLICK"):
                self._is_dragged = self._do(context, event, self.press)
        elif self._is_dragged and event.type in ("WHEELUPMOUSE", "WHEELDOWNMOUSE"):
            self.wheel(FARTHER if event.type == "WHEELUPMOUSE" else 1.0 / FARTHER)
            self._do(context, event, self.follow)
        elif self._is_dragged and event.type in FOLLOWED:
            self._do(context, event, self.follow)
        elif event.type == "MOUSEMOVE":
            self._is_told = self._is_still = False
        elif event.type.startswith(PASSED_ON):
            if event.type == "TIMER" and not (self._is_dragged or self._is_told):
                self._is_told = self._is_still and self._do(context, event, self._hover)
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
        self._tell(context, self._note)
        return is_done

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
        region, mouse = view_under(context, event)
        return None if region is None else hit_at(context, region, mouse)


class MovingGesture(Gesture):
    """A gesture that moves the active light."""

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        light = active_light(context)
        if light is None:
            return "No light is active"
        reason = reason_to_stay(light)
        return super().reason_against(context) or (f"{light.name}: {reason}" if reason else "")

    @classmethod
    def words(cls, context) -> str:
        """As `Gesture.words`."""
        return cls.KEYS.format(active_light(context).name)

    def invoke(self, context, event):
        self._light = active_light(context)
        self._pose, self._distance = LightPose.of(self._light), 0.0
        return super().invoke(context, event)

    def put_back(self) -> None:
        """Put the light back where it was."""
        self._pose.put_back(self._light)

    def _put(self, matrix: Matrix) -> None:
        self._pose.put(self._light, matrix)


class LTSH_OT_drag_highlight(MovingGesture, bpy.types.Operator):
    """Drag the highlight of the active light over surfaces in a 3D view: the light follows, keeps its distance and
    faces them"""

    bl_idname = "ltsh.drag_highlight"
    bl_label = "Drag Highlight"
    bl_options = {"UNDO"}
    KEYS, ICON = "Drag the highlight of {}    Wheel: distance", "ops.transform.tosphere"

    def wheel(self, factor: float) -> None:
        """Change the distance."""
        self._distance *= factor

    def press(self, context, event) -> bool:
        """Move the light so that its highlight is at the mouse; False where no surface is."""
        return self.follow(context, event)

    def follow(self, context, event) -> bool:
        """As `press`."""
        region, mouse = view_under(context, event)
        hits = hits_around(context, region, mouse) if region is not None else []
        if not hits:
            self._note = NO_SURFACE
            return False
        middle = hits[len(hits) // 2].position
        self._distance = self._distance or max((self._pose.matrix.translation - middle).length, 1e-3)
        matrix, note = place_of(self._light, self._pose, hits, self._distance, self._textures)
        self._put(matrix)
        self._note = f"Distance {self._distance:.3g} m" + (f"    {note}" if note else "")
        return True


class LTSH_OT_drag_brightness(Gesture, bpy.types.Operator):
    """Press on a surface in a 3D view and drag up or down: the light that gives it the most changes its power"""

    bl_idname = "ltsh.drag_brightness"
    bl_label = "Drag Brightness"
    bl_options = {"UNDO"}
    KEYS = "Press on a surface, drag up or down: its brightness follows    Shift: precise    Ctrl: thirds of a stop"
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
        self._stops, self._last, self._shares = 0.0, event.mouse_y, self.share_line(hit, shares)
        return self.follow(context, event)

    def follow(self, context, event) -> bool:
        """Change the power by the way of the mouse."""
        way = (event.mouse_y - self._last) / (STOP * self._scale)
        self._last = event.mouse_y
        self._stops += way * (PRECISE if event.shift else 1.0)
        stops = round(SNAPS * self._stops) / SNAPS if event.ctrl else self._stops
        factor = 2.0**stops
        power = power_for(factor, self._power, self._share)
        self._light.data.energy = power
        unit = "W/m²" if self._light.data.type == "SUN" else "W"
        text = f"{self._light.name}: {self._power:.4g} to {power:.4g} {unit}"
        if power > 0.0 or factor >= 1.0:
            text += f"    here {factor:.3g} times the direct light, {stops:+.2f} stops"
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

    bl_idname = "ltsh.drag_shadow"
    bl_label = "Drag Shadow"
    bl_options = {"UNDO"}
    KEYS, ICON = "Drag the edge of a shadow of {}    Wheel: distance", "ops.transform.shear"

    @classmethod
    def reason_against(cls, context) -> str:
        """As `Gesture.reason_against`."""
        reason, light = super().reason_against(context), active_light(context)
        return reason or ("" if light.data.use_shadow else f"{light.name}: its shadows are off")

    def wheel(self, factor: float) -> None:
        """Change the distance from what the light faces."""
        self._edge = replace(self._edge, distance=factor * self._edge.distance)

    def press(self, context, event) -> bool:
        """Choose the edge of a shadow near the mouse; False where there is none."""
        region, mouse = view_under(context, event)
        if region is None:
            self._note = NO_SURFACE
            return False
        depsgraph = context.evaluated_depsgraph_get()
        self._edge, self._note = shadow_edge_near(
            OccluderRays(context.scene, depsgraph, self._light),
            lambda offset: hit_at(context, region, mouse + offset, depsgraph),
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
            self._put(self._pose.facing(*place))
        kind = "Shadow" if self._edge.across is None else "Edge of the shadow"
        far = "" if math.isinf(self._edge.distance) else f"    Distance {self._edge.distance:.3g} m"
        self._note = f"{kind} of {self._edge.ob.name}{far}" + (f"    {note}" if note else "")
        return True


class LTSH_OT_aim_light(MovingGesture, bpy.types.Operator):
    """Turn the active light, where it is, to face the point of a surface under the mouse in a 3D view"""

    bl_idname = "ltsh.aim_light"
    bl_label = "Aim Light"
    bl_options = {"UNDO"}
    KEYS, ICON = "Press where {} shall shine, and drag", "ops.transform.tilt"

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
        self._note = f"Distance {way.length:.3g} m"
        return True


GESTURES = (LTSH_OT_drag_highlight, LTSH_OT_drag_shadow, LTSH_OT_drag_brightness, LTSH_OT_aim_light)
# A tool for each of them, in one group of the toolbar.
_tools: list[type] = []


def _tool_of(gesture) -> type:
    def draw_settings(context, layout, tool):
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


def hit_at(context, region, pixel: tuple[float, float], depsgraph=None) -> SurfaceHit | None:
    """What the view of a region meets at a pixel."""
    start = view3d_utils.region_2d_to_origin_3d(region, region.data, pixel)
    direction = view3d_utils.region_2d_to_vector_3d(region, region.data, pixel)
    return surface_hit(context.scene, depsgraph or context.evaluated_depsgraph_get(), start, direction)


def hits_around(context, region, pixel: tuple[float, float]) -> list[SurfaceHit]:
    """What the view of a region meets at a pixel and at those of STENCIL around it: nine, one, or none. After nine,
    what it meets of the same surface in the RING."""
    depsgraph = context.evaluated_depsgraph_get()
    pixels = (np.array(pixel) + SPACING * np.concatenate([STENCIL, RING])).tolist()
    hits = [hit_at(context, region, one, depsgraph) for one in pixels]
    middle = hits[len(STENCIL) // 2]
    if middle is None:
        return []
    same = [hit for hit in hits if hit is not None and hit.ob == middle.ob and hit.material == middle.material]
    return same if same[: len(STENCIL)] == hits[: len(STENCIL)] else [middle]
