"""How far a job is as a whole, by the stages that it reports, with a clock that the tests turn."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltsh_addon.blender.ui.job import MOST, PRIOR_SECONDS, Plan, Run, Step, progress_text, steps
from ltsh_addon.pipeline.options import BakeOptions, PictureOptions

STAGES = ("open", "samples", "Cycles A", "Cycles B", "images")


def plan_of(*costs, stages=STAGES):
    clock = SimpleNamespace(now=100.0)
    return Plan([Step(stage, cost) for stage, cost in zip(stages, costs, strict=False)], lambda: clock.now), clock


@given(
    costs=st.lists(st.floats(0.0, 1e3), min_size=5, max_size=5),
    reports=st.lists(
        st.tuples(st.sampled_from([*STAGES, "?"]), st.floats(-0.5, 1.5), st.floats(0.0, 1e3)), max_size=30
    ),
)
def test_the_share_that_is_done_never_falls_whatever_is_reported(costs, reports):
    plan, clock = plan_of(*costs)
    shares, numbers = [0.0], [1]
    for stage, fraction, seconds in reports:
        plan.report(stage, fraction)
        shares.append(plan.share())
        clock.now += seconds
        shares.append(plan.share())
        numbers.append(plan.number)
        assert 0.0 <= plan.seconds_left() < float("inf")
    assert shares == sorted(shares) and shares[-1] <= MOST
    assert numbers == sorted(numbers) and numbers[-1] <= plan.count == 5


def test_a_job_that_takes_what_was_expected_goes_on_evenly():
    plan, clock = plan_of(10.0, 30.0, 40.0, 20.0)
    for stage, cost in zip(STAGES, (10.0, 30.0, 40.0, 20.0), strict=False):
        plan.report(stage, 0.0)
        for tenth in range(1, 10):
            clock.now += cost / 10.0
            plan.report(stage, tenth / 10.0)
            done = clock.now - 100.0
            assert plan.share() == pytest.approx(done / 100.0, abs=1e-9)
            assert plan.seconds_left() == pytest.approx(100.0 - done, abs=1e-9)
        clock.now += cost / 10.0


def test_a_stage_that_reports_nothing_goes_on_and_does_not_end():
    plan, clock = plan_of(10.0, 10.0)
    plan.report("open", 0.0)
    shares = []
    for clock.now in range(101, 200):
        shares.append(plan.share())
    assert all(later > earlier for earlier, later in itertools.pairwise(shares))
    assert shares[4] > 0.2 and plan.seconds_left() > 10.0


def test_a_machine_that_is_slower_makes_the_rest_longer():
    plan, clock = plan_of(10.0, 10.0, 10.0)
    clock.now += 40.0
    plan.report("samples", 0.0)
    pace = (40.0 + PRIOR_SECONDS) / (10.0 + PRIOR_SECONDS)
    assert plan.seconds_left() == pytest.approx(20.0 * pace)


def test_a_stage_that_is_late_makes_the_rest_longer_before_it_ends():
    plan, clock = plan_of(10.0, 10.0)
    clock.now += 40.0
    pace = (40.0 + PRIOR_SECONDS) / (10.0 + PRIOR_SECONDS)
    assert plan.seconds_left() >= 10.0 * pace


def test_a_stage_that_comes_again_is_expected_to_take_as_long_again():
    plan, clock = plan_of(1.0, 5.0, 1.0, 5.0, stages=("open", "samples", "open", "samples"))
    clock.now += 2.0
    plan.report("samples", 0.0)
    clock.now += 30.0
    plan.report("open", 0.0)
    assert plan.number == 3 and plan.seconds_left() == pytest.approx(32.0)


def test_a_job_is_expected_to_take_as_long_as_the_last_one():
    """Of twice the size, on a machine that takes three times as long for samples and ten times for the rest."""
    costs, paces = (2.0, 30.0, 20.0), (10.0, 3.0, 10.0)
    plan, clock = plan_of(*costs)
    for stage, cost, pace in zip(STAGES, costs, paces, strict=False):
        plan.report(stage, 0.0)
        clock.now += cost * pace
    seen = {}
    plan.end(seen)
    assert seen == {
        stage.split()[0]: (cost * pace, cost) for stage, cost, pace in zip(STAGES, costs, paces, strict=False)
    }
    larger = [Step(stage, 2.0 * cost) for stage, cost in zip(STAGES, costs, strict=False)]
    takes = sum(2.0 * cost * pace for cost, pace in zip(costs, paces, strict=True))
    assert Plan(larger, lambda: clock.now).seconds_left() < takes / 4.0
    assert Plan(larger, lambda: clock.now, seen).seconds_left() == pytest.approx(takes, rel=0.15)


def test_stages_that_no_job_had_are_expected_at_the_pace_of_all_and_objects_of_a_bake_are_alike():
    seen = {"bake": (80.0, 40.0), "open": (40.0, 20.0)}
    plan = Plan([Step("bake wall", 100.0), Step("images", 100.0)], lambda: 0.0, seen)
    assert plan.seconds_left() == pytest.approx(400.0, rel=0.1)


def test_a_small_job_says_little_about_a_large_one():
    """A stage that took a second for next to nothing."""
    assert Plan([Step("open", 100.0)], lambda: 0.0, {"open": (1.0, 0.001)}).seconds_left() < 250.0


def test_a_job_that_ends_early_teaches_what_it_has_done():
    plan, clock = plan_of(10.0, 10.0, 10.0)
    clock.now += 20.0
    plan.report("samples", 0.5)
    clock.now += 3.0
    seen = {}
    plan.end(seen)
    assert seen == {"open": (20.0, 10.0)}


def test_stages_that_are_left_out_are_passed_over_and_unknown_ones_change_nothing():
    plan, _ = plan_of(1.0, 1.0, 1.0, 1.0, 1.0)
    plan.report("Cycles B", 0.0)
    assert plan.number == 4
    for stage in ("samples", "something else"):
        plan.report(stage, 0.5)
        assert plan.number == 4


@given(guess=st.floats(0.4, 3.0), half=st.floats(20.0, 200.0), fraction=st.floats(0.05, 0.95))
def test_a_time_left_that_is_told_without_about_is_right_within_a_factor_of_two(guess, half, fraction):
    """The halves of Cycles are alike, and what comes after them takes up to three times as long as expected."""
    rest = 0.3 * half
    plan, clock = plan_of(2.0, 1.0, 10.0, 10.0, rest / guess)
    for stage in STAGES[:2]:
        plan.report(stage, 0.0)
        clock.now += 1.5
    plan.report("Cycles A", 0.0)
    clock.now += half * fraction
    plan.report("Cycles A", fraction)
    left, text = half * (2.0 - fraction) + rest, progress_text(plan, clock.now - 100.0)
    assert plan.is_sure == ("left" in text and "about" not in text)
    assert not plan.is_sure or left / 2.0 <= plan.seconds_left() <= 2.0 * left


def test_no_time_left_is_told_before_anything_is_measured_and_then_it_is_rough():
    plan, clock = plan_of(1.0, 1.0, 1.0, 1.0, 1.0)
    texts = []
    for clock.now in (103.0, 109.0, 111.0, 160.0):
        texts.append(progress_text(plan, clock.now - 100.0))
    assert ["left" in text for text in texts] == [False, False, True, True]
    assert "about 0:10 left" in texts[2] and "about" in texts[3]
    seen = {}
    for stage in STAGES:
        plan.report(stage, 0.0)
        clock.now += 10.0
    plan.end(seen)
    again = Plan([Step(stage, 1.0) for stage in STAGES], lambda: clock.now, seen)
    clock.now += 3.0
    assert "left" in progress_text(again, 3.0) and "about" not in progress_text(again, 3.0)


def test_shadows_of_a_bake_and_the_points_at_their_edges_are_expected_to_take_time():
    def shading(**options):
        values = {"objects": ("A",), "size": (512, 512), "passes": ("diffuse_light",), **options}
        run = Run("bake", BakeOptions(Path("any.blend"), output=Path("out"), **values))
        return next(step.cost for step in steps([run]) if step.stage == "shade A")

    bare, shadowed = shading(shadows="off"), shading(shadows="on")
    # Measured on a floor: shading 0.1 s, shadows 2.5 s, two thirds of it are points at edges; in a room a half. There
    # 0.22 million texels took 5.6 s of two cores.
    assert shadowed > 5.0 * bare
    assert 2.0 * shadowed < shading(shadows="on", bounces="on") < 4.0 * shadowed
    assert 0.5 < shading(shadows="on", bounces="on") / (0.26 * 5.6 / 0.22) < 2.0
    assert shading(shadows="on", shadow_rays=1024) > 1.5 * shadowed
    assert shading(shadows="off", passes=("combined",)) > 2.0 * bare


# What pictures of 480 x 270 pixels with 4 points told on one idle core: after how many seconds, stage, fraction; or the
# seconds that were expected of stages. A product shot with bumps, anisotropic metal and a world that varies; gold under
# ten lights; the example scene.
RECORDED = {
    "product": (
        (1.1, "open scene", 0.0), (2.4, "samples", 0.0),
        (8.7, {"horizons": 19.1, "shadows": 37.5, "LTSH N=4": 34.3}), (9.2, "horizons", 0.0), (13.2, "horizons", 0.25),
        (17.2, "horizons", 0.5), (25.8, "shadows", 0.015), (30.2, "shadows", 0.14), (39.2, "shadows", 0.37),
        (48.0, "shadows", 0.57), (56.9, "shadows", 0.78), (65.1, "shadows", 0.95), (66.8, "LTSH N=4", 0.0),
        (74.6, "LTSH N=4", 0.1), (84.0, "LTSH N=4", 0.22), (97.6, "LTSH N=4", 0.38), (110.6, "LTSH N=4", 0.51),
        (121.2, "LTSH N=4", 0.67), (126.6, "write", 0.0), (127.3, "end", 0.0),
    ),
    "jewelry": (
        (1.1, "open scene", 0.0), (1.7, "samples", 0.0),
        (7.9, {"horizons": 2.5, "shadows": 40.7, "LTSH N=4": 19.4}), (8.1, "horizons", 0.0), (12.2, "horizons", 0.99),
        (14.0, "shadows", 0.02), (23.0, "shadows", 0.27), (32.6, "shadows", 0.51), (41.4, "shadows", 0.76),
        (50.1, "LTSH N=4", 0.0), (54.5, "LTSH N=4", 0.48), (58.7, "LTSH N=4", 0.83), (66.0, "write", 0.0),
        (66.5, "end", 0.0),
    ),
    "arcade": (
        (1.1, "open scene", 0.0), (2.6, "samples", 0.0), (8.1, {"horizons": 1.8, "shadows": 21.6, "LTSH N=4": 6.9}),
        (8.2, "horizons", 0.0), (10.8, "shadows", 0.06), (15.1, "shadows", 0.39), (19.0, "shadows", 0.56),
        (23.1, "shadows", 0.78), (26.7, "shadows", 0.89), (28.2, "LTSH N=4", 0.0), (31.7, "LTSH N=4", 0.82),
        (34.0, "write", 0.0), (34.6, "end", 0.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDED)
def test_the_time_left_of_real_pictures_is_right_within_a_factor_of_two_after_ten_seconds(name):
    options = {"techniques": ("ltsh4",), "resolution": (480, 270), "sub_samples": 4, "shadows": "on"}
    run, clock = (
        Run("shade", PictureOptions(Path("any.blend"), output=Path("out"), **options)),
        SimpleNamespace(now=0.0),
    )
    plan, messages = Plan(steps([run]), lambda: clock.now), list(RECORDED[name])
    end = messages[-1][0]
    for second in range(1, int(end)):
        while messages[0][0] <= second:
            clock.now, *message = messages.pop(0)
            plan.report(*message) if len(message) == 2 else plan.expect(*message)
        clock.now = second
        # Nobody minds a few seconds.
        if second >= 10 and end - second > 15.0:
            assert 0.5 <= plan.seconds_left() / (end - second) <= 2.0, second
