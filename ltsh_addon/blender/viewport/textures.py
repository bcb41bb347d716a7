"""The inputs of shaders: samples, lights, tables and looks as textures and buffers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import gpu
import numpy as np

from ...cycles import closures, horizons
from ...cycles.lobes import LEAST_VELVET, LOBE_KINDS
from ...emitters import light_profile
from ...emitters.facing import LEAST_SHRINKING, NEAR_DISK
from ...emitters.light_polygons import ROUND_CORNERS, ROUND_LIMITS
from ...lobes import moments32
from ...lobes.lookup_table import LookupTable
from ...scene import Light, PolygonLight, SurfaceSamples
from ...shading.header import float_literal
from ..materials.looks import COAT, IMAGE_SLOTS, REFRACTION, Look
from ..materials.values import EXTENSIONS, Value

# Fields of `GBufferTextures` by their names in shaders.
SAMPLERS = {
    "positions": "position",
    "normals": "normal",
    "bases": "base",
    "f0s": "f0",
    "f90s": "f90",
    "dielectric_weights": "dielectric",
    "geometric_normals": "geometric_normal",
    "diffuse_normals": "diffuse_normal",
    "smooth_normals": "smooth_normal",
    "tangents": "tangent",
    "rebounds": "rebound",
}
# Fields of `ShareGrid` by their names in shaders.
SHARE_SAMPLERS = {"shares": "shares", "grid_positions": "positions"}


def read_texture(texture: gpu.types.GPUTexture) -> np.ndarray:
    """The values (H, W, 4) of a texture of floats, row 0 at the bottom."""
    buffer = texture.read()
    buffer.dimensions = texture.width * texture.height * 4
    return np.array(buffer, np.float32).reshape(texture.height, texture.width, 4)


@dataclass(frozen=True)
class ShareGrid:
    """The shares of lights that are seen at the points of a picture. Other pictures of the same surfaces may use it."""

    shares: gpu.types.GPUTexture  # RG, a layer for each light: the specular and the diffuse share
    positions: gpu.types.GPUTexture  # of the points, relative to the view's origin; w = 0 where there is no surface
    projection: np.ndarray  # (4, 4) to the clip space that the texels fill
    sources: tuple = ()  # of each layer: a layer whose source is the same object is the same


@dataclass(frozen=True)
class GBufferTextures:
    """The surface points of a picture as textures of one size, with the fields of `scene.SurfaceSamples`.

    RGBA32F, one texel per pixel, row 0 at the bottom. A texture may be None where its default holds everywhere.
    """

    position: gpu.types.GPUTexture  # in the world, m; w = 1 + receiver, 0 where there is no surface
    normal: gpu.types.GPUTexture  # shading normal of the specular lobe; w = roughness
    base: gpu.types.GPUTexture  # diffuse albedo; w = index of refraction of the dielectric lobe
    f0: gpu.types.GPUTexture  # specular_f0; w = red of specular_dip
    f90: gpu.types.GPUTexture  # specular_f90; w = green of specular_dip
    dielectric: gpu.types.GPUTexture  # weight of the dielectric lobe; w = blue of specular_dip
    geometric_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `normal`
    diffuse_normal: gpu.types.GPUTexture | None = None  # w = bump_alpha2; None: `normal`, bump_alpha2 0
    smooth_normal: gpu.types.GPUTexture | None = None  # w is not read; None: `diffuse_normal`
    tangent: gpu.types.GPUTexture | None = None  # of anisotropic lobes; w = anisotropy; None: 0
    rebound: gpu.types.GPUTexture | None = None  # diffuse_rebound; w = diffuse_roughness; None: 0
    shares: ShareGrid | None = None  # None: every light is seen whole
    mask: gpu.types.GPUTexture | None = None  # depth buffer, 0 where there is no surface; None: all pixels are lit
    has_sheen: bool = False  # there are texels of sheen: base.w = -sheen_a, normal.w = sheen_b
    has_velvet: bool = False  # there are texels of velvet: rebound.w = -sigma, rebound.rgb = albedo
    has_bent: bool = False  # there are dielectrics with an index of refraction between 0 and 1

    def __post_init__(self):
        if self.diffuse_normal is None and self.smooth_normal is not None:
            raise ValueError("G-buffer: smooth_normal without diffuse_normal, expected both")
        sizes = {
            field.name: (texture.width, texture.height)
            for field in fields(self)
            if not field.name.startswith("has_")
            and field.name != "shares"
            and (texture := getattr(self, field.name)) is not None
        }
        if len(set(sizes.values())) != 1:
            raise ValueError(f"G-buffer: textures have the sizes {sizes}, expected one size for all")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.position.width, self.position.height


def empty_texture(size: tuple[int, int]) -> gpu.types.GPUTexture:
    """RGBA32F texture of zeros; `size` is (width, height)."""
    texture = gpu.types.GPUTexture(size, format="RGBA32F")
    texture.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))
    return texture


def frame_buffer(color: gpu.types.GPUTexture, depth: gpu.types.GPUTexture | None = None) -> gpu.types.GPUFrameBuffer:
    """A frame buffer of the textures."""
    return gpu.types.GPUFrameBuffer(color_slots=[color], **({} if depth is None else {"depth_slot": depth}))


def float_texture(values: np.ndarray) -> gpu.types.GPUTexture:
    """RGBA32F texture of values (H, W, 4), or an array texture of values (N, H, W, 4)."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    height, width = values.shape[-3:-1]
    buffer = gpu.types.Buffer("FLOAT", values.size, values.reshape(-1))
    layers = values.shape[0] if values.ndim == 4 else 0
    return gpu.types.GPUTexture((width, height), layers=layers, format="RGBA32F", data=buffer)


