"""Flat lights whose radiance varies, as patches of constant radiance. Needs no bpy.

An image of the light is cut in halves, always where the error is largest, until the mean absolute difference between
the radiance and its patch is below `ERROR` of the mean radiance. The larger patches on the way stay: each surface point
uses the coarsest ones that its lobe cannot resolve (`shading.light_polygons`).
"""

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..lobes.polygon import clip_to_horizon
from ..scene import Light, PolygonLight, QuadLight

# Mean absolute error at which cutting stops, as a share of the mean radiance.
ERROR = 0.02
# Most cells along each side; so there are at most 64 x 64 patches.
GRID = 64
# Cuts that lead from a patch to its parts.
CUTS = 4
# Corners of the polygon that stands for an ellipse cut into patches. It has the area of the ellipse and is within 2e-3
# of the radius from it.
ROUND_CORNERS = 64
# Largest side of a rectangle at the edge of a round light with a spread; the light's half axes are 1.
FOCUSED_EDGE = 0.125


@dataclass(frozen=True)
class Patch:
    """A rectangle `cell` (left, right, bottom, top in [-1, 1]), its mean radiance (3,) and its parts."""

    cell: tuple[float, float, float, float]
    radiance: np.ndarray
    parts: "tuple[Patch, ...]" = ()

    def smallest(self) -> "Iterator[Patch]":
        """The uncut patches in this one."""
        if not self.parts:
            yield self
        for patch in self.parts:
            yield from patch.smallest()


@dataclass(frozen=True)
class Patches:
    """The patch of the whole image, None if that is dark, and the relative L1 error of the smallest patches."""

    whole: Patch | None
    error: float

    @property
    def smallest(self) -> list[Patch]:
        """The uncut patches."""
        return [] if self.whole is None else list(self.whole.smallest())

    @property
    def spread(self) -> float:
        """The mean difference of the image from its mean radiance, as a share of that."""
        mean, difference = (np.zeros(3) if self.whole is None else self.whole.radiance), 0.0
        for patch in self.smallest:
            left, right, bottom, top = patch.cell
            # Dark parts, which are in no patch, lack as much as the others have too much.
            difference += 0.5 * (right - left) * (top - bottom) * np.maximum(patch.radiance - mean, 0.0).sum()
        return difference / max(mean.sum(), 1e-30)


def cut_into_patches(image: np.ndarray, covered: np.ndarray, most: int = GRID * GRID) -> Patches:
    """Patches of an `image` (H, W, 3), row 0 on top, of which only the pixels `covered` (H, W) count. Dark patches are
    left out. There are at most `most` uncut patches."""
    pixels = _Pixels(image, covered)
    height, width = covered.shape
    total = np.abs(image[covered]).sum()
    number = itertools.count()
    whole = (0, height, 0, width)
    error = pixels.error(whole)
    # A heap of (-error, tie breaker, cell). Cells that are too small to cut are removed and counted in `done`.
    open_cells, done, halves_of = [(-error, next(number), whole)], 0, {}
    while open_cells and error > ERROR * total and len(open_cells) + done < most:
        negative_error, _, cell = heapq.heappop(open_cells)
        halves = pixels.best_halves(cell)
        if halves is None:
            done += 1
            continue
        error += negative_error
        halves_of[cell] = halves
        for half in halves:
            half_error = pixels.error(half)
            error += half_error
            heapq.heappush(open_cells, (-half_error, next(number), half))
    share = max(error, 0.0) / total if total > 0.0 else 0.0
    return Patches(_patch(whole, halves_of, pixels), float(share))


def _patch(cell, halves_of: dict, pixels: "_Pixels") -> Patch | None:
    cells, radiance = [cell] if cell in halves_of else [], pixels.mean(cell)
    for _ in range(CUTS):
        cells = [half for inner in cells for half in halves_of.get(inner, (inner,))]
    children = tuple(patch for patch in (_patch(inner, halves_of, pixels) for inner in cells) if patch is not None)
    if not children and not np.any(radiance != 0.0):
        return None
    height, width = pixels.covered.shape
    sides = (cell[2] / width, cell[3] / width, 1.0 - cell[1] / height, 1.0 - cell[0] / height)
    return Patch(tuple(2.0 * side - 1.0 for side in sides), radiance, children)


