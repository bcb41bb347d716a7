"""From the channels that a 1-sample Cycles render wrote to `SurfaceSamples` and `Film`. Needs no bpy.

Cycles evaluates every texture, bump map and node group itself; the values arrive through shader AOVs (arbitrary output
variables), one sample per pixel and file, so nothing is averaged across an edge.
"""

from __future__ import annotations

import numpy as np

from ..scene import Film, SurfaceSamples

AOV_PREFIX = "ltsh_"
# Name of the quantity -> type of the AOV.
AOVS = {
    "hit": "VALUE",  # 1 where a surface was hit
    "lobe": "VALUE",  # one of LOBES
    "receiver": "VALUE",  # `AreaLight.receivers`
    "correct_normal": "VALUE",  # 1 where Cycles bends specular normals (use_bump_map_correction)
    "position": "COLOR",
    "incoming": "COLOR",  # towards the camera
    "smooth_normal": "COLOR",
    "true_normal": "COLOR",
    "normal": "COLOR",  # the Normal socket
    "color": "COLOR",
    "roughness": "VALUE",
    "metallic": "VALUE",
    "ior": "VALUE",
    "specular_level": "VALUE",
}
LOBES = {"none": 0.0, "principled": 1.0, "glossy": 2.0}

# Reflected rays stay at least this far above the true surface, or this share of the view's own elevation.
MINIMUM_REFLECTION_ELEVATION = 0.01
ELEVATION_SHARE = 0.9


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
    """The AOV `name` (a key of AOVS): (H, W) or (H, W, 3) float32."""
    return read_layer(channels, AOV_PREFIX + name, "RGB" if AOVS[name] == "COLOR" else "X")


def unit(vectors: np.ndarray) -> np.ndarray:
    """`vectors` (..., 3) divided by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def valid_specular_normal(normal: np.ndarray, true_normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Unit normals (P, 3) bent towards `true_normal` just enough that the mirrored view leaves the surface.

    In the plane of both normals let phi be the angle of the normal from the true normal and (x, z) the view's
    components. The mirrored view's elevation is x sin 2phi + z cos 2phi = a cos(2phi - delta) with a = |(x, z)| and
    tan delta = x / z. It starts at z for phi = 0 and first falls to the threshold t at phi = (delta + acos(t / a)) / 2.
    Cycles bends specular normals (not diffuse ones) by this rule; t = min(0.9 z, 0.01). Inputs are unit (P, 3) with
    `view . true_normal` > 0. Agrees with Cycles' own normals to 1e-4, 99 % of them to 1e-5.
    """
    elevation = np.sum(view * true_normal, axis=-1)
    threshold = np.minimum(ELEVATION_SHARE * elevation, MINIMUM_REFLECTION_ELEVATION)
    mirrored = 2.0 * np.sum(normal * view, axis=-1, keepdims=True) * normal - view
    bend = np.sum(mirrored * true_normal, axis=-1) < threshold
    tangent = unit(normal - np.sum(normal * true_normal, axis=-1, keepdims=True) * true_normal)
    x = np.sum(view * tangent, axis=-1)
    span = np.hypot(x, elevation)
    ratio = np.divide(threshold, span, out=np.ones_like(span), where=span > 0.0)
    angle = 0.5 * (np.arctan2(x, elevation) + np.arccos(np.clip(ratio, -1.0, 1.0)))
    bent = np.sin(angle)[:, None] * tangent + np.cos(angle)[:, None] * true_normal
    return np.where(bend[:, None], bent, normal)


def bump_alpha2(normal: np.ndarray, smooth_normal: np.ndarray) -> np.ndarray:
    """Squared GGX roughness (P,) of the shadowing that Cycles puts on a bump-mapped diffuse lobe; 0 means none.

    The lobe is multiplied by 2 / (1 + sqrt(1 + alpha^2 tan^2 theta_i)), theta_i the angle between light direction and
    smooth normal, and is 0 below the smooth horizon; alpha^2 = tan^2 theta_d / 8, at most 1, theta_d the angle between
    both normals (Estevez, Lecocq and Stein 2019, "A Microfacet-Based Shadowing Function to Solve the Bump Terminator
    Problem", doi:10.1007/978-1-4842-4427-2_12). Agrees with Cycles 4.5.15 and 5.2.3 to 1e-4 of the total.
    """
    cosine2 = np.square(np.sum(normal * smooth_normal, axis=-1))
    tangent2 = np.divide(1.0 - cosine2, cosine2, out=np.full_like(cosine2, np.inf), where=cosine2 > 0.0)
    return np.clip(tangent2 / 8.0, 0.0, 1.0)


