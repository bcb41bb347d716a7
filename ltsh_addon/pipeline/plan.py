"""The plan of a finished picture: points per pixel, shadow rays, and how a budget of processor seconds is spent.

All of it follows from measured numbers alone: nothing here opens a scene or shades.
"""

from dataclasses import dataclass

import numpy as np

from .compositing import FirstErrors
from .options import SHADOW_RAYS, RenderOptions

# Points per pixel. Without a budget, one for SAMPLES_OF_POINT samples of Cycles, up to DEFAULT_POINTS: a point takes 80
# us, a sample 4 to 8. What fewer than LEAST_POINTS win, as many more samples of Cycles win as well. FEWEST_POINTS:
# with a budget, or where each light by itself is wanted. MOST_POINTS: with a budget, at most.
FEWEST_POINTS, DEFAULT_POINTS, SAMPLES_OF_POINT, MOST_POINTS = 3, 9, 32, 17
# Processor seconds of denoising. DENOISER_START_SECONDS: always. FIRST_DENOISING_SECONDS: for a picture of a million
# pixels. NEXT_DENOISING_SECONDS: for each further picture of that size.
DENOISER_START_SECONDS, FIRST_DENOISING_SECONDS, NEXT_DENOISING_SECONDS = 0.25, 12.0, 4.0
# SHADOWS_SHARE: the share of a budget that goes to the rays of soft shadows. RAY_SECONDS: processor time of a ray.
# SOFT_SHARE: the share of the pairs of a pixel and a light that lie in soft shadows.
SHADOWS_SHARE, RAY_SECONDS, SOFT_SHARE = 0.02, 6e-7, 0.1
MOST_OVER = 1.1  # how many times the budget a picture may take without a warning
# With a budget direct light is shaded in those squares of the picture where Cycles errs most. SQUARE: their size in
# pixels. READ_SHARE: the share of the time for reading their samples. READ_SECONDS: of a point. SHARES: of the squares
# that are read, of which the plan takes one.
SQUARE, READ_SHARE, READ_SECONDS, SHARES = 8, 0.03, 6e-6, (0.08, 0.15, 0.25, 0.4, 0.65, 1.0)
# The time of direct light is extrapolated from a few of these. PROBE_SHARE: the share of the samples that they have.
# PROBE_POWER: of the number of samples, with which the time grows from there; in six scenes 0.65 to 0.95. LEAST_WEIGHT:
# with which a square is chosen, in units of the whole error.
PROBE_SHARE, PROBE_POWER, LEAST_WEIGHT = 0.04, 0.8, 1e-6
# SAMPLES_POWER: with n samples of Cycles the squared error of a denoised picture falls as n to this power, of a noisy
# one as n to -1. In seven scenes, from 10 to 60 samples: -0.42 to -0.72, of what direct light leaves -0.3 to -0.6.
# POINTS_POWER: with p points the squared error of direct light is their variance times p to this power: they are spread
# evenly. In five scenes, from one to three points: -1 to -2.
SAMPLES_POWER, POINTS_POWER = -0.56, -1.5
# GAIN_SHARE: what remains of the gain that the first samples foretell: the squares where they err most err less
# afterwards; in four scenes 0.4 to 1.1. LEAST_GAIN: the least gain, as a share of the squared error; where 0.13 and
# 0.26 were foretold, FLIP and L2 were 1.15 and 1.4 times those of Cycles. A probe is made where there is as much beside
# what Cycles would win in the time that it takes: PROBE_SECONDS, and for each pixel.
GAIN_SHARE, LEAST_GAIN, PROBE_SECONDS = 0.6, 0.3, (2.0, 1.2e-4)


