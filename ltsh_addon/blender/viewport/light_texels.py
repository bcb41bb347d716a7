"""Lights, the sky and tables of lobes as textures.

Pictures of all directions are octahedral maps: an octahedron around the eye, unfolded onto a square. Its upper half is
the inner square, which is turned by 45 degrees.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import gpu
import numpy as np

from ...cycles.environment import CUBE, SkyPicture, sky_lights, summed
from ...emitters import light_profile
from ...emitters.facing import LEAST_SHRINKING, NEAR_DISK
from ...emitters.light_polygons import ROUND_CORNERS, ROUND_LIMITS
from ...lobes import moments32
from ...lobes.lookup_table import LookupTable
from ...scene import Light, PolygonLight, round_outline
from ...shading.header import float_literal
from .drawing import float_texture

HEADER = 7  # texels of a light's header, see `light_texels`
WIDTH = 1024  # texels of a row of the texture of lights
# Flags of a light, from the lowest bit on. UNEVEN: not equally bright all over. PROFILE: with a spread or a falloff.
# CAP: seen as a cap of the sphere. PLACED: with a pattern by the position on the light.
FLAGS = (
    *("DIFFUSE", "SPECULAR", "ROUND", "DISTANT", "FACING", "BALL", "CONE"),
    *("UNEVEN", "PROFILE", "CAP", "PLACED"),
)
_QUAD = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


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
    *(round_outline(count).T for count in _CIRCLES),
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
    """Texels (H, `WIDTH`, 4) of `lights` in float32. Lights must have an area.

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

    A pattern is three texels of its axes, with rows from pole to pole, width and `by_ray` as w, one of its number of
    rows, then its values, four per texel.

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
    rows, columns = pattern.values.shape
    traits = np.array([rows * np.pi / (np.pi - pattern.start), columns, pattern.by_ray])[:, None]
    values = np.pad(pattern.values.ravel(), (0, -pattern.values.size % 4)).reshape(-1, 4)
    return np.concatenate([np.concatenate([pattern.axes, traits], axis=1), [[rows, 0.0, 0.0, 0.0]], values])


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


def table_texels(table: LookupTable) -> np.ndarray:
    """Texels (N, R, T, 4) of a table in float32.

    The first layer is the warp. Then come the layers of each curve, with four weights per layer. An integral over a
    polygon is the product of these weights with `edge_integrals.moments`.
    """
    ridges = moments32.along_directions(table)
    rows, columns, parameters = table.warp.shape
    vectors = range(len(ridges.weights))
    channels = ridges.channels(vectors)
    parts = [channels[:parameters], *np.split(channels[parameters:], len(vectors))]
    padded = np.concatenate([np.pad(layers, ((0, -len(layers) % 4), (0, 0))) for layers in parts])
    return padded.reshape(-1, 4, rows, columns).transpose(0, 2, 3, 1)


def dielectric_texels(table: LookupTable) -> np.ndarray:
    """Texels (S, 2, 4) of the weights of the table's curves for dielectrics; row y: ior = 1 + y / `IOR_STEPS`.

    The first texel of a row has the weights of curves 0 to 3, the second those of curves 4 to 7, if there are any.
    """
    count = table.fresnel_weights.shape[1]
    if count > 8:
        raise ValueError(f"table {table.name} has {count} Fresnel curves, the graphics card's path takes up to 8")
    grid = 1.0 + np.arange(round((float(table.fresnel_ior[-1]) - 1.0) * IOR_STEPS) + 1) / IOR_STEPS
    texels = np.zeros((len(grid), 8), np.float32)
    texels[:, :count] = table.dielectric_weights(grid).T
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
    visible = tuple(light for light in lights if light.area_vector.any())
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