def upload_samples(samples: SurfaceSamples, width: int, pixel: np.ndarray | None = None) -> GBufferTextures:
    """Textures, `width` texels wide, of `samples` (P) at the texels `pixel` (P,), counted from the lower left.

    Without `pixel` the samples are stored in order.
    """
    pixel = np.arange(len(samples)) if pixel is None else np.asarray(pixel)
    height = -(-(int(pixel.max(initial=0)) + 1) // width)

    def texture(vectors, scalars):
        values = np.zeros((height * width, 4), np.float32)
        values[pixel, :3] = vectors
        values[pixel, 3] = scalars
        return float_texture(values.reshape(height, width, 4))

    dip = samples.specular_dip
    bumped = (samples.smooth_normal != samples.diffuse_normal).any()
    turned = bumped or (samples.diffuse_normal != samples.normal).any()
    fuzzy, velvet = samples.sheen_a > 0.0, samples.sheen_a < 0.0
    return GBufferTextures(
        has_sheen=bool(fuzzy.any()),
        has_bent=bool(((samples.ior < 1.0) & samples.dielectric.any(axis=1)).any()),
        position=texture(samples.position, 1.0 + samples.receiver),
        normal=texture(samples.normal, np.where(fuzzy, samples.sheen_b, samples.roughness)),
        base=texture(samples.diffuse_albedo, np.where(fuzzy, -samples.sheen_a, samples.ior)),
        f0=texture(samples.specular_f0, dip[:, 0]),
        f90=texture(samples.specular_f90, dip[:, 1]),
        dielectric=texture(samples.dielectric, dip[:, 2]),
        geometric_normal=texture(samples.geometric_normal, 0.0)
        if (samples.geometric_normal != samples.normal).any()
        else None,
        diffuse_normal=texture(samples.diffuse_normal, samples.bump_alpha2) if turned else None,
        smooth_normal=texture(samples.smooth_normal, 0.0) if bumped else None,
        tangent=texture(samples.tangent, samples.anisotropy) if samples.anisotropy.any() else None,
        rebound=texture(
            np.where(velvet[:, None], _albedo_of_velvet(samples)[:, None], samples.diffuse_rebound),
            np.where(velvet, samples.sheen_a, samples.diffuse_roughness),
        )
        if velvet.any() or samples.diffuse_roughness.any()
        else None,
        has_velvet=bool(velvet.any()),
    )


def _albedo_of_velvet(samples) -> np.ndarray:
    cosine = (samples.diffuse_normal * samples.view).sum(axis=1)
    return closures.velvet_albedo(cosine, np.maximum(-samples.sheen_a, 0.0))


HEADER = 7  # texels of a light's header, see `light_texels`
WIDTH = 256  # texels of a row of the texture of lights
# Flags of a light.
DIFFUSE, SPECULAR, ROUND, DISTANT, FACING, BALL, CONE = 1, 2, 4, 8, 16, 32, 64
# UNEVEN: not equally bright all over. PROFILE: with a spread or a falloff. CAP: seen as a cap of the sphere.
# PLACED: with a pattern by the place on the light.
UNEVEN, PROFILE, CAP, PLACED = 128, 256, 512, 1024
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
_NODES = tuple(sorted({effort.layers for effort in light_profile.EFFORTS}))
_SHARED = [
    _QUAD,
    *(_circle(count) for count in _CIRCLES),
    *(np.stack(light_profile.gauss_legendre(count), axis=1) for count in _NODES),
]
_FIRST = np.concatenate([[0], np.cumsum([len(part) for part in _SHARED])])[:-1].tolist()
QUAD_FIRST, _CIRCLE_FIRST = _FIRST[0], _FIRST[1 : 1 + len(_CIRCLES)]
# Texel of the first node of a quadrature, by its number of nodes.
NODES_FIRST = dict(zip(_NODES, _FIRST[1 + len(_CIRCLES) :], strict=True))
FIRST_LIGHT = sum(len(part) for part in _SHARED)
# Texel of the first corner, number of corners, and the largest apparent width for which they are used.
ROUND_LEVELS = tuple(zip(_CIRCLE_FIRST, _CIRCLES, _SIZES, strict=True))


def constants() -> dict[str, int | str]:
    """The constants that GLSL needs to read the texture of lights, by name."""
    return {
        "LIGHT_HEADER": HEADER,
        "FIRST_LIGHT": FIRST_LIGHT,
        "LIGHT_WIDTH": WIDTH,
        "DIFFUSE_FLAG": DIFFUSE,
        "SPECULAR_FLAG": SPECULAR,
        "ROUND_FLAG": ROUND,
        "DISTANT_FLAG": DISTANT,
        "FACING_FLAG": FACING,
        "BALL_FLAG": BALL,
        "CONE_FLAG": CONE,
        "UNEVEN_FLAG": UNEVEN,
        "PROFILE_FLAG": PROFILE,
        "CAP_FLAG": CAP,
        "PLACED_FLAG": PLACED,
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
    place = FIRST_LIGHT + HEADER * len(lights)
    for light in lights:
        first, count, half_v, corners = _outline(light, place)
        receivers = np.zeros((0, 1)) if light.receivers is None else np.array(light.receivers, float)[:, None]
        headers.append(_header(light, first, count, half_v, place + len(corners)))
        pattern = _pattern_texels(light.pattern)
        headers[-1][6, 3] = place + len(corners) + len(receivers) if len(pattern) else 0.0
        for part in (corners, receivers, pattern):
            lists.append(np.pad(part, ((0, 0), (0, 4 - part.shape[1]))))
            place += len(part)
    shared = [np.pad(part, ((0, 0), (0, 2))) for part in _SHARED]
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


def _outline(light, place):
    """First texel and number of corners, half_v, and the light's own corners (V, 2).

    half_v has the sign with which corners run counterclockwise as seen from the lit side.
    """
    half_v = light.half_v
    if isinstance(light, PolygonLight):
        axes = np.stack([light.half_u, half_v], axis=1)
        corners = np.linalg.lstsq(axes, (light.polygon() - light.center).T, rcond=None)[0].T
        return place, len(corners), half_v, corners
    if np.dot(light.area_vector, light.direction) < 0.0:
        half_v = -half_v
    own = np.zeros((0, 2))
    if light.cone is not None:
        values = [[light.cone.cosine], [light.cone.sharpness], [0.0]]
        return place, 0, half_v, np.concatenate([light.cone.axes, values], axis=1)
    return (0, 0, half_v, own) if light.is_round else (QUAD_FIRST, 4, half_v, own)


def _header(light, first, count, half_v, first_receiver):
    flags = DIFFUSE * light.affects_diffuse + SPECULAR * light.affects_specular + ROUND * light.is_round
    flags += DISTANT * light.is_distant + FACING * light.is_facing + BALL * (light.is_facing and light.is_sphere)
    flags += CONE * (light.cone is not None) + UNEVEN * (light.is_facing and not light.is_uniform)
    flags += PROFILE * light.has_profile + CAP * _is_cap(light)
    flags += PLACED * (light.pattern is not None and light.is_sphere and not light.pattern.by_ray)
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
    padded = np.concatenate([np.pad(part, ((0, -len(part) % 4), (0, 0))) for part in parts])
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


def shares(loops: Sequence[int]) -> list[tuple[int, int]]:
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


# The layout of a look's uniform buffer in units of vec4: start and size of the slots, start of the terms of conductors,
# start of the layers (coat and others), whole size.
FIRST_SLOT, SLOT_SIZE = 3, 6
FIRST_TERM = FIRST_SLOT + SLOT_SIZE * len(IMAGE_SLOTS)
LAYERS = FIRST_TERM + 5
LOOK_SIZE = LAYERS + 5
# Numbers for the direction of tangents of anisotropic lobes, by `Brush.direction`; 0: not anisotropic.
DIRECTIONS = {"X": 1, "Y": 2, "Z": 3, "": 4}
VIEW_FACTORS = {"fresnel": 1, "facing": 2}
KINDS = {**LOBE_KINDS, COAT: max(LOBE_KINDS.values()) + 1, REFRACTION: max(LOBE_KINDS.values()) + 2}
DEFINES = {
    **{name.upper(): str(int(number)) for name, number in KINDS.items()},
    **{f"{name.upper()}_SLOT": str(position) for position, name in enumerate(IMAGE_SLOTS)},
    **{f"EXTENSION_{name}": str(position) for position, name in enumerate(EXTENSIONS)},
    "EXTENSIONS": str(len(EXTENSIONS)),
    "FIRST_SLOT": str(FIRST_SLOT),
    "SLOT_SIZE": str(SLOT_SIZE),
    "FIRST_TERM": str(FIRST_TERM),
    "LAYERS": str(LAYERS),
    "LEAST_VELVET": str(LEAST_VELVET),
    "MAX_F0": str(closures.MAX_F0),
    "AVERAGE_START": str(closures.DIELECTRIC_AVERAGE[0]),
    "AVERAGE_SLOPE": str(closures.DIELECTRIC_AVERAGE[1]),
    "ELEVATION_SHARE": str(horizons.ELEVATION_SHARE),
    "MINIMUM_REFLECTION_ELEVATION": str(horizons.MINIMUM_REFLECTION_ELEVATION),
}


def uniform_buffer(values: np.ndarray) -> gpu.types.GPUUniformBuf:
    """A uniform buffer of values (N, 4)."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    return gpu.types.GPUUniformBuf(gpu.types.Buffer("FLOAT", values.size, values.ravel()))


def look_values(look: Look) -> np.ndarray:
    """The uniform buffer (LOOK_SIZE, 4) of a look."""
    data = np.zeros((LOOK_SIZE, 4))
    flags = (look.normal is not None) + 2 * look.corrected
    data[0] = KINDS[look.kind], look.scattered, flags, look.normal_strength
    data[1] = *look.emission, look.through
    data[2] = *look.value("tint").offset, look.value("specular_level").offset[0]
    for position, name in enumerate(IMAGE_SLOTS):
        value = look.normal if name == "normal" else look.value(name)
        if value is not None:
            start = FIRST_SLOT + SLOT_SIZE * position
            data[start : start + SLOT_SIZE] = _slot_values(value)
    data[LAYERS, 0] = look.weight
    if look.view_factor is not None:
        factor = look.view_factor
        data[LAYERS + 2, :3] = VIEW_FACTORS[factor.kind], factor.parameter, factor.is_complement
    data[LAYERS + 2, 3] = look.glow
    if look.sheen is not None:
        data[LAYERS + 3, :2] = look.sheen
    data[LAYERS + 3, 2] = look.value("diffuse_roughness").offset[0] if look.is_rough else 0.0
    if look.brush is not None:
        brush = look.brush
        data[LAYERS + 4, :3] = brush.aspect, 2.0 * np.pi * brush.rotation, DIRECTIONS[brush.direction]
    if look.coat is not None:
        data[LAYERS, 1:] = look.coat.weight, look.coat.roughness, look.coat.ior
        data[LAYERS + 1] = *look.coat.tint, look.coat.follows_normal
    if look.kind.startswith("conductor"):
        exact = look.kind == "conductor"
        index, extinction = look.value("color").offset[None], np.maximum(look.value("tint").offset, 0.0)[None]
        data[FIRST_TERM : FIRST_TERM + 4, :3] = np.stack(closures.conductor_fit(index, extinction, exact))[:, 0]
        data[FIRST_TERM + 4, :3] = closures.conductor_average(index, extinction, exact)[0]
    return data


def _slot_values(value: Value) -> np.ndarray:
    rows = np.zeros((SLOT_SIZE, 4))
    rows[3, :3] = value.offset
    if value.image is not None:
        use = value.image
        rows[:3], rows[3, 3] = value.matrix, 1.0
        rows[4:6, :3] = use.mapping
        rows[4, 3] = use.closest
        encoding = is_encoded(use.image) * (1 + use.by_alpha)
        rows[5, 3] = EXTENSIONS.index(use.extension) + len(EXTENSIONS) * encoding
    return rows


def is_encoded(image) -> bool:
    """True for images that Cycles interpolates before it converts them to linear values."""
    return not image.is_float and image.colorspace_settings.name == "sRGB"


def float_table(values: np.ndarray) -> gpu.types.GPUTexture:
    """R32F texture of values (H, W), row 0 first."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    buffer = gpu.types.Buffer("FLOAT", values.size, values.ravel())
    return gpu.types.GPUTexture(values.shape[::-1], format="R32F", data=buffer)


def albedo_table() -> np.ndarray:
    """(33, 32): directional albedo of GGX by roughness and cosine; the last row is its average by roughness."""
    return np.vstack(closures.albedo_tables())


def sheen_table() -> np.ndarray:
    """(N, N, 4): albedo, a and b of sheen (see `closures.sheen_lobe`), albedo of velvet; rows by cosine, columns by
    roughness."""
    nodes = np.linspace(0.0, 1.0, closures.SHEEN_NODES)
    cosine, roughness = (axis.ravel() for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    found = np.concatenate([closures.sheen_lobe(cosine, roughness), closures.velvet_albedo(cosine, roughness)[None]])
    return found.T.reshape(len(nodes), len(nodes), 4)


def blend_table() -> np.ndarray:
    """(256, 16): the place of a dielectric's albedo between f0 and 1; rows by roughness and cosine.

    Columns are uniform in the fourth root of f0.
    """
    count = closures.GLASS_NODES
    nodes = np.linspace(0.0, 1.0, count)
    roughness, cosine, coordinate = (axis.ravel() for axis in np.meshgrid(nodes, nodes, nodes, indexing="ij"))
    f0 = np.minimum(coordinate**4, closures.MAX_F0)
    ior = (1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0))
    share = closures.dielectric_albedo(np.zeros((len(ior), 1)), ior, roughness, cosine)[:, 0]
    return share.reshape(count * count, count)
