"""Shadows of a view: the share of each light that its pixels see, by the rays and the occluders of pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import gpu
import numpy as np

from ...scene import PASSES, AreaLight, Film, SurfaceSamples
from ...visibility import Occluders, Tracer, open_tracer, visible_shares
from ..process.blender_process import embree_libraries
from .surfaces import View
from .textures import GBufferTextures, read_texture

# Of the shares of all lights, in half precision, on the card.
MOST_BYTES = 1 << 30
_SHARE_BYTES = 4


class ShadowRays:
    """Traces the shares of lights that the pixels of G-buffers see past `occluders`, with at most `rays` for each."""

    def __init__(self, occluders: Occluders, rays: int):
        self._occluders, self._rays = occluders, rays
        self._tracer: Tracer | None = None
        self._origin = np.zeros(3)
        self.seconds, self.traced = 0.0, 0
        # By pass: squares of the light that pixels reflect and of its standard deviation, added up over all calls.
        self._power = {name: np.zeros(2) for name in PASSES}
        self.description = ""

    def shares(self, gbuffer: GBufferTextures, view: View, lights: Sequence[AreaLight]) -> gpu.types.GPUTexture | None:
        """A texture with a layer for each of `lights`, around the origin of `view`: specular and diffuse share.

        None where there is nothing to see. Raises SceneError where Embree is not there.
        """
        start = time.perf_counter()
        samples, pixel = gbuffer_samples(gbuffer, view)
        if not len(samples) or not lights:
            return None
        width, height = gbuffer.size
        found = visible_shares(samples, lights, self._tracer_at(view.origin), rays=self._rays,
                               film=Film(width, height, pixel))  # fmt: skip
        values = np.ones((len(lights), height * width, len(PASSES)), np.float32)
        for index, name in enumerate(PASSES):
            values[:, pixel, index] = getattr(found, name)
            self._power[name] += [
                np.square(part[name], dtype=np.float64).sum() for part in (found.radiance, found.deviation)
            ]
        buffer = gpu.types.Buffer("FLOAT", values.size, values.reshape(-1))
        texture = gpu.types.GPUTexture((width, height), layers=len(lights), format="RG16F", data=buffer)
        self.seconds += time.perf_counter() - start
        self.traced += found.rays
        return texture

    def noise(self, samples: int) -> dict[str, float]:
        """Estimated relative L2 error by pass of the mean of `samples` pictures."""
        return {
            name: float(np.sqrt(variance / max(power, 1e-30) / samples))
            for name, (power, variance) in self._power.items()
        }

    def _tracer_at(self, origin: np.ndarray) -> Tracer:
        """The tracer of the occluders around `origin` (3,): single precision is best near it."""
        if self._tracer is None or not np.array_equal(origin, self._origin):
            matrices = np.array(self._occluders.matrices, np.float64)
            matrices[:, :, 3] -= origin
            self._tracer = open_tracer(replace(self._occluders, matrices=matrices), embree_libraries())
            self._origin, self.description = np.array(origin), self._tracer.description
        return self._tracer


def too_many(lights: int, size: tuple[int, int]) -> str:
    """What to say where the shares of so many lights do not fit; empty where they do."""
    needed = lights * size[0] * size[1] * _SHARE_BYTES
    if needed <= MOST_BYTES:
        return ""
    return f"shadows are not drawn: those of {lights} lights need {needed / 2**30:.1f} GiB of graphics memory"


def gbuffer_samples(gbuffer: GBufferTextures, view: View) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples (P) that a G-buffer holds, around the origin of `view`, and their texels, from the lower left."""
    position = _texels(gbuffer.position)
    pixel = np.flatnonzero(position[:, 3] > 0.0)
    position = position[pixel]
    normal, base, f0, f90, dielectric = (
        _texels(texture)[pixel]
        for texture in (gbuffer.normal, gbuffer.base, gbuffer.f0, gbuffer.f90, gbuffer.dielectric)
    )
    further = {
        name: None if getattr(gbuffer, name) is None else _texels(getattr(gbuffer, name))[pixel]
        for name in ("diffuse_normal", "smooth_normal", "geometric_normal")
    }
    bent = further["diffuse_normal"]
    return SurfaceSamples(
        position=position[:, :3],
        view=np.broadcast_to(view.eye, (len(pixel), 3)) if view.is_parallel else _unit(view.eye - position[:, :3]),
        normal=_unit(normal),
        diffuse_normal=_unit(normal if bent is None else bent),
        roughness=normal[:, 3],
        specular_f0=f0[:, :3],
        specular_f90=f90[:, :3],
        dielectric=dielectric[:, :3],
        ior=base[:, 3],
        diffuse_albedo=base[:, :3],
        geometric_normal=_unit_or_none(further["geometric_normal"]),
        smooth_normal=_unit_or_none(further["smooth_normal"]),
        bump_alpha2=None if bent is None else bent[:, 3],
        specular_dip=np.stack([f0[:, 3], f90[:, 3], dielectric[:, 3]], axis=1),
        receiver=np.rint(position[:, 3]).astype(np.int64) - 1,
    ), pixel


def _texels(texture: gpu.types.GPUTexture) -> np.ndarray:
    """The texels (H W, 4) in double precision."""
    return read_texture(texture).reshape(-1, 4).astype(np.float64)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors of the first three columns; a zero vector stays one."""
    vectors = vectors[:, :3]
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _unit_or_none(vectors: np.ndarray | None) -> np.ndarray | None:
    return None if vectors is None else _unit(vectors)
