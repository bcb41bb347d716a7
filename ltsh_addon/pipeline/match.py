"""`match`: powers and colors of lights for which the scene looks like a target picture.

Radiance is linear in that of each light. The finished picture is a sum of one picture per light and of what depends on
none; the factors of these pictures are those of non-negative least squares (Lawson and Hanson 1974, chapter 23).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import imaging
from ..files import temporary_folder, write_bytes
from ..imaging.color import luminance
from ..imaging.exr import group_names, parse_layer_name
from ..scene import Progress, SceneError, listed
from .lighting import light_groups, prepare
from .options import MatchOptions, RenderOptions, child_job
from .picture import view_transformed
from .render import Finished, finish
from .tasks import TaskResult, check_before_writing, write_reports

# PIXELS: of the pictures of the lights, at most; targets with more are reduced.
PIXELS = 480 * 270
# STEADY: the weight of the present factors, relative to the target's. It holds lights that give next to nothing.
STEADY = 1e-6
# SQUARE: pictures are compared by the means of squares of so many pixels on a side: edges that lie differently within
# pixels would count as light otherwise (errors of powers 2.4 % in place of .6 % in a room of eight lights).
SQUARE = 5
# LEAST_SHARE: of lights with less of the picture's light a target hardly tells the power: the report says so.
LEAST_SHARE = 0.005
FEWEST = 100  # pixels of a target
NOT_TOLD = "less than {1:.1f} % of the picture is light of {0}: the target hardly tells its power"


@dataclass(frozen=True)
class LightFactors:
    """What the target says of the lights."""

    factors: np.ndarray  # (R, 3), by which the radiance of each row is multiplied
    shares: np.ndarray  # (R,) of the light of the picture as it is
    before: float  # relative error of the picture, weighted as it is minimized
    after: float


def non_negative_least_squares(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The x (N,) without negative values for which |matrix x - target|^2 is least; matrix (M, N), target (M,).

    Lawson and Hanson 1974, algorithm NNLS (23.10), by the normal equations: N is small and M large.
    """
    normal, right = matrix.T @ matrix, matrix.T @ target
    count = len(right)
    x, is_free = np.zeros(count), np.zeros(count, bool)
    tolerance = 1e-12 * max(np.abs(right).max(initial=0.0), 1e-300)
    for _ in range(3 * count):
        gradient = right - normal @ x
        if is_free.all() or gradient[~is_free].max() <= tolerance:
            break
        is_free[np.argmax(np.where(is_free, -np.inf, gradient))] = True
        while True:
            step = np.zeros(count)
            step[is_free] = np.linalg.lstsq(normal[np.ix_(is_free, is_free)], right[is_free], rcond=None)[0]
            if step[is_free].min(initial=0.0) >= 0.0:
                x = step
                break
            # Go as far as no value becomes negative; the first that becomes 0 stays there.
            falls = is_free & (step < 0.0)
            ratio = np.where(falls, x / np.where(falls, x - step, 1.0), np.inf)
            x = x + ratio.min() * (step - x)
            is_free &= ratio > ratio.min()
            x[~is_free] = 0.0
    return x


