"""What a comparison writes, on a scene whose Cycles image is known: truth times 1 + and 1 - fake_scene.NOISE."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import fake_scene
import numpy as np
import pytest

from ltsh_addon import imaging, scene, shading
from ltsh_addon.imaging.exr import group_names
from ltsh_addon.pipeline import PictureOptions, compare_scene, comparison, lighting, shade_scene
from ltsh_addon.scene import Cancelled, PolygonLight

TABLES = Path(shading.__file__).resolve().parents[2] / "tables"
TECHNIQUES = ("ltc", "ltsh4", "reference")
# Images pass through float32 once; sums of a few of them differ by a few roundings.
FLOAT32 = 4 * float(np.finfo(np.float32).eps)


def options(folder, **changes):
    given = {"scene": Path("room.blend"), "techniques": TECHNIQUES, "cycles_samples": 64, **changes}
    return PictureOptions(output=folder / "out", **given)


def written(folder, name="compare.exr"):
    return imaging.read_layers(folder / "out" / name)


def test_compare_leaves_its_five_files_and_the_layers_of_the_design(child, tmp_path):
    compare_scene(options(tmp_path))
    layers, folder = written(tmp_path), tmp_path / "out"
    expected = {"coverage.hit", *(f"samples.{field}" for field in scene.SurfaceSamples.__dataclass_fields__)}
    for pass_name in ("specular", "diffuse"):
        expected |= {f"{image}.{pass_name}" for image in ("cycles", "cycles_A", "cycles_B")}
        for name in TECHNIQUES:
            expected |= {f"{name}.{pass_name}", f"error_{name}.{pass_name}"}
            expected |= {f"{name}.{pass_name}@{group}" for group in ("Key", "Fill_001", "ungrouped")}
    for name in TECHNIQUES:
        expected |= {f"{name}.combined", f"error_{name}.combined"}
    assert set(layers) == expected | {"cycles.combined"}
    channels = imaging.read_channels(folder / "compare.exr")
    assert {"ltsh4.specular.R", "error_ltsh4.specular.B", "samples.position.X", "coverage.hit.V"} <= set(channels)
    assert "ltsh4.specular@Key.R" in channels and "samples.roughness.V" in channels
    assert all(plane.dtype == np.float32 and plane.shape == (4, 6) for plane in channels.values())
    names = {path.name for path in folder.iterdir()}
    assert names == {"compare.exr", "compare.png", "report.html", "report.json", "timing.json"}
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "ltsh4" in page and "&#x27;Glass&#x27;" in page


def test_combined_is_all_that_the_picture_shows(child, tmp_path):
    compare_scene(options(tmp_path, techniques=("ltsh2", "reference"), reference_samples=12))
    layers, rest = written(tmp_path), fake_scene.BACKGROUND + np.array([fake_scene.EMISSION] * 3 + [0.0])
    is_surface = layers["coverage.hit"] > 0.0
    for name in ("ltsh2", "reference", "cycles"):
        light, whole = layers[f"{name}.specular"] + layers[f"{name}.diffuse"], layers[f"{name}.combined"]
        # The reference stands for some pixels only, the others are black.
        there = light.any(axis=-1) | ~is_surface
        assert there.all() == (name != "reference")
        np.testing.assert_allclose(whole[there, :3], light[there] + rest[:3], rtol=FLOAT32)
        np.testing.assert_array_equal(whole[there, 3], np.float32(rest[3]))
        assert not whole[~there].any()
    error = layers["ltsh2.combined"] - layers["cycles.combined"]
    np.testing.assert_allclose(layers["error_ltsh2.combined"], error[..., :3], atol=FLOAT32)


def test_one_pass_alone_is_not_combined(child, tmp_path):
    shade_scene(options(tmp_path, passes=("diffuse",)))
    assert not [name for name in written(tmp_path, "shade.exr") if name.endswith("combined")]
    assert (tmp_path / "out" / "shade.png").is_file() and not child.asked[0].rest


def test_layers_of_groups_have_names_of_their_own_without_dots():
    """Blender and compositors take what stands before a dot for the name of a layer."""
    found = group_names(["Key.001", "", "Key_001", "ungrouped"])
    assert found == ["Key_001", "ungrouped_", "Key_001_2", "ungrouped"]


def test_a_group_named_ungrouped_and_lights_without_one_are_both_there_and_one_group_is_none(monkeypatch, tmp_path):
    fake_scene.FakeChild(groups=("ungrouped", "")).install(monkeypatch)
    compare_scene(options(tmp_path))
    layers = written(tmp_path)
    first, second = layers["ltc.specular@ungrouped"], layers["ltc.specular@ungrouped_"]
    assert np.allclose(first + second, layers["ltc.specular"], rtol=FLOAT32, atol=0.0) and (first != second).any()
    fake_scene.FakeChild(groups=("Key",)).install(monkeypatch)
    compare_scene(options(tmp_path))
    assert not [name for name in written(tmp_path) if "@" in name]


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
            groups = [layers[f"{name}.{pass_name}@{group}"] for group in ("Key", "Fill_001", "ungrouped")]
            assert np.allclose(sum(groups), image, rtol=FLOAT32, atol=0.0) and all(part.any() for part in groups)
    assert not layers["ltc.specular"][0].any() and not layers["coverage.hit"][0].any()
    assert layers["coverage.hit"][1, 0] == 0.5 and (layers["coverage.hit"][2:] == 1.0).all()


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


@pytest.mark.parametrize("stage", ["samples", "LTC", "write", "sheet"])
def test_stopping_or_failing_at_any_stage_leaves_no_file(child, tmp_path, monkeypatch, stage):
    if stage == "sheet":
        monkeypatch.setattr(imaging, "comparison_sheet", None)
    with pytest.raises(TypeError if stage == "sheet" else Cancelled):
        compare_scene(options(tmp_path), lambda name, fraction: name != stage)
    assert list((tmp_path / "out").iterdir()) == []


def test_progress_tells_every_stage_from_beginning_to_end(child, tmp_path):
    seen = {}
    compare_scene(options(tmp_path), lambda stage, fraction: seen.setdefault(stage, []).append(fraction))
    assert list(seen)[-4:] == ["LTC", "LTSH N=4", "Reference quadrature", "write"]
    for stage in list(seen)[-4:]:
        assert seen[stage][0] == 0.0 and seen[stage][-1] == 1.0 and seen[stage] == sorted(seen[stage])


def test_a_comparison_needs_two_cycles_samples(child, tmp_path):
    with pytest.raises(ValueError, match="cycles_samples is 1, expected at least 2"):
        compare_scene(options(tmp_path, cycles_samples=1))
    assert child.asked == [] and not (tmp_path / "out").exists()


STATISTICS = {
    *("relative_l2", "unbiased_relative_error", "unbiased_squared_error", "relative_rmse", "bias"),
    *("median_relative_error", "percentile_95_relative_error", "max_absolute_error", "not_finite", "pixels"),
}


def check_statistics(figures, pixels):
    assert set(figures) >= STATISTICS and figures["pixels"] == pixels and figures["not_finite"] == 0
    assert all(figures[name] is None or math.isfinite(figures[name]) for name in STATISTICS)


def check_schema(report, *, pixels, samples, techniques=TECHNIQUES, passes=("specular", "diffuse")):
    """The report's schema, by hand."""
    types = {
        "scene": str, "camera": str, "frame": int, "resolution": list, "sub_samples": int, "surface_samples": int,
        "cycles_samples": int, "lights": list, "versions": dict, "tables": dict, "passes": dict,
        "problems": list, "warnings": list, "exposure": float, "color_space": str,
        "pixel_aspect": float, "pixel_filter": str,
    }  # fmt: skip
    assert set(report) - {"seconds"} == {*types, "reference", "border", "shadows"}
    assert all(isinstance(report[key], kind) for key, kind in types.items())
    assert set(report["versions"]) == {"ltsh", "blender", "python", "numpy", "OpenEXR"}
    assert set(report["tables"]) == set(techniques) and list(report["passes"]) == list(passes)
    for light in report["lights"]:
        assert set(light) == {"name", "shape", "group", "radiance", "patches"}
    for figures in report["passes"].values():
        assert list(figures["techniques"]) == list(techniques)
        for name, row in figures["techniques"].items():
            if report["cycles_samples"]:
                check_statistics(row["against_cycles"], pixels)
            compared = "reference" in techniques and name != "reference"
            assert ("against_reference" in row) is compared
            if compared:
                check_statistics(row["against_reference"], samples)


