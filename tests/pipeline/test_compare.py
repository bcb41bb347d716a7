"""What a comparison writes, on a scene whose Cycles image is known: truth times 1 + and 1 - fake_scene.NOISE."""

import shutil
import struct
from pathlib import Path

import fake_scene
import numpy as np
import pytest
from comparison_runs import FLOAT32, TECHNIQUES, options, written

from ltsh_addon import imaging, scene, shading
from ltsh_addon.pipeline import compare_scene
from ltsh_addon.scene import Cancelled

TABLES = Path(shading.__file__).resolve().parents[2] / "tables"


def test_layers_have_the_names_of_the_design(child, tmp_path):
    compare_scene(options(tmp_path))
    layers = written(tmp_path)
    expected = {"coverage.hit", *(f"samples.{field}" for field in scene.SurfaceSamples.__dataclass_fields__)}
    for pass_name in ("specular", "diffuse"):
        expected |= {f"{image}.{pass_name}" for image in ("cycles", "cycles_A", "cycles_B")}
        for name in TECHNIQUES:
            expected |= {f"{name}.{pass_name}", f"error_{name}.{pass_name}"}
            expected |= {f"{name}.{pass_name}@{group}" for group in ("Key", "Fill.001", "ungrouped")}
    assert set(layers) == expected
    channels = imaging.read_channels(tmp_path / "out" / "compare.exr")
    assert {"ltsh4.specular.R", "error_ltsh4.specular.B", "samples.position.X", "coverage.hit.V"} <= set(channels)
    assert "ltsh4.specular@Key.R" in channels and "samples.roughness.V" in channels
    assert all(plane.dtype == np.float32 and plane.shape == (4, 6) for plane in channels.values())


def test_a_scene_with_one_group_has_no_layers_of_groups(monkeypatch, tmp_path):
    fake_scene.FakeChild(groups=("Key",)).install(monkeypatch)
    compare_scene(options(tmp_path))
    assert not [name for name in written(tmp_path) if "@" in name]


def test_a_group_named_ungrouped_and_lights_without_one_are_both_there(monkeypatch, tmp_path):
    fake_scene.FakeChild(groups=("ungrouped", "")).install(monkeypatch)
    compare_scene(options(tmp_path))
    layers = written(tmp_path)
    first, second = layers["ltc.specular@ungrouped"], layers["ltc.specular@ungrouped_"]
    assert np.allclose(first + second, layers["ltc.specular"], rtol=FLOAT32, atol=0.0) and (first != second).any()


def test_the_error_is_technique_minus_the_mean_of_both_halves(child, tmp_path):
    compare_scene(options(tmp_path))
    layers = written(tmp_path)
    for pass_name in ("specular", "diffuse"):
        mean = 0.5 * (layers[f"cycles_A.{pass_name}"] + layers[f"cycles_B.{pass_name}"])
        assert np.allclose(layers[f"cycles.{pass_name}"], mean, rtol=FLOAT32, atol=0.0) and mean.any()
        for name in TECHNIQUES:
            error = layers[f"{name}.{pass_name}"] - mean
            assert np.abs(layers[f"error_{name}.{pass_name}"] - error).max() <= FLOAT32 * mean.max()
    assert np.abs(layers["error_ltc.specular"]).max() > 1e-3 * layers["cycles.specular"].max()
    assert np.abs(layers["error_reference.specular"]).max() <= FLOAT32 * layers["cycles.specular"].max()


def test_images_are_what_shade_gives_and_light_groups_add_up(child, tmp_path):
    compare_scene(options(tmp_path))
    layers, film = written(tmp_path), fake_scene.film()
    samples = fake_scene.samples(len(film.pixel))
    for name in TECHNIQUES:
        shaded = shading.shade(samples, fake_scene.lights(), name)
        for pass_name in ("specular", "diffuse"):
            image = layers[f"{name}.{pass_name}"]
            assert np.allclose(image, film.image(getattr(shaded, pass_name).sum(axis=0)), rtol=FLOAT32, atol=0.0)
            groups = [layers[f"{name}.{pass_name}@{group}"] for group in ("Key", "Fill.001", "ungrouped")]
            assert np.allclose(sum(groups), image, rtol=FLOAT32, atol=0.0) and all(part.any() for part in groups)
    assert not layers["ltc.specular"][0].any() and not layers["coverage.hit"][0].any()
    assert layers["coverage.hit"][1, 0] == 0.5 and (layers["coverage.hit"][2:] == 1.0).all()


def test_the_sheet_shows_the_specular_pass_whatever_the_order(child, tmp_path, monkeypatch):
    titles = []
    make_sheet = imaging.comparison_sheet
    monkeypatch.setattr(imaging, "comparison_sheet", lambda *a, **k: titles.append(a[0]) or make_sheet(*a, **k))
    compare_scene(options(tmp_path, passes=("diffuse", "specular")))
    assert "specular" in titles[0]


def test_compare_leaves_exactly_its_five_files(child, tmp_path):
    compare_scene(options(tmp_path))
    folder = tmp_path / "out"
    names = {path.name for path in folder.iterdir()}
    assert names == {"compare.exr", "compare.png", "report.html", "report.json", "timing.json"}
    data = (folder / "compare.png").read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    assert data.startswith(b"\x89PNG") and width > 4 * 240 and height > 300
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "ltsh4" in page and "&#x27;Glass&#x27;" in page


def test_tables_given_by_path_get_short_names_of_their_own(child, tmp_path):
    paths = []
    for folder, name in (("a", "my.table.npz"), ("b", "my.table.npz"), ("a", "ltc.npz")):
        (tmp_path / folder).mkdir(exist_ok=True)
        paths.append(str(tmp_path / folder / name))
        shutil.copy(TABLES / "ltsh2.npz", paths[-1])
    report = compare_scene(options(tmp_path, techniques=("ltc", *paths)))
    assert report["tables"] == dict(zip(("ltc", "my_table", "my_table_2", "ltc_2"), ("ltc", *paths), strict=True))
    layers = written(tmp_path)
    assert np.array_equal(layers["my_table.specular"], layers["ltc_2.specular"])
    assert not np.array_equal(layers["ltc.specular"], layers["ltc_2.specular"])


@pytest.mark.parametrize("stage", ["samples", "LTC", "write"])
def test_stopping_at_any_stage_leaves_no_file(child, tmp_path, stage):
    with pytest.raises(Cancelled):
        compare_scene(options(tmp_path), lambda name, fraction: name != stage)
    assert list((tmp_path / "out").iterdir()) == []


def test_progress_tells_every_stage_from_beginning_to_end(child, tmp_path):
    seen = {}
    compare_scene(options(tmp_path), lambda stage, fraction: seen.setdefault(stage, []).append(fraction))
    assert list(seen)[-4:] == ["LTC", "LTSH N=4", "Reference quadrature", "write"]
    for stage in list(seen)[-4:]:
        assert seen[stage][0] == 0.0 and seen[stage][-1] == 1.0 and seen[stage] == sorted(seen[stage])


def test_a_failure_while_the_sheet_is_made_leaves_no_file(child, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("no ink")

    monkeypatch.setattr(imaging, "comparison_sheet", fail)
    with pytest.raises(RuntimeError, match="no ink"):
        compare_scene(options(tmp_path))
    assert list((tmp_path / "out").iterdir()) == []


def test_a_comparison_needs_two_cycles_samples(child, tmp_path):
    with pytest.raises(ValueError, match="cycles_samples is 1, expected at least 2"):
        compare_scene(options(tmp_path, cycles_samples=1))
    assert child.asked == [] and not (tmp_path / "out").exists()
