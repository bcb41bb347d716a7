"""The lobes of a surface as AOVs carry them, and the samples that follow from them."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from ..lobes import diffuse as rough_diffuse
from ..lobes.brdf import is_clipped
from ..scene import SurfaceSamples
from . import closures
from .closures import sheen_lobe
from .horizons import SPECULAR_FIELDS, bump_alpha2, unit, valid_specular_normal

AOV_PREFIX = "ltsh_"
MAX_LOBES = 8
# Name of the quantity -> type of the AOV.
HIT_AOVS = {
    "hit": "VALUE",  # 1 where a surface was hit
    "receiver": "VALUE",  # `Light.receivers`
    "correct_normal": "VALUE",  # 1 where Cycles bends specular normals (use_bump_map_correction)
    "position": "COLOR",
    "incoming": "COLOR",  # towards the camera
    "smooth_normal": "COLOR",
    "true_normal": "COLOR",
}
# Only for finished pictures: the sum of the bits of the passes whose direct light is left to Cycles.
KEPT_AOV, KEPT_BITS = "kept", {"specular": 1, "diffuse": 2}
# -ln of the share of red, green and blue light that passes through glass, summed over all that a ray meets.
DENSITY_AOVS = "density_r", "density_g", "density_b"
# Name of the quantity -> type of the AOV, and the neutral value, which changes nothing. An AOV that no material needs
# is left out, unless its neutral value is None.
LOBE_AOVS = {
    "kind": ("VALUE", 0.0),  # one of LOBE_KINDS
    "weight": ("VALUE", 1.0),  # product of the factors of mixes
    "normal": ("COLOR", (0.0, 0.0, 0.0)),  # the Normal socket; zero: the smooth normal
    "color": ("COLOR", None),  # for conductors, the refractive index
    "roughness": ("VALUE", None),
    "anisotropy": ("VALUE", 0.0),
    "rotation": ("VALUE", 0.0),  # of the tangent, in turns
    "tangent": ("COLOR", (0.0, 0.0, 0.0)),
    "metallic": ("VALUE", 0.0),
    "ior": ("VALUE", 1.5),
    "diffuse_roughness": ("VALUE", 0.0),
    "specular_level": ("VALUE", 0.5),
    "tint": ("COLOR", (1.0, 1.0, 1.0)),  # for conductors, the extinction coefficient
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
    "conductor_4_5": 7.0,  # with the approximate reflectance that Cycles 4.5 uses
    "glass": 8.0,
    "sheen": 9.0,
    "velvet": 10.0,
}


def lobe_aov(name: str, slot: int) -> str:
    """Name of the AOV of the quantity `name` of LOBE_AOVS in a slot."""
    return f"{name}_{slot}"


def aov_kind(name: str) -> str:
    """Type of an AOV, whose name is from HIT_AOVS, DENSITY_AOVS or `lobe_aov`, or KEPT_AOV."""
    if name in (KEPT_AOV, *DENSITY_AOVS):
        return "VALUE"
    return HIT_AOVS[name] if name in HIT_AOVS else LOBE_AOVS[name.rpartition("_")[0]][0]


def read_layer(channels: dict[str, np.ndarray], name: str, components: str) -> np.ndarray:
    """Pass `name` as (H, W) float32, or (H, W, 3) for three components, from EXR `channels` of one view layer.

    Blender writes `<view layer>.<pass>.<component>`; any view layer will do. Raises ValueError.
    """
    planes = []
    for component in components:
        suffix = f".{name}.{component}"
        keys = [key for key in channels if key.endswith(suffix) or key == suffix[1:]]
        if len(keys) != 1:
            raise ValueError(
                f"render result: {len(keys)} channels named {suffix[1:]!r}, expected one; found {sorted(channels)}"
            )
        planes.append(channels[keys[0]])
    return planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def read_aov(channels: dict[str, np.ndarray], name: str) -> np.ndarray:
    """The AOV `name` (as in `aov_kind`): (H, W) or (H, W, 3) float32."""
    return read_layer(channels, AOV_PREFIX + name, "RGB" if aov_kind(name) == "COLOR" else "X")


def lobe_names(channels: dict[str, np.ndarray]) -> list[list[str]]:
    """For each slot in EXR `channels`, the names of LOBE_AOVS that were written."""
    written = {key.rpartition(".")[0].rpartition(AOV_PREFIX)[2] for key in channels if AOV_PREFIX in key}
    slots = [[name for name in LOBE_AOVS if lobe_aov(name, slot) in written] for slot in range(MAX_LOBES)]
    return [names for names in slots if names]


LEAST_VELVET = 0.01  # the least roughness of velvet, as in Cycles
# Cycles drops closures below this weight.
SMALLEST_WEIGHT = 1e-5


@dataclass(frozen=True)
class SurfaceHits:
    """What all lobes of a hit share, for P hits."""

    position: np.ndarray  # (P, 3)
    view: np.ndarray  # (P, 3)
    smooth_normal: np.ndarray  # (P, 3)
    true_normal: np.ndarray  # (P, 3)
    corrected: np.ndarray  # (P,) bool: Cycles bends the specular normals
    receiver: np.ndarray  # (P,) integers
    diffuse_albedo: np.ndarray | None  # (P, 3) sum over all lobes; None: estimated lobe by lobe

    def take(self, index) -> "SurfaceHits":
        """The hits at `index`."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return SurfaceHits(**{name: None if value is None else value[index] for name, value in values.items()})


