"""How close the techniques come to the reference on random surfaces and lights."""

import numpy as np
import pytest
from surface_scenes import four_lights, random_samples, unit

from ltsh_addon import shading
from ltsh_addon.scene import SurfaceSamples

COUNT = 1500


def reflecting_samples(count, seed, metal):
    """Points on a floor and two walls whose mirror directions meet the lights' surroundings, at all view angles."""
    samples = random_samples(count, seed, lowest_roughness=0.08)
    generator = np.random.default_rng(seed + 100)
    centers = np.array([light.center for light in four_lights()])
    target = centers[generator.integers(0, 4, count)] + 0.6 * generator.normal(size=(count, 3))
    towards = unit(target - samples.position)
    cosine = generator.uniform(0.03, 0.98, size=(count, 1))
    side = unit(np.cross(towards, generator.normal(size=(count, 3))))
    normal = cosine * towards + np.sqrt(1.0 - cosine**2) * side
    view = 2.0 * (towards * normal).sum(axis=1, keepdims=True) * normal - towards
    share = np.full((count, 3), 1.0 if metal else 0.0)
    fields = {name: getattr(samples, name) for name in samples.__dataclass_fields__}
    fields.update(normal=normal, diffuse_normal=normal, geometric_normal=normal, view=view)
    fields.update(specular_f0=0.9 * share, specular_f90=share, dielectric=1.0 - share[:, 0])
    return SurfaceSamples(**fields)


@pytest.mark.parametrize("kind", ["metal", "dielectric"])
def test_more_coefficients_are_closer_and_degree_4_is_close(kind):
    """Relative L2 errors of the specular pass. 2 % is what a scene of metals may be off, 4 % one of dielectrics; this
    set favors neither."""
    samples = reflecting_samples(COUNT, seed=1, metal=kind == "metal")
    reference = shading.shade(samples, four_lights(), shading.REFERENCE, passes=["specular"])
    assert (reference.quadrature_error < 1e-3).all()
    truth, errors = reference.combined, {}
    for name in shading.SHIPPED_TABLES:
        value = shading.shade(samples, four_lights(), name, passes=["specular"]).combined
        errors[name] = np.sqrt(((value - truth) ** 2).sum() / (truth**2).sum())
    print(kind, {name: round(float(value), 5) for name, value in errors.items()})
    assert errors["ltsh4"] < errors["ltsh2"] < errors["ltc"], errors
    assert errors["ltsh4"] < 0.02 and 2.0 * errors["ltsh4"] < errors["ltc"], errors