def effective_ior(ior: np.ndarray, specular_level: np.ndarray) -> np.ndarray:
    """Index of refraction (P,) whose normal reflectance is that of `ior` times 2 `specular_level` (0.5 is neutral)."""
    scaled = np.square((ior - 1.0) / (ior + 1.0)) * 2.0 * np.maximum(specular_level, 0.0)
    root = np.sqrt(np.minimum(scaled, 0.99))
    return np.where(specular_level == 0.5, ior, (1.0 + root) / (1.0 - root))


def surface_samples(channels: dict[str, np.ndarray], diffuse_color: str) -> tuple[SurfaceSamples, np.ndarray, int]:
    """Samples (P) of one render, the pixel (P,) of each (row by row from the top left), and how many were unusable.

    `diffuse_color` is the name of the pass with the diffuse albedo. Unusable are samples whose ray met several surfaces
    (transparency adds the AOVs of both) and samples that are not finite.
    """
    hit = read_aov(channels, "hit").ravel()
    pixel = np.flatnonzero(hit != 0.0)
    values = {}
    for name in AOVS:
        plane = read_aov(channels, name)
        values[name] = plane.reshape(hit.size, *plane.shape[2:])[pixel].astype(np.float64)
    values["albedo"] = read_layer(channels, diffuse_color, "RGB").reshape(hit.size, 3)[pixel].astype(np.float64)

    usable = np.abs(values["hit"] - 1.0) < 1e-6
    for value in values.values():
        usable &= np.isfinite(value) if value.ndim == 1 else np.isfinite(value).all(axis=-1)
    usable &= np.linalg.norm(values["incoming"], axis=-1) > 0.5
    values = {name: value[usable] for name, value in values.items()}
    return _samples_of(values), pixel[usable], int(np.count_nonzero(~usable))


def clear_holdouts(channels: dict[str, np.ndarray]) -> None:
    """Take the hits on holdouts out of the `channels` of a render with an opaque background.

    Cycles evaluates the shaders of holdouts, AOVs included, and then shows a hole; nothing else has alpha 0.
    """
    read_aov(channels, "hit")[read_layer(channels, "Combined", "A") == 0.0] = 0.0


def surfaces_without_sample(channels: dict[str, np.ndarray]) -> int:
    """Pixels of a one-sample render that show a surface (its depth is finite) which wrote no AOV."""
    depth = read_layer(channels, "Depth", "Z" if any(key.endswith("Depth.Z") for key in channels) else "V")
    return int(np.count_nonzero((depth < 1e9) & (read_aov(channels, "hit") == 0.0)))


def _samples_of(values: dict[str, np.ndarray]) -> SurfaceSamples:
    """Samples of the per-sample AOV `values`; clamps and weights are those of Cycles' Principled and Glossy BSDF."""
    view = unit(values["incoming"])
    smooth_normal, true_normal = unit(values["smooth_normal"]), unit(values["true_normal"])
    normal = unit(values["normal"])
    normal = np.where(np.any(normal != 0.0, axis=-1, keepdims=True), normal, smooth_normal)
    corrected = values["correct_normal"] > 0.5
    specular_normal = np.where(corrected[:, None], valid_specular_normal(normal, true_normal, view), normal)

    principled = values["lobe"] == LOBES["principled"]
    glossy = values["lobe"] == LOBES["glossy"]
    color = np.maximum(values["color"], 0.0)
    metallic = np.where(principled, np.clip(values["metallic"], 0.0, 1.0), 0.0)
    metal = metallic[:, None] * np.minimum(color, 1.0)
    gloss = np.where(glossy[:, None], color, 0.0)
    return SurfaceSamples(
        position=values["position"],
        view=view,
        normal=specular_normal,
        diffuse_normal=normal,
        roughness=np.clip(values["roughness"], 0.0, 1.0),
        specular_f0=metal + gloss,
        specular_f90=metallic[:, None] + gloss,
        dielectric=np.where(principled, 1.0 - metallic, 0.0),
        ior=effective_ior(np.maximum(values["ior"], 1e-5), values["specular_level"]),
        diffuse_albedo=values["albedo"],
        geometric_normal=true_normal,
        smooth_normal=smooth_normal,
        receiver=np.rint(values["receiver"]).astype(np.int32),
        bump_alpha2=np.where(corrected, bump_alpha2(normal, smooth_normal), 0.0),
    )


def join(renders: list[tuple[SurfaceSamples, np.ndarray]], width: int, height: int) -> tuple[SurfaceSamples, Film]:
    """All samples of `renders` (samples, pixel), one per sub-sample, and the film they lie on."""
    first = renders[0][0]
    merged = {
        name: np.concatenate([getattr(samples, name) for samples, _ in renders]) for name in first.__dataclass_fields__
    }
    pixel = np.concatenate([pixel for _, pixel in renders])
    return SurfaceSamples(**merged), Film(width, height, pixel, sub_samples=len(renders))