# The kinds of lobes that may be anisotropic.
BRUSHED_KINDS = ("glossy", "principled", "metal", "conductor", "conductor_4_5")


def aspect_of(kind: str, anisotropy):
    """Factor by which a lobe of one of BRUSHED_KINDS divides alpha along the tangent and multiplies it across."""
    if kind != "glossy":
        return np.sqrt(1.0 - 0.9 * np.clip(anisotropy, 0.0, 1.0))
    share = np.clip(anisotropy, -0.99, 0.99)
    aspect = np.where(share < 0.0, 1.0 + share, 1.0 / (1.0 - share))
    return np.where(np.abs(share) > 1e-4, aspect, 1.0)


class LobeSlot:
    """The hits (Q,) that have a lobe in one slot, and its quantities there."""

    def __init__(self, hits: SurfaceHits, lobe, index, weight):
        self.lobe, self.index, self.weight = lobe, index, weight
        self.hits = hits.take(index)
        self.kind = np.rint(lobe["kind"][index]).astype(int)
        self.normal = self._normal("normal")
        self.specular_normal = self._bent(self.normal)
        self.roughness = np.clip(self.value("roughness", 1.0), 0.0, 1.0)

    @cached_property
    def alphas(self) -> np.ndarray:
        """Alphas (2, Q) of GGX along the tangent and across it."""
        alpha = self.roughness**2
        if "anisotropy" not in self.lobe or not (np.abs(self.value("anisotropy")) > 0.0).any():
            return np.stack([alpha, alpha])
        anisotropy, aspect = self.value("anisotropy"), 1.0
        for kind in BRUSHED_KINDS:
            aspect = np.where(self.of(kind)[:, 0], aspect_of(kind, anisotropy), aspect)
        return np.minimum(np.stack([alpha / aspect, alpha * aspect]), 1.0)

    @cached_property
    def gloss(self) -> np.ndarray:
        """Roughness (Q,) of the reflecting lobes, from the geometric mean of both alphas."""
        return np.sqrt(np.sqrt(self.alphas[0] * self.alphas[1]))

    def stretch(self) -> dict[str, np.ndarray]:
        """Anisotropy and tangent as in `SurfaceSamples`; {} if no lobe is anisotropic."""
        along, across = self.alphas
        if (along == across).all():
            return {}
        ratio = np.sqrt(np.divide(across, along, out=np.ones_like(along), where=along > 0.0))
        # Cycles rotates the tangent of a Glossy BSDF around its bent normal.
        axis = np.where(self.of("glossy"), self.specular_normal, self.normal)
        tangent, angle = self.value("tangent"), 2.0 * np.pi * self.value("rotation")[:, None]
        beside = np.sum(axis * tangent, axis=1, keepdims=True) * axis
        turned = beside + np.cos(angle) * (tangent - beside) + np.sin(angle) * np.cross(axis, tangent)
        return {"anisotropy": np.where(ratio > 0.0, 1.0 - ratio, 0.0), "tangent": turned}

    def value(self, name: str, default=None) -> np.ndarray:
        """The quantity `name`, (Q,) or (Q, 3). If it was not written: its neutral value or, without one, `default`."""
        if name in self.lobe:
            return self.lobe[name][self.index]
        kind, neutral = LOBE_AOVS[name]
        neutral = default if neutral is None else neutral
        return np.broadcast_to(np.float64(neutral), (len(self.index), 3) if kind == "COLOR" else (len(self.index),))

    def has(self, name: str) -> bool:
        """True if the quantity `name` exceeds SMALLEST_WEIGHT at some hit."""
        return name in self.lobe and bool((self.value(name) > SMALLEST_WEIGHT).any())

    def of(self, kind: str) -> np.ndarray:
        """Mask (Q, 1) of a kind of lobe."""
        return (self.kind == LOBE_KINDS[kind])[:, None]

    def _normal(self, name):
        normal = unit(self.value(name))
        return np.where(np.any(normal != 0.0, axis=-1, keepdims=True), normal, self.hits.smooth_normal)

    def _bent(self, normal):
        bent = valid_specular_normal(normal, self.hits.true_normal, self.hits.view)
        return np.where(self.hits.corrected[:, None], bent, normal)

    def coat_normal(self) -> np.ndarray:
        """Shading normal (Q, 3) of the coat."""
        return self._bent(self._normal("coat_normal"))

    def cosine(self, normal) -> np.ndarray:
        """Cosine (Q,) of the angle between `normal` and the view, in [0, 1]."""
        return np.clip(np.sum(normal * self.hits.view, axis=-1), 0.0, 1.0)

    @cached_property
    def color(self) -> np.ndarray:
        """Color (Q, 3), never negative."""
        return np.maximum(self.value("color", 0.0), 0.0)

    @cached_property
    def metallic(self) -> np.ndarray:
        """Share (Q,) of metal."""
        clipped = np.clip(self.value("metallic"), 0.0, 1.0)
        return np.where(self.of("metal")[:, 0], 1.0, np.where(self.of("principled")[:, 0], clipped, 0.0))

    @cached_property
    def transmission(self) -> np.ndarray:
        """Share (Q,) of transmission in what is not metal."""
        return np.where(self.of("principled")[:, 0], np.clip(self.value("transmission"), 0.0, 1.0), 0.0)

    @cached_property
    def albedos(self) -> tuple[np.ndarray, np.ndarray]:
        """Directional and average albedo (Q,) of the lobe without Fresnel."""
        return closures.albedos(self.gloss, self.cosine(self.specular_normal))

    def scattered(self, mean: np.ndarray) -> np.ndarray:
        """Factor (Q, 3) of multiple scattering for the mean reflectance `mean` (Q, 3); 1 for lobes without it."""
        if not self.has("multiple_scattering"):
            return np.ones_like(mean)
        factor = closures.multiple_scattering(mean, *self.albedos)
        return np.where((self.value("multiple_scattering") > 0.5)[:, None], factor, 1.0)


