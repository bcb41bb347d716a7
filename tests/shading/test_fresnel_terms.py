"""F82 metals, tinted dielectrics and their clamp, against sums over patches with the true BRDF."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
from precisions import assert_close
from surface_scenes import area_light, random_samples, single_sample, unit

from ltsh_addon import shading
from ltsh_addon.lobes import brdf

# Overhead, and low beyond the point: at grazing angles the terms differ most.
LOW = {"center": (-1.6, 0.1, 0.35), "half_u": (0, 0.5, 0), "half_v": (0, 0, 0.25), "radiance": (1.0, 1.0, 1.0)}
LIGHT = {"center": (-0.6, 0.1, 1.6), "half_u": (0.5, 0, 0), "half_v": (0, -0.4, 0), "radiance": (1.0, 2.0, 0.5)}


def f82_term(f0, tint):
    """The factor of c (1 - c)^6 of Blender's F82 tint, by which the reflectance at c = 1/7 is `tint` times Schlick's
    (Kutz, Hasan and Edmondson 2021, eq. 5)."""
    schlick = f0 + (1.0 - f0) * (6.0 / 7.0) ** 5
    return schlick * (1.0 - tint) * 7.0 / (6.0 / 7.0) ** 6


def gold(tint=(0.2, 0.5, 0.9)):
    f0 = np.array([0.95, 0.7, 0.3])
    return {"specular_f0": f0, "specular_f90": (1, 1, 1), "specular_dip": f82_term(f0, np.array(tint))}


SURFACES = {
    "F82": gold(),
    "tinted dielectric": {"dielectric": (1.0, 0.4, 0.1), "ior": 1.6},
    "negative dielectric": {  # Blender's tint: f0 tint + (1 - f0 tint) s, with s = (F_d - F_0) / (1 - F_0)
        "specular_f0": (0.0, -0.01, -0.02), "specular_f90": (0.0, -0.01, -0.02),
        "dielectric": (1.0, 1.01, 1.02), "ior": 1.5,
    },
    "black edge": {
        "specular_f0": (0.1, 0.3, 0.6), "specular_f90": (1, 1, 1),
        "specular_dip": f82_term(np.array([0.1, 0.3, 0.6]), np.zeros(3)),
    },
    "IOR below 1": {"dielectric": (1.0, 0.5, 0.2), "ior": 0.7},
    "all": {**gold(), "dielectric": (0.1, 0.5, 0.9), "ior": 2.0},
}  # fmt: skip


# Of the error of harmonics, of the brightest. A black edge, which the tables look up at points of the light, turns into
# white within this one where it is seen at 6 degrees.
LIMITS = {"F82": 0.12, "IOR below 1": 0.12, "black edge": 0.25}


def samples_of(fields):
    """Views from steep to grazing, rough to fairly sharp."""
    for cosine, roughness in ((0.95, 0.25), (0.6, 0.5), (0.25, 0.8), (0.1, 0.4)):
        view = (np.sqrt(1.0 - cosine**2), 0.05, cosine)
        yield single_sample(view=view, roughness=roughness, diffuse_albedo=(0, 0, 0), **fields)


@pytest.mark.parametrize("place", [LIGHT, LOW], ids=["overhead", "low"])
@pytest.mark.parametrize("kind", SURFACES)
def test_the_reference_and_harmonics_have_every_term(kind, place):
    """The oracle's patches leave 1e-5, the quadrature 1e-4. Harmonics are within what the fit of a lobe may be off, of
    the brightest: cosines miss a dielectric by up to 40 %, and a strong F82 tint at grazing angles is a difference of
    large terms."""
    light = area_light(**place)
    samples = list(samples_of(SURFACES[kind]))
    expected = np.concatenate([quadrature.radiance(sample, [light], quadrature.ggx, 300) for sample in samples])
    for sample, wanted in zip(samples, expected, strict=True):
        found = shading.shade(sample, [light], shading.REFERENCE, passes=["specular"]).specular[0, 0]
        # Patches that the onset of total reflection crosses are half right.
        tolerance = 2e-3 if kind == "IOR below 1" else 2e-4
        # What is clipped is next to nothing beside the lobe without its reflectance, on which the quadrature goes by.
        assert found == pytest.approx(wanted, rel=tolerance, abs=1e-6 if kind == "black edge" else 1e-7), kind
    for dtype in (np.float32, np.float64):
        found = [shading.shade(sample, [light], "ltsh4", dtype=dtype).specular[0, 0] for sample in samples]
        assert np.abs(np.array(found) - expected).max() < LIMITS.get(kind, 0.06) * expected.max()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_the_tables_terms_are_integrals_of_the_lobes_they_fit(name, dtype):
    """Each term alone is that of white: f0 = f90 for 1, f0 = 0 for (1 - c)^5, and their sum is the sum."""
    light = area_light(**LOW)
    zero, one = (0, 0, 0), (1, 1, 1)
    fields = [
        {"specular_f0": one, "specular_f90": one},
        {"specular_f0": zero, "specular_f90": one},
        {"specular_f0": zero, "specular_f90": zero, "specular_dip": (-1, -1, -1)},
        {"specular_f0": zero, "specular_f90": zero, "dielectric": one, "ior": 1.5},
    ]
    f0, dip, coat = np.array([0.9, 0.5, 0.2]), np.array([0.3, 0.1, 0.4]), np.array([0.2, 0.7, 0.1])
    shown = 0
    for number in range(4):
        parts = [
            shading.shade(list(samples_of(part))[number], [light], name, dtype=dtype).specular[0, 0] for part in fields
        ]
        whole = {"specular_f0": f0, "specular_f90": one, "specular_dip": dip, "dielectric": coat, "ior": 1.5}
        found = shading.shade(list(samples_of(whole))[number], [light], name, dtype=dtype).specular[0, 0]
        expected = f0 * parts[0] + (1.0 - f0) * parts[1] - dip * parts[2] + coat * parts[3]
        # A term that is next to nothing may ring below zero: then it is clamped, alone and in the sum.
        shown += (np.array(parts) > 1e-4).all()
        assert found == pytest.approx(expected, rel=1e-5 if dtype == np.float32 else 1e-12)
    assert shown


def random_metals(count, seed, tint):
    samples = random_samples(count, seed, lowest_roughness=0.0)
    generator = np.random.default_rng(seed + 50)
    f0 = generator.random((count, 3))
    dip = f82_term(f0, tint + (1.0 - tint) * generator.random((count, 3)))
    dielectric = np.where(np.arange(count)[:, None] % 3 == 0, generator.random((count, 3)), 0.0)
    return replace(samples, specular_f0=f0, specular_f90=np.ones((count, 3)), specular_dip=dip, dielectric=dielectric)


@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_single_precision_keeps_its_promise(name):
    """Reflected light, not its terms: those are larger, up to three times for a black tint."""
    lights = [area_light(**{**LIGHT, "radiance": (0.3, 0.3, 0.3)}), area_light(center=(1.5, 0.5, 0.4), direction=unit(
        np.array([-1.0, -0.2, -0.1])), half_u=(0, 0.5, 0), half_v=(0, 0, 0.4), radiance=(0.3, 0.3, 0.3))]  # fmt: skip
    assert_close(random_metals(600, seed=8, tint=0.0), lights, name)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("technique", [*shading.SHIPPED_TABLES, shading.REFERENCE])
def test_terms_that_cancel_leave_nothing_below_zero(technique, dtype):
    """White that a dip and a negative coat take away again: the true sum may be 0, that of the fits is not."""
    samples = random_samples(150, seed=9, lowest_roughness=0.0)
    black = {"specular_f0": np.full((150, 3), 0.05), "specular_f90": np.full((150, 3), 0.05)}
    samples = replace(samples, **black, specular_dip=np.full((150, 3), 2.0), dielectric=np.full((150, 3), -0.02))
    lights = [area_light(**LIGHT)]
    found = shading.shade(samples, lights, technique, dtype=dtype).specular
    assert (found >= 0.0).all() and np.isfinite(found).all()
    assert (found == 0.0).all(axis=2).any(), "nothing was clamped: the test shows nothing"
    bright = shading.shade(replace(samples, specular_dip=np.zeros((150, 3))), lights, technique, dtype=dtype).specular
    assert bright.max() > 0.0


def test_metals_that_fall_below_black_are_found_among_all_and_others_are_not():
    generator = np.random.default_rng(3)
    f0 = generator.uniform(0.0, 1.0, (20_000, 3)) ** 3
    dip = f82_term(f0, generator.uniform(0.0, 1.2, f0.shape))
    cosine = np.linspace(0.0, 1.0, 501)[:, None, None]
    least = (f0 + (1.0 - f0) * (1.0 - cosine) ** 5 - dip * cosine * (1.0 - cosine) ** 6).min(axis=(0, 2))
    found = brdf.is_clipped(f0, np.ones_like(f0), dip)
    # The angles that are tried are 1/32 apart: next to them the reflectance differs by less than 0.01.
    assert found[least < -0.01].all() and not found[least >= 0.0].any()
    assert 0.02 < found.mean() < 0.98
