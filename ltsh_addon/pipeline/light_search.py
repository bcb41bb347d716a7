"""Places, directions and sizes of lights for which pictures come closest to a target; and places for new lights.

The pictures of the lights are closed forms times visibility on some samples of the picture, without noise: the random
numbers of the rays depend on the samples alone. Their weights are linear and are solved for at every step (Golub and
Pereyra 1973, "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate",
doi:10.1137/0710036), with the derivative of Kaufman 1975 (doi:10.1007/BF01932995). The rest is Levenberg-Marquardt.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .. import shading, visibility
from ..imaging.color import luminance
from ..lobes.polygon import normal_frames
from ..scene import PASSES, EllipseLight, Light, PointLight, SpotLight, SunLight, SurfaceSamples

# SQUARE: pictures are compared by the means of squares of so many pixels on a side: edges that lie differently within
# pixels would count as light otherwise (errors of powers 2.4 % in place of .6 % in a room of eight lights).
SQUARE = 5
# STEP: of the differences, relative to the distance of a light and to 1 rad. Errors of visibility are about 1e-3.
STEP = 0.01
# STEPS: of Levenberg-Marquardt at most. NEAR_ENOUGH: relative to the distance, of a last step.
STEPS, NEAR_ENOUGH, COARSE_ENOUGH = 25, 3e-4, 3e-3
# FAR, TURN: how far starts and steps lead from the first place, relative to the distance and in rad.
FAR, TURN = 0.35, 0.4
# STARTS: that are looked at; SEARCHED: from which it is searched with few samples; REFINED: of whose results are then
# improved with more.
STARTS, SEARCHED, REFINED = 48, 4, 2

# NEW_LIGHTS: places for a new light on each sphere; NEW_DISTANCES: their radii, relative to the root mean square
# distance of the samples from their middle; NEW_SIZE: of the light, relative to its distance.
NEW_LIGHTS, NEW_DISTANCES, NEW_SIZE = 96, (1.0, 1.8), 0.12


def non_negative_least_squares(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The x (N,) without negative values for which |matrix x - target|^2 is least; matrix (M, N), target (M,).

    Lawson and Hanson 1974, algorithm NNLS (23.10), by the normal equations: N is small and M large.
    """
    normal, right = matrix.T @ matrix, matrix.T @ target
    count = len(right)
    x, is_free = np.zeros(count), np.zeros(count, bool)
    tolerance = 1e-12 * max(np.abs(right).max(initial=0.0), 1e-300)
    for _ in range(3 * count):
        gradient = right - normal @ x
        if is_free.all() or gradient[~is_free].max() <= tolerance:
            break
        is_free[np.argmax(np.where(is_free, -np.inf, gradient))] = True
        while True:
            step = np.zeros(count)
            step[is_free] = np.linalg.lstsq(normal[np.ix_(is_free, is_free)], right[is_free], rcond=None)[0]
            if step[is_free].min(initial=0.0) >= 0.0:
                x = step
                break
            # Go as far as no value becomes negative; the first that becomes 0 stays there.
            falls = is_free & (step < 0.0)
            ratio = np.where(falls, x / np.where(falls, x - step, 1.0), np.inf)
            x = x + ratio.min() * (step - x)
            is_free &= ratio > ratio.min()
            x[~is_free] = 0.0
    return x


def in_squares(image: np.ndarray, weights: np.ndarray, side: int = SQUARE) -> np.ndarray:
    """Means of `image` (..., H, W, C) over squares, weighted by `weights` (H, W)."""
    total = np.maximum(sums_in_squares(weights, (0, 1), side), 1e-30)
    return sums_in_squares(image * weights[..., None], (-3, -2), side) / total[..., None]


def sums_in_squares(values: np.ndarray, axes: tuple[int, int], side: int = SQUARE) -> np.ndarray:
    """Sums over squares of `side` pixels on a side along two `axes`."""
    for axis in axes:
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], side), axis)
    return values