# Fields of SurfaceSamples that make a diffuse lobe differ from Lambert's, or a specular lobe from isotropic GGX; how
# many numbers each has.
SHAPE = {
    "diffuse_roughness": 1, "diffuse_rebound": 3, "sheen_a": 1, "sheen_b": 1, "anisotropy": 1, "tangent": 3,
}  # fmt: skip


@dataclass
class _LobeSamples:
    """Samples of one kind at the hits `index` (Q,). Fields that are left out are zero, or those of the hit."""

    index: np.ndarray
    normal: np.ndarray  # (Q, 3) of the specular lobe
    diffuse_normal: np.ndarray
    roughness: np.ndarray
    ior: np.ndarray
    specular: np.ndarray = field(default=None)  # (4, Q, 3): f0, f90, f82_factor, dielectric
    diffuse: np.ndarray = field(default=None)  # (Q, 3) estimated diffuse albedo
    behind: np.ndarray = field(default=None)  # (Q,) bool: the diffuse lobe is on the other side of the surface
    shape: dict[str, np.ndarray] = field(default_factory=dict)  # the fields of SHAPE that are not 0

    def __post_init__(self):
        count = len(self.index)
        self.specular = np.zeros((4, count, 3)) if self.specular is None else self.specular
        self.diffuse = np.zeros((count, 3)) if self.diffuse is None else self.diffuse
        self.behind = np.zeros(count, dtype=bool) if self.behind is None else self.behind


