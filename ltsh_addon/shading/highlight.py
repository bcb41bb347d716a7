"""Where a light must be for its highlight to be at a given pixel: the peak of its specular radiance in the picture."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..lobes.polygon import normal_frames
from ..scene import Light, SurfaceSamples
from .integrator import shade

# STENCIL: the cursor and the pixels around it, in steps. Their radiance is fitted by a quadratic.
STENCIL = np.stack(np.meshgrid([0.0, -1.0, 1.0], [0.0, -1.0, 1.0]), axis=-1).reshape(-1, 2)
_FIT = np.linalg.pinv(np.stack([np.ones(9), *STENCIL.T, *(0.5 * STENCIL**2).T, STENCIL.prod(axis=1)], axis=-1))
# STEPS: of Newton's method from each start. NEAR: steps of the stencil from the cursor to the peak at which it ends.
STEPS, NEAR = 5, 0.05
# FLAT: a gradient, per step of the stencil, of a radiance that hardly varies around the cursor: large lights in smooth
# surfaces.
FLAT = 5e-4
# PROBE: the angle of the differences, relative to that of the lobe; LARGEST: of a step.
PROBE, LARGEST = 0.1, 0.8
# RIGID: how far a matrix may be from a rotation. SPATIAL: what moves with samples.
RIGID, SPATIAL = 1e-5, (
    "position", "view", "normal", "diffuse_normal", "geometric_normal", "smooth_normal", "tangent",
)  # fmt: skip
# BRIGHTER: by how much a pixel around may be brighter than the cursor. STRICT: with more than this at a sample there is
# a search: what is between samples may be a little brighter than they are. GOOD: with less, it ends.
BRIGHTER, STRICT, GOOD = 0.01, 0.006, 0.003
# Where Newton's method fails, directions around the mirrored view are tried: on circles at ANGLES rad, TURNS on each,
# by the first samples and every THINNED-th of the others. Searches from the best ones with at least DIM of the radiance
# of the mirrored view take moves of at most REACH times the lobe, which a move that leads to no better place makes
# SHORTER.
ANGLES, TURNS, THINNED, DIM = (0.04, 0.12, 0.25, 0.5, 0.8), 8, 4, 0.1
REACH, SHORTER = 0.5, 0.3
# HALF: of the time of a search. Where Newton's method took more, no directions around are tried.
HALF = 0.5
# MOVES: the moves (M, 2) that are looked at, in units of the longest.
MOVES = np.concatenate([
    radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    for radius in (0.05, 0.15, 0.3, 0.5, 0.75, 1.0) for turns in [2.0 * np.pi * np.arange(24) / 24]
])  # fmt: skip


@dataclass(frozen=True)
class SearchEffort:
    """How long a place is searched where Newton's method fails."""

    starts: int
    moves: int  # from each start
    seconds: float = np.inf  # of processor time, after which no step begins


QUICK, THOROUGH = SearchEffort(2, 3), SearchEffort(4, 12)


@dataclass(frozen=True)
class MovedLight:
    """A light that may be elsewhere."""

    matrix_at: Callable[[np.ndarray], np.ndarray]  # (4, 4) of it in a unit direction (3,) from the cursor
    at: Callable[[np.ndarray], Light]  # it at such a matrix


@dataclass(frozen=True)
class HighlightPlace:
    """Where a light is for a highlight."""

    direction: np.ndarray  # (3,) unit, from the point to the light
    excess: float  # by how much a sample is brighter than the cursor; inf: no light arrives there

    @property
    def is_peak(self) -> bool:
        """True if the highlight is at the cursor."""
        return self.excess <= BRIGHTER


