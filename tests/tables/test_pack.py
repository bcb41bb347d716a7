"""The pack: splines beside scipy, its errors beside the shipped tables, its files."""

import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import BSpline
from table_exports import run

from ltsh_addon import shading
from tables import __main__, export, header, pack, sheen, validate

MOST_BYTES = {"pack_2": 24_000, "pack_4": 72_000, "pack_4c": 112_000}
names = pytest.mark.parametrize("name", pack.TABLES)


def test_the_splines_are_uniform_cubic_b_splines():
    positions = np.random.default_rng(1).random(200)
    knots = np.arange(-3, pack.SIZE + 1) / (pack.SIZE - 3)
    expected = BSpline(knots, np.eye(pack.SIZE), 3)(positions)
    assert pack.matrix(positions) == pytest.approx(expected, abs=1e-12)
    assert pack.matrix(np.array([0.0, 1.0])).sum(axis=1) == pytest.approx(1.0)


@names
def test_lookups_are_the_splines_of_the_stored_coefficients(name):
    table, generator = pack.load_pack()[name], np.random.default_rng(2)
    cosine, roughness = generator.random((2, 50))
    lobe = table.lookup(cosine, roughness)
    theta = 1.0 - np.sqrt(1.0 - np.arccos(cosine) / (0.5 * np.pi))
    expected = np.einsum("pi,pj,ijfk->fkp", pack.matrix(roughness), pack.matrix(theta), table.coefficients)
    assert lobe.coefficients == pytest.approx(expected, abs=1e-9)
    assert table.albedos(cosine, roughness) == pytest.approx(lobe.albedo(), rel=1e-6)


@names
def test_errors_are_those_of_the_shipped_tables(name):
    """At 6 x 6 points: the mean within 1.1, the median within 1.3 and the mean curvature within 2 times. The README has
    those of all points."""
    packed, shipped = pack.load_pack()[name], shading.load_table(name)
    found, expected = validate.error_map(packed, 6), validate.error_map(shipped, 6)
    assert found.mean() < 1.1 * expected.mean() and np.median(found) < 1.3 * np.median(expected)
    assert validate.curvature(packed, 3) < 2.0 * validate.curvature(shipped, 3)


@names
def test_grazing_and_smooth_lobes_keep_their_albedo(name):
    """Where the fit has few points: within 2 % for both curves."""
    packed, shipped = pack.load_pack()[name], shading.load_table(name)
    roughness, theta = (grid.ravel() for grid in np.meshgrid(np.linspace(0.02, 1.0, 41), np.linspace(0.0, 89.0, 41)))
    cosine = np.cos(np.radians(theta))
    found, expected = packed.lookup(cosine, roughness).albedo(), shipped.lookup(cosine, roughness, curves=2).albedo()
    assert np.abs(found - expected).max() < 0.02