# Texels of a side of maps. SKY_SIZE, LEAST_SIZE: the largest and the smallest map of the light. IRRADIANCE_SIZE: the
# map of the irradiance. IRRADIANCE_SOURCE: the map of the light from which the irradiance is computed.
SKY_SIZE, LEAST_SIZE, IRRADIANCE_SIZE, IRRADIANCE_SOURCE = 256, 4, 32, 64
SKY_LEVELS = (SKY_SIZE // LEAST_SIZE).bit_length()
SKY_POINTS = 16  # directions in which a lobe samples the map
MOST_PATCHES = 1536  # of all sides together, for shadows
# CUBE_SIZE: pixels of a side of the cube's pictures, enough for the light. BACKGROUND_SIZE: of the largest background.
CUBE_SIZE, BACKGROUND_SIZE = 128, 2048


@dataclass(frozen=True)
class ShownSky:
    """A world as a view shows it."""

    sides: tuple[Light, ...] = ()  # of a cube around all points, for shadows; empty for a dark world
    lights: tuple[Light, ...] = ()  # the small bright lights in it
    # (N, N, 3) map of the light without these lights; N = 1: constant.
    light: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3)))
    background: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3)))  # (N, N, 3) map as cameras see it


def constant_sky(like: Light | None, radiance: np.ndarray, background: np.ndarray) -> ShownSky:
    """A world that is the same in all directions. `like` has the name and traits of its light; None: it is dark."""
    picture = np.array(radiance, np.float64).reshape(1, 1, 3)
    sides = [] if like is None else sky_lights(like, [SkyPicture(*axes, picture) for axes in CUBE])[0]
    shown = np.array(background, np.float64).reshape(1, 1, 3)
    return ShownSky(tuple(sides), (), picture if sides else np.zeros((1, 1, 3)), shown)


def varied_sky(like: Light | None, light, lights, background: np.ndarray) -> ShownSky:
    """A world from a cube of coarse pictures of its `light`, the small bright `lights` that these leave out, and the
    map `background` (N, N, 3)."""
    sides = () if like is None else tuple(sky_lights(like, light, MOST_PATCHES)[0])
    if not sides:
        return ShownSky(lights=tuple(lights), background=background)
    return ShownSky(sides, tuple(lights), unfolded(light, SKY_SIZE), background)


def coarse(picture: SkyPicture) -> SkyPicture:
    """The picture, reduced to at most `CUBE_SIZE` pixels along each side."""
    while len(picture.radiance) > CUBE_SIZE:
        weight = picture.solid_angles()[..., None]
        picture = replace(picture, radiance=summed(picture.radiance * weight) / summed(weight))
    return picture


def directions(size: int) -> np.ndarray:
    """Unit directions (N, N, 3) of the texels of a map with N = `size` texels along each side, row 0 at v = -1."""
    coordinate = (np.arange(size) + 0.5) * (2.0 / size) - 1.0
    u, v = np.meshgrid(coordinate, coordinate)
    height = 1.0 - np.abs(u) - np.abs(v)
    below = height < 0.0
    x = np.where(below, (1.0 - np.abs(v)) * np.where(u < 0.0, -1.0, 1.0), u)
    y = np.where(below, (1.0 - np.abs(u)) * np.where(v < 0.0, -1.0, 1.0), v)
    toward = np.stack([x, y, height], axis=-1)
    return toward / np.linalg.norm(toward, axis=-1, keepdims=True)


def solid_angles(size: int) -> np.ndarray:
    """Approximate solid angles (N, N) in sr of the texels of `directions`."""
    return (2.0 / size) ** 2 * np.abs(directions(size)).sum(axis=-1) ** 3


def unfolded(pictures: list[SkyPicture], size: int) -> np.ndarray:
    """The map (size, size, 3) interpolated from the six pictures of a cube."""
    toward = directions(size).reshape(-1, 3)
    radiance = np.zeros((len(toward), 3))
    side = np.argmax(np.stack([toward @ picture.ahead for picture in pictures]), axis=0)
    for number, picture in enumerate(pictures):
        texels = np.flatnonzero(side == number)
        along = toward[texels] @ picture.ahead
        count = len(picture.radiance)
        column, row = (
            np.clip(
                (sign * (toward[texels] @ axis) / (axis @ axis) / along + 1.0) * 0.5 * count - 0.5, 0.0, count - 1.0
            )
            for sign, axis in ((1.0, picture.right), (-1.0, picture.up))
        )
        radiance[texels] = _interpolated(picture.radiance, row, column)
    return radiance.reshape(size, size, 3)


