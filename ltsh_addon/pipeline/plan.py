"""The plan of a finished picture: points per pixel, shadow rays, and how a budget of processor seconds is spent.

All of it follows from measured numbers alone: nothing here opens a scene or shades.
"""

from dataclasses import dataclass

import numpy as np

from .compositing import FirstErrors
from .options import SHADOW_RAYS, RenderOptions

# Points per pixel. Without a budget, one for SAMPLES_OF_POINT samples of Cycles, up to DEFAULT_POINTS: a point takes 80
# us, a sample 4 to 8. What fewer than LEAST_POINTS win, as many more samples of Cycles win as well. With a budget,
# FIRST_POINTS: of the samples on which the plan rests, and MOST_POINTS: at most.
FIRST_POINTS, DEFAULT_POINTS, SAMPLES_OF_POINT, MOST_POINTS = 3, 9, 32, 17
# Processor seconds of denoising. DENOISER_START_SECONDS: always. FIRST_DENOISING_SECONDS: for a picture of a million
# pixels. NEXT_DENOISING_SECONDS: for each further picture of that size.
DENOISER_START_SECONDS, FIRST_DENOISING_SECONDS, NEXT_DENOISING_SECONDS = 0.25, 12.0, 4.0
# SHADOWS_SHARE: the share of a budget that goes to the rays of soft shadows. RAY_SECONDS: processor time of a ray.
# SOFT_SHARE: the share of the pairs of a pixel and a light that lie in soft shadows.
SHADOWS_SHARE, RAY_SECONDS, SOFT_SHARE = 0.02, 6e-7, 0.1
MOST_OVER = 1.1  # how many times the budget a picture may take without a warning
# The time of direct light is extrapolated from a few squares of the picture. PROBE_SHARE: the share of the samples that
# these have. PROBE_POWER: of the number of samples, with which the time grows from there; in six scenes 0.65 to 0.95.
PROBE_SHARE, PROBE_POWER = 0.04, 0.75
# SAMPLES_POWER: with n samples of Cycles the squared error of a denoised picture falls as n to this power, of a noisy
# one as n to -1. In seven scenes, from 10 to 60 samples: -0.42 to -0.72, of what direct light leaves -0.3 to -0.6.
# POINTS_FACTOR, POINTS_POWER: what of their variance is the squared error of one point, and of several: these are
# spread evenly. In five scenes 0.12 to 0.5, and from one to three points -1 to -2. LEAST_GAIN: by this share direct
# light must make the squared error less, to be shaded: what the plan foretells is up to 1.5 times wrong.
SAMPLES_POWER, POINTS_FACTOR, POINTS_POWER, LEAST_GAIN = -0.56, 0.5, -1.5, 0.2


@dataclass(frozen=True)
class Probe:
    """What squares of the picture, fully shaded, tell of the whole: sums over their pixels, those of each square
    divided by how likely it was chosen."""

    samples: int
    seconds: float  # processor time of their direct light
    whole: float  # the `FirstErrors`
    rest: float
    variance: float  # of direct light among the points of a pixel


@dataclass(frozen=True)
class SceneMeasurements:
    """What is known of a scene after its first samples; times are processor seconds."""

    budget: float | None  # of the whole picture; None: no limit
    seconds_left: float | None  # of the budget, before denoising
    sampling_seconds: float  # of the first points
    edge_seconds: float  # that Cycles needs beside its samples
    points: int  # per pixel, of the samples that are there
    most_points: int
    samples_of_one_point: int
    samples: int  # of all `points`, after equal ones are merged
    has_lens: bool  # depth of field, which needs all points from the start
    cycles_samples: int = 0  # of Cycles that are there
    sample_seconds: float = 0.0  # of one more
    errors: FirstErrors | None = None  # of these samples
    probe: Probe | None = None


@dataclass(frozen=True)
class DirectLightPlan:
    """How many points per pixel LTSH shades; 0: all direct light is left to Cycles, for the `reason`.

    If `needs_probe`, the plan is not final: a `Probe` with PROBE_SHARE of the samples is needed.
    """

    points_per_pixel: int = 0
    reason: str = ""
    needs_probe: bool = False


def first_and_most_points(options: RenderOptions) -> tuple[int, int]:
    """Points per pixel of the first samples, and the most that the plan may ask for; 0: all direct light is left to
    Cycles, whose samples are too few."""
    from ..blender.process.pixels import LEAST_POINTS

    most = options.sub_samples or MOST_POINTS
    if options.budget is None and options.sub_samples is None:
        samples = options.cycles_samples or SAMPLES_OF_POINT * DEFAULT_POINTS
        most = min(samples // SAMPLES_OF_POINT, DEFAULT_POINTS)
        if options.keep_visibility or options.own_groups is not None:
            most = max(most, FIRST_POINTS)  # each light by itself is wanted
        elif most < LEAST_POINTS:
            most = 0
    # Depth of field needs all of its points from the start.
    return (most if options.budget is None or most > MOST_POINTS else min(FIRST_POINTS, most)), most


def direct_light_plan(scene: SceneMeasurements) -> DirectLightPlan:
    """The points per pixel with which the remaining budget leaves the least error, or why Cycles does better alone.

    With n samples, of which some are there and the others follow in the time that direct light leaves, the squared
    error is that of Cycles' picture, or that of its rest and that of direct light by its points.
    """
    from ..blender.process.pixels import TOO_LITTLE_GAIN, too_little

    if scene.seconds_left is None or scene.samples == 0:
        return DirectLightPlan(scene.points)
    seconds, errors = scene.seconds_left - scene.edge_seconds, scene.errors
    if seconds <= 0.0 or errors is None:
        return DirectLightPlan(0, too_little(scene.budget))
    # All points of a pixel but the first make about equally many samples.
    counts = np.array([scene.points]) if scene.has_lens else np.arange(1, max(scene.points, scene.most_points) + 1)
    one = scene.samples_of_one_point
    samples = one + (counts - 1) * (scene.samples - one) / max(scene.points - 1, 1)
    # More points than there are need all samples anew.
    again = np.where(counts > scene.points, scene.sampling_seconds * (1.0 + counts / scene.points), 0.0)

    def noise(taken) -> np.ndarray:
        """The factor of squared errors where direct light has `taken` so many seconds."""
        samples = scene.cycles_samples + np.maximum(seconds - taken, 0.0) / scene.sample_seconds
        return (samples / errors.samples) ** (SAMPLES_POWER if errors.is_denoised else -1.0)

    def is_worth(whole, left) -> bool:
        return left <= (1.0 - LEAST_GAIN) * whole * noise(0.0)

    by_cycles, probe = DirectLightPlan(0, TOO_LITTLE_GAIN), scene.probe
    if probe is None:
        least = errors.rest.mean() * noise(0.0)
        return DirectLightPlan(needs_probe=True) if is_worth(errors.whole.mean(), least) else by_cycles
    expected = probe.seconds * (samples / probe.samples) ** PROBE_POWER + again
    # With depth of field direct light is denoised as well.
    factors = 0.0 * counts if scene.has_lens else POINTS_FACTOR * counts**POINTS_POWER
    left = np.where(expected < seconds, probe.rest * noise(expected) + factors * probe.variance, np.inf)
    best = int(np.argmin(left))
    return DirectLightPlan(int(counts[best])) if is_worth(probe.whole, left[best]) else by_cycles


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
