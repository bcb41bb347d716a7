"""Lights and tables of lobes as textures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gpu
import numpy as np

from ...emitters import light_profile
from ...emitters.facing import LEAST_SHRINKING, NEAR_DISK
from ...emitters.light_polygons import ROUND_CORNERS, ROUND_LIMITS
from ...lobes import moments32
from ...lobes.lookup_table import LookupTable
from ...scene import Light, PolygonLight
from ...shading.header import float_literal
from .drawing import float_texture

HEADER = 7  # texels of a light's header, see `light_texels`
WIDTH = 256  # texels of a row of the texture of lights
# Flags of a light, from the lowest bit on. UNEVEN: not equally bright all over. PROFILE: with a spread or a falloff.
# CAP: seen as a cap of the sphere. PLACED: with a pattern by the position on the light.
FLAGS = (
    *("DIFFUSE", "SPECULAR", "ROUND", "DISTANT", "FACING", "BALL", "CONE"),
    *("UNEVEN", "PROFILE", "CAP", "PLACED"),
)
_QUAD = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def _circle(count):
    """Corners (count, 2) of a regular polygon with the area of the unit circle, as in `Light.polygon`."""
    step = 2.0 * np.pi / count
    angle = step * np.arange(count)
    return np.sqrt(step / np.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# _FEW_SIZES: the apparent width up to which round lights that no horizon cuts get 8 or 16 corners. Width is the squared
# half diagonal over distance after the warp, see integral.glsl. A polygon with the area of a circle has its second
# moments to 2e-3 with 8 corners, to 1.4e-4 with 16. Note that lobes make lights on their axis twice as large, and that
# the half diagonal is longer than the radius.
_FEW_SIZES = {8: 0.15, 16: 1.0}
_CIRCLES = (*_FEW_SIZES, *ROUND_CORNERS)
_SIZES = (*_FEW_SIZES.values(), *(0.25 * limit * limit for limit in ROUND_LIMITS), np.inf)
_NODES = tuple(sorted({effort.layers for effort in light_profile.DISK_LAYERS}))
_SHARED = [
    _QUAD,
    *(_circle(count) for count in _CIRCLES),
    *(np.stack(light_profile.gauss_legendre(count), axis=1) for count in _NODES),
]
_FIRST = np.concatenate([[0], np.cumsum([len(texels) for texels in _SHARED])])[:-1].tolist()
QUAD_FIRST, _CIRCLE_FIRST = _FIRST[0], _FIRST[1 : 1 + len(_CIRCLES)]
# Texel of the first node of a quadrature, by its number of nodes.
NODES_FIRST = dict(zip(_NODES, _FIRST[1 + len(_CIRCLES) :], strict=True))
FIRST_LIGHT = sum(len(texels) for texels in _SHARED)
# Texel of the first corner, number of corners, and the largest apparent width for which they are used.
ROUND_LEVELS = tuple(zip(_CIRCLE_FIRST, _CIRCLES, _SIZES, strict=True))


def constants() -> dict[str, int | str]:
    """The constants that GLSL needs to read the texture of lights, by name."""
    return {
        "LIGHT_HEADER": HEADER,
        "FIRST_LIGHT": FIRST_LIGHT,
        "LIGHT_WIDTH": WIDTH,
        **{f"{name}_FLAG": 1 << bit for bit, name in enumerate(FLAGS)},
        "NEAR_DISK": float_literal(NEAR_DISK),
        "LEAST_SHRINKING": float_literal(LEAST_SHRINKING),
    }


def circle_first(count: int) -> int:
    """Texel of the first of `count` corners of a circle."""
    return _CIRCLE_FIRST[_CIRCLES.index(count)]


def light_texels(lights: Iterable[Light]) -> np.ndarray:
    """Texels (H, `WIDTH`, 4) of `lights` in float32. Lights must have an area, see `visible_lights`.

    The order is: corners s, t that lights share; nodes and weights of quadratures over cones; `HEADER` texels per
    light; then the corners, receivers and pattern of each light. A corner is center + s * half_u + t * half_v. A light
    with a `SpotCone` has in place of corners the axes of the cone, with cosine, sharpness and 0 as w. Headers:

        0   center; texel of the first corner
        1   half_u; number of corners, 0: chosen per pixel from the circles
        2   half_v; flags
        3   direction; texel of the first receiver
        4   radiance; number of receivers, -1: all
        5   tan h and 1 / (tan h - h) of the spread, 0 without profile; largest half length; bound
        6   power of the falloff; its smoothing; area; first texel of the pattern, 0: there is none

    A pattern is three texels of its axes, with height, width and `by_ray` as w, then its values, four per texel.

    Bound: along any axis no corner is farther from the center than the bound times the sum of the extents of half_u
    and half_v.
    """
    lights = list(lights)
    headers, lists = [], []
    next_texel = FIRST_LIGHT + HEADER * len(lights)
    for light in lights:
        first, count, half_v, corners = _outline(light, next_texel)
        receivers = np.zeros((0, 1)) if light.receivers is None else np.array(light.receivers, float)[:, None]
        headers.append(_header(light, first, count, half_v, next_texel + len(corners)))
        pattern = _pattern_texels(light.pattern)
        headers[-1][6, 3] = next_texel + len(corners) + len(receivers) if len(pattern) else 0.0
        for rows in (corners, receivers, pattern):
            lists.append(np.pad(rows, ((0, 0), (0, 4 - rows.shape[1]))))
            next_texel += len(rows)
    shared = [np.pad(rows, ((0, 0), (0, 2))) for rows in _SHARED]
    texels = np.concatenate([*shared, *headers, *lists])
    rows = -(-len(texels) // WIDTH)
    return np.pad(texels, ((0, rows * WIDTH - len(texels)), (0, 0))).reshape(rows, WIDTH, 4).astype(np.float32)


def _pattern_texels(pattern) -> np.ndarray:
    if pattern is None:
        return np.zeros((0, 4))
    traits = np.array([*pattern.values.shape, pattern.by_ray])[:, None]
    values = np.pad(pattern.values.ravel(), (0, -pattern.values.size % 4)).reshape(-1, 4)
    return np.concatenate([np.concatenate([pattern.axes, traits], axis=1), values])


def visible_lights(lights: Iterable[Light]) -> list[Light]:
    """The lights that have an area."""
    return [light for light in lights if light.area_vector.any()]


def _outline(light, next_texel):
    """First texel and number of corners, half_v, and the light's own corners (V, 2).

    half_v has the sign with which corners run counterclockwise as seen from the lit side.
    """
    half_v = light.half_v
    if isinstance(light, PolygonLight):
        axes = np.stack([light.half_u, half_v], axis=1)
        corners = np.linalg.lstsq(axes, (light.polygon() - light.center).T, rcond=None)[0].T
        return next_texel, len(corners), half_v, corners
    if np.dot(light.area_vector, light.direction) < 0.0:
        half_v = -half_v
    none = np.zeros((0, 2))
    if light.cone is not None:
        values = [[light.cone.cosine], [light.cone.sharpness], [0.0]]
        return next_texel, 0, half_v, np.concatenate([light.cone.axes, values], axis=1)
    return (0, 0, half_v, none) if light.is_round else (QUAD_FIRST, 4, half_v, none)


def _header(light, first, count, half_v, first_receiver):
    is_ball = light.is_facing and light.is_sphere
    traits = {
        "DIFFUSE": light.affects_diffuse,
        "SPECULAR": light.affects_specular,
        "ROUND": light.is_round,
        "DISTANT": light.is_distant,
        "FACING": light.is_facing,
        "BALL": is_ball,
        "CONE": light.cone is not None,
        "UNEVEN": light.is_facing and not light.is_uniform,
        "PROFILE": light.has_profile,
        "CAP": _is_cap(light),
        "PLACED": is_ball and light.pattern is not None and not light.pattern.by_ray,
    }
    flags = sum(1 << bit for bit, name in enumerate(FLAGS) if traits[name])
    receivers = -1 if light.receivers is None else len(light.receivers)
    profile = light_profile.Profile.of(light)
    tangent, share = (profile.tangent, profile.share) if light.has_profile else (0.0, np.inf)
    reach = np.sqrt(max((light.half_u**2).sum(), (light.half_v**2).sum()))
    return np.array([
        [*light.center, first],
        [*light.half_u, count],
        [*half_v, flags],
        [*light.direction, first_receiver],
        [*light.radiance, receivers],
        [tangent, 1.0 / share, reach, _bound(light)],
        [light.falloff, light.smooth, np.linalg.norm(light.area_vector), 0.0],
    ])  # fmt: skip


def _is_cap(light) -> bool:
    """True for lights that are seen as a cap of the sphere: balls, facing disks, and suns."""
    if light.is_facing or not (light.is_round and light.is_distant):
        return light.is_facing
    axes = np.stack([light.half_u, light.half_v, light.center])
    products = axes @ axes.T
    whole = np.sqrt(np.outer(products.diagonal(), products.diagonal()))
    apart = np.abs(products - np.diag(products.diagonal())) > 1e-6 * whole
    return bool(not apart.any() and abs(products[0, 0] - products[1, 1]) <= 1e-6 * products[0, 0])


def _bound(light):
    if not isinstance(light, PolygonLight):
        return 1.01
    axes = np.stack([light.half_u, light.half_v], axis=1)
    return 1.01 * np.abs(np.linalg.lstsq(axes, (light.corners - light.center).T, rcond=None)[0]).max()


# IOR_STEPS: steps per unit of the index of refraction in the texture of the dielectrics' weights. They include the
# indices of the shipped tables.
IOR_STEPS = 200


def table_texels(table: LookupTable, iors: tuple[float, ...] = ()) -> np.ndarray:
    """Texels (N, R, T, 4) of a table in float32, with one more curve for every index of refraction of `iors`.

    The first layer is the warp. Then come the layers of each curve, with four weights per layer. An integral over a
    polygon is the product of these weights with `edge_integrals.moments`.
    """
    ridges = moments32.along_directions(table)
    rows, columns, parameters = table.warp.shape
    vectors = (*range(len(ridges.weights)), *(("dielectric", float(ior)) for ior in iors))
    channels = ridges.channels(vectors)
    parts = [channels[:parameters], *np.split(channels[parameters:], len(vectors))]
    padded = np.concatenate([np.pad(layers, ((0, -len(layers) % 4), (0, 0))) for layers in parts])
    return padded.reshape(-1, 4, rows, columns).transpose(0, 2, 3, 1)


def dielectric_texels(table: LookupTable, iors: tuple[float, ...] = ()) -> np.ndarray:
    """Texels (S, 2, 4) of the weights of the table's curves for dielectrics; row y: ior = 1 + y / `IOR_STEPS`.

    The first texel of a row has the weights of curves 0 to 3, the second those of curves 4 to 6, if there are any. The
    w of the second is 1 + n where ior is number n of `iors`, else 0.
    """
    count = table.fresnel_weights.shape[1]
    if count > 7:
        raise ValueError(f"table {table.name} has {count} Fresnel curves, the graphics card's path takes up to 7")
    grid = 1.0 + np.arange(round((float(table.fresnel_ior[-1]) - 1.0) * IOR_STEPS) + 1) / IOR_STEPS
    texels = np.zeros((len(grid), 8), np.float32)
    texels[:, :count] = table.dielectric_weights(grid).T
    for number, ior in enumerate(iors):
        nearest = round((ior - 1.0) * IOR_STEPS)
        if 0 <= nearest < len(grid) and abs(grid[nearest] - ior) < 1e-6:
            texels[nearest, 7] = 1.0 + number
    return texels.reshape(len(grid), 2, 4)


MOST_LOOPS, MOST_LIGHTS = 40000, 32  # limits of a draw call


@dataclass(frozen=True)
class UploadedLights:
    """Lights that have an area, their texture, and the texture of the world's light, if there is any."""

    lights: tuple[Light, ...]
    texture: gpu.types.GPUTexture
    sky: gpu.types.GPUTexture | None = None


def upload_lights(lights: Iterable[Light], sky: gpu.types.GPUTexture | None = None) -> UploadedLights:
    """`lights` on the card, beside the texture `sky`; needs an active GPU context."""
    visible = tuple(visible_lights(lights))
    return UploadedLights(visible, float_texture(light_texels(visible)), sky)


def draw_ranges(loops: Sequence[int]) -> list[tuple[int, int]]:
    """The lights (first, end) of each draw call; `loops` are the iterations of each light. At least one call.

    Calls are limited because llvmpipe aborts loops of a pixel after 65535 iterations, and long loops are bad for other
    cards, too.
    """
    starts, total = [0], 0
    for number, count in enumerate(loops):
        if number > starts[-1] and (total + count > MOST_LOOPS or number - starts[-1] == MOST_LIGHTS):
            starts.append(number)
            total = 0
        total += count
    return list(zip(starts, [*starts[1:], len(loops)], strict=True))
