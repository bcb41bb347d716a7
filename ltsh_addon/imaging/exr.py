"""Multi-layer EXR files of 32-bit floats: the names of their layers, and how they are read and written.

Files are written atomically, as one part of scanlines with ZIP compression.
"""

import contextlib
import io
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files import replacing
from ..scene import CYCLES, VERSION

_DEFAULT_CHANNELS = {1: "V", 3: "RGB", 4: "RGBA"}
_CHANNEL_ORDERS = ("RGBA", "XYZW", "UVW")
_BLOCK_VALUES = 1 << 22
_ZIP_ROWS = 16  # rows that are compressed together
LARGEST_HALF = 65504.0
_LONGEST_NAME = 255  # bytes, OpenEXR's limit
_HEADER_BYTES = 1 << 22  # more than the header of a file with thousands of channels
_OF_THE_FORMAT = {"channels", "chromaticities", "compression", "dataWindow", "displayWindow", "lineOrder", "name",
                  "pixelAspectRatio", "type", "version"}  # fmt: skip
# COMBINED: the pass of whole pictures. REST: the layer of a finished picture that holds what is not LTSH's.
COMBINED, REST, TRANSMITTED = "combined", "rest", "transmitted"
# ERROR: prefix of a technique's name in the layers of its difference to Cycles. UNSHADOWED: suffix of a technique's
# name in the layers without shadows, where others have shadows.
ERROR, UNSHADOWED = "error_", "_unshadowed"
# CYCLES_LAYERS: Cycles' picture, and the two halves whose mean it is.
CYCLES_LAYERS = (CYCLES, f"{CYCLES}_A", f"{CYCLES}_B")
COVERAGE, GLASS = "coverage.hit", "coverage.glass"


def layer_name(technique: str, pass_name: str, group: str = "") -> str:
    """The name of a layer; `group` is one of `group_names`, "" for all light."""
    return f"{technique}.{pass_name}@{group}" if group else f"{technique}.{pass_name}"


def parse_layer_name(name: str) -> tuple[str, str, str]:
    """The technique, pass and light group ("" for all light) of a layer."""
    technique, _, rest = name.partition(".")
    pass_name, _, group = rest.partition("@")
    return technique, pass_name, group


def unique_names(names: Iterable[str]) -> list[str]:
    """`names` made unique for layers, with _ for the dots that separate the components of a layer's name."""
    unique: list[str] = []
    for name in names:
        plain = name.replace(".", "_")
        others = (f"{plain}_{number}" for number in itertools.count(2))
        unique.append(next(other for other in itertools.chain([plain], others) if other not in unique))
    return unique


def group_names(groups: Iterable[str]) -> list[str]:
    """Names of light groups in layers. The empty group becomes "ungrouped", or a longer name that is free."""
    groups, ungrouped = list(groups), "ungrouped"
    while ungrouped in groups:
        ungrouped += "_"
    return unique_names(group or ungrouped for group in groups)


def by_group(name: str, groups: Sequence[str], values: Iterable) -> dict:
    """The `values` of light groups by the names of their layers, beside the layer `name`; {} for a single group."""
    if len(groups) < 2:
        return {}
    technique, pass_name, _ = parse_layer_name(name)
    names = [layer_name(technique, pass_name, group) for group in group_names(groups)]
    return dict(zip(names, values, strict=True))


def metadata_of(extraction, scene: Path, **more: str) -> dict[str, str]:
    """`metadata` of a picture of an `Extraction`, which has its `exposure`."""
    facts = extraction.picture
    names = facts.frame, facts.camera, facts.color_space.name
    return metadata(scene, *names, exposure=repr(facts.exposure), **more)


def metadata(scene: Path, frame: int, camera: str, color_space: str, **more: str) -> dict[str, str]:
    """The metadata of an EXR; each of `more` gets the prefix "ltsh:"."""
    facts = {"scene": Path(scene).name, "frame": str(frame), "camera": camera, "color_space": color_space}
    return {f"ltsh:{name}": value for name, value in {**facts, "version": VERSION, **more}.items()}


@dataclass(frozen=True)
class Layer:
    """Pixels (H, W) or (H, W, C) and one letter per channel: ``Layer(position, "XYZ")``."""

    pixels: np.ndarray
    channels: str = ""  # "" means V, RGB or RGBA by the number of channels

    def planes(self, name: str) -> dict[str, np.ndarray]:
        """The planes (H, W) by full channel name; raises ValueError for a wrong shape or type."""
        pixels = np.asarray(self.pixels)
        if pixels.ndim not in (2, 3) or 0 in pixels.shape or pixels.dtype.kind not in "fiub":
            raise ValueError(
                f"layer {name!r}: an array of shape {pixels.shape} and type {pixels.dtype} was given, expected real "
                "numbers of shape (height, width) or (height, width, channels)"
            )
        pixels = pixels.reshape(*pixels.shape[:2], -1)
        count = pixels.shape[2]
        channels = self.channels or _DEFAULT_CHANNELS.get(count, "")
        if len(channels) != count or len(set(channels)) != count or "." in channels:
            raise ValueError(f"layer {name!r}: {count} channels need {count} different letters, found {channels!r}")
        return {f"{name}.{letter}": pixels[..., index] for index, letter in enumerate(channels)}


