"""Bakes: the texels of objects, shaded block by block into the files of `bake_files`, and the report about them."""

import functools
import itertools
import math
import shutil
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import PurePosixPath

import numpy as np

from ..cycles import uv
from ..cycles.texels import NOT_BAKED, BakeMaterial, BakeView, TexelMesh, light_bend, texel_guides, texel_samples
from ..files import temporary_folder
from ..imaging import exr, grouped
from ..imaging.denoise import DENOISER
from ..imaging.exr import COMBINED, REST, layer_name
from ..imaging.seams import SeamFit, TexelGrid, islands_of
from ..reading import Malformed, check, file_name
from ..scene import REFERENCE, Cancelled, Film, Progress, SurfaceSamples, lights_of
from ..visibility import Occluders, ShadowSampling
from ..workers.pool import cores
from . import bake_files, lighting, lightmap
from .lighting import check_named, prepare
from .mixer import rows_of_groups
from .options import BAKE_PASSES, BakeOptions, child_job, passes, size
from .tasks import TaskResult, file_stems, versions, write_reports

# NOTED_SHARE_OUTSIDE: a larger share of the UV map outside of the texture is reported. Less may come from texels along
# the border, which count by their centers.
NOTED_SHARE_OUTSIDE, NOTED_SHARE_DOUBLE = 0.01, 0.001
# BLOCK_TEXELS: texels that a thread shades at a time. The allocator reuses arrays of this size; larger ones would be
# new memory each time.
BLOCK_TEXELS = 1 << 18
# With bounces, texels at the edges of shadows get EDGE_POINTS: there light bends by more than EDGE of its root mean
# square from one texel to the next ones. At most MOST_EDGES of the texels do, those where it bends most.
EDGE, EDGE_POINTS, MOST_EDGES = 0.05, 16, 0.125


def bake_scene(options: BakeOptions, progress: Progress | None = None) -> dict:
    """Bake the objects of a scene: OUT/<object>.exr (<object>.<tile>.exr with several tiles), report.json, timing.json.

    Returns the report, with the times under "seconds". An object that cannot be baked is named in the report under
    "problems"; the others are baked all the same. Only timing.json depends on the machine's speed. Raises SceneError,
    TableError, OSError, Cancelled, ValueError.
    """
    result = bake_objects(options, progress)
    report = result.report
    if options.apply and report["objects"]:
        layer = bake_files.applied_layer(options)
        report["applied"] = bake_files.apply_textures(options.scene, options.output, report, layer, progress)
    if options.export and report["objects"]:
        layers = bake_files.exported_layers(options)
        report["exported"] = bake_files.export_glb(options.scene, options.output, report, layers, progress)
    return write_reports(result, options.output)


def bake_objects(
    options: BakeOptions, progress: Progress | None = None, *, tile: int | None = None, following: tuple[str, ...] = ()
) -> TaskResult:
    """Bake the objects and write their files, but no report.json; `tile` is the only UDIM tile to bake, None: all.

    Within `shared_blender` the scene stays open for the next call with the same options, for the objects named here and
    those announced as `following`. Raises as `bake_scene` does.
    """
    from ..blender.process.bake import extract_bake
    from ..blender.process.blender_process import check_readable

    start = time.perf_counter()
    _check(options)
    check_readable(options.scene)
    check_named(options.techniques, "a bake that is resumed")
    tables = prepare(options)
    with temporary_folder() as folder:
        manifest = extract_bake(_job(options, tile, following), folder, progress=progress)
        names = [record["name"] for record in manifest["objects"]]
        stems = file_stems(names) if options.name is None else [options.name]
        records, files, seconds = [], [], {"blender": manifest["seconds"]}
        with _shadow_tracer(options, manifest, folder) as tracer:
            for record, stem in zip(manifest["objects"], stems, strict=True):
                if record["folder"]:
                    (options.output / stem).parent.mkdir(parents=True, exist_ok=True)
                    baker = ObjectBaker(options, tables, manifest, record, folder / record["folder"], tracer)
                    baked = baker.bake(stem, [] if tile is None else [tile], progress)
                    records.append(baked.report)
                    files += baked.files
                    seconds |= baked.seconds
                    shutil.rmtree(folder / record["folder"])
    document = _report(options, manifest, records)
    seconds["total"] = time.perf_counter() - start
    return TaskResult(document, seconds, tuple(files))