def mirrored(view: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The direction (..., 3) from which a mirror with this `normal` shows light along `view`, both (..., 3), unit."""
    return 2.0 * (view * normal).sum(axis=-1, keepdims=True) * normal - view


def place_for_highlight(
    samples: SurfaceSamples, light: MovedLight, technique="ltsh4c", has_stencil=True, effort=QUICK
) -> HighlightPlace:
    """The direction for which the specular radiance of a light has its peak at the first one of the `samples`; no other
    may be brighter.

    If the first nine are those of the pixels of STENCIL: Newton's method for the gradient of the logarithm of the
    radiance, which is 0 at the peak, from the mirrored view on: of rough and curved surfaces the peak is elsewhere.
    Where that fails, the directions around are tried, by the `effort`.
    """
    lobe = max(float(samples.sharpest_roughness[0]) ** 2, 1e-3)
    problem = _Problem(samples, light, technique, lobe, (time.thread_time(), effort.seconds))
    direction, is_peak = problem.by_newton(problem.mirror) if has_stencil else (problem.mirror, False)
    excess = float(problem.excess([direction])[0][0])
    if is_peak and excess <= STRICT:
        return HighlightPlace(direction, excess)
    further = [direction] if excess < np.inf else []
    # Lobes that take long are searched from there alone.
    starts = np.array([*further, problem.mirror]) if problem.is_late(HALF) else problem.starts(further)
    searched, least = problem.by_search(starts[: effort.starts], effort.moves)
    if least < excess:
        direction, excess = searched, least
    return HighlightPlace(direction, excess)


@dataclass(frozen=True)
class _Problem:
    """A highlight to be placed."""

    samples: SurfaceSamples
    light: MovedLight
    technique: object
    lobe: float  # its angle in rad
    clock: tuple[float, float]  # processor time of this thread at the start, and how long the search may take

    def is_late(self, share: float = 1.0) -> bool:
        """True if this share of the time is over."""
        start, seconds = self.clock
        return time.thread_time() > start + share * seconds

    @cached_property
    def mirror(self) -> np.ndarray:
        """The direction (3,) of the mirrored view."""
        return mirrored(self.samples.view[0], self.samples.normal[0])

    @cached_property
    def _light_at_mirror(self) -> tuple[np.ndarray, Light]:
        matrix = self.light.matrix_at(self.mirror)
        return matrix, self.light.at(matrix)

    def by_newton(self, direction: np.ndarray) -> tuple[np.ndarray, bool]:
        """The direction (3,) to which Newton's method leads, and whether it is that of a peak."""
        best, samples = None, self.samples.take(np.arange(len(STENCIL)))
        for _ in range(STEPS):
            axes = _axes(direction)
            turned = _unit(direction + np.concatenate([np.zeros((1, 3)), PROBE * self.lobe * axes]))
            gradient, curvature, is_lit = _fitted(self._specular(turned, samples, np.float64))
            if not is_lit:
                break
            # How far the peak is, in steps of the stencil. Without a peak, by the size of the curvature alone.
            values, vectors = np.linalg.eigh(curvature)
            offset = float(np.linalg.norm(vectors.T @ gradient[0] / np.maximum(np.abs(values), 1e-12)))
            if best is None or offset < best[0]:
                is_flat = float(np.linalg.norm(gradient[0])) < FLAT
                best = offset, direction, is_flat or (values.max() < 0.0 and offset < 1.0)
            if (offset < NEAR and values.max() < 0.0) or self.is_late():
                break
            jacobian = (gradient[1:] - gradient[0]).T / (PROBE * self.lobe)
            step = np.linalg.lstsq(jacobian, -gradient[0], rcond=None)[0]
            step *= min(1.0, LARGEST * self.lobe / max(np.linalg.norm(step), 1e-30))
            direction = _unit(direction + step @ axes)
        return (direction, False) if best is None else best[1:]

    def excess(self, directions, samples=None) -> tuple[np.ndarray, np.ndarray]:
        """By how much (D,) the brightest of the samples is brighter than the cursor, of lights in `directions` (D, 3);
        and the radiance (D,) there."""
        radiance = self._specular(directions, self.samples if samples is None else samples)
        here = radiance[:, 0]
        return np.where(here > 0.0, radiance.max(axis=-1) / np.maximum(here, 1e-30) - 1.0, np.inf), here

    def starts(self, further: list) -> np.ndarray:
        """The directions (N, 3) around the mirrored view from which to search, the most promising first."""
        mirror = self.mirror
        turned = np.tensordot(np.sin(ANGLES), _circle() @ _axes(mirror), axes=0).reshape(-1, 3)
        tried = np.stack([mirror, *further, *(turned + np.cos(ANGLES).repeat(TURNS)[:, None] * mirror)])
        few = np.concatenate([np.arange(len(STENCIL)), np.arange(len(STENCIL), len(self.samples), THINNED)])
        excess, radiance = self.excess(tried, self.samples.take(few[few < len(self.samples)]))
        excess[radiance < DIM * radiance[0]] = np.inf
        order = np.argsort(excess)
        return tried[order[excess[order] < np.inf]]

    def by_search(self, starts: np.ndarray, most_moves: int) -> tuple[np.ndarray | None, float]:
        """The direction (3,) with the least excess to which searches from `starts` (N, 3) lead, and that excess.

        Each move is the one with the least excess by first differences of the logarithms of all samples (a minimax
        problem, by sequential linear programming; the moves are so few that all of them are looked at).
        """
        if not len(starts):
            return None, np.inf
        best, least = starts, np.full(len(starts), np.inf)
        slopes = axes = np.zeros((len(starts), 2, 0))
        logs, reach, now = np.zeros((len(starts), 0)), np.full(len(starts), REACH * self.lobe), starts
        for _ in range(most_moves):
            axes_now = np.array([_axes(direction) for direction in now])
            tried = np.concatenate([now[:, None], _unit(now[:, None] + PROBE * self.lobe * axes_now)], axis=1)
            radiance = self._specular(tried.reshape(-1, 3), self.samples).reshape(len(now), 3, -1)
            relative = np.log(np.maximum(radiance, 1e-30) / np.maximum(radiance[..., :1], 1e-30))
            excess = np.where(radiance[:, 0, 0] > 0.0, np.expm1(relative[:, 0].max(axis=-1)), np.inf)
            is_better, slopes_now = excess < least, (relative[:, 1:] - relative[:, :1]) / (PROBE * self.lobe)
            if not slopes.size:
                slopes, logs, axes = slopes_now, relative[:, 0], axes_now
            else:
                slopes[is_better], logs[is_better] = slopes_now[is_better], relative[is_better, 0]
                axes[is_better] = axes_now[is_better]
                reach[~is_better] *= SHORTER
            best, least = np.where(is_better[:, None], now, best), np.where(is_better, excess, least)
            if least.min() <= GOOD or self.is_late():
                break
            expected = (logs[:, None] + (MOVES @ slopes) * reach[:, None, None]).max(axis=-1)
            moves = reach[:, None] * MOVES[np.argmin(expected, axis=-1)]
            now = _unit(best + np.einsum("ni,nij->nj", moves, axes))
        first = int(np.argmin(least))
        return best[first], float(least[first])

    def _specular(self, directions, samples: SurfaceSamples, dtype=np.float32) -> np.ndarray:
        """The specular radiance (D, P) of the light in each of the directions (D, 3) from the cursor.

        Samples that move in a rigid way before one light are shaded faster than many lights.
        """
        options = {"passes": ("specular",), "workers": 1, "dtype": dtype}
        matrices = np.array([self.light.matrix_at(direction) for direction in directions])
        place, light = self._light_at_mirror
        moves = place @ np.linalg.inv(matrices)
        if np.abs(moves[:, :3, :3] @ moves[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < RIGID:
            moved = samples.take(np.tile(np.arange(len(samples)), len(moves)))
            arrays = {name: _moved(moves, getattr(samples, name), name == "position") for name in SPATIAL}
            shading = shade(replace(moved, **arrays), [light], self.technique, **options)
            return shading.specular.sum(axis=(0, 2)).reshape(len(moves), len(samples))
        lights = [self.light.at(matrix) for matrix in matrices]
        return shade(samples, lights, self.technique, rows=range(len(lights)), **options).specular.sum(axis=-1)


def _moved(moves: np.ndarray, vectors: np.ndarray, are_positions: bool) -> np.ndarray:
    """Vectors (P, 3) after each of the moves (D, 4, 4), (D P, 3)."""
    moved = vectors @ moves[:, :3, :3].transpose(0, 2, 1)
    return (moved + moves[:, None, :3, 3] if are_positions else moved).reshape(-1, 3)


def _circle() -> np.ndarray:
    """Points (TURNS, 2) of the unit circle."""
    turns = 2.0 * np.pi * np.arange(TURNS) / TURNS
    return np.stack([np.cos(turns), np.sin(turns)], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _axes(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) across a direction and each other."""
    return normal_frames(direction[:, None])[:2, :, 0]


def _fitted(radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Gradients (L, 2) of the logarithm of the radiance (L, 9) of each light, the curvature (2, 2) of the first, and
    whether all of it is above 0."""
    if not (radiance > 0.0).all():
        return np.zeros((len(radiance), 2)), np.zeros((2, 2)), False
    _, right, up, right_right, up_up, right_up = _FIT @ np.log(radiance).T
    return np.stack([right, up], axis=-1), np.array([[right_right[0], right_up[0]], [right_up[0], up_up[0]]]), True
