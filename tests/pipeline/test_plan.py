"""The plan of a finished picture, from measured numbers alone."""

from dataclasses import replace

import numpy as np
import pytest

from ltsh_addon.blender.process.pixels import TOO_LITTLE_GAIN, TOO_LITTLE_TIME
from ltsh_addon.pipeline import plan
from ltsh_addon.pipeline.compositing import FirstErrors
from ltsh_addon.pipeline.options import RenderOptions

SECONDS = 30.0  # that remain for direct light and Cycles' samples
SIDE = plan.SQUARE
# Of 4 x 5 squares: what LTSH wins of the squared error in each. All of them err by REST more.
WINS, REST = 8.0 * 0.7 ** np.arange(20.0), 0.2


def errors_of(wins, rest=REST, is_denoised=True):
    """Errors of Cycles' samples with these `wins` (4 N,) of the squares, row by row."""
    won = np.kron(wins.reshape(4, -1), np.ones((SIDE, SIDE)))
    return FirstErrors(10.0, rest + won, np.full(won.shape, rest), is_denoised)


SCENE = plan.SceneMeasurements(
    seconds_left=SECONDS + 0.5,
    edge_seconds=0.5,
    points=5,
    has_lens=False,
    cycles_samples=20,
    sample_seconds=0.1,
    squares=plan.Squares(errors_of(WINS)),
)
ONE, EVERY = 50, 90  # samples of a square with one and with five points


def planned(scene, seconds_of, variance=0.0):
    """The final plan of a scene whose direct light takes `seconds_of` a number of samples; `variance` is that of its
    points over what it wins, in every square."""
    chosen = plan.direct_light_plan(scene)
    if not chosen.needs_probe:
        return chosen
    counts = np.full(chosen.squares, ONE), np.full(chosen.squares, EVERY)
    probe = plan.Probe(EVERY, seconds_of(EVERY), np.full(3, variance), *counts)
    return plan.direct_light_plan(replace(scene, probe=probe))


def left_error(points, squares, seconds, variance):
    """The squared error in this case, in the words of the plan's docstring; in units of a square's pixels."""
    noise = ((20 + (SECONDS - seconds) / 0.1) / 10.0) ** plan.SAMPLES_POWER
    total = 0.0
    for number, win in enumerate(WINS):
        direct = plan.GAIN_SHARE * win * noise if number < squares else 0.0
        of_points = variance * points**plan.POINTS_POWER / noise
        total += (REST + win) * noise - direct / (1.0 + of_points)
    return total


@pytest.mark.parametrize("variance", [0.0, 0.3, 30.0])
@pytest.mark.parametrize("each", [1e-6, 1e-3, 3e-3, 1e-2, 10.0])
def test_direct_light_gets_the_points_and_squares_that_leave_the_least_error(each, variance):
    """Of a scene whose samples all take the same time. What the plan expects of all from the probe is less, by its
    power."""
    chosen, errors = planned(SCENE, lambda count: each * count, variance), {}
    read = plan.direct_light_plan(SCENE).squares
    for points in range(plan.FEWEST_POINTS, 6):
        for squares in {int(np.ceil(share * read)) for share in plan.SHARES}:
            samples = squares * (ONE + (points - 1) * (EVERY - ONE) / 4)
            seconds = each * EVERY * (samples / EVERY) ** plan.PROBE_POWER
            errors[points, squares] = left_error(points, squares, seconds, variance) if seconds < SECONDS else np.inf
    best = min(errors, key=errors.get)
    is_less = errors[best] <= (1.0 - plan.LEAST_GAIN) * left_error(1, 0, 0.0, 0.0)
    assert chosen == (plan.DirectLightPlan(*best) if is_less else plan.DirectLightPlan(reason=TOO_LITTLE_GAIN))
    if each == 10.0 or variance == 30.0:
        assert chosen.points_per_pixel == 0
    if each == 1e-6 and variance < 30.0:
        assert chosen.points_per_pixel == (5 if variance else 3) and chosen.squares == read
    if each == 1e-2 and variance == 0.3:
        assert 0 < chosen.squares < read


def test_squares_are_read_in_a_share_of_the_time_or_all_where_each_light_is_wanted():
    pixels = 20 * SIDE**2
    read = [plan.direct_light_plan(replace(SCENE, seconds_left=0.5 + time)).squares for time in (0.2, 30.0)]
    expected = plan.READ_SHARE * 0.2 / (plan.READ_SECONDS * 5 * pixels)
    assert 0.0 < expected < 1.0 and read == [int(np.ceil(20 * expected)), 20]
    every = planned(replace(SCENE, seconds_left=20.5, points=50, needs_all=True), lambda count: 1e-7 * count)
    assert every.squares == 20


