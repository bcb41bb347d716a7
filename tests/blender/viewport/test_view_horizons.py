"""Where specular lobes end in the viewport: at the horizon that numpy takes, as Cycles does."""

import itertools
from dataclasses import fields, replace
from unittest.mock import patch

import bpy
import gpu
import numpy as np
import pytest
import random_surfaces
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from random_surfaces import EYE
from uploaded_samples import upload_samples
from view_pictures import OpenView

from ltsh_addon import shading
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.viewport.light_texels import upload_lights
from ltsh_addon.blender.viewport.lighting import HorizonPass
from ltsh_addon.cycles import horizons
from ltsh_addon.cycles.horizons import SMALLEST_ANGLE, horizon_excess, lobe_selection_pmf, smooth_horizon_share
from ltsh_addon.cycles.light_tree import light_bounds_at, selection_pmf
from ltsh_addon.scene import SurfaceSamples

WIDTH, HEIGHT = 32, 16
SIZE = (80, 60)
RELATIVE, ABSOLUTE = 1e-3, 1e-5
# Between estimates that are this close, single precision may choose otherwise.
TIE = 1e-3


def read(texture):
    """The texture (H W, 4) in double precision, row 0 at the bottom."""
    values = texture.read()
    values.dimensions = texture.width * texture.height * 4
    return np.array(values, np.float32).astype(np.float64).reshape(-1, 4)


def chances_in_one_leaf(position, normal, lights, rows):
    """Those of lights, which the card takes for one leaf of the tree."""
    return selection_pmf(light_bounds_at(position, normal, lights, rows))


def shares(samples, lights, threshold=0.5):
    """Shares (P,) of the lobes that end at the smooth horizon; a mask (P,) of samples for which neither rounding can
    turn the choice at the `threshold` nor no light is between the horizons."""
    of_lobes = lobe_selection_pmf(samples, np.arange(len(samples)), False)
    with patch.object(horizons, "light_selection_pmf", chances_in_one_leaf):
        by_lobe, by_light = horizon_excess(samples, lights, of_lobes, is_quick=True)
    # Of what is between the horizons where they cross, one part may cancel the other.
    is_sum = np.abs(by_lobe + by_light) >= TIE * (np.abs(by_lobe) + np.abs(by_light))
    share = smooth_horizon_share(by_lobe, by_light)
    return share, is_sum & (np.abs(share - threshold) >= TIE), by_lobe + by_light != 1.0


def ended(samples, lights, threshold=0.5):
    """The samples as the viewport ends them: at the smooth horizon if its share is at least the `threshold`."""
    is_smooth = shares(samples, lights)[0] >= threshold
    normal = np.where(is_smooth[:, None], samples.smooth_normal, samples.geometric_normal)
    return replace(samples, geometric_normal=normal)


def chosen(kind, count, threshold):
    """What the card chose (P, 3) among random samples under `count` lights of `kind`, with samples and lights."""
    random = np.random.default_rng([len(kind), *map(ord, kind)])
    samples = random_surfaces.samples("tilted", WIDTH * HEIGHT, random)
    # Apart by as much as meshes are.
    bent = random_surfaces.unit(samples.smooth_normal + 0.1 * random.normal(size=(len(samples), 3)))
    samples = replace(samples, geometric_normal=random_surfaces.unit(random_surfaces.rounded(bent)))
    lights = tuple(random_surfaces.light(kind, number, random) for number in range(count))
    horizons = HorizonPass()
    texture = horizons.draw(upload_samples(samples, WIDTH), upload_lights(lights), (*EYE, 1.0), threshold)
    found = read(texture)[:, :3]
    return found, samples, lights


@pytest.mark.parametrize("threshold", [0.5, 0.2, 0.9])
def test_the_card_chooses_the_horizon_that_numpy_chooses(threshold):
    # The last ones are more than a draw call takes.
    kinds = {"near": 4, "horizon": 4, "huge": 4, "disk": 4, "polygon": 4, "tiny": 4, "plain": 110}
    results = with_graphics(lambda: [chosen(kind, count, threshold) for kind, count in kinds.items()])
    turned = 0
    for kind, (found, samples, lights) in zip(kinds, results, strict=True):
        expected = ended(samples, lights, threshold).geometric_normal
        _, is_certain, has_light = shares(samples, lights, threshold)
        sure = is_certain & has_light
        wrong = np.abs(found - expected).max(axis=1) > 1e-6
        assert not wrong[sure].any(), kind
        smooth = np.abs(expected - samples.smooth_normal).max(axis=1) < 1e-6
        turned += min(smooth[sure].sum(), (~smooth)[sure].sum())
    # Both choices are there.
    assert turned > 20


