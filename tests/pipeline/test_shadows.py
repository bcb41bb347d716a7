"""Pictures with shadows, and what `relight` makes of the samples that they keep. No Blender: see `fake_scene`."""

import json
from dataclasses import replace

import fake_scene
import numpy as np
import pytest
from fake_scene import run, wall
from surface_scenes import four_lights, random_samples, shifted

from ltsh_addon import shading, visibility
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.pipeline import lighting

ARGUMENTS = ("--techniques", "ltsh4,reference", "--quiet")


def shade(capsys, monkeypatch, room, output, *arguments, **scene):
    """The channels of a picture of the fake scene."""
    fake_scene.FakeChild(**scene).install(monkeypatch)
    assert run(capsys, "shade", room, "-o", output, *ARGUMENTS, *arguments)[0] == 0
    return read_channels(output / "shade.exr")


def parts(channels, start):
    return {name: values for name, values in channels.items() if name.startswith(start)}


def test_samples_that_see_all_of_their_lights_get_the_same_bits(capsys, monkeypatch, room, out):
    without = shade(capsys, monkeypatch, room, out / "off", "--shadows", "off", wall=wall(9.0))
    shadowed = shade(capsys, monkeypatch, room, out / "on", wall=wall(9.0))
    for name, values in without.items():
        assert np.array_equal(shadowed[name], values), name
    for technique in ("ltsh4", "reference"):
        for name, values in parts(shadowed, f"{technique}_unshadowed.").items():
            assert np.array_equal(values, without[name.replace("_unshadowed", "")])
    visibility = parts(shadowed, "visibility.")
    assert len(visibility) == 2 * 3 and all((values == 1.0).all() for values in visibility.values())
    assert set(shadowed) == set(without) | set(visibility) | set(parts(shadowed, "ltsh4_unsh")) | set(
        parts(shadowed, "reference_unsh")
    )


@pytest.mark.parametrize("count, is_one_call", [(63, False), (64, True)])
def test_many_lights_without_shadows_are_shaded_all_at_once(count, is_one_call):
    """One by one `shade` could not take those together that a sample cannot tell apart."""
    samples, four = random_samples(40, seed=1), four_lights()
    lights = [replace(shifted(four[n % 4], (0.2 * n, 0.0, 1.0)), group=f"{n % 2}") for n in range(2 * count)]
    (found,) = lighting.shade_lights(samples, lights, "ltsh4", ("diffuse",), workers=1)
    rows = [n % 2 for n in range(2 * count)]
    expected = shading.shade(samples, lights, "ltsh4", passes=("diffuse",), workers=1, rows=rows)
    assert np.allclose(found.diffuse, expected.diffuse, rtol=1e-2, atol=1e-4)
    numbers = visibility.shared_numbers(lights)
    seen = lighting.Shadows({"diffuse": np.ones((len(numbers), len(samples)))}, numbers, {}, 0, "")
    shadowed, unshadowed = lighting.shade_lights(samples, lights, "ltsh4", ("diffuse",), (seen, None), workers=1)
    assert np.array_equal(shadowed.diffuse, unshadowed.diffuse)
    assert np.array_equal(found.diffuse, shadowed.diffuse) != is_one_call
    assert not is_one_call or np.array_equal(found.diffuse, expected.diffuse)


def test_behind_a_wall_is_exactly_nothing(capsys, monkeypatch, room, out):
    without = shade(capsys, monkeypatch, room, out / "off", "--shadows", "off")
    shadowed = shade(capsys, monkeypatch, room, out / "on", wall=wall(0.5))
    for technique in ("ltsh4", "reference"):
        light = [parts(shadowed, f"{technique}.{name}") for name in ("specular", "diffuse")]
        assert all(found and not any(values.any() for values in found.values()) for found in light)
    assert np.array_equal(shadowed["ltsh4_unshadowed.diffuse.G"], without["ltsh4.diffuse.G"])
    seen = parts(shadowed, "visibility.specular")
    hit = shadowed["coverage.hit.V"]
    assert all(np.array_equal(values, 1.0 - hit) for values in seen.values())
    report = json.loads((out / "on" / "report.json").read_text(encoding="utf-8"))
    assert report["shadows"]["rays"] > 0 and report["shadows"]["tracer"].startswith("Embree")


