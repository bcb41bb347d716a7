"""The surface points of a picture as textures: what `scene.SurfaceSamples` holds, for the lighting pass.

Each is RGBA32F, one texel per pixel, row 0 at the bottom:

    position          world position in m; w = 1 + receiver, 0 where there is no surface
    normal            shading normal of the specular lobe; w = roughness
    base              diffuse albedo; w = index of refraction of the dielectric lobe
    f0                specular_f0; w = red of specular_dip
    f90               specular_f90; w = green of specular_dip
    dielectric        weight of the dielectric lobe; w = blue of specular_dip
    geometric_normal  may be None, where it is `normal` all over; w is not read
    diffuse_normal    may be None, where it is `normal` all over; w = bump_alpha2
    smooth_normal     may be None, where it is `diffuse_normal` all over; w is not read
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import gpu
import numpy as np

from ...scene import SurfaceSamples

# Field of `GBufferTextures` by its name in shaders.
SAMPLERS = {
    "positions": "position",
    "normals": "normal",
    "bases": "base",
    "f0s": "f0",
    "f90s": "f90",
    "dielectric_weights": "dielectric",
    "geometric_normals": "geometric_normal",
    "diffuse_normals": "diffuse_normal",
    "smooth_normals": "smooth_normal",
}


@dataclass(frozen=True)
class GBufferTextures:
    """Textures of one size; see the module's docstring."""

    position: gpu.types.GPUTexture
    normal: gpu.types.GPUTexture
    base: gpu.types.GPUTexture
    f0: gpu.types.GPUTexture
    f90: gpu.types.GPUTexture
    dielectric: gpu.types.GPUTexture
    geometric_normal: gpu.types.GPUTexture | None = None
    diffuse_normal: gpu.types.GPUTexture | None = None
    smooth_normal: gpu.types.GPUTexture | None = None

    def __post_init__(self):
        if self.diffuse_normal is None and self.smooth_normal is not None:
            raise ValueError("G-buffer: smooth_normal without diffuse_normal, expected both")
        sizes = {
            field.name: (texture.width, texture.height)
            for field in fields(self)
            if (texture := getattr(self, field.name)) is not None
        }
        if len(set(sizes.values())) != 1:
            raise ValueError(f"G-buffer: textures have the sizes {sizes}, expected one size for all")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.position.width, self.position.height


def float_texture(values: np.ndarray) -> gpu.types.GPUTexture:
    """RGBA32F texture of values (H, W, 4), or an array texture of values (N, H, W, 4)."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    height, width = values.shape[-3:-1]
    buffer = gpu.types.Buffer("FLOAT", values.size, values.reshape(-1))
    layers = values.shape[0] if values.ndim == 4 else 0
    return gpu.types.GPUTexture((width, height), layers=layers, format="RGBA32F", data=buffer)


def upload_samples(samples: SurfaceSamples, width: int, pixel: np.ndarray | None = None) -> GBufferTextures:
    """Textures of `samples` (P), `width` wide, at `pixel` (P,), counted from the lower left; left out: in order."""
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
    return GBufferTextures(
        position=texture(samples.position, 1.0 + samples.receiver),
        normal=texture(samples.normal, samples.roughness),
        base=texture(samples.diffuse_albedo, samples.ior),
        f0=texture(samples.specular_f0, dip[:, 0]),
        f90=texture(samples.specular_f90, dip[:, 1]),
        dielectric=texture(samples.dielectric, dip[:, 2]),
        geometric_normal=texture(samples.geometric_normal, 0.0)
        if (samples.geometric_normal != samples.normal).any()
        else None,
        diffuse_normal=texture(samples.diffuse_normal, samples.bump_alpha2) if turned else None,
        smooth_normal=texture(samples.smooth_normal, 0.0) if bumped else None,
    )
