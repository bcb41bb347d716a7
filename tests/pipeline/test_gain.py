"""What a finished picture takes from LTSH, the denoiser and Cycles, by pictures whose errors are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from ltsh_addon.pipeline import compositing
from ltsh_addon.pipeline.render import _gain, summary

SHAPE, SAMPLES, NOISE, OFF = (60, 120, 3), (30, 20), 1.0, 1.0


def halves(*, ours, denoised, firefly=0.0):
    """`_weights` of pictures of an edge of light: with normal noise `NOISE` of a sample, and a `firefly` in one pixel
    of a half; and with the errors `ours` and `denoised` (H, W) of those that share no noise."""
    random, edge = np.random.default_rng(1), np.where(np.arange(SHAPE[1]) < 60, 1.0, 2.0)[:, None]
    noisy = [edge + NOISE / np.sqrt(count) * random.standard_normal(SHAPE) for count in SAMPLES]
    noisy[0][30, 20] += firefly
    others = [(edge + denoised[..., None], edge + ours[..., None]) for _ in SAMPLES]
    return compositing._weights(noisy, others, SAMPLES), np.square(edge).mean()


def test_each_pixel_is_of_the_picture_with_the_least_error():
    x, y = np.meshgrid(range(SHAPE[1]), range(SHAPE[0]))
    (weights, _), _ = halves(ours=OFF * (x < 60), denoised=OFF * (y < 30))
    # Away from the borders by more than the radius of the means.
    ours, denoised, noisy = ([weight[rows, columns].mean() for rows in (slice(0, 24), slice(36, 60))
                              for columns in (slice(0, 54), slice(66, 120))] for weight in weights)  # fmt: skip
    # Where both err alike, none of them counts; where neither errs, LTSH's does.
    ours[0] = denoised[0] = 0.5 * (1.0 - noisy[0])
    for values, expected in ((noisy, [1, 0, 0, 0]), (ours, [0, 1, 0, 1]), (denoised, [0, 0, 1, 0])):
        # The variance of the halves is 1 / 24 of the other errors; what has none counts as 0.1 of that.
        assert values == pytest.approx(expected, abs=0.04)
    assert sum(weights) == pytest.approx(1.0)


def test_no_noise_surrounds_a_firefly():
    """It has a squared noise of 40, a mean of 0.5 around: its root is a third of the light. The others err by 1."""
    wrong = np.full(SHAPE[:2], OFF)
    ((_, _, noisy), _), _ = halves(ours=wrong, denoised=wrong, firefly=9.0)
    assert noisy[26:35, 16:25].max() < 0.1 and noisy[20, 20] > 0.8


def test_what_errs_in_a_highlight_does_not_count_in_the_dark_around_it():
    """There the clean pictures err by 20, elsewhere not. The mean of their squares would be 20, of the noise 0.04."""
    wrong = np.zeros(SHAPE[:2])
    wrong[30:32, 20:22] = 20.0
    ((_, _, noisy), _), _ = halves(ours=wrong, denoised=wrong)
    assert noisy[30:32, 20:22].min() > 0.9 and noisy[30, 23] < 0.1 and noisy[28, 20] < 0.1


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_pixel_without_a_finite_value_spoils_no_others():
    wrong = np.zeros(SHAPE[:2])
    wrong[30, 20] = np.inf
    (weights, _), _ = halves(ours=wrong, denoised=wrong)
    assert np.isfinite(sum(weights)[:20, :]).all() and sum(weights)[:20, :] == pytest.approx(1.0)


def test_errors_are_those_that_the_pictures_have():
    flat = np.full(SHAPE[:2], 0.1)
    (_, (ours, denoised)), light = halves(ours=0.0 * flat, denoised=flat)
    # The mean of 21,600 squares with a deviation of twice 0.1 x 0.2 is known to 0.0003, of 0.01.
    assert denoised == pytest.approx(0.1 / np.sqrt(light), rel=0.05)
    assert ours < 0.75 * denoised  # the least error is that of 0.1 of the variance of a half, 1 / 24


def begun(*, direct, rest, shining=0.0):
    """A picture of Cycles that was begun: halves of 11 and 9 samples of white surfaces, whose diffuse direct light and
    other light have normal noise with these deviations of a sample, and what shines in sight before a transparent
    film."""
    random, made = np.random.default_rng(2), []

    def planes(name, image):
        return {f"{name}.{channel}": image[..., number].astype(np.float32) for number, channel in enumerate("RGB")}

    for count in (11, 9):
        lit, other = (1.0 + one / np.sqrt(count) * random.standard_normal(SHAPE) for one in (direct, rest))
        black = np.zeros(SHAPE)
        passes = {"Combined": lit + other + shining, "D": lit, "S": black, "E": black + shining, "B": black + 7.0}
        channels = {key: plane for name, image in passes.items() for key, plane in planes(name, image).items()}
        made.append(SimpleNamespace(channels=channels, samples=count))
    names = dict(
        diffuse_light="D", diffuse_color="W", specular_light="S", specular_color="W", emission="E", background="B"
    )
    return SimpleNamespace(
        halves=made, channels=planes("W", np.ones(SHAPE)), names=names, guides={}, shining=("emission",)
    )


@pytest.mark.parametrize("left", [False, True])
def test_first_samples_tell_how_much_of_the_error_is_of_direct_light(left):
    """The means of the squares of 21,600 normal numbers are known to 1 %; without the brightest they are 1 % less."""
    masks = {name: np.full(SHAPE[:2], left) for name in ("diffuse", "specular")}
    errors = compositing.first_errors(begun(direct=0.3, rest=0.1, shining=5.0), masks, "off", None)
    assert errors.samples == 10.0 and not errors.is_denoised
    assert errors.whole.mean() == pytest.approx(0.1 / 10.0, rel=0.05)
    # What is left to Cycles keeps its noise.
    assert errors.rest.mean() == pytest.approx((0.1 if left else 0.01) / 10.0, rel=0.05)
    assert compositing.first_errors(SimpleNamespace(halves=()), masks, "off", None) is None


def test_pictures_without_noise_or_light_are_taken_as_they_are():
    black = np.zeros(SHAPE)
    weights, errors = compositing._weights([black, black], [(black, black)] * 2, SAMPLES)
    assert sum(weights) == pytest.approx(1.0) and errors == (0.0, 0.0)


def test_the_summary_gives_cycles_alone_the_time_of_direct_light():
    lit = {"diffuse": SimpleNamespace(image=np.ones(SHAPE))}
    picture = SimpleNamespace(passes=lit, combined=np.full((*SHAPE[:2], 4), 2.0), errors=(0.01, 0.05))
    finished = {"share_of_ours": {"diffuse": 1.0}, "denoiser": "", "gain": _gain(picture)}
    report = {"finished": finished, "resolution": (4, 3), "sub_samples": 1, "cycles_samples": 2}
    # Four times as long as Cycles took: six times the samples had 0.54 to 0.75 of the error in seven scenes.
    line = summary(report, {"processor": {"cycles": 3.0, "total": 12.0}})[1]
    assert line.endswith("50 % of the light; error of half the samples 1.0 %, of Cycles alone in this time 3.4 %")
    picture.errors = None
    report["finished"]["gain"] = _gain(picture)
    assert summary(report, {})[1].endswith("50 % of the light")
