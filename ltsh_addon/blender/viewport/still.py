"""The viewport's picture without a window, through a camera of the scene (runs in the child): `ltsh view`."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import bpy
import gpu
import numpy as np

from ...files import save_array
from ...scene import SceneError, error_line, listed
from ...workers.pool import cores
from .. import render_settings
from ..evaluated import GREASE_PENCIL, SURFACE_TYPES, objects_in_renders, objects_in_views, with_render_depsgraph
from ..extract.occluders import with_baked_shares
from ..extract.pixels import files_opened, missing_images, no_light, open_scene
from ..lights.area import collect_lights, note_overlaps
from ..lights.textures import NodeEmission
from ..lights.world import light_of_world
from ..materials.preview_material import world_radiance
from ..process.view import GRAPHICS, VIEW_PASSES, VIEW_PNG, ViewJob
from ..render_settings import cycles_setting
from .drawing import ViewCamera, VisibilityGrid, float_texture, forget_shaders, frame_buffer, read_texture
from .light_texels import ShownSky, varied_sky
from .live_cycles import rendered_world
from .mirror import NOT_RESOLVED, Changes, SceneMirror, patterns_of
from .pictures import TRANSMITTED, ShownPicture, ShownRest
from .renderer import ViewRenderer
from .shadow_rays import MOST_BYTES, ShadowRays, ViewTracer, too_many, view_occluders, visibility_texture
from .shadows import MANY_POINTS, QUICK, QUICK_RAYS, PixelGrid, ShadowRequest, shape_of, shape_of_sky

# FEWEST_RAYS: a point of a pixel takes at least so many rays per light, however many points share those of the pixel.
FEWEST_RAYS = 32
# SHARE_OF_RAYS: in a playblast, where all points of a pixel share the rays, they take one of so many. POINT_BYTES: what
# is kept of a point of a pixel for the next frame.
SHARE_OF_RAYS, POINT_BYTES = 8, 500
# The last renderer, kept for its compiled shaders. Only where scripts may always use graphics.
_renderer: list[ViewRenderer] = []


class OpenScene:
    """The scene of a view, open for further frames: what does not change from one to the next is not read again."""

    def __init__(self, job: ViewJob, progress):
        self.warnings: list[str] = []
        progress("open scene", 0.0)
        open_scene(Path(job.scene), self.warnings, job.scripts)
        self.scene, self._state = bpy.context.scene, _state_of(job)
        self._changes, self._patterns, self._sky, self._lights = Changes(everything=True), {}, None, None
        self._sky_notes: list[str] = []
        self._shadow_notes: list[str] = []
        self._mirror: SceneMirror | None = None
        self.tracing: ViewTracer | None = None
        self._shadows: FrameShadows | None = None

    def is_of(self, job: ViewJob) -> bool:
        """True if it is the scene of a job, and nothing else has been opened since."""
        return self._state == _state_of(job)

    def go_to_frame(self, frame: int | None) -> None:
        """Go to a frame and take note of what that changes."""
        self.depsgraph()  # settings of pictures are no changes

        def note(scene, depsgraph) -> None:
            self._changes.add(depsgraph)

        handlers = [getattr(bpy.app.handlers, name) for name in ("frame_change_post", "depsgraph_update_post")]
        for each in handlers:
            each.append(note)
        try:
            render_settings.go_to_frame(self.scene, frame)
            self.depsgraph()
        finally:
            for each in handlers:
                each.remove(note)

    def depsgraph(self):
        """The evaluated scene, up to date."""
        with bpy.context.temp_override(scene=self.scene, view_layer=_layer(self.scene)):
            return bpy.context.evaluated_depsgraph_get()

    def read(self, has_shadows: bool) -> list[str]:
        """Read again what Cycles tells about the world and lights, and the occluders; returns warnings."""
        scene, changes = self.scene, self._changes
        if changes.sky:
            self._sky_notes = []
            self._sky = _sky(scene, self._sky_notes)
        with bpy.context.temp_override(scene=scene, view_layer=_layer(scene)):
            depsgraph, unread = self.depsgraph(), []
            if changes.emitters:
                self._patterns = patterns_of(scene, depsgraph, {} if changes.images else self._patterns)
            lights = [ob.name_full for ob in depsgraph.objects if ob.type == "LIGHT"]
            # Simplify may leave out what the camera does not see.
            if has_shadows and (changes.surfaces or lights != self._lights or scene.render.use_simplify):
                self._lights, self._shadow_notes = lights, []
                occluders = view_occluders(depsgraph, self._shadow_notes.append, unread)
                if unread:
                    occluders = with_baked_shares(occluders, unread, scene, self._shadow_notes.append)
                if self.tracing is not None:
                    self.tracing.close()
                self.tracing = ViewTracer(occluders, cores())
            images = missing_images(depsgraph, scene.world, _layer(scene).material_override)
            notes = [*self._sky_notes, *self._shadow_notes, *images, *overlaps_of_lights(depsgraph)]
        return notes

    def mirror(self) -> SceneMirror:
        """The mirror of the scene, up to date; needs an active GPU context."""
        depsgraph = self.depsgraph()
        if self._mirror is None or not MAY_DRAW_ALWAYS:
            self._mirror = SceneMirror(lambda world: self._sky, self._pattern)
            self._mirror.sync(depsgraph)
        else:
            self._mirror.sync(depsgraph, changes=self._changes)
        self._changes = Changes()
        return self._mirror

    def shadows(self, rays: int) -> "FrameShadows":
        """The shadows of frames."""
        if self._shadows is None or self._shadows.tracing is not self.tracing:
            self._shadows = FrameShadows(self.tracing, rays)
        return self._shadows

    def _pattern(self, data, source) -> NodeEmission | str:
        return self._patterns[source.key][1] if source.key in self._patterns else NOT_RESOLVED

    def close(self) -> None:
        """End the processes that trace, and free what is on the graphics card."""
        if self.tracing is not None:
            self.tracing.close()
        self._mirror = self._shadows = None


class FrameShadows:
    """Shadows of the frames of a playblast, as views have them soon after they come to rest: once for all points of a
    pixel. A light that stays keeps them as long as the surfaces and the camera stay."""

    version, waits, is_fine, traces_lobes = 0, False, True, False

    def __init__(self, tracing: ViewTracer, rays: int):
        self.tracing, self._rays, self.seconds = tracing, rays, 0.0
        self._state, self._points, self._known, self._grid = None, None, {}, None

    @cached_property
    def of_glass(self) -> "FrameShadows":
        """The shadows of the glass in front of the surfaces."""
        return FrameShadows(self.tracing, self._rays)

    def take_news(self) -> None:
        """Do nothing: there is never news, because everything is traced at once."""

    def visibility(self, gbuffer, view: ViewCamera, lights, sides=(), number: int = 0) -> VisibilityGrid | None:
        """As `ShadowRays.visibility`."""
        if number > 0:
            return self._grid
        start, self._grid = time.monotonic(), None
        state = view.projection.tobytes(), gbuffer.size
        if state != self._state:
            self._state, self._points, self._known = state, PixelGrid(1, gbuffer, view), {}
        else:
            self._points.follow(gbuffer)
        emitters = {shape_of(light): (light,) for light in lights}
        emitters |= {shape_of_sky(sides): sides} if sides else {}
        keys = [*map(shape_of, lights), *([shape_of_sky(sides)] if sides else [])]
        if keys and len(self._points.samples()[0]):
            self._known = {key: self._known.get(key) for key in emitters}
            for key, values in self._known.items():
                if values is None:
                    self._known[key] = self._traced(key, emitters[key])
            values, (positions, projection) = [self._known[key] for key in keys], self._points.grid
            texture = visibility_texture(np.stack(values), positions.shape[1::-1])
            sources = tuple((positions, one) for one in values)
            self._grid = VisibilityGrid(texture, float_texture(positions), projection, sources)
        self.seconds += time.monotonic() - start
        return self._grid

    def _traced(self, key, lights) -> np.ndarray:
        level = QUICK if np.prod(self._state[1]) > MANY_POINTS else 1
        work = ShadowRequest((), level, 0, (0,), (key,), (lights,), self._points, self._rays, self.tracing)
        return work.visibility(lambda stage, fraction: None)[0]

    def facts(self, samples: int) -> dict:
        """As `ShadowRays.facts`, since the last call and without the noise."""
        seconds, rays = self.seconds + self.of_glass.seconds, self.tracing.rays
        self.seconds = self.of_glass.seconds = self.tracing.rays = 0
        return {"rays": rays, "noise": {}, "tracer": self.tracing.tracer.description, "seconds": seconds}


# The scene of the last job, and whether scripts may use the graphics card outside of renders.
_open: list[OpenScene] = []
MAY_DRAW_ALWAYS = hasattr(gpu, "init")


def _state_of(job: ViewJob) -> tuple:
    """What an open scene is of."""
    return files_opened(), Path(job.scene).stat().st_mtime_ns, replace(job, frame=None, rest=None, is_everything=False)


def draw_view(job: ViewJob, folder: Path, progress) -> dict:
    """Do the `job` and write arrays and a PNG into `folder`; returns the manifest."""
    started = time.monotonic()
    if not (_open and _open[0].is_of(job)):
        for other in _open:
            other.close()
        _open[:] = [OpenScene(job, progress)]
    opened = _open[0]
    try:
        return {**_drawn(opened, job, folder, progress), "seconds": time.monotonic() - started}
    except BaseException:
        opened.close()
        _open.clear()
        raise


def _drawn(opened: OpenScene, job: ViewJob, folder: Path, progress) -> dict:
    """Draw a frame of the open scene; returns the manifest."""
    scene = opened.scene
    opened.go_to_frame(job.frame)
    camera = render_settings.choose_camera(scene, job.camera)
    size = render_settings.set_resolution(scene, job.width, job.height)
    warnings = [*opened.warnings, *_not_shown(scene, camera), *opened.read(job.shadows == "on")]
    progress(GRAPHICS, 0.0)
    pictures, notes, facts = with_graphics(lambda: _draw(job, opened, camera, size, progress))
    for number, pixels in enumerate(pictures):
        technique, index = divmod(number, len(facts["passes"]))
        save_array(folder / f"{technique}_{facts['passes'][index]}.npy", pixels)
    render_settings.save_png(scene, pictures[0], folder / VIEW_PNG)
    return {
        "blender_version": bpy.app.version_string,
        "frame": scene.frame_current,
        "camera": camera.name,
        "width": size[0],
        "height": size[1],
        "pixel_aspect": scene.render.pixel_aspect_x / scene.render.pixel_aspect_y,
        "pixel_filter": render_settings.filter_name(scene),
        "exposure": cycles_setting(scene, "film_exposure"),
        "color_space": render_settings.working_space(),
        "warnings": [*warnings, *notes],
        **facts,
    }


def overlaps_of_lights(depsgraph) -> list[str]:
    """Warnings about area lights that overlap in a plane."""
    # The object of an instance is another one after its turn.
    objects = (instance.object for instance in depsgraph.object_instances)
    if sum(ob.type == "LIGHT" and ob.data.type == "AREA" for ob in objects) < 2:
        return []
    inventory = collect_lights(depsgraph, depsgraph.view_layer_eval.material_override)
    inventory.warnings.clear()
    note_overlaps(inventory)
    return inventory.warnings


def with_graphics(function: Callable):
    """Call `function()` where the graphics card may be used, and return its result. Raises SceneError without a card.

    Before Blender 5.2, scripts without a window may use the card only inside a render whose engine asks for it.
    """
    if not MAY_DRAW_ALWAYS:
        return _inside_render(function)
    try:
        gpu.init()
    except (RuntimeError, SystemError) as error:
        raise SceneError(error_line(error)) from None
    if not _has_context():
        # A render with grease pencil loses the context; a render whose engine asks for it brings it back.
        _inside_render(lambda: None)
    return function()


def _has_context() -> bool:
    try:
        gpu.types.GPUUniformBuf(gpu.types.Buffer("FLOAT", 4))
    except RuntimeError:
        return False
    return True


def _inside_render(function: Callable):
    scene = bpy.data.scenes.new("LTSH graphics")
    scene.camera = bpy.data.objects.new("LTSH graphics", bpy.data.cameras.new("LTSH graphics"))
    scene.collection.objects.link(scene.camera)
    scene.render.resolution_x = scene.render.resolution_y = 4
    try:
        return with_render_depsgraph(scene, lambda depsgraph: function(), graphics=True)
    finally:
        bpy.data.scenes.remove(scene)


def _not_shown(scene, camera) -> list[str]:
    """Notes about settings of the file that views do not show."""
    asked = {
        "motion blur": scene.render.use_motion_blur,
        "stereoscopy": scene.render.use_multiview,
        f"depth of field of camera {camera.name!r}": camera.data.dof.use_dof,
        "the render region": scene.render.use_border,
    }
    notes = [f"{name} is not shown in views" for name, is_asked in asked.items() if is_asked]
    others = sorted(ob.name for ob in objects_in_renders(_layer(scene)) if _differs_in_renders(ob))
    if others:
        notes.append(f"views and renders have other modifiers or levels of subdivision of {listed(others, 4, ', ')}")
    notes += _shown_apart(_layer(scene))
    drawn = sorted(ob.name for ob in objects_in_renders(_layer(scene)) if ob.type in GREASE_PENCIL)
    if drawn:
        text = "grease pencil is not in pictures of views; Blender draws it over live views and renders"
        notes.append(f"{listed(drawn, 4, ', ')}: {text}")
    used = [layer.name for layer in scene.view_layers if layer.use]
    if len(used) > 1:
        notes.append(f"scene {scene.name!r}: only view layer {used[0]!r} of {len(used)} is shown")
    return notes


def _shown_apart(layer) -> list[str]:
    """Notes about the objects of the view `layer` that views show and renders do not, and the other way round."""
    viewed, rendered, notes = set(objects_in_views(layer)), objects_in_renders(layer), {"views": [], "renders": []}
    for ob in layer.objects:
        if not (ob.type in (*SURFACE_TYPES, "LIGHT") or ob.is_instancer):
            continue
        # An instancer need not show its own mesh.
        own = ob.type in SURFACE_TYPES and ob.is_instancer
        in_views = ob in viewed and not (own and not ob.show_instancer_for_viewport)
        in_renders = ob in rendered and not (own and not ob.show_instancer_for_render)
        if in_views != in_renders:
            notes["views" if in_views else "renders"].append(ob.name)
    return [f"only {name} show {listed(sorted(names), 4, ', ')}" for name, names in notes.items() if names]


def _differs_in_renders(ob) -> bool:
    """True if a modifier of the object gives renders another mesh than views."""
    return any(
        modifier.show_viewport != modifier.show_render
        or modifier.type in ("SUBSURF", "MULTIRES")
        and modifier.levels != modifier.render_levels
        for modifier in ob.modifiers
    )


def _sky(scene, warnings: list[str]) -> ShownSky | None:
    """The world of `scene` as Cycles sees it; None where it is one constant."""
    world = _layer(scene).world_override or scene.world
    if world_radiance(world)[1]:
        return None
    return varied_sky(light_of_world(world), *rendered_world(scene, world, warnings.append))


def _layer(scene):
    return next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])


def _draw(
    job: ViewJob, opened: OpenScene, camera, size: tuple[int, int], progress
) -> tuple[list[np.ndarray], list[str], dict]:
    """Pictures (H, W, 4), row 0 on top, of all techniques and passes, notes, and facts for the manifest."""
    progress("draw", 0.0)
    scene, mirror, depsgraph = opened.scene, opened.mirror(), opened.depsgraph()
    if not mirror.lights and not mirror.sky.sides:
        raise no_light(scene, mirror.notes)
    notes, shadows = mirror.notes if job.rest is None else mirror.notes_with_rest(job.is_everything), None
    if opened.tracing is not None:
        problem = too_many(len(mirror.lights), size)
        rays = max(min(FEWEST_RAYS, job.shadow_rays), job.shadow_rays // job.refine)
        if problem:
            notes.append(problem)
        elif job.is_playblast:
            shadows = opened.shadows(max(QUICK_RAYS, job.shadow_rays // SHARE_OF_RAYS))
        else:
            shadows = ShadowRays(opened.tracing, rays)
    drawn = mirror, view_of_camera(camera.evaluated_get(depsgraph), depsgraph, size), size
    # Beside Cycles' light the mean of the points must be the center.
    offsets = render_settings.filter_points if job.rest is None else render_settings.balanced_points
    points = render_settings.sub_pixel_offsets(scene, job.refine, offsets)
    passes = (*VIEW_PASSES, TRANSMITTED) if mirror.has_glass else VIEW_PASSES
    first, *others = ((technique, name) for technique in job.techniques for name in passes)
    exposure, transparent = cycles_setting(scene, "film_exposure"), scene.render.film_transparent
    shown = ShownPicture(first[0], "combined", exposure=exposure, transparent=transparent, also=tuple(others))
    renderer = _renderer[0] if _renderer else ViewRenderer()
    renderer.shadows, renderer.has_bounces = shadows, job.rest is not None
    renderer.keeps_points = job.is_playblast and job.refine * size[0] * size[1] * POINT_BYTES <= MOST_BYTES
    renderer.may_split = renderer.keeps_points
    if job.rest is not None:
        renderer.rest = ShownRest(float_texture(np.load(job.rest)[::-1]), drawn[1], job.is_everything)
    try:
        pictures = _pictures(renderer, drawn, shown, points, progress)
    except ValueError as error:  # a table that the card does not take
        raise SceneError(error_line(error)) from error
    except SceneError as error:  # rays
        raise SceneError(f"{error}; --shadows off draws the view without") from error
    finally:
        renderer.shadows = renderer.rest = None
        if MAY_DRAW_ALWAYS:
            _renderer[:] = [renderer]
        else:
            renderer.free()
            forget_shaders()
    traced = None if shadows is None else shadows.facts(len(points))
    return (
        pictures,
        notes,
        {
            "graphics": f"{gpu.platform.renderer_get()}, {gpu.platform.backend_type_get()}",
            "lights": sorted({light.name for light in (*mirror.lights, *mirror.sky.sides)}),
            "shadows": traced,
            "passes": passes,
        },
    )


def view_of_camera(camera, depsgraph, size: tuple[int, int]) -> ViewCamera:
    """The view of the evaluated object `camera` in a picture of `size`."""
    render = depsgraph.scene_eval.render
    aspect = {"scale_x": render.pixel_aspect_x, "scale_y": render.pixel_aspect_y}
    window = camera.calc_matrix_camera(depsgraph, x=size[0], y=size[1], **aspect)
    return ViewCamera.of(camera.matrix_world.normalized().inverted(), window, camera.data.type == "ORTHO")


def _pictures(
    renderer: ViewRenderer, drawn: tuple, shown: ShownPicture, points: np.ndarray, progress: Callable
) -> list:
    """Pictures (H, W, 4) of a view at rest, the means over `points`: the one `shown`, then its `also`.

    Row 0 is on top; the exposure is included. `drawn` is the mirror, the camera and the size. Needs an active GPU
    context.
    """
    mirror, view, size = drawn
    texture = gpu.types.GPUTexture(size, format="RGBA32F")
    buffer = frame_buffer(texture)
    for number in range(len(points)):
        progress("draw", number / len(points))
        renderer.draw(mirror, view, size, shown, buffer, points)
        buffer.read_color(0, 0, 1, 1, 4, 0, "FLOAT")  # wait until the card has finished
    pictures = [read_texture(texture)]
    for number, (_, name) in enumerate(shown.also, 1):
        if name == "combined":
            renderer.show(number, view, shown, buffer)
            lit = read_texture(texture)
        else:
            lit = renderer.read(number)
            lit[..., :3] *= np.float32(shown.exposure)
        pictures.append(lit)
    return [picture[::-1] for picture in pictures]
