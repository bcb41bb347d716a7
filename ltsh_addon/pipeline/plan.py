"""The plan of a finished picture: points per pixel, shadow rays, and how a budget of processor seconds is spent.

All of it follows from measured numbers alone: nothing here opens a scene or shades.
"""

from dataclasses import dataclass

import numpy as np

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
# The time of direct light is extrapolated from a few squares of the picture. PROBES: the share of the samples that
# these have, and the power of the number of samples with which the time grows from there: from the first squares at
# least 0.45, from the second 0.49 to 0.7 in six scenes of 32,400 pixels, and 0.84 with nine times as many.
# MADE_ONCE: how many times too long the first may seem, since it also makes what all others have (maps of skies).
PROBES, MADE_ONCE = ((0.01, 0.45), (0.04, 0.6)), 2.0
# Of the remaining budget: the share that direct light may take with the first points, and with more points. With as
# many samples it leaves 0.75 to 0.95 of the error, for which so much time makes up.
DIRECT_SHARE, MORE_SHARE = 0.3, 0.2
# THIN_CONTRAST: from this `Probe.contrast` on, highlights are thinner than pixels, and time is better spent on samples
# of Cycles. In seven scenes the contrast is at most 0.11, of flakes in a car's paint 0.18, on the example scene more.
THIN_CONTRAST = 0.14


@dataclass(frozen=True)
class Probe:
    """What a few squares of the picture, fully shaded, tell of the whole."""

    samples: int
    seconds: float  # processor time of their direct light
    # Root mean square, over all pixels, of the deviation of specular light among the points of a pixel, in units of the
    # light of the pixel and of the mean.
    contrast: float = 0.0


@dataclass(frozen=True)
class SceneMeasurements:
    """What is known of a scene after its first samples; times are processor seconds."""

    budget: float | None  # of the whole picture; None: no limit
    seconds_left: float | None  # of the budget, before denoising
    sampling_seconds: float  # of the first points
    cycles_seconds: float  # that Cycles needs beside its samples
    points: int  # per pixel, of the samples that are there
    most_points: int
    samples_of_one_point: int
    samples: int  # of all `points`, after equal ones are merged
    has_lens: bool  # depth of field, which needs all points from the start
    probes: tuple[Probe, ...] = ()


@dataclass(frozen=True)
class DirectLightPlan:
    """How many points per pixel LTSH shades; 0: all direct light is left to Cycles, for the `reason`.

    While `probe_share` is above 0 the plan is not final: a `Probe` with that share of the samples is needed.
    """

    points_per_pixel: int = 0
    reason: str = ""
    probe_share: float = 0.0


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
    """The points per pixel that the remaining budget allows, or why Cycles does better with that time."""
    from ..blender.process.pixels import LEAST_POINTS, TOO_THIN, too_little

    if scene.seconds_left is None or scene.samples == 0:
        return DirectLightPlan(scene.points)
    by_cycles = DirectLightPlan(0, too_little(scene.budget))
    seconds = scene.seconds_left - scene.cycles_seconds
    if seconds <= 0.0:
        return by_cycles
    # All points of a pixel but the first make about equally many samples.
    counts = np.array([scene.points])
    if not scene.has_lens:
        counts = np.arange(min(LEAST_POINTS, scene.points), max(scene.points, scene.most_points) + 1)
    one = scene.samples_of_one_point
    samples = one + (counts - 1) * (scene.samples - one) / max(scene.points - 1, 1)
    # More points than there are need all samples anew.
    again = np.where(counts > scene.points, scene.sampling_seconds * (1.0 + counts / scene.points), 0.0)
    allowed = np.where(counts > scene.points, MORE_SHARE, DIRECT_SHARE) * seconds - again
    (small_share, small_power), (large_share, large_power) = PROBES
    if not scene.probes:
        return DirectLightPlan(probe_share=small_share)
    small, *large = scene.probes
    if small.seconds * (samples[0] / small.samples) ** small_power > MADE_ONCE * allowed[0]:
        return by_cycles
    if not large:
        return DirectLightPlan(probe_share=large_share)
    (large,) = large
    expected = large.seconds * (samples / large.samples) ** large_power
    affordable = counts[expected <= allowed]
    if len(affordable) == 0:
        return by_cycles
    # Either probe may miss the highlights.
    is_thin = max(small.contrast, large.contrast) > THIN_CONTRAST
    return DirectLightPlan(0, TOO_THIN) if is_thin else DirectLightPlan(int(affordable[-1]))


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
