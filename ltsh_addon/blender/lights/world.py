"""The light of the world as distant lights, made from pictures of it by Cycles (runs in the child)."""

import math
from contextlib import contextmanager
from dataclasses import replace

import bpy
import numpy as np
from mathutils import Matrix

from ...cycles import environment
from ...cycles.patches import note_patches
from ...scene import Light, SkyLight, listed
from ..materials import graph
from .emission import COMPARE_TELLS, CONSTANT_NODES, LIGHT_PATH, camera_outputs, open_studio, trees_of

# Pixels along each side of a picture of a world. PLAIN: a world of one color. SMOOTH: one without fine detail.
# PROCEDURAL: another without images. LEAST, MOST: limits for one with images. SPOT_PIXELS: a small, bright spot.
PLAIN, SMOOTH, PROCEDURAL, LEAST, MOST = 8, 64, 256, 256, 1024
SPOT_PIXELS, SAMPLES, SPOT_SAMPLES = 128, 8, 16
# COARSE: mean relative error of patches above which there is a warning. PLAIN_BACKGROUND: the `fine_detail` of skies
# without edges or lines: a horizon between 1 and 2 has 0.009, between 1 and 1.1 0.0013.
COARSE, PLAIN_BACKGROUND = 0.05, 1e-3
MOST_RADIANCE = 1e15  # W m^-2 sr^-1
SAMPLING_METHODS = ("NONE", "AUTOMATIC", "MANUAL")  # of a world, in the order of their numbers
NOT_SAMPLED, SAMPLED_BY_ITSELF = 0, 1
# Outputs of Light Path nodes where Cycles samples the world for surfaces; all others are taken as 0.
SEEN_BY_SURFACES = {"Is Camera Ray": 0.0, "Ray Depth": 1.0}
EVERYWHERE_THE_SAME = (
    CONSTANT_NODES
    | {LIGHT_PATH, "NodeGroupInput", "NodeGroupOutput"}
    | {"ShaderNode" + name for name in ("OutputWorld", "Background", "Emission", "AddShader", "MixShader")}
)


def take_world(scene, view_layer, warnings: list[str]):
    """The world that Cycles renders, without its volume, or None; it is removed from `scene`."""
    world = view_layer.world_override or scene.world
    view_layer.world_override = scene.world = None
    if world is None:
        return None
    if _without_volume(world):
        warnings.append(f"world {world.name!r}: its volume is not shaded; left out of the Cycles reference as well")
    # The setting in the file only affects how well Cycles samples the world.
    if world.cycles.sampling_method == "NONE":
        _store(world.cycles, "sampling_method", SAMPLED_BY_ITSELF)
    return world


@contextmanager
def world_behind(scene, world):
    """Within this context `scene` has the `world`, which Cycles does not sample as a light."""
    if world is None:
        yield
        return
    method = SAMPLING_METHODS.index(world.cycles.sampling_method)
    try:
        _store(world.cycles, "sampling_method", NOT_SAMPLED)
        scene.world = world
        yield
    finally:
        scene.world = None
        _store(world.cycles, "sampling_method", method)


def _store(settings, name: str, value) -> None:
    """Set a property of Cycles without its update function, which expects the world to be that of a scene."""
    stored = settings.bl_system_properties_get(do_create=True) if bpy.app.version >= (5, 0, 0) else settings
    stored[name] = value


def blocks_nothing(occluders, world):
    """`occluders`, but blocking nothing of the light of `world` if the world's shadows are switched off."""
    if world is None or getattr(world.cycles, "use_shadows", True):
        return occluders
    return replace(occluders, light_masks={**occluders.light_masks, world.name: 0})


