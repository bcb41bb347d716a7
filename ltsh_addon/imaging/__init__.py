"""Images and figures: multi-layer EXR, PNG, error metrics, false color, the comparison sheet, the report.

numpy and OpenEXR only; nothing here knows Blender. Conventions: images are (H, W) or (H, W, C) with row 0 on top,
scene-referred linear RGB, Rec.709 where a function says nothing else, unless a name says sRGB; error = technique -
reference, red too bright, blue too dark.
"""

from .color import chromaticities, encode_png, exposure_factor, signed_error_colors, to_srgb8, write_png
from .exr import Layer, read_channels, read_layers, write_layers
from .metrics import (
    ErrorStatistics,
    error_statistics,
    mean_flip,
    noisy_error_statistics,
    reference_noise,
    unbiased_relative_error,
)
from .report import MOST_SHOWN, grouped, on_screen, write_html, write_json, write_overview
from .sheet import Tile, comparison_sheet
