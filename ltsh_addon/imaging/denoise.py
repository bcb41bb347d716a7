"""Denoising by the library Open Image Denoise that Blender ships, called through ctypes.

Functions and arguments are those of oidn.h of Open Image Denoise 2. As in Blender, pictures are denoised with the help
of their albedo and normal, which are denoised first.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..scene import error_line, listed

# Names under which the system may know the library.
SYSTEM_LIBRARIES = ("libOpenImageDenoise.so.2", "libOpenImageDenoise.dylib", "OpenImageDenoise.dll")
_CPU, _FLOAT3 = 1, 3  # OIDNDeviceType, OIDNFormat
_FAST, _BALANCED, _HIGH = 4, 5, 6  # OIDNQuality
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
        self.name = f"Open Image Denoise {version // 10000}.{version // 100 % 100}.{version % 100}"

    def close(self) -> None:
        """Free the memory of the library."""
        self._ReleaseDevice(self._device)

    def all_denoised(
        self, colors: Sequence[np.ndarray], albedo: np.ndarray, normal: np.ndarray, rough: Sequence[int] = ()
    ) -> list[np.ndarray]:
        """The denoised pictures, float32 and never negative, of pictures `colors` (H, W, 3) of the same surfaces.

        `albedo` and `normal` (H, W, 3) may be noisy, too. NaN and Inf count as 0. The guides, and the pictures with the
        indices `rough`, are filtered in 0.4 of the time: with such guides pictures err 0.5 % more.
        """
        images = {"albedo": albedo, "normal": normal}
        guides = {name: self._filtered({name: one}, quality=_BALANCED) for name, one in images.items()}
        quality, settings = {True: _BALANCED, False: _HIGH}, {"hdr": True, "cleanAux": True}
        pictures = [{"color": color, **guides} for color in colors]
        return [self._filtered(one, quality=quality[i in rough], **settings) for i, one in enumerate(pictures)]

    def quickly_denoised(self, color: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """As `all_denoised` of one picture, with the library's fast quality and the guides as they are."""
        return self._filtered({"color": color, "albedo": albedo, "normal": normal}, hdr=True, quality=_FAST)

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
