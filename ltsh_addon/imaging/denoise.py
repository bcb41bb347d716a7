"""Denoising by the library Open Image Denoise that Blender ships, called through ctypes.

Functions and arguments are those of oidn.h of Open Image Denoise 2. As in Blender, pictures are denoised with the help
of their albedo and normal, which are denoised first.
"""

import ctypes
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np

from ..scene import error_line, listed

DENOISER = "Open Image Denoise"  # how `Denoiser.name` begins
# Names under which the system may know the library.
SYSTEM_LIBRARIES = ("libOpenImageDenoise.so.2", "libOpenImageDenoise.dylib", "OpenImageDenoise.dll")
_CPU, _FLOAT3 = 1, 3  # OIDNDeviceType, OIDNFormat
_FAST, _BALANCED, _HIGH = 4, 5, 6  # OIDNQuality
# Ways to denoise: the weights of the pictures whose mean is taken, by the quality of the network and how the picture is
# mirrored before, down and right. A network blurs each in a way of its own: in nine scenes, of 96 samples, BEST errs 1
# to 7 % less than PLAIN in L2, 1 to 10 % in FLIP. HALVES: of two halves of a picture, in 0.4 of the time.
PLAIN = {(_HIGH, (1, 1)): 1.0}
BEST = {(_HIGH, (1, 1)): 0.4, (_HIGH, (-1, -1)): 0.4, (_BALANCED, (1, -1)): 0.2}
HALVES = {(_BALANCED, (1, -1)): 1.0}, {(_BALANCED, (-1, 1)): 1.0}
_POINTER, _SIZE, _TEXT, _BOOL, _INT = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p, ctypes.c_bool, ctypes.c_int
_FUNCTIONS = {
    "oidnNewDevice": (_POINTER, _INT),
    "oidnSetDeviceInt": (None, _POINTER, _TEXT, _INT),
    "oidnSetDeviceBool": (None, _POINTER, _TEXT, _BOOL),
    "oidnGetDeviceInt": (_INT, _POINTER, _TEXT),
    "oidnCommitDevice": (None, _POINTER),
    "oidnGetDeviceError": (_INT, _POINTER, ctypes.POINTER(_TEXT)),
    "oidnReleaseDevice": (None, _POINTER),
    "oidnNewFilter": (_POINTER, _POINTER, _TEXT),
    "oidnSetSharedFilterImage": (None, _POINTER, _TEXT, _POINTER, _INT, *(_SIZE,) * 5),
    "oidnSetFilterBool": (None, _POINTER, _TEXT, _BOOL),
    "oidnSetFilterInt": (None, _POINTER, _TEXT, _INT),
    "oidnCommitFilter": (None, _POINTER),
    "oidnExecuteFilter": (None, _POINTER),
    "oidnReleaseFilter": (None, _POINTER),
}


class NoDenoiser(Exception):
    """No library is usable; the message says why."""


