"""Cycles' pixel filter: points drawn from it, and camera rays pinned to a point (runs in the child).

Cycles weights all camera rays of a pixel alike and draws where they go from the filter. Equally weighted points drawn
from the same density therefore give the edges of a plain render.
"""

from __future__ import annotations

from contextlib import contextmanager

import bpy
import numpy as np

# In pixels. The interface ends at 0.01, which is too wide: reference rays then cross edges that the central sample
# does not (measured: 1 % of the pixels of a detailed picture, 6 % relative L2). What
# remains: 1 in 1000 rays per axis strays by up to half a pixel, by the first cell of Cycles' filter table.
CENTER_FILTER_WIDTH = 1e-6
QUANTILE_STEPS = 8192


def filter_density(kind: str, width: float, distance: np.ndarray) -> tuple[np.ndarray, float]:
    """Weight of the filter `distance` pixels from the center along one axis, not normalized, and its half extent.

    `kind` and `width` (pixels) are `pixel_filter_type` and `filter_width` of the scene; filters are separable. BOX is
    one pixel whatever the width. GAUSSIAN is exp(-8 (x / width)^2), cut at 1.5 widths. BLACKMAN_HARRIS is the window of
    Harris 1978 ("On the use of windows for harmonic analysis with the discrete Fourier transform"), four terms,
    two widths from end to end. Measured on an edge: Cycles 4.5.15 and 5.2.3 agree to 1e-3 of its height.
    """
    distance = np.asarray(distance, dtype=np.float64)
    if kind == "BOX":
        weight, half = np.ones_like(distance), 0.5
    elif kind == "GAUSSIAN":
        weight, half = np.exp(-8.0 * (distance / width) ** 2), 1.5 * width
    elif kind == "BLACKMAN_HARRIS":
        phase = np.pi * (distance / width + 1.0)
        terms = (0.35875, -0.48829, 0.14128, -0.01168)
        weight, half = sum(term * np.cos(order * phase) for order, term in enumerate(terms)), width
    else:
        raise ValueError(f"pixel filter is {kind!r}, expected BOX, GAUSSIAN or BLACKMAN_HARRIS")
    return np.where(np.abs(distance) <= half, weight, 0.0), half


def filter_quantiles(kind: str, width: float, shares: np.ndarray) -> np.ndarray:
    """Distances from the pixel's center, in pixels, below which the filter has the `shares` of its weight."""
    half = filter_density(kind, width, np.zeros(1))[1]
    distance = np.linspace(-half, half, QUANTILE_STEPS + 1)
    weight = filter_density(kind, width, distance)[0]
    cumulative = np.concatenate([[0.0], np.cumsum(weight[1:] + weight[:-1])])
    return np.interp(shares, cumulative / cumulative[-1], distance)


def filter_points(kind: str, width: float, count: int) -> np.ndarray:
    """Offsets (count, 2) from the pixel's center, right and up, in pixels, distributed as the filter; 0 for one.

    The R2 sequence (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences"), warped along each axis.
    """
    if count == 1:
        return np.zeros((1, 2))
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    return filter_quantiles(kind, width, (np.arange(count)[:, None] * steps + 0.5) % 1.0)


def sub_pixel_offsets(scene, count: int) -> np.ndarray:
    """`filter_points` of the scene's own filter. To be called outside `pinned_pixel_filter`, which replaces it."""
    return filter_points(scene.cycles.pixel_filter_type, scene.cycles.filter_width, count)


def filter_name(scene) -> str:
    """The scene's filter for a report: its kind, and its width in pixels where it has one."""
    kind = scene.cycles.pixel_filter_type
    return kind if kind == "BOX" else f"{kind} {scene.cycles.filter_width:g} px"


@contextmanager
def pinned_pixel_filter(scene):
    """Meanwhile all camera rays of a pixel go through its center; sub-samples come from shifting the camera."""
    cycles = scene.cycles
    before = cycles.pixel_filter_type, cycles.filter_width
    cycles.pixel_filter_type = "GAUSSIAN"
    # Written past the property's limits, into what stores it.
    stored = cycles.bl_system_properties_get(do_create=True) if bpy.app.version >= (5, 0, 0) else cycles
    stored["filter_width"] = CENTER_FILTER_WIDTH
    try:
        yield
    finally:
        cycles.pixel_filter_type, cycles.filter_width = before
