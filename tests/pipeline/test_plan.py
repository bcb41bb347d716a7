"""The plan of a finished picture, from measured numbers alone."""

from dataclasses import replace

import pytest

from ltsh_addon.blender.process.pixels import TOO_THIN, too_little
from ltsh_addon.pipeline import plan
from ltsh_addon.pipeline.options import RenderOptions

SECONDS = 3.0  # that remain for direct light and Cycles' samples
SCENE = plan.SceneMeasurements(
    budget=9.0,
    seconds_left=SECONDS + 0.5,
    sampling_seconds=0.1,
    cycles_seconds=0.5,
    points=2,
    most_points=5,
    samples_of_one_point=1000,
    samples=1200,
    has_lens=False,
)


def planned(scene, seconds_of, **probe):
    """The final plan of a scene whose direct light takes `seconds_of` a number of samples."""
    while (chosen := plan.direct_light_plan(scene)).probe_share > 0.0:
        count = max(round(chosen.probe_share * scene.samples), 1)
        scene = replace(scene, probes=(*scene.probes, plan.Probe(count, seconds_of(count), **probe)))
    return chosen


@pytest.mark.parametrize(
    ("each", "power", "sampling_seconds", "points"),
    [
        (1e-5, 1.0, 0.1, [5]),  # seconds of a sample: all points
        (1e-5, 1.0, 9.0, [2]),  # no time for a second extraction
        (1e-5, 1.0, 0.22, [3, 4]),
        (0.009, 0.7, 0.1, [0, 2, 3, 4]),  # never one alone
        (0.03, 1.0, 0.1, [0]),
        (1.0, 0.5, 0.1, [0]),
    ],
)
def test_direct_light_gets_no_more_points_than_probes_say_there_is_time_for(each, power, sampling_seconds, points):
    scene = replace(SCENE, sampling_seconds=sampling_seconds)

    def seconds_of(count):
        return each * count**power

    chosen = planned(scene, seconds_of, contrast=0.1)
    number = chosen.points_per_pixel
    assert number in points and chosen.reason == ("" if number else too_little(9.0))
    if number == 0:
        return
    samples = 1000 + 200 * (number - 1)
    # The plan goes on from the second probe with a power of its own.
    (_, (share, expected)) = plan.PROBES
    share_of_time = (plan.MORE_SHARE if number > 2 else plan.DIRECT_SHARE) * share ** min(expected - power, 0.0)
    assert seconds_of(samples) <= share_of_time * SECONDS
    # With thin highlights Cycles does better with the time.
    assert planned(scene, seconds_of, contrast=2.0) == plan.DirectLightPlan(0, TOO_THIN)


def test_without_a_budget_or_without_surfaces_all_points_are_shaded():
    for scene in (replace(SCENE, budget=None, seconds_left=None), replace(SCENE, samples=0)):
        assert plan.direct_light_plan(scene) == plan.DirectLightPlan(2)
    # Without any time no probe is worth its time.
    assert plan.direct_light_plan(replace(SCENE, seconds_left=0.0)) == plan.DirectLightPlan(0, too_little(9.0))


def test_depth_of_field_has_all_of_its_points_or_none():
    scene = replace(SCENE, has_lens=True, points=17, most_points=17)
    assert planned(scene, lambda count: 1e-5 * count).points_per_pixel == 17
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
