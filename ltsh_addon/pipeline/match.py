"""`match`: powers and colors of lights for which the scene looks like a target picture.

Radiance is linear in that of each light. The finished picture is a sum of one picture per light and of what depends on
none; the factors of these pictures are those of non-negative least squares (Lawson and Hanson 1974, chapter 23).
"""

import math
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import imaging, visibility
from ..files import temporary_folder, write_bytes
from ..imaging.color import luminance
from ..imaging.exr import group_names, parse_layer_name
from ..scene import Cancelled, Light, Progress, SceneError, listed
from . import light_search
from .lighting import light_groups, load_tables, prepare
from .options import MatchOptions, RenderOptions, child_job
from .picture import view_transformed
from .render import Finished, finish
from .tasks import TaskResult, check_before_writing, write_reports

# PIXELS: of the pictures of the lights, at most; targets with more are reduced.
PIXELS = 480 * 270
# STEADY: the weight of the present factors, relative to the target's. It holds lights that give next to nothing.
STEADY = 1e-6
# LEAST_SHARE: of lights with less of the picture's light a target hardly tells the power: the report says so.
LEAST_SHARE = 0.005
FEWEST = 100  # pixels of a target
# ROUNDS: of moving lights, at most. Each begins with a new picture, with the bounces of the lights where they are by
# then. A step smaller than STILL of a light's distance ends them.
ROUNDS, STILL = 3, 0.01
# FINE, COARSE: sides of squares in pixels, points in each, and rays of a point, with which lights are moved.
FINE, COARSE = (5, 4, 64), (12, 8, 32)
# STILL_OFF: the error of a picture from which on the report says that the lights may not be where the target's were.
STILL_OFF = 0.05
STILL_OFF_BY = (
    "the picture is still {:.1f} % off the target: lights that start nearer to where they should be may come closer; "
    "or the target shows what no light of this scene gives"
)
NOT_TOLD = "less than {1:.1f} % of the picture is light of {0}: the target hardly tells its power"


@dataclass(frozen=True)
class LightFactors:
    """What the target says of the lights."""

    factors: np.ndarray  # (R, 3), by which the radiance of each row is multiplied
    shares: np.ndarray  # (R,) of the light of the picture as it is
    before: float  # relative error of the picture, weighted as it is minimized
    after: float


def matched_factors(
    layers: np.ndarray, fixed: np.ndarray, target: np.ndarray, weights: np.ndarray, *, colors: bool = False
) -> LightFactors:
    """The factors of `layers` (R, H, W, 3) with which they and `fixed` (H, W, 3) come closest to the `target`.

    The `weights` (H, W) count pixels. Errors are relative to the target's luminance, where it is above its mean, and
    else to this mean. Each layer has one factor, with `colors` one for each channel.
    """
    count = light_search.sums_in_squares(weights, (0, 1))
    layers, fixed, target = (
        light_search.in_squares(image, weights).reshape(*image.shape[:-3], -1, 3)[..., count.ravel() > 0.0, :]
        for image in (layers, fixed, target)
    )
    weights = count[count > 0.0]
    mean = np.average(luminance(target), weights=weights)
    scale = np.sqrt(weights)[:, None] / np.maximum(luminance(target), mean)[:, None]
    scaled, wanted = scale * layers, scale * target
    steady = math.sqrt(STEADY) * np.linalg.norm(wanted) * np.eye(len(layers))

    def solved(channels) -> np.ndarray:
        matrix = scaled[..., channels].reshape(len(layers), -1).T
        rest = (wanted - scale * fixed)[:, channels].ravel()
        return light_search.non_negative_least_squares(
            np.vstack([matrix, steady]), np.concatenate([rest, steady.sum(axis=1)])
        )

    if colors:
        factors = np.stack([solved(slice(number, number + 1)) for number in range(3)], axis=-1)
    else:
        factors = np.repeat(solved(slice(0, 3))[:, None], 3, axis=1)

    def error(by) -> float:
        difference = np.einsum("rpc,rc->pc", scaled, by) + scale * fixed - wanted
        return float(np.linalg.norm(difference) / np.linalg.norm(wanted))

    light = np.einsum("rpc,p->r", layers, weights)
    shares = light / max(light.sum() + np.einsum("pc,p->", fixed, weights), 1e-30)
    return LightFactors(factors, shares, error(np.ones_like(factors)), error(factors))


