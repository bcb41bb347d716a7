"""The plan of a finished picture, from measured numbers alone."""

from dataclasses import replace

import numpy as np
import pytest

from ltsh_addon.blender.process.pixels import TOO_LITTLE_GAIN, too_little
from ltsh_addon.pipeline import plan
from ltsh_addon.pipeline.compositing import FirstErrors
from ltsh_addon.pipeline.options import RenderOptions

SECONDS = 3.0  # that remain for direct light and Cycles' samples
# Without direct light a quarter of the squared error remains.
ERRORS = FirstErrors(10.0, np.full((3, 4), 4.0), np.full((3, 4), 1.0), True)
SCENE = plan.SceneMeasurements(
    budget=9.0,
    seconds_left=SECONDS + 0.5,
    sampling_seconds=0.1,
    edge_seconds=0.5,
    points=2,
    most_points=5,
    samples_of_one_point=1000,
    samples=1200,
    has_lens=False,
    cycles_samples=20,
    sample_seconds=0.01,
    errors=ERRORS,
)


def planned(scene, seconds_of, variance=0.0):
    """The final plan of a scene whose direct light takes `seconds_of` a number of samples."""
    chosen = plan.direct_light_plan(scene)
    if not chosen.needs_probe:
        return chosen
    count = round(plan.PROBE_SHARE * scene.samples)
    rest = scene.errors.rest.mean() * count
    probe = plan.Probe(count, seconds_of(count), 4.0 * count, rest, variance * count)
    return plan.direct_light_plan(replace(scene, probe=probe))


def left_error(scene, points, seconds, variance):
    """The squared error with so many points whose light takes so many seconds, in the words of the plan's docstring."""
    samples = scene.cycles_samples + (SECONDS - seconds) / scene.sample_seconds
    return (samples / 10.0) ** plan.SAMPLES_POWER + plan.POINTS_FACTOR * variance * points**plan.POINTS_POWER


@pytest.mark.parametrize("variance", [0.0, 0.3, 30.0])
@pytest.mark.parametrize("each", [1e-7, 3e-4, 1e-3, 2e-3, 1.0])
def test_direct_light_gets_the_points_that_leave_the_least_error(each, variance):
    """Of a scene whose samples all take the same time. What the plan expects of all from the probe is less, by its
    power."""
    scene = replace(SCENE, sampling_seconds=0.0)
    chosen, errors = planned(scene, lambda count: each * count, variance), {}
    for points in range(1, 6):
        samples = 1000 + 200 * (points - 1)
        seconds = each * samples * (samples / round(plan.PROBE_SHARE * 1200)) ** (plan.PROBE_POWER - 1.0)
        errors[points] = left_error(SCENE, points, seconds, variance) if seconds < SECONDS else np.inf
    best = min(errors, key=errors.get)
    is_less = errors[best] <= (1.0 - plan.LEAST_GAIN) * 4.0 * left_error(SCENE, 1, 0.0, 0.0)
    assert chosen == (plan.DirectLightPlan(best) if is_less else plan.DirectLightPlan(0, TOO_LITTLE_GAIN))
    if each == 1.0 or variance == 30.0:
        assert chosen.points_per_pixel == 0
    if each == 1e-7 and variance < 30.0:
        assert chosen.points_per_pixel == (5 if variance else 1)


def test_more_points_than_there_are_pay_for_their_extraction():
    def points(sampling_seconds):
        scene = replace(SCENE, sampling_seconds=sampling_seconds)
        return planned(scene, lambda count: 1e-7 * count, 0.3).points_per_pixel

    assert [points(seconds) for seconds in (0.0, 9.0)] == [5, 2]


def test_where_direct_light_is_not_what_is_noisy_not_even_a_probe_is_shaded():
    few = replace(ERRORS, rest=0.9 * ERRORS.whole)
    assert plan.direct_light_plan(replace(SCENE, errors=few)) == plan.DirectLightPlan(0, TOO_LITTLE_GAIN)
    assert plan.direct_light_plan(SCENE).needs_probe


def test_points_that_there_is_no_time_for_are_not_shaded_even_if_nothing_else_errs():
    clean = replace(SCENE, errors=replace(ERRORS, rest=0.0 * ERRORS.whole), sampling_seconds=0.0)
    # One point takes each x 48 x (1000 / 48)^0.75 s, 468 each, and two take 537 each.
    points = [
        planned(clean, lambda count, each=each: each * count, 0.1).points_per_pixel for each in (1e-7, 6e-3, 1e-2)
    ]
    assert points == [5, 1, 0] and 468 * 6e-3 < SECONDS < 537 * 6e-3


