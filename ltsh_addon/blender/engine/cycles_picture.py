"""The Cycles picture that a view can show beside its own."""

import functools
import hashlib
from dataclasses import dataclass

import gpu
import numpy as np

from ...imaging.exr import read_channels
from ...imaging.report import index_stamp
from ...scene import CYCLES
from ..ui import results
from ..ui.job import output_folder
from ..viewport.drawing import float_texture
from ..viewport.meshes import look_values
from .overlay import Rectangle

# Shares by which the shapes of two pictures may differ: sizes are whole pixels.
SAME_SHAPE = 0.01


@dataclass(frozen=True)
class Reference:
    """A Cycles picture: `pixels` (H, W, 3) in W m^-2 sr^-1, row 0 on top, in `frame` of the region."""

    pixels: np.ndarray
    frame: Rectangle
    stamp: tuple  # changes when the picture is made again


def reference_of(context, scene, passes: str, projection: np.ndarray) -> Reference | str:
    """The Cycles picture of what the region of `context` shows, or why there is none."""
    result = _comparison_of(scene)
    if result is None:
        return "There is no Cycles picture of this scene: press Compare with Cycles"
    space, report = context.space_data, result.report
    camera = space.camera if space.use_local_camera else scene.camera
    if camera is None or context.region_data.view_perspective != "CAMERA":
        return "The Cycles picture is the camera's: look through the camera"
    if camera.name != report.get("camera"):
        return f"The Cycles picture is that of camera {report.get('camera')!r}, this is {camera.name!r}"
    if scene.frame_current != report.get("frame"):
        return f"The Cycles picture is that of frame {report.get('frame')}, this is {scene.frame_current}"
    files = result.groups[""]["files"]
    layer = f"{CYCLES}.{passes}"
    if layer not in files:
        return f"The Cycles picture has no {passes} pass: compare with that pass"
    region = context.region
    frame = camera_frame(camera, scene, projection, (region.width, region.height))
    width, height = report["resolution"]
    aspect = width * report["pixel_aspect"] / height
    if report["border"] is not None or abs(aspect * (frame[3] - frame[1]) / (frame[2] - frame[0]) - 1.0) > SAME_SHAPE:
        return "The Cycles picture does not fill the camera's frame: compare again without render region"
    path = result.folder / files[layer]
    pixels = _pixels(path, path.stat().st_mtime_ns, report["exposure"])
    return Reference(pixels, frame, (str(result.folder), *index_stamp(result.folder)))


def _comparison_of(scene) -> results.Result | None:
    """The results with a Cycles picture: those that are shown, or the last ones of the command."""
    last = results.folder_of(scene, "compare", output_folder(scene, "compare") / "images")
    for result in (results.result_of(scene), results.result_in(str(last))):
        if result is not None and "" in result.groups and CYCLES in result.groups[""]["names"]:
            return result
    return None


@functools.lru_cache(maxsize=1)
def _pixels(path, changed: int, exposure: float) -> np.ndarray:
    """The picture in the file `path`, last `changed` then, without the exposure. Raises OSError, ValueError."""
    channels = read_channels(path)
    return np.stack([channels[letter] for letter in "RGB"], axis=-1) / exposure


def camera_frame(camera, scene, projection: np.ndarray, size: tuple[int, int]) -> Rectangle:
    """Where what `camera` renders is seen in a region of `size` whose `projection` (4, 4) is from the world."""
    corners = [camera.matrix_world @ corner for corner in camera.data.view_frame(scene=scene)]
    clip = np.array([projection @ [*corner, 1.0] for corner in corners])
    x, y = ((0.5 + 0.5 * clip[:, axis] / clip[:, 3]) * size[axis] for axis in (0, 1))
    return x.min(), y.min(), x.max(), y.max()


def averaged(image: np.ndarray, frame: Rectangle, size: tuple[int, int]) -> np.ndarray:
    """`image` (H, W, C), row 0 on top, stretched over `frame`: (height, width, C + 1) of pixels of the size `size`
    (width, height), row 0 at the bottom.

    Each pixel has the mean of `image` over the pixel's area; the last channel is 1 inside the frame and 0 outside.
    """
    left, bottom, right, top = frame
    whole = np.concatenate([image[::-1], np.ones((*image.shape[:2], 1))], axis=-1)
    for axis, (start, end, count) in enumerate(((bottom, top, size[1]), (left, right, size[0]))):
        edges = (np.arange(count + 1) - start) / (end - start) * whole.shape[axis]
        whole = _mean_between(whole, edges, axis)
    # Pixels that the frame cuts would be too dark.
    whole[whole[..., -1] < 1.0 - 1e-6] = 0.0
    whole[..., -1] = np.rint(whole[..., -1])
    return whole


def _mean_between(values: np.ndarray, edges: np.ndarray, axis: int) -> np.ndarray:
    """Means of the steps `values` along `axis` between neighbors of `edges`; outside the values it is zero."""
    values = np.moveaxis(values, axis, 0)
    count = len(values)
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0, dtype=np.float64)])
    inside = np.clip(edges, 0.0, count)
    lower = np.minimum(inside.astype(int), count - 1)
    share = (inside - lower).reshape(-1, *([1] * (values.ndim - 1)))
    at_edges = sums[lower] + share * values[lower]
    width = np.diff(edges).reshape(-1, *([1] * (values.ndim - 1)))
    return np.moveaxis(np.diff(at_edges, axis=0) / width, 0, axis)


class ReferenceTexture:
    """The texture of a reference in one view; made again when view or picture change."""

    def __init__(self):
        self._pixels = self._placement = self._texture = None

    def of(self, reference: Reference, size: tuple[int, int]) -> gpu.types.GPUTexture:
        """RGBA of `size` pixels, alpha 0 outside the camera's frame; needs an active GPU context."""
        placement = reference.frame, size
        if reference.pixels is not self._pixels or placement != self._placement:
            self._texture = float_texture(averaged(reference.pixels, *placement))
            self._pixels, self._placement = reference.pixels, placement
        return self._texture


# Stamp of a reference -> content of the scene when it was first shown.
_content: dict[tuple, str] = {}


def content(mirror) -> str:
    """A digest of what the scene mirror `mirror` shows: lights, places, sizes and materials."""
    digest = hashlib.blake2b(digest_size=16)
    for light in mirror.lights:
        digest.update(repr(light.record()).encode())
    for instance in mirror.instances:
        digest.update(np.array(instance.model).tobytes())
        digest.update(repr((instance.mesh.triangles, instance.receiver)).encode())
        digest.update(instance.mesh.middle.tobytes())
        for lobe in (lobe for shown in instance.looks for lobe in shown.look.lobes):
            digest.update(look_values(lobe).tobytes())
    return digest.hexdigest()


def is_outdated(reference: Reference, now: str) -> bool:
    """Is the `content` of the scene `now` another one than when `reference` was first shown?"""
    return _content.setdefault(reference.stamp, now) != now
