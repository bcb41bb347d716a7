"""The comparison of a table with the best lobe at grazing views."""

from dataclasses import replace

import numpy as np
import pytest

from ltsh_addon.shading import load_table
from tables import __main__, grazing, validate


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(grazing, "ROUGHNESS", (0.2, 0.5))
    monkeypatch.setattr(grazing, "COSINES", (0.05, 0.15))


@pytest.fixture(scope="module")
def tables():
    return {name: load_table(name) for name in ("ltsh2", "ltsh4")}


def test_no_table_beats_the_lobe_solved_at_the_point(tables):
    found = {name: grazing.grazing_errors(table, 2) for name, table in tables.items()}
    points = [(0.2, 0.05), (0.2, 0.15), (0.5, 0.05), (0.5, 0.15)]
    assert [(row.roughness, row.cosine) for row in found["ltsh4"]] == points
    for rows in found.values():
        for row in rows:
            # The search uses another quadrature than the measurement, which agree to 1 %.
            assert 0.99 * row.solved_lobe < row.table_lobe < 1.3 * row.solved_lobe
            assert row.ratio == row.table / row.solved
    # More coefficients, less error.
    for two, four in zip(found["ltsh2"], found["ltsh4"], strict=True):
        assert four.solved_lobe < 0.9 * two.solved_lobe


def test_the_error_of_the_table_is_that_of_validate(tables):
    for row in grazing.grazing_errors(tables["ltsh4"], 2):
        measured = validate._measure(tables["ltsh4"], row.cosine, row.roughness)
        assert np.isclose(row.table_lobe, measured[0], rtol=1e-12)
        # validate gives the squared integrals over disks relative to the albedo, and their squared errors.
        assert np.isclose(row.table, np.sqrt(measured[5] / measured[4]), rtol=1e-9)


def test_a_spoiled_table_stands_out_and_does_not_spoil_the_solved_lobe(tables):
    good = grazing.grazing_errors(tables["ltsh4"], 2)
    table = tables["ltsh4"]
    spoiled = grazing.grazing_errors(replace(table, coefficients=1.3 * table.coefficients), 2)
    for before, after in zip(good, spoiled, strict=True):
        assert after.ratio > 1.5 * before.ratio and np.isclose(after.solved_lobe, before.solved_lobe, rtol=1e-9)


def test_the_command_prints_every_point_and_the_goal(capsys):
    assert __main__.main(["optimum", "ltsh2", "--grazing"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 4 + 1 and lines[0].startswith("| `ltsh2` roughness") and "of 4 points" in lines[-1]


def test_the_command_refuses_what_has_no_table_of_spherical_harmonics(capsys):
    assert __main__.main(["optimum", "ltc", "--grazing"]) == 2
    assert "ltsh2 or ltsh4" in capsys.readouterr().err
