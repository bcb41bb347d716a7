"""The light mixer: a kept picture as the sum of its lights. No Blender: see `fake_scene`."""

from dataclasses import replace

import fake_scene
import numpy as np
import pytest
from fake_scene import run, wall
from surface_scenes import shifted

from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.pipeline import lighting, relight
from ltsh_addon.pipeline.mixer import (
    NOT_SHADED,
    REST,
    SHARED_OUT,
    WEAKEST,
    LightPictures,
    Mixer,
    MixerRow,
    _members,
    _row,
    light_pictures,
    moved_light,
)
from ltsh_addon.pipeline.relight import RelightData, write_relight_data
from ltsh_addon.scene import Cancelled
from ltsh_addon.visibility import Occluders

# float32 sums of three lights in another order, and what EXR files hold of them.
ROUNDING = 1e-5


def shade(capsys, monkeypatch, room, output, *arguments, **scene):
    """The whole light (H, W, 3) of a picture of the fake scene by LTSH 4."""
    fake_scene.FakeChild(**scene).install(monkeypatch)
    words = ("--techniques", "ltc,ltsh4,reference", "--keep-visibility", "--quiet", *arguments)
    assert run(capsys, "shade", room, "-o", output, *words)[0] == 0
    channels = read_channels(output / "shade.exr")
    return sum(np.stack([channels[f"ltsh4.{name}.{c}"] for c in "RGB"], -1) for name in ("specular", "diffuse"))


def kept_in(output):
    return RelightData.load(output / "shade.samples.npz")


def mixed(mixer, factors):
    """With row 0 on top."""
    found = mixer.mixed(factors)
    assert (found[..., 3] == 1.0).all()
    return found[::-1, :, :3].copy()


FACTORS = np.array([[0.5, 0.5, 0.5], [2.0, 3.0, 4.0], [0.0, 0.0, 0.0]])


def changed(lights):
    return tuple(replace(one, radiance=one.radiance * factor) for one, factor in zip(lights, FACTORS, strict=True))


def test_a_mixed_picture_is_that_of_other_lights(capsys, monkeypatch, room, out):
    first = shade(capsys, monkeypatch, room, out / "first")
    second = shade(capsys, monkeypatch, room, out / "second", change=changed)
    mixer = Mixer(light_pictures(kept_in(out / "first")))
    assert [row.name for row in mixer.rows] == ["Light 0", "Light 1", "Light 2"]
    np.testing.assert_allclose(mixed(mixer, np.ones((3, 3))), first, rtol=ROUNDING, atol=ROUNDING * first.max())
    np.testing.assert_allclose(mixed(mixer, FACTORS), second, rtol=ROUNDING, atol=ROUNDING * second.max())


def test_shadows_stay_while_all_lights_change_alike(capsys, monkeypatch, room, out):
    """Then rays are chosen as before; else noise differs."""
    scene = {"wall": wall(0.7, left=0.0)}
    first = shade(capsys, monkeypatch, room, out / "first", **scene)
    scene["change"] = lambda lights: tuple(replace(one, radiance=2.0 * one.radiance) for one in lights)
    second = shade(capsys, monkeypatch, room, out / "second", **scene)
    mixer = Mixer(light_pictures(kept_in(out / "first")))
    for factor, expected in ((1.0, first), (2.0, second)):
        found = mixed(mixer, np.full((3, 3), factor))
        np.testing.assert_allclose(found, expected, rtol=ROUNDING, atol=ROUNDING * expected.max())


def random_mixer(rows=5, size=(40, 30)):
    random = np.random.default_rng(7)
    layers = random.random((rows, *size, 3)).astype(np.float32) * 10.0 ** random.integers(-3, 4, (rows, 1, 1, 1))
    names = [MixerRow(f"Light {number}", (f"Light {number}",)) for number in range(rows)]
    return Mixer(LightPictures(tuple(names), layers, np.ones(size, np.float32), {})), layers