class _Pixels:
    """Sums over the covered pixels of cells (top, bottom, left, right)."""

    def __init__(self, image: np.ndarray, covered: np.ndarray):
        self.image, self.covered, self.full = image, covered, bool(covered.all())
        inside = np.where(covered[..., None], image, 0.0)
        values = np.concatenate([inside, np.square(inside), covered[..., None]], axis=-1)
        self._sums = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0), (0, 0)))
        self._least = tuple(-(-count // GRID) for count in covered.shape)

    def _sum(self, cell) -> np.ndarray:
        """Sums (7,) over covered pixels of the colors, of their squares, and of 1."""
        y0, y1, x0, x1 = cell
        return self._sums[y1, x1] - self._sums[y0, x1] - self._sums[y1, x0] + self._sums[y0, x0]

    def mean(self, cell) -> np.ndarray:
        """Mean color (3,); 0 if no pixel is covered."""
        rows, columns = slice(cell[0], cell[1]), slice(cell[2], cell[3])
        inside = self.image[rows, columns][self.covered[rows, columns]]
        return inside.mean(axis=0) if len(inside) else np.zeros(3)

    def error(self, cell) -> float:
        """Sum of the absolute differences from the mean color."""
        rows, columns = slice(cell[0], cell[1]), slice(cell[2], cell[3])
        values = self.image[rows, columns]
        values = values.reshape(-1, 3) if self.full else values[self.covered[rows, columns]]
        return float(np.abs(values - values.mean(axis=0)).sum()) if len(values) else 0.0

    def _squares(self, cell) -> float:
        """Sum of the squared differences from the mean color."""
        sums = self._sum(cell)
        return float((sums[3:6] - np.square(sums[:3]) / max(sums[6], 1.0)).sum())

    def best_halves(self, cell):
        """The halves of `cell` with the smaller sum of squared differences; None if the cell is too small to cut.

        A cut never increases the squares. It may increase the absolute differences, which decide when to stop.
        """
        y0, y1, x0, x1 = cell
        choices = []
        if y1 - y0 >= 2 * self._least[0]:
            middle = (y0 + y1) // 2
            choices.append(((y0, middle, x0, x1), (middle, y1, x0, x1)))
        if x1 - x0 >= 2 * self._least[1]:
            middle = (x0 + x1) // 2
            choices.append(((y0, y1, x0, middle), (y0, y1, middle, x1)))
        return min(choices, key=lambda halves: sum(self._squares(half) for half in halves), default=None)


def split_light(light: Light, patches: Patches) -> list[Light]:
    """`light` with its mean radiance and a tree of its patches as `children`; [] if it is dark.

    Cells are along its half_u and half_v. Those wholly inside the light become rectangles, others polygons.
    """
    if patches.whole is None:
        return []
    outline = _outline(light)
    children = [child for patch in patches.whole.parts for child in _lights_of(light, outline, patch)]
    return [replace(light, radiance=patches.whole.radiance, children=tuple(children))]


def _lights_of(light: Light, outline: np.ndarray, patch: Patch) -> list[Light]:
    """One light for `patch` with its parts as children; only the parts if the patch has no simple shape."""
    whole = _light_of_cell(replace(light, radiance=patch.radiance), outline, patch.cell)
    if not patch.parts:
        return whole
    children = tuple(child for inner in patch.parts for child in _lights_of(light, outline, inner))
    return [replace(whole[0], children=children)] if len(whole) == 1 else list(children)


def _light_of_cell(light: Light, outline: np.ndarray, cell) -> list[Light]:
    """The part of `light` in `cell`. `outline` (V, 2) is that of a light that is no rectangle."""
    size = (cell[1] - cell[0]) * (cell[3] - cell[2])
    inside = outline if isinstance(light, QuadLight) else clip_to_cell(outline, cell)
    share = abs(signed_area(inside)) / size
    if isinstance(light, QuadLight) or share >= 1.0 - 1e-6:
        return [_rectangle(light, cell)]
    if share <= 1e-9:
        return []
    if not light.has_profile:
        whole = _rectangle(light, cell)
        return [PolygonLight.like(whole, corners=_in_space(light, inside))]
    # Polygons cannot have a spread, so small rectangles with the same power stand for the edge.
    if max(cell[1] - cell[0], cell[3] - cell[2]) > FOCUSED_EDGE:
        return [piece for half in _halves(cell) for piece in _light_of_cell(light, outline, half)]
    bounds = np.stack([inside.min(axis=0), inside.max(axis=0)], axis=-1).ravel()
    full = (bounds[1] - bounds[0]) * (bounds[3] - bounds[2])
    return [_rectangle(replace(light, radiance=light.radiance * share * size / full), bounds)]


def _halves(cell) -> list[tuple]:
    x0, x1, y0, y1 = cell
    if x1 - x0 >= y1 - y0:
        middle = 0.5 * (x0 + x1)
        return [(x0, middle, y0, y1), (middle, x1, y0, y1)]
    middle = 0.5 * (y0 + y1)
    return [(x0, x1, y0, middle), (x0, x1, middle, y1)]


def _rectangle(light: Light, cell) -> Light:
    x0, x1, y0, y1 = cell
    return QuadLight.like(
        light,
        center=light.center + 0.5 * (x0 + x1) * light.half_u + 0.5 * (y0 + y1) * light.half_v,
        half_u=0.5 * (x1 - x0) * light.half_u,
        half_v=0.5 * (y1 - y0) * light.half_v,
    )


def _outline(light: Light) -> np.ndarray:
    """Corners (V, 2) of `light` in units of half_u and half_v."""
    if isinstance(light, PolygonLight):
        offset = light.corners - light.center
        axes = np.stack([light.half_u, light.half_v], axis=-1)
        outline = np.linalg.lstsq(axes, offset.T, rcond=None)[0].T
        return outline if signed_area(outline) > 0.0 else outline[::-1]
    step = 2.0 * np.pi / ROUND_CORNERS
    # No corner where the ellipse touches its rectangle: the polygon stays inside.
    angle = step * (np.arange(ROUND_CORNERS) + 0.5)
    return np.sqrt(step / np.sin(step)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _in_space(light: Light, outline: np.ndarray) -> np.ndarray:
    corners = light.center + outline[:, :1] * light.half_u + outline[:, 1:] * light.half_v
    mirrored = np.dot(np.cross(light.half_u, light.half_v), light.direction) < 0.0
    return corners[::-1] if mirrored else corners


def note_patches(whose: str, count: int, error: float, warn) -> None:
    """Call `warn(text)` if `count` patches differ by more than ERROR from the emission for which they stand."""
    if error > ERROR:
        off = f"which differ from it by {100.0 * error:.0f} % on average"
        warn(f"{whose} is shaded as {count} patches of constant radiance, {off}")


def clip_to_cell(outline: np.ndarray, cell) -> np.ndarray:
    """The part (W, 2) of a polygon (V, 2) in the rectangle left, right, bottom, top, see `clip_to_horizon`.

    If a concave polygon falls into several parts, edges that run there and back connect them.
    """
    x0, x1, y0, y1 = cell
    x, y = outline.T
    inside = np.stack([x, y, x - x0, x1 - x, y - y0, y1 - y])[..., None]
    for side in range(2, len(inside)):
        if not (inside[side] > 0.0).any():
            return np.zeros((0, 2))
        inside = clip_to_horizon(inside, side)
    return inside[:2, :, 0].T


def signed_area(outline: np.ndarray) -> float:
    """Area of a polygon (V, 2), positive if it is counterclockwise."""
    if len(outline) < 3:
        return 0.0
    x, y = outline.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
