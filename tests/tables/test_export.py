"""`python -m tables export`: the EXR against the table, the file handling, the command line."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from table_exports import run

from ltsh_addon import shading
from ltsh_addon.imaging import read_channels
from ltsh_addon.lobes import lookup_table
from tables import export

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = ROOT / "tables" / "EXPORT.md"
LICENSES = ["LICENSE-CC0.txt", "LICENSE-MIT.txt"]


def files_of(name: str, family: str = "") -> list[str]:
    """What is written of a table, in order."""
    textures = [f"{name}_{number}.dds" for number in (1, 2)] if "ltc" in (name, family) else []
    return [*(f"{name}.{ending}" for ending in ("exr", "h", "wgsl", "dds")), *textures]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    export.export_tables(export.export_prefixes(shading.SHIPPED_TABLES), folder)
    return folder


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_the_image_holds_the_table_bit_for_bit(exported, name):
    table, channels = shading.load_table(name), read_channels(exported / f"{name}.exr")
    pairs = [(l, m) for l in range(table.degree + 1) for m in range(l + 1)]  # noqa: E741
    suffixes = ["c"] if table.family == "ltc" else [f"c_{l}_{m}" for l, m in pairs]  # noqa: E741
    suffixes += ["c_bent_x", "c_bent_z"] if table.bend else []
    warp_names = ["A", "B", "C", "tilt"][: table.warp.shape[2]]
    expected = {f"warp.{key}": table.warp[..., n] for n, key in enumerate(warp_names)}
    curves = range(len(table.fresnel_curves))
    for curve in curves:
        for k, suffix in enumerate(suffixes):
            expected[f"curve{curve}.{suffix}"] = table.coefficients[:, :, curve, k]
    derived = {f"curve{curve}.{kind}" for curve in curves for kind in ("albedo", "average_albedo")}
    assert set(channels) == set(expected) | derived
    for key, plane in expected.items():
        assert channels[key].dtype == np.float32 and plane.dtype == np.float32
        assert np.array_equal(channels[key].view(np.uint32), np.ascontiguousarray(plane).view(np.uint32)), key
    rows, columns = table.warp.shape[:2]
    roughness, theta = np.meshgrid(lookup_table.roughness_nodes(rows), lookup_table.theta_nodes(columns), indexing="ij")
    albedos = table.lookup(np.cos(theta).ravel(), roughness.ravel()).albedo().reshape(-1, rows, columns)
    for curve in curves:
        average = table.average_albedo[:, curve, None].astype(np.float32)
        assert (channels[f"curve{curve}.average_albedo"] == average).all()
        assert channels[f"curve{curve}.albedo"] == pytest.approx(albedos[curve], rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_the_attributes_say_the_conventions_and_hold_the_fresnel_curves(exported, name):
    table = shading.load_table(name)
    with OpenEXR.File(str(exported / f"{name}.exr"), header_only=True) as file:
        conventions, fresnel = (json.loads(file.header()[f"ltsh:{key}"]) for key in ("conventions", "fresnel"))
    assert conventions["table"] == name and "top" in conventions["rows"] and "left" in conventions["columns"]
    assert conventions["fit"] == table.metadata
    assert len(conventions["fresnel_curves"]) == len(table.fresnel_curves)
    assert np.array_equal(fresnel["curves"], table.fresnel_curves) and np.array_equal(fresnel["ior"], table.fresnel_ior)
    assert np.array_equal(fresnel["dielectric_weights"], table.fresnel_weights)


def test_every_channel_is_documented_and_every_documented_one_is_written(exported):
    documented = re.findall(r"`((?:warp|curve<f>)\.[^`]*)`", DOCUMENT.read_text(encoding="utf-8"))
    patterns = {re.sub("<[flm]>", r"\\d+", name.replace(".", r"\.")): 0 for name in documented}
    assert len(patterns) == len(documented) >= 8
    for name in shading.SHIPPED_TABLES:
        for channel in read_channels(exported / f"{name}.exr"):
            matching = [pattern for pattern in patterns if re.fullmatch(pattern, channel)]
            assert len(matching) == 1, channel
            patterns[matching[0]] += 1
    assert all(patterns.values()), patterns


@pytest.mark.parametrize(
    ("name", "expected"),
    [("ltsh4", "ltsh4"), ("My table-2", "my_table_2"), ("a__b.", "a_b"), ("4k", "table_4k"), ("gl", "table_gl"),
     ("LTSH", "table_ltsh"), ("ä", "table")],
)  # fmt: skip
def test_names_in_headers_are_identifiers(name, expected):
    assert export.identifier(name) == expected


def test_all_shipped_tables_are_the_default(capsys, out):
    code, stdout, stderr = run(capsys, "-o", out)
    names = [file for name in shading.SHIPPED_TABLES for file in files_of(name)] + LICENSES
    assert (code, stderr) == (0, "") and stdout.splitlines() == [str(out / name) for name in names]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)


def test_json_is_one_document_that_names_the_files(capsys, out, tmp_path):
    path = tmp_path / "My table.npz"
    shutil.copy(ROOT / "tables" / "ltc.npz", path)
    code, stdout, stderr = run(capsys, "ltc", path, "ltc", "-o", out / "deep", "--json")
    document = json.loads(stdout)
    files = document["tables"]
    assert [Path(path).name for path in document["licenses"]] == LICENSES
    assert (code, stderr) == (0, "") and list(files) == ["ltc", str(path)]
    expected = {*files_of("ltc"), *files_of("My table", "ltc")}
    assert {Path(file).name for written in files.values() for file in written} == expected
    assert {file.name for file in (out / "deep").iterdir()} == expected | set(LICENSES)
    assert "my_table_integrate_polygon" in (out / "deep" / "My table.h").read_text(encoding="ascii")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["ltsh9", "-o", "OUT"], "table 'ltsh9' is unknown, expected some of ltc, ltsh2, ltsh4, ltsh4c or the path"),
        (["reference", "-o", "OUT"], "'reference' is unknown"),
        (["ltc"], "-o"),
        (["ltc", "other/LTC.npz", "-o", "OUT"], "ltc and other/LTC.npz would get the same names"),
        (["-o", "OUT", "--degree"], "--degree"),
    ],
)
def test_wrong_arguments_are_misuse(capsys, out, arguments, complaint):
    code, stdout, stderr = run(capsys, *(out if word == "OUT" else word for word in arguments))
    assert (code, stdout) == (2, "") and complaint in stderr.splitlines()[-1] and not out.exists()


def _assert_failure(result, complaint):
    code, stdout, stderr = result
    assert (code, stdout) == (1, "") and len(stderr.splitlines()) == 1 and complaint in stderr


def test_a_broken_table_fails_before_anything_is_written(capsys, out, tmp_path):
    path = tmp_path / "broken.npz"
    path.write_bytes(b"")
    _assert_failure(run(capsys, "ltc", path, "-o", out), f"lookup table {path}")
    _assert_failure(run(capsys, tmp_path / "no.npz", "-o", out), "no such file")
    assert not out.exists()


@pytest.mark.parametrize(
    ("owner", "attribute", "failure", "named"),
    [
        (Path, "write_bytes", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "ltc.h"),
        (OpenEXR, "OutputFile", OSError("Cannot write image file"), "ltc.exr"),
    ],
)
def test_nothing_is_left_behind_when_writing_fails(capsys, out, monkeypatch, owner, attribute, failure, named):
    def fail(*arguments, **options):
        raise failure

    monkeypatch.setattr(owner, attribute, fail)
    result = run(capsys, "ltc", "-o", out)
    _assert_failure(result, f"{out / named}: cannot be written")
    assert result[2].count("cannot be written") == 1 and list(out.iterdir()) == []


@pytest.mark.parametrize("name", ["ltc.exr", "ltc.h", "ltc_2.dds"])
def test_a_failure_keeps_what_was_there(capsys, out, name):
    """A folder in the place of one file: none is replaced."""
    other = "ltc.wgsl"
    (out / name).mkdir(parents=True)
    (out / other).write_bytes(b"old")
    _assert_failure(run(capsys, "ltc", "-o", out), "a folder has that name")
    assert (out / other).read_bytes() == b"old" and len(list(out.iterdir())) == 2


def test_every_file_says_its_license(exported, tmp_path):
    for name in shading.SHIPPED_TABLES:
        for ending in ("h", "wgsl"):
            text = (exported / f"{name}.{ending}").read_text(encoding="ascii")
            start = text[:3000]
            assert "SPDX-License-Identifier: CC0-1.0" in start and "SPDX-License-Identifier: MIT" in start
            assert "Permission is hereby granted, free of charge" in start and "GPL" not in text
        with OpenEXR.File(str(exported / f"{name}.exr"), header_only=True) as file:
            assert json.loads(file.header()["ltsh:conventions"])["license"] == "CC0-1.0"
    export.write_licenses(tmp_path)
    public_domain, mit = ((tmp_path / name).read_text(encoding="utf-8") for name in LICENSES)
    assert "CC0 1.0 Universal" in public_domain
    assert mit.startswith("MIT License\n\nCopyright 2026 LTSH contributors\n\nPermission is hereby granted")
    assert mit.endswith("OTHER DEALINGS IN THE SOFTWARE.\n") and "\n   " not in mit


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_headers_say_first_what_they_need(exported, name):
    """tests/shading/test_header_languages.py and test_shader_languages.py try all of these."""
    for ending in ("h", "wgsl"):
        start = (exported / f"{name}.{ending}").read_text(encoding="ascii").splitlines()[:4]
        assert "Needs C99 or C++" in start[1] and "GLSL ES 3.00 (WebGL 2)" in start[1] and "HLSL" in start[1]
        assert f"{name.upper()}_DATA" in start[2] and f"{name}_data" in start[2]