def test_without_a_denoiser_samples_count_for_more():
    """So direct light may take less of the time."""
    worth = {}
    for is_denoised in (True, False):
        errors = replace(ERRORS, rest=0.3 * ERRORS.whole, is_denoised=is_denoised)
        scene = replace(SCENE, errors=errors)
        times = np.geomspace(1e-6, 1e-2, 40)
        worth[is_denoised] = sum(planned(scene, lambda n, t=t: t * n).points_per_pixel > 0 for t in times)
    assert worth[True] > worth[False] > 0


def test_without_a_budget_or_without_surfaces_all_points_are_shaded():
    for scene in (replace(SCENE, budget=None, seconds_left=None), replace(SCENE, samples=0)):
        assert plan.direct_light_plan(scene) == plan.DirectLightPlan(2)
    # Without any time no probe is worth its time.
    for scene in (replace(SCENE, seconds_left=0.0), replace(SCENE, errors=None)):
        assert plan.direct_light_plan(scene) == plan.DirectLightPlan(0, too_little(9.0))


def test_depth_of_field_has_all_of_its_points_or_none():
    scene = replace(SCENE, has_lens=True, points=17, most_points=17)
    assert planned(scene, lambda count: 1e-5 * count, 9.0).points_per_pixel == 17
    assert planned(scene, lambda count: 0.03 * count).points_per_pixel == 0


def test_without_a_budget_points_follow_the_samples_alone_so_that_every_run_gives_the_same_picture(tmp_path):
    options = RenderOptions(tmp_path / "room.blend", output=tmp_path)
    assert plan.first_and_most_points(options) == (plan.DEFAULT_POINTS, plan.DEFAULT_POINTS)
    points = [plan.first_and_most_points(replace(options, cycles_samples=count)) for count in (1, 63, 64, 128, 4096)]
    assert points == [(0, 0), (0, 0), (2, 2), (4, 4), (plan.DEFAULT_POINTS, plan.DEFAULT_POINTS)]
    few = replace(options, cycles_samples=1)
    # What was asked for is shaded, as is what other powers of lights need.
    assert plan.first_and_most_points(replace(few, sub_samples=5)) == (5, 5)
    for wanted in ({"keep_visibility": True}, {"own_groups": ()}):
        assert plan.first_and_most_points(replace(few, **wanted)) == (plan.FIRST_POINTS, plan.FIRST_POINTS)


def test_first_points_are_few_only_with_a_budget(tmp_path):
    options = RenderOptions(tmp_path / "room.blend", output=tmp_path)
    budget = replace(options, budget=5.0)
    assert plan.first_and_most_points(budget) == (plan.FIRST_POINTS, plan.MOST_POINTS)
    assert plan.first_and_most_points(replace(budget, sub_samples=2)) == (2, 2)
    assert plan.first_and_most_points(replace(budget, sub_samples=40)) == (40, 40)


def test_shadow_rays_follow_the_budget_between_their_limits():
    assert plan.shadow_rays(256, None, 1e9) == 256
    rays = [plan.shadow_rays(256, 10.0, pairs) for pairs in (1e3, 1e5, 1e9)]
    assert rays[0] == 256 > rays[1] > rays[2] == 8


def test_a_budget_reserves_time_for_every_picture_to_denoise():
    left = [plan.seconds_before_denoising(30.0, 2.0, 1_000_000, denoisings) for denoisings in (1, 3)]
    assert left[0] - left[1] == pytest.approx(2 * plan.NEXT_DENOISING_SECONDS)
    assert plan.seconds_before_denoising(1.0, 2.0, 100, 1) == 0.0
    assert plan.seconds_before_denoising(None, 2.0, 100, 1) is None


def test_only_clear_excess_of_a_budget_is_a_warning():
    assert plan.over_budget(None, 9.0, 1.0) == plan.over_budget(10.0, 10.9, 1.0) == []
    (line,) = plan.over_budget(10.0, 12.0, 3.0)
    assert "took 12.0 s of processor time, of at least 3.0 s" in line
    (line,) = plan.over_budget(1.0, 4.0, 3.0)
    assert "takes at least 3.0 s of processor time" in line and "the budget is 1 s" in line
