"""Hits, and the quantities that they have in one slot of the lobes' AOVs. Needs no bpy."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from . import reflectance
from .aovs import LOBE_AOVS, LOBE_KINDS
from .shading_normals import unit, valid_specular_normal

# Below this weight Cycles drops a closure.
SMALLEST_WEIGHT = 1e-5


@dataclass(frozen=True)
class Hits:
    """What each of P hits has once."""

    position: np.ndarray  # (P, 3)
    view: np.ndarray  # (P, 3)
    smooth_normal: np.ndarray  # (P, 3)
    true_normal: np.ndarray  # (P, 3)
    corrected: np.ndarray  # (P,) bool: specular normals are bent
    receiver: np.ndarray  # (P,) integers
    diffuse_albedo: np.ndarray | None  # (P, 3) of all lobes together; None: as estimated from each lobe's own

    def take(self, index) -> Hits:
        """The hits at `index`."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return Hits(**{name: None if value is None else value[index] for name, value in values.items()})


class LobeSlot:
    """The hits (Q,) that have a lobe in one slot, and its quantities there."""

    def __init__(self, hits: Hits, lobe, index, weight):
        self.lobe, self.index, self.weight = lobe, index, weight
        self.hits = hits.take(index)
        self.kind = np.rint(lobe["kind"][index]).astype(int)
        self.normal = self._normal("normal")
        self.specular_normal = self._bent(self.normal)
        self.roughness = np.clip(self.value("roughness", 1.0), 0.0, 1.0)

    def value(self, name: str, default=None) -> np.ndarray:
        """The quantity `name`, or what changes nothing, or `default` where there is no such value."""
        if name in self.lobe:
            return self.lobe[name][self.index]
        kind, neutral = LOBE_AOVS[name]
        neutral = default if neutral is None else neutral
        return np.broadcast_to(np.float64(neutral), (len(self.index), 3) if kind == "COLOR" else (len(self.index),))

    def has(self, name: str) -> bool:
        """True where some sample has more than a vanishing `name`."""
        return name in self.lobe and bool((self.value(name) > SMALLEST_WEIGHT).any())

    def of(self, kind: str) -> np.ndarray:
        """Mask (Q, 1) of a kind of lobe."""
        return (self.kind == LOBE_KINDS[kind])[:, None]

    def _normal(self, name):
        normal = unit(self.value(name))
        return np.where(np.any(normal != 0.0, axis=-1, keepdims=True), normal, self.hits.smooth_normal)

    def _bent(self, normal):
        bent = valid_specular_normal(normal, self.hits.true_normal, self.hits.view)
        return np.where(self.hits.corrected[:, None], bent, normal)

    def coat_normal(self) -> np.ndarray:
        """Shading normal (Q, 3) of the coat."""
        return self._bent(self._normal("coat_normal"))

    def sheen_normal(self) -> np.ndarray:
        """Shading normal (Q, 3) of the sheen: that of the base, and under a coat partly that of the coat."""
        coat = np.clip(self.value("coat_weight"), 0.0, 1.0)[:, None]
        return unit((1.0 - coat) * self.normal + coat * self.coat_normal())

    def cosine(self, normal) -> np.ndarray:
        """Cosine (Q,) of the view."""
        return np.clip(np.sum(normal * self.hits.view, axis=-1), 0.0, 1.0)

    @cached_property
    def color(self) -> np.ndarray:
        """(Q, 3), never negative."""
        return np.maximum(self.value("color", 0.0), 0.0)

    @cached_property
    def metallic(self) -> np.ndarray:
        """Share (Q,) of the metal."""
        clipped = np.clip(self.value("metallic"), 0.0, 1.0)
        return np.where(self.of("metal")[:, 0], 1.0, np.where(self.of("principled")[:, 0], clipped, 0.0))

    @cached_property
    def transmission(self) -> np.ndarray:
        """Share (Q,) of the transmission in what is no metal."""
        return np.where(self.of("principled")[:, 0], np.clip(self.value("transmission"), 0.0, 1.0), 0.0)

    @cached_property
    def albedos(self) -> tuple[np.ndarray, np.ndarray]:
        """Directional and average albedo (Q,) of the lobe without Fresnel."""
        return reflectance.albedos(self.roughness, self.cosine(self.specular_normal))

    def scattered(self, mean: np.ndarray) -> np.ndarray:
        """Factor (Q, 3) of multiple scattering for the mean reflectance `mean` (Q, 3); 1 where there is none."""
        if not self.has("multiple_scattering"):
            return np.ones_like(mean)
        factor = reflectance.multiple_scattering(mean, *self.albedos)
        return np.where((self.value("multiple_scattering") > 0.5)[:, None], factor, 1.0)
