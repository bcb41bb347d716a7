"""Lights with node trees or textures, as patches of constant radiance, patterns of directions, or their mean."""

from contextlib import contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...cycles.patches import Patches, cut_into_patches, note_patches, split_light
from ...cycles.texels import ImageTexture
from ...emitters.facing import cone_angle, pattern_values
from ...scene import Light, Pattern, SpotCone
from ..materials.values import ImageUse, Value, is_srgb, opaque_pixels
from .emission import PIXELS, Falloff, ObjectFacts, Studio, nodes_as_text, without_camera_rays, without_falloff

# MOST_INSTANCES: how many lights of one data block are rendered where they stand; others get the result of the first.
MOST_INSTANCES = 100


@dataclass(frozen=True)
class NodeLight:
    """A light whose node tree affects its radiance, which must be rendered to be known."""

    data: object  # the original light data block
    matrix: np.ndarray  # (4, 4) in the world
    varies: bool  # over the light's surface or by direction, as far as its nodes tell
    falloff: Falloff = Falloff()
    is_placed: bool = False  # it must be rendered where it stands
    # For points and spots:
    by_ray: bool = False  # its emission depends on the direction of the light; see `Pattern.by_ray`
    within: bool = False  # it must be rendered from its inside
    by_spot: bool = False  # it must be rendered as a spot
    is_mixed: bool = False  # its emission depends on the place on the light, too
    facts: ObjectFacts = ObjectFacts()
    instance: tuple = ()  # names the instance, whatever changes about it

    @property
    def flags(self) -> dict:
        """The fields that are True or False, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, bool)}

    @property
    def key(self) -> tuple:
        """A key that lights share if one render is enough for them: the data block, and the instance if `is_placed`."""
        return self.data.session_uid, *(self.instance if self.is_placed else ())

    @property
    def render_matrix(self) -> np.ndarray:
        """The matrix (4, 4) at which it is rendered."""
        return self.matrix if self.is_placed else np.eye(4)

    @property
    def axes(self) -> np.ndarray:
        """`Pattern.axes` (3, 3) for points and spots."""
        linear = self.matrix[:3, :3]
        return self.frame if self.is_placed else np.linalg.inv(linear / np.linalg.norm(linear, axis=0))

    @property
    def frame(self) -> np.ndarray:
        """The orthonormal axes, rows of (3, 3), of its map of directions where it is rendered."""
        axes, sizes = np.linalg.qr(self.render_matrix[:3, [2, 0, 1]])
        z, x = (axes[:, number] * np.copysign(1.0, sizes[number, number]) for number in (0, 1))
        return np.stack([x, np.cross(z, x), z])


def state_of(data, source: NodeLight, images: int = 0) -> tuple:
    """All that the emission of a light with nodes depends on; `images` counts the changes of images."""
    names = {"AREA": ("shape", "size", "size_y"), "SUN": ("angle",)}.get(data.type, ("use_soft_falloff",))
    if data.type in ("POINT", "SPOT") and (source.is_mixed or not source.by_ray):
        names = (*names, "shadow_soft_size")
    if source.by_spot or source.by_ray and data.type == "SPOT":
        names = (*names, "spot_size")
    where = (source.matrix.tobytes(), source.facts) if source.is_placed else ()
    text = nodes_as_text(data)
    images = images if "image: " in text else 0
    return data.type, *(getattr(data, name) for name in names), *source.flags.values(), where, text, images


def with_node_emission(lights: list[Light], unseen: dict[int, NodeLight], studio: Studio, warn) -> list:
    """`lights` with the rendered emission of those at the positions in `unseen`; dark ones of these are left out."""
    result, emissions = [], {}
    for position, light in enumerate(lights):
        if position not in unseen:
            result.append(light)
            continue
        source = unseen[position]
        of_data = emissions.setdefault(source.data.name_full, [])
        if not of_data or (source.is_placed and len(of_data) < MOST_INSTANCES):
            of_data.append(node_emission(source, studio))
            emission = of_data[-1]
        else:
            emission = of_data[0]
            if source.is_placed:
                warn(f"light {light.name!r}: of over {MOST_INSTANCES} instances the others get the nodes of the first")
        if not light.is_distant:
            light = replace(light, falloff=source.falloff.power, smooth=source.falloff.smooth)
        if light.is_facing or light.is_distant:
            result.extend(with_pattern(light, emission, source, warn))
        else:
            result.extend(_with_factor(light, emission.factor, warn))
    return result


@dataclass(frozen=True)
class NodeEmission:
    """The factor by which the node tree of a light multiplies its radiance."""

    # (H, W, 3), or (1, 1, 3) where it is constant and for suns. Area lights: columns run along half_u, row 0 is at
    # +half_v. Points and spots: rows and columns are directions, as in a `Pattern`.
    factor: np.ndarray
    # Relative error of the factor of emission that depends on both direction and place, or that varies over a sun.
    lost: float = 0.0
    # Of points and spots: the polar angle in rad where the rows begin, and the relative error by the size of steps.
    start: float = 0.0
    blurred: float = 0.0


def node_emission(source: NodeLight, studio: Studio) -> NodeEmission:
    """The factor of the nodes of a light, rendered by Cycles."""
    return {"AREA": _area_factor, "SUN": _sun_factor}.get(source.data.type, _point_factor)(source, studio)


def _area_factor(source: NodeLight, studio: Studio) -> NodeEmission:
    data, matrix = source.data, source.render_matrix
    size_v = data.size if data.shape in ("SQUARE", "DISK") else data.size_y
    half_u, half_v = 0.5 * data.size * matrix[:3, 0], 0.5 * size_v * matrix[:3, 1]
    direction = -matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    with _white_light(source, studio, {"spread": np.pi}):
        image, _ = studio.look(matrix[:3, 3], half_u, half_v, direction, PIXELS if source.varies else 8)
    if np.dot(np.cross(half_u, half_v), direction) < 0.0:
        image = image[::-1]
    return NodeEmission(image / (_WHITE["energy"] / np.pi))


# PATTERN_ROWS: rows of the map of directions of a point or spot light, if they suffice; else up to MOST_ROWS, in maps
# of up to MOST_TEXELS. VIEW_PIXELS: along each side of the six views that the map is made from, at least.
PATTERN_ROWS, MOST_ROWS, MOST_TEXELS, VIEW_PIXELS = 64, 2048, 1 << 19, 192
# RESOLVED: relative error of a map that needs no finer steps.
RESOLVED = 0.01
# The least radius of a point or spot light in a render. SMALL_RADIUS: in m. SMALL_SHARE: of its largest coordinate.
SMALL_RADIUS, SMALL_SHARE = 1e-3, 1e-4
# PATTERN_COLORS: relative error above which a pattern has a map for each color. MOST_LOST, MOST_BLURRED: errors of a
# `NodeEmission` above which there is a warning.
PATTERN_COLORS, MOST_LOST, MOST_BLURRED = 0.01, 0.05, 0.02
# SUN_PIXELS: along each side of the picture of a sun. LEAST_SUN, WIDEST_SUN: limits of the angle in rad of that sun.
SUN_PIXELS, LEAST_SUN, WIDEST_SUN = 32, 1e-3, 2.9


def _sun_factor(source: NodeLight, studio: Studio) -> NodeEmission:
    """The mean factor over the disk of a sun."""
    angle = min(max(source.data.angle, LEAST_SUN), WIDEST_SUN)
    toward = source.matrix[:3, 2] / np.linalg.norm(source.matrix[:3, 2])
    right = np.cross(toward, np.eye(3)[np.argmin(np.abs(toward))])
    axes = toward, right / np.linalg.norm(right)
    with _white_light(source, studio, {"angle": angle}):
        image = studio.look_around(np.zeros(3), axes, angle, 1.0, SUN_PIXELS)
    step = (np.arange(SUN_PIXELS) + 0.5) * (2.0 / SUN_PIXELS) - 1.0
    inside = image[np.hypot(*np.meshgrid(step, step)) < 1.0 - 2.0 / SUN_PIXELS] / _WHITE["energy"]
    mean = inside.mean(axis=0)
    return NodeEmission(mean.reshape(1, 1, 3), _apart(inside, mean))


def _apart(values: np.ndarray, expected: np.ndarray) -> float:
    """The mean absolute difference of two arrays, relative to the mean of `expected`."""
    return float(np.abs(values - expected).mean() / max(np.abs(expected).mean(), 1e-30))


def _point_factor(source: NodeLight, studio: Studio) -> NodeEmission:
    data, center = source.data, source.render_matrix[:3, 3]
    small = max(SMALL_RADIUS, SMALL_SHARE * np.abs(center).max())
    radius = max(data.shadow_soft_size, small)

    def views(within: bool, radius: float, pixels: int = VIEW_PIXELS, sides=range(6)) -> dict[int, np.ndarray]:
        """The factor (N, N, 3) on `sides` of a light of this `radius`, seen from outside or within, by their number."""
        kind = "SPOT" if data.type == "SPOT" and source.by_spot else "POINT"
        settings = {"shadow_soft_size": radius, "use_soft_falloff": False}
        with _white_light(source, studio, settings, kind):
            images = {number: _side(studio, source, number, (radius, within, pixels)) for number in sides}
        return {number: image / (_WHITE["energy"] / np.pi) for number, image in images.items()}

    within = source.within
    if not source.by_ray:
        return _resolved(source, lambda *sampling: views(False, radius, *sampling))
    sides = views(within, small)
    factor = _unfolded(sides, within, _map_directions(PATTERN_ROWS))
    if not source.varies:
        return NodeEmission(factor.mean(axis=(0, 1), keepdims=True))
    emission = _resolved(source, lambda *sampling: views(within, small, *sampling) if sampling else sides)
    if not source.is_mixed or radius == small:
        return emission
    if data.use_soft_falloff or source.by_spot:
        # Differences of opposite sign on opposite sides cancel in the mean over a disk.
        beside = _unfolded(views(within, radius), within, _map_directions(PATTERN_ROWS)) - factor
        across = np.roll(beside[::-1], PATTERN_ROWS, axis=1)
        return replace(emission, lost=_apart(factor + 0.5 * (beside + across), factor))
    # Points see a ball as a whole disk: scale the factor from the mean in the middle of that to the mean over it.
    step = (np.arange(VIEW_PIXELS) + 0.5) * (2.0 / VIEW_PIXELS) - 1.0
    disk = np.hypot(*np.meshgrid(step, step)) < 1.0 - 2.0 / VIEW_PIXELS
    whole = np.array([image[disk] for image in views(False, radius).values()])
    half = slice(VIEW_PIXELS // 2 - 1, VIEW_PIXELS // 2 + 1)
    middle = np.array([image[half, half].mean(axis=(0, 1)) for image in sides.values()])[:, None]
    scale = whole.mean() / max(middle.mean(), 1e-30)
    return replace(emission, factor=emission.factor * scale, lost=_apart(middle * scale, whole))


def _resolved(source: NodeLight, views) -> NodeEmission:
    """The map of directions, as fine as it must be; `views(pixels, sides)` are its pictures, the first without
    arguments. Fine maps of what a spot emits by the direction end at its cone."""
    within, sides, start = source.within, views(), 0.0
    if source.data.type == "SPOT" and source.by_ray:
        cone = SpotCone(np.linalg.inv(source.matrix[:3, :3]), np.cos(0.5 * source.data.spot_size), 1.0)
        start = np.pi - cone_angle(cone)
    emission = NodeEmission(_unfolded(sides, within, _map_directions(PATTERN_ROWS)))
    error = _blurred(emission, sides, within, (PATTERN_ROWS, start))
    if error <= RESOLVED:
        return emission
    rows = int(2.0 ** np.ceil(np.log2(min(PATTERN_ROWS * error / RESOLVED, MOST_ROWS))))
    while _map_directions(rows, start)[..., 0].size > MOST_TEXELS:
        rows //= 2
    normal = _map_directions(rows, start)
    sides = views(max(VIEW_PIXELS, rows * 5 // 4), np.unique(_sides_of(normal)).tolist())
    emission = NodeEmission(_unfolded(sides, within, normal), start=np.pi - len(normal) * (np.pi / rows))
    return replace(emission, blurred=_blurred(emission, sides, within, (rows, start)))


def _blurred(emission: NodeEmission, sides: dict, within: bool, steps: tuple[int, float]) -> float:
    """The relative error of a map by the size of its steps: from one of twice the rows, four times if these are few."""
    rows, start = steps
    normal = _map_directions(rows * (4 if rows == PATTERN_ROWS else 2), start)
    # Some of the many rows will do. What is beyond the cone does not count.
    normal = normal[1 if start else 0 :: 1 if rows == PATTERN_ROWS else 5]
    weights = np.hypot(normal[..., 0], normal[..., 1])
    pattern = Pattern(np.eye(3), emission.factor.mean(axis=-1), start=emission.start)
    coarse = pattern_values(pattern, np.moveaxis(normal, -1, 0))
    return _apart(coarse * weights, _unfolded(sides, within, normal).mean(axis=-1) * weights)


_AXES = np.eye(3)
_WHITE = {"color": (1.0, 1.0, 1.0), "energy": 100.0, "exposure": 0.0, "normalize": False, "use_temperature": False}


@contextmanager
def _white_light(source: NodeLight, studio: Studio, settings: dict, kind: str = ""):
    """Within this context a white copy of the light stands at its place, without falloff and with these `settings`.

    A `kind` replaces the type of the light.
    """
    data = source.data.copy()
    try:
        if kind and kind != data.type:
            name, data.type = data.name, kind
            # Each type of light is a class of its own in Python: fetch the data block again.
            data = bpy.data.lights[name]
        data.animation_data_clear()
        if data.type == "SPOT":
            settings = {**settings, "spot_blend": 0.0}
        for key, value in {**_WHITE, **settings}.items():
            setattr(data, key, value)
        ob = bpy.data.objects.new("Look at a light", data)
        ob.visible_camera = True
        with without_falloff([data]), without_camera_rays([data], source.facts.random):
            with studio.show(ob, source.render_matrix, source.facts):
                yield
    finally:
        bpy.data.lights.remove(data)


def _side_axes(number: int) -> tuple[np.ndarray, np.ndarray]:
    """The outward axis of side `number` of a cube, and the axis to its right."""
    return _AXES[number // 2] * (-1.0) ** number, _AXES[(number // 2 + 1) % 3]


def _side(studio: Studio, source: NodeLight, number: int, look: tuple[float, bool, int]) -> np.ndarray:
    """A picture (N, N, 3) of side `number` of a ball from outside; within: of the opposite side from the inside.

    `look` are its radius, whether it is seen from within, and N.
    """
    radius, within, pixels = look
    center, (out, right) = source.render_matrix[:3, 3], (axis @ source.frame for axis in _side_axes(number))
    if not within:
        return studio.look(center, radius * right, radius * np.cross(out, right), out, pixels, 1.0)[0]
    # Rays from the exact center of a spot do not hit it.
    eye = center + 0.004 * radius * out
    return studio.look_around(eye, (-out, right), 0.5 * np.pi, 2.0 * radius, pixels)


def _map_directions(rows: int, start: float = 0.0) -> np.ndarray:
    """Unit vectors (H, W, 3) of a map of directions with `rows` from pole to pole: its rows from the polar angle
    `start` on, with as many columns as the longest of them needs."""
    step = np.pi / rows
    first = int(start / step)
    polar = (np.arange(first, rows) + 0.5)[:, None] * step
    columns = 2 * rows if first < rows // 2 else max(4, int(np.ceil(2 * rows * np.sin(first * step))))
    around = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    return np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0.0 * around], -1)


def _sides_of(normal: np.ndarray) -> np.ndarray:
    """The numbers (...) of the sides of a cube that directions (..., 3) from its center meet."""
    axis = np.abs(normal).argmax(axis=-1)
    return 2 * axis + (np.take_along_axis(normal, axis[..., None], -1)[..., 0] < 0.0)


def _unfolded(views: dict[int, np.ndarray], within: bool, normal: np.ndarray) -> np.ndarray:
    """The map (H, W, 3) for directions `normal`, made from pictures of sides; `within`: taken from the inside."""
    result, side = np.zeros(normal.shape), _sides_of(normal)
    for number, image in views.items():
        out, right = _side_axes(number)
        chosen = normal[side == number]
        # From within, light that leaves along the normal is seen by a ray in the opposite direction.
        up, depth = (np.cross(right, -out), -(chosen @ out)) if within else (np.cross(out, right), 1.0)
        row, column = (
            np.clip((chosen @ axis / depth + 1.0) * 0.5 * len(image), 0, len(image) - 1).astype(int)
            for axis in (-up, right)
        )
        result[side == number] = image[row, column]
    return result


def with_pattern(light: Light, emission: NodeEmission, source: NodeLight, warn) -> list[Light]:
    """A point, spot or sun times the factor of its nodes: one light, one for each color, or [] if it is dark."""
    factor, step = emission.factor, (np.pi - emission.start) / len(emission.factor)
    weights = np.sin(emission.start + (np.arange(len(factor)) + 0.5) * step)[:, None, None]
    mean = (factor * weights).sum(axis=(0, 1)) / (weights.sum() * factor.shape[1])
    if not mean.any():
        return []
    light = replace(light, radiance=light.radiance * mean)
    if emission.lost > MOST_LOST:
        what = "over the sun, shaded as its mean" if light.is_distant else "over the light, shaded as in its middle"
        warn(f"light {light.name!r}: its emission varies {what}, up to {100.0 * emission.lost:.0f} % off on average")
    if len(factor) == 1:
        return [light]
    if emission.blurred > MOST_BLURRED:
        warn(
            f"light {light.name!r}: its pattern is shaded in steps of {np.degrees(step):.2g} degrees, "
            f"{100.0 * emission.blurred:.0f} % off on average"
        )
    colors = [(np.ones(3), factor.mean(axis=-1) / mean.mean())]
    if _apart(colors[0][1][..., None] * mean, factor) > PATTERN_COLORS:
        colors = [(np.eye(3)[n], factor[..., n] / mean[n]) for n in range(3) if mean[n] and light.radiance[n]]
    patterns = [(color, Pattern(source.axes, values, source.by_ray, emission.start)) for color, values in colors]
    return [replace(light, radiance=light.radiance * color, pattern=pattern) for color, pattern in patterns]


def _covered(light: Light, rows: int, columns: int) -> np.ndarray:
    """The mask (rows, columns) of pixels on the light; pixels on the edge of a round one are left out, being partly
    dark."""
    if not light.is_round:
        return np.ones((rows, columns), bool)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return np.hypot(2.0 * x - 1.0, 2.0 * y - 1.0) < 1.0 - 1.5 / min(rows, columns)


def _with_factor(light: Light, factor: np.ndarray, warn) -> list[Light]:
    patches = cut_into_patches(factor * light.radiance, _covered(light, *factor.shape[:2]))
    note_patches(f"light {light.name!r}: its texture", len(patches.smallest), patches.error, warn)
    return split_light(light, patches)


# MOST_PATCHES: of one light in the viewport, where each patch costs as much as a light. PATCHES_OF_OBJECT: of one that
# shines by an image, which often does so on both sides.
MOST_PATCHES, PATCHES_OF_OBJECT = 64, 16
# POINTS: along each side of the grid on which an image is read. SUB: each point is the mean of SUB x SUB.
POINTS, SUB = 128, 2


# MOST_CACHED: how many lights with nodes have their patches kept.
MOST_CACHED = 256


class ShownTextures:
    """A cache of the patches of lights with images or nodes, which holds as long as these do not change."""

    def __init__(self):
        self._patches: dict[tuple, Patches | None] = {}
        self._seen: dict[tuple, tuple[NodeEmission, Patches]] = {}
        self._textures: dict[tuple, ImageTexture | None] = {}  # only of `color_at`: patches need their image once

    def clear(self) -> None:
        """Forget the patches of images, so that the images are read again."""
        self._patches.clear()
        self._textures.clear()

    def color_at(self, use: ImageUse, uv: np.ndarray) -> np.ndarray | None:
        """Linear colors (P, 3) of an image at coordinates (P, 2) of its UV map; None where only Cycles knows them."""
        key = use.image.session_uid, use.closest, use.extension
        if key not in self._textures:
            self._textures[key] = _texture(use)
        texture = self._textures[key]
        if texture is None:
            return None
        return texture.colors(np.append(uv, np.ones((len(uv), 1)), axis=-1) @ np.array(use.mapping).T)

    def split(self, light: Light, factor: Value, notes: list[str]) -> list[Light] | None:
        """`light` times the image `factor` as patches; None where only Cycles knows the colors of the image.

        Coarse patches are reported in `notes`.
        """
        patches = self._patches_of(light.is_round, factor, lambda: _uv_of_light(light.is_round))
        return None if patches is None else _shown_patches(light, patches, notes)

    def split_polygon(self, light: Light, factor: Value, triangles, uv, share: float, notes) -> list[Light] | None:
        """As `split`, for a polygon that `triangles` (T, 3, 3) with UV coordinates `uv` (T, 3, 2) cover; it gets this
        `share` of PATCHES_OF_OBJECT."""
        axes = np.stack([half / np.dot(half, half) for half in (light.half_u, light.half_v)])
        places = np.round((triangles - light.center) @ axes.T, 4)
        shape, most = (places.tobytes(), uv.tobytes(), share), max(round(share * PATCHES_OF_OBJECT), 1)
        patches = self._patches_of(shape, factor, lambda: (*_uv_within(places, uv), most))
        return None if patches is None else _shown_patches(light, patches, notes)

    def split_by_nodes(self, light: Light, emission: NodeEmission, notes: list[str]) -> list[Light]:
        """As `split`, for the factor of the nodes of the light."""
        key = id(emission), light.is_round
        if key not in self._seen:
            if len(self._seen) >= MOST_CACHED:
                self._seen.clear()
            rows, columns = emission.factor.shape[:2]
            patches = cut_into_patches(emission.factor, _covered(light, rows, columns), MOST_PATCHES)
            # `emission` is kept alive, so that no other object gets its id().
            self._seen[key] = emission, patches
        return _shown_patches(light, self._seen[key][1], notes)

    def mean(self, factor: Value) -> tuple[np.ndarray, float]:
        """The mean color (3,) of an image on all of its UV square, and the mean difference from it as a share of it; 0
        where only Cycles knows its colors."""
        patches = self._patches_of(False, factor, lambda: _uv_of_light(False))
        return (
            (np.zeros(3), 0.0) if patches is None or patches.whole is None else (patches.whole.radiance, patches.spread)
        )

    def _patches_of(self, shape, factor: Value, uv_of) -> Patches | None:
        """The patches of an image on a light of the `shape`, for which `uv_of()` gives what `_cut` takes."""
        use = factor.image
        key = (use.image.session_uid, use.mapping, use.closest, use.extension, shape,
               factor.matrix.tobytes(), factor.offset.tobytes())  # fmt: skip
        if key not in self._patches:
            if len(self._patches) >= MOST_CACHED:
                self._patches.clear()
            texture = _texture(use)
            self._patches[key] = None if texture is None else _cut(texture, factor, *uv_of())
        return self._patches[key]


def _shown_patches(light: Light, patches: Patches, notes: list[str]) -> list[Light]:
    note_patches(f"{light.name}: its texture", len(patches.smallest), patches.error, notes.append)
    shown = (patch for whole in split_light(light, patches) for patch in whole.leaves)
    return [replace(patch, radiance=patch.radiance * light.radiance) for patch in shown]


def _texture(use) -> ImageTexture | None:
    """The pixels of an image, as in Cycles one of pink where it is missing; None where only Cycles knows its colors."""
    image = use.image.original
    srgb = is_srgb(image) if all(image.size) else False
    pixels = np.array([[[1.0, 0.0, 1.0]]]) if not all(image.size) else None if srgb is None else opaque_pixels(image)
    if pixels is None:
        return None
    return ImageTexture(pixels, use.extension, "Closest" if use.closest else "Linear", srgb)


def _cut(texture, factor: Value, uv: np.ndarray, covered: np.ndarray, most: int = MOST_PATCHES) -> Patches:
    """The patches of an image at points `uv` (N, N, 2) of a light, row 0 on top, of which those `covered` (N, N) count;
    SUB x SUB of them are one of POINTS x POINTS."""
    count = len(uv)
    mapped = np.append(uv.reshape(-1, 2), np.ones((count * count, 1)), axis=1) @ np.array(factor.image.mapping).T
    colors = factor.offset + texture.colors(mapped) @ factor.matrix[:, :3].T + factor.matrix[:, 3]
    share = covered.reshape(POINTS, SUB, POINTS, SUB, 1).mean(axis=(1, 3))
    image = (covered.reshape(-1, 1) * colors).reshape(POINTS, SUB, POINTS, SUB, 3).mean(axis=(1, 3))
    return cut_into_patches(image / np.maximum(share, 1e-9), share[..., 0] >= 0.5, most)


def _points() -> np.ndarray:
    """The points (N, N, 2) of a light at which its image is read, in units of half_u and half_v, row 0 on top."""
    step = 2.0 * (np.arange(POINTS * SUB) + 0.5) / (POINTS * SUB) - 1.0
    return np.stack(np.meshgrid(step, -step), axis=-1)


def _uv_of_light(is_round: bool) -> tuple[np.ndarray, np.ndarray]:
    """UV coordinates (N, N, 2) of an area light at `_points`, and which of them are inside (N, N)."""
    points = _points()
    return 0.5 + 0.5 * points, (np.hypot(*np.moveaxis(points, -1, 0)) < 1.0) | (not is_round)


def _uv_within(places: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `_uv_of_light`, within triangles with corners at `places` (T, 3, 2)."""
    points = _points()
    found, covered = np.zeros_like(points), np.zeros(points.shape[:2], bool)
    for corners, of_corners in zip(places, uv, strict=True):
        edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)
        if abs(np.linalg.det(edges)) > 1e-9:
            weights = (points - corners[0]) @ np.linalg.inv(edges).T
            inside = (weights >= 0.0).all(axis=-1) & (weights.sum(axis=-1) <= 1.0)
            found[inside] = of_corners[0] + weights[inside] @ (of_corners[1:] - of_corners[0])
            covered |= inside
    return found, covered
