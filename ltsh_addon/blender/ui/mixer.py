"""The panel of the light mixer: changes power, exposure and color of each light in a finished picture at once."""

import time
from dataclasses import replace
from typing import ClassVar

import bpy
import numpy as np

from ...files import temporary_folder
from ...pipeline.match import LightFactors, matched_factors
from ...pipeline.mixer import MixerRow
from ...scene import Cancelled, Light, SceneError, error_line, light_of, listed
from ..evaluated import EmitterTraits
from ..extract.match import is_telling, light_of_image
from ..lights.area import area_light, reason_to_leave_out
from ..lights.groups import reason_to_keep
from ..lights.linking import Receivers
from . import comparison, results
from .operators import TIMER_SECONDS, WatchedOperator
from .panels import draw_job, draw_text, gray, in_both_places, split_names
from .preview import LTSHOperator

UPDATE, MOVED = "Update Moved Lights", "moved since this picture"
# UNMOVED: smaller changes, relative to a light's distance and size, do not count as a move.
UNMOVED = 1e-5


def plain_lights(depsgraph) -> dict[str, Light]:
    """The current lights of the scene without their node trees, by name. Only objects that are exactly one light."""
    receivers = Receivers([instance.object.original for instance in depsgraph.object_instances])
    by_name: dict[str, list[Light]] = {}
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type == "LIGHT" and instance.show_self:
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            if not reason_to_leave_out(ob, matrix):
                light = area_light(ob, matrix, EmitterTraits.of(instance), receivers)
                by_name.setdefault(light.name, []).append(light)
    return {name: lights[0] for name, lights in by_name.items() if len(lights) == 1}


def has_moved(before: Light, now: Light) -> bool:
    """True where a light has another place, direction, size or shape."""
    size = np.abs(before.center).max() + before.radius
    near = all(
        np.allclose(getattr(before, name), getattr(now, name), rtol=0.0, atol=UNMOVED * most)
        for name, most in (("center", size), ("half_u", size), ("half_v", size), ("direction", 1.0))
    )
    cones = [(np.inf, np.inf) if one.cone is None else (one.cone.cosine, one.cone.sharpness) for one in (before, now)]
    return not (near and np.allclose(*cones, rtol=UNMOVED) and abs(before.spread - now.spread) < UNMOVED)


def light_where_it_is(former: Light, now: Light, normalized: bool) -> Light:
    """The light at its place `now`, with the power, linking and light group of `former`.

    Where its power is `normalized`, the radiance is scaled with the area.
    """
    former_area, area = (np.linalg.norm(light.area_vector) for light in (former, now))
    names = "group", "receivers", "affects_diffuse", "affects_specular", "falloff", "smooth"
    settings = {name: getattr(former, name) for name in names}
    return replace(now, radiance=former.radiance * (former_area / area if normalized else 1.0), **settings)


def moved_rows(context, rows) -> dict[int, Light]:
    """The moved lights at their new places, by the numbers of their rows."""
    moved, lights = {}, plain_lights(context.evaluated_depsgraph_get())
    for number, row in enumerate(rows):
        if row.light is not None and row.name in lights:
            before, now = light_of(row.light), lights[row.name]
            if has_moved(before, now):
                moved[number] = light_where_it_is(before, now, bpy.data.objects[row.name].data.normalize)
    return moved


def targets(row: MixerRow, item) -> dict[str, tuple[float, float, tuple[float, ...]]]:
    """Power, exposure and color with which each light object of a row looks as the mixer shows it."""
    # Channels that the light lacks in the picture stay as they are.
    values, factor = {}, np.where(np.array(row.color) != 0.0, results.tint_of(row, item), 1.0)
    for name, (power, exposure, *color) in row.settings.items():
        mixed = factor * color
        # Blender's color fields show values up to 1, so brighter colors go into the power.
        bright = max(1.0, mixed.max()) if not np.allclose(factor, 1.0) else 1.0
        values[name] = power * item.power * bright, exposure + item.exposure, tuple((mixed / bright).tolist())
    return values


def _stands_elsewhere(ob, before: dict) -> bool:
    """True if a light object has moved or turned since its light was kept. A fast check, without the depsgraph."""
    if ob is None or ob.type != "LIGHT":
        return False
    matrix = np.array(ob.matrix_world)
    near = before["is_distant"] or np.allclose(matrix[:3, 3], before["center"], rtol=1e-4, atol=1e-4)
    axis = -matrix[:3, 2] / max(np.linalg.norm(matrix[:3, 2]), 1e-30)
    is_turned = ob.data.type != "POINT" and not np.allclose(axis, before["direction"], atol=1e-4)
    return not near or is_turned