def test_light_is_what_the_samples_see_of_it(capsys, monkeypatch, room, out):
    """Half of the lights is hidden: no value is above the unshadowed one, and some are in between."""
    shadowed = shade(capsys, monkeypatch, room, out, "--shadow-rays", "256", wall=wall(0.7, left=0.0))
    found, whole = (shadowed[f"ltsh4{kind}.diffuse.R"] for kind in ("", "_unshadowed"))
    assert (found <= whole).all() and ((found > 0.1 * whole) & (found < 0.9 * whole)).any()


LIGHTS = fake_scene.lights()
CHANGES = "--light", "Light 1", "--power", "x2", "--color", "1,.5,.25", "--light", "Light 0", "--power", "x0"


def changed(lights):
    """CHANGES: the radiance of light 1 is (3, 3, 1), so that its brightest channel is 3."""
    return (
        replace(lights[0], radiance=(0.0, 0.0, 0.0)),
        replace(lights[1], radiance=2.0 * 3.0 * np.array([1.0, 0.5, 0.25])),
        lights[2],
    )


def test_a_picture_lit_anew_is_that_of_other_lights(capsys, monkeypatch, room, out):
    shade(capsys, monkeypatch, room, out, "--keep-visibility")
    rendered = shade(capsys, monkeypatch, room, out / "other", change=changed)
    monkeypatch.undo()
    assert run(capsys, "relight", out, *CHANGES, "--quiet")[0] == 0
    found = read_channels(out / "relit" / "shade.exr")
    assert set(found) == set(rendered)
    for name, values in rendered.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-6, err_msg=name)
    report = json.loads((out / "relit" / "report.json").read_text(encoding="utf-8"))
    expected = {"light": "Light 1", "power": 2.0, "color": [1.0, 0.5, 0.25], "exposure": 0.0, "muted": False}
    assert report["relit"][0] == expected


@pytest.mark.parametrize(
    ("arguments", "factors"),
    [
        (("--light", "Light 0", "--exposure", "-1.5", "--mute", "Light 2"), (2.0**-1.5, 1.0, 0.0)),
        (("--solo", "Light 1", "--solo", "Light 2", "--light", "Light 2", "--exposure", "+1"), (0.0, 1.0, 2.0)),
        (("--solo", "Light 1", "--mute", "Light 1"), (0.0, 0.0, 0.0)),
    ],
)
def test_exposure_mute_and_solo_are_factors_of_power(capsys, monkeypatch, room, out, arguments, factors):
    first = shade(capsys, monkeypatch, room, out, "--keep-visibility")
    assert run(capsys, "relight", out, *arguments, "--quiet")[0] == 0
    found = read_channels(out / "relit" / "shade.exr")
    for layer in ("ltsh4.specular", "ltsh4.diffuse"):
        groups = (first[f"{layer}@{group}.G"] for group in ("Key", "Fill_001", "ungrouped"))
        expected = sum(factor * part for factor, part in zip(factors, groups, strict=True))
        np.testing.assert_allclose(found[f"{layer}.G"], expected, rtol=1e-5, atol=1e-9)


def test_a_picture_lit_anew_keeps_its_shadows(capsys, monkeypatch, room, out):
    """Radiance is linear in that of each light, and each fake light is a group of its own."""
    first = shade(capsys, monkeypatch, room, out, "--keep-visibility", wall=wall(0.7, left=0.0))
    assert run(capsys, "relight", out, *CHANGES, "--quiet")[0] == 0
    found = read_channels(out / "relit" / "shade.exr")
    assert set(found) == set(first)
    factors = [after.radiance / before.radiance for before, after in zip(LIGHTS, changed(LIGHTS), strict=True)]
    for name, values in found.items():
        layer, _, channel = name.rpartition(".")
        if layer not in ("ltsh4.specular", "ltsh4.diffuse", "reference.specular"):
            continue
        groups = (first[f"{layer}@{group}.{channel}"] for group in ("Key", "Fill_001", "ungrouped"))
        expected = sum(factor["RGB".index(channel)] * part for factor, part in zip(factors, groups, strict=True))
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-9, err_msg=name)
    assert all(np.array_equal(found[name], first[name]) for name in parts(first, "visibility."))