class Denoiser:
    """Open Image Denoise; made by `open_denoiser`."""

    def __init__(self, library: str, threads: int):
        try:
            loaded = ctypes.CDLL(library)
            for name, (result, *arguments) in _FUNCTIONS.items():
                function = getattr(loaded, name)
                function.restype, function.argtypes = result, arguments
                setattr(self, "_" + name.removeprefix("oidn"), function)
        except (OSError, AttributeError) as error:
            raise NoDenoiser(f"{library}: {error_line(error)}") from None
        self._device = self._NewDevice(_CPU)
        if not self._device:
            raise NoDenoiser(f"{library}: it makes no device")
        # Threads are not pinned to cores, because other work runs beside them.
        self._SetDeviceBool(self._device, b"setAffinity", False)
        self._SetDeviceInt(self._device, b"numThreads", threads)
        self._CommitDevice(self._device)
        self._check()
        version = self._GetDeviceInt(self._device, b"version")
        self.name = f"{DENOISER} {version // 10000}.{version // 100 % 100}.{version % 100}"

    def close(self) -> None:
        """Free the memory of the library."""
        self._ReleaseDevice(self._device)

    def all_denoised(
        self, colors: Sequence[np.ndarray], albedo: np.ndarray, normal: np.ndarray, ways: Sequence[dict] | None = None
    ) -> list[np.ndarray]:
        """The denoised pictures, float32 and never negative, of pictures `colors` (H, W, 3) of the same surfaces.

        `albedo` and `normal` (H, W, 3) may be noisy, too. NaN and Inf count as 0. `ways` are PLAIN by default.
        """
        images = {"albedo": albedo, "normal": normal}
        guides = [self._filtered({name: one}, quality=_BALANCED) for name, one in images.items()]
        ways = ways or [PLAIN] * len(colors)
        return [self.guided(color, *guides, way) for color, way in zip(colors, ways, strict=True)]

    def quickly_denoised(self, color: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """As `all_denoised` of one picture, with the library's fast quality and the guides as they are."""
        return self._filtered({"color": color, "albedo": albedo, "normal": normal}, hdr=True, quality=_FAST)

    def guided(self, color: np.ndarray, albedo: np.ndarray, normal: np.ndarray, way: dict = BEST) -> np.ndarray:
        """As `all_denoised` of one picture, with guides without noise."""
        images, mean = {"color": color, "albedo": albedo, "normal": normal}, 0.0
        for (quality, (down, right)), weight in way.items():
            mirrored = {name: one[::down, ::right] for name, one in images.items()}
            clean = self._filtered(mirrored, quality=quality, hdr=True, cleanAux=True)
            mean = mean + np.float32(weight) * clean[::down, ::right]
        return mean

    def _filtered(self, images: dict[str, np.ndarray], **settings: int) -> np.ndarray:
        """The first of the `images`, filtered with the help of the others."""
        images = {name: _plain(image) for name, image in images.items()}
        result = np.zeros_like(next(iter(images.values())))
        height, width = result.shape[:2]
        made = self._NewFilter(self._device, b"RT")
        try:
            for name, image in {**images, "output": result}.items():
                layout = _FLOAT3, width, height, 0, 0, 0
                self._SetSharedFilterImage(made, name.encode(), image.ctypes.data, *layout)
            for name, value in settings.items():
                set_value = getattr(self, "_SetFilterBool" if isinstance(value, bool) else "_SetFilterInt")
                set_value(made, name.encode(), value)
            self._CommitFilter(made)
            self._ExecuteFilter(made)
            self._check()
        finally:
            self._ReleaseFilter(made)
        return result

    def _check(self) -> None:
        text = _TEXT()
        if self._GetDeviceError(self._device, ctypes.byref(text)):
            raise NoDenoiser(f"Open Image Denoise: {(text.value or b'no reason').decode(errors='replace')}")


def _plain(image: np.ndarray) -> np.ndarray:
    image = np.array(image, dtype=np.float32, order="C")
    image[~np.isfinite(image)] = 0.0
    return image


@contextmanager
def open_denoiser(libraries: Iterable[Path], threads: int) -> Iterator[Denoiser]:
    """Context with the first library that works, of `libraries` and then of the system. Raises NoDenoiser."""
    reasons = []
    for library in (*map(str, libraries), *SYSTEM_LIBRARIES):
        try:
            denoiser = Denoiser(library, threads)
        except NoDenoiser as error:
            reasons.append(str(error))
            continue
        try:
            yield denoiser
        finally:
            denoiser.close()
        return
    raise NoDenoiser(f"Open Image Denoise cannot be used: {listed(reasons, 2, '; ')}")


# ALBEDO, NORMAL, DISTANCE: differences at which neighbors count 1/e: of albedo, of the cosine, and relative. FARTHEST:
# the distance of the background in m. MOST: how often a pixel may be as bright as its brightest neighbor.
ALBEDO, NORMAL, DISTANCE, FARTHEST, MOST = 0.1, 0.05, 0.02, 1e6, 2.0


def smoothed(light: np.ndarray, guides: np.ndarray, samples: int) -> np.ndarray:
    """Light (H, W, 3) as means of pixels of the same surface, where there is no denoiser.

    Pixels that outshine their neighbors are dimmed. `guides` (H, W, 7) are albedo, normal and distance. The more
    `samples`, the closer the pixels. Source: Dammertz et al. 2010, Edge-Avoiding A-Trous Wavelet Transform for fast
    Global Illumination Filtering.
    """
    light = np.maximum(np.nan_to_num(light), 0.0)
    brightness = light.mean(axis=-1)
    brightest = np.max([_shifted(brightness, *way) for way in _WAYS], axis=0)
    light = light * np.minimum(1.0, MOST * brightest / np.maximum(brightness, 1e-9))[..., None]
    normal = guides[..., 3:6] / np.maximum(np.linalg.norm(guides[..., 3:6], axis=-1, keepdims=True), 1e-6)
    surface = np.concatenate([guides[..., :3], normal, guides[..., 6:]], axis=-1)
    for step in (1, 2, 4)[: max(3 - int(np.log2(max(samples, 4) / 4)) // 2, 1)]:

        def weight(there: np.ndarray, _, step=step) -> np.ndarray:
            off = ((there[..., :3] - surface[..., :3]) ** 2).sum(axis=-1) / ALBEDO**2
            off += (1.0 - (there[..., 3:6] * normal).sum(axis=-1)).clip(0.0) / NORMAL
            off += ((there[..., 6] - surface[..., 6]) / (DISTANCE * step * np.maximum(surface[..., 6], 1e-6))) ** 2
            return np.exp(-off)[..., None]

        light = means_of_neighbors(light, surface, weight, step)
    return light


_WAYS = sorted({*product((-1, 0, 1), repeat=2)} - {(0, 0)})


def means_of_neighbors(values: np.ndarray, surface: np.ndarray, weight: Callable, step: int = 1) -> np.ndarray:
    """Values (H, W, C) as weighted means of 3 x 3 pixels `step` apart, the corners with half of their weights.

    `weight(surface, values)` of one neighbor of each pixel is (H, W, C or 1); that of the pixel itself is 1.
    """
    total, weights = values, 1.0
    for down, right in _WAYS:
        there = [_shifted(one, step * down, step * right) for one in (surface, values)]
        one = weight(*there) * (0.5 if down and right else 1.0)
        total, weights = total + one * there[1], weights + one
    return total / weights


def _shifted(picture: np.ndarray, down: int, right: int) -> np.ndarray:
    """A picture (H, W, ...) moved by pixels; its border is repeated."""
    rows, columns = (np.arange(side) - way for side, way in zip(picture.shape, (down, right), strict=False))
    return picture.take(rows, 0, mode="clip").take(columns, 1, mode="clip")
