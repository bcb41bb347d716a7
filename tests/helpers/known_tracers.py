"""Tracers of shadow rays whose answers are known, and a floor and a light for them."""

import numpy as np
import random_surfaces

from ltsh_addon.scene import Film, SurfaceSamples, light_of
from ltsh_addon.visibility.occluders import ChosenBy


class Tracer:
    """Rays with a function of origins, directions (R, 3) and distances (R,) for the light that they let through."""

    def __init__(self, passed=lambda origins, directions, distances: np.ones(len(origins))):
        self.passed, self.rays = passed, 0

    library = None

    @property
    def occluders(self):
        return self

    def mask_of(self, name):
        return 0xFFFFFFFF

    surface_mask_of = mask_of

    def chosen_by(self, name):
        return ChosenBy(surface=False)

    def ray_origins(self, samples):
        self.position, self.geometric_normal = samples.position.astype(np.float32), samples.geometric_normal
        self.clearance = np.zeros(len(samples), np.float32)
        return self

    def aimed(self, index, directions, distances, at_surface=False):
        origins = np.broadcast_to(self.position[index].T[:, None], directions.shape)
        return origins.astype(np.float32), directions, distances, np.zeros(0, int)

    def past_touching(self, index, directions, masks):
        return None

    def transmittance(self, origins, directions, distances, masks):
        self.rays += len(origins)
        assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-5)
        return self.passed(origins, directions, distances).astype(np.float32)


OPEN, WALL = Tracer(), Tracer(lambda origins, directions, distances: np.zeros(len(origins)))


def past_spheres(*spheres):
    """A tracer for opaque spheres (center, radius)."""

    def passed(origins, directions, distances):
        free = np.ones(len(origins), bool)
        for center, radius in spheres:
            offset = origins - np.asarray(center)
            along = (offset * directions).sum(axis=1)
            root = along**2 - (offset**2).sum(axis=1) + radius**2
            near = -along - np.sqrt(np.maximum(root, 0.0))
            free &= (root <= 0.0) | (near <= 0.0) | (near >= distances)
        return free

    return Tracer(passed)


def floor(side, roughness=0.3):
    """side^2 samples of the floor from -2 to 2 m, with a diffuse and a specular lobe, and their film."""
    y, x = (np.mgrid[0:side, 0:side].reshape(2, -1) + 0.5) / side * 4.0 - 2.0
    position = np.stack([x, y, np.zeros_like(x)], axis=1)
    view = random_surfaces.unit(np.array([0.0, -6.0, 3.0]) - position)
    count = len(position)
    gray = np.full((count, 3), 0.5)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (count, 3))
    samples = SurfaceSamples(
        position, view, up, up, np.full(count, roughness), gray, gray, np.zeros(count), np.full(count, 1.5), gray
    )
    return samples, Film(side, side, np.arange(count))


def panel(**changes):
    """A light of 2 x 1.4 m that stands at the end of the floor."""
    direction = np.array([0.0, -np.cos(0.3), -np.sin(0.3)])
    half_u = np.array([1.0, 0.0, 0.0])
    values = {
        "name": "Panel", "shape": "RECTANGLE", "center": np.array([0.0, 3.0, 1.5]), "half_u": half_u,
        "half_v": 0.7 * np.cross(direction, half_u), "direction": direction, "radiance": np.ones(3),
    }  # fmt: skip
    return light_of(values | changes)
