"""Lights with node trees or textures, as patches of constant radiance, patterns of directions, or their mean."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...cycles.patches import ERROR, Patches, cut_into_patches, split_light
from ...cycles.texels import ImageTexture
from ...scene import Light, Pattern
from ..materials.values import Value, is_srgb, opaque_pixels
from .emission import PIXELS, Falloff, ObjectFacts, Studio, without_camera_rays, without_falloff

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
        return np.eye(3) if self.is_placed else np.linalg.inv(linear / np.linalg.norm(linear, axis=0))


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


# PATTERN_ROWS: rows of the map of directions of a point or spot light. VIEW_PIXELS: along each side of the six views
# that the map is made from.
PATTERN_ROWS, VIEW_PIXELS = 64, 192
# The least radius of a point or spot light in a render. SMALL_RADIUS: in m. SMALL_SHARE: of its largest coordinate.
SMALL_RADIUS, SMALL_SHARE = 1e-3, 1e-4
# Relative errors above which there is a warning. PATTERN_COLORS: where a pattern has one color for all directions.
# MOST_LOST: of `NodeEmission.lost`.
PATTERN_COLORS = MOST_LOST = 0.05
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

    def views(within: bool, radius: float) -> list[np.ndarray]:
        """The factor (N, N, 3) on each of the six sides of a light of this `radius`, seen from outside or within."""
        kind = "SPOT" if data.type == "SPOT" and source.by_spot else "POINT"
        settings = {"shadow_soft_size": radius, "use_soft_falloff": False}
        with _white_light(source, studio, settings, kind):
            images = [_side(studio, center, number, radius, within) for number in range(6)]
        return [image / (_WHITE["energy"] / np.pi) for image in images]

    within = source.within
    if not source.by_ray:
        return NodeEmission(_unfolded(views(False, radius), False))
    sides = views(within, small)
    factor = _unfolded(sides, within)
    if not source.varies:
        return NodeEmission(factor.mean(axis=(0, 1), keepdims=True))
    if not source.is_mixed or radius == small:
        return NodeEmission(factor)
    if data.use_soft_falloff or source.by_spot:
        # Differences of opposite sign on opposite sides cancel in the mean over a disk.
        beside = _unfolded(views(within, radius), within) - factor
        across = np.roll(beside[::-1], PATTERN_ROWS, axis=1)
        return NodeEmission(factor, _apart(factor + 0.5 * (beside + across), factor))
    # Points see a ball as a whole disk: scale the factor from the mean in the middle of that to the mean over it.
    step = (np.arange(VIEW_PIXELS) + 0.5) * (2.0 / VIEW_PIXELS) - 1.0
    disk = np.hypot(*np.meshgrid(step, step)) < 1.0 - 2.0 / VIEW_PIXELS
    whole = np.array([image[disk] for image in views(False, radius)])
    half = VIEW_PIXELS // 2
    middle = np.array([image[half - 1 : half + 1, half - 1 : half + 1].mean(axis=(0, 1)) for image in sides])[:, None]
    scale = whole.mean() / max(middle.mean(), 1e-30)
    return NodeEmission(factor * scale, _apart(middle * scale, whole))


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


def _side(studio: Studio, center, number: int, radius: float, within: bool) -> np.ndarray:
    """A picture (N, N, 3) of side `number` of a ball from outside; `within`: of the opposite side from the inside."""
    out, right = _side_axes(number)
    if not within:
        return studio.look(center, radius * right, radius * np.cross(out, right), out, VIEW_PIXELS, 1.0)[0]
    # Rays from the exact center of a spot do not hit it.
    eye = center + 0.02 * radius * out
    return studio.look_around(eye, (-out, right), 0.5 * np.pi, 2.0 * radius, VIEW_PIXELS)


def _unfolded(views: list[np.ndarray], within: bool) -> np.ndarray:
    """The map (H, W, 3) of directions, made from pictures of the six sides; `within`: taken from the inside."""
    rows, columns = PATTERN_ROWS, 2 * PATTERN_ROWS
    polar = (np.arange(rows) + 0.5)[:, None] * (np.pi / rows)
    around = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    x, y, z = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0.0 * around
    normal = np.stack([x, y, z], axis=-1)
    result, highest = np.zeros((rows, columns, 3)), np.full((rows, columns), -1.0)
    for number, image in enumerate(views):
        out, right = _side_axes(number)
        facing = normal @ out
        better = facing > highest
        # From within, light that leaves along the normal is seen by a ray in the opposite direction.
        up, depth = (np.cross(right, -out), -facing) if within else (np.cross(out, right), np.ones_like(facing))
        depth = np.where(better & (depth != 0.0), depth, 1.0)
        row, column = (
            np.clip((normal @ axis / depth + 1.0) * 0.5 * VIEW_PIXELS, 0, VIEW_PIXELS - 1).astype(int)
            for axis in (-up, right)
        )
        result[better], highest[better] = image[row, column][better], facing[better]
    return result


def with_pattern(light: Light, emission: NodeEmission, source: NodeLight, warn) -> list[Light]:
    """A point, spot or sun times the factor of its nodes: one light, or [] if it is dark."""
    factor = emission.factor
    weights = np.sin((np.arange(factor.shape[0]) + 0.5) * (np.pi / factor.shape[0]))[:, None, None]
    mean = (factor * weights).sum(axis=(0, 1)) / (weights.sum() * factor.shape[1])
    if not mean.any():
        return []
    light = replace(light, radiance=light.radiance * mean)
    if emission.lost > MOST_LOST:
        what = "over the sun, shaded as its mean" if light.is_distant else "over the light, shaded as in its middle"
        warn(f"light {light.name!r}: its emission varies {what}, up to {100.0 * emission.lost:.0f} % off on average")
    if factor.shape[0] == 1:
        return [light]
    values = factor.mean(axis=-1) / mean.mean()
    apart = _apart(values[..., None] * mean, factor)
    if apart > PATTERN_COLORS:
        warn(f"light {light.name!r}: the colors of its pattern are shaded as their mean, {100.0 * apart:.0f} % off")
    return [replace(light, pattern=Pattern(source.axes, values, source.by_ray))]


def _covered(light: Light, rows: int, columns: int) -> np.ndarray:
    """The mask (rows, columns) of pixels on the light; pixels on the edge of a round one are left out, being partly
    dark."""
    if not light.is_round:
        return np.ones((rows, columns), bool)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return np.hypot(2.0 * x - 1.0, 2.0 * y - 1.0) < 1.0 - 1.5 / min(rows, columns)


def _with_factor(light: Light, factor: np.ndarray, warn) -> list[Light]:
    patches = cut_into_patches(factor * light.radiance, _covered(light, *factor.shape[:2]))
    if patches.error > ERROR:
        warn(
            f"light {light.name!r}: its texture is shaded as {len(patches.smallest)} patches of constant radiance, "
            f"which differ from it by {100.0 * patches.error:.0f} % on average"
        )
    return split_light(light, patches)


# MOST_PATCHES: of one light in the viewport, where each patch costs as much as a light.
MOST_PATCHES = 64
# POINTS: along each side of the grid on which an image is read. SUB: each point is the mean of SUB x SUB.
POINTS, SUB = 128, 2


# MOST_CACHED: how many lights with nodes have their patches kept.
MOST_CACHED = 256


class ShownTextures:
    """A cache of the patches of lights with images or nodes, which holds as long as these do not change."""

    def __init__(self):
        self._patches: dict[tuple, Patches | None] = {}
        self._seen: dict[tuple, tuple[NodeEmission, Patches]] = {}

    def clear(self) -> None:
        """Forget the patches of images, so that the images are read again."""
        self._patches.clear()

    def split(self, light: Light, factor: Value, notes: list[str]) -> list[Light] | None:
        """`light` times the image `factor` as patches; None where only Cycles knows the colors of the image.

        Coarse patches are reported in `notes`.
        """
        patches = self._patches_of(light, factor)
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

    def _patches_of(self, light: Light, factor: Value) -> Patches | None:
        use = factor.image
        key = (use.image.session_uid, use.mapping, use.closest, use.extension, light.is_round,
               factor.matrix.tobytes(), factor.offset.tobytes())  # fmt: skip
        if key not in self._patches:
            texture = _texture(use)
            self._patches[key] = None if texture is None else _cut(texture, factor, light.is_round)
        return self._patches[key]


def _shown_patches(light: Light, patches: Patches, notes: list[str]) -> list[Light]:
    if patches.error > ERROR:
        notes.append(
            f"{light.name}: its texture is shown as {len(patches.smallest)} patches, "
            f"{100.0 * patches.error:.0f} % off on average"
        )
    shown = (patch for whole in split_light(light, patches) for patch in whole.leaves)
    return [replace(patch, radiance=patch.radiance * light.radiance) for patch in shown]


def _texture(use) -> ImageTexture | None:
    """The pixels of an image; None where only Cycles knows its colors."""
    image = use.image.original
    srgb = is_srgb(image)
    pixels = None if srgb is None else opaque_pixels(image)
    if pixels is None:
        return None
    return ImageTexture(pixels, use.extension, "Closest" if use.closest else "Linear", srgb)


def _cut(texture: ImageTexture, factor: Value, is_round: bool) -> Patches:
    count = POINTS * SUB
    step = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(step, 1.0 - step)
    mapping = np.array(factor.image.mapping)
    uv = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ mapping.T
    colors = factor.offset + texture.colors(uv) @ factor.matrix[:, :3].T + factor.matrix[:, 3]
    image = colors.reshape(POINTS, SUB, POINTS, SUB, 3).mean(axis=(1, 3))
    covered = np.ones((POINTS, POINTS), bool)
    if is_round:
        x, y = np.meshgrid(*2 * [2.0 * (np.arange(POINTS) + 0.5) / POINTS - 1.0])
        covered = np.hypot(x, y) < 1.0
    return cut_into_patches(image, covered, MOST_PATCHES)
