"""Samples as textures of a G-buffer, to draw light on them."""

from __future__ import annotations

import numpy as np

from ltsh_addon.blender.viewport.drawing import GBufferTextures, float_texture
from ltsh_addon.cycles import closures
from ltsh_addon.scene import SurfaceSamples


def upload_samples(samples: SurfaceSamples, width: int, pixel: np.ndarray | None = None) -> GBufferTextures:
    """Textures, `width` texels wide, of `samples` (P) at the texels `pixel` (P,), counted from the lower left.

    Without `pixel` the samples are stored in order.
    """
    pixel = np.arange(len(samples)) if pixel is None else np.asarray(pixel)
    height = -(-(int(pixel.max(initial=0)) + 1) // width)

    def texture(vectors, scalars):
        values = np.zeros((height * width, 4), np.float32)
        values[pixel, :3] = vectors
        values[pixel, 3] = scalars
        return float_texture(values.reshape(height, width, 4))

    dip = samples.specular_dip
    bumped = (samples.smooth_normal != samples.diffuse_normal).any()
    turned = bumped or (samples.diffuse_normal != samples.normal).any()
    fuzzy, velvet = samples.sheen_a > 0.0, samples.sheen_a < 0.0
    return GBufferTextures(
        has_sheen=bool(fuzzy.any()),
        has_bent=bool(((samples.ior < 1.0) & samples.dielectric.any(axis=1)).any()),
        position=texture(samples.position, 1.0 + samples.receiver),
        normal=texture(samples.normal, np.where(fuzzy, samples.sheen_b, samples.roughness)),
        base=texture(samples.diffuse_albedo, np.where(fuzzy, -samples.sheen_a, samples.ior)),
        f0=texture(samples.specular_f0, dip[:, 0]),
        f90=texture(samples.specular_f90, dip[:, 1]),
        dielectric=texture(samples.dielectric, dip[:, 2]),
        geometric_normal=texture(samples.geometric_normal, 0.0)
        if (samples.geometric_normal != samples.normal).any()
        else None,
        diffuse_normal=texture(samples.diffuse_normal, samples.bump_alpha2) if turned else None,
        smooth_normal=texture(samples.smooth_normal, 0.0) if bumped else None,
        tangent=texture(samples.tangent, samples.anisotropy) if samples.anisotropy.any() else None,
        rebound=texture(
            np.where(velvet[:, None], _albedo_of_velvet(samples)[:, None], samples.diffuse_rebound),
            np.where(velvet, samples.sheen_a, samples.diffuse_roughness),
        )
        if velvet.any() or samples.diffuse_roughness.any()
        else None,
        has_velvet=bool(velvet.any()),
    )


def _albedo_of_velvet(samples) -> np.ndarray:
    cosine = (samples.diffuse_normal * samples.view).sum(axis=1)
    return closures.velvet_albedo(cosine, np.maximum(-samples.sheen_a, 0.0))