def state_of(row: MixerRow, item) -> tuple[str, str]:
    """An icon, and a sentence if the light in the scene differs from that of the picture."""
    if not row.lights:
        return "INFO", row.note
    lost = [name for name in row.lights if name not in bpy.data.objects]
    if lost and row.settings:
        return "ERROR", f"{listed(lost, 3)}: not in the scene any more"
    if row.light is not None and _stands_elsewhere(bpy.data.objects.get(row.name), row.light):
        return "ERROR", f"{row.name}: {MOVED}; {UPDATE} shades it where it is"
    for name, (power, exposure, color) in targets(row, item).items():
        ob = bpy.data.objects[name]
        now = (ob.data.energy, ob.data.exposure, *ob.data.color) if ob.type == "LIGHT" else ()
        known = (row.settings[name], (power, exposure, *color))
        if not any(len(now) == 5 and np.allclose(now, values, rtol=1e-4, atol=1e-6) for values in known):
            return "ERROR", f"{name}: its power or color was changed in the scene since this picture"
    return "LIGHT", row.note


class LTSH_UL_mixer(bpy.types.UIList):
    """Lights of a finished picture"""

    # Rows by name, found once per draw of the panel, because that looks at files.
    rows: ClassVar[dict[str, MixerRow]] = {}

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index):
        line, row = layout.row(align=True), LTSH_UL_mixer.rows.get(item.name)
        line.enabled = row is not None
        line.prop(item, "muted", text="", icon="HIDE_ON" if item.muted else "HIDE_OFF", emboss=False)
        line.prop(item, "solo", text="", icon="SOLO_ON" if item.solo else "SOLO_OFF", emboss=False)
        state = "ERROR" if row is None else state_of(row, item)[0]
        line.label(text=item.name, icon=state, translate=False)
        values = line.row(align=True)
        values.scale_x = 0.9
        values.prop(item, "power", text="")
        swatch = line.row(align=True)
        swatch.scale_x = 0.4
        swatch.prop(item, "color", text="")


class _Mixer:
    bl_label = "Light Mixer"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, settings = self.layout, context.scene.ltsh
        rows = LTSH_UL_mixer.rows = {row.name: row for row, _ in results.mixer_pairs(context.scene)}
        split_names(layout, context)
        if not rows:
            layout.prop(settings, "keep_lights")
            draw_text(layout, context, "Shade the picture with it, or bake Per Light: then lights change here", "INFO")
            layout.prop(settings, "match_target")
            _draw_move(layout)
            return
        layout.template_list("LTSH_UL_mixer", "", settings, "mixed", settings, "mixed_active", rows=min(len(rows), 8))
        item = settings.mixed[settings.mixed_active] if settings.mixed_active < len(settings.mixed) else None
        row = None if item is None else rows.get(item.name)
        if row is not None:
            column = layout.column()
            for name in ("power", "exposure", "color"):
                column.prop(item, name)
            icon, note = state_of(row, item)
            if note:
                draw_text(gray(column), context, note, icon if icon == "ERROR" else "INFO")
        elif item is not None:
            draw_text(gray(layout), context, f"{item.name} is not in this picture; its values wait here", "INFO")
        row = layout.row(align=True)
        row.operator("ltsh.reset_mixer", icon="LOOP_BACK")
        row.operator("ltsh.apply_mixer", icon="CHECKMARK")
        _draw_update(layout)
        row = layout.row(align=True)
        row.prop(settings, "match_target", text="")
        row.operator("ltsh.paint_target", text="", icon="BRUSH_DATA")
        row = layout.row(align=True)
        row.operator("ltsh.match_target", icon="LIGHT")
        row.prop(settings, "match_colors", toggle=True)
        _draw_move(layout)
        for note in notes(context.scene):
            draw_text(gray(layout), context, note, "INFO")


def _draw_move(layout) -> None:
    """The button that also moves lights, or the progress of its job."""
    if not draw_job(layout, "match"):
        layout.operator("ltsh.match_move", icon="LIGHT_AREA")


def _draw_update(layout) -> None:
    """The button that shades moved lights, or its progress while that is done."""
    update = results.state["update"]
    if update is None:
        layout.operator("ltsh.update_moved_lights", icon="ORIENTATION_GLOBAL")
        return
    row = layout.row(align=True)
    row.progress(factor=update.done, text=f"{100.0 * update.done:.0f} %")
    row.operator("ltsh.cancel_moved_lights", text="", icon="X")