def light_of_world(world) -> Light | None:
    """A distant light on one side of a cube with the name and traits of `world`; None if the world gives no light."""
    if not may_shine(world):
        return None
    sees = world.cycles_visibility
    if not (sees.diffuse or sees.glossy):
        return None
    return SkyLight(
        name=world.name,
        center=np.array([0.0, 0.0, 1.0]),
        half_u=np.array([1.0, 0.0, 0.0]),
        half_v=np.array([0.0, 1.0, 0.0]),
        direction=np.array([0.0, 0.0, -1.0]),
        radiance=np.ones(3),
        group=world.lightgroup,
        affects_diffuse=sees.diffuse,
        affects_specular=sees.glossy,
    )


def world_lights(scene, world, warn) -> tuple[list[Light], float]:
    """The light of the `world` of `scene` as distant lights that have its name, [] if it is dark; its `fine_detail`."""
    like = light_of_world(world)
    if like is None:
        return [], 0.0
    pictures, lights = light_pictures(scene, world, like, warn)
    sky, error = environment.sky_lights(like, pictures)
    if error > COARSE:
        note_patches(f"world {world.name!r}: it", sum(len(light.leaves) for light in sky), error, warn)
    return sky + lights, environment.fine_detail(pictures)


def light_pictures(scene, world, like: Light, warn) -> tuple[list[environment.SkyPicture], list[Light]]:
    """Six pictures (a cube) of `world` as surfaces see it, without small, bright spots, and lights like `like` for
    these."""
    with _observatory(scene, world, warn) as look:
        for pixels in _pixels(world):
            pictures = [look(*axes, pixels, SAMPLES if pixels < MOST else SAMPLES // 2) for axes in environment.CUBE]
            if environment.fine_detail(pictures) <= environment.SMOOTH_SKY:
                break
        spots = environment.bright_spots(pictures)
        lights = []
        for number, spot in enumerate(spots):
            close = look(*environment.spot_frame(spot), SPOT_PIXELS, SPOT_SAMPLES)
            lights += environment.spot_light(like, environment.without_spots(close, spots[:number]), spot)
    return [environment.without_spots(picture, spots) for picture in pictures], lights


def background_pictures(scene, world, warn, light=()) -> list[environment.SkyPicture]:
    """Six pictures (a cube) of the `world` of `scene` as cameras see it. `light` are those of `light_pictures`, which
    may tell that few pixels are enough."""
    is_plain = environment.fine_detail(light) <= PLAIN_BACKGROUND and all(len(one.radiance) == SMOOTH for one in light)
    with _observatory(scene, world, warn, by_cameras=True) as look:
        *_, pixels = _pixels(world)
        if pixels != PLAIN:
            is_seen_alike = not any(node.bl_idname == LIGHT_PATH for node in _nodes(world))
            pixels = 2 * SMOOTH if light and is_plain and is_seen_alike else max(pixels, 2 * PROCEDURAL)
        return [look(*axes, pixels, SAMPLES // 2) for axes in environment.CUBE]


def may_shine(world) -> bool:
    """False if `world` is None or plainly dark."""
    if world is None:
        return False
    if graph.tree_in_use(world) is None:
        return max(world.color) > 0.0
    surface = graph.surface_of(world)
    source = None if surface is None else graph.source_of(surface)
    if source is None or source.node is None:
        return False
    if source.node.bl_idname != "ShaderNodeBackground":
        return True
    color, strength = (graph.value_of(source.node.inputs[name]) for name in ("Color", "Strength"))
    return not (strength == 0.0 or (not graph.is_socket(color) and max(color[:3]) <= 0.0))


def _pixels(world) -> tuple[int, ...]:
    """Pixels along each side of pictures of `world` that span a quarter of the horizon, to be tried in turn until one
    shows no fine detail. Images, which take long to read, have detail: they are looked at once."""
    if all(graph.is_group(node) or node.bl_idname in EVERYWHERE_THE_SAME for node in _nodes(world)):
        return (PLAIN,)
    widths = [node.image.size[0] for node in _nodes(world) if getattr(node, "image", None) is not None]
    if not widths:
        return SMOOTH, PROCEDURAL
    return (int(2 ** np.clip(round(math.log2(max(max(widths) / 4, 1))), math.log2(LEAST), math.log2(MOST))),)


def _nodes(world) -> list:
    """All nodes of a world, also in groups."""
    return [node for tree in trees_of([world]) for node in tree.nodes]


@contextmanager
def _observatory(scene, world, warn, by_cameras: bool = False):
    """Yields look(ahead, right, up, pixels, samples), which returns a `SkyPicture` of `world`.

    It shows the world as surfaces see it, or with `by_cameras` as cameras do.
    """
    copied = world.copy()
    groups = []
    try:
        _store(copied.cycles, "sampling_method", NOT_SAMPLED)
        if not by_cameras:
            _store(copied.cycles_visibility, "camera", True)
        if graph.tree_in_use(copied) is not None and not by_cameras:
            groups = graph.own_groups(copied.node_tree)
            _as_surfaces_see(copied, world.name, warn)
        with open_studio(scene) as studio:
            studio.scene.world = copied
            studio.scene.render.film_transparent = False
            lens = studio.camera.data
            lens.type, lens.clip_start, lens.clip_end = "PERSP", 0.1, 1.0

            def look(ahead, right, up, pixels, samples):
                axes = np.eye(4)
                axes[:3, 0], axes[:3, 1] = right / np.linalg.norm(right), up / np.linalg.norm(up)
                axes[:3, 2] = -ahead / np.linalg.norm(ahead)
                studio.camera.matrix_world = Matrix(axes.tolist())
                lens.angle = 2.0 * math.atan(np.linalg.norm(right) / np.linalg.norm(ahead))
                render = studio.scene.render
                render.resolution_x = render.resolution_y = pixels
                studio.scene.cycles.samples = samples
                radiance = studio.picture()[..., :3]
                odd = ~(np.abs(radiance) < MOST_RADIANCE).all(axis=-1)
                if odd.any():
                    share = f"on {100.0 * odd.mean():.2g} % of a side of the sky, dark there"
                    warn(f"world {world.name!r}: its radiance is not finite, or beyond {MOST_RADIANCE:g}, {share}")
                    radiance[odd] = 0.0
                return environment.SkyPicture(ahead, right, up, radiance)

            _note_cameras(copied, world.name, warn)
            yield look
    finally:
        bpy.data.worlds.remove(copied)
        for group in groups:
            bpy.data.node_groups.remove(group)


def _without_volume(world) -> bool:
    """Remove the volume of `world`; True if there was one."""
    tree = graph.tree_in_use(world)
    outputs = () if tree is None else [node for node in tree.nodes if node.bl_idname == "ShaderNodeOutputWorld"]
    links = [link for node in outputs for link in node.inputs["Volume"].links]
    for link in links:
        tree.links.remove(link)
    return bool(links)


def _note_cameras(world, name: str, warn) -> None:
    """Warn of nodes whose values depend on the camera."""
    labels = {f"{node.bl_label}: {output}" for node in _nodes(world) for output in camera_outputs(node)}
    if labels:
        warn(
            f"world {name!r}: it depends on the camera ({listed(sorted(labels))}); its light and its background are "
            f"those of six cameras, one for each side of a cube; {COMPARE_TELLS}"
        )


def _as_surfaces_see(world, name: str, warn) -> None:
    """Give the Light Path nodes of `world` the values that they have where Cycles samples the world for a surface."""
    unclear = set()
    for node in _nodes(world):
        if node.bl_idname != LIGHT_PATH:
            continue
        for output in [output for output in node.outputs if output.is_linked]:
            if output.name not in SEEN_BY_SURFACES:
                unclear.add(output.name)
            graph.replaced_by_number(output, SEEN_BY_SURFACES.get(output.name, 0.0))
    if unclear:
        warn(
            f"world {name!r}: its light depends on {listed(sorted(unclear))} of a Light Path node, of which Cycles "
            f"takes a mixture that depends on how it samples; shaded as for rays that are none; {COMPARE_TELLS}"
        )
