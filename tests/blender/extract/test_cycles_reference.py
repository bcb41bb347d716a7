"""The Cycles reference has no occlusion, no bias from settings of the file, and two independent halves."""

import bpy
import numpy as np
import scene_parts
from scene_parts import add_plane, add_sphere, principled

from ltsh_addon.blender.extract import pixels


def room(blocker=False):
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_area_light()
    add_plane(principled(Roughness=0.3)[0], size=12.0)
    if blocker:
        # Between light and plane, out of the camera's sight because it is not visible to it.
        add_plane(principled("Blocker")[0], size=3.0, name="Blocker", location=(0.3, 0.2, 1.0)).visible_camera = False
    return scene_parts.prepare()


def noise(halves):
    return np.abs(halves[0] - halves[1]).sum() / np.abs(halves[0] + halves[1]).sum()


def test_a_blocker_changes_nothing(tmp_path):
    free = scene_parts.reference(tmp_path, room(), 32)
    blocked = scene_parts.reference(tmp_path, room(blocker=True), 32)
    for lobe in ("specular", "diffuse"):
        assert free[lobe].min() >= 0.0 and free[lobe].max() > 0.0
        assert np.allclose(free[lobe], blocked[lobe], rtol=1e-5, atol=1e-7)


def test_settings_of_the_file_have_no_say(tmp_path):
    plain = scene_parts.reference(tmp_path, room(), 32)
    room()
    scene = bpy.context.scene
    scene.render.use_motion_blur = scene.render.use_multiview = True
    cycles = scene.cycles
    cycles.sample_clamp_direct, cycles.light_sampling_threshold, cycles.blur_glossy = 0.1, 0.5, 5.0
    cycles.use_adaptive_sampling, cycles.use_denoising, cycles.film_exposure = True, True, 3.0
    bpy.context.view_layer.samples = 1
    scene.camera.data.dof.use_dof = True
    bpy.data.objects["Plane"].shadow_terminator_shading_offset = 0.8
    prepared = scene_parts.prepare()
    changed = scene_parts.reference(tmp_path, prepared, 32)
    for lobe in plain:
        assert np.allclose(plain[lobe], changed[lobe], rtol=1e-5, atol=1e-7)
    for word in ("motion blur", "stereoscopy", "depth of field", "shadow terminator"):
        assert sum(word in line for line in prepared[3]) == 1, prepared[3]


def test_halves_differ_and_agree(tmp_path):
    prepared = room()
    coarse = scene_parts.reference(tmp_path, prepared, 32)["specular"]
    fine = scene_parts.reference(tmp_path, prepared, 512)["specular"]
    assert noise(coarse) > 2.0 * noise(fine) > 0.0
    truth = scene_parts.reference(tmp_path, prepared, 4096)["specular"].mean(axis=0)
    errors = [half - truth for half in coarse]
    bright = truth > 0.05 * truth.max()
    correlation = np.corrcoef(errors[0][..., 0][bright[..., 0]], errors[1][..., 0][bright[..., 0]])[0, 1]
    # About 150 bright pixels: chance alone gives 0.08.
    assert np.count_nonzero(bright[..., 0]) > 60 and abs(correlation) < 0.3


def test_chunks_add_up_to_one_render(tmp_path, monkeypatch):
    prepared = room()
    chunked = scene_parts.reference(tmp_path, prepared, 128)
    monkeypatch.setattr(pixels, "FIRST_CHUNK", 64)
    whole = scene_parts.reference(tmp_path, prepared, 128)
    for lobe in whole:
        # The same samples, added in another order.
        assert np.allclose(chunked[lobe], whole[lobe], rtol=1e-4, atol=1e-6 * whole[lobe].max())


def test_one_object_behind_another_stays_hidden(tmp_path):
    """Meshes are invisible to light but not to the camera."""
    scene_parts.empty_scene()
    scene_parts.add_top_camera()
    scene_parts.add_area_light(location=(0.3, 0.2, 4.0))
    add_sphere(principled("Ball", Base_Color=(1.0, 0.0, 0.0, 1.0))[0], radius=2.5)
    add_plane(principled("Floor", Base_Color=(0.0, 1.0, 0.0, 1.0))[0], location=(0.0, 0.0, -3.0))
    diffuse = scene_parts.reference(tmp_path, scene_parts.prepare(), 16)["diffuse"]
    center, corner = diffuse[:, 8, 12], diffuse[:, 0, 0]
    assert center[:, 0].min() > 0.0 and not center[:, 1:].any()
    assert corner[:, 1].min() > 0.0 and not corner[:, 0].any()
