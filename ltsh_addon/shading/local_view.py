"""Lights as seen from shading points in double precision: local frames, parts of polygons above the horizons."""

from __future__ import annotations

import numpy as np

from . import light_cone
from .light_polygons import light_levels
from .polygon import split_at_horizon


def local_frames(normal, view):
    """Local frames (3, 3, P): rows tangent, bitangent, normal; the view has y = 0 and x >= 0."""
    # The difference of vectors that are close is exact. The length of a normal from single precision is not quite 1.
    across = view - normal
    squared = (normal * normal).sum(axis=1, keepdims=True)
    tangent = across - (across * normal).sum(axis=1, keepdims=True) / squared * normal
    length = np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    # Where view and normal coincide any tangent serves: take the axis that the normal is farthest from.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    other = axis - (axis * normal).sum(axis=1, keepdims=True) / squared * normal
    tangent = np.where(length > 1e-7, tangent, other)
    tangent = tangent / np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    bitangent = np.cross(normal, tangent)
    return np.stack([tangent.T, bitangent.T, normal.T])


def in_front(samples, light, candidates):
    """Those candidate points that lie on the side to which the light shines, in its cone, and that it lights at all."""
    center, direction = (
        vector if vector.ndim == 1 else vector[candidates] for vector in (light.center, light.direction)
    )
    facing = ((samples.position[candidates] - center) * direction).sum(axis=1) > 0.0
    if light.is_focused:
        facing &= light_cone.may_reach(light, samples.position[candidates].T)
    allowed = light.receives(samples.receiver, candidates)
    return candidates[facing if allowed is None else facing & allowed]


def to_local(axes, vectors):
    """World vectors (3, ..., P) in local frames (3, 3, P)."""
    return np.stack([sum(row[k] * vectors[k] for k in range(3)) for row in axes])


def visible_parts(samples, frame, light, corners, candidates, second_normal=None):
    """Yield (index, polygons (3, W, Q) in local frames) of the candidate points that the light shines on.

    Polygons are clipped at the shading horizon, and before that at the horizon of `second_normal` (P, 3). Those of a
    focused light have two more coordinates, in the light's plane with the foot of the point as the origin.
    """
    index = in_front(samples, light, candidates)
    if len(index) == 0:
        return
    corners = corners[:, None, :] if corners.ndim == 2 else corners[:, index]
    offset = (corners - samples.position[index]).transpose(2, 0, 1)
    local = to_local(frame[:, :, index], offset)
    if light.is_focused:
        local = np.concatenate([local, to_local(light_cone.plane_axes(light), offset)])
    parts = [(slice(None), local)]
    if second_normal is not None:
        height = (offset * second_normal[index].T[:, None, :]).sum(axis=0)
        if not (height > 0.0).all():
            with_height = np.concatenate([local, height[None]])
            parts = ((part, clipped[:-1]) for part, clipped in split_at_horizon(with_height, axis=len(local)))
    for outer, polygon in parts:
        for inner, clipped in split_at_horizon(polygon):
            yield index[outer][inner], clipped


def seen_parts(samples, frame, light, corners, candidates, width, second_normal=None):
    """As `visible_parts`, (index, polygons, effort), with what lobes of `width` (Q,) or a number need of the light."""
    position = samples.position[candidates].T
    for outline, effort, chosen in light_levels(light, corners, position, width):
        of_level = candidates if chosen is None else candidates[chosen]
        for index, polygon in visible_parts(samples, frame, light, outline, of_level, second_normal):
            yield index, polygon, effort


def light_view(samples, frame, light, index, to_lobe) -> light_cone.LightView:
    """The view of a focused light from the points `index`; the first three coordinates are those of the lobe,
    to_lobe(vectors (3, Q)), the others local."""
    axes = frame[:, :, index]
    offset = (light.center - samples.position[index]).T

    def along(vector):
        local = to_local(axes, np.broadcast_to(vector[:, None], offset.shape))
        return np.concatenate([to_lobe(local), local])

    return light_cone.LightView.of(light, offset, along)