def test_the_report_has_its_schema_and_is_the_file(child, tmp_path):
    report = compare_scene(options(tmp_path, frame=3, camera="Side", sub_samples=2))
    on_disk = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    seconds = report.pop("seconds")
    assert on_disk == json.loads(json.dumps(report))
    assert json.loads((tmp_path / "out" / "timing.json").read_text(encoding="utf-8")) == {"seconds": seconds}
    assert set(seconds) == {"start", "samples", "cycles", "techniques", "total"}
    assert set(seconds["techniques"]) == set(TECHNIQUES) and min(seconds["techniques"]["ltc"].values()) >= 0.0
    film = fake_scene.film()
    check_schema(on_disk, pixels=18, samples=len(film.pixel))
    facts = on_disk["reference"]
    assert (facts["samples"], facts["of"], facts["seed"]) == (35, 35, None)
    assert 0.0 <= facts["largest_error_estimate"] < 1e-3
    assert (on_disk["frame"], on_disk["camera"], on_disk["resolution"]) == (3, "Side", [6, 4])
    assert on_disk["warnings"] == [fake_scene.WARNING] and on_disk["sub_samples"] == 2
    assert on_disk["surface_samples"] == 35 and on_disk["cycles_samples"] == 64
    assert on_disk["lights"][1] == {
        "name": "Light 1", "shape": "SQUARE", "group": "Fill.001", "radiance": [3.0, 3.0, 1.0], "patches": 1
    }  # fmt: skip
    asked = child.asked[0]
    assert (asked.frame, asked.camera, asked.sub_samples, asked.cycles_samples) == (3, "Side", 2, 64)