def levenberg_marquardt(
    residuals: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    *,
    steps: int = STEPS,
    near: float = NEAR_ENOUGH,
) -> tuple[np.ndarray, float]:
    """The x (N,) near the given one for which |residuals(x)|^2 has a minimum, and that minimum.

    Marquardt 1963 (doi:10.1137/0111030), with the damping of Nielsen 1999, "Damping parameter in Marquardt's method".
    It ends after a step shorter than `near`, or after `steps` of them.
    """
    values, damping, growth = residuals(x), 1e-2, 2.0
    squares, slopes = values @ values, jacobian(x)
    for _ in range(steps):
        normal, gradient = slopes.T @ slopes, slopes.T @ values
        scale = np.maximum(np.diag(normal), 1e-9 * max(np.diag(normal).max(initial=0.0), 1e-300))
        step = -np.linalg.solve(normal + damping * np.diag(scale), gradient)
        tried = residuals(x + step)
        gain, expected = squares - tried @ tried, step @ (damping * scale * step - gradient)
        if gain <= 0.0:
            if np.abs(step).max() < near:
                break
            damping, growth = damping * growth, 2.0 * growth
            continue
        x, values, squares = x + step, tried, tried @ tried
        if np.abs(step).max() < near:
            break
        damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / expected - 1.0) ** 3), 2.0
        slopes = jacobian(x)
    return x, float(squares)


