"""Random surface points seen from one place, and random area lights around them, of kinds that are hard each."""

from __future__ import annotations

import numpy as np
from surface_scenes import unit

from ltsh_addon.scene import (
    EllipseLight,
    Light,
    PointLight,
    PolygonLight,
    QuadLight,
    SpotCone,
    SpotLight,
    SunLight,
    SurfaceSamples,
)

EYE = np.array([0.25, -4.0, 2.0])
SURFACES = ("plain", "sharp", "grazing", "head-on", "tilted")
SHAPED = ("rough", "sheen")  # with other diffuse lobes than Lambert's
LIGHTS = ("plain", "near", "horizon", "tiny", "tiny disk", "huge", "disk", "polygon", "linked")
PROFILED_LIGHTS = ("spread", "narrow", "spread disk", "linear", "constant disk", "smooth")
FACING_LIGHTS = ("ball", "facing disk", "spot", "spot disk", "bulb", "sun")
GROUPS = 4


def rounded(values):
    """As single precision holds them: what the graphics card gets is then what the oracle gets."""
    return np.asarray(values, np.float32).astype(np.float64)


def samples(kind: str, count: int, random: np.random.Generator) -> SurfaceSamples:
    """`count` points within 2 m of the origin, half of them with normals that are far from upright."""
    flat, height = random.uniform(-2.0, 2.0, (count, 2)), random.uniform(-0.3, 0.3, (count, 1))
    position = rounded(np.concatenate([flat, height], axis=1))
    view = unit(EYE - position)
    normal = unit(np.array([0.0, 0.0, 1.0]) + 0.4 * random.normal(size=(count, 3)))
    roughness = random.random(count)
    if kind == "sharp":
        roughness = 10.0 ** random.uniform(-3.0, -0.7, count)
    elif kind == "grazing":
        # The rounding of a normal is 6e-8: from 3e-4 on the cosine has the digits that the test asks for.
        # Sharp lobes at grazing angles see small lights as hairs, whose edges are lost in single precision.
        roughness = 0.1 + 0.9 * roughness
        cosine = 10.0 ** random.uniform(-3.5, -1.0, (count, 1))
        normal = cosine * view + np.sqrt(1.0 - cosine**2) * unit(np.cross(view, random.normal(size=(count, 3))))
    elif kind == "head-on":
        normal = unit(view + 10.0 ** random.uniform(-7.0, -2.0, (count, 1)) * random.normal(size=(count, 3)))
    normal[(normal * view).sum(axis=1) < 0.0] *= -1.0
    normal = unit(rounded(normal))
    bends = 0.5 if kind == "tilted" else 0.0
    bent = [unit(rounded(normal + bends * random.normal(size=(count, 3)))) for _ in range(3)] if bends else [None] * 3
    if bends:
        # Horizons that are the same one: of both lobes, and of the diffuse one alone.
        for other in bent:
            other[::4] = normal[::4]
        bent[1][1::4] = bent[0][1::4]
    return SurfaceSamples(
        position=position,
        view=view,
        normal=normal,
        diffuse_normal=normal if bent[0] is None else bent[0],
        smooth_normal=bent[1],
        geometric_normal=bent[2],
        bump_alpha2=rounded(random.random(count)) if bends else None,
        roughness=rounded(roughness),
        diffuse_albedo=_colors(random, count),
        receiver=random.integers(0, GROUPS, count),
        **_fresnel(random, count),
        **_shape(kind, count, random),
    )


def _shape(kind, count, random):
    if kind == "rough":
        return {"diffuse_roughness": random.uniform(0.05, 1.0, count), "diffuse_rebound": 0.1 * _colors(random, count)}
    if kind == "brushed":
        return {"anisotropy": random.uniform(-0.6, 0.5, count), "tangent": random.normal(size=(count, 3))}
    if kind == "sheen":
        return {"sheen_a": random.uniform(0.2, 1.4, count), "sheen_b": random.uniform(-1.5, 0.3, count)}
    return {}


def _colors(random, count):
    return rounded(random.random((count, 3)))


def _fresnel(random, count):
    """A sixth each: white, Schlick, F82, dielectric of two common and of any index of refraction, coated metal."""
    kind = random.integers(0, 6, count)[:, None]
    is_metal = (kind != 3) & (kind != 4)
    f0 = _colors(random, count) * is_metal
    f90 = np.where(kind == 0, f0, 1.0) * is_metal
    common = np.where(kind[:, 0] == 3, 1.5, 1.45)
    return {
        "specular_f0": f0,
        "specular_f90": f90,
        "specular_dip": rounded(0.5 * f0 * _colors(random, count)) * (kind == 2),
        "dielectric": _colors(random, count) * (kind >= 3),
        "ior": rounded(np.where(kind[:, 0] == 5, random.uniform(1.0, 3.0, count), common)),
    }


