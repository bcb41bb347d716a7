"""A ball on a floor under two lights, and the errors of techniques against Cycles there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scene_parts

from ltsh_addon.cycles import gbuffer
from ltsh_addon.imaging import unbiased_relative_error
from ltsh_addon.shading import shade

SIZE = (24, 16)
# Techniques are judged where the surface is not seen at a grazing angle.
STEEP_COSINE = 0.2


def build(material):
    """A floor and a ball of `material`, a large light behind them and a round one above."""
    scene_parts.add_camera((0.0, -3.2, 1.8), (1.1, 0.0, 0.0))
    scene_parts.add_area_light("Key", location=(0.2, 2.2, 1.3), rotation=(-1.2, 0.2, 0.0), size=2.0, size_y=1.2)
    scene_parts.add_area_light("Top", (-0.8, -0.4, 2.2), (0.1, -0.2, 0.0), shape="DISK", size=0.8, energy=30.0)
    scene_parts.add_plane(material, size=12.0)
    scene_parts.add_sphere(material, radius=0.6, location=(0.3, 0.2, 0.6))


def prepared_scene(make):
    """An empty scene with the material that `make()` returns, prepared as the child does it."""
    scene_parts.empty_scene(*SIZE)
    build(make())
    return scene_parts.prepare()


def errors(folder: Path, prepared, cycles_samples: int, techniques=("reference", "ltsh4", "ltc")):
    """(pass, technique) -> squared error against Cycles beyond the noise of Cycles: all pixels, and steep ones."""
    ((samples, pixel, unusable),), _ = scene_parts.sample(folder, prepared)
    assert unusable == 0
    samples, film = gbuffer.join([(samples, pixel)], *SIZE)
    halves = scene_parts.reference(folder, prepared, cycles_samples)
    cosine = np.sum(samples.view * samples.normal, axis=-1)
    grazing = film.image(cosine < STEEP_COSINE) > 0.0
    hit = film.coverage() > 0.0
    found = {}
    for technique in techniques:
        shaded = shade(samples, prepared[2].lights, technique, workers=1)
        for name in ("specular", "diffuse"):
            image = film.image(getattr(shaded, name).sum(axis=0))
            squared = [unbiased_relative_error(image, *halves[name], mask)[1] for mask in (hit, hit & ~grazing)]
            found[name, technique] = squared
    return found
