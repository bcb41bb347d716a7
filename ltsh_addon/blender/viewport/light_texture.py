"""Area lights as one texture of RGBA32F texels, for any number of lights of any shape.

A corner of a light is center + s * half_u + t * half_v. First come lists of corners s, t that lights share, nodes and
weights of quadratures over cones, then `HEADER` texels per light, then corners and receivers of single lights. Headers:

    0   center; texel of the first corner
    1   half_u; number of corners, 0: chosen per pixel from the circles
    2   half_v; flags
    3   direction; texel of the first receiver
    4   radiance; number of receivers, -1: all
    5   tan h and 1 / (tan h - h) of the spread, 0 without one; largest half length; bound

No corner is farther from the center along any axis than the bound times the sum of those of half_u and half_v.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...scene import AreaLight
from ...shading import light_cone
from ...shading.light_polygons import ROUND_CORNERS, ROUND_LIMITS

HEADER = 6
WIDTH = 256
DIFFUSE, SPECULAR, ROUND = 1, 2, 4
_QUAD = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def _circle(count):
    """Corners (count, 2) of a regular polygon with the area of the unit circle, as in `AreaLight.polygon`."""
    step = 2.0 * np.pi / count
    angle = step * np.arange(count)
    return np.sqrt(step / np.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# A polygon of the area of a circle has its second moments to 2e-3 with 8 corners, to 1.4e-4 with 16. Lobes that do not
# see more than these, of lights that no horizon cuts, are as exact as with those of `light_polygons`: within 3e-5.
_FEW_CORNERS, _FEW_LIMITS = (8, 16), (0.3, 1.5)
_CIRCLES = (*_FEW_CORNERS, *ROUND_CORNERS)
_NODES = tuple(sorted({effort.layers for effort in light_cone.EFFORTS}))
_SHARED = [
    _QUAD,
    *(_circle(count) for count in _CIRCLES),
    *(np.stack(light_cone.gauss_legendre(count), axis=1) for count in _NODES),
]
_FIRST = np.concatenate([[0], np.cumsum([len(part) for part in _SHARED])])[:-1].tolist()
QUAD_FIRST, _CIRCLE_FIRST = _FIRST[0], _FIRST[1 : 1 + len(_CIRCLES)]
# Texel of the first node by the number of nodes.
NODES_FIRST = dict(zip(_NODES, _FIRST[1 + len(_CIRCLES) :], strict=True))
FIRST_LIGHT = sum(len(part) for part in _SHARED)
# Texel of the first corner, number of corners, and up to which reach in units of the lobe's width they are taken.
ROUND_LEVELS = tuple(zip(_CIRCLE_FIRST, _CIRCLES, (*_FEW_LIMITS, *ROUND_LIMITS, np.inf), strict=True))


def constants() -> dict[str, int]:
    """What GLSL that reads the texture needs to know, by name."""
    return {
        "LIGHT_HEADER": HEADER,
        "FIRST_LIGHT": FIRST_LIGHT,
        "LIGHT_WIDTH": WIDTH,
        "DIFFUSE_FLAG": DIFFUSE,
        "SPECULAR_FLAG": SPECULAR,
        "ROUND_FLAG": ROUND,
    }


def circle_first(count: int) -> int:
    """Texel of the first of `count` corners of a circle."""
    return _CIRCLE_FIRST[_CIRCLES.index(count)]


def light_texels(lights: Iterable[AreaLight]) -> np.ndarray:
    """Texels (H, `WIDTH`, 4) of `lights` in float32; lights without area have no part of it: see `visible_lights`."""
    lights = list(lights)
    headers, lists = [], []
    place = FIRST_LIGHT + HEADER * len(lights)
    for light in lights:
        first, count, half_v, corners = _outline(light, place)
        receivers = np.zeros((0, 1)) if light.receivers is None else np.array(light.receivers, float)[:, None]
        headers.append(_header(light, first, count, half_v, place + len(corners)))
        for part in (corners, receivers):
            lists.append(np.pad(part, ((0, 0), (0, 4 - part.shape[1]))))
            place += len(part)
    shared = [np.pad(part, ((0, 0), (0, 2))) for part in _SHARED]
    texels = np.concatenate([*shared, *headers, *lists])
    rows = -(-len(texels) // WIDTH)
    return np.pad(texels, ((0, rows * WIDTH - len(texels)), (0, 0))).reshape(rows, WIDTH, 4).astype(np.float32)


def visible_lights(lights: Iterable[AreaLight]) -> list[AreaLight]:
    """Those lights that have an area."""
    return [light for light in lights if light.area_vector.any()]


def _outline(light, place):
    """First texel and number of corners, half_v so that corners run counterclockwise as seen from the lit side, and
    the light's own corners (V, 2)."""
    half_v = light.half_v
    if light.shape == "POLYGON":
        axes = np.stack([light.half_u, half_v], axis=1)
        corners = np.linalg.lstsq(axes, (light.polygon() - light.center).T, rcond=None)[0].T
        return place, len(corners), half_v, corners
    if np.dot(light.area_vector, light.direction) < 0.0:
        half_v = -half_v
    own = np.zeros((0, 2))
    return (0, 0, half_v, own) if light.is_round else (QUAD_FIRST, 4, half_v, own)


def _header(light, first, count, half_v, first_receiver):
    flags = DIFFUSE * light.affects_diffuse + SPECULAR * light.affects_specular + ROUND * light.is_round
    receivers = -1 if light.receivers is None else len(light.receivers)
    tangent, share = light_cone.cone(light.spread) if light.is_focused else (0.0, np.inf)
    reach = np.sqrt(max((light.half_u**2).sum(), (light.half_v**2).sum()))
    return np.array([
        [*light.center, first],
        [*light.half_u, count],
        [*half_v, flags],
        [*light.direction, first_receiver],
        [*light.radiance, receivers],
        [tangent, 1.0 / share, reach, _bound(light)],
    ])  # fmt: skip


def _bound(light):
    if light.shape != "POLYGON":
        return 1.01
    axes = np.stack([light.half_u, light.half_v], axis=1)
    return 1.01 * np.abs(np.linalg.lstsq(axes, (light.corners - light.center).T, rcond=None)[0]).max()
