"""8-bit RGB PNG files. Format: PNG specification, third edition (W3C 2025), with an sRGB chunk."""

from __future__ import annotations

import os
import struct
import zlib

import numpy as np

from ..files import write_bytes

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write `image` (H, W, 3) uint8, sRGB, row 0 on top. The file appears complete or not at all.

    Raises ValueError for another shape or type, OSError when the file cannot be written.
    """
    write_bytes(path, encode_png(image))


def encode_png(image: np.ndarray) -> bytes:
    """The bytes of a PNG file that shows `image` (H, W, 3) uint8."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not 0 < min(image.shape[:2]):
        raise ValueError(f"PNG: expected an image (height, width, 3) of uint8, found {image.shape} of {image.dtype}")
    height, width = image.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB, deflate, adaptive, not interlaced
    pixels = zlib.compress(_filtered(image).tobytes(), 6)
    perceptual = b"\0"
    return b"".join(
        [
            _SIGNATURE,
            _chunk(b"IHDR", header),
            _chunk(b"sRGB", perceptual),
            _chunk(b"IDAT", pixels),
            _chunk(b"IEND", b""),
        ]
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _filtered(image: np.ndarray) -> np.ndarray:
    """Rows (H, 1 + 3 W) with the filter byte in front: of None, Sub, Up and Paeth the one with the smallest sum."""
    height, width = image.shape[:2]
    raw = image.astype(np.int16)
    left, above, corner = np.zeros_like(raw), np.zeros_like(raw), np.zeros_like(raw)
    left[:, 1:], above[1:], corner[1:, 1:] = raw[:, :-1], raw[:-1], raw[:-1, :-1]
    estimate = left + above - corner
    distances = [abs(estimate - neighbor) for neighbor in (left, above, corner)]
    paeth = np.where(
        (distances[0] <= distances[1]) & (distances[0] <= distances[2]),
        left,
        np.where(distances[1] <= distances[2], above, corner),
    )
    best, best_cost = None, None
    for kind, prediction in ((0, 0), (1, left), (2, above), (4, paeth)):
        residual = (raw - prediction).astype(np.uint8).reshape(height, -1)  # modulo 256, as PNG wants
        rows = np.concatenate([np.full((height, 1), kind, dtype=np.uint8), residual], axis=1)
        cost = abs(residual.view(np.int8).astype(np.int32)).sum(axis=1)
        if best is None:
            best, best_cost = rows, cost
        else:
            better = cost < best_cost
            best[better], best_cost[better] = rows[better], cost[better]
    return best
