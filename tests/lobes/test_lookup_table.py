"""Lookup tables: interpolation, clamping, Fresnel weights, and what a damaged file leads to."""

import dataclasses
import json

import numpy as np
import pytest

from ltsh_addon import shading
from ltsh_addon.lobes import lookup_table

TABLES = {name: shading.load_table(name) for name in shading.SHIPPED_TABLES}
table_names = pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
ARRAYS = ("warp", "coefficients", "fresnel_curves", "fresnel_ior", "fresnel_weights", "average_albedo")


def stored(lobe, cosine, roughness):
    """A, B, C (and tilt) of looked-up lobes, by undoing the formula of the module's docstring: (channels, P)."""
    alpha = np.maximum(roughness**2, lookup_table.MIN_ALPHA)
    g_squared = cosine**2 + (1.0 - cosine**2) * alpha**2 / 4.0
    a = lobe.xx / g_squared
    sine = np.sqrt(1.0 - cosine**2)
    b = np.divide(lobe.xz, a * np.sqrt(g_squared) * sine, out=np.full_like(a, np.nan), where=sine > 1e-6)
    rows = [a, b, lobe.yy] + ([] if lobe.tilt is None else [lobe.tilt])
    assert np.array_equal(lobe.zz, 2.0 * alpha)
    return np.stack(rows)


@table_names
@pytest.mark.parametrize("between", [False, True])
def test_the_table_is_bilinear_and_reproduces_its_nodes(name, between):
    """To rounding: theta_o of a node passes through cos and arccos, whose condition is worst at normal incidence."""
    table = TABLES[name]
    rows, columns = table.warp.shape[:2]
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    if between:
        u, v = np.random.default_rng(1).random((2, 4000)) * [[rows - 1], [columns - 1]]
    i, j = np.minimum(u.astype(int), rows - 2), np.minimum(v.astype(int), columns - 2)
    s, t = (u - i)[:, None], (v - j)[:, None]
    cosine = np.cos(0.5 * np.pi * (1.0 - (1.0 - v / (columns - 1)) ** 2)).clip(0.0, 1.0)
    lobe = table.lookup(cosine, u / (rows - 1))
    nodes = np.concatenate([table.coefficients.reshape(rows, columns, -1), table.warp], axis=2).astype(float)
    low, high = ((1 - t) * nodes[row, j] + t * nodes[row, j + 1] for row in (i, i + 1))
    found = np.concatenate([lobe.coefficients.reshape(-1, len(u)), stored(lobe, cosine, u / (rows - 1))])
    known, split = np.isfinite(found), table.coefficients[0, 0].size
    error = np.where(known, np.abs(found - ((1 - s) * low + s * high).T), 0.0).max(axis=1)
    assert error[:split].max() < 1e-9 * np.abs(table.coefficients).max()
    assert error[split:].max() < 1e-9 * np.abs(table.warp).max()
    assert (~known).sum() == (0 if between else rows)  # B at normal incidence


@table_names
def test_the_albedo_is_the_integral_over_the_hemisphere(name):
    """Of every Fresnel curve: a polygon just above the horizon, by the closed form of the integrals (F = 1), and the
    lobes' own values by quadrature in polar coordinates (rough surfaces: 300 x 300 points are good to 1e-4)."""
    table = TABLES[name]
    cosine, roughness = np.array([0.9, 0.6, 0.35]), np.array([0.8, 0.9, 0.95])
    angle = 2.0 * np.pi * np.arange(16) / 16
    ring = np.stack([np.cos(angle), np.sin(angle), np.full(16, 1e-9)], axis=1)
    lobe = table.lookup(cosine, roughness)
    found = lobe.albedo()
    assert found.shape == (len(table.fresnel_curves), 3)
    whole = shading.integrate_polygon(table, cosine, roughness, np.broadcast_to(ring, (3, 16, 3)))
    assert found[0] == pytest.approx(whole, rel=1e-6)
    z, phi = (grid.ravel() for grid in np.meshgrid((np.arange(300) + 0.5) / 300, np.arange(300) / 150.0 * np.pi))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    for curve in range(1, len(table.fresnel_curves)):
        only = dataclasses.replace(table, coefficients=table.coefficients[:, :, [curve]])
        values = shading.evaluate_lobe(only, cosine, roughness, np.broadcast_to(directions, (3, 90000, 3)))
        assert found[curve] == pytest.approx(values.mean(axis=1) * 2.0 * np.pi, rel=1e-3, abs=1e-5)


