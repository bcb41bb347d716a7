"""The shipped tables, random polygons for their lobes, and the integral of a lobe by quadrature."""

import numpy as np
import polygon_quadrature
import pytest
import textbook

from ltsh_addon import shading

TABLES = {name: shading.load_table(name) for name in shading.SHIPPED_TABLES}
table_names = pytest.mark.parametrize("name", shading.SHIPPED_TABLES)


def random_rectangles(generator, count, crossing):
    """Rectangles (P, 4, 3) above the horizon, or crossing it."""
    found = []
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    while len(found) < count:
        center = generator.normal(size=3) + np.array([-0.5, 0.0, 0.5])
        u = generator.normal(size=3)
        v = np.cross(u, generator.normal(size=3))
        rectangle = center + signs[:, :1] * u + signs[:, 1:] * v
        above = (rectangle[:, 2] > 0.0).sum()
        if (0 < above < 4) if crossing else above == 4:
            found.append(rectangle)
    return np.array(found)


def lobe_quadrature(table, cosine, roughness, polygon, tolerance=1e-8):
    """Signed integral of `evaluate_lobe` over one polygon above the horizon, and an error bound.

    The clamped cosine of "ltc" has a kink, of which two orders of a rule may both miss a piece: a finer start and an
    allowance for that.
    """
    smooth = table.family == "ltsh"

    def lobe(directions):
        flat = directions.reshape(1, -1, 3)
        values = shading.evaluate_lobe(table, np.array([cosine]), np.array([roughness]), flat)
        return values.reshape(directions.shape[:-1])

    apex = textbook.mirror_direction(max(cosine, 0.05))
    value, bound = polygon_quadrature.adaptive_integral(polygon, lobe, apex, tolerance, 2 if smooth else 4)
    return value, bound + (1e-9 if smooth else 3e-7)