def match_scene(options: MatchOptions, progress: Progress | None = None) -> dict:
    """Write matched.blend, a copy of the scene whose lights fit the target, match.png (before, after, target), and
    report.json. Returns the report.

    Raises SceneError for a target or mask that does not fit, TableError, OSError, Cancelled.
    """
    from ..blender.process.blender_process import shared_blender
    from ..blender.process.match import TargetJob, read_target

    prepare(options)
    with temporary_folder() as folder, shared_blender(folder):
        paths = options.target.absolute(), options.mask and options.mask.absolute()
        job = child_job(TargetJob, options, target=paths[0], mask=paths[1])
        target, weights, reasons = read_target(job, folder, progress)
        # Of a pixel of which some is clipped or masked, the rest tells nothing about the mean.
        is_whole = reduced((weights > 0.0).astype(np.float64)) > 0.999
        target, weights = reduced(target), np.where(is_whole, reduced(weights), 0.0)
        if (telling := np.count_nonzero(weights)) < FEWEST:
            raise SceneError(
                f"{options.target}: {telling} pixels tell anything, expected {FEWEST} or more: the others are clipped "
                "or outside of the mask"
            )
        height, width = weights.shape
        matching = _Matching(options, target, weights, reasons, folder, progress)
        before = now = matching.picture()
        for _ in range(options.add):
            matching.add(now)
            now = matching.picture()
        for number in range(ROUNDS if options.move or options.add else 0):
            largest = matching.move(now, number)
            now = matching.picture()
            if largest < STILL:
                break
        result = matched_factors(now.layers, now.fixed, target, weights, colors=options.colors)
        first = before.layers, before.fixed, target, weights
        error_before = result.before if now is before else matched_factors(*first, colors=options.colors).before
        pictures = [before.fixed + before.layers.sum(axis=0)]
        pictures += [now.fixed + np.einsum("rhwc,rc->hwc", now.layers, result.factors), target]
        sheet = np.concatenate([np.concatenate(pictures, axis=1), np.ones((height, 3 * width, 1))], axis=-1)
        png = view_transformed(sheet, options, folder, progress)
        check_before_writing(progress)
        matching.save(Path(options.output) / "matched.blend", dict(zip(now.groups, result.factors, strict=True)))
    write_bytes(Path(options.output) / "match.png", png)
    shares = dict(zip(now.groups, result.shares.tolist(), strict=True))
    lights = [{**light, "share": shares[light.pop("group")]} for light in matching.lights.values()]
    lights = [{**light, "power_before": 0.0} if light["name"] in matching.added else light for light in lights]
    weak = [repr(light["name"]) for light in lights if light["share"] < LEAST_SHARE]
    warnings = [NOT_TOLD.format(listed(weak), 100.0 * LEAST_SHARE)] if weak else []
    warnings += [f"light {name!r} keeps its place: {reason}" for name, reason in matching.staying.items()]
    if options.move and result.after > STILL_OFF:
        warnings.append(STILL_OFF_BY.format(100.0 * result.after))
    report = {
        "target": str(options.target),
        "resolution": [width, height],
        "pixels": telling,
        "lights": lights,
        "error_before": error_before,
        "error_after": result.after,
        "search": {"processor_s": matching.seconds},
        "warnings": imaging.grouped([*now.finished.report["warnings"], *warnings]),
        "files": ["matched.blend", "match.png"],
    }
    return write_reports(TaskResult(report, now.finished.seconds, tuple(report["files"])), options.output)


@dataclass(frozen=True)
class _Layers:
    """A finished picture, apart into what each group of lights gives it."""

    finished: Finished
    groups: list[str]  # R
    layers: np.ndarray  # (R, H, W, 3)
    fixed: np.ndarray  # (H, W, 3)