@table_names
def test_average_albedos_are_interpolated_in_roughness(name):
    table = TABLES[name]
    count = len(table.average_albedo)
    found = table.average_albedos(np.array([-1.0, 0.0, 2.25 / (count - 1), 1.0, 3.0]))
    mixed = 0.75 * table.average_albedo[2] + 0.25 * table.average_albedo[3]
    expected = [table.average_albedo[0], table.average_albedo[0], mixed, *[table.average_albedo[-1]] * 2]
    assert np.abs(found.T - np.array(expected)).max() < 1e-12


@table_names
def test_outside_the_axes_the_border_holds(name):
    table = TABLES[name]
    outside = table.lookup(np.array([-0.3, 1.2, 0.5, 0.5]), np.array([0.5, 0.5, -1.0, 7.0]))
    inside = table.lookup(np.array([0.0, 1.0, 0.5, 0.5]), np.array([0.5, 0.5, 0.0, 1.0]))
    for field in ("xx", "xz", "yy", "zz", "coefficients"):
        assert np.array_equal(getattr(outside, field), getattr(inside, field)), field


def contents(name):
    """Arrays and metadata of a shipped table."""
    table = TABLES[name]
    return {key: getattr(table, key).copy() for key in ARRAYS}, dict(table.metadata)


def written(path, arrays, metadata):
    np.savez(path, **arrays, metadata=np.array(json.dumps(metadata)))
    return path


