"""Lights on the graphics card, uploaded once for all passes that read them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gpu
import numpy as np

from ...scene import AreaLight
from .gbuffer_textures import float_texture
from .light_texture import light_texels, visible_lights

MOST_LOOPS = 40000


@dataclass(frozen=True)
class UploadedLights:
    """Lights that have an area, and their texture."""

    lights: tuple[AreaLight, ...]
    texture: gpu.types.GPUTexture


def upload_lights(lights: Iterable[AreaLight]) -> UploadedLights:
    """`lights` on the card; needs an active GPU context."""
    visible = tuple(visible_lights(lights))
    return UploadedLights(visible, float_texture(light_texels(visible)))


def shares(loops: Sequence[int]) -> list[tuple[int, int]]:
    """The lights (first, end) of each draw call, of which each goes round as many `loops`: llvmpipe breaks off those
    of a pixel that go round more than 65535 times, and other cards do not like long ones. The first call is there
    without lights, too."""
    number = np.cumsum([0, *loops[:-1]]) // MOST_LOOPS if len(loops) else np.zeros(0)
    starts = [0, *(np.nonzero(np.diff(number))[0] + 1).tolist(), len(loops)]
    return list(zip(starts[:-1], starts[1:], strict=True))
