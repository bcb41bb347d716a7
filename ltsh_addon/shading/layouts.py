"""Tables as textures that engines have: half floats in one array texture, and the two textures of Heitz et al. 2016.

The two textures have the layout of the authors' shaders and of those made after them. Row j of N is theta_o with
sqrt(1 - cos(theta_o)) = j / (N - 1), column i is roughness i / (N - 1). The first holds m00, m20, m02 and m22 of M^-1,
over m11. The second holds the integrals of the lobe for F = 1 and (1 - c)^5 over the whole sphere, zero, and by
what the shader multiplies the form factor of a sphere that the horizon cuts.
"""

from __future__ import annotations

import struct

import numpy as np

from .lookup_table import LookupTable, TableError

# DXGI_FORMAT_R32G32B32A32_FLOAT, DXGI_FORMAT_R16G16B16A16_FLOAT
_FORMATS = {np.dtype(np.float32): 2, np.dtype(np.float16): 10}


def half_layers(table: LookupTable) -> np.ndarray:
    """(N, R, T, 4) float16: the channels of the nodes, warp first, then every curve's coefficients, four to a layer.

    Raises TableError where a number is too large.
    """
    rows, columns = table.warp.shape[:2]
    channels = np.concatenate([table.warp, table.coefficients.reshape(rows, columns, -1)], axis=2)
    if not np.abs(channels).max() <= np.finfo(np.float16).max:
        raise TableError(
            f"table {table.name}: its largest number is {np.abs(channels).max():g}, expected at most 65504"
        )
    layers = -(-channels.shape[2] // 4)
    padded = np.zeros((rows, columns, 4 * layers), np.float16)
    padded[..., : channels.shape[2]] = channels
    return np.ascontiguousarray(np.moveaxis(padded.reshape(rows, columns, layers, 4), 2, 0))


def two_textures(table: LookupTable, size: int = 64) -> np.ndarray:
    """(2, N, N, 4) float32: the two textures of a table of the family "ltc"."""
    nodes = np.linspace(0.0, 1.0, size)
    theta, roughness = (grid.ravel() for grid in np.meshgrid(nodes, nodes, indexing="ij"))
    lobe = table.lookup(1.0 - theta * theta, roughness, curves=2)
    sine, cosine = np.sin(lobe.tilt), np.cos(lobe.tilt)
    # The axis of the cosine turned into z.
    across = cosine * lobe.xx, cosine * lobe.xz - sine * lobe.zz
    along = sine * lobe.xx, sine * lobe.xz + cosine * lobe.zz
    inverse = np.stack([across[0], along[0], across[1], along[1]], axis=-1) / lobe.yy[:, None]
    sphere = clipped_sphere_factor(2.0 * roughness - 1.0, theta)
    second = np.stack([*lobe.coefficients[:, 0], np.zeros_like(sphere), sphere], axis=-1)
    return np.stack([inverse, second]).reshape(2, size, size, 4).astype(np.float32)


def clipped_sphere_factor(height: np.ndarray, form_factor: np.ndarray) -> np.ndarray:
    """Form factor of a sphere in the direction of z = `height` above the horizon, relative to `form_factor`, which it
    has straight above.

    Snyder 1996, "Area light sources for real-time graphics", Microsoft Research MSR-TR-96-11, as in Heitz et al. 2016.
    """
    squared = np.maximum(form_factor, 1e-9)
    sigma = np.arcsin(np.sqrt(np.minimum(squared, 1.0)))
    omega = np.arccos(np.clip(height, -1.0, 1.0))
    whole = np.maximum(height, 0.0) * squared
    # Where the horizon cuts the sphere.
    ratio = np.clip(np.cos(sigma) / np.maximum(np.sin(omega), 1e-9), -1.0, 1.0)
    gamma = np.arcsin(ratio)
    under_root = np.maximum(squared - np.cos(gamma) ** 2, 0.0)
    turned = np.arcsin(np.clip(np.cos(gamma) / np.sin(sigma), -1.0, 1.0))
    g = 0.5 * np.pi - 2.0 * np.sin(omega) * np.cos(sigma) * np.cos(gamma) - gamma + np.sin(gamma) * np.cos(gamma)
    h = height * (np.cos(gamma) * np.sqrt(under_root) + squared * turned)
    above = height * squared + (g - h) / np.pi
    cut = np.where(omega < 0.5 * np.pi, above, (g + h) / np.pi)
    is_cut = np.abs(omega - 0.5 * np.pi) < sigma
    return np.maximum(np.where(is_cut, cut, whole), 0.0) / squared


def dds(layers: np.ndarray) -> bytes:
    """A DDS file of RGBA textures (N, H, W, 4), float16 or float32: an array texture where there are several."""
    count, height, width, _ = layers.shape
    pitch = width * 4 * layers.itemsize
    # DDSCAPS_TEXTURE; DDSD_CAPS | HEIGHT | WIDTH | PITCH | PIXELFORMAT; DDPF_FOURCC
    start = struct.pack("<4s7I44x", b"DDS ", 124, 0x100F, height, width, pitch, 1, 1)
    pixel_format = struct.pack("<2I4s20x", 32, 0x4, b"DX10")
    caps = struct.pack("<I16x", 0x1000)
    # D3D10_RESOURCE_DIMENSION_TEXTURE2D
    extended = struct.pack("<5I", _FORMATS[layers.dtype], 3, 0, count, 0)
    return start + pixel_format + caps + extended + layers.astype(layers.dtype.newbyteorder("<")).tobytes()