class _Matching:
    """A scene whose lights come closer to a target, from copy to copy."""

    def __init__(self, options: MatchOptions, target, weights, reasons: dict[str, str], folder: Path, progress):
        self.scene, self.lights, self.staying, self.seconds = Path(options.scene), {}, {}, 0.0
        self._options, self._target, self._weights, self._reasons = options, target, weights, reasons
        self._folder, self._progress, self.added = folder, progress, []

    @property
    def _names(self) -> tuple[str, ...]:
        """The lights that may change, () for all."""
        return (*self._options.lights, *self.added) if self._options.lights else ()

    def picture(self) -> _Layers:
        """The picture of the scene as it is now."""
        height, width = self._weights.shape
        settings = {"scene": self.scene, "own_groups": self._names, "resolution": (width, height)}
        picture = finish(child_job(RenderOptions, self._options, **settings), self._progress)
        groups, layers, fixed = light_layers(picture)
        if not groups and not self._options.add:
            raise SceneError(f"{self._options.scene}: no light of the picture can be changed, expected light objects")
        return _Layers(picture, groups, layers, fixed)

    def save(
        self,
        path: Path,
        factors: dict[str, np.ndarray],
        moves: dict[str, light_search.LightMove] | None = None,
        added: dict | None = None,
    ) -> None:
        """Save the scene with changed lights, and a new one of the record `added`, as `path`, and go on with that."""
        from ..blender.process.match import LightsJob, save_lights

        changes = {"path": path, "factors": {group: one.tolist() for group, one in factors.items()}}
        changes["moves"] = {group: move.record() for group, move in (moves or {}).items()}
        changes |= {"lights": self._names, "added": added}
        for light in save_lights(child_job(LightsJob, self._options, scene=self.scene, **changes), self._progress):
            former = self.lights.get(light["name"], light)
            if light["group"] == "":
                self.added.append(light["name"])
            self.lights[light["name"]] = {**light, **{key: former[key] for key in light if key.endswith("_before")}}
        self.scene = path

    def add(self, now: _Layers) -> None:
        """Add a light to the scene, where it brings the picture closest to the target."""
        start = time.process_time()
        with self._places(now) as places_of:
            places, layers, fixed = places_of(*COARSE)
            try:
                light = light_search.added_light(places, layers, fixed)
            except ValueError as error:
                raise SceneError(f"{self._options.scene}: {error}; lower --add") from error
        self.seconds += time.process_time() - start
        path = self._folder / f"added_{len(self.added)}.blend"
        self.save(path, dict.fromkeys(now.groups, np.ones(3)), added=light.record())

    def move(self, now: _Layers, number: int) -> float:
        """Search better places of the lights, in the first round from several starts; the largest step, relative to the
        distances of the lights."""
        start, extraction = time.process_time(), now.finished.comparison.extraction
        moving = self._moving(now.groups, extraction)
        if not moving:
            raise SceneError(f"{self._options.scene}: no light can be moved: " + "; ".join(
                f"{name!r}, {reason}" for name, reason in self.staying.items()))  # fmt: skip
        with self._places(now) as places_of:

            def search(side: int, points: int, rays: int) -> light_search.LightSearch:
                places, layers, fixed = places_of(side, points, rays)
                is_moving = np.isin(now.groups, list(moving))
                lights = [moving[group] for group in now.groups if group in moving]
                freedoms = [
                    light_search.LightFreedom(light, places.distance(light), self._options.sizes) for light in lights
                ]
                direct = np.array([places.picture(light) for light in lights])
                rest, others = layers[is_moving] - direct, layers[~is_moving]
                of_lights = tuple(freedoms), rest, others, fixed, direct.sum(axis=1)
                return light_search.LightSearch(places, *of_lights, self._options.colors)

            def report(share: float) -> None:
                if self._progress is not None and self._progress("search", share) is False:
                    raise Cancelled("stopped before the lights were placed")

            fine = search(*FINE)
            x = light_search.searched(search(*COARSE) if number == 0 else None, fine, progress=report)
            factors = np.stack(fine.factors(x), axis=-1)
        factors = np.broadcast_to(factors, (len(factors), 3))
        names = [group for group in now.groups if group in moving]
        ordered = [*names, *(group for group in now.groups if group not in moving)]
        moves = {name: one.move(part) for name, one, part in zip(names, fine.freedoms, fine.split(x), strict=True)}
        self.seconds += time.process_time() - start
        # A light without power would have no place in the next picture.
        self.save(
            self._folder / f"round_{number}.blend", dict(zip(ordered, np.maximum(factors, 1e-3), strict=True)), moves
        )
        return float(np.abs(x).max())

    @contextmanager
    def _places(self, now: _Layers):
        """Context with a function: for a side of squares, points in each and rays of a point, the samples there, and
        the means of the layers of `now`."""
        from ..blender.process.blender_process import embree_libraries

        if now.finished.report["finished"]["all_by_cycles"]:
            raise SceneError(
                f"{self._options.scene}: lights cannot be moved, because Cycles shades all direct light: "
                f"{listed(now.finished.report['finished']['all_by_cycles'], 4, '; ')}; leave out --move and --add"
            )
        extraction = now.finished.comparison.extraction
        (table,) = load_tables(self._options.techniques).values()
        weights = np.where(np.logical_or(*extraction.left_to_cycles.by_pass.values()), 0.0, self._weights)
        with visibility.open_tracer(extraction.occluders, embree_libraries()) as tracer:

            def places_of(
                side: int, points: int, rays: int
            ) -> tuple[light_search.TargetSamples, np.ndarray, np.ndarray]:
                places = light_search.TargetSamples.of(
                    extraction, self._target, weights, (side, points), (tracer, rays), table
                )
                return places, *(places.mean(image, weights, side) for image in (now.layers, now.fixed))

            yield places_of

    def _moving(self, groups: list[str], extraction) -> dict[str, Light]:
        """The lights that may move by their groups; notes why others may not."""
        moving = {}
        for group in groups:
            lights = [light for light in extraction.lights if light.group == group]
            names = sorted({light.name for light in lights})
            if not self._options.move and set(names).isdisjoint(self.added):
                continue
            reason = self._reasons.get(names[0], "") if names else ""
            if len(lights) > 1:
                reason = reason or "its data or object stands in several places"
            elif lights and (lights[0].children or lights[0].pattern is not None):
                reason = reason or "it has a texture"
            if lights and not reason:
                moving[group] = lights[0]
            self.staying |= dict.fromkeys(names, reason) if reason else {}
        return moving


