"""What is measured: polygons in local frames, and a floor under rectangular lights."""

from dataclasses import replace

import numpy as np

from ltsh_addon.cycles.environment import CUBE, SkyPicture, sky_lights
from ltsh_addon.scene import QuadLight, SkyLight, SurfaceSamples


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_polygons(count, kind, seed=0):
    """cos_theta_o (P,), roughness (P,) in [0.1, 1], vertices (P, 4, 3), float32. `kind` "whole": above the horizon;
    "mixed": 70 % above, 20 % cut by it, 10 % below; "cut": all of them cut."""
    generator = np.random.default_rng(seed)
    center = unit(generator.normal(size=(count, 3)))
    center[:, 2] = np.abs(center[:, 2])
    size = 10.0 ** generator.uniform(-1.2, -0.2, size=(count, 1))
    u = unit(np.cross(center, generator.normal(size=(count, 3))))
    v = unit(np.cross(center, u) + 0.5 * generator.normal(size=(count, 3)))
    angle = 0.5 * np.pi * (np.arange(4) + 0.5)
    vertices = size[..., None] * (np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None])
    half_height = -vertices[..., 2].min(axis=1)
    share = generator.random(count)
    above = half_height * (1.05 + generator.random(count)) + 0.5 * generator.random(count)
    cut = half_height * generator.uniform(-0.9, 0.9, count)
    limits = {"whole": (1.0, 1.0), "mixed": (0.7, 0.9), "cut": (0.0, 1.0)}[kind]
    center[:, 2] = np.where(share < limits[0], above, np.where(share < limits[1], cut, -above))
    vertices = vertices + center[:, None]
    cosine, roughness = 0.05 + 0.95 * generator.random(count), 0.1 + 0.9 * generator.random(count)
    return cosine.astype(np.float32), roughness.astype(np.float32), vertices.astype(np.float32)


def floor_scene(count, lights=4, fresnel="white", seed=0):
    """Samples on a bumpy floor of 6 m, seen from one side, and `lights` rectangles hanging over it and around it.

    `fresnel`: "white" (F = 1), "schlick", "f82" (a metal with a tint), "dielectric" (all of one IOR), "both" (Schlick
    and a dielectric).
    """
    generator = np.random.default_rng(seed)
    position = np.zeros((count, 3))
    position[:, :2] = generator.uniform(-3.0, 3.0, size=(count, 2))
    normal = unit(np.array([0.0, 0.0, 1.0]) + 0.15 * generator.normal(size=(count, 3)))
    ones, none = np.ones((count, 3)), np.zeros((count, 3))
    metal = fresnel != "dielectric"
    samples = SurfaceSamples(
        position=position,
        view=unit(np.array([0.0, -8.0, 3.0]) - position),
        normal=normal,
        diffuse_normal=normal,
        roughness=0.1 + 0.9 * generator.random(count),
        specular_f0=(ones if fresnel == "white" else 0.6 * ones) if metal else none,
        specular_f90=ones if metal else none,
        specular_dip=0.8 * ones if fresnel == "f82" else None,
        dielectric=np.full(count, 1.0 if fresnel in ("dielectric", "both") else 0.0),
        ior=np.full(count, 1.5),
        diffuse_albedo=0.5 * ones,
    )
    return samples, [_lamp(number, generator) for number in range(lights)]


def _lamp(number, generator):
    """Three of four hang over the floor, one stands at its edge; they shine towards its middle."""
    angle = 2.4 * number
    height = 0.7 if number % 4 == 3 else 2.0 + generator.random()
    center = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), height])
    if number % 4 == 3:
        center[:2] *= 1.4
    direction = unit(np.array([0.0, 0.0, 0.2]) - center)
    half_u = 0.5 * unit(np.cross(direction, [0.0, 0.0, 1.0]))
    half_v = 0.7 * np.cross(direction, unit(half_u))
    lamp = QuadLight("Lamp", center, half_u, half_v, direction, np.array([5.0, 4.0, 3.0]))
    return lamp if np.dot(np.cross(half_u, half_v), direction) > 0 else replace(lamp, half_v=-half_v)


WORLDS = {
    "constant": lambda unit: np.ones(unit.shape),
    "gradient": lambda unit: (0.2 + 0.3 * (1.0 + unit[..., 2:])) * [0.8, 0.9, 1.0],
    "windows": lambda unit: np.where(
        (np.abs(np.sin(3.0 * unit)) > 0.9).all(axis=-1, keepdims=True), 12.0, 0.4 * unit**2
    ),
}


def world(kind):
    """The lights of one of WORLDS, as of a picture of 64 x 64 pixels a side."""
    like = SkyLight("World", [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], np.ones(3))
    sides = [SkyPicture(*axes, np.zeros((64, 64, 3))) for axes in CUBE]
    return list(sky_lights(like, [replace(one, radiance=WORLDS[kind](unit(one.offsets()))) for one in sides])[0])


def metals_of_product(count, anisotropy):
    """Brushed legs of a product shot: a metal of roughness 0.15 to 0.45, in the places of `floor_scene`."""
    samples, lights = floor_scene(count, 3, "f82")
    turn = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, count)
    tangent = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    own = {"roughness": 0.15 + 0.3 * (samples.roughness - 0.1) / 0.9, "specular_f0": np.full((count, 3), 0.78)}
    return replace(samples, **own, anisotropy=np.full(count, anisotropy), tangent=tangent), lights