def _shadow_tracer(options, manifest, folder):
    """A context with the ShadowTracer; it gives None where shadows are off."""
    if manifest["occluders"] is None:
        return nullcontext()
    lights = lightmap.crisp_and_soft(lights_of(manifest["lights"]), options)[0]
    return lighting.ShadowTracer(Occluders.load(folder / manifest["occluders"]), lights)


def _check(options: BakeOptions) -> None:
    size("x".join(map(str, options.size)))
    passes(BAKE_PASSES)(",".join(options.passes))
    if options.bounces == "on" and options.shadows == "off":
        raise ValueError(
            "bounces are on and shadows off, expected both, since bounced light has shadows: leave out one"
        )


def _job(options, tile=None, following=()):
    from ..blender.process.bake import BakeJob

    return child_job(
        BakeJob,
        options,
        width=options.size[0],
        height=options.size[1],
        block_rows=block_rows(options),
        cycles_samples=options.cycles_samples if options.error else 0,
        passes=passes_of_cycles(options),
        tile=tile,
        following=following,
        rest_passes=lightmap.rest_passes(options.passes),
        rest_rows=lightmap.rest_rows(options.size),
    )


def block_rows(options) -> int:
    """Rows of texels that are baked at a time."""
    width, height = options.size
    return max(1, min(height, BLOCK_TEXELS // width))


def shaded_passes(options) -> set[str]:
    """The passes of `shading.shade` from which the wanted passes follow; `diffuse_light` is shaded apart."""
    both = {"specular", "diffuse"}
    return both if COMBINED in options.passes else both & set(options.passes)


def passes_of_cycles(options) -> tuple[str, ...]:
    """The passes of Cycles' bake from which the wanted passes follow."""
    wanted = {*shaded_passes(options), *options.passes} - {COMBINED}
    return tuple(name for name in BAKE_PASSES if name in wanted)


class ObjectBaker:
    """Bakes the tiles of one object, the `record` of the `manifest`, in blocks of rows from the bottom."""

    def __init__(self, options, tables, manifest, record, folder, tracer=None):
        self.options, self.tables, self.manifest, self.record, self.folder = options, tables, manifest, record, folder
        lights = lights_of(manifest["lights"])
        self.lights, self.soft_lights = lightmap.crisp_and_soft(lights, options)
        self.tracer = tracer
        self.mesh = TexelMesh.load(folder / "mesh.npz")
        uv_maps = {name: folder / file for name, file in record["uv_maps"].items()}
        self.materials = [BakeMaterial.of(material, folder.parent, uv_maps) for material in record["materials"]]
        self.view = BakeView(**manifest["view"])
        self.groups = lighting.light_groups(self.lights)
        self.tiles, self.area = uv.tiles_of(self.mesh.uv)
        self.compared, self._trace_progress = options.passes if options.error else (), None

    def bake(self, stem: str, tiles: list[int], progress) -> TaskResult:
        """Write the files of `tiles` (empty: all tiles). The report is the object's entry in the whole report."""
        files, seconds = [], {}
        result = {"name": self.record["name"], "uv": self.record["uv"], "outside": 0.0, "tiles": {}}
        if self.options.atlas is not None:
            result |= {"members": self.record["members"], "atlas": self.record["atlas"]}
        for tile in tiles or self.tiles:
            file = f"{stem}{self._suffix(tile)}.exr"
            start = time.perf_counter()
            report, written = self._tile(tile, stem, progress)
            seconds[file] = time.perf_counter() - start
            files += written
            result["tiles"][str(tile)] = {"file": file, **report}
            if self.area > 0.0:
                baked = report["covered_times"] / math.prod(self.options.size)
                result["outside"] = max(0.0, 1.0 - baked / self.area)
        return TaskResult(result, seconds, tuple(files))

    def _suffix(self, tile) -> str:
        return "" if len(self.tiles) == 1 else f".{tile}"

    def _tile(self, tile, stem, progress):
        """Write the files of one tile; returns its record and the names of the files."""
        options, file = self.options, f"{stem}{self._suffix(tile)}.exr"
        path = options.output / file
        errors, written = bake_files.ErrorSums(), [file]
        with bake_files.Planes(self.folder / f"planes_{tile}", self.channels(), *options.size) as planes:
            record = self._shade(tile, planes, errors, progress)
            pictures = None
            if self.compared:
                pictures = bake_files.ErrorPictures(*options.size, path, list(self.tables), list(self.compared))
                named = [str(PurePosixPath(file).with_name(name)) for name in pictures.names]
                record |= {"pictures": named, "errors": errors.report()}
                written += named
            texture = None
            if options.apply:
                record["texture"] = f"{stem}.{bake_files.applied_layer(options)}{self._suffix(tile)}.exr"
                texture = options.output / record["texture"], bake_files.applied_layers(options)
                written.append(record["texture"])
            half = [name for name in planes.names if "@" in name] if options.per_light else []
            planes.write(path, options.margin, (self._metadata(tile), half), pictures, texture)
        return record, written

    def _shade(self, tile, planes, errors, progress) -> dict:
        """Shade a tile block by block into `planes`; returns its counts of texels for the record."""
        options, covered, covers, overlaps, unshaded, unbaked, lit = self.options, 0, 0, 0, 0, 0, False
        is_unshaded = np.array([bool(reason) for reason in self.record["unshaded"]])
        of_members = np.zeros(len(self.record["members"]), np.int64)
        rows, height = block_rows(options), options.size[1]
        points, spread = options.sub_samples, TilePoints(self, tile, self._threads())
        facts, seams = self._take_bounces(spread, progress) if options.bounces == "on" else ({}, None)

        def shaded(task):
            return *task, self._block(spread, *task)

        self._tell(progress, "shade", 0.0)
        firsts, sums, is_refined = range(0, height, rows), {}, options.bounces == "on" and points < EDGE_POINTS
        if len(firsts) * points == 1:  # Nothing else tells how far a single block is.
            self._trace_progress = lambda _, share: self._tell(progress, "shade", share * (0.3 if is_refined else 0.9))
        tasks = ((first, point) for first in firsts for point in range(points))
        for number, (first, point, block) in enumerate(_in_order(shaded, tasks, self._threads())):
            sums = {name: sums[name] + values for name, values in block.items()} if point else block
            if point == points - 1:
                texels = spread.texels(first)
                planes_of = {name: values / points for name, values in sums.items()}
                if options.bounces == "on" and points < (2 if self.record["maps"] else EDGE_POINTS):
                    self._refine_edges(planes_of, spread, first)
                halves = self._add_cycles(planes_of, tile, first, texels)
                covered += len(texels.index)
                covers += texels.covers
                overlaps += texels.overlaps
                unbaked += texels.unbaked
                unshaded += int(is_unshaded[self.mesh.material[texels.triangle]].sum())
                of_members += np.bincount(self.mesh.object[texels.triangle], minlength=len(of_members))
                names = (layer_name(name, pass_name) for name in self.tables for pass_name in options.passes)
                lit = lit or any(planes_of[name].any() for name in names)
                planes.put(first, min(rows, height - first), texels, _channels(planes_of))
                for pass_name, (a, b) in halves.items():
                    errors.add_halves(pass_name, a, b)
                    for name in self.tables:
                        errors.add(name, pass_name, planes_of[layer_name(name, pass_name)], a, b)
            self._tell(progress, "shade", (number + 1) / (len(firsts) * points))
        counts = {"texels": covered, "covered_times": covers, "overlapping_texels": overlaps}
        if options.atlas is not None:
            counts["member_texels"] = dict(zip(self.record["members"], of_members.tolist(), strict=True))
        if seams is not None:
            planes.fit(seams, is_sum=options.per_light)
        return {**counts, "unshaded_texels": unshaded, "unbaked_texels": unbaked, "is_lit": lit, **facts}

    def _tell(self, progress, stage: str, share: float) -> None:
        """Report the share of a stage that is done. Raises Cancelled."""
        if progress is not None and progress(f"{stage} {self.record['name']}", share) is False:
            raise Cancelled("the bake was stopped")

    def _take_bounces(self, spread, progress) -> tuple[dict, SeamFit]:
        """Denoise the bounced light of the texels; returns entries of the tile's record, and what fits its seams."""
        width, height = self.options.size
        triangle, guides = np.full(height * width, -1), np.zeros((height * width, 6), np.float32)
        self._tell(progress, "denoise", 0.0)
        for first in range(0, height, block_rows(self.options)):
            texels, maps, _ = spread.at(first, 0)
            at, read_map = texels.index + first * width, _map_reader(maps, texels)
            triangle[at] = texels.triangle
            guides[at] = texel_guides(self.mesh, self.materials, texels, read_map)
        shape = height, width
        grid = TexelGrid.of(triangle.reshape(shape), spread.corners, self.mesh)
        guides = guides.reshape(*shape, 6)
        islands = islands_of(grid)
        spread.rest, denoiser = lightmap.denoised_rest(spread.rest, guides, islands, self.options.rest_samples)
        dull = (guides[..., :3].max(axis=-1) <= lightmap.DULL) & (grid.triangle >= 0)
        return {"denoiser": denoiser, "dull_texels": int(np.count_nonzero(dull))}, SeamFit(islands)

    def _refine_edges(self, images, spread, first) -> None:
        """Replace the layers `images` (Q, 3) of texels of a block at edges of shadows by those of more points."""
        index, width = spread.texels(first).index, self.options.size[0]
        if not len(index):
            return
        light = (images[layer_name(name, kind)] for name in self.tables for kind in self.options.passes)
        bend = np.max([light_bend(one, index, width) for one in light], axis=0)
        chosen = np.sort(np.argsort(-bend, kind="stable")[: int(MOST_EDGES * len(bend))])
        chosen = chosen[bend[chosen] > EDGE]
        if not len(chosen):
            return
        shaded = functools.partial(self._block, spread, first, chosen=chosen)
        images_of = _in_order(shaded, range(EDGE_POINTS), self._threads())
        sums = next(images_of)
        for more in images_of:
            sums = {name: sums[name] + values for name, values in more.items()}
        for name, values in sums.items():
            images[name][chosen] = values / EDGE_POINTS

    def _sampling(self, passes, first, texel, points) -> ShadowSampling:
        """How to find the shadows of samples of a block, of the texels `texel` (S,), with so many points each."""
        size = self.options.size
        film = Film(size[0], min(block_rows(self.options), size[1] - first), texel)
        return ShadowSampling(passes, lighting.rays_of_point(self.options.shadow_rays, points), film, is_baked=True)

    def _threads(self) -> int:
        """Blocks to shade at a time: one with the reference, whose shading of a block takes all cores itself."""
        return 1 if REFERENCE in self.tables.values() else cores()

    def channels(self) -> list[str]:
        """Names of the channels of the EXR, without the coverage."""
        names = [layer_name(name, pass_name) for name in self.tables for pass_name in self.options.passes]
        names += [of_group for name in names for of_group in exr.by_group(name, self.groups, self.groups)]
        if self.options.bounces == "on":
            names += [layer_name(REST, pass_name) for pass_name in self.options.passes]
        for pass_name in self.compared:
            images = [*exr.CYCLES_LAYERS, *(f"{exr.ERROR}{name}" for name in self.tables)]
            names += [layer_name(image, pass_name) for image in images]
        return [f"{name}.{letter}" for name in names for letter in "RGB"]

    def _block(self, spread, first, point, chosen=None) -> dict[str, np.ndarray]:
        """Layers (Q, 3) of the Q texels of a block, shaded at one point of each texel: of `sub_samples`, or of
        EDGE_POINTS for the `chosen` ones."""
        points = self.options.sub_samples if chosen is None else EDGE_POINTS
        texels, maps, weights = spread.at(first, point) if chosen is None else spread.at_edges(first, point, chosen)
        read_map = _map_reader(maps, texels)
        # Lights only say where specular lobes end.
        lights = self.lights if "specular" in shaded_passes(self.options) else ()
        samples, texel = texel_samples(self.mesh, self.materials, texels, read_map, self.view, lights)
        images, shadows, bounces, soft = {}, None, {}, {}
        if self.options.bounces == "on":
            color = _summed(samples.diffuse_albedo[None], texel, len(texels.index))[0]
            bounces, soft = spread.soft_light(first, texels, color)
            images = {layer_name(REST, name): bounces[name].sum(axis=0) for name in self.options.passes}
        if self.tracer is not None:
            passes = sorted({name.removesuffix("_light") for name in passes_of_cycles(self.options)})
            workers = 1 if self._threads() > 1 else None
            sampling = self._sampling(passes, first, texels.index[texel], points)
            told = self._trace_progress if chosen is None else None
            shadows = self.tracer.trace(samples, sampling, workers=workers, progress=told)
        for name, table in self.tables.items():
            for pass_name, radiance in self._passes(samples, texel, len(texels.index), table, shadows).items():
                layer = layer_name(name, pass_name)
                if pass_name in soft:
                    radiance[self.groups.index(self.soft_lights[0].group)] += soft[pass_name]
                whole = radiance.sum(axis=0)
                if bounces:
                    whole = whole + bounces[pass_name].sum(axis=0)
                    radiance = radiance + bounces[pass_name] if self.options.per_light else radiance
                images |= {layer: whole, **exr.by_group(layer, self.groups, radiance)}
        return images if weights is None else {name: values * weights[:, None] for name, values in images.items()}

    def _add_cycles(self, images, tile, first, texels) -> dict[str, np.ndarray]:
        """Add Cycles' bake and the signed errors to the `images` (Q, 3); returns the halves of `_halves`."""
        halves = self._halves(tile, first, texels)
        for pass_name, (a, b) in halves.items():
            mean = 0.5 * (a + b)
            for name, image in zip(exr.CYCLES_LAYERS, (mean, a, b), strict=True):
                images[layer_name(name, pass_name)] = image
            for name in self.tables:
                images[layer_name(f"{exr.ERROR}{name}", pass_name)] = images[layer_name(name, pass_name)] - mean
        return halves

    def _halves(self, tile, first, texels) -> dict[str, np.ndarray]:
        """Cycles' bake of the texels by pass: two independent halves (2, Q, 3)."""
        halves = {}
        for pass_name in passes_of_cycles(self.options) if self.compared else ():
            baked = np.load(self.folder / f"cycles_{pass_name}_{tile}_{first}.npy")
            halves[pass_name] = baked.reshape(2, -1, 3)[:, texels.index]
        if COMBINED in self.compared:
            halves[COMBINED] = halves["specular"] + halves["diffuse"]
        return {name: halves[name] for name in self.compared}

    def _passes(self, samples: SurfaceSamples, texel, count, table, shadows) -> dict[str, np.ndarray]:
        """Radiance (G, Q, 3) of the wanted passes of `count` texels."""
        radiance = {}
        wanted = tuple(sorted(shaded_passes(self.options), reverse=True))
        workers = 1 if self._threads() > 1 else None
        if wanted:
            shaded = lighting.shade_lights(samples, self.lights, table, wanted, (shadows,), workers=workers)[0]
            radiance = {name: _summed(getattr(shaded, name), texel, count) for name in wanted}
        if "diffuse_light" in self.options.passes:
            share = lightmap.diffuse_shares(samples.diffuse_albedo, texel)
            some = np.flatnonzero(share.any(axis=1))
            white = replace(samples.take(some), diffuse_albedo=share[some])
            shadows = None if shadows is None else shadows.take(some)
            (lit,) = lighting.shade_lights(white, self.lights, table, ("diffuse",), (shadows,), workers=workers)
            radiance["diffuse_light"] = _summed(lit.diffuse, texel[some], count)
        if COMBINED in self.options.passes:
            radiance[COMBINED] = radiance["specular"] + radiance["diffuse"]
        return {name: radiance[name] for name in self.options.passes}

    def _metadata(self, tile) -> dict[str, str]:
        options, view = self.options, self.view
        vector = ", ".join(f"{value:g}" for value in view.vector)
        views = {"above": "above the surface", "point": f"position {vector}", "direction": f"from direction {vector}"}
        return exr.metadata(
            options.scene,
            self.manifest["frame"],
            self.manifest["camera"],
            self.manifest["color_space"]["name"] or "Linear Rec.709",
            object=self.record["name"],
            uv=self.record["uv"],
            tile=str(tile),
            sub_samples=str(options.sub_samples),
            view=views[view.kind] + (", bent as in Cycles' bake" if view.bent else ""),
        )


class TilePoints:
    """The points of the texels of a tile: those of `UvTriangles.spread`, or those at which maps were baked."""

    def __init__(self, baker: ObjectBaker, tile: int, threads: int):
        options = baker.options
        self._options, self._folder, self._tile = options, baker.folder, tile
        self._mapped = baker.record["maps"]
        self._width = baker.manifest["sampled_texels"]
        self._triangles = uv.UvTriangles.in_tile(baker.mesh.uv, *options.size, uv.column_and_row(tile))
        self._at_centers = bakes_centers_alone(options, baker.record)
        self.rest, self._baked = {}, None
        if options.bounces == "on":
            self.rest, self._baked = lightmap.read_rest(
                baker.folder, tile, options, baker.groups, bool(baker.soft_lights)
            )
        # The points of a block are shaded one after another, so few blocks need to be cached.
        cached = functools.lru_cache(maxsize=2 + threads // options.sub_samples)
        self.texels, self._weights_of = cached(self._covered), cached(self._fitted_weights)

    def at(self, first: int, point: int):
        """One point of the Q texels of the block from row `first` on.

        Returns the texels at this point, the maps there (N, rows, W, 3; None without maps), and the weights (Q,) of
        the point, 1 on average (None: all points count alike).
        """
        texels = self.texels(first)
        count = self._options.sub_samples
        if not self._mapped:
            return self._triangles.spread(texels, point, count, self._width), None, None
        maps = np.load(self._file(first, point))
        if count == 1:
            return texels, maps, None
        positions = self._positions(texels, maps, first, point)
        return self._triangles.at(texels, positions), maps, self._weights_of(first).at(positions)

    def at_edges(self, first: int, point: int, chosen: np.ndarray):
        """As `at` for one of EDGE_POINTS of the `chosen` texels of the block. Maps there are those of their centers."""
        texels = self.texels(first)
        some = texels.index[chosen], texels.triangle[chosen], texels.barycentric[chosen]
        texels = replace(texels, index=some[0], triangle=some[1], barycentric=some[2])
        maps = np.load(self._file(first, 0)) if self._mapped else None
        return self._triangles.spread(texels, point, EDGE_POINTS, self._width), maps, None

    @property
    def corners(self) -> np.ndarray:
        """The corners (T, 3, 2) of the triangles in the texture, in texels."""
        return self._triangles.corners

    def soft_light(self, first: int, texels, color: np.ndarray) -> tuple[dict, dict]:
        """`lightmap.of_passes` for the `texels` of the block from row `first` on, of the diffuse `color` (Q, 3)."""
        return lightmap.of_passes(self.rest, texels.index + first * self._options.size[0], color)

    def _covered(self, first):
        rows = min(block_rows(self._options), self._options.size[1] - first)
        texels = self._triangles.texels(first, rows, self._options.conservative and not self._at_centers)
        if not self._at_centers:
            return texels
        if self._baked is not None:
            return texels.baked(self._baked[first : first + rows].reshape(-1)[texels.index])
        path = self._file(first, 0)
        if not self._mapped:
            path = self._folder / f"cycles_{passes_of_cycles(self._options)[0]}_{self._tile}_{first}.npy"
        baked = np.load(path, mmap_mode="r")[0].reshape(-1, 3)[texels.index, 0] != np.float32(NOT_BAKED)
        return texels.baked(baked)

    def _file(self, first, point):
        return self._folder / f"maps_{self._tile}_{first}_{point}.npy"

    def _positions(self, texels, maps, first, point):
        """Positions (Q, 2) in the texture, in texels, at which the maps of a point were baked."""
        if point == 0:
            return self._triangles.places(texels)
        rows, width = maps.shape[1:3]
        return maps[-1].reshape(-1, 3)[texels.index, :2] * (width, rows) + (0, first)

    def _fitted_weights(self, first):
        texels, points = self.texels(first), range(self._options.sub_samples)
        maps = ((np.load(self._file(first, point), mmap_mode="r"), point) for point in points)
        positions = (self._positions(texels, of_point, first, point) for of_point, point in maps)
        return uv.PointWeights.of(self._triangles, texels, positions, self._width)


def bakes_centers_alone(options: BakeOptions, record: dict) -> bool:
    """True where an object needs Cycles' own bake, which has only texels whose centers are covered."""
    return record["maps"] or options.error or options.bounces == "on"


def _map_reader(maps, texels):
    """The function that returns map `number` (Q, 3) at the `texels`."""
    return lambda number: maps[number].reshape(-1, 3)[texels.index]


def _in_order(function, items, threads: int):
    """Yield function(item) in the order of `items`, computed by `threads` threads."""
    with ThreadPoolExecutor(threads) as pool:
        waiting, items = deque(), iter(items)
        try:
            for item in itertools.islice(items, threads):
                waiting.append(pool.submit(function, item))
            while waiting:
                result = waiting.popleft().result()
                for item in itertools.islice(items, 1):
                    waiting.append(pool.submit(function, item))
                yield result
        finally:
            for future in waiting:
                future.cancel()


def _channels(images) -> dict[str, np.ndarray]:
    """Channel values (Q,) by name, from images (Q, 3) of layers."""
    return {f"{name}.{letter}": pixels[:, n] for name, pixels in images.items() for n, letter in enumerate("RGB")}


def _summed(radiance, texel, count):
    """Radiance (G, count, 3) of texels: the sums over their samples (G, S, 3)."""
    if len(texel) == count:
        return radiance
    return np.add.reduceat(radiance, lightmap.first_samples(texel), axis=1)


def _report(options, manifest, records) -> dict:
    problems = [line for record in manifest["objects"] for line in record["problems"]]
    lines = [line for record in manifest["objects"] for line in record["warnings"]]
    warnings = [*manifest["warnings"], *lines]
    if options.conservative:
        warnings += [
            f"{record['name']!r}: texels whose centers no face covers are left out, because Cycles bakes none "
            f"of them: leave out {'--error' if options.error else '--conservative, or bake its textures to images'}"
            for record in manifest["objects"]
            if record["folder"] and bakes_centers_alone(options, record)
        ]
    reasons = {record["name"]: record.get("unshaded", ()) for record in manifest["objects"]}
    for record in records:
        wrong, note = bake_files.darkness(record, reasons[record["name"]])
        problems += wrong
        warnings += note
        name = f"object {record['name']!r}"
        if (share := 100 * record["outside"]) > 100 * NOTED_SHARE_OUTSIDE:
            warnings.append(f"{name}: {share:.3g} % of UV map {record['uv']!r} lies outside of the texture, not baked")
        for tile in record["tiles"].values():
            if (share := 100 * tile["overlapping_texels"] / max(tile["texels"], 1)) > 100 * NOTED_SHARE_DOUBLE:
                warnings.append(f"{name}: {share:.3g} % of its texels are covered more than once")
            if share := 100 * tile["unbaked_texels"] / max(tile["texels"] + tile["unbaked_texels"], 1):
                why = "because Cycles bakes nothing there: apply the modifiers"
                warnings.append(f"{name}: {share:.3g} % of its texels are left out, {why}")
            warnings += [
                f"object {member!r} has no texel of the atlas: its islands are too small, or lie below others"
                for member, texels in tile.get("member_texels", {}).items()
                if not texels
            ]
            if share := 100 * tile.get("dull_texels", 0) / max(tile["texels"], 1):
                why = "have no diffuse color: the light that bounces there is reflected, which no lightmap holds"
                warnings.append(f"{name}: {share:.3g} % of its texels {why}; bake the pass specular or combined")
            if not tile.get("denoiser", DENOISER).startswith(DENOISER):
                warnings.append(f"{name}: {tile['denoiser']}")
    report = {
        "scene": str(options.scene),
        "frame": manifest["frame"],
        "size": list(options.size),
        "sub_samples": options.sub_samples,
        "view": manifest["view"],
        "objects": records,
        "problems": problems,
        "warnings": grouped(warnings),
        "versions": versions(manifest["blender_version"]),
    }
    if options.per_light:
        rows = rows_of_groups(lights_of(manifest["lights"]), manifest["light_settings"])
        report |= {"light_rows": [asdict(row) for row in rows], "camera": manifest["camera"]}
    return report


def _tiles(value, name) -> None:
    check(value, {str: {**bake_files.TILE, "file": file_name}}, name)
    if wrong := [number for number in value if not number.isdecimal()]:
        raise Malformed(f"{name} has {wrong[0]!r}, expected the number of a tile")


# What `merge` and a summary need in a report (see `reading.check`).
REPORT = {
    "objects": [{"name": str, "uv": str, "tiles": _tiles}],
    **dict.fromkeys(("problems", "warnings"), [str]),
    "versions": dict,
}