def test_the_report_names_a_lamp_of_many_faces_once():
    whole = fake_scene.lights()[0]
    lamp = PolygonLight.like(whole, name="Lamp", corners=whole.polygon(), group="Lamps")
    dark = replace(lamp, radiance=np.zeros(3))
    found = comparison._light_reports([whole, lamp, dark, lamp, replace(lamp, name="Other")])
    assert [(one["name"], one["patches"]) for one in found] == [(whole.name, 1), ("Lamp", 3), ("Other", 1)]
    assert np.allclose(found[1]["radiance"], lamp.radiance * 2.0 / 3.0)
    # Two lights of one name that are no faces are two.
    assert len(comparison._light_reports([whole, whole])) == 2


def test_figures_against_cycles_are_those_of_the_known_noise(child, tmp_path):
    """T = R, A = (1 + n) R, B = (1 - n) R: noise n, e^2 = -n^2 / (1 - n^2), no error against the mean."""
    report = compare_scene(options(tmp_path))
    for figures in report["passes"].values():
        row = figures["techniques"]["reference"]["against_cycles"]
        assert figures["noise"] == pytest.approx(fake_scene.NOISE, rel=1e-5)
        expected = -(fake_scene.NOISE**2) / (1.0 - fake_scene.NOISE**2)
        assert row["unbiased_squared_error"] == pytest.approx(expected, rel=1e-3)
        assert row["unbiased_relative_error"] == 0.0
        # The halves are float32, so the rest is their rounding.
        assert max(row["relative_l2"], abs(row["bias"]), row["relative_rmse"]) < FLOAT32


def test_figures_against_the_reference_come_from_samples(child, tmp_path):
    report = compare_scene(options(tmp_path))
    samples = fake_scene.samples(35)
    shaded = [shading.shade(samples, fake_scene.lights(), name) for name in ("reference", "ltc")]
    truth, found = (part.specular.sum(axis=0) for part in shaded)
    row = report["passes"]["specular"]["techniques"]["ltc"]["against_reference"]
    even, odd = slice(0, None, 2), slice(1, None, 2)
    for index, expected in ((slice(None), row), (even, row["metals"]), (odd, row["dielectrics"])):
        error = np.linalg.norm((found - truth)[index]) / np.linalg.norm(truth[index])
        # Radiance is float32: rounding of 6e-8 in a difference of 7e-3.
        assert expected["relative_l2"] == pytest.approx(error, rel=1e-4) and expected["pixels"] == len(truth[index])
    assert report["passes"]["diffuse"]["techniques"]["ltc"]["against_reference"]["relative_l2"] < 1e-6


def test_material_classes_part_metals_from_dielectrics():
    samples = replace(
        fake_scene.samples(5),
        specular_f90=np.array([[1.0, 1, 1], [0, 0, 0], [0.4, 0.4, 0.4], [0.6, 0.6, 0.6], [0, 0, 0]]),
        dielectric=np.array([0.0, 1.0, 0.6, 0.4, 0.0]),
    )
    classes = comparison.material_classes(samples)
    assert classes["metals"].tolist() == [True, False, False, True, False]
    assert classes["dielectrics"].tolist() == [False, True, True, False, False]