def low_poly_sphere():
    """A rough metal sphere of few faces with interpolated normals, lit from beside; its camera."""
    parts.empty_scene(*SIZE)
    material, _ = parts.bsdf_material("ShaderNodeBsdfAnisotropic", Color=(0.9, 0.8, 0.7, 1.0), Roughness=0.45)
    sphere = parts.add_sphere(material, radius=1.3, segments=12)
    sphere.rotation_euler = (0.3, 0.2, 0.1)
    parts.add_plane(parts.principled("Floor", Roughness=0.4)[0], size=8.0, location=(0.0, 0.0, -1.3))
    parts.add_area_light("Side", location=(2.5, 0.0, 1.0), rotation=(0.0, 1.2, 0.0), size=4.0, size_y=3.0)
    parts.add_area_light("Far", location=(-4.0, 1.5, 0.5), rotation=(0.0, -1.4, 0.2), size=0.8, size_y=0.5)
    camera = parts.add_camera((0.0, -4.0, 1.6), (1.2, 0.0, 0.0))
    bpy.context.view_layer.update()
    return camera


def samples_in(gbuffer, eye):
    """Samples and pixels of the surfaces in `gbuffer`."""
    textures = {field.name: getattr(gbuffer, field.name) for field in fields(gbuffer)}
    textures.pop("mask")
    read_textures = {name: read(one) for name, one in textures.items() if isinstance(one, gpu.types.GPUTexture)}
    pixel = np.flatnonzero(read_textures["position"][:, 3] > 0.0)
    at = {name: values[pixel] for name, values in read_textures.items()}
    normals = ("geometric_normal", "diffuse_normal", "smooth_normal")
    unit = {name: random_surfaces.unit(at[name][:, :3]) for name in ("normal", *normals)}
    return SurfaceSamples(
        position=at["position"][:, :3],
        view=random_surfaces.unit(eye - at["position"][:, :3]),
        roughness=at["normal"][:, 3],
        diffuse_albedo=at["base"][:, :3],
        ior=at["base"][:, 3],
        specular_f0=at["f0"][:, :3],
        specular_f90=at["f90"][:, :3],
        dielectric=at["dielectric"][:, :3],
        **unit,
    ), pixel


def drawn(camera):
    """Lights, samples, their pixels, and pictures (P, 3) by technique and pass."""
    with OpenView(camera, SIZE) as opened:
        keys = itertools.product(("ltc", "ltsh2", "ltsh4", "ltsh4c"), shading.PASSES)
        pictures = {key: opened.light(*key).reshape(-1, 3) for key in keys}
        samples, pixel = samples_in(opened.renderer._surfaces._gbuffer, opened.view.eye)
        return opened.mirror.lights, samples, pixel, {key: values[pixel] for key, values in pictures.items()}


@edits_with_graphics
def test_lobes_of_a_coarse_smooth_mesh_end_where_those_of_numpy_do(tmp_path):
    camera = low_poly_sphere()
    lights, samples, pixel, pictures = with_graphics(lambda: drawn(camera))
    numpys = ended(samples, lights)
    _, sure, _ = shares(samples, lights)
    assert sure.mean() > 0.99
    for (technique, name), found in pictures.items():
        expected = shading.shade(numpys, lights, technique, passes=(name,), workers=1, dtype=np.float64).combined
        times = (np.abs(found - expected) / (ABSOLUTE + RELATIVE * np.abs(expected))).max(axis=1)
        assert times[sure].max() <= 1.0, f"{technique}, {name}: {times[sure].max():.1f} times as far off as it may be"
    smooth = replace(samples, geometric_normal=samples.smooth_normal)
    plain = shading.shade(smooth, lights, "ltsh4", passes=("specular",), workers=1, dtype=np.float64).combined
    found = pictures["ltsh4", "specular"]
    wrong = np.abs(found - plain).max(axis=1) > 10.0 * (ABSOLUTE + RELATIVE * np.abs(plain).max(axis=1))
    # The horizon of the mesh makes a difference.
    assert wrong.sum() > 20
    # The samples of the viewport are those that Cycles takes of the saved file, but for edges of faces.
    path = parts.save(tmp_path / "sphere.blend", copy=True)
    found = extract_pixels(PixelJob(scene=path))
    row, column = np.divmod(found.film.pixel, SIZE[0])
    place = np.full(SIZE[0] * SIZE[1], -1)
    place[pixel] = np.arange(len(pixel))
    match = place[(SIZE[1] - 1 - row) * SIZE[0] + column]
    theirs, ours = found.samples.take(match >= 0), numpys.take(match[match >= 0])
    for name, share in (("smooth_normal", 0.97), ("normal", 0.95), ("diffuse_normal", 0.97), ("geometric_normal", 0.9)):
        apart = np.abs(getattr(theirs, name) - getattr(ours, name)).max(axis=1)
        assert (apart < 1e2 * SMALLEST_ANGLE).mean() > share, f"{name}: {(apart < 1e2 * SMALLEST_ANGLE).mean():.3f}"