def light_layers(picture: Finished) -> tuple[list[str], np.ndarray, np.ndarray]:
    """The light groups of a finished picture, their light (R, H, W, 3), and what is of no group (H, W, 3)."""
    rest = picture.relight_data["rest"]
    groups = sorted(group for group in rest if group)
    of_lights = light_groups(picture.comparison.extraction.lights)
    names = dict(zip(group_names(of_lights), of_lights, strict=True))
    images = {group: rest[group][..., :3].astype(np.float64) for group in ["", *groups]}
    for name, image in picture.ours.items():
        group = parse_layer_name(name)[2]
        if group or len(of_lights) == 1:
            images[names[group] if group else of_lights[0]] += image
    layers = [images[group] for group in groups]
    return groups, np.reshape(layers, (-1, *images[""].shape)), images[""]


def reduced(image: np.ndarray) -> np.ndarray:
    """`image` (H, W) or (H, W, C) with at most PIXELS pixels: means over areas of equal size."""
    height, width = image.shape[:2]
    factor = math.sqrt(PIXELS / (height * width))
    if factor >= 1.0:
        return image
    for axis, side in enumerate((height, width)):
        smaller = max(1, round(factor * side))
        sums = np.concatenate([np.zeros_like(image.take([0], axis)), np.cumsum(image, axis=axis)], axis=axis)
        bounds = np.linspace(0.0, side, smaller + 1)
        whole = np.minimum(bounds.astype(int), side - 1)
        share = (bounds - whole).reshape([-1 if axis == other else 1 for other in range(image.ndim)])
        at_bounds = (1.0 - share) * sums.take(whole, axis) + share * sums.take(whole + 1, axis)
        image = np.diff(at_bounds, axis=axis) * (smaller / side)
    return image


def summary(report: dict) -> list[str]:
    """A line for each light, and the errors."""
    lines = []
    for light in report["lights"]:
        way = np.linalg.norm(np.subtract(light["location_after"], light["location_before"]))
        lines.append(
            f"{light['name']:<24} {light['power_before']:10.4g} W -> {light['power_after']:10.4g} W   "
            f"{100.0 * light['share']:5.1f} % of the picture" + (f"   moved {way:.3g} m" if way > 0.0 else "")
        )
    return [*lines, f"error {100.0 * report['error_before']:.2f} % -> {100.0 * report['error_after']:.2f} %"]