def notes(scene) -> list[str]:
    """Notes about the mix as a whole."""
    facts = results.mixer_of(scene).facts
    texts, camera = list(facts["notes"]), scene.camera
    if facts["frame"] != scene.frame_current:
        texts.append(f"The picture is of frame {facts['frame']}, the scene is at frame {scene.frame_current}")
    if facts["camera"] and (camera is None or facts["camera"] != camera.name):
        texts.append(f"The picture is of camera {facts['camera']}")
    return texts


class LTSH_PT_IMAGE_mixer(_Mixer, bpy.types.Panel):
    """Power, exposure and color of the lights in the picture, without rendering it again"""

    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "UI"
    bl_category = "LTSH"
    bl_options = set()


class _NeedsMixer(LTSHOperator):
    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        reason = "Shade a picture first, with Keep Lights, or bake Per Light"
        return reason if results.mixer_of(context.scene) is None else super().reason_against(context)


class LTSH_OT_reset_mixer(_NeedsMixer, bpy.types.Operator):
    """Show all lights as they were rendered"""

    bl_label = "Reset"
    bl_options = {"UNDO"}

    def execute(self, context):
        results.reset_mixer(context.scene)
        comparison.refresh(context.scene)
        return {"FINISHED"}


class LTSH_OT_apply_mixer(_NeedsMixer, bpy.types.Operator):
    """Give the lights of the scene the values that the mixer shows, and hide muted ones in renders"""

    bl_label = "Apply to Scene"
    bl_options = {"UNDO"}

    def execute(self, context):
        problems = applied(context.scene)
        for problem in problems:
            self.report({"WARNING"}, problem)
        if not problems:
            self.report({"INFO"}, "The lights of the scene are as the mixer shows them")
        return {"FINISHED"}


def applied(scene) -> list[str]:
    """Write the values of the mixer to the lights of the scene; returns problems about those that cannot be written.

    Lights that the mixer never changed stay as they are.
    """
    problems, given = [], {}
    for row, item in results.mixer_pairs(scene):
        dark = not results.is_on(scene, item)
        if not dark and not item.applied and results.is_neutral(row, item):
            continue
        if not row.settings:
            problems.append(f"{row.name}: no light object, so it is as it was; change its material or the world")
            continue
        for name, values in targets(row, item).items():
            ob = bpy.data.objects.get(name)
            problem = _reason_not_to_apply(ob, values, given)
            if problem:
                problems.append(f"{name}: {problem}")
                continue
            ob.hide_render = dark
            ob.data.energy, ob.data.exposure, ob.data.color = values
            item.applied = True
    return problems


def _reason_not_to_apply(ob, values, given: dict) -> str:
    """Why a light cannot get `values`; "" if it can. `given` are the values of the data of earlier lights."""
    if ob is None or ob.type != "LIGHT":
        return "not in the scene any more"
    if reason := reason_to_keep(ob):
        return reason
    if given.setdefault(ob.data.name, values) != values:
        return "it shares its data with a light that got other values; make it a single user"
    return ""


class LTSH_OT_paint_target(_NeedsMixer, bpy.types.Operator):
    """Make a target to paint on: a copy of the picture as the mixer shows it"""

    bl_label = "Paint a Target"
    bl_options = {"UNDO"}

    def execute(self, context):
        pixels = results.mixed_pixels(context.scene)
        image = bpy.data.images.new("LTSH Target", *pixels.shape[1::-1], float_buffer=True)
        image.colorspace_settings.name = results.linear_space()
        image.pixels.foreach_set(np.ascontiguousarray(pixels).ravel())
        image[results.DIRECT_ONLY] = results.is_direct_only(context.scene)
        context.scene.ltsh.match_target = image
        if context.area is not None and context.area.type == "IMAGE_EDITOR":
            context.space_data.image, context.space_data.mode = image, "PAINT"
        self.report({"INFO"}, f"Paint brighter, darker or colored light on {image.name!r}, then Match")
        return {"FINISHED"}


class LTSH_OT_match_target(_NeedsMixer, bpy.types.Operator):
    """Give the lights the powers with which the picture comes closest to the target"""

    bl_label = "Match"
    bl_options = {"UNDO"}

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        return results.reason_without_target(context.scene) or super().reason_against(context)

    def execute(self, context):
        scene, settings = context.scene, context.scene.ltsh
        try:
            result = match_mixer(scene, settings.match_target, settings.match_colors)
        except SceneError as error:
            self.report({"ERROR"}, error_line(error))
            return {"CANCELLED"}
        if settings.mode == "MIX":
            comparison.changed(settings, context)
        else:
            settings.mode = "MIX"
        before, after = 100.0 * result.before, 100.0 * result.after
        self.report({"INFO"}, f"The picture is {after:.1f} % from the target, it was {before:.1f} % as rendered")
        return {"FINISHED"}