def light(kind: str, number: int, random: np.random.Generator) -> Light:
    """A light within a few meters of the origin that shines towards it, with about the power of any other."""
    if kind in FACING_LIGHTS:
        return _facing(kind, number, random)
    center = np.array([*random.uniform(-2.0, 2.0, 2), random.uniform(0.4, 2.5)])
    direction = unit(random.normal(size=3) * [1.0, 1.0, 0.5])
    spread = np.pi
    size = 10.0 ** random.uniform(-0.8, 0.2, 2)
    if kind == "near":
        center[2] = random.uniform(0.0, 0.4)
    elif kind == "horizon":
        center[2], direction[2] = random.uniform(-0.3, 0.3), 0.2 * random.normal()
    elif kind in ("tiny", "tiny disk"):
        size = 10.0 ** random.uniform(-4.0, -1.5) * np.array([1.0, random.uniform(0.3, 1.0)])
    elif kind == "huge":
        size = 10.0 ** random.uniform(1.0, 3.0, 2)
    elif kind in ("spread", "narrow", "spread disk"):
        spread = random.uniform(0.5, 3.0) if kind != "narrow" else 10.0 ** random.uniform(-2.0, -0.5)
        direction = unit(np.array([*random.uniform(-1.0, 1.0, 2), 0.0]) - center)
    first = unit(np.cross(direction, random.normal(size=3)))
    half_u, half_v = rounded(size[0] * first), rounded(size[1] * np.cross(unit(direction), first))
    direction = unit(np.cross(half_u, half_v))
    if direction @ center > 0.0:
        direction = -direction
    shape = "POLYGON" if kind == "polygon" else "ELLIPSE" if "disk" in kind else "RECTANGLE"
    area = 4.0 * np.linalg.norm(half_u) * np.linalg.norm(half_v)
    kinds = {"RECTANGLE": QuadLight, "ELLIPSE": EllipseLight, "POLYGON": PolygonLight}
    return kinds[shape](
        name=f"{kind} {number}",
        center=rounded(center),
        half_u=half_u,
        half_v=half_v,
        direction=direction,
        radiance=rounded(random.uniform(0.5, 1.0, 3) / area),
        **({"corners": _star(random, rounded(center), half_u, half_v)} if shape == "POLYGON" else {}),
        spread=spread,
        receivers=tuple(random.choice(GROUPS, 2, replace=False)) if kind == "linked" else None,
        falloff={"linear": 1, "constant disk": 2}.get(kind, 0),
        smooth=0.5 if kind == "smooth" else 0.0,
    )


def _facing(kind, number, random):
    """A ball or disk that faces every point, half of them a spot aimed at the origin."""
    if kind == "sun":
        toward, half = unit(np.array([*random.uniform(-1.0, 1.0, 2), 0.5])), random.uniform(0.01, 0.5)
        first = np.sin(half) * unit(np.cross(toward, random.normal(size=3)))
        return SunLight(
            name=f"{kind} {number}",
            center=rounded(np.cos(half) * toward),
            half_u=rounded(first),
            half_v=rounded(np.cross(first, toward)),
            direction=-toward,
            radiance=rounded(random.uniform(0.5, 1.0, 3) / (np.pi * np.sin(half) ** 2)),
        )
    center, radius = (
        np.array([*random.uniform(-2.0, 2.0, 2), random.uniform(0.8, 2.5)]),
        10.0 ** random.uniform(-2.0, -0.2),
    )
    toward, light_class, cone = unit(center), PointLight, {}
    if "spot" in kind:
        u = unit(np.cross(toward, random.normal(size=3)))
        axes = np.stack([u, random.uniform(0.6, 1.6) * np.cross(toward, u), toward])
        cosine = np.cos(random.uniform(0.3, 1.2))
        light_class = SpotLight
        cone = {"cone": SpotCone(axes, cosine, 1.0 / (random.uniform(0.05, 1.0) * (1.0 - cosine)))}
    if kind == "bulb":
        radius = 1e-6
    return light_class(
        name=f"{kind} {number}",
        shape="FACING_DISK" if "disk" in kind else "BALL",
        center=rounded(center),
        half_u=rounded([radius, 0.0, 0.0]),
        half_v=rounded([0.0, radius, 0.0]),
        direction=-toward,
        radiance=rounded(random.uniform(0.5, 1.0, 3) / radius**2),
        **cone,
    )


def _star(random, center, half_u, half_v):
    """Four to eight corners around the center, not convex in general."""
    count = random.integers(4, 9)
    angle = 2.0 * np.pi / count * (np.arange(count) + random.uniform(0.0, 0.9, count))
    radius = random.uniform(0.3, 1.0, len(angle))
    return center + np.outer(radius * np.cos(angle), half_u) + np.outer(radius * np.sin(angle), half_v)