def assert_refused(path, *words):
    with pytest.raises(shading.TableError) as caught:
        shading.load_table(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    for word in words:
        assert word in message, message


def test_a_shipped_table_is_loaded_once_and_a_users_table_each_time(tmp_path):
    path = written(tmp_path / "own.npz", *contents("ltsh2"))
    assert shading.load_table("ltsh2") is shading.load_table("ltsh2")
    assert shading.load_table(path) is not shading.load_table(path)
    with pytest.raises(ValueError, match="read-only"):
        shading.load_table("ltc").warp[0, 0, 0] = 1.0


def test_a_written_table_is_read_back(tmp_path):
    arrays, metadata = contents("ltsh2")
    table = shading.load_table(written(tmp_path / "own.npz", arrays, metadata))
    assert all(np.array_equal(getattr(table, key), value) for key, value in arrays.items())
    assert shading.load_table(str(tmp_path / "own.npz")).name == "ltsh2"
    arrays[ANY_LENGTH[0]] = arrays[ANY_LENGTH[0]][ANY_LENGTH[1]]
    assert shading.load_table(written(tmp_path / "short.npz", arrays, metadata)).degree == 2


def test_missing_files_and_folders_are_named(tmp_path):
    assert_refused(tmp_path / "none.npz", "no such file", "ltsh4")
    assert_refused(tmp_path, "no such file")
    with pytest.raises(shading.TableError, match="lookup table ltsh3: no such file or table; shipped are ltc"):
        shading.load_table("ltsh3")


@pytest.mark.parametrize("content", [b"", b"not a zip at all", b"PK\x03\x04", b"\x93NUMPY", 0.1, 0.5, 0.9, 0.999])
def test_files_that_are_no_zip_or_were_cut_are_refused(tmp_path, content):
    if isinstance(content, float):
        whole = written(tmp_path / "whole.npz", *contents("ltc")).read_bytes()
        content = whole[: int(content * len(whole))]
    (tmp_path / "bad.npz").write_bytes(content)
    assert_refused(tmp_path / "bad.npz", "is no .npz")


def test_flipped_bytes_are_refused_or_harmless(tmp_path):
    """A shipped, compressed file damaged anywhere gives TableError, never another exception."""
    source = lookup_table.Path(lookup_table.__file__).parents[2] / "tables" / "ltc.npz"
    whole = source.read_bytes()
    generator = np.random.default_rng(2)
    path = tmp_path / "flipped.npz"
    refused = 0
    offsets = [*generator.integers(0, len(whole), 60), *range(len(whole) - 120, len(whole)), *range(0, 40)]
    for offset in offsets:
        damaged = bytearray(whole)
        damaged[offset] ^= 0x5A
        path.write_bytes(damaged)
        try:
            shading.load_table(path)
        except shading.TableError as error:
            assert str(path) in str(error)
            refused += 1
    # Time stamps, attributes and the second copy of a header field carry no data.
    assert refused > 0.5 * len(offsets)


INDICES = [np.s_[:1], np.s_[1:], np.s_[:0], np.s_[None], np.s_[..., 0], np.s_[..., 1:]]
ANY_LENGTH = ("fresnel_curves", np.s_[..., 1:])  # any number of cosines is allowed
# What is done to arrays and metadata, and what the refusal names.
SPOILED = [
    *((lambda arrays, _, key=key: arrays.pop(key), key) for key in ARRAYS),
    *((lambda _, metadata, version=version: metadata.update(format_version=version),
       f"is {version!r}, expected") for version in (0, 1, "2", None)),
    *((lambda _, metadata, change=change: metadata.update(change), "")
      for change in ({"family": "ltx"}, {"degree": 12}, {"degree": "2"}, {"degree": None}, {"degree": 3})),
    *((lambda arrays, _, key=key, value=value: arrays[key].flat.__setitem__(arrays[key].size // 2, value),
       "NaN or infinity") for key in ARRAYS for value in (np.nan, np.inf)),
    (lambda arrays, _: arrays.update(warp=arrays["warp"].astype(float) * 1e300), "infinity in single precision"),
    *((lambda arrays, _, key=key, index=index: arrays.update({key: arrays[key][index]}), "")
      for key in ARRAYS for index in INDICES if (key, index) != ANY_LENGTH),
    *((lambda arrays, _, kind=kind: arrays.update(warp=arrays["warp"].astype(kind)), "warp")
      for kind in (str, complex)),
    (lambda arrays, _: arrays.update(fresnel_ior=arrays["fresnel_ior"][::-1].copy()), "fresnel_ior"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "word"), SPOILED)
def test_arrays_and_metadata_that_make_no_table_are_refused(tmp_path, spoil, word):
    arrays, metadata = contents("ltsh2")
    spoil(arrays, metadata)
    assert_refused(written(tmp_path / "spoiled.npz", arrays, metadata), word)


def test_a_table_of_two_fresnel_curves_is_refused(tmp_path):
    """Engines need no more, see `tables.pack.with_two_curves`; shading takes a third."""
    arrays, metadata = contents("ltsh2")
    arrays["fresnel_curves"] = arrays["fresnel_curves"][:2]
    for key, axis in (("coefficients", 2), ("fresnel_weights", 1), ("average_albedo", 1)):
        arrays[key] = arrays[key].take([0, 1], axis=axis)
    assert_refused(written(tmp_path / "two.npz", arrays, metadata), "expected at least (2, 2, 3, 1)")


@pytest.mark.parametrize("metadata", [None, "not json {", "[1, 2]", "null"])
def test_broken_metadata_is_refused(tmp_path, metadata):
    arrays, _ = contents("ltc")
    np.savez(tmp_path / "broken.npz", **arrays, **({} if metadata is None else {"metadata": np.array(metadata)}))
    assert_refused(tmp_path / "broken.npz")


def test_pickled_objects_are_refused_and_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "exploded"), "w"))

    arrays, metadata = contents("ltsh2")
    path = tmp_path / "pickle.npz"
    np.savez(path, **{**arrays, "warp": np.array([Bomb()], dtype=object)}, metadata=np.array(json.dumps(metadata)))
    assert_refused(path, "warp holds Python objects")
    assert not (tmp_path / "exploded").exists()
