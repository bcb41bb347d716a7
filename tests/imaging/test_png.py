"""PNG files against a decoder of the test's own, and the display curve."""

import struct
import zlib

import numpy as np
import pytest

from ltsh_addon.imaging import to_srgb8, write_png
from ltsh_addon.imaging.color import exposure_factor


def decode(data: bytes) -> tuple[np.ndarray, list[bytes]]:
    """Pixels (H, W, 3) and the chunk types of an 8-bit RGB PNG without interlace (ISO/IEC 15948)."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    position, kinds, compressed = 8, [], b""
    while position < len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        body = data[position + 8 : position + 8 + length]
        assert struct.unpack(">I", data[position + 8 + length : position + 12 + length])[0] == zlib.crc32(kind + body)
        kinds.append(kind)
        if kind == b"IHDR":
            width, height, depth, color, *rest = struct.unpack(">IIBBBBB", body)
            assert (depth, color, rest) == (8, 2, [0, 0, 0])
        compressed += body if kind == b"IDAT" else b""
        position += 12 + length
    stream = zlib.decompress(compressed)
    stride = 3 * width
    above, rows = bytearray(stride), []
    for y in range(height):
        start = y * (stride + 1)
        filter_type, line = stream[start], bytearray(stream[start + 1 : start + 1 + stride])
        for i in range(stride):
            left = line[i - 3] if i >= 3 else 0
            up, corner = above[i], above[i - 3] if i >= 3 else 0
            estimate = left + up - corner
            paeth = min((left, up, corner), key=lambda value: abs(estimate - value))
            line[i] = (line[i] + (0, left, up, (left + up) // 2, paeth)[filter_type]) & 255
        rows.append(bytes(line))
        above = line
    return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(height, width, 3), kinds


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (40, 60)])
def test_pixels_come_back(tmp_path, shape):
    image = np.random.default_rng(1).integers(0, 256, (*shape, 3), dtype=np.uint8)
    image[: shape[0] // 2] = 7  # a smooth part beside the noise
    write_png(tmp_path / "a.png", image)
    pixels, kinds = decode((tmp_path / "a.png").read_bytes())
    assert np.array_equal(pixels, image)
    assert kinds[0] == b"IHDR" and kinds[-1] == b"IEND" and b"sRGB" in kinds


@pytest.mark.parametrize("bad", [np.zeros((2, 2, 3)), np.zeros((2, 2), np.uint8), np.zeros((0, 2, 3), np.uint8)])
def test_other_arrays_are_refused(tmp_path, bad):
    with pytest.raises((ValueError, TypeError)):
        write_png(tmp_path / "a.png", bad)
    assert list(tmp_path.iterdir()) == []


def test_srgb_curve_at_known_points():
    # IEC 61966-2-1: 0.0031308 is the joint (12.92 * 0.0031308 * 255 = 10.3), 0.215861 is display 128/255.
    linear = np.array([0.0, 0.0031308, 0.215861, 1.0, 2.0, -1.0, np.nan])
    assert to_srgb8(linear).tolist() == [0, 10, 128, 255, 255, 0, 0]


def test_exposure_brings_the_bright_end_to_its_place():
    image = np.random.default_rng(2).uniform(0.0, 50.0, (64, 64, 3))
    exposed = exposure_factor(image) * image @ np.array([0.2126, 0.7152, 0.0722])
    assert np.percentile(exposed, 99.0) == pytest.approx(0.9, rel=0.01)
    assert exposure_factor(np.zeros((4, 4, 3))) == 1.0
