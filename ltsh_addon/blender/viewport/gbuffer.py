"""The surface points of a picture: as textures, and as samples."""

from __future__ import annotations

from dataclasses import dataclass, fields

import gpu
import numpy as np

from ...scene import SurfaceSamples
from .drawing import ViewCamera, read_texture

# Fields of `GBufferTextures` by their names in shaders.
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
    "tangents": "tangent",
    "rebounds": "rebound",
}
# Fields of `VisibilityGrid` by their names in shaders.
VISIBILITY_SAMPLERS = {"visibility": "visibility", "grid_positions": "positions"}


@dataclass(frozen=True)
class VisibilityGrid:
    """The visible fraction of each light at the points of a picture. Other pictures of the same surfaces may use it."""

    visibility: gpu.types.GPUTexture  # RG, a layer for each light: the specular and the diffuse fraction
    positions: gpu.types.GPUTexture  # of the points, relative to the view's origin; w = 0 where there is no surface
    projection: np.ndarray  # (4, 4) to the clip space that the texels fill
    sources: tuple = ()  # of each layer: a layer whose source is the same object is the same


@dataclass(frozen=True)
class GBufferTextures:
    """The surface points of a picture as textures of one size, with the fields of `scene.SurfaceSamples`.

    RGBA32F, one texel per pixel, row 0 at the bottom. A texture may be None where its default holds everywhere.
    """

    position: gpu.types.GPUTexture  # in the world, m; w = 1 + receiver, 0 where there is no surface
    normal: gpu.types.GPUTexture  # shading normal of the specular lobe; w = roughness
    base: gpu.types.GPUTexture  # diffuse albedo; w = index of refraction of the dielectric lobe
    f0: gpu.types.GPUTexture  # specular_f0; w = red of specular_dip
    f90: gpu.types.GPUTexture  # specular_f90; w = green of specular_dip
    dielectric: gpu.types.GPUTexture  # weight of the dielectric lobe; w = blue of specular_dip
    geometric_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `normal`
    diffuse_normal: gpu.types.GPUTexture | None = None  # w = bump_alpha2; None: `normal`, bump_alpha2 0
    smooth_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `diffuse_normal`
    tangent: gpu.types.GPUTexture | None = None  # of anisotropic lobes; w = anisotropy; None: 0
    rebound: gpu.types.GPUTexture | None = None  # diffuse_rebound; w = diffuse_roughness; None: 0
    visibility: VisibilityGrid | None = None  # None: every light is seen whole
    mask: gpu.types.GPUTexture | None = None  # depth buffer, 0 where there is no surface; None: all pixels are lit
    has_sheen: bool = False  # there are texels of sheen: base.w = -sheen_a, normal.w = sheen_b
    has_velvet: bool = False  # there are texels of velvet: rebound.w = -sigma, rebound.rgb = albedo
    has_bent: bool = False  # there are dielectrics with an index of refraction between 0 and 1

    def __post_init__(self):
        if self.diffuse_normal is None and self.smooth_normal is not None:
            raise ValueError("G-buffer: smooth_normal without diffuse_normal, expected both")
        sizes = {
            field.name: (texture.width, texture.height)
            for field in fields(self)
            if not field.name.startswith("has_")
            and field.name != "visibility"
            and (texture := getattr(self, field.name)) is not None
        }
        if len(set(sizes.values())) != 1:
            raise ValueError(f"G-buffer: textures have the sizes {sizes}, expected one size for all")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.position.width, self.position.height


def every_texel(texture: gpu.types.GPUTexture, step: int) -> np.ndarray:
    """Every `step`-th texel (H, W, 4) in either direction."""
    return np.ascontiguousarray(read_texture(texture)[step // 2 :: step, step // 2 :: step])


def gbuffer_texels(gbuffer: GBufferTextures, step: int = 1) -> dict[str, np.ndarray]:
    """Every `step`-th texel of a G-buffer, (H, W, 4) by name of the texture."""
    textures = {name: getattr(gbuffer, name) for name in (*_REQUIRED, *_OPTIONAL)}
    return {name: every_texel(texture, step) for name, texture in textures.items() if texture is not None}


_REQUIRED = ("position", "normal", "base", "f0", "f90", "dielectric")
_OPTIONAL = ("diffuse_normal", "smooth_normal", "geometric_normal", "tangent", "rebound")


def gbuffer_samples(gbuffer: GBufferTextures, view: ViewCamera) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) of a G-buffer, relative to the origin of `view`, and their texels (P,), counted from the lower
    left."""
    return samples_of_texels(gbuffer_texels(gbuffer), view)


def samples_of_texels(texels: dict[str, np.ndarray], view: ViewCamera) -> tuple[SurfaceSamples, np.ndarray]:
    pixel = np.flatnonzero(texels["position"][:, :, 3] > 0.0)
    values = {name: rows.reshape(-1, 4)[pixel].astype(np.float64) for name, rows in texels.items()}
    position, normal, base, f0, f90, dielectric = (values[name] for name in _REQUIRED)
    further = {name: values.get(name) for name in _OPTIONAL}
    bent, fuzzy = further["diffuse_normal"], base[:, 3] < 0.0
    tangent, rebound = further["tangent"], further["rebound"]
    return SurfaceSamples(
        position=position[:, :3],
        view=np.broadcast_to(view.eye, (len(pixel), 3)) if view.is_parallel else unit_xyz(view.eye - position[:, :3]),
        normal=unit_xyz(normal),
        diffuse_normal=unit_xyz(normal if bent is None else bent),
        roughness=np.where(fuzzy, 1.0, normal[:, 3]),
        specular_f0=f0[:, :3],
        specular_f90=f90[:, :3],
        dielectric=dielectric[:, :3],
        ior=np.where(fuzzy, 1.5, base[:, 3]),
        sheen_a=np.where(fuzzy, -base[:, 3], 0.0 if rebound is None else np.minimum(rebound[:, 3], 0.0)),
        sheen_b=np.where(fuzzy, normal[:, 3], 0.0),
        diffuse_albedo=base[:, :3],
        diffuse_roughness=None if rebound is None else np.maximum(rebound[:, 3], 0.0),
        diffuse_rebound=None if rebound is None else rebound[:, :3],
        geometric_normal=_unit_or_none(further["geometric_normal"]),
        smooth_normal=_unit_or_none(further["smooth_normal"]),
        bump_alpha2=None if bent is None else bent[:, 3],
        specular_dip=np.stack([f0[:, 3], f90[:, 3], dielectric[:, 3]], axis=1),
        receiver=np.rint(position[:, 3]).astype(np.int64) - 1,
        anisotropy=None if tangent is None else tangent[:, 3],
        tangent=None if tangent is None else tangent[:, :3],
    ), pixel


def unit_xyz(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of the first three columns; zero vectors stay zero."""
    vectors = vectors[:, :3]
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _unit_or_none(vectors: np.ndarray | None) -> np.ndarray | None:
    return None if vectors is None else unit_xyz(vectors)