def write_layers(
    path: str | os.PathLike,
    layers: Mapping[str, np.ndarray | Layer],
    metadata: Mapping[str, str] | None = None,
    chromaticities: Sequence[float] | None = None,
    pixel_aspect: float = 1.0,
) -> None:
    """Write `layers` as channels ``<layer>.<letter>``; plain arrays of 1, 3 or 4 channels become V, RGB or RGBA.

    float32 values are kept bit for bit, NaN and Inf included. `metadata` becomes string attributes of the header.
    `chromaticities` (xy of red, green, blue and white) tell readers the color space; `pixel_aspect` is width / height
    of a pixel. Raises ValueError for layers that do not fit together, OSError when the file cannot be written.
    """
    planes: dict[str, np.ndarray] = {}
    for name, layer in layers.items():
        planes |= (layer if isinstance(layer, Layer) else Layer(layer)).planes(name)
    write_channels(path, planes, metadata, chromaticities, pixel_aspect)


def write_channels(path: str | os.PathLike, channels: Mapping[str, np.ndarray], *header) -> None:
    """Write `channels` (H, W) by full name, which need not end in a single letter; `header` as in `write_layers`."""
    planes = {name: np.asarray(plane) for name, plane in channels.items()}
    _check_planes(planes)
    height, width = next(iter(planes.values())).shape
    # Block by block, so that signals are handled before a large file is complete.
    rows = max(1, _BLOCK_VALUES // (width * len(planes)) // _ZIP_ROWS) * _ZIP_ROWS
    with writing_rows(path, list(planes), (width, height), *header) as writer:
        for first in range(0, height, rows):
            writer.write({name: plane[first : first + rows] for name, plane in planes.items()})


@contextmanager
def writing_rows(
    path: str | os.PathLike,
    names: Sequence[str],
    size: tuple[int, int],
    metadata: Mapping[str, str] | None = None,
    chromaticities: Sequence[float] | None = None,
    pixel_aspect: float = 1.0,
    *,
    half: Sequence[str] = (),
) -> "Iterator[RowWriter]":
    """Context with a RowWriter for a file of `size` (width, height) with the channels `names`.

    Those of `half` are stored as half floats, values beyond theirs as the largest. The other arguments are those of
    `write_layers`. Also raises ValueError if rows are missing at the end.
    """
    OpenEXR = _openexr()
    metadata = {str(key): str(value) for key, value in (metadata or {}).items()}
    if clash := _OF_THE_FORMAT & metadata.keys():
        raise ValueError(f"metadata {min(clash)!r}: that name belongs to the EXR format itself, use another one")
    width, height = size
    header = OpenEXR.Header(width, height)
    header["channels"] = dict.fromkeys(names, header["channels"]["R"])
    if half:
        from Imath import Channel, PixelType

        header["channels"] |= dict.fromkeys(half, Channel(PixelType(PixelType.HALF)))
    header |= {"type": b"scanlineimage", "pixelAspectRatio": float(pixel_aspect)}
    header |= {key: value.encode() for key, value in metadata.items()}
    if chromaticities is not None:
        import Imath

        if np.shape(chromaticities) != (8,) or not np.isfinite(chromaticities).all():
            raise ValueError(f"chromaticities {chromaticities!r}: expected xy of red, green, blue and white, 8 numbers")
        header["chromaticities"] = Imath.Chromaticities(*[Imath.chromaticity(0.0, 0.0)] * 4)
    with replacing(path) as temporary:
        try:
            file = OpenEXR.OutputFile(str(temporary), header)
        except OSError as error:
            raise OSError(_reason(error, temporary)) from error
        writer = RowWriter(file, temporary, tuple(names), (height, width), frozenset(half))
        try:
            yield writer
        finally:
            file.close()
        if writer.done != height:
            raise ValueError(f"{writer.done} rows were written, expected {height}")
        if chromaticities is not None:
            _put_chromaticities(temporary, np.asarray(chromaticities, dtype="<f4").tobytes())


@dataclass
class RowWriter:
    """Takes the rows of a file from top to bottom; made by `writing_rows`."""

    file: object
    path: Path
    names: tuple[str, ...]
    shape: tuple[int, int]
    half: frozenset[str] = frozenset()  # the channels of half floats
    done: int = 0  # rows

    def write(self, planes: Mapping[str, np.ndarray]) -> None:
        """Write the next rows, (R, W) for every channel; raises ValueError for other channels or shapes."""
        height, width = self.shape
        rows = len(next(iter(planes.values()))) if planes else 0
        if set(planes) != set(self.names) or rows == 0 or self.done + rows > height:
            raise ValueError(
                f"rows {self.done} to {self.done + rows} of channels {sorted(planes)}, expected rows up to {height} "
                f"of channels {sorted(self.names)}"
            )
        data = {}
        for name, plane in planes.items():
            if plane.shape != (rows, width):
                raise ValueError(f"channel {name!r}: rows have shape {plane.shape}, expected {(rows, width)}")
            with np.errstate(over="ignore"):
                # The writer ignores strides and types other than its own: it would store wrong numbers or crash.
                kind = np.float32
                if name in self.half:
                    kind, plane = np.float16, np.clip(plane, -LARGEST_HALF, LARGEST_HALF)
                data[name] = np.ascontiguousarray(plane, dtype=kind).tobytes()
        try:
            self.file.writePixels(data, rows)
        except (RuntimeError, OSError) as error:
            raise OSError(_reason(error, self.path)) from error
        self.done += rows


def _check_planes(planes: Mapping[str, np.ndarray]) -> None:
    if not planes:
        raise ValueError("no layers were given, an EXR file needs at least one")
    first_name, first = next(iter(planes.items()))
    for name, plane in planes.items():
        if not name or "\0" in name or len(name.encode()) > _LONGEST_NAME:
            raise ValueError(f"channel {name!r}: expected a name of 1 to {_LONGEST_NAME} bytes without NUL")
        if plane.ndim != 2 or 0 in plane.shape:
            raise ValueError(f"channel {name!r}: an array of shape {plane.shape} was given, expected (height, width)")
        if plane.shape != first.shape:
            raise ValueError(
                f"channel {name!r} is {plane.shape[1]}x{plane.shape[0]}, but {first_name!r} is "
                f"{first.shape[1]}x{first.shape[0]}; all layers of a file need the same size"
            )


def _put_chromaticities(path: Path, values: bytes) -> None:
    """Put chromaticities into the header of a file, since OutputFile always writes zeros (OpenEXR 3.5)."""
    attribute = b"\0chromaticities\0chromaticities\0" + len(values).to_bytes(4, "little")
    with path.open("r+b") as file:
        file.seek(file.read(_HEADER_BYTES).index(attribute) + len(attribute))
        file.write(values)


def _reason(error: Exception, temporary: os.PathLike) -> str:
    """Why OpenEXR could not write: the reason in its message `Cannot open image file "NAME". Reason.`"""
    return str(error).rpartition(f'"{temporary}". ')[2].strip().rstrip(".")


def read_channels(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All channels of all parts by full name, each (H, W) of the file's type, row 0 on top.

    Blender 4.5 writes one part, Blender 5 may write one part per pass; both give names like ``ViewLayer.Position.X``. A
    channel without a layer gets the name of its part in front. Raises OSError if the file is missing or unreadable, and
    ValueError, naming the file, if it is damaged, incomplete or no EXR.
    """
    with open(path, "rb") as stream:  # the system's own error for a missing or unreadable file
        if stream.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError(f"{path}: is not an OpenEXR file, expected one")
    OpenEXR, complaint, channels = _openexr(), io.StringIO(), {}
    try:
        # The package prints a warning to stdout and leaves a damaged part out, instead of raising.
        with contextlib.redirect_stdout(complaint):
            expected = len(OpenEXR.File(str(path), header_only=True).parts)
            parts = OpenEXR.File(str(path), separate_channels=True).parts
    except (RuntimeError, ValueError, OSError, MemoryError) as error:
        raise ValueError(f"{path}: is damaged and cannot be read ({error}); render or write it again") from error
    if len(parts) != expected or not parts:
        reason = complaint.getvalue().strip().rpartition(" - ")[2] or f"{len(parts)} of {expected} parts readable"
        raise ValueError(f"{path}: is damaged or incomplete ({reason}); render or write it again")
    for exr_part in parts:
        for name, channel in exr_part.channels.items():
            if channel.pixels is None:
                raise ValueError(f"{path}: is damaged, channel {name!r} has no pixels; render or write it again")
            prefix = f"{exr_part.name()}." if len(parts) > 1 and "." not in name and exr_part.name() else ""
            channels[prefix + name] = channel.pixels
    return channels


def read_layers(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All layers by name: (H, W) for a single channel, else (H, W, C) in the order RGBA, XYZW or alphabetical.

    The layer is the channel's name up to its last dot ("" without one). Raises as `read_channels` does.
    """
    grouped: dict[str, dict[str, np.ndarray]] = {}
    for name, pixels in read_channels(path).items():
        layer, _, letter = name.rpartition(".")
        grouped.setdefault(layer, {})[letter] = pixels
    layers = {}
    for layer, planes in grouped.items():
        ordered = [planes[letter] for letter in sorted(planes, key=_channel_rank)]
        layers[layer] = ordered[0] if len(ordered) == 1 else np.stack(ordered, axis=-1)
    return layers


def _channel_rank(letter: str) -> tuple[int, str]:
    ranks = [order.index(letter) for order in _CHANNEL_ORDERS if len(letter) == 1 and letter in order]
    return (ranks[0] if ranks else 99, letter)


def _openexr():
    try:
        import OpenEXR
    except ImportError as error:
        raise ImportError(
            f"the Python package OpenEXR cannot be imported ({error}); it is needed to read and write EXR files: "
            "install it with `pip install OpenEXR`"
        ) from error
    return OpenEXR
