"""The camera of a picture."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from mathutils import Matrix


@dataclass(frozen=True)
class ViewCamera:
    """The camera of a picture. All positions that are drawn are relative to `origin`."""

    projection: np.ndarray  # (4, 4) to clip space
    eye: np.ndarray  # (3,) position of the eye, or in parallel views the unit direction toward it
    is_parallel: bool
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) in the world

    @classmethod
    def of(cls, view_matrix: Matrix, window_matrix: Matrix, is_parallel: bool) -> ViewCamera:
        """The view of a region with these matrices."""
        to_view = np.array(view_matrix, np.float64)
        to_world = np.linalg.inv(to_view)
        eye = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2]) if is_parallel else to_world[:3, 3]
        return cls(np.array(window_matrix, np.float64) @ to_view, eye, is_parallel)

    def around(self, origin: np.ndarray) -> ViewCamera:
        """The same view of the world, with positions relative to `origin` (3,)."""
        to_world = np.eye(4)
        to_world[:3, 3] = origin - self.origin
        eye = self.eye if self.is_parallel else self.eye - to_world[:3, 3]
        return ViewCamera(self.projection @ to_world, eye, self.is_parallel, origin)

    def shifted(self, offset: np.ndarray, size: tuple[int, int]) -> ViewCamera:
        """The same view, in which pixels show the point `offset` (2,) pixels right and up of their centers.

        `size` is that of the picture in pixels.
        """
        shift = np.eye(4)
        shift[:2, 3] = -2.0 * np.asarray(offset) / size
        return ViewCamera(shift @ self.projection, self.eye, self.is_parallel, self.origin)

    @property
    def rays(self) -> np.ndarray:
        """(3, 3): the change of the eye's ray from the center of the picture to its right end, the change to its upper
        end, and the ray of the center. Rays may have any length."""
        if self.is_parallel:
            return np.stack([np.zeros(3), np.zeros(3), -self.eye])
        back = np.linalg.inv(self.projection)
        corners = (back[:3] - self.eye[:, None] * back[3]).T
        return np.stack([corners[0], corners[1], corners[2] + corners[3]]) / np.linalg.norm(corners[2] + corners[3])

    @property
    def homogeneous_eye(self) -> tuple[float, ...]:
        """The eye's position and 1, or the direction toward it and 0."""
        return (*self.eye, 0.0 if self.is_parallel else 1.0)
