"""Images on the area lights of a viewport, as few patches of constant radiance, from pixels alone.

Cycles is not asked, as `light_textures` does: that takes longer than a frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...scene import AreaLight
from ..materials.image_textures import ImageTexture
from ..materials.linear_values import Value
from ..materials.plain_textures import BYTE_SPACES, FLOAT_SPACES, MOST_PIXELS
from .patches import ERROR, Patches, cut_into_patches, split_light

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
    spaces = FLOAT_SPACES if image.is_float else BYTE_SPACES
    srgb = spaces.get(image.colorspace_settings.name)
    width, height = image.size
    if srgb is None or not 0 < width * height <= MOST_PIXELS:
        return None
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, 4)
    if (pixels[..., 3] != 1.0).any():
        return None
    return ImageTexture(pixels[..., :3], use.extension, "Closest" if use.closest else "Linear", srgb)


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