def _interpolated(values: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    top, west = row.astype(int), column.astype(int)
    down, east = np.minimum(top + 1, len(values) - 1), np.minimum(west + 1, values.shape[1] - 1)
    y, x = (row - top)[:, None], (column - west)[:, None]
    above = (1.0 - x) * values[top, west] + x * values[top, east]
    below = (1.0 - x) * values[down, west] + x * values[down, east]
    return (1.0 - y) * above + y * below


def halved(picture: np.ndarray) -> np.ndarray:
    """Means over blocks of 2 x 2 texels, weighted by their solid angles."""
    weight = solid_angles(len(picture))[..., None]
    return summed(picture * weight) / summed(weight)


def mean_of(picture: np.ndarray) -> np.ndarray:
    """The mean (3,) of a map over all directions."""
    return np.average(picture.reshape(-1, 3), axis=0, weights=solid_angles(len(picture)).ravel())


def irradiance(picture: np.ndarray, size: int) -> np.ndarray:
    """Irradiance divided by pi, (size, size, 3), of surfaces whose normals are the directions of the texels."""
    toward, weight = directions(len(picture)).reshape(-1, 3), solid_angles(len(picture)).ravel()
    mean = mean_of(picture)
    cosines = np.maximum(directions(size).reshape(-1, 3) @ toward.T, 0.0)
    # Only differences from the mean are summed: a world that is the same everywhere then has no error.
    rest = (picture.reshape(-1, 3) - mean) * weight[:, None] / np.pi
    return np.maximum(mean + cosines @ rest, 0.0).reshape(size, size, 3)


def with_border(picture: np.ndarray) -> np.ndarray:
    """The map with one more texel on each side, from beyond the fold."""
    wide = np.concatenate([picture[:1, ::-1], picture, picture[-1:, ::-1]])
    return np.concatenate([wide[::-1, :1], wide, wide[::-1, -1:]], axis=1)


def sky_texels(sky: ShownSky) -> np.ndarray:
    """Texels (H, W, 4) of the light of `sky`.

    Texel 0 of the first row: mean radiance, w = 1 if the light is not constant. Texel 1: whether glossy lobes and
    diffuse lobes see the light. The next rows are maps with borders, absent for constant light: the largest with the
    smaller ones beside it, then the irradiance divided by pi.
    """
    traits = sky.sides[0]
    header = np.zeros((1, 2, 4))
    header[0, 1, :2] = traits.affects_specular, traits.affects_diffuse
    header[0, 0, :3] = mean_of(sky.light)
    if len(sky.light) == 1:
        return header
    header[0, 0, 3] = 1.0
    texels = np.zeros((SKY_SIZE + 3 + IRRADIANCE_SIZE + 2, SKY_SIZE + SKY_SIZE // 2 + 4, 4))
    texels[:1, :2] = header
    picture, row, sources = sky.light, 1, {}
    for level in range(SKY_LEVELS):
        sources[len(picture)] = picture
        wide = with_border(picture)
        column = 0 if level == 0 else SKY_SIZE + 2
        texels[row : row + len(wide), column : column + len(wide), :3] = wide
        row += len(wide) if level else 0
        picture = halved(picture)
    wide = with_border(irradiance(sources[IRRADIANCE_SOURCE], IRRADIANCE_SIZE))
    texels[SKY_SIZE + 3 : SKY_SIZE + 3 + len(wide), : len(wide), :3] = wide
    return texels


def background_texels(sky: ShownSky) -> np.ndarray:
    """Texels (N + 2, N + 2, 4) of the background, with a border."""
    wide = with_border(sky.background)
    return np.concatenate([wide, np.ones((*wide.shape[:2], 1))], axis=-1)
