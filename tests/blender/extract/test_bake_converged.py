"""A bake beside Cycles' own, converged: what is left is the technique."""

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save, start
from scene_parts import add_plane, principled


def metal_plane():
    add_plane(principled("Metal", Metallic=1.0, Roughness=0.5, Base_Color=(0.9, 0.6, 0.3, 1.0))[0], size=3.0)


def dielectric_sphere():
    """With four texels to the side of a face: Cycles spreads its samples over a texel but keeps them on one triangle,
    which moves them by up to 1 % of the light at two texels to a side."""
    material = principled("Dielectric", Roughness=0.6, Base_Color=(0.3, 0.5, 0.7, 1.0))[0]
    scene_parts.add_sphere(material, radius=0.7, segments=32)


@pytest.mark.parametrize(
    ("build", "size", "passes"), [(metal_plane, 64, ("specular",)), (dielectric_sphere, 128, ("specular", "diffuse"))]
)
def test_reference_and_ltsh4_are_near_a_converged_bake(tmp_path, build, size, passes):
    start(camera=(0.0, -2.0, 4.0))
    bpy.data.objects["Key"].location.z = 2.0
    build()
    _, files = baked(
        save(tmp_path),
        tmp_path / "out",
        techniques=("reference", "ltsh4"),
        cycles_samples=128,
        error=True,
        size=(size, size),
    )
    (layers,) = files.values()
    for pass_name in passes:
        cycles = layers[f"cycles.{pass_name}"].max(axis=-1)
        # Where there is light: relative errors of black mean nothing.
        lit = cycles > 0.05 * cycles.max()
        assert lit.sum() > 1000
        for name, limit in (("reference", 5e-3), ("ltsh4", 1.5e-2)):
            error = np.abs(layers[f"error_{name}.{pass_name}"]).max(axis=-1)[lit] / cycles[lit]
            assert np.median(error) < limit, (pass_name, name, np.median(error))