def samples_of_lobes(hits: SurfaceHits, lobes: list[dict[str, np.ndarray]]) -> tuple[SurfaceSamples, np.ndarray]:
    """Samples (S), and the hit (S,) of each: one for each lobe with a weight, at least one per hit, consecutive.

    `lobes` has the quantities of LOBE_AOVS that were written, (P,) or (P, 3), for each slot.
    """
    slots = [slot for slot in (_slot_of(hits, lobe) for lobe in lobes) if slot is not None]
    batches_of_slots = [_samples_of_slot(slot) for slot in slots]
    batches = [batch for of_slot in batches_of_slots for batch in of_slot]
    hits = _with_velvet(hits, slots, batches_of_slots)
    for slot, of_slot in zip(slots, batches_of_slots, strict=True):
        if slot.has("sheen_weight"):
            _put_under_sheen(hits, slot, of_slot, batches)
    bare = np.ones(len(hits.position), dtype=bool)
    for batch in batches:
        bare[batch.index] = False
    at = np.nonzero(bare)[0]
    normal, ones = hits.smooth_normal[at], np.ones(len(at))
    return _joined(hits, [*batches, _LobeSamples(at, normal, normal, ones, ones)])


def _joined(hits: SurfaceHits, batches: list[_LobeSamples]) -> tuple[SurfaceSamples, np.ndarray]:
    """The samples of all parts, and the hit of each, in the order of the hits."""
    index = np.concatenate([batch.index for batch in batches])
    order = np.argsort(index, kind="stable")
    joined = {
        name: np.concatenate([getattr(batch, name) for batch in batches])[order]
        for name in ("normal", "diffuse_normal", "roughness", "ior", "diffuse", "behind")
    }
    specular = np.concatenate([batch.specular for batch in batches], axis=1)[:, order]
    index, behind = index[order], joined["behind"]
    at_hit = hits.take(index)
    smooth_normal = np.where(behind[:, None], -at_hit.smooth_normal, at_hit.smooth_normal)
    shape = {}
    for name, count in SHAPE.items():
        if any(name in batch.shape for batch in batches):
            width = (3,) if count == 3 else ()
            values = [batch.shape.get(name, np.zeros((len(batch.index), *width))) for batch in batches]
            shape[name] = np.concatenate(values)[order]
    diffuse = joined["diffuse"]
    if hits.diffuse_albedo is not None:
        diffuse = _split(hits.diffuse_albedo, diffuse, index)
    # Cycles lights no diffuse lobe whose bumped normal is behind the surface.
    hidden = (joined["diffuse_normal"] * smooth_normal).sum(axis=1) <= 0.0
    samples = SurfaceSamples(
        position=at_hit.position,
        view=at_hit.view,
        normal=joined["normal"],
        diffuse_normal=joined["diffuse_normal"],
        roughness=joined["roughness"],
        **dict(zip(SPECULAR_FIELDS, specular, strict=True)),
        ior=joined["ior"],
        diffuse_albedo=np.where(hidden[:, None], 0.0, diffuse),
        geometric_normal=at_hit.true_normal,
        smooth_normal=smooth_normal,
        receiver=at_hit.receiver,
        **shape,
        bump_alpha2=np.where(at_hit.corrected, bump_alpha2(joined["diffuse_normal"], smooth_normal), 0.0),
    )
    return samples, index


