"""Captions over pictures can be read whatever the pictures show."""

import bpy  # noqa: F401  brings blf and gpu
import pytest

from ltsh_addon.blender.engine import view
from ltsh_addon.blender.ui.drawing import INK, PLATE

# WCAG 2.2, success criterion 1.4.3, https://www.w3.org/TR/WCAG22/#contrast-minimum
LEAST_CONTRAST = 4.5
LUMINANCE = (0.2126, 0.7152, 0.0722)


def linear(value):
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1


def luminance(color):
    return sum(weight * linear(value) for weight, value in zip(LUMINANCE, color[:3], strict=True))


@pytest.mark.parametrize("picture", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("color", [INK, view.CAPTION_COLOR, view.BRIGHTER_COLOR, view.DARKER_COLOR])
def test_captions_stand_out_from_their_plates_on_dark_and_white_pictures(picture, color):
    behind = PLATE[3] * luminance(PLATE) + (1.0 - PLATE[3]) * picture
    assert (luminance(color) + 0.05) / (behind + 0.05) > LEAST_CONTRAST