def rotation(vector: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) that turns around `vector` (3,) by its length in rad (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


@dataclass(frozen=True)
class LightMove:
    """How a light changes its place."""

    shift: np.ndarray  # (3,) m
    turn: np.ndarray  # (3,) rad, the vector of a rotation around the light's center
    growth: float = 0.0  # logarithm of the factor of its size, its power being the same

    def record(self) -> dict:
        """For JSON."""
        return {"shift": self.shift.tolist(), "turn": rotation(self.turn).tolist(), "growth": self.growth}

    def of(self, light: Light) -> Light:
        """The `light` there."""
        matrix, factor = rotation(self.turn), np.exp(self.growth)
        changes = {"half_u": matrix @ light.half_u, "half_v": matrix @ light.half_v}
        changes["direction"] = matrix @ light.direction
        if isinstance(light, SunLight):
            return replace(light, center=matrix @ light.center, **changes)
        if light.is_facing:  # its half axes have no direction
            changes = {"half_u": light.half_u, "half_v": light.half_v, "direction": changes["direction"]}
        if isinstance(light, SpotLight):
            changes["cone"] = replace(light.cone, axes=light.cone.axes @ matrix.T)
        if self.growth:
            changes["half_u"], changes["half_v"] = factor * changes["half_u"], factor * changes["half_v"]
            changes["radiance"] = light.radiance / factor**2
        return replace(light, center=light.center + self.shift, **changes)


@dataclass(frozen=True)
class LightFreedom:
    """The parameters (K,) of a light's move, from 0 where it is."""

    light: Light
    distance: float  # m, from what it lights: the unit of its shift
    with_size: bool = False

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors (0 to 3, 3) around which a turn of the light matters."""
        light = self.light
        if isinstance(light, PointLight) and not isinstance(light, SpotLight):
            return np.zeros((0, 3))
        lengths = np.linalg.norm(light.half_u), np.linalg.norm(light.half_v)
        is_disk = light.is_round and abs(lengths[0] - lengths[1]) < 1e-6 * lengths[0]
        return normal_frames(light.direction[:, None])[: 2 if is_disk or light.is_facing else 3, :, 0]

    @property
    def is_placed(self) -> bool:
        """Whether its place matters: not that of a sun."""
        return not isinstance(self.light, SunLight)

    @property
    def count(self) -> int:
        """K."""
        return 3 * self.is_placed + len(self.axes) + (self.with_size and self.is_placed)

    def move(self, x: np.ndarray) -> LightMove:
        """The move for parameters (K,)."""
        first, axes = 3 * self.is_placed, self.axes
        shift = self.distance * x[:first] if first else np.zeros(3)
        growth = x[-1] if self.with_size and self.is_placed else 0.0
        return LightMove(shift, x[first : first + len(axes)] @ axes if len(axes) else np.zeros(3), float(growth))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Parameters of a start: evenly in a ball of radius FAR, turned by up to TURN per axis."""
        x = np.zeros(self.count)
        if self.is_placed:
            way = rng.normal(size=3)
            x[:3] = FAR * rng.random() ** (1.0 / 3.0) * way / np.linalg.norm(way)
        first = 3 * self.is_placed
        x[first : first + len(self.axes)] = rng.uniform(-TURN, TURN, len(self.axes))
        return x


@dataclass(frozen=True)
class TargetSamples:
    """Samples of a picture, and areas of it in which their light is compared with a target."""

    samples: SurfaceSamples  # P
    area: np.ndarray  # (P,) the number of the area of each sample
    share: np.ndarray  # (P,) its weight there; what of an area shows no surface is missing
    target: np.ndarray  # (Q, 3)
    scale: np.ndarray  # (Q,) by which errors count
    visibility: Callable[[SurfaceSamples, Sequence[Light]], dict[str, np.ndarray]]  # (L, P) by pass
    technique: object = "ltsh4c"
    exposure: float = 1.0

    @classmethod
    def of(cls, extraction, target: np.ndarray, weights: np.ndarray, squares, rays, technique) -> "TargetSamples":
        """Random points of an `Extraction` in each of the squares of a `target` (H, W, 3), whose pixels have `weights`
        (H, W). `squares` are the side in pixels and the most points in each; `rays` are a tracer and the most of a
        point."""
        (side, most), (tracer, most_rays), film = squares, rays, extraction.film
        columns = -(-film.width // side)
        row, column = np.divmod(film.pixel, film.width)
        square = row // side * columns + column // side
        is_first = np.ones(len(square), bool) if film.first is None else film.first
        point = np.cumsum(is_first) - 1  # of each sample
        count = np.ones(len(square)) if film.count is None else film.count
        weight = (count / film.sub_samples * weights.ravel()[film.pixel])[is_first]
        of_point = np.where(weight > 0.0, square[is_first], -1)
        order = np.lexsort((np.random.default_rng(0).random(len(of_point)), of_point))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order)) - np.searchsorted(of_point[order], of_point[order])
        is_chosen = (rank < most) & (of_point >= 0)
        total = sums_in_squares(weights, (0, 1), side).ravel()
        is_told = total > 0.0
        number = np.cumsum(is_told) - 1
        whole, some = (np.bincount(square[is_first], one, len(total)) for one in (weight, weight * is_chosen))
        share = weight * (whole / np.maximum(some, 1e-30) / np.maximum(total, 1e-30))[square[is_first]]
        kept = is_chosen[point]
        means = cls.mean(target, weights, side)
        mean = np.average(luminance(means), weights=total[is_told])
        scale = np.sqrt(total[is_told]) / np.maximum(luminance(means), mean)

        def visible(samples, lights):
            sampling = visibility.ShadowSampling(rays=most_rays)
            result = visibility.trace_visibility(samples, lights, tracer, sampling, workers=1)
            return {name: result.of_lights(name) for name in PASSES}

        samples, area, exposure = extraction.samples.take(kept), number[square[kept]], extraction.picture.exposure
        return cls(samples, area, share[point[kept]], means, scale, visible, technique, exposure)

    @staticmethod
    def mean(image: np.ndarray, weights: np.ndarray, side: int) -> np.ndarray:
        """Means (..., Q, C) of an image (..., H, W, C) over the squares that have any of the `weights` (H, W)."""
        is_told = sums_in_squares(weights, (0, 1), side).ravel() > 0.0
        means = in_squares(image, weights, side)
        return means.reshape(*image.shape[:-3], -1, image.shape[-1])[..., is_told, :]

    def distance(self, light: Light) -> float:
        """The mean distance in m of a light from the samples, by its light."""
        weight = self.picture(light).sum(axis=-1)[self.area] * self.share + 1e-30
        return float(np.average(np.linalg.norm(self.samples.position - light.center, axis=-1), weights=weight))

    def picture(self, light: Light) -> np.ndarray:
        """The direct light (Q, 3) of one light."""
        shaded = shading.shade(self.samples, [light], self.technique, passes=PASSES, workers=1)
        visible = self.visibility(self.samples, [light])
        values = sum(getattr(shaded, name)[0] * visible[name][0][:, None] for name in PASSES)
        values = self.exposure * self.share[:, None] * values
        areas = len(self.target)
        return np.stack([np.bincount(self.area, column, areas) for column in values.T], axis=-1)


