"""Constants, and images under a linear map: what an input of a shader may be worth. Needs no bpy.

A value is matrix (R, G, B, A) + offset. Numbers are colors with three equal components.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

LUMA = np.array([0.2126, 0.7152, 0.0722])  # of Rec.709, by which Blender makes numbers of colors
EXTENSIONS = ("REPEAT", "EXTEND", "CLIP", "MIRROR")


@dataclass(frozen=True)
class ImageUse:
    """A flat image on a UV map ("": the active one); `mapping` (2, 3) takes (u, v, 1) to image coordinates."""

    image: Any
    uv_map: str
    mapping: tuple[tuple[float, float, float], tuple[float, float, float]]
    closest: bool
    extension: str  # one of EXTENSIONS


@dataclass(frozen=True)
class Value:
    """offset + matrix (R, G, B, A), or offset alone where there is no image."""

    offset: np.ndarray  # (3,)
    matrix: np.ndarray | None = None  # (3, 4)
    image: ImageUse | None = None

    @property
    def is_constant(self) -> bool:
        return self.image is None

    def mapped(self, matrix: np.ndarray, offset=0.0) -> Value:
        """`matrix` (3, 3) times this plus `offset`."""
        image_matrix = None if self.matrix is None else matrix @ self.matrix
        return Value(matrix @ self.offset + offset, image_matrix, self.image)

    def as_number(self) -> Value:
        """The color as a number."""
        return self.mapped(np.broadcast_to(LUMA, (3, 3)))


def is_gray(value: Value) -> bool:
    """True where all components are the same."""
    rows = value.offset[:, None] if value.matrix is None else np.column_stack([value.matrix, value.offset])
    return bool(np.all(rows == rows[:1]))


def constant(number) -> Value:
    """A number or the first three components of a color."""
    return Value(np.array(np.broadcast_to(np.ravel(number)[:3], (3,)), np.float64))


def combined(first: Value | None, second: Value | None, first_share, second_share) -> Value | None:
    """The sum of both under constant shares; None unless at most one has an image."""
    if first is None or second is None:
        return None
    if not first.is_constant and not second.is_constant:
        if first.image != second.image:
            return None
        matrix = first_share * first.matrix + second_share * second.matrix
        return Value(first_share * first.offset + second_share * second.offset, matrix, first.image)
    carrier, share, other, other_share = first, first_share, second, second_share
    if first.is_constant:
        carrier, share, other, other_share = second, second_share, first, first_share
    return carrier.mapped(share * np.eye(3), other_share * other.offset)


def product(first: Value | None, second: Value | None) -> Value | None:
    """The product; None unless at most one has an image."""
    if first is None or second is None:
        return None
    if not first.is_constant:
        first, second = second, first
    return second.mapped(np.diag(first.offset)) if first.is_constant else None
