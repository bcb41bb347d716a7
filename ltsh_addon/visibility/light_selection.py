"""Who chooses a shadow ray in Cycles, the light or the lobes of the surface."""

from collections.abc import Sequence

import numpy as np

from ..cycles.horizons import lobe_density, lobe_selection_pmf
from ..cycles.light_tree import light_selection_pmf, light_tree_rows
from ..scene import Light, SurfaceSamples


class LightSelection:
    """How likely Cycles chooses directions from samples (P) by `lights` (L) and by the lobes of the surface.

    Who chose a ray decides what it meets. Rays that the light chose start above a curved surface, and are not blocked
    if the light casts no shadow. Rays that the surface chose start at the surface, and are always blocked.
    """

    def __init__(self, samples: SurfaceSamples, lights: Sequence[Light], is_baked: bool):
        self._samples, self._lights, self._is_baked = samples, tuple(lights), is_baked
        self._first = None

    def _prepare(self):
        """Compute the chances on first use; most scenes never need them."""
        samples = self._samples
        moved = np.any(samples.position[1:] != samples.position[:-1], axis=1)
        # The samples of one hit are consecutive.
        self._hit = np.concatenate([np.zeros(min(len(samples), 1), int), np.cumsum(moved)])
        self._count = np.bincount(self._hit)
        self._first = np.cumsum(self._count) - self._count
        self._lobes = lobe_selection_pmf(samples, self._hit, is_baked=False)
        self._light_selection_pmf = np.full((len(self._lights), len(samples)), np.nan, np.float32)
        self._rows = light_tree_rows(self._lights)

    def bsdf_share(self, name: str, number: int, index, directions, solid_angle) -> np.ndarray:
        """Share (R,) of the light of light `number` that a pass gets because the surface chose the unit directions
        (3, R), seen from the samples `index` (R,). The light has the `solid_angle` (R,) in sr."""
        if self._first is None:
            self._prepare()
        by_light = self._pmf(number, index) / np.maximum(solid_angle, 1e-12)
        bsdf_share = self._density(name, index, directions.T.astype(np.float64))
        return (bsdf_share**2 / np.maximum(bsdf_share**2 + by_light**2, 1e-30)).astype(np.float32)

    def _pmf(self, number, index):
        unknown = np.unique(index[np.isnan(self._light_selection_pmf[number, index])])
        if len(unknown):
            position, normal = self._samples.position[unknown], self._samples.smooth_normal[unknown]
            self._light_selection_pmf[:, unknown] = light_selection_pmf(position, normal, self._lights, self._rows)
        return self._light_selection_pmf[number, index]

    def _density(self, name, index, directions):
        """Probability density (R,) per sr with which the lobes of a hit choose the directions (R, 3)."""
        hit, density = self._hit[index], np.zeros(len(index))
        for number in range(self._count[hit].max(initial=0)):
            here = np.flatnonzero(self._count[hit] > number)
            sample = self._first[hit[here]] + number
            specular, diffuse = self._lobes[:, sample]
            # A bake of one pass chooses by the lobes of that pass alone.
            if self._is_baked:
                sums = np.bincount(self._hit, weights=self._lobes[int(name == "diffuse")])
                whole = np.maximum(sums[hit[here]], 1e-12)
                specular, diffuse = (
                    specular / whole if name == "specular" else 0.0 * specular,
                    diffuse / whole if name == "diffuse" else 0.0 * diffuse,
                )
            chosen = lobe_density(self._samples.take(sample), directions[here, None])[:, 0]
            density[here] += specular * chosen
            cosine = np.einsum("rk,rk->r", directions[here], self._samples.diffuse_normal[sample])
            density[here] += diffuse * np.maximum(cosine, 0.0) / np.pi
        return density