def test_weights_that_hang_on_the_former_lights_are_named(capsys, monkeypatch, room, out):
    fake = fake_scene.FakeChild()

    def split(options, *, progress=None, look=None):
        """The first three samples become two each, as where two horizons are apart."""
        found = fake.extract(options, progress=progress)
        index = np.sort(np.concatenate([np.arange(len(found.samples)), np.arange(3)]))
        first = np.diff(index, prepend=-1) > 0
        samples, film = found.samples.take(index), replace(found.film.take(index), first=first)
        normal = np.where(first[:, None], samples.geometric_normal, samples.geometric_normal[:, [1, 2, 0]])
        return replace(found, samples=replace(samples, geometric_normal=normal), film=film)

    fake.install(monkeypatch)
    monkeypatch.setattr(fake_scene.pixels, "extract_pixels", split)
    assert run(capsys, "shade", room, "-o", out, *ARGUMENTS, "--keep-visibility")[0] == 0
    _, stdout, _ = run(capsys, "relight", out, "--light", "Light 2", "--power", "x2", "--json", "--quiet")
    assert any(line.startswith("3 of ") and "weigh both" in line for line in json.loads(stdout)["warnings"])


def test_cycles_picture_of_the_former_lights_is_left_out_with_a_word(capsys, monkeypatch, room, out):
    fake_scene.FakeChild().install(monkeypatch)
    run(capsys, "compare", room, "-o", out, "--keep-visibility", "--techniques", "ltc", "--quiet")
    code, stdout, _ = run(capsys, "relight", out, "--light", "Light 2", "-o", out / "new", "--json", "--quiet")
    assert code == 0 and "Cycles" in json.loads(stdout)["warnings"][-1]
    assert not parts(read_channels(out / "new" / "compare.exr"), "cycles")


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (("--light", "Key"), 1, "light 'Key' is not in the picture; lights there: 'Light 0', 'Light 1', 'Light 2'"),
        (("--power", "x2"), 2, "--power: expected --light NAME before it"),
        (("--light", "Light 0", "--power", "2"), 2, "power is '2', expected x and a factor, such as x2 or x.5"),
        (("--light", "Light 0", "--color", "1,2"), 2, "color is '1,2', expected red, green and blue such as 1,.8,.6"),
        (("--light", "Light 0", "--power", "x1", "--power", "x2"), 2, "--power: given twice for light 'Light 0'"),
        (("--exposure", "+1"), 2, "--exposure: expected --light NAME before it"),
        (("--light", "Light 0", "--exposure", "40"), 2, "exposure is '40', expected a number from -32 to 32"),
        (("--mute", "Key"), 1, "light 'Key' is not in the picture; lights there: 'Light 0', 'Light 1', 'Light 2'"),
        (("--solo", "Key"), 1, "light 'Key' is not in the picture; lights there: 'Light 0', 'Light 1', 'Light 2'"),
        ((), 2, "nothing to change: expected --light NAME with --power, --exposure or --color, --mute or --solo"),
    ],
)
def test_wrong_changes_are_named(capsys, monkeypatch, room, out, arguments, code, complaint):
    shade(capsys, monkeypatch, room, out, "--keep-visibility")
    found = run(capsys, "relight", out, *arguments)
    assert found[0] == code and complaint in found[2] and not (out / "relit").exists()


def test_folders_and_files_that_keep_nothing_are_refused(capsys, monkeypatch, room, out):
    shade(capsys, monkeypatch, room, out)
    code, _, stderr = run(capsys, "relight", out, "--light", "Light 0")
    assert code == 1 and "run shade, compare or render with --keep-visibility" in stderr
    for content in (b"", b"no archive", (out / "shade.exr").read_bytes()[:2000]):
        (out / "shade.samples.npz").write_bytes(content)
        code, _, stderr = run(capsys, "relight", out, "--light", "Light 0")
        assert code == 1 and "is no file of --keep-visibility" in stderr and len(stderr.splitlines()) == 1


def test_much_noise_of_shadows_is_told_with_its_size():
    quiet = lighting.Shadows({}, (), {"specular": 0.02, "diffuse": 0.09}, 0, "")
    assert quiet.warnings() == []
    (told,) = replace(quiet, noise={"specular": 0.02, "diffuse": 0.576}).warnings()
    assert "noise of 58 % of the diffuse light" in told and "specular" not in told and "--shadow-rays" in told
