"""Long checks of the integrals: `make soak`. Random evaluations must be finite and not negative, and random polygons of
every kind must agree with quadrature.

python tests/soak/soak.py [--evaluations N] [--polygons N] [--seed S]
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import hostile_polygons as hostile  # noqa: E402
import polar_quadrature  # noqa: E402

from ltsh_addon import shading  # noqa: E402
from ltsh_addon.lobes import spherical_harmonics  # noqa: E402

TABLES = {name: shading.load_table(name) for name in shading.SHIPPED_TABLES}
BATCH = 50_000
QUADRATURE_BATCH = 2000
# Absolute, against quadrature; of 1e5 polygons of each set the worst were 3e-13 and 1.8e-5.
DOUBLE, SINGLE = 1e-11, 2e-5
# Of tiny polygons in float32, unless the lobe is a thousand times darker there than elsewhere.
RELATIVE = 1e-4


def evaluate(count, generator):
    """`count` integrals over hostile polygons, all tables, both precisions: finite and not negative."""
    done, start, shown = 0, time.perf_counter(), 0.0
    while done < count:
        for kind in hostile.HOSTILE:
            polygons = kind(generator, BATCH)
            cosine, roughness = hostile.setting(generator, BATCH)
            for name, table in TABLES.items():
                # Single precision is what shades; double precision is its oracle and five times slower.
                for dtype in (np.float32,) * 4 + (np.float64,):
                    values = shading.integrate_polygon(table, cosine, roughness, polygons.astype(dtype))
                    wrong = ~(np.isfinite(values) & (values >= 0.0))
                    if wrong.any():
                        first = np.nonzero(wrong)[0][0]
                        raise SystemExit(
                            f"{name} {kind.__name__} {np.dtype(dtype)}: {values[first]} at cos_theta_o "
                            f"{cosine[first]!r}, roughness {roughness[first]!r}, {polygons[first].tolist()}"
                        )
                    done += BATCH
                    cosine, roughness = np.roll(cosine, 1), np.roll(roughness, 1)
        seconds = time.perf_counter() - start
        if seconds - shown > 10.0 or done >= count:
            shown = seconds
            print(f"  {done:.2e} of {count:.0e} evaluations, {seconds:.0f} s", flush=True)


def generic(generator, count):
    """Squares of 0.03 to 1 around random directions, above the horizon."""
    return _lifted(_squares(generator, count, 10.0 ** generator.uniform(-1.5, 0.0, size=(count, 1, 1))))


def tiny(generator, count):
    return _lifted(_squares(generator, count, 1e-4))


def _squares(generator, count, size):
    center = hostile.unit(generator.normal(size=(count, 3)) + np.array([0.0, 0.0, 0.7]))
    return hostile.oriented(generator, count, center, size)


def _lifted(polygons):
    lift = np.maximum(0.01 - polygons[..., 2].min(axis=1), 0.0)
    return polygons + np.array([0.0, 0.0, 1.0]) * lift[:, None, None]


def huge(generator, count):
    """Ceilings at 0.001 to 1 of their size."""
    height = 10.0 ** generator.uniform(-3.0, 0.0, size=(count, 1, 1))
    shift = generator.uniform(-0.8, 0.8, size=(count, 1, 3)) * np.array([1.0, 1.0, 0.0])
    return hostile.SQUARE + shift + height * np.array([0.0, 0.0, 1.0])


def crossing(generator, count):
    """Cut by the horizon at any angle."""
    return _squares(generator, count, 10.0 ** generator.uniform(-0.5, 0.5, size=(count, 1, 1)))


def grazing(generator, count):
    """Planes that pass by the point at 1e-3 to 1e-1 of their size, cut by the horizon."""
    polygons = hostile.oriented(generator, count, np.zeros((count, 3)), 1.0)
    u = polygons[:, 1] - polygons[:, 0]
    normal = hostile.unit(np.cross(u, polygons[:, 2] - polygons[:, 1]))[:, None]
    gap = 10.0 ** generator.uniform(-3.0, -1.0, size=(count, 1, 1))
    return polygons + u[:, None] * generator.uniform(-1.0, 1.0, size=(count, 1, 1)) + gap * normal


def edge_on(generator, count):
    """Seen at 1e-4 to 1e-2 of their size from their planes, beside the point."""
    center = hostile.unit(generator.normal(size=(count, 3)) + np.array([0.0, 0.0, 1.0]))
    normal = hostile.unit(np.cross(center, generator.normal(size=(count, 3))))
    gap = 10.0 ** generator.uniform(-4.0, -2.0, size=(count, 1))
    u, v = 0.4 * center[:, None], 0.4 * np.cross(normal, center)[:, None]
    corners = hostile.SQUARE[:, :1] * u + hostile.SQUARE[:, 1:2] * v
    return corners + (center + gap * normal)[:, None]


def repeated(generator, count):
    """A corner twice and one on the edge between its neighbors: hexagons that are rectangles."""
    polygons = generic(generator, count)
    middle = 0.5 * (polygons[:, 1] + polygons[:, 2])
    return np.concatenate([polygons[:, :2], middle[:, None], polygons[:, 2:3], polygons[:, 2:]], axis=1)


SETS = (generic, tiny, huge, crossing, grazing, edge_on, repeated)


def against_quadrature(count, generator):
    """`count` polygons of each set and lobes of the tables, in both precisions."""
    for kind in SETS:
        worst, start = {np.float64: 0.0, np.float32: 0.0}, time.perf_counter()
        relative = 0.0
        for first in range(0, count, QUADRATURE_BATCH):
            size = min(QUADRATURE_BATCH, count - first)
            polygons = kind(generator, size).astype(np.float32)
            cosine, roughness = generator.random(size).astype(np.float32), generator.uniform(0.4, 1.0, size)
            roughness = roughness.astype(np.float32)
            table = TABLES[("ltsh2", "ltsh4")[first // QUADRATURE_BATCH % 2]]
            expected = quadrature(table, cosine, roughness, polygons.astype(np.float64))
            for dtype in worst:
                found = shading.integrate_polygon(table, cosine, roughness, polygons.astype(dtype), signed=True)
                error = np.abs(found - expected)
                worst[dtype] = max(worst[dtype], error.max())
                if dtype == np.float32 and kind is tiny:
                    scale = np.abs(expected)
                    relative = max(relative, (error / np.maximum(scale, 1e-3 * scale.max())).max())
        text = f"  {kind.__name__:<9} {count} polygons: "
        text += f"float64 {worst[np.float64]:.1e} (limit {DOUBLE:.0e}), float32 {worst[np.float32]:.1e} ({SINGLE:.0e})"
        text += f", relative {relative:.1e} ({RELATIVE:.0e})" if kind is tiny else ""
        print(f"{text}, {time.perf_counter() - start:.0f} s", flush=True)
        if worst[np.float64] > DOUBLE or worst[np.float32] > SINGLE or relative > RELATIVE:
            raise SystemExit(f"{kind.__name__}: beyond the limit")


def quadrature(table, cosine, roughness, polygons):
    """Signed integrals (P,) of the lobes over polygons (P, V, 3): of the harmonics over the warped polygons, by
    quadrature in polar coordinates."""
    lobe = table.lookup(cosine.astype(float), roughness.astype(float), curves=1)
    warped = lobe.to_original_domain(polygons.transpose(2, 1, 0)).transpose(2, 1, 0)
    coefficients = lobe.coefficients[0].T[..., None]  # (P, K, 1)

    def harmonics(directions):
        basis = spherical_harmonics.evaluate(table.degree, directions)
        return sum(basis[k] * coefficients[:, k] for k in range(len(basis)))

    return polar_quadrature.integrate(warped, harmonics)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--evaluations", type=float, default=1e8)
    parser.add_argument("--polygons", type=float, default=1e5)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    generator = np.random.default_rng(options.seed)
    print(f"random polygons against quadrature, seed {options.seed}")
    against_quadrature(int(options.polygons), generator)
    print("random evaluations: finite and not negative")
    evaluate(int(options.evaluations), generator)
    print("passed")


if __name__ == "__main__":
    main()