def matched_factors(
    layers: np.ndarray, fixed: np.ndarray, target: np.ndarray, weights: np.ndarray, *, colors: bool = False
) -> LightFactors:
    """The factors of `layers` (R, H, W, 3) with which they and `fixed` (H, W, 3) come closest to the `target`.

    The `weights` (H, W) count pixels. Errors are relative to the target's luminance, where it is above its mean, and
    else to this mean. Each layer has one factor, with `colors` one for each channel.
    """
    count = _sums(weights, (0, 1))
    layers, fixed, target = (
        in_squares(image, weights).reshape(*image.shape[:-3], -1, 3)[..., count.ravel() > 0.0, :]
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
        return non_negative_least_squares(np.vstack([matrix, steady]), np.concatenate([rest, steady.sum(axis=1)]))

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


def in_squares(image: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means of `image` (..., H, W, C) over squares, weighted by `weights` (H, W)."""
    total = np.maximum(_sums(weights, (0, 1)), 1e-30)
    return _sums(image * weights[..., None], (-3, -2)) / total[..., None]


def _sums(values: np.ndarray, axes: tuple[int, int]) -> np.ndarray:
    """Sums over squares of SQUARE on a side along two `axes`."""
    for axis in axes:
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], SQUARE), axis)
    return values


def match_scene(options: MatchOptions, progress: Progress | None = None) -> dict:
    """Write matched.blend, a copy of the scene whose lights fit the target, match.png (before, after, target), and
    report.json. Returns the report.

    Raises SceneError for a target or mask that does not fit, TableError, OSError, Cancelled.
    """
    from ..blender.process.blender_process import shared_blender
    from ..blender.process.match import LightsJob, TargetJob, read_target, save_lights

    prepare(options)
    with temporary_folder() as folder, shared_blender(folder):
        paths = options.target.absolute(), options.mask and options.mask.absolute()
        job = child_job(TargetJob, options, target=paths[0], mask=paths[1])
        target, weights = read_target(job, folder, progress)
        # Of a pixel of which some is clipped or masked, the rest tells nothing about the mean.
        is_whole = reduced((weights > 0.0).astype(np.float64)) > 0.999
        target, weights = reduced(target), np.where(is_whole, reduced(weights), 0.0)
        if (telling := np.count_nonzero(weights)) < FEWEST:
            raise SceneError(
                f"{options.target}: {telling} pixels tell anything, expected {FEWEST} or more: the others are clipped "
                "or outside of the mask"
            )
        height, width = weights.shape
        settings = {"own_groups": options.lights, "resolution": (width, height)}
        picture = finish(child_job(RenderOptions, options, **settings), progress)
        groups, layers, fixed = light_layers(picture)
        if not groups:
            raise SceneError(f"{options.scene}: no light of the picture can be changed, expected light objects")
        result = matched_factors(layers, fixed, target, weights, colors=options.colors)
        pictures = [fixed + layers.sum(axis=0), fixed + np.einsum("rhwc,rc->hwc", layers, result.factors), target]
        sheet = np.concatenate([np.concatenate(pictures, axis=1), np.ones((height, 3 * width, 1))], axis=-1)
        png = view_transformed(sheet, options, folder, progress)
        check_before_writing(progress)
        factors = dict(zip(groups, result.factors.tolist(), strict=True))
        path = Path(options.output) / "matched.blend"
        lights = save_lights(child_job(LightsJob, options, path=path, factors=factors), progress)
    write_bytes(Path(options.output) / "match.png", png)
    shares = dict(zip(groups, result.shares.tolist(), strict=True))
    lights = [{**light, "share": shares[light.pop("group")]} for light in lights]
    weak = [repr(light["name"]) for light in lights if light["share"] < LEAST_SHARE]
    warnings = [NOT_TOLD.format(listed(weak), 100.0 * LEAST_SHARE)] if weak else []
    report = {
        "target": str(options.target),
        "resolution": [width, height],
        "pixels": telling,
        "lights": lights,
        "error_before": result.before,
        "error_after": result.after,
        "warnings": imaging.grouped([*picture.report["warnings"], *warnings]),
        "files": ["matched.blend", "match.png"],
    }
    return write_reports(TaskResult(report, picture.seconds, tuple(report["files"])), options.output)


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
    return groups, np.stack([images[group] for group in groups]) if groups else np.zeros(0), images[""]


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
    lines = [
        f"{light['name']:<24} {light['power_before']:10.4g} W -> {light['power_after']:10.4g} W   "
        f"{100.0 * light['share']:5.1f} % of the picture"
        for light in report["lights"]
    ]
    return [*lines, f"error {100.0 * report['error_before']:.2f} % -> {100.0 * report['error_after']:.2f} %"]
