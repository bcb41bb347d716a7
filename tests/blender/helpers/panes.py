"""A floor under a light so small that a point is lit or not, and what stands between them: in Cycles, and by rays."""

import math

import bpy
import numpy as np
import scene_parts
from material_scenes import Build

from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.blender.render_settings import pass_names, pinned_pixel_filter
from ltsh_addon.visibility import open_tracer

SIZE = (48, 32)
WIDTH = 6.0
LIGHT = np.array([1.2, 0.9, 4.0])
LIGHT_SIZE = 2e-3


def start():
    """An empty scene: a white floor seen from above, lit by a light that is nearly a point."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera(WIDTH)
    scene.camera.location.z = 9.0
    floor = scene_parts.bsdf_material("ShaderNodeBsdfDiffuse", "Floor", Color=(1.0, 1.0, 1.0, 1.0))[0]
    scene_parts.add_plane(floor, size=8.0, name="Floor")
    add_light("Key", LIGHT)
    return scene


def add_light(name, place, **settings):
    settings = {"shape": "SQUARE", "size": LIGHT_SIZE, "energy": 1000.0, **settings}
    return scene_parts.add_area_light(name, place, (0.0, 0.0, 0.0), **settings)


def hidden(ob):
    """`ob`, which the camera does not see."""
    ob.visible_camera = False
    return ob


def invisible(ob):
    """`ob`, which no ray meets that looks for light."""
    ob.visible_shadow = ob.visible_diffuse = ob.visible_glossy = False
    return ob


def floor_points():
    """Centers (N, 3) of the pixels on the floor, row 0 on top."""
    width, height = SIZE
    step = WIDTH / width
    x = (np.arange(width) + 0.5) * step - 0.5 * WIDTH
    y = 0.5 * height * step - (np.arange(height) + 0.5) * step
    return np.stack([*np.meshgrid(x, y), np.zeros((height, width))], axis=-1).reshape(-1, 3)


def seen_by_cycles(folder, light=LIGHT):
    """Share (N,) of the light that reaches the floor in Cycles."""
    settings = dict.fromkeys(("max_bounces", "light_sampling_threshold", "sample_clamp_direct"), 0)
    with pinned_pixel_filter(bpy.context.scene):
        channels = scene_parts.cycles_channels(folder, 1, ("combined", "diffuse_direct"), **settings)
    wanted = f"{pass_names()['diffuse_light']}.R"
    found = next(values for name, values in channels.items() if name.endswith(wanted)).ravel()
    power = 1000.0 / math.pi  # times cosine over pi, twice: at the light, whose area takes its radiance, and the floor
    to_light = light - floor_points()
    distance = np.linalg.norm(to_light, axis=-1)
    return found / (power * (to_light[:, 2] / distance) ** 2 / distance**2 / math.pi)


def seen_by_rays(occluders, light=LIGHT, name="Key"):
    """Share (N,) of light that reaches the floor, and a mask of the points where the size of the light, the place in
    the pixel or single precision does not matter."""
    points = floor_points()
    with open_tracer(occluders, embree_libraries()) as tracer:
        shares = []
        for x, y in ((0, 0), (3, 0), (-3, 0), (0, 3), (0, -3)):
            origins = points + [x * LIGHT_SIZE, y * LIGHT_SIZE, 1e-5]
            directions = light - origins
            distances = np.linalg.norm(directions, axis=1)
            directions /= distances[:, None]
            masks = np.full(len(points), tracer.occluders.mask_of(name), np.uint32)
            shares.append(tracer.transmittance(origins, directions, distances, masks))
    return shares[0], np.ptp(shares, axis=0) < 0.02


def assert_as_cycles(folder, note="", least=0.03, most_doubtful=0.35):
    """The occluders, whose shadow is that of Cycles; `note` is all that is warned of."""
    expected = seen_by_cycles(folder)
    occluders, warnings = scene_parts.collected_occluders()
    found, is_sure = seen_by_rays(occluders)
    assert is_sure.mean() > 1.0 - most_doubtful
    blocked = (1.0 - found)[is_sure]
    assert (blocked > 0.2).mean() >= least, "no shadow to compare"
    off = np.abs(found - expected)[is_sure]
    # A pixel of 1,536 at a silhouette may be on its other side.
    assert (off > 0.01).sum() <= 2, f"{(off > 0.01).sum()} pixels are off by up to {off.max():.3f}"
    assert len(warnings) == bool(note) and all(note in line for line in warnings), warnings
    return occluders


def pane(material):
    """A square in the way of half of the light, with a UV map."""
    return hidden(scene_parts.add_plane(material, size=2.0, name="Pane", location=(0.3, 0.2, 1.0)))


def checkered(name="Mask", interpolate="Closest", space="Non-Color"):
    """An image whose alpha and colors are two patterns of 4 x 4."""
    image = bpy.data.images.new(name, 4, 4, alpha=True)
    image.colorspace_settings.name = space
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (4, 4, 4)) / 255.0
    pixels[..., 3] = rng.integers(0, 3, (4, 4)) / 2.0
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.pack()
    return image


def textured(made, output, **settings):
    """The output of an image texture."""
    node = made.tree.nodes.new("ShaderNodeTexImage")
    node.image, node.interpolation = checkered(space=settings.pop("space", "Non-Color")), "Closest"
    if output == "Color":
        node.image.alpha_mode = "CHANNEL_PACKED"
    for key, value in settings.items():
        setattr(node, key, value)
    return node.outputs[output]


def clear(made, color=1.0):
    return made.shader("BsdfTransparent", Color=(color, color, color, 1.0))


def shown(make):
    made = Build("Pane")
    made.show(make(made))
    return made.material
