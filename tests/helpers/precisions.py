"""All techniques of `shade`, and single precision beside double precision."""

import numpy as np
import pytest

from ltsh_addon import shading

TECHNIQUES = (*shading.SHIPPED_TABLES, shading.REFERENCE)
techniques = pytest.mark.parametrize("technique", TECHNIQUES)
# Both precisions among all techniques
_DTYPES = (np.float32, np.float64, np.float32, np.float32, np.float64)
techniques_and_types = pytest.mark.parametrize(("technique", "dtype"), [*zip(TECHNIQUES, _DTYPES, strict=True)])
# What `shade` promises for radiance 1.
PROMISED = 2e-5


def assert_close(samples, lights, name):
    single = shading.shade(samples, lights, name, workers=1)
    double = shading.shade(samples, lights, name, workers=1, dtype=np.float64)
    for part in shading.PASSES:
        found, expected = getattr(single, part), getattr(double, part)
        assert found.dtype == np.float32 and expected.dtype == np.float64
        assert np.isfinite(found).all() and (found >= 0.0).all()
        error = np.abs(found - expected).max(axis=(0, 2))
        worst = error.argmax()
        assert error[worst] < PROMISED, (part, samples.take(slice(worst, worst + 1)))
    return double