def test_where_direct_light_is_not_what_is_noisy_not_even_a_probe_is_shaded():
    few = replace(SCENE, squares=plan.Squares(errors_of(0.1 * WINS, rest=2.0)))
    assert plan.direct_light_plan(few) == plan.DirectLightPlan(0, 20, TOO_LITTLE_GAIN)
    assert plan.direct_light_plan(SCENE).needs_probe
    # Where nothing is noisy the noise that is taken off may be more than the errors.
    clean = plan.Squares(errors_of(-WINS, rest=-1.0))
    assert clean.whole < 0.0 and not plan.direct_light_plan(replace(SCENE, squares=clean)).needs_probe
    # A probe takes its time, too.
    assert not plan.direct_light_plan(replace(SCENE, seconds_left=3.0)).needs_probe


def test_what_squares_win_by_chance_does_not_count():
    """Nothing is won in truth. Those 1,000 of 2,000 squares that seem best seem to win 0.8 each."""
    squares = plan.Squares(errors_of(np.random.default_rng(3).standard_normal(2000)))
    assert np.cumsum(squares.gain)[999] / SIDE**2 == pytest.approx(800, rel=0.1)
    # The sum of all has a deviation of 45.
    assert squares.gains.max() / SIDE**2 < 3 * 45


def test_squares_are_those_of_the_picture():
    squares = plan.Squares(errors_of(WINS[::-1]))
    image = np.kron(np.arange(20.0).reshape(4, 5), np.ones((SIDE, SIDE)))
    assert (squares.sums(image) == SIDE**2 * np.arange(19.0, -1.0, -1.0)).all()
    assert (squares.pixels(slice(3)) == (image > 16.0)).all() and (squares.pixels([19]) == (image == 0.0)).all()
    assert squares.sums(pixels=np.flatnonzero(image == 18.0))[1] == SIDE**2
    # A picture may end within a square.
    errors = errors_of(WINS)
    cut = plan.Squares(replace(errors, whole=errors.whole[:-3, :-2], rest=errors.rest[:-3, :-2]))
    assert cut.sums().sum() == (4 * SIDE - 3) * (5 * SIDE - 2) and len(cut.gain) == 20


def test_squares_that_there_is_no_time_for_are_not_shaded_even_if_nothing_else_errs():
    clean = replace(SCENE, squares=plan.Squares(errors_of(WINS, rest=0.0)))
    plans = [planned(clean, lambda count, each=each: each * count, 0.1) for each in (1e-6, 1e-1, 1.0)]
    assert plans[0] == plan.DirectLightPlan(5, 20) and plans[2].points_per_pixel == 0
    # All squares with three points take each x 90 x (20 x 70 / 90)^0.8 s, 807 each.
    assert plans[1] == plan.DirectLightPlan(reason=TOO_LITTLE_GAIN) or plans[1].squares < 20
    assert 807 * 1e-1 > SECONDS


def test_a_probe_that_meets_no_surface_leaves_all_to_cycles():
    probe = plan.Probe(0, 0.0, np.zeros(0), np.zeros(20), np.zeros(20))
    assert plan.direct_light_plan(replace(SCENE, probe=probe)) == plan.DirectLightPlan(reason=TOO_LITTLE_GAIN)


def test_without_a_denoiser_samples_count_for_more():
    """So direct light may take less of the time."""
    worth = {}
    for is_denoised in (True, False):
        scene = replace(SCENE, squares=plan.Squares(errors_of(WINS, is_denoised=is_denoised)))
        times = np.geomspace(1e-5, 1e-1, 40)
        worth[is_denoised] = sum(planned(scene, lambda n, t=t: t * n).points_per_pixel > 0 for t in times)
    assert worth[True] > worth[False] > 0


def test_without_time_or_errors_no_probe_is_shaded():
    for scene in (replace(SCENE, seconds_left=0.0), replace(SCENE, squares=None)):
        assert plan.direct_light_plan(scene) == plan.DirectLightPlan(reason=TOO_LITTLE_TIME)


def test_depth_of_field_has_all_of_its_points_or_none():
    scene = replace(SCENE, has_lens=True)
    assert planned(scene, lambda count: 1e-5 * count, 9.0).points_per_pixel == 5
    assert planned(scene, lambda count: 1.0 * count).points_per_pixel == 0


def test_without_a_budget_points_follow_the_samples_alone_so_that_every_run_gives_the_same_picture(tmp_path):
    options = RenderOptions(tmp_path / "room.blend", output=tmp_path)
    assert plan.most_points(options) == plan.DEFAULT_POINTS
    points = [plan.most_points(replace(options, cycles_samples=count)) for count in (1, 63, 64, 128, 4096)]
    assert points == [0, 0, 2, 4, plan.DEFAULT_POINTS]
    few = replace(options, cycles_samples=1)
    # What was asked for is shaded, as is what other powers of lights need.
    assert plan.most_points(replace(few, sub_samples=5)) == 5
    for wanted in ({"keep_visibility": True}, {"own_groups": ()}):
        assert plan.most_points(replace(few, **wanted)) == plan.FEWEST_POINTS


def test_a_budget_may_have_more_points(tmp_path):
    budget = RenderOptions(tmp_path / "room.blend", output=tmp_path, budget=5.0)
    assert plan.most_points(budget) == plan.MOST_POINTS
    assert [plan.most_points(replace(budget, sub_samples=count)) for count in (2, 40)] == [2, 40]


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