def _split(albedo: np.ndarray, estimate: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The diffuse albedo (S, 3) of each sample: a share of its hit's (P, 3), in proportion to the `estimate` (S, 3).

    The samples of a hit add up to what Cycles says. If all of its estimates are 0, the first sample gets it.
    """
    count = len(albedo)
    sums = np.stack([np.bincount(index, weights=column, minlength=count) for column in estimate.T], axis=-1)[index]
    first = np.concatenate([[True], index[1:] != index[:-1]])[:, None] if len(index) else np.ones((0, 1), dtype=bool)
    share = np.divide(estimate, sums, out=np.where(first, 1.0, np.zeros_like(estimate)), where=sums > 0.0)
    return share * albedo[index]


def _slot_of(hits: SurfaceHits, lobe: dict[str, np.ndarray]) -> LobeSlot | None:
    """The hits that have a lobe in one slot; None if there are none."""
    weight = lobe["weight"] if "weight" in lobe else np.ones(len(hits.position))
    index = np.nonzero((np.rint(lobe["kind"]) > 0) & (weight > SMALLEST_WEIGHT))[0]
    return LobeSlot(hits, lobe, index, weight[index]) if len(index) else None


def _samples_of_slot(slot: LobeSlot) -> list[_LobeSamples]:
    """The parts of one slot. Its base comes first."""
    coat, under = _coat_samples(slot)
    transmitted = _transmission_samples(slot, under)
    base = _base_samples(slot, under)
    return [batch for batch in (base, coat, transmitted, _dark_metal(slot, under, base)) if batch is not None]


def _dark_metal(slot: LobeSlot, under: np.ndarray, base: _LobeSamples) -> _LobeSamples | None:
    """The metal of a slot as a part of its own, None if there is none. It is taken out of `base` where Cycles clips its
    reflectance at 0 and where it is mixed with a dielectric."""
    if not slot.metallic.any() or not (slot.value("tint") < 1.0).any():
        return None
    terms = _metal_terms(slot) * under
    at = np.nonzero(is_clipped(*terms[:3]) & base.specular[3].any(axis=1))[0]
    if not len(at):
        return None
    base.specular[:, at] -= terms[:, at]
    normal = slot.specular_normal[at]
    shape = {name: values[at] for name, values in slot.stretch().items()}
    return _LobeSamples(slot.index[at], normal, normal, slot.gloss[at], np.ones(len(at)), terms[:, at], shape=shape)


def _with_velvet(hits: SurfaceHits, slots: list[LobeSlot], batches_of_slots: list[list[_LobeSamples]]) -> SurfaceHits:
    """The hits with a diffuse albedo that includes velvet, which Cycles counts as specular."""
    if hits.diffuse_albedo is None or not any(slot.of("velvet").any() for slot in slots):
        return hits
    albedo = hits.diffuse_albedo.copy()
    for slot, (base, *_) in zip(slots, batches_of_slots, strict=True):
        albedo[slot.index] += np.where(slot.of("velvet"), base.diffuse, 0.0)
    return replace(hits, diffuse_albedo=albedo)


def _put_under_sheen(
    hits: SurfaceHits, slot: LobeSlot, of_slot: list[_LobeSamples], batches: list[_LobeSamples]
) -> None:
    """Take what the slot's sheen reflects away from its samples `of_slot`, and add samples that reflect it to
    `batches`."""
    base = of_slot[0]
    shine = np.maximum(slot.value("sheen_weight"), 0.0)[:, None] * np.maximum(slot.value("sheen_tint"), 0.0)
    shine = np.where(slot.of("principled"), shine, 0.0)
    most = shine.max(axis=1, keepdims=True)
    coat = np.clip(slot.value("coat_weight"), 0.0, 1.0)[:, None]
    normal = unit((1.0 - coat) * slot.normal + coat * slot.coat_normal())
    albedo, a, b = sheen_lobe(slot.cosine(normal), slot.value("sheen_roughness"))
    albedo = albedo[:, None]
    remaining = np.ones((len(hits.position), 1))
    remaining[base.index] = np.clip(1.0 - most * albedo, 0.0, 1.0)
    for batch in of_slot:
        batch.specular *= remaining[batch.index]
        batch.diffuse *= remaining[batch.index]
    shine = slot.weight[:, None] * shine * albedo
    at = np.nonzero(shine.any(axis=1))[0]
    shape = {"sheen_a": _tilted(a[at]), "sheen_b": b[at]}
    ones = np.ones(len(at))
    batches.append(_LobeSamples(slot.index[at], normal[at], normal[at], ones, ones, diffuse=shine[at], shape=shape))


def _tilted(a: np.ndarray) -> np.ndarray:
    """`a` (Q,) of sheen, kept away from 0, which would mean no sheen."""
    return np.where(np.abs(a) < 1e-5, 1e-5, a)


def _coat_samples(slot: LobeSlot):
    """The coat (None if there is none), and the share (Q, 3) of the lobe's weight that is left under it."""
    under = np.repeat(slot.weight[:, None], 3, axis=1)
    if not slot.has("coat_weight"):
        return None, under
    weight = np.maximum(slot.value("coat_weight"), 0.0)
    ior = np.maximum(slot.value("coat_ior"), 1.0)
    roughness = np.clip(slot.value("coat_roughness"), 0.0, 1.0)
    normal = slot.coat_normal()
    cosine = slot.cosine(normal)
    albedo, average = closures.albedos(roughness, cosine)
    mean = np.repeat(closures.dielectric_average(ior)[:, None], 3, axis=1)
    boost = closures.multiple_scattering(mean, albedo, average)
    f0 = np.repeat(closures.f0_of_ior(ior)[:, None], 3, axis=1)
    reflected = boost * albedo[:, None] * closures.dielectric_albedo(f0, ior, roughness, cosine)
    remaining = np.clip(1.0 - weight[:, None] * np.where(ior[:, None] > 1.0, reflected, 0.0), 0.0, 1.0)
    # The light crosses the coat along the refracted ray.
    depth = 1.0 / np.sqrt(1.0 - (1.0 - cosine**2) / ior**2).clip(1e-6)
    tint = np.maximum(slot.value("coat_tint"), 0.0) ** depth[:, None]
    remaining = remaining * (1.0 + weight[:, None] * (tint - 1.0))
    coated = np.nonzero((weight > SMALLEST_WEIGHT) & (slot.kind == LOBE_KINDS["principled"]))[0]
    specular = np.zeros((4, len(coated), 3))
    specular[3] = (boost * (weight * slot.weight)[:, None])[coated]
    coat = _LobeSamples(slot.index[coated], normal[coated], normal[coated], roughness[coated], ior[coated], specular)
    under[coated] *= remaining[coated]
    return coat, under


def _transmission_samples(slot: LobeSlot, under: np.ndarray):
    """What the transmission of a Principled BSDF reflects; None if there is none."""
    if not slot.has("transmission"):
        return None
    weight = slot.transmission * (1.0 - slot.metallic)
    at = np.nonzero(weight > SMALLEST_WEIGHT)[0]
    specular, ior = _glass_terms(slot, np.maximum(slot.value("tint"), 0.0), np.sqrt(np.minimum(slot.color, 1.0)))
    specular = (specular * (weight[:, None] * under))[:, at]
    return _LobeSamples(
        slot.index[at], slot.specular_normal[at], slot.normal[at], slot.roughness[at], ior[at], specular
    )


def _glass_terms(slot: LobeSlot, tint: np.ndarray, through: np.ndarray):
    """Specular terms (4, Q, 3) of a glass surface, and its index (Q,) as seen from the side of the view. `tint`
    multiplies the reflectance at normal incidence, `through` the light that passes."""
    ior = np.maximum(slot.value("ior"), 1e-5)
    f0 = np.clip(closures.f0_of_ior(ior)[:, None] * tint, 0.0, 1.0)
    ior = np.where(slot.value("backfacing") > 0.5, 1.0 / ior, ior)
    view = slot.roughness, slot.cosine(slot.specular_normal)
    factor = np.ones_like(through)
    if slot.has("multiple_scattering"):
        scattered = (slot.value("multiple_scattering") > 0.5)[:, None]
        factor = np.where(scattered, closures.glass_scattering(through, ior, *view), 1.0)
    return np.stack(closures.dielectric_terms(f0, ior)) * factor, ior


def _base_samples(slot: LobeSlot, under: np.ndarray) -> _LobeSamples:
    """The part of everything but coat and transmission."""
    specular = _metal_terms(slot)
    diffuse = np.where(slot.of("diffuse") | slot.of("translucent") | slot.of("velvet"), slot.color, 0.0)
    if slot.of("sheen").any():
        albedo = sheen_lobe(slot.cosine(slot.normal), slot.roughness)[0][:, None]
        diffuse = np.where(slot.of("sheen"), slot.color * albedo, diffuse)
    shape = _diffuse_shape(slot) | slot.stretch()
    ior = np.full(len(slot.index), closures.CONDUCTOR_FIT_IOR)
    for kind in ("conductor", "conductor_4_5"):
        if slot.of(kind).any():
            index, exact = (slot.color, np.maximum(slot.value("tint"), 0.0)), kind == "conductor"
            terms = np.stack(closures.conductor_fit(*index, exact))
            terms *= slot.scattered(closures.conductor_average(*index, exact))
            specular += np.where(slot.of(kind), terms, 0.0)
    if slot.of("glass").any():
        terms, own_ior = _glass_terms(slot, np.ones_like(slot.color), slot.color)
        specular += np.where(slot.of("glass"), terms * slot.color, 0.0)
        ior = np.where(slot.of("glass")[:, 0], own_ior, ior)
    if slot.of("principled").any():
        terms, own_ior, remaining = _dielectric_terms(slot)
        below = np.where(slot.of("principled"), ((1.0 - slot.metallic) * (1.0 - slot.transmission))[:, None], 0.0)
        specular += terms * below
        diffuse = diffuse + slot.color * below * remaining
        ior = np.where(slot.of("principled")[:, 0], own_ior, ior)
    behind = slot.of("translucent")
    return _LobeSamples(
        slot.index,
        slot.specular_normal,
        # Cycles also bends the normals of translucent lobes.
        np.where(behind, -slot.specular_normal, slot.normal),
        slot.gloss,
        ior,
        specular * under,
        diffuse * under,
        behind[:, 0],
        shape,
    )


def _diffuse_shape(slot: LobeSlot) -> dict[str, np.ndarray]:
    """The diffuse fields of SHAPE for the base of the slot."""
    shape = {}
    if slot.has("diffuse_roughness"):
        roughness = np.clip(slot.value("diffuse_roughness"), 0.0, 1.0)
        roughness = np.where((slot.of("diffuse") | slot.of("principled"))[:, 0], roughness, 0.0)
        shape["diffuse_roughness"] = roughness
        shape["diffuse_rebound"] = rough_diffuse.rebound(slot.color, slot.cosine(slot.normal), roughness)
    if slot.of("sheen").any() or slot.of("velvet").any():
        _, a, b = sheen_lobe(slot.cosine(slot.normal), slot.roughness)
        a = np.where(slot.of("sheen")[:, 0], _tilted(a), 0.0)
        a = np.where(slot.of("velvet")[:, 0], -np.clip(slot.roughness, LEAST_VELVET, 1.0), a)
        shape |= {"sheen_a": a, "sheen_b": b}
    return shape


def _metal_terms(slot: LobeSlot) -> np.ndarray:
    """Specular terms (4, Q, 3) of F82 metals, and of Glossy BSDFs, which reflect their color at all angles."""
    terms = np.zeros((4, len(slot.index), 3))
    if slot.metallic.any():
        f0, tint = np.minimum(slot.color, 1.0), np.clip(slot.value("tint"), 0.0, 1.0)
        f82_factor = closures.f82_term(f0, tint)
        factor = slot.metallic[:, None] * slot.scattered(closures.metal_average(f0, f82_factor))
        terms[:3] += factor * np.stack([f0, np.ones_like(f0), f82_factor])
    if slot.of("glossy").any():
        terms[:2] += np.where(slot.of("glossy"), slot.color * slot.scattered(slot.color), 0.0)
    return terms


def _dielectric_terms(slot: LobeSlot):
    """Specular terms (4, Q, 3) of the dielectric part of a Principled BSDF, its index (Q,), and the share (Q, 1) of the
    light left for the diffuse part."""
    ior, f0 = closures.specular_level_applied(np.maximum(slot.value("ior"), 1e-5), slot.value("specular_level"))
    f0 = np.clip(f0[:, None] * np.maximum(slot.value("tint"), 0.0), 0.0, 1.0)
    factor = slot.scattered(closures.dielectric_blend_average(f0, ior))
    cosine = slot.cosine(slot.specular_normal)
    albedo = closures.dielectric_albedo(f0, ior, slot.gloss, cosine)
    scattered = (slot.value("multiple_scattering") > 0.5)[:, None]
    albedo = albedo * np.where(scattered, factor * slot.albedos[0][:, None], 1.0)
    remaining = np.clip(1.0 - albedo.max(axis=-1, keepdims=True), 0.0, 1.0)
    return np.stack(closures.dielectric_terms(f0, ior)) * factor, ior, remaining
