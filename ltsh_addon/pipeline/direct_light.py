"""LTSH's direct light of a finished picture: its samples, shadows and shading, with as many points as the plan says."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..cycles.gbuffer import with_one_shadow
from ..scene import PASSES
from ..visibility import ShadowSampling
from . import plan
from .comparison import Comparison
from .compositing import clean_share, light_curvature, point_statistics, radiance_of_samples
from .lighting import Shadows, ShadowTracer, evaluated, load_tables, rays_of_samples
from .options import EDGE_POINTS, SHADOW_RAYS, PictureOptions, RenderOptions, child_job

# SQUARE: the squares of a probe, in pixels on a side.
SQUARE = 8
# MOST_EDGES: where a larger share of the pixels has edges, these are the detail of surfaces, and samples of Cycles are
# worth more than further points.
MOST_EDGES = 0.3


def shade_direct_light(
    options: RenderOptions, scene_and_layer: dict, clock, seconds_left: Callable, progress
) -> Comparison:
    """The direct light by the technique, with shadows; without results where all of it is left to Cycles.

    `scene_and_layer` are fields of the child's job. `clock` is told the ends of stages; `seconds_left(extraction)` are
    those of the budget.
    """
    from ..blender.process import client

    tables = load_tables(options.techniques)
    width, height = options.resolution or (None, None)
    first, most = plan.first_and_most_points(options)
    picture = child_job(PictureOptions, options, passes=PASSES, sub_samples=most, shadows="on", cycles_samples=2)
    job = child_job(
        client.ExtractOptions,
        picture,
        **scene_and_layer,
        width=width,
        height=height,
        seconds=options.budget,
        sub_samples=first,
        reserve=plan.FIRST_DENOISING_SECONDS / 1e6,
        cycles_samples=0,
        for_finished=True,
        edge_points=EDGE_POINTS,
    )
    extraction = client.extract(job, progress=progress)
    clock.end("extraction", extraction.processor_seconds)
    if not extraction.lights or extraction.left_to_cycles.everything:
        return Comparison(picture, extraction, {}, None)
    with ShadowTracer(extraction.occluders, extraction.lights, extraction.origin) as tracer:
        shader = DirectLightShader(picture, options.budget, tables, tracer)
        opening = extraction.processor_seconds - extraction.direct_seconds
        chosen = shader.planned(extraction, seconds_left(extraction), clock.seconds() - opening)
        clock.end("choice")
        if chosen.reason:
            cycles = extraction.left_to_cycles
            cycles = replace(cycles, everything=(*cycles.everything, chosen.reason))
            return Comparison(picture, replace(extraction, left_to_cycles=cycles), {}, None)
        points = chosen.points_per_pixel
        if points > extraction.film.sub_samples:
            extraction = client.extract(replace(job, sub_samples=points, seconds=None), progress=progress)
            clock.end("extraction", extraction.processor_seconds)
        extraction = client.ended(client.with_points(extraction, points))
        clock.end("extraction")
        shadows = shader.shadows(extraction, progress)
        clock.end("shadows")
        comparison = shader.shaded(extraction, shadows, progress)
        clock.end("shading")
        if extraction.finer is not None:
            direct_seconds = clock.stages["shadows"] + clock.stages["shading"]
            more = plan.edge_samples(seconds_left(extraction), direct_seconds)
            comparison = shader.with_edge_points(comparison, more, progress)
            clock.end("edges")
    return comparison


@dataclass(frozen=True)
class DirectLightShader:
    """Shades the direct light of one scene."""

    options: PictureOptions
    budget: float | None
    tables: dict
    tracer: ShadowTracer

    def shadows(self, extraction, progress=None) -> Shadows:
        """The visibility of the lights from the samples. Points of a pixel with about the same view share rays."""
        samples, film, index = extraction.samples, extraction.film, slice(None)
        if not extraction.has_lens:
            samples, film, index = with_one_shadow(samples, film)
        # Lights of one name, such as the sides of a sky, have common rays.
        pairs = film.coverage().sum() * len({light.name for light in extraction.lights})
        rays = rays_of_samples(plan.shadow_rays(self.options.shadow_rays, self.budget, pairs), film)
        return self.tracer.trace(samples, ShadowSampling(PASSES, rays, film), progress=progress).take(index)

    def shaded(self, extraction, shadows: Shadows, progress=None) -> Comparison:
        """The samples of an extraction, shaded with these shadows."""
        results = evaluated(self.tables, extraction, shadows, self.options, progress)
        return Comparison(self.options, extraction, results, shadows)

    def planned(self, extraction, seconds_left: float | None, sampling_seconds: float) -> plan.DirectLightPlan:
        """The plan by samples of the first points of each pixel, which took `sampling_seconds`, and by probes."""
        from ..blender.process import client

        film = extraction.film
        merged = client.with_points(extraction, film.sub_samples)
        measured = plan.SceneMeasurements(
            budget=self.budget,
            seconds_left=seconds_left,
            sampling_seconds=sampling_seconds,
            # Cycles will read the scene in half the time that was needed here, and render what shines in sight.
            cycles_seconds=0.5 * extraction.direct_seconds + client.EDGE_SECONDS * film.width * film.height / 1e6,
            points=film.sub_samples,
            most_points=self.options.sub_samples,
            samples_of_one_point=np.count_nonzero(extraction.point == 0),
            samples=len(merged.samples),
            has_lens=extraction.has_lens,
        )
        while (chosen := plan.direct_light_plan(measured)).probe_share > 0.0:
            probe = self.probe(merged, chosen.probe_share)
            measured = replace(measured, probes=(*measured.probes, probe))
        return chosen

    def probe(self, extraction, share: float) -> plan.Probe:
        """Shades a few random squares of the picture that have a `share` of its samples."""
        from ..blender.process import client

        film, start = extraction.film, time.process_time()
        row, column = np.divmod(film.pixel, film.width)
        square = row // SQUARE * film.width + column // SQUARE
        order = np.random.default_rng(round(1.0 / share)).permutation(film.width * film.height)
        count = np.cumsum(np.bincount(square, minlength=len(order))[order])
        chosen = np.isin(square, order[: 1 + np.searchsorted(count, share * len(square))])
        squares = replace(extraction, samples=extraction.samples.take(chosen), film=film.take(chosen))
        squares = client.ended(squares)
        comparison = self.shaded(squares, self.shadows(squares))
        (technique, result), *_ = comparison.results.items()
        variance, _ = point_statistics(squares.film, radiance_of_samples(squares, result, "specular"))
        variance = variance[~squares.left_to_cycles.by_pass["specular"]].sum()
        light = {name: comparison.images[technique, name].mean(axis=-1) for name in PASSES}
        total, squared = sum(light.values()).sum(), np.square(sum(light.values())).sum()
        samples, seconds = int(np.count_nonzero(chosen)), time.process_time() - start
        if not total > 0.0:
            return plan.Probe(samples, seconds)
        clean = sum((clean_share(comparison.shadows, name) * light[name]).sum() for name in PASSES)
        return plan.Probe(samples, seconds, float(np.sqrt(variance / squared)), float(clean / total))

    def with_edge_points(self, comparison: Comparison, more: float, progress) -> Comparison:
        """The same with more points for the pixels that edges of diffuse light run through, of shadows or of objects.

        There are at most `more` times as many new samples as samples.
        """
        extraction, film = comparison.extraction, comparison.film
        light = comparison.images[next(iter(comparison.results)), "diffuse"].mean(axis=-1)
        curvature = (light_curvature(light) * clean_share(comparison.shadows, "diffuse")).ravel()
        covered = np.minimum(film.coverage(), 1.0).ravel()
        by_cycles = extraction.left_to_cycles.by_pass["diffuse"].ravel()
        pixel = np.flatnonzero((curvature > 0.0) & ~by_cycles & (covered > 0.0))
        if len(pixel) > MOST_EDGES * len(curvature):
            return comparison
        points = plan.points_of_edges(curvature[pixel], covered[pixel], more * len(film.pixel))
        is_finer = points > film.sub_samples
        if not is_finer.any():
            return comparison
        pixels = {"pixel": pixel[is_finer], "number": points[is_finer]}
        samples, fine_film, replaced = self.tracer.finer(extraction.samples, film, extraction.finer, pixels)
        if len(samples) == 0:
            return comparison
        fine = replace(extraction, samples=samples, film=fine_film)
        sampling = ShadowSampling(PASSES, SHADOW_RAYS[0], fine_film)
        shadows = self.tracer.trace(samples, sampling, progress=progress)
        return comparison.with_more(~replaced, self.shaded(fine, shadows, progress))
