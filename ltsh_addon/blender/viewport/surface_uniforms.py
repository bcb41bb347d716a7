"""Looks and views as uniform buffers, and the small tables that the surface shader reads."""

from __future__ import annotations

import gpu
import numpy as np

from ..materials import reflectance
from ..materials.aovs import LOBE_KINDS
from ..materials.linear_values import EXTENSIONS, Value
from ..materials.surface_looks import COAT, IMAGE_SLOTS, Look

# In units of vec4: where slots start, the size of one, where the terms of conductors and where the coat starts, all.
FIRST_SLOT, SLOT_SIZE = 3, 6
FIRST_TERM = FIRST_SLOT + SLOT_SIZE * len(IMAGE_SLOTS)
LAYERS = FIRST_TERM + 5
LOOK_SIZE = LAYERS + 3
VIEW_FACTORS = {"fresnel": 1, "facing": 2}
KINDS = {**LOBE_KINDS, COAT: max(LOBE_KINDS.values()) + 1}
DEFINES = {
    **{name.upper(): str(int(number)) for name, number in KINDS.items()},
    **{"FIRST_SLOT": str(FIRST_SLOT), "SLOT_SIZE": str(SLOT_SIZE), "FIRST_TERM": str(FIRST_TERM)},
    "LAYERS": str(LAYERS),
}


def uniform_buffer(values: np.ndarray) -> gpu.types.GPUUniformBuf:
    """A uniform buffer of values (N, 4)."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    return gpu.types.GPUUniformBuf(gpu.types.Buffer("FLOAT", values.size, values.ravel()))


def look_values(look: Look) -> np.ndarray:
    """The uniform buffer (LOOK_SIZE, 4) of a look."""
    data = np.zeros((LOOK_SIZE, 4))
    flags = (look.normal is not None) + 2 * look.corrected
    data[0] = KINDS[look.kind], look.scattered, flags, look.normal_strength
    data[1] = *look.emission, look.value("transmission").offset[0]
    data[2] = *look.value("tint").offset, look.value("specular_level").offset[0]
    for position, name in enumerate(IMAGE_SLOTS):
        value = look.normal if name == "normal" else look.value(name)
        if value is not None:
            start = FIRST_SLOT + SLOT_SIZE * position
            data[start : start + SLOT_SIZE] = _slot_values(value)
    data[LAYERS, 0] = look.weight
    if look.view_factor is not None:
        factor = look.view_factor
        data[LAYERS + 2, :3] = VIEW_FACTORS[factor.kind], factor.parameter, factor.is_complement
    if look.coat is not None:
        data[LAYERS, 1:] = look.coat.weight, look.coat.roughness, look.coat.ior
        data[LAYERS + 1] = *look.coat.tint, look.coat.follows_normal
    if look.kind.startswith("conductor"):
        exact = look.kind == "conductor"
        index, extinction = look.value("color").offset[None], np.maximum(look.value("tint").offset, 0.0)[None]
        data[FIRST_TERM : FIRST_TERM + 4, :3] = np.stack(reflectance.conductor_fit(index, extinction, exact))[:, 0]
        data[FIRST_TERM + 4, :3] = reflectance.conductor_average(index, extinction, exact)[0]
    return data


def _slot_values(value: Value) -> np.ndarray:
    rows = np.zeros((SLOT_SIZE, 4))
    rows[3, :3] = value.offset
    if value.image is not None:
        use = value.image
        rows[:3], rows[3, 3] = value.matrix, 1.0
        rows[4:6, :3] = use.mapping
        rows[4, 3] = use.closest
        rows[5, 3] = EXTENSIONS.index(use.extension) + 4 * is_encoded(use.image)
    return rows


def is_encoded(image) -> bool:
    """True for images that Cycles interpolates before it makes them linear."""
    return not image.is_float and image.colorspace_settings.name == "sRGB"


def float_table(values: np.ndarray) -> gpu.types.GPUTexture:
    """R32F texture of values (H, W), row 0 first."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    buffer = gpu.types.Buffer("FLOAT", values.size, values.ravel())
    return gpu.types.GPUTexture(values.shape[::-1], format="R32F", data=buffer)


def albedo_table() -> np.ndarray:
    """(33, 32): directional albedo of GGX by roughness and cosine, then its average by roughness."""
    nodes = np.linspace(0.0, 1.0, reflectance.ALBEDO_NODES)
    roughness, cosine = (axis.ravel() for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    directional, _ = reflectance.albedos(roughness, cosine)
    _, average = reflectance.albedos(nodes, np.ones_like(nodes))
    return np.vstack([directional.reshape(len(nodes), -1), average])


def blend_table() -> np.ndarray:
    """(256, 16): where between f0 and 1 the albedo of a dielectric lies, rows by roughness and cosine."""
    count = reflectance.NODES
    nodes = np.linspace(0.0, 1.0, count)
    roughness, cosine, coordinate = (axis.ravel() for axis in np.meshgrid(nodes, nodes, nodes, indexing="ij"))
    f0 = np.minimum(coordinate**4, reflectance.MAX_F0)
    ior = (1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0))
    share = reflectance.dielectric_albedo(np.zeros((len(ior), 1)), ior, roughness, cosine)[:, 0]
    return share.reshape(count * count, count)
