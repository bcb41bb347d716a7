"""What a finished picture says of its noise, by pictures whose noise is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from ltsh_addon.imaging import Layer
from ltsh_addon.pipeline import compositing
from ltsh_addon.pipeline.render import _gain, summary

SHAPE, SAMPLES, DEVIATION = (64, 96, 3), (30, 10), {"direct": 0.6, "rest": 0.3}
NAMES = {key: key for keys in compositing.DIRECT.values() for key in keys}


def cycles(samples=SAMPLES):
    """A Cycles picture of two files; each sample has normal noise in diffuse direct light and in the rest."""
    random, files = np.random.default_rng(1), []
    for count in samples:
        noise = {name: one / np.sqrt(count) * random.standard_normal(SHAPE) for name, one in DEVIATION.items()}
        light = {"diffuse_light": (1.0 + noise["direct"]) / 0.5, "Combined": 2.0 + noise["direct"] + noise["rest"]}
        light |= {
            "diffuse_color": np.full(SHAPE, 0.5),
            "specular_light": np.zeros(SHAPE),
            "specular_color": np.ones(SHAPE),
        }
        files.append({key: plane for name, one in light.items() for key, plane in Layer(one).planes(name).items()})
    total = sum(samples)
    mean = {key: sum(n / total * file[key] for n, file in zip(samples, files, strict=True)) for key in files[0]}
    facts = {"samples": total, "processor_seconds": 5.0, "least_seconds": 2.0}
    scale = np.sqrt(samples[0] / max(total - samples[0], 1))
    noise = {key: scale * (plane - mean[key]) for key, plane in files[0].items() if len(files) > 1}
    return SimpleNamespace(channels=mean, noise=noise, names=NAMES, **facts)


def passes(is_replaced):
    mask, black, one = np.full(SHAPE[:2], is_replaced), np.zeros(SHAPE), np.ones(SHAPE)
    image = one if is_replaced else black
    return {
        "specular": compositing.DirectPass(black, {}, mask, np.ones(SHAPE[:2]), black, one),
        "diffuse": compositing.DirectPass(image, {}, mask, np.ones(SHAPE[:2]), 2.0 * one, 0.5 * one),
    }


def test_noise_is_that_of_the_mean_of_all_samples_and_what_is_replaced_has_none():
    rest, whole = compositing.noise(cycles(), passes(True))
    # The mean of |x| of a normal deviate is sqrt(2 / pi); 18,432 of them find it within a percent, and the light is 2.
    expected = np.sqrt(2.0 / np.pi) / np.sqrt(sum(SAMPLES)) / 2.0
    assert rest == pytest.approx(expected * DEVIATION["rest"], rel=0.03)
    assert whole == pytest.approx(expected * np.hypot(*DEVIATION.values()), rel=0.03)
    same = compositing.noise(cycles(), passes(False))
    assert same[0] == same[1] == pytest.approx(whole)


def test_cycles_alone_gets_the_time_of_direct_light_for_samples():
    stages = {"extraction": 4.0, "shading": 5.0, "cycles": 5.0, "denoise": 1.0}
    gain, (_, whole) = (
        _gain(cycles(), passes(True), np.full((*SHAPE[:2], 4), 2.0), stages),
        compositing.noise(cycles(), passes(True)),
    )
    assert gain["share_of_light"] == pytest.approx(0.5)
    assert gain["noise_of_cycles"] == pytest.approx(whole / 2.0)  # 9 s more, 3 s for all samples: four times as many
    assert _gain(cycles((8,)), passes(True), np.ones((*SHAPE[:2], 4)), stages)["noise"] is None


def test_the_summary_tells_it():
    gain = {"share_of_light": 0.5, "noise": None, "noise_of_cycles": None}
    finished = {"share_of_ours": {"diffuse": 1.0}, "denoiser": "", "gain": gain}
    report = {"finished": finished, "resolution": (4, 3), "sub_samples": 1, "cycles_samples": 2}
    assert summary(report, {})[1].endswith("50 % of the light")
    gain |= {"noise": 0.01, "noise_of_cycles": 0.025}
    assert summary(report, {})[1].endswith("noise 1.0 % before denoising, Cycles alone in this time 2.5 %")
