"""The quantities that a 1-sample Cycles render writes through shader AOVs (arbitrary output variables). Needs no bpy.

A hit has those of HIT_AOVS once, and those of LOBE_AOVS for each of its lobes, in slots that are numbered from 0.
"""

from __future__ import annotations

import numpy as np

AOV_PREFIX = "ltsh_"
MAX_LOBES = 8
# Name of the quantity -> type of the AOV.
HIT_AOVS = {
    "hit": "VALUE",  # 1 where a surface was hit
    "receiver": "VALUE",  # `AreaLight.receivers`
    "correct_normal": "VALUE",  # 1 where Cycles bends specular normals (use_bump_map_correction)
    "position": "COLOR",
    "incoming": "COLOR",  # towards the camera
    "smooth_normal": "COLOR",
    "true_normal": "COLOR",
}
# Name of the quantity -> type of the AOV, and the value that changes nothing: an AOV that no material needs is left out
# (None: never left out).
LOBE_AOVS = {
    "kind": ("VALUE", 0.0),  # one of LOBE_KINDS
    "weight": ("VALUE", 1.0),  # product of the factors of mixes
    "normal": ("COLOR", (0.0, 0.0, 0.0)),  # the Normal socket; zero: the smooth normal
    "color": ("COLOR", None),  # of conductors the refractive index
    "roughness": ("VALUE", None),
    "metallic": ("VALUE", 0.0),
    "ior": ("VALUE", 1.5),
    "specular_level": ("VALUE", 0.5),
    "tint": ("COLOR", (1.0, 1.0, 1.0)),  # of conductors the extinction coefficient
    "multiple_scattering": ("VALUE", 0.0),  # 1 for Multiscatter GGX
    "transmission": ("VALUE", 0.0),
    "backfacing": ("VALUE", 0.0),
    "sheen_weight": ("VALUE", 0.0),
    "sheen_tint": ("COLOR", (1.0, 1.0, 1.0)),
    "sheen_roughness": ("VALUE", 0.5),
    "coat_weight": ("VALUE", 0.0),
    "coat_roughness": ("VALUE", 0.03),
    "coat_ior": ("VALUE", 1.5),
    "coat_tint": ("COLOR", (1.0, 1.0, 1.0)),
    "coat_normal": ("COLOR", (0.0, 0.0, 0.0)),
}
LOBE_KINDS = {
    "none": 0.0,
    "principled": 1.0,
    "glossy": 2.0,
    "diffuse": 3.0,
    "translucent": 4.0,
    "metal": 5.0,
    "conductor": 6.0,
    "conductor_4_5": 7.0,  # with the approximate reflectance of Cycles 4.5
    "glass": 8.0,
    "sheen": 9.0,
}


def lobe_aov(name: str, slot: int) -> str:
    """The AOV of the quantity `name` of LOBE_AOVS in a slot."""
    return f"{name}_{slot}"


def aov_kind(name: str) -> str:
    """Type of an AOV: of HIT_AOVS, or as `lobe_aov` names it."""
    return HIT_AOVS[name] if name in HIT_AOVS else LOBE_AOVS[name.rpartition("_")[0]][0]


def read_layer(channels: dict[str, np.ndarray], name: str, components: str) -> np.ndarray:
    """Pass `name` as (H, W) float32, or (H, W, 3) for three components, from EXR `channels` of one view layer.

    Blender writes `<view layer>.<pass>.<component>`; the view layer's name is of no interest.
    """
    planes = []
    for component in components:
        suffix = f".{name}.{component}"
        found = [key for key in channels if key.endswith(suffix) or key == suffix[1:]]
        if len(found) != 1:
            raise ValueError(
                f"render result: {len(found)} channels named {suffix[1:]!r}, expected one; found {sorted(channels)}"
            )
        planes.append(channels[found[0]])
    return planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def read_aov(channels: dict[str, np.ndarray], name: str) -> np.ndarray:
    """The AOV `name` (see `aov_kind`): (H, W) or (H, W, 3) float32."""
    return read_layer(channels, AOV_PREFIX + name, "RGB" if aov_kind(name) == "COLOR" else "X")


def lobe_names(channels: dict[str, np.ndarray]) -> list[list[str]]:
    """For each slot in EXR `channels` the names of LOBE_AOVS that were written."""
    written = {key.rpartition(".")[0].rpartition(AOV_PREFIX)[2] for key in channels if AOV_PREFIX in key}
    slots = [[name for name in LOBE_AOVS if lobe_aov(name, slot) in written] for slot in range(MAX_LOBES)]
    return [names for names in slots if names]