def test_any_order_of_changes_gives_the_same_bits():
    """Whatever sums are kept meanwhile: nothing adds up."""
    mixer, layers = random_mixer()
    random, factors = np.random.default_rng(8), np.ones((5, 3))
    for _ in range(60):
        for row in random.choice(5, random.choice([1, 1, 1, 2, 5]), replace=False):
            factors[row] = random.choice([0.0, 1.0, random.random()])
        found = mixed(mixer, factors)
        expected = np.einsum("rc,rhwc->hwc", factors, layers.astype(float))
        # Five products and five sums of positive numbers.
        np.testing.assert_allclose(found, expected, rtol=10 * 2.0**-24, atol=1e-30)


def test_pictures_of_lights_are_read_back(tmp_path):
    mixer, _ = random_mixer()
    mixer.replace(2, MixerRow("Other", ("Other",)), np.full((40, 30, 3), 7.0))
    mixer.pictures.save(tmp_path / "lights.npz")
    found = LightPictures.load(tmp_path / "lights.npz")
    assert found.rows == mixer.rows and np.array_equal(found.layers, mixer.pictures.layers)
    assert (found.layers[2] == 7.0).all()
    whole = (tmp_path / "lights.npz").read_bytes()
    for content in (b"", b"no archive", whole[:3000], whole[:-30000]):
        (tmp_path / "lights.npz").write_bytes(content)
        with pytest.raises(ValueError, match="is no file of the light mixer"):
            LightPictures.load(tmp_path / "lights.npz")


def test_lights_that_change_together_are_one_row(capsys, monkeypatch, room, out):
    """Those of one name, as faces of a lamp, those that share rays, and the weakest of very many."""
    shade(capsys, monkeypatch, room, out)
    kept = kept_in(out)
    lights = [replace(kept.extraction.lights[0], name=f"L{n // 2}", radiance=[1.0 + n] * 3) for n in range(6)]
    shadows = lighting.Shadows({}, ((0,), (1, 2), (3,), (4,), (5,)), {}, 0, "")
    assert _members(lights, None) == [[0, 1], [2, 3], [4, 5]]
    assert _members(lights, shadows) == [[0, 1, 2, 3], [4, 5]]
    many = [replace(lights[0], name=f"M{n}", radiance=[100.0 - n] * 3) for n in range(100)]
    members = _members(many, None)
    assert len(members) == 64 and members[-1] == list(range(63, 100))
    assert [len(own) for own in _members(many, None, 8)] == [1] * 7 + [93]
    row = _row(replace(kept.extraction, lights=tuple(many)), members[-1])
    assert row.name == "M63 and 36 more" and row.note == WEAKEST


def test_a_finished_picture_lit_anew_keeps_the_rest(capsys, monkeypatch, room, out):
    whole = shade(capsys, monkeypatch, room, out / "first")
    kept, random = kept_in(out / "first"), np.random.default_rng(3)
    rest, taken = (
        random.random((*whole.shape[:2], 4)),
        {name: random.random(whole.shape[:2]) for name in ("specular", "diffuse")},
    )
    path = out / "finished" / "render.samples.npz"
    path.parent.mkdir()
    write_relight_data(kept.extraction, None, options(room, out), path, rest={"": rest}, taken=taken)
    found = run(capsys, "relight", out / "finished", "--light", "Light 1", "--power", "x3", "--json", "--quiet")
    assert found[0] == 0 and relight.SAME_REST.format("") in found[1]
    channels = read_channels(out / "finished" / "relit" / "render.exr")
    assert np.allclose(channels["rest.A"], rest[..., 3]) and np.allclose(channels["combined.A"], rest[..., 3])
    pictures = light_pictures(RelightData.load(path))
    expected = np.einsum("rhwc,r->hwc", pictures.layers, [1.0, 3.0, 1.0, 1.0])
    combined = np.stack([channels[f"combined.{letter}"] for letter in "RGB"], axis=-1)
    np.testing.assert_allclose(combined, expected, rtol=1e-5, atol=1e-6)


