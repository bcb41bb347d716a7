"""Shading of surface samples by area lights: frames, chunks, light groups, progress."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ..scene import AreaLight, Cancelled, SurfaceSamples
from . import reference
from .edge_integrals import vector_irradiance
from .lobe_integrals import form_factor, polygon_integrals
from .lookup_table import Lobe, LookupTable, load_table
from .polygon import project_to_sphere, split_at_horizon

REFERENCE = "reference"
PASSES = ("specular", "diffuse")
CHUNK = 8192
ROUND_LIGHT_CORNERS = 32
FINE_ROUND_LIGHT_CORNERS = 64


@dataclass(frozen=True)
class Shading:
    """Reflected radiance in W m^-2 sr^-1 per light group; a pass that was not asked for is None."""

    groups: tuple[str, ...]
    specular: np.ndarray | None  # (G, P, 3)
    diffuse: np.ndarray | None  # (G, P, 3)
    quadrature_error: np.ndarray | None = None  # (P,) estimate for F = 1 and unit radiance, of "reference" only

    @property
    def combined(self) -> np.ndarray:
        """Sum (P, 3) over the passes and light groups."""
        return sum(part.sum(axis=0) for part in (self.specular, self.diffuse) if part is not None)


def shade(
    samples: SurfaceSamples,
    lights: Iterable[AreaLight],
    technique: str | Path | LookupTable = "ltsh4",
    *,
    passes: Sequence[str] = PASSES,
    workers: int | None = None,
    progress: Callable[[float], bool | None] | None = None,
) -> Shading:
    """Direct, unoccluded reflected radiance of `samples` (P) under `lights`.

    `technique` is "reference" (quadrature of the true BRDF), a shipped table, a table's path or a LookupTable. Diffuse
    is exact for polygons in every technique. `workers` threads (default: all cores) give the same result bit for bit.
    `progress(fraction)` may return False to stop: Cancelled is raised. Raises TableError and ValueError.
    """
    unknown = [name for name in passes if name not in PASSES]
    if unknown or not passes:
        raise ValueError(f"passes are {list(passes)}, expected some of {', '.join(PASSES)}")
    lights = tuple(lights)
    groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
    table = technique
    if isinstance(technique, str | Path) and technique != REFERENCE:
        table = load_table(technique)
    prepared = [(light, groups.index(light.group), light.polygon(ROUND_LIGHT_CORNERS)) for light in lights]
    radiance = {name: np.zeros((len(groups), len(samples), 3)) for name in passes}
    error = np.zeros(len(samples)) if table == REFERENCE and "specular" in passes else None

    def work(chunk: slice) -> None:
        part = samples.take(chunk)
        views = {name: values[:, chunk] for name, values in radiance.items()}
        if "diffuse" in views:
            _shade_diffuse(part, prepared, views["diffuse"])
        if "specular" in views:
            _shade_specular(part, prepared, table, views["specular"], None if error is None else error[chunk])

    chunks = [slice(start, start + CHUNK) for start in range(0, len(samples), CHUNK)]
    _run(work, chunks, workers or os.cpu_count() or 1, progress)
    return Shading(groups, radiance.get("specular"), radiance.get("diffuse"), error)


def _run(work, chunks, workers, progress):
    """Call work(chunk) for all chunks on a few threads; stop between chunks where `progress` says so."""
    with ThreadPoolExecutor(max_workers=workers) as pool:
        pending = {pool.submit(work, chunk) for chunk in chunks}
        done_count = 0
        try:
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
                done_count += len(done)
                if progress is not None and progress(done_count / len(chunks)) is False:
                    raise Cancelled("shading was stopped")
        finally:
            for future in pending:
                future.cancel()


def _shade_diffuse(samples, lights, radiance):
    frame = _frame(samples.diffuse_normal, samples.view)
    lit = np.nonzero(samples.diffuse_albedo.any(axis=1))[0]
    bumped = (samples.diffuse_normal[lit] != samples.smooth_normal[lit]).any(axis=1)
    for light, group, corners in lights:
        if not light.affects_diffuse:
            continue
        for index, polygon in _visible_parts(samples, frame, light, corners, lit[~bumped]):
            irradiance = np.abs(form_factor(polygon))
            radiance[group, index] += irradiance[:, None] * samples.diffuse_albedo[index] * light.radiance
        for index, polygon in _visible_parts(samples, frame, light, corners, lit[bumped], samples.smooth_normal):
            irradiance = _shadowed_form_factor(samples, frame, index, polygon)
            radiance[group, index] += irradiance[:, None] * samples.diffuse_albedo[index] * light.radiance


def _shadowed_form_factor(samples, frame, index, polygon):
    """Form factor (Q,) times the bump shadowing of `SurfaceSamples`, taken at the mean direction of the polygon."""
    direction = -vector_irradiance(project_to_sphere(polygon))
    smooth = _to_local(frame[:, :, index], samples.smooth_normal[index].T)
    along = (direction * smooth).sum(axis=0)
    tangent2 = (direction * direction).sum(axis=0) / np.maximum(along, 1e-30) ** 2 - 1.0
    shadowing = 2.0 / (1.0 + np.sqrt(1.0 + samples.bump_alpha2[index] * np.maximum(tangent2, 0.0)))
    return np.where(along > 0.0, np.abs(form_factor(polygon)) * shadowing, 0.0)


def _shade_specular(samples, lights, table, radiance, error):
    cosine = (samples.normal * samples.view).sum(axis=1)
    frame = _frame(samples.normal, samples.view)
    reflective = samples.specular_f90.any(axis=1) | samples.specular_f0.any(axis=1) | (samples.dielectric > 0.0)
    lit = np.nonzero((cosine > 0.0) & reflective)[0]
    cosine = np.clip(cosine, 0.0, 1.0)
    lobe = None
    if table != REFERENCE and len(lit):
        lobe = _fresnel_lobe(table, cosine, samples)
    for light, group, corners in lights:
        if not light.affects_specular:
            continue
        if table == REFERENCE:
            parts = _reference_integrals(samples, cosine, frame, light, corners, lit, error)
        else:
            visible = _visible_parts(samples, frame, light, corners, lit, samples.geometric_normal)
            parts = ((index, _table_integrals(table, lobe.take(index), polygon)) for index, polygon in visible)
        for index, integrals in parts:
            plain, schlick, dielectric = integrals[..., None]
            f0, f90 = samples.specular_f0[index], samples.specular_f90[index]
            reflected = f0 * plain + (f90 - f0) * schlick + samples.dielectric[index, None] * dielectric
            radiance[group, index] += reflected * light.radiance


def _reference_integrals(samples, cosine, frame, light, corners, candidates, error):
    """Yield (index, integrals (3, Q)) by quadrature; round lights are exact ellipses. Adds to `error`."""
    batches = []
    if light.is_round:
        candidates, whole, local = _uncut_ellipses(samples, frame, light, candidates)
        if len(whole):
            batches.append((whole, lambda warp: reference.EllipseBoundary.warped(warp, *local)))
        corners = light.polygon(FINE_ROUND_LIGHT_CORNERS)
    for index, polygon in _visible_parts(samples, frame, light, corners, candidates, samples.geometric_normal):
        batches.append((index, partial(reference.PolygonBoundary.warped, polygon=polygon)))
    for index, make_boundary in batches:
        alpha = samples.roughness[index] ** 2
        integrals, estimate = reference.lobe_integrals(make_boundary, cosine[index], alpha, samples.ior[index])
        error[index] += estimate
        yield index, integrals


def _uncut_ellipses(samples, frame, light, candidates):
    """Split the candidates: (those whose light is cut by the geometric horizon, the others that see it, for these the
    center and half axes in local frames)."""
    index = _in_front(samples.position, light, candidates)
    offset = (light.center - samples.position[index]).T
    height, swing = _ellipse_extent(samples.geometric_normal[index].T, offset, light)
    cut = index[(height < swing) & (height > -swing)]
    index, offset = index[height >= swing], offset[:, height >= swing]
    height, swing = _ellipse_extent(samples.normal[index].T, offset, light)
    index, offset = index[height > -swing], offset[:, height > -swing]
    axes = frame[:, :, index]
    return cut, index, [_to_local(axes, vector) for vector in (offset, light.half_u[:, None], light.half_v[:, None])]


def _ellipse_extent(normal, offset, light):
    """Heights (P,) of the light's center over the planes with `normal` (3, P), and how far it reaches up and down."""
    u, v = (sum(normal[k] * vector[k] for k in range(3)) for vector in (light.half_u, light.half_v))
    return (normal * offset).sum(axis=0), np.hypot(u, v)