@dataclass(frozen=True)
class LightSearch:
    """The search for the lights of a target: those of `freedoms` may move, each with bounces that scale with it."""

    places: TargetSamples
    freedoms: tuple[LightFreedom, ...]  # R
    bounced: np.ndarray  # (R, Q, 3) of the lights where they are
    others: np.ndarray  # (N, Q, 3) of lights that only change their powers
    fixed: np.ndarray  # (Q, 3)
    direct: np.ndarray  # (R, 3) sums of the direct light of the lights where they are
    colors: bool = False

    @cached_property
    def _pictures(self) -> dict[tuple[int, bytes], np.ndarray]:
        """The latest `layer`s by number and parameters."""
        return {}

    def split(self, x: np.ndarray) -> list[np.ndarray]:
        """The parameters of each light."""
        return np.split(x, np.cumsum([freedom.count for freedom in self.freedoms])[:-1])

    def layer(self, number: int, x: np.ndarray) -> np.ndarray:
        """The light (Q, 3) of light `number` with parameters `x` (K,), bounces included."""
        key = number, x.tobytes()
        if key not in self._pictures:
            if len(self._pictures) > 64 * len(self.freedoms):
                self._pictures.clear()
            freedom = self.freedoms[number]
            direct = self.places.picture(freedom.move(x).of(freedom.light))
            factor = direct.sum(axis=0).sum() / max(self.direct[number].sum(), 1e-30)
            self._pictures[key] = direct + factor * self.bounced[number]
        return self._pictures[key]

    def layers(self, x: np.ndarray) -> np.ndarray:
        """The light (R + N, Q, 3) of all lights."""
        moved = [self.layer(number, one) for number, one in enumerate(self.split(x))]
        return np.concatenate([np.reshape(moved, (-1, *self.fixed.shape)), self.others])

    def _columns(self, layers: np.ndarray) -> list[np.ndarray]:
        """Scaled (M, R + N), by channel or for all channels at once."""
        scaled = self.places.scale[:, None] * layers
        if self.colors:
            return [scaled[..., channel].T for channel in range(3)]
        return [scaled.reshape(len(layers), -1).T]

    @cached_property
    def _targets(self) -> list[np.ndarray]:
        return [one[:, 0] for one in self._columns((self.places.target - self.fixed)[None])]

    def _solved(self, x: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The columns of all lights, and their best factors."""
        columns = self._columns(self.layers(x))
        return columns, [non_negative_least_squares(*pair) for pair in zip(columns, self._targets, strict=True)]

    def factors(self, x: np.ndarray) -> list[np.ndarray]:
        """The best factors of all lights (R + N,), by channel or one for all."""
        return self._solved(x)[1]

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """The scaled errors (M,) with the best factors."""
        terms = zip(*self._solved(x), self._targets, strict=True)
        return np.concatenate([one @ by - wanted for one, by, wanted in terms])

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """The derivatives (M, N) of the residuals: differences, without what other factors would take away."""
        columns, factors = self._solved(x)
        bases = []
        for one, by in zip(columns, factors, strict=True):
            bases.append(np.linalg.qr(one[:, by > 0.0])[0] if (by > 0.0).any() else np.zeros((len(one), 0)))
        slopes, parts = [], self.split(x)
        for number, part in enumerate(parts):
            here = self.layer(number, part)
            for index in range(len(part)):
                there = self.layer(number, part + STEP * np.eye(len(part))[index])
                changes = self._columns(((there - here) / STEP)[None])
                slopes.append(np.concatenate([
                    (one := by[number] * change[:, 0]) - basis @ (basis.T @ one)
                    for by, change, basis in zip(factors, changes, bases, strict=True)
                ]))  # fmt: skip
        return np.stack(slopes, axis=-1)

    def error(self, x: np.ndarray) -> float:
        """The relative error of the picture."""
        return float(
            np.linalg.norm(self.residuals(x)) / np.linalg.norm(self.places.scale[:, None] * self.places.target)
        )


def searched(
    coarse: LightSearch | None,
    fine: LightSearch,
    *,
    progress: Callable[[float], object] = lambda share: None,
) -> np.ndarray:
    """The parameters (N,) with which the lights of `fine` come closest to its target.

    From several starts it is searched in `coarse`, of the same lights with fewer samples and larger areas, in which
    shadows and highlights are seen from farther; from the two best in `fine`. Without it, from where the lights are.
    """
    starts = [np.zeros(sum(freedom.count for freedom in fine.freedoms))]
    if coarse is not None:
        starts = _coarse_results(coarse, starts, progress)
    best = []
    for number, x in enumerate(starts):
        best.append(levenberg_marquardt(fine.residuals, fine.jacobian, x))
        progress(0.6 + 0.2 * (number + 1))
    return min(best, key=lambda result: result[1])[0]


def _coarse_results(coarse, starts, progress) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    starts += [np.concatenate([one.random(rng) for one in coarse.freedoms]) for _ in range(STARTS)]
    errors, results = [], []
    for number, start in enumerate(starts):
        errors.append(coarse.error(start))
        progress(0.2 * number / len(starts))
    best = [number for number in np.argsort(errors, kind="stable").tolist() if number != 0]
    for number, start in enumerate((0, *best[:SEARCHED])):
        results.append(levenberg_marquardt(coarse.residuals, coarse.jacobian, starts[start], near=COARSE_ENOUGH))
        progress(0.2 + 0.4 * number / (1 + SEARCHED))
    return [x for x, _ in sorted(results, key=lambda result: result[1])[:REFINED]]


def added_light(places: TargetSamples, layers: np.ndarray, fixed: np.ndarray) -> Light:
    """A new light that brings the pictures `layers` (R, Q, 3) and `fixed` (Q, 3) of other lights closest to the target.

    One of NEW_LIGHTS disks on spheres around the samples, which face their middle; the powers of all lights are those
    of least squares. Raises ValueError where none of them lights anything.
    """
    position, best = places.samples.position, None
    middle = np.average(position, axis=0, weights=places.share + 1e-30)
    reach = np.sqrt(np.average(np.square(position - middle).sum(axis=-1), weights=places.share + 1e-30))
    wanted = (places.scale[:, None] * (places.target - fixed)).ravel()
    columns = [(places.scale[:, None] * layer).ravel() for layer in layers]
    number = np.arange(NEW_LIGHTS)
    height, angle = 1.0 - (2.0 * number + 1.0) / NEW_LIGHTS, np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - height**2)
    ways = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=-1)
    for way, far in ((way, far) for far in NEW_DISTANCES for way in ways):
        half_u, half_v = NEW_SIZE * far * reach * normal_frames(way[:, None])[:2, :, 0]
        light = EllipseLight("", middle + far * reach * way, half_u, half_v, -way, np.ones(3), shape="DISK")
        column = (places.scale[:, None] * places.picture(light)).ravel()
        if not column.any():
            continue
        matrix = np.stack([*columns, column], axis=-1)
        factors = non_negative_least_squares(matrix, wanted)
        error = float(np.square(matrix @ factors - wanted).sum())
        if factors[-1] > 0.0 and (best is None or error < best[0]):
            best = error, replace(light, radiance=factors[-1] * np.ones(3))
    if best is None:
        raise ValueError("no further light makes the picture more like the target")
    return best[1]