def test_bounced_light_follows_a_group_also_where_its_lights_change_differently(capsys, monkeypatch, room, out):
    """The command and the mixer share it out alike. A group without a light of ours has a row, and stays."""
    whole = shade(capsys, monkeypatch, room, out / "first", groups=("Key", "Key", ""))
    kept, random = kept_in(out / "first"), np.random.default_rng(4)
    shape, path = whole.shape[:2], out / "finished" / "render.samples.npz"
    rest = {"": random.random((*shape, 4)), "Key": random.random((*shape, 3)), "Sky": random.random((*shape, 3))}
    taken = {name: np.ones(shape) for name in ("specular", "diffuse")}
    path.parent.mkdir()
    write_relight_data(
        kept.extraction, None, replace(options(room, out), techniques=("ltsh4",)), path, rest=rest, taken=taken
    )
    pictures = light_pictures(RelightData.load(path))
    names = [row.name for row in pictures.rows]
    assert names == ["Light 0", "Light 1", "Light 2", "Light group Sky", REST]
    assert pictures.rows[3].note == NOT_SHADED
    for changes, factors in (
        (("Light 1", "--power", "x3"), [1.0, 3.0, 1.0, 1.0, 1.0]),
        (("Light 0", "--power", "x2", "--light", "Light 1", "--power", "x2"), [2.0, 2.0, 1.0, 1.0, 1.0]),
        (("Light 2", "--power", "x0"), [1.0, 1.0, 0.0, 1.0, 1.0]),
    ):
        found = run(capsys, "relight", out / "finished", "--light", *changes, "--json", "--quiet")
        assert found[0] == 0 and "but for that of light groups" in found[1]
        channels = read_channels(out / "finished" / "relit" / "render.exr")
        combined = np.stack([channels[f"combined.{letter}"] for letter in "RGB"], axis=-1)
        expected = np.einsum("rhwc,r->hwc", pictures.layers, factors)
        np.testing.assert_allclose(combined, expected, rtol=1e-5, atol=1e-6)


def options(room, output):
    from ltsh_addon.pipeline.options import PictureOptions

    return PictureOptions(room, output, techniques=("ltc", "ltsh4"))


def test_bounced_light_of_several_lights_is_shared_out(capsys, monkeypatch, room, out):
    shade(capsys, monkeypatch, room, out, groups=("Key", "Key", ""))
    kept = kept_in(out)
    bounced = np.full((fake_scene.HEIGHT, fake_scene.WIDTH, 3), 0.25)
    found = light_pictures(replace(kept, rest={"Key": bounced}))
    plain = light_pictures(kept)
    more = found.layers - plain.layers
    np.testing.assert_allclose(more.sum(axis=0), bounced, rtol=1e-5)
    assert (more[0] > 0.01).all() and (more[1] > 0.01).all() and (more[2] == 0.0).all()
    assert found.facts["notes"] == [SHARED_OUT.format("Key", "'Light 0', 'Light 1'")]


def test_a_moved_light_is_as_in_a_new_picture(capsys, monkeypatch, room, out):
    occluders = {"wall": wall(0.7, left=0.0)}
    before = shade(capsys, monkeypatch, room, out / "first", **occluders)

    def move(lights):
        return shifted(lights[0], (0.3, -0.2, 0.1)), *lights[1:]

    shade(capsys, monkeypatch, room, out / "second", **occluders, change=move)
    kept, expected = kept_in(out / "first"), light_pictures(kept_in(out / "second"))
    mixer = Mixer(light_pictures(kept))
    shares, row = [], mixer.rows[0]
    given = kept, Occluders.load(out / "first" / "shade.occluders.npz"), move(kept.extraction.lights)[0], row
    moved = moved_light(*given, shares.append)
    assert shares == sorted(shares) and 0.0 < shares[0] < shares[-1] <= 1.0
    # It can be stopped.
    with pytest.raises(Cancelled):
        moved_light(*given, lambda share: False)
    # Rays of both are as many as the share of the light in all light, which differs, asks for.
    assert np.abs(moved - expected.layers[0]).mean() < 0.02 * expected.layers[0].mean()
    mixer.replace(0, mixer.rows[0], moved)
    assert not np.allclose(mixed(mixer, np.ones((3, 3))), before, rtol=0.05)


def test_no_samples_give_a_black_picture(capsys, monkeypatch, room, out):
    shade(capsys, monkeypatch, room, out, empty=True)
    pictures = light_pictures(kept_in(out))
    assert pictures.layers.shape == (3, fake_scene.HEIGHT, fake_scene.WIDTH, 3) and not pictures.layers.any()