def match_mixer(scene, image, colors: bool) -> LightFactors:
    """Set the mixer's lights so that its picture comes closest to `image`. Raises SceneError."""
    mixer = results.mixer_of(scene)
    layers, size = mixer.pictures.layers, mixer.pictures.alpha.shape[::-1]
    with temporary_folder() as folder:
        target, encoded = light_of_image(image, scene, None, folder)
    if target.shape[1::-1] != size:
        found = f"{target.shape[1]}x{target.shape[0]} pixels"
        raise SceneError(f"image {image.name!r} is {found}, expected {size[0]}x{size[1]} as the picture")
    of_lights = np.array([bool(row.lights) for row in mixer.rows])
    weights = is_telling(target, encoded).astype(np.float64)
    target = np.where(weights[..., None] > 0.0, target, 0.0)
    result = matched_factors(layers[of_lights], layers[~of_lights].sum(axis=0), target, weights, colors=colors)
    names = [row.name for row in mixer.rows if row.lights]
    results.set_factors(scene, dict(zip(names, result.factors, strict=True)))
    return result


class LTSH_OT_update_moved_lights(_NeedsMixer, WatchedOperator, bpy.types.Operator):
    """Shade lights that have been moved or resized since the picture where they are now; the others stay.
    Lights that are moved meanwhile are followed"""

    bl_label = UPDATE

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        is_busy = results.state["update"] is not None
        return "Moved lights are being shaded" if is_busy else super().reason_against(context)

    def _wait(self, context):
        while not self._update.is_finished:
            self._update.take()
            time.sleep(TIMER_SECONDS)
        return self._finish(context)

    def modal(self, context, event):
        update, scene = self._update, results.scene_of(self._scene_uid)
        if results.state["update"] is not update or scene is None or results.mixer_of(scene) is not update.mixer:
            # Cancelled by the cross, or another picture or file is open.
            update.stop()
            return self._finish(context)
        if event.type == "ESC" and event.value == "PRESS":
            update.stop()
            return self._finish(context)
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if any(_stands_elsewhere(bpy.data.objects.get(light.name), light.record()) for light in update.moved.values()):
            update.stop()
            if not self._begin(context):
                return self._finish(context)
        elif update.take():
            comparison.refresh(scene)
        if self._update.is_finished:
            return self._finish(context)
        comparison.redraw_panels()
        return {"PASS_THROUGH"}

    def cancel(self, context):
        """Called by Blender when the window is closed."""
        self._update.stop()
        self._finish(context)

    def _begin(self, context) -> bool:
        scene = context.scene
        moved = moved_rows(context, results.mixer_of(scene).rows)
        if not moved:
            self.report({"INFO"}, "No light of the picture has moved")
            return False
        try:
            self._update = results.state["update"] = results.Update(scene, moved)
        except SceneError as error:
            self.report({"ERROR"}, error_line(error))
            return False
        self._scene_uid = scene.session_uid
        return True

    def _finish(self, context):
        update = self._update
        if results.state["update"] is update:
            results.state["update"] = None
        self._end_timer(context)
        if update.error is not None and not isinstance(update.error, Cancelled):
            self.report({"ERROR"}, error_line(update.error))
        scene = results.scene_of(self._scene_uid)
        if scene is not None and results.mixer_of(scene) is update.mixer:
            comparison.refresh(scene)
        comparison.redraw_panels()
        return {"FINISHED"} if update.error is None else {"CANCELLED"}


class LTSH_OT_cancel_moved_lights(LTSHOperator, bpy.types.Operator):
    """Show the lights as they were before"""

    bl_label = "Cancel"

    def execute(self, context):
        results.state["update"] = None
        return {"FINISHED"}


CLASSES = (
    LTSH_UL_mixer,
    *in_both_places(_Mixer, "mixer", "main"),
    LTSH_PT_IMAGE_mixer,
    LTSH_OT_reset_mixer,
    LTSH_OT_apply_mixer,
    LTSH_OT_paint_target,
    LTSH_OT_match_target,
    LTSH_OT_update_moved_lights,
    LTSH_OT_cancel_moved_lights,
)
