"""Tables as textures for other engines: the two of Heitz et al. 2016 in a shader like theirs, half floats, DDS."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from ltsh_addon import shading
from tables import header, layouts, validate
from tables.header import data_blocks


def sampled(texture, u, v):
    """Bilinear lookup of (N, N, C) at 0 .. 1, as the shader does it with LUT_SCALE and LUT_BIAS."""
    size = len(texture)
    x, y = u * (size - 1), v * (size - 1)
    i, j = min(int(x), size - 2), min(int(y), size - 2)
    top = texture[j, i] * (i + 1 - x) + texture[j, i + 1] * (x - i)
    bottom = texture[j + 1, i] * (i + 1 - x) + texture[j + 1, i + 1] * (x - i)
    return top * (j + 1 - y) + bottom * (y - j)


def shader(textures, cosine, roughness, corners):
    """What a shader of Heitz et al. computes for a polygon (V, 3) around the point, clipped at the horizon of the
    transformed space."""
    u, v = roughness, np.sqrt(1.0 - cosine)
    a, b, c, d = sampled(textures[0].astype(float), u, v)
    inverse = np.array([[a, 0.0, c], [0.0, 1.0, 0.0], [b, 0.0, d]])
    clipped, turned = [], corners @ inverse.T
    for start, end in zip(turned, np.roll(turned, -1, axis=0), strict=True):
        if start[2] > 0.0:
            clipped.append(start)
        if (start[2] > 0.0) != (end[2] > 0.0):
            clipped.append(start + start[2] / (start[2] - end[2]) * (end - start))
    if not clipped:
        return 0.0
    unit = np.array(clipped) / np.linalg.norm(clipped, axis=1, keepdims=True)
    total = 0.0
    for start, end in zip(unit, np.roll(unit, -1, axis=0), strict=True):
        angle = np.arccos(np.clip(start @ end, -1.0, 1.0))
        total += np.cross(start, end)[2] * angle / max(np.sin(angle), 1e-12)
    return abs(total) / (2.0 * np.pi) * sampled(textures[1].astype(float), u, v)[0]


def test_a_shader_of_the_usual_kind_takes_the_two_textures():
    """Beside the table's own lookup: the same at its nodes, close to it between them."""
    table, generator = shading.load_table("ltc"), np.random.default_rng(1)
    textures = layouts.layout_textures(layouts.LAYOUTS["three"], table)
    for number in range(60):
        row, column = generator.integers(8, 64), generator.integers(0, 63)
        at_node = number % 2 == 0
        roughness = row / 63 if at_node else generator.uniform(0.1, 1.0)
        cosine = 1.0 - (column / 63) ** 2 if at_node else generator.uniform(0.05, 1.0)
        center = generator.normal(size=3) + (0.0, 0.0, 2.5)
        first, second = generator.normal(size=(2, 3)) * 0.6
        corners = np.array([center - first - second, center + first - second, center + first + second,
                            center - first + second])  # fmt: skip
        corners[:, 2] = np.maximum(corners[:, 2], 0.05)
        expected = shading.integrate_polygon(table, np.array([cosine]), np.array([roughness]), corners[None])[0]
        found = shader(textures, cosine, roughness, corners)
        assert abs(found - expected) < (2e-5 if at_node else 5e-3), (cosine, roughness)


def test_the_errors_of_the_layouts_are_close_to_those_of_the_table():
    """At 4 x 4 points; tables/README.md and docs/engines.md have those of all."""
    table = shading.load_table("ltc")
    own, found = validate.error_map(table, 4).mean(), validate.layout_errors(table, 4)
    assert found["two_textures"] < 1.02 * own and abs(found["half"] / own - 1.0) < 0.002
    table = shading.load_table("ltsh4")
    own, found = validate.error_map(table, 4).mean(), validate.layout_errors(table, 4)
    assert abs(found["half"] / own - 1.0) < 0.02 and set(found) == {"half"}


@pytest.mark.parametrize("height", [1.0, 0.7, 0.2, 0.0, -0.3, -0.8])
@pytest.mark.parametrize("form_factor", [0.01, 0.2, 0.6, 0.95])
def test_the_clipped_sphere_is_the_cosine_over_its_cap_above_the_horizon(height, form_factor):
    sigma, turn = np.arcsin(np.sqrt(form_factor)), np.arccos(height)
    z, weights = np.polynomial.legendre.leggauss(400)
    z = 0.5 * (1.0 + np.cos(sigma)) + 0.5 * (1.0 - np.cos(sigma)) * z
    angle = (np.arange(800) + 0.5) / 800 * 2.0 * np.pi
    cosine = np.cos(turn) * z[:, None] + np.sin(turn) * np.sqrt(1.0 - z * z)[:, None] * np.cos(angle)
    weights = 0.5 * (1.0 - np.cos(sigma)) * weights * 2.0 * np.pi / 800
    expected = (weights @ np.maximum(cosine, 0.0)).sum() / np.pi / form_factor
    assert layouts.clipped_sphere_factor(np.array([height]), np.array([form_factor]))[0] == pytest.approx(
        expected, abs=2e-4
    )


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_the_array_texture_holds_the_nodes_four_channels_to_a_layer(name):
    table = shading.load_table(name)
    data = header.dds(header.half_layers(table))
    magic, size, _, height, width = struct.unpack_from("<4s4I", data)
    form, dimension, _, layers, _ = struct.unpack_from("<5I", data, 128)
    rows, columns = table.warp.shape[:2]
    assert (magic, size, height, width, data[84:88]) == (b"DDS ", 124, rows, columns, b"DX10")
    assert (form, dimension, len(data)) == (10, 3, 148 + layers * rows * columns * 8)
    found = np.frombuffer(data, "<f2", offset=148).reshape(layers, rows, columns, 4)
    nodes = data_blocks(table)["NODES"].reshape(rows, columns, -1)
    for channel in range(nodes.shape[2]):
        assert np.array_equal(found[channel // 4, :, :, channel % 4], nodes[..., channel].astype(np.float16))


def test_numbers_that_no_half_float_holds_are_refused():
    table = shading.load_table("ltsh2")
    coefficients = table.coefficients.copy()
    coefficients[3, 3, 0, 0] = 1e6
    with pytest.raises(shading.TableError, match="its largest number is 1e\\+06, expected at most 65504"):
        header.half_layers(replace(table, coefficients=coefficients))