def _fresnel_lobe(table: LookupTable, cosine, samples) -> Lobe:
    """Lobes with three coefficient vectors: F = 1, (1 - c)^5 and the dielectric of each sample's IOR."""
    lobe = table.lookup(cosine, samples.roughness.astype(cosine.dtype))
    weights = table.dielectric_weights(samples.ior)
    dielectric = sum(weight * vector for weight, vector in zip(weights, lobe.coefficients, strict=True))
    return lobe.with_coefficients(np.stack([lobe.coefficients[0], lobe.coefficients[1], dielectric]))


def _table_integrals(table, lobe, polygon):
    """Integrals (3, P), never negative; corners run counterclockwise as seen from the point (`AreaLight.polygon`)."""
    signed = polygon_integrals(table, lobe, polygon, lobe.coefficients)
    return np.maximum(-signed, 0.0)


def _frame(normal, view):
    """Local frames (3, 3, P): rows tangent, bitangent, normal; the view has y = 0 and x >= 0."""
    cosine = (normal * view).sum(axis=1, keepdims=True)
    tangent = view - cosine * normal
    length = np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    # Where view and normal coincide any tangent serves: take the axis that the normal is farthest from.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    other = axis - (axis * normal).sum(axis=1, keepdims=True) * normal
    tangent = np.where(length > 1e-7, tangent, other)
    tangent = tangent / np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    bitangent = np.cross(normal, tangent)
    return np.stack([tangent.T, bitangent.T, normal.T])


def _in_front(position, light, candidates):
    """Those candidate points that lie on the side to which the light shines."""
    return candidates[((position[candidates] - light.center) * light.direction).sum(axis=1) > 0.0]


def _to_local(axes, vectors):
    """World vectors (3, ..., P) in local frames (3, 3, P)."""
    return np.stack([sum(row[k] * vectors[k] for k in range(3)) for row in axes])


def _visible_parts(samples, frame, light, corners, candidates, second_normal=None):
    """Yield (index, polygons (3, W, Q) in local frames) of the candidate points that the light shines on.

    Polygons are clipped at the shading horizon, and before that at the horizon of `second_normal` (P, 3).
    """
    index = _in_front(samples.position, light, candidates)
    if len(index) == 0:
        return
    offset = (corners[:, None, :] - samples.position[index]).transpose(2, 0, 1)
    local = _to_local(frame[:, :, index], offset)
    parts = [(slice(None), local)]
    if second_normal is not None:
        height = (offset * second_normal[index].T[:, None, :]).sum(axis=0)
        if not (height > 0.0).all():
            with_height = np.concatenate([local, height[None]])
            parts = ((part, clipped[:3]) for part, clipped in split_at_horizon(with_height, axis=3))
    for outer, polygon in parts:
        for inner, clipped in split_at_horizon(polygon):
            yield index[outer][inner], clipped