class Squares:
    """Squares of a picture (H, W), those first where LTSH wins most of Cycles' squared error by its first `errors`."""

    def __init__(self, errors: FirstErrors):
        self.errors, self._shape = errors, errors.whole.shape
        height, width = self._shape
        row, column = np.arange(height)[:, None] // SQUARE, np.arange(width) // SQUARE
        square = (row * -(-width // SQUARE) + column).ravel()
        gain = np.bincount(square, (errors.whole - errors.rest).ravel())
        order = np.argsort(-gain / np.bincount(square), kind="stable")
        self._rank = np.argsort(order)[square]  # of the square of each pixel
        self.whole = errors.whole.sum()  # Cycles' squared error
        self.gain = gain[order]  # (S,) what LTSH wins of it in each square
        # (S,) and in the first of them. These seem best by chance in part, so it is at most what all squares win.
        self.gains = np.minimum(np.cumsum(self.gain), self.gain.sum())

    def sums(self, image: np.ndarray | float = 1.0, pixels: np.ndarray | None = None) -> np.ndarray:
        """Sums (S,) of an `image` (H, W); or of values at `pixels` (P,), which are counted row by row."""
        rank = self._rank if pixels is None else self._rank[pixels]
        values = np.broadcast_to(image, self._shape if pixels is None else rank.shape).ravel()
        return np.bincount(rank, values, minlength=len(self.gain))

    def pixels(self, squares) -> np.ndarray:
        """Mask (H, W) of the pixels of `squares`, which are numbers or a slice."""
        chosen = np.zeros(len(self.gain), bool)
        chosen[squares] = True
        return chosen[self._rank].reshape(self._shape)


@dataclass(frozen=True)
class Probe:
    """What some of the squares, fully shaded, tell of the others."""

    samples: int
    seconds: float  # processor time of their direct light
    variances: np.ndarray  # (Q,) of the points of a pixel, over what LTSH wins, of squares drawn by what it wins
    of_one_point: np.ndarray  # (S,) samples of the first of the squares
    of_all_points: np.ndarray  # (S,) after equal ones are merged


@dataclass(frozen=True)
class SceneMeasurements:
    """What is known of a scene after its first samples; times are processor seconds."""

    seconds_left: float  # of the budget, before denoising
    edge_seconds: float  # that Cycles needs beside its samples
    points: int  # of each pixel that are there
    has_lens: bool  # depth of field, which needs all points
    needs_all: bool = False  # squares
    cycles_samples: int = 0  # of Cycles that are there
    sample_seconds: float = 0.0  # of one more
    squares: Squares | None = None  # with the errors of these samples
    look_seconds: float = 0.0  # that a look at the lights will take first
    probe: Probe | None = None


@dataclass(frozen=True)
class DirectLightPlan:
    """How many points per pixel LTSH shades, and in how many of the squares; without any, all direct light is left to
    Cycles, for the `reason`.

    If `needs_probe`, the plan is not final: a `Probe` of so many squares is needed.
    """

    points_per_pixel: int = 0
    squares: int = 0
    reason: str = ""
    needs_probe: bool = False


def most_points(options: RenderOptions) -> int:
    """The most points per pixel; 0: all direct light is left to Cycles, whose samples are too few."""
    from ..blender.process.pixels import LEAST_POINTS

    if options.budget is not None or options.sub_samples is not None:
        return options.sub_samples or MOST_POINTS
    samples = options.cycles_samples or SAMPLES_OF_POINT * DEFAULT_POINTS
    most = min(samples // SAMPLES_OF_POINT, DEFAULT_POINTS)
    if options.needs_each_light:
        return max(most, FEWEST_POINTS)
    return most if most >= LEAST_POINTS else 0


def direct_light_plan(scene: SceneMeasurements) -> DirectLightPlan:
    """The points per pixel and the squares with which the remaining budget leaves the least error, or why Cycles does
    better alone.

    With n samples, of which some are there and the others follow in the time that direct light leaves, the squared
    error is that of Cycles' picture. Of what its direct light has of it in a square, D, LTSH wins D / (D + A), A that
    of its points: both pictures are weighed by their errors.
    """
    from ..blender.process.pixels import TOO_LITTLE_GAIN, TOO_LITTLE_TIME

    seconds, squares, probe = scene.seconds_left - scene.edge_seconds, scene.squares, scene.probe
    if seconds <= 0.0 or squares is None:
        return DirectLightPlan(reason=TOO_LITTLE_TIME)
    whole, gain = squares.whole, GAIN_SHARE * squares.gains

    def noise(taken) -> np.ndarray:
        """The factor of squared errors where direct light has `taken` so many seconds."""
        samples = scene.cycles_samples + np.maximum(seconds - taken, 0.0) / scene.sample_seconds
        return (samples / squares.errors.samples) ** (SAMPLES_POWER if squares.errors.is_denoised else -1.0)

    if probe is None:
        pixels = squares.errors.whole.size
        share = READ_SHARE * seconds / (READ_SECONDS * scene.points * pixels)
        count = len(gain) if scene.needs_all else int(np.ceil(min(share, 1.0) * len(gain)))
        first = scene.look_seconds + PROBE_SECONDS[0] + PROBE_SECONDS[1] * pixels
        least = LEAST_GAIN - SAMPLES_POWER * first / seconds
        is_worth = bool(gain[:count].max() >= max(least * whole, 1e-30))
        return DirectLightPlan(0, count, "" if is_worth else TOO_LITTLE_GAIN, needs_probe=is_worth)
    if not probe.samples:  # no surface is there
        return DirectLightPlan(reason=TOO_LITTLE_GAIN)
    # All points of a pixel but the first make about equally many samples.
    fewest = scene.points if scene.has_lens else min(FEWEST_POINTS, scene.points)
    points = np.arange(fewest, scene.points + 1)
    one, every = np.cumsum(probe.of_one_point), np.cumsum(probe.of_all_points)
    counts = np.ceil(len(one) * np.array(SHARES[-1:] if scene.needs_all else SHARES)).astype(int)[:, None]
    samples = one[counts - 1] + (points - 1) * ((every - one)[counts - 1] / max(scene.points - 1, 1))
    taken = probe.seconds * (samples / probe.samples) ** PROBE_POWER
    # With depth of field direct light is denoised as well.
    of_points = 0.0 * points if scene.has_lens else points**POINTS_POWER
    won = np.mean(1.0 / (1.0 + of_points[:, None] * probe.variances / noise(taken)[..., None]), axis=-1)
    left = (whole - won * gain[counts - 1]) * noise(taken)
    left = np.where(taken < seconds, left, np.inf)
    row, column = np.unravel_index(np.argmin(left), left.shape)
    if left[row, column] > (1.0 - LEAST_GAIN) * whole * noise(0.0):
        return DirectLightPlan(reason=TOO_LITTLE_GAIN)
    return DirectLightPlan(int(points[column]), int(counts[row, 0]))


def shadow_rays(most: int, budget: float | None, pairs: float) -> int:
    """The most shadow rays, up to `most`, for each of the `pairs` of a pixel and a light."""
    if budget is None:
        return most
    affordable = SHADOWS_SHARE * budget / max(SOFT_SHARE * RAY_SECONDS * pairs, 1e-9)
    return int(np.clip(affordable, SHADOW_RAYS[0], most))


def seconds_before_denoising(budget: float | None, spent: float, pixels: int, denoisings: int) -> float | None:
    """Processor seconds of the budget that remain before denoising; None without a budget."""
    if budget is None:
        return None
    reserve = (FIRST_DENOISING_SECONDS + NEXT_DENOISING_SECONDS * (denoisings - 1)) * (pixels / 1e6)
    return max(budget - spent - DENOISER_START_SECONDS - reserve, 0.0)


def over_budget(budget: float | None, seconds: float, least: float) -> list[str]:
    """The warning about a picture that took more `seconds` than its budget; `least` is what any picture of it takes."""
    if budget is None or seconds <= MOST_OVER * budget:
        return []
    if least > budget:
        time = f"takes at least {least:.1f} s of processor time, however few samples, and took {seconds:.1f} s"
    else:
        time = f"took {seconds:.1f} s of processor time, of at least {least:.1f} s with nothing but a few samples"
    return [f"the picture {time}; the budget is {budget:g} s: give it more, or fewer pixels"]
