"""The inputs of shaders: materials, and tables of closures, as textures and buffers."""

from __future__ import annotations

import numpy as np

from ...cycles import closures, horizons
from ...cycles.lobes import LEAST_VELVET, LOBE_KINDS
from ..materials.preview_material import COAT, IMAGE_SLOTS, REFRACTION, PreviewMaterial
from ..materials.values import EXTENSIONS, Value

# The layout of a look's uniform buffer in units of vec4: start and size of the slots, start of the terms of conductors,
# start of the layers (coat and others), whole size.
FIRST_SLOT, SLOT_SIZE = 3, 6
FIRST_TERM = FIRST_SLOT + SLOT_SIZE * len(IMAGE_SLOTS)
LAYERS = FIRST_TERM + 5
LOOK_SIZE = LAYERS + 5
# Numbers for the direction of tangents of anisotropic lobes, by `Brush.direction`; 0: not anisotropic.
DIRECTIONS = {"X": 1, "Y": 2, "Z": 3, "": 4}
VIEW_FACTORS = {"fresnel": 1, "facing": 2}
KINDS = {**LOBE_KINDS, COAT: max(LOBE_KINDS.values()) + 1, REFRACTION: max(LOBE_KINDS.values()) + 2}
DEFINES = {
    **{name.upper(): str(int(number)) for name, number in KINDS.items()},
    **{f"{name.upper()}_SLOT": str(position) for position, name in enumerate(IMAGE_SLOTS)},
    **{f"EXTENSION_{name}": str(position) for position, name in enumerate(EXTENSIONS)},
    "EXTENSIONS": str(len(EXTENSIONS)),
    "FIRST_SLOT": str(FIRST_SLOT),
    "SLOT_SIZE": str(SLOT_SIZE),
    "FIRST_TERM": str(FIRST_TERM),
    "LAYERS": str(LAYERS),
    "LEAST_VELVET": str(LEAST_VELVET),
    "MAX_F0": str(closures.MAX_F0),
    "AVERAGE_START": str(closures.DIELECTRIC_AVERAGE[0]),
    "AVERAGE_SLOPE": str(closures.DIELECTRIC_AVERAGE[1]),
    "ELEVATION_SHARE": str(horizons.ELEVATION_SHARE),
    "MINIMUM_REFLECTION_ELEVATION": str(horizons.MINIMUM_REFLECTION_ELEVATION),
}


def look_values(look: PreviewMaterial) -> np.ndarray:
    """The uniform buffer (LOOK_SIZE, 4) of a look."""
    data = np.zeros((LOOK_SIZE, 4))
    flags = (look.normal is not None) + 2 * look.corrected
    data[0] = KINDS[look.kind], look.scattered, flags, look.normal_strength
    data[1] = *look.emission, look.through
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
    data[LAYERS + 2, 3] = look.glow
    if look.sheen is not None:
        data[LAYERS + 3, :2] = look.sheen
    data[LAYERS + 3, 2] = look.value("diffuse_roughness").offset[0] if look.is_rough else 0.0
    if look.brush is not None:
        brush = look.brush
        data[LAYERS + 4, :3] = brush.aspect, 2.0 * np.pi * brush.rotation, DIRECTIONS[brush.direction]
    if look.coat is not None:
        data[LAYERS, 1:] = look.coat.weight, look.coat.roughness, look.coat.ior
        data[LAYERS + 1] = *look.coat.tint, look.coat.follows_normal
    if look.kind.startswith("conductor"):
        exact = look.kind == "conductor"
        index, extinction = look.value("color").offset[None], np.maximum(look.value("tint").offset, 0.0)[None]
        data[FIRST_TERM : FIRST_TERM + 4, :3] = np.stack(closures.conductor_fit(index, extinction, exact))[:, 0]
        data[FIRST_TERM + 4, :3] = closures.conductor_average(index, extinction, exact)[0]
    return data


def _slot_values(value: Value) -> np.ndarray:
    rows = np.zeros((SLOT_SIZE, 4))
    rows[3, :3] = value.offset
    if value.image is not None:
        use = value.image
        rows[:3], rows[3, 3] = value.matrix, 1.0
        rows[4:6, :3] = use.mapping
        rows[4, 3] = use.closest
        encoding = is_encoded(use.image) * (1 + use.by_alpha)
        rows[5, 3] = EXTENSIONS.index(use.extension) + len(EXTENSIONS) * encoding
    return rows


def is_encoded(image) -> bool:
    """True for images that Cycles interpolates before it converts them to linear values."""
    return not image.is_float and image.colorspace_settings.name == "sRGB"


def albedo_table() -> np.ndarray:
    """(33, 32): directional albedo of GGX by roughness and cosine; the last row is its average by roughness."""
    return np.vstack(closures.albedo_tables())


def sheen_table() -> np.ndarray:
    """(N, N, 4): albedo, a and b of sheen (see `closures.sheen_lobe`), albedo of velvet; rows by cosine, columns by
    roughness."""
    nodes = np.linspace(0.0, 1.0, closures.SHEEN_NODES)
    cosine, roughness = (axis.ravel() for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    values = np.concatenate([closures.sheen_lobe(cosine, roughness), closures.velvet_albedo(cosine, roughness)[None]])
    return values.T.reshape(len(nodes), len(nodes), 4)


def blend_table() -> np.ndarray:
    """(256, 16): the place of a dielectric's albedo between f0 and 1; rows by roughness and cosine.

    Columns are uniform in the fourth root of f0.
    """
    count = closures.GLASS_NODES
    nodes = np.linspace(0.0, 1.0, count)
    roughness, cosine, coordinate = (axis.ravel() for axis in np.meshgrid(nodes, nodes, nodes, indexing="ij"))
    f0 = np.minimum(coordinate**4, closures.MAX_F0)
    ior = (1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0))
    share = closures.dielectric_albedo(np.zeros((len(ior), 1)), ior, roughness, cosine)[:, 0]
    return share.reshape(count * count, count)