def test_a_reference_on_a_subset_is_stated_and_zero_elsewhere(child, tmp_path):
    report = compare_scene(options(tmp_path, reference_samples=20))
    layers, facts = written(tmp_path), report["reference"]
    assert facts["of"] == 35 and 0 < facts["samples"] <= 20 and isinstance(facts["seed"], int)
    evaluated = layers["reference.specular"].any(axis=2)
    inside, film = np.count_nonzero(evaluated), fake_scene.film()
    assert np.count_nonzero(evaluated.ravel()[film.pixel]) == facts["samples"]
    for pass_name in ("specular", "diffuse"):
        for layer in (f"reference.{pass_name}", f"error_reference.{pass_name}"):
            assert not layers[layer][~evaluated].any()
        techniques = report["passes"][pass_name]["techniques"]
        assert techniques["reference"]["against_cycles"]["pixels"] == inside < 18
        assert techniques["ltc"]["against_cycles"]["pixels"] == 18
        assert techniques["ltc"]["against_reference"]["pixels"] == facts["samples"]
        # Pixels of the subset are whole: they agree with Cycles as they do without a subset.
        assert techniques["reference"]["against_cycles"]["relative_l2"] < FLOAT32
    again = compare_scene(options(tmp_path, reference_samples=20))
    assert again["reference"] == facts
    assert np.array_equal(written(tmp_path)["reference.specular"], layers["reference.specular"])
    stated = f"{facts['samples']} of 35 samples"
    assert stated.encode() in (tmp_path / "out" / "compare.exr").read_bytes()


def test_a_reference_of_many_lights_takes_fewer_samples(child, tmp_path, monkeypatch):
    """Their number times that of the lights stays bounded: 100,000 lights would take days."""
    monkeypatch.setattr(lighting, "FEWEST_SAMPLES", 1)
    monkeypatch.setattr(lighting, "MOST_REFERENCE_PAIRS", 20 * len(fake_scene.lights()))
    facts = compare_scene(options(tmp_path))["reference"]
    assert facts["of"] == 35 and 0 < facts["samples"] <= 20


def test_the_sheet_has_all_light_first_and_then_the_passes_that_were_shaded(child, tmp_path, monkeypatch):
    sheets = []
    make_sheet = imaging.comparison_sheet
    monkeypatch.setattr(imaging, "comparison_sheet", lambda *a, **k: sheets.append(a) or make_sheet(*a, **k))
    compare_scene(options(tmp_path, passes=("diffuse", "specular"), reference_samples=20))
    layers = written(tmp_path)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "combined" in page and page.index("combined") < page.index("specular") < page.index("diffuse")
    for (image, tiles), names in zip(sheets, (("specular", "diffuse"), ("specular",), ("diffuse",)), strict=True):
        shown = ["combined"] if len(names) == 2 else names
        assert np.allclose(image, sum(layers[f"cycles.{name}"][..., :3] for name in shown))
        assert np.allclose(tiles[1].image, sum(layers[f"ltsh4.{name}"][..., :3] for name in shown))
        assert np.allclose(tiles[1].error, sum(layers[f"error_ltsh4.{name}"] for name in names))
        missing = (layers["coverage.hit"] > 0.0) & ~layers["reference.specular"].any(axis=2)
        assert np.array_equal(tiles[2].missing, missing) and missing.any() and tiles[0].missing is None
    compare_scene(options(tmp_path, passes=("diffuse",), techniques=("ltsh2",)))
    assert len(sheets) == 4 and np.allclose(sheets[3][0], written(tmp_path)["cycles.diffuse"][..., :3])


def test_the_passes_and_techniques_that_were_asked_for_alone(child, tmp_path):
    report = compare_scene(options(tmp_path, passes=("diffuse",), techniques=("ltsh2",)))
    check_schema(report, pixels=18, samples=35, passes=("diffuse",), techniques=("ltsh2",))
    assert report["reference"] is None
    assert not [name for name in written(tmp_path) if "specular" in name and not name.startswith("samples.")]


