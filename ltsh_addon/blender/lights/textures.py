"""Lights with textures, as patches."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...cycles.images import ImageTexture
from ...cycles.patches import ERROR, Patches, cut_into_patches, split_light
from ...scene import AreaLight, Pattern
from ..materials.values import Value, is_srgb, opaque_pixels
from .emission import PIXELS, Falloff, Studio, falloff_left_out

# Lights of one data block, with the same texture, that are looked at one by one; the others get what the first has.
MOST_LOOKS = 100
# Below this half angle in rad Cycles takes the first terms of a series instead of tan h - h.
SMALL_SPREAD = 0.05


@dataclass(frozen=True)
class UnseenLight:
    """An area light whose node tree has a say in its radiance."""

    data: object  # the original light data block
    matrix: np.ndarray  # (4, 4) in the world
    varies: bool  # over the light's surface, as far as its nodes tell
    falloff: Falloff
    is_point: bool = False  # a point, spot or sun
    by_ray: bool = False  # what it emits depends on where it shines


def look_at_area_lights(lights: list[AreaLight], unseen: dict[int, UnseenLight], studio: Studio, warn) -> list:
    """`lights` with those at the positions `unseen` replaced by what they look like; dark ones go."""
    result, seen = [], {}
    for position, light in enumerate(lights):
        if position not in unseen:
            result.append(light)
            continue
        source = unseen[position]
        own = seen.setdefault(source.data.name_full, [])
        if not own or (source.varies and len(own) < MOST_LOOKS):
            own.append(
                point_factor(light.is_distant, source, studio) if source.is_point else _factor(light, source, studio)
            )
            factor, covered = own[-1]
        else:
            factor, covered = own[0]
            if source.varies:
                warn(f"light {light.name!r}: of over {MOST_LOOKS} instances the others get the texture of the first")
        if not light.is_distant:
            light = replace(light, falloff=source.falloff.power, smooth=source.falloff.smooth)
        elif source.falloff != Falloff():
            warn(f"light {light.name!r}: its Light Falloff has no distance, shaded as its Strength")
        if light.is_facing or light.is_distant:
            result.extend(with_pattern(light, factor, source, warn))
            continue
        result.extend(_with_factor(light, factor, covered, warn))
    return result


def spread_peak(spread: float) -> float:
    """By what the radiance of a light of `spread` rad exceeds, straight ahead, that of one of 180 degrees."""
    half = 0.5 * spread
    if spread >= np.pi - 1e-6:
        return 1.0
    tangent = np.tan(half)
    return float(3.0 * tangent / half**3 if half <= SMALL_SPREAD else tangent / (tangent - half))


def _factor(light: AreaLight, source: UnseenLight, studio: Studio) -> tuple[np.ndarray, np.ndarray]:
    """What the node tree multiplies the radiance by (H, W, 3), and the pixels (H, W) on the light.

    Columns run along half_u, row 0 is at +half_v.
    """
    ob = bpy.data.objects.new("Look at a light", source.data)
    ob.visible_camera = True
    pixels = PIXELS if source.varies else 8
    with falloff_left_out([source.data]), studio.show(ob, source.matrix):
        image, _ = studio.look(light.center, light.half_u, light.half_v, light.direction, pixels)
    if np.dot(np.cross(light.half_u, light.half_v), light.direction) < 0.0:
        image = image[::-1]
    plain = light.radiance * spread_peak(light.spread)
    factor = np.divide(image, plain, out=np.zeros_like(image), where=plain != 0.0)
    rows, columns = image.shape[:2]
    covered = np.ones((rows, columns), bool)
    if light.is_round:
        # Pixels that the edge goes through are partly dark.
        x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        covered = np.hypot(2.0 * x - 1.0, 2.0 * y - 1.0) < 1.0 - 1.5 / min(rows, columns)
    return factor, covered


# Of the map of directions of a point or spot light: rows, and points along each side of the six views it is made of.
PATTERN_ROWS, VIEW_PIXELS = 64, 192
SMALL_RADIUS = 1e-3  # in place of none: m
# Colors of a pattern that differ by more, as a share of the light, are said to be lost.
PATTERN_COLORS = 0.05


def point_factor(is_distant: bool, source: UnseenLight, studio: Studio) -> tuple[np.ndarray, np.ndarray]:
    """What the node tree multiplies the radiance of a point, spot or sun by: (1, 1, 3), or where it varies (H, W, 3) by
    direction in the frame of the light, as of a `Pattern`; all are covered."""
    data = source.data.copy()
    try:
        if is_distant or not source.varies:
            data = _white(data, "AREA", {"shape": "SQUARE", "size": 1.0, "spread": np.pi})
            with _in_the_middle(data, studio):
                image = studio.look(np.zeros(3), 0.5 * _AXES[0], 0.5 * _AXES[1], -_AXES[2], 8)[0]
            factor = image.mean(axis=(0, 1), keepdims=True)
        else:
            radius = 1.0 if source.by_ray else max(data.shadow_soft_size, SMALL_RADIUS)
            data = _white(data, "POINT", {"shadow_soft_size": radius, "use_soft_falloff": False})
            with _in_the_middle(data, studio):
                factor = _seen_from_all_sides(studio, source.by_ray, radius)
    finally:
        bpy.data.lights.remove(data)
    factor = factor / (_WHITE["energy"] / np.pi)
    return factor, np.ones(factor.shape[:2], bool)


_AXES = np.eye(3)
_WHITE = {"color": (1.0, 1.0, 1.0), "energy": 100.0, "exposure": 0.0, "normalize": False, "use_temperature": False}


def _white(data, kind: str, settings: dict):
    """The light `data` as one of another kind, white."""
    name, data.type = data.name, kind
    # Another type is another class.
    data = bpy.data.lights[name]
    data.animation_data_clear()
    for key, value in {**_WHITE, **settings}.items():
        setattr(data, key, value)
    return data


@contextmanager
def _in_the_middle(data, studio):
    """Meanwhile the light stands at the origin, without its falloff."""
    ob = bpy.data.objects.new("Look at a light", data)
    ob.visible_camera = True
    with falloff_left_out([data]), studio.show(ob, np.eye(4)):
        yield


def _seen_from_all_sides(studio, by_ray: bool, radius: float) -> np.ndarray:
    """The map (H, W, 3) of a ball: from six sides, or from within, where rays go against its normals."""
    rows, columns = PATTERN_ROWS, 2 * PATTERN_ROWS
    polar = (np.arange(rows) + 0.5)[:, None] * (np.pi / rows)
    around = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    x, y, z = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0.0 * around
    normal = np.stack([x, y, z], axis=-1)
    result, highest = np.zeros((rows, columns, 3)), np.full((rows, columns), -1.0)
    for number in range(6):
        out, right = _AXES[number // 2] * (-1.0) ** number, _AXES[(number // 2 + 1) % 3]
        facing = normal @ out
        better, depth = facing > highest, np.ones_like(facing)
        if by_ray:
            # Light that goes out along the normal is met by a ray that goes the other way.
            image, up, depth = studio.look_around(-out, right, VIEW_PIXELS), np.cross(right, -out), -facing
        else:
            up = np.cross(out, right)
            image = studio.look(np.zeros(3), radius * right, radius * up, out, VIEW_PIXELS, 1.0)[0]
        depth = np.where(better & (depth != 0.0), depth, 1.0)
        row, column = (
            np.clip((normal @ axis / depth + 1.0) * 0.5 * VIEW_PIXELS, 0, VIEW_PIXELS - 1).astype(int)
            for axis in (-up, right)
        )
        result[better], highest[better] = image[row, column][better], facing[better]
    return result


def with_pattern(light: AreaLight, factor: np.ndarray, source: UnseenLight, warn) -> list[AreaLight]:
    """A point, spot or sun whose radiance its node tree multiplies by `factor`, as from `point_factor`."""
    weights = np.sin((np.arange(factor.shape[0]) + 0.5) * (np.pi / factor.shape[0]))[:, None, None]
    mean = (factor * weights).sum(axis=(0, 1)) / (weights.sum() * factor.shape[1])
    if not mean.any():
        return []
    light = replace(light, radiance=light.radiance * mean)
    if factor.shape[0] == 1:
        return [light]
    values = factor.mean(axis=-1) / mean.mean()
    apart = np.abs(factor - values[..., None] * mean).mean() / max(np.abs(mean).mean(), 1e-30)
    if apart > PATTERN_COLORS:
        warn(f"light {light.name!r}: the colors of its pattern are shaded as their mean, {100.0 * apart:.0f} % off")
    axes = np.linalg.inv(source.matrix[:3, :3] / np.linalg.norm(source.matrix[:3, :3], axis=0))
    # A light without a radius shines everywhere with the normal that goes there.
    by_ray = source.by_ray or source.data.shadow_soft_size == 0.0
    return [replace(light, pattern=Pattern(axes, values, by_ray))]


def _with_factor(light: AreaLight, factor: np.ndarray, covered: np.ndarray, warn) -> list[AreaLight]:
    patches = cut_into_patches(factor * light.radiance, covered)
    if patches.error > ERROR:
        warn(
            f"light {light.name!r}: its texture is shaded as {len(patches.smallest)} patches of constant radiance, "
            f"which differ from it by {100.0 * patches.error:.0f} % on average"
        )
    return split_light(light, patches)


# Of one light: each costs as much as a light.
MOST_PATCHES = 64
# Points along each side at which an image is read, each the mean of SUB x SUB.
POINTS, SUB = 128, 2


class ShownTextures:
    """Patches of the images on lights, kept for as long as neither the images nor the nodes change."""

    def __init__(self):
        self._patches: dict[tuple, Patches | None] = {}

    def clear(self) -> None:
        """Read all images again."""
        self._patches.clear()

    def split(self, light: AreaLight, factor: Value, notes: list[str]) -> list[AreaLight] | None:
        """`light` times `factor` as patches, named in `notes` where they are coarse; None: not resolved."""
        patches = self._patches_of(light, factor)
        if patches is None:
            return None
        if patches.error > ERROR:
            notes.append(
                f"{light.name}: its texture is shown as {len(patches.smallest)} patches, "
                f"{100.0 * patches.error:.0f} % off on average"
            )
        shown = (patch for whole in split_light(light, patches) for patch in whole.patches)
        return [replace(patch, radiance=patch.radiance * light.radiance) for patch in shown]

    def _patches_of(self, light: AreaLight, factor: Value) -> Patches | None:
        use = factor.image
        key = (use.image.session_uid, use.mapping, use.closest, use.extension, light.is_round,
               factor.matrix.tobytes(), factor.offset.tobytes())  # fmt: skip
        if key not in self._patches:
            texture = _texture(use)
            self._patches[key] = None if texture is None else _cut(texture, factor, light.is_round)
        return self._patches[key]


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
    place = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(place, 1.0 - place)
    mapping = np.array(factor.image.mapping)
    uv = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ mapping.T
    colors = factor.offset + texture.colors(uv) @ factor.matrix[:, :3].T + factor.matrix[:, 3]
    image = colors.reshape(POINTS, SUB, POINTS, SUB, 3).mean(axis=(1, 3))
    covered = np.ones((POINTS, POINTS), bool)
    if is_round:
        x, y = np.meshgrid(*2 * [2.0 * (np.arange(POINTS) + 0.5) / POINTS - 1.0])
        covered = np.hypot(x, y) < 1.0
    return cut_into_patches(image, covered, MOST_PATCHES)
