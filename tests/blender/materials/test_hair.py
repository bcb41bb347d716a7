"""Hair is shaded as Cycles shades it: as curves or particles, as tubes or as ribbons that pretend to be round."""

import bpy
import numpy as np
import pytest
import scene_parts

from ltsh_addon.pipeline import PictureOptions, compare_scene


def add_curves(material):
    """40 bent hairs of 8 cm diameter."""
    generator, count, along = np.random.default_rng(1), 40, np.linspace(0.0, 1.0, 5)[None, :, None]
    roots = generator.uniform(-1.0, 1.0, (count, 1, 3)) * (1.0, 0.3, 0.0)
    points = roots + along * (0.0, 0.0, 1.3) + 0.4 * along * generator.normal(size=(count, 1, 3))
    hair = bpy.data.hair_curves.new("Fur")
    hair.add_curves([5] * count)
    hair.points.foreach_set("position", points.astype(np.float32).ravel())
    hair.attributes.new("radius", "FLOAT", "POINT").data.foreach_set("value", np.full(5 * count, 0.04, np.float32))
    hair.materials.append(material)
    scene_parts.link(bpy.data.objects.new("Fur", hair))


def add_particles(material):
    """Hair on a plane that is itself not rendered."""
    emitter = scene_parts.add_plane(material, size=2.0)
    emitter.modifiers.new("Hair", "PARTICLE_SYSTEM")
    settings = emitter.particle_systems[0].settings
    settings.type, settings.count, settings.hair_length = "HAIR", 60, 1.0
    settings.root_radius, settings.radius_scale = 8.0, 0.01
    emitter.show_instancer_for_render = False


@pytest.mark.parametrize("shape", ["RIBBONS", "THICK"])
@pytest.mark.parametrize("add_hair", [add_curves, add_particles])
def test_hair_is_shaded_as_in_cycles(tmp_path, add_hair, shape):
    scene = scene_parts.empty_scene(64, 48)
    scene_parts.add_camera((0.0, -3.0, 1.0), (1.3, 0.0, 0.0))
    scene_parts.add_area_light(location=(1.0, -1.0, 2.5), rotation=(0.5, 0.4, 0.0))
    scene.cycles_curves.shape = shape
    add_hair(scene_parts.principled(Roughness=0.4, Metallic=0.5)[0])
    path = tmp_path / "hair.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    report = compare_scene(PictureOptions(path, tmp_path / "out", techniques=("reference",), cycles_samples=512))
    assert report["warnings"] == [] and report["surface_samples"] > 1000
    for figures in report["passes"].values():
        found = figures["techniques"]["reference"]["against_cycles"]
        # Noise is taken out; what is left are single pixels at the rims, where Cycles' rays stray by a filter's cell.
        assert found["unbiased_relative_error"] < 0.006 and abs(found["bias"]) < 1e-3