def test_no_samples_at_all(monkeypatch, tmp_path):
    fake_scene.FakeChild(empty=True).install(monkeypatch)
    report = compare_scene(options(tmp_path))
    check_schema(json.loads((tmp_path / "out" / "report.json").read_text()), pixels=0, samples=0)
    assert report["surface_samples"] == 0 and "sees no surface" in report["warnings"][0]
    assert not any(plane.any() for name, plane in written(tmp_path).items() if not name.endswith(".combined"))
    assert report["passes"]["specular"]["techniques"]["ltc"]["against_cycles"]["relative_l2"] is None


def test_shade_writes_its_layers_and_report_and_nothing_else(child, tmp_path):
    report = shade_scene(options(tmp_path))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"shade.exr", "shade.png", "report.json", "timing.json"}
    assert child.asked[0].cycles_samples == 0
    check_schema(report, pixels=18, samples=35)
    assert report["cycles_samples"] == 0 and "noise" not in report["passes"]["specular"]
    shaded = written(tmp_path, "shade.exr")
    assert not [name for name in shaded if name.startswith(("cycles", "error_"))]
    compare_scene(options(tmp_path))
    compared = written(tmp_path)
    assert set(shaded) < set(compared) and all(np.array_equal(shaded[name], compared[name]) for name in shaded)


def own_technique():
    """The class that docs/python.md shows."""
    text = (TABLES.parent / "docs" / "python.md").read_text(encoding="utf-8")
    code = next(block for block in re.findall(r"^```python\n(.*?)^```", text, re.M | re.S) if "class Center" in block)
    names: dict = {}
    exec(code, names)
    return names["Center"]()


def test_the_technique_that_the_documents_show_takes_part_in_a_comparison(child, tmp_path):
    technique = own_technique()
    report = compare_scene(options(tmp_path, techniques=("ltsh4", technique)))
    assert list(report["tables"]) == ["ltsh4", "center"] and report["tables"]["center"].endswith(".Center")
    error = report["passes"]["specular"]["techniques"]["center"]["against_cycles"]["unbiased_relative_error"]
    assert 0.0 < error < 2.0
    layers, film = written(tmp_path), fake_scene.film()
    expected = technique.evaluate(fake_scene.samples(len(film.pixel)), fake_scene.lights()).specular.sum(axis=0)
    assert np.allclose(layers["center.specular"], film.image(expected), rtol=1e-5)
    assert np.array_equal(layers["center.diffuse"], layers["ltsh4.diffuse"])
    assert {"center.specular@Key", "error_center.specular"} <= set(layers)


def test_the_technique_that_the_documents_show_is_right_for_small_lights():
    """The integral over a light of the side h is lobe x solid angle, but for terms of h^2 and the fit, within 1 %."""
    samples, light = fake_scene.samples(40), fake_scene.lights()[0]
    ones = np.ones((40, 3))
    samples = replace(samples, specular_f0=ones, specular_f90=ones, dielectric=0.0 * ones)
    light = replace(light, half_u=light.half_u / 100.0, half_v=light.half_v / 100.0)
    found = shading.shade(samples, [light], own_technique()).specular
    expected = shading.shade(samples, [light], "reference").specular
    bright = expected > 0.05 * expected.max()
    assert bright.sum() > 20 and np.allclose(found[bright], expected[bright], rtol=1e-2)


def test_light_linking_and_the_passes_of_a_light_hold_for_techniques_of_ones_own():
    samples = replace(fake_scene.samples(6), receiver=np.array([0, 1, 0, 1, 0, 1]))
    light = replace(fake_scene.lights()[0], receivers=(1,), affects_diffuse=False)
    found = shading.shade(samples, [light], own_technique())
    assert not found.specular[0, ::2].any() and not found.diffuse.any()


@pytest.mark.parametrize(
    ("returned", "problem"),
    [
        (np.zeros(3), "returned ndarray, expected a ltsh_addon.shading.Shading"),
        (shading.Shading(np.zeros((5, 3))), r"returned specular of shape \(5, 3\), expected \(rows, 5, 3"),
    ],
)
def test_a_technique_that_returns_something_else_is_named(returned, problem):
    class Mine:
        def evaluate(self, samples, lights):
            return returned

    with pytest.raises(ValueError, match=f"technique Mine: evaluate {problem}"):
        shading.shade(fake_scene.samples(5), fake_scene.lights(), Mine())


def test_techniques_of_ones_own_are_refused_where_they_would_be_called_later(child, tmp_path):
    with pytest.raises(ValueError, match=r"Center: with keep_visibility, relight cannot call it later"):
        compare_scene(options(tmp_path, techniques=(own_technique(),), keep_visibility=True))