def test_the_files_are_small_array_textures_and_code(tmp_path):
    files = {path.name: path.read_bytes() for path in export.export_pack(tmp_path)}
    assert {name for name in files if name.endswith(".dds")} == {f"{name}.dds" for name in MOST_BYTES}
    for name, most in MOST_BYTES.items():
        data = files[f"{name}.dds"]
        assert len(data) <= most
        magic, size, _, height, width = struct.unpack_from("<4s4I", data)
        form, dimension, _, layers, _ = struct.unpack_from("<5I", data, 128)
        assert (magic, size, data[84:88], height, width) == (b"DDS ", 124, b"DX10", pack.SIZE, pack.SIZE)
        assert (form, dimension, len(data)) == (10, 3, 148 + layers * pack.SIZE**2 * 8)
        texels = np.frombuffer(data, "<f2", offset=148).reshape(layers, pack.SIZE, pack.SIZE, 4)
        for table in pack.TABLES:
            first = pack.FIRST_LAYERS[table]
            nodes = header.data_blocks(pack.load_pack()[table])["NODES"].reshape(pack.SIZE, pack.SIZE, -1)
            if first < layers:
                for channel in range(nodes.shape[2]):
                    assert np.array_equal(texels[first + channel // 4, ..., channel % 4], nodes[..., channel])
    for table, first in pack.FIRST_LAYERS.items():
        for ending in ("h", "wgsl"):
            text = files[f"pack_{table}.{ending}"].decode("ascii")
            assert f"from layer {first} on" in text and f"pack_{table}_tap_weight" in text


def test_the_fit_is_written_as_the_texture_that_is_shipped(out, monkeypatch):
    """The fit itself takes minutes: here all of them come back from the file."""

    def fitted(name, progress):
        table = pack.load_pack()[name]
        return np.concatenate([table.warp, table.coefficients.reshape(pack.SIZE, pack.SIZE, -1)], axis=2)

    monkeypatch.setattr(pack, "fit_table", fitted)
    monkeypatch.setattr(sheen, "fit", sheen.load_sheen)
    assert __main__.main(["fit", "--pack", "-o", str(out)]) == 0
    assert (out / "pack.dds").read_bytes() == pack.PATH.read_bytes()


def test_the_closest_splines_keep_a_polynomial():
    """A cubic of both axes is a spline: its coefficients give it back anywhere."""
    position = np.linspace(0.0, 1.0, 64)
    row, column = position[:, None], position
    values = (1.0 + row - 2.0 * row**3) * (0.5 - column**2 + column**3)
    table = SimpleNamespace(warp=values[..., None], coefficients=np.zeros((64, 64, 1, 0)))
    at = np.random.default_rng(3).random((2, 40))
    found = np.einsum("pi,pj,ij->p", pack.matrix(at[0]), pack.matrix(at[1]), pack.closest(table)[..., 0])
    assert found == pytest.approx((1.0 + at[0] - 2.0 * at[0] ** 3) * (0.5 - at[1] ** 2 + at[1] ** 3), abs=1e-9)


def test_the_command_writes_the_pack_with_both_licenses(capsys, out):
    code, stdout, stderr = run(capsys, "--layout", "pack", "-o", out, "--json")
    document = json.loads(stdout)
    assert (code, stderr) == (0, "") and len(document["tables"]["pack"]) == 3 + 2 * 5
    assert len(document["licenses"]) == 2
    assert sorted(path.name for path in out.iterdir()) == sorted(
        path.rpartition("/")[2] for path in document["tables"]["pack"] + document["licenses"]
    )


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--layout", "pack", "ltc"], "--layout pack writes all shipped tables; give no TABLE"),
        (["--layout", "bevy", "--two-curves"], "--layout bevy has two curves anyway; leave --two-curves out"),
    ],
)
def test_wrong_arguments_are_misuse(capsys, out, arguments, complaint):
    code, stdout, stderr = run(capsys, *arguments, "-o", out)
    assert (code, stdout) == (2, "") and complaint in stderr and not out.exists()


def test_two_curves_are_the_first_two_with_dielectrics_by_schlick(capsys, out):
    code, _, _ = run(capsys, "ltsh4", "--two-curves", "-o", out)
    data = (out / "ltsh4.dds").read_bytes()
    assert code == 0 and len(data) == 148 + 9 * 64 * 64 * 8
    table, small = shading.load_table("ltsh4"), pack.with_two_curves(shading.load_table("ltsh4"))
    assert np.array_equal(small.coefficients, table.coefficients[:, :, :2]) and small.average_albedo.shape[1] == 2
    # Schlick 1994: F0 + (1 - F0) (1 - c)^5
    weights = small.dielectric_weights(np.array([1.5]))[:, 0]
    cosine = np.linspace(0.0, 1.0, small.fresnel_curves.shape[1])
    assert weights @ small.fresnel_curves == pytest.approx(0.04 + 0.96 * (1.0 - cosine) ** 5, abs=1e-4)
    assert "PACK" not in (text := (out / "ltsh4.h").read_text(encoding="ascii")) and "#define LTSH4_CURVES 2" in text
