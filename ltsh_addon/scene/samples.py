"""Surface samples: the points that are shaded, with all that shading needs."""

from dataclasses import dataclass, fields, replace

import numpy as np

# Fields of SurfaceSamples with one number per sample. All other fields are vectors or colors.
SCALAR_FIELDS = (
    "roughness", "ior", "bump_alpha2", "receiver", "diffuse_roughness", "sheen_a", "sheen_b", "anisotropy",
)  # fmt: skip


@dataclass(frozen=True)
class SurfaceSamples:
    """P surface points with all that shading needs. Vectors are unit, in world space; last axis is space or color.

    A surface with several lobes has one sample for each of them.

    Specular lobe: single-scatter GGX with alpha = roughness^2 and the Fresnel factor
    ``f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6 + dielectric F_d(c, ior)``. c is the cosine of the half angle, F_d
    the exact unpolarized reflectance of a dielectric, with total reflection where `ior` is below 1. Negative terms may
    stand for a tint. Without a dielectric, a sum of the first three terms below 0 counts as 0. With an `anisotropy`
    the alpha of GGX is roughness^2 / (1 - anisotropy) along the `tangent` and roughness^2 (1 - anisotropy) across it.

    Diffuse lobe: Lambert's; with a `diffuse_roughness` that of a rough surface, with a `sheen_a` that of sheen (see
    `shading.diffuse`). `diffuse_albedo` is what the specular layer leaves.

    Horizons, as in Cycles: the specular lobe ends at the horizons of both the shading and the geometric normal, a
    bump-mapped diffuse lobe at the horizon of the smooth normal. Toward that horizon the diffuse lobe is shadowed by
    2 / (1 + sqrt(1 + bump_alpha2 tan^2 theta_i)), theta_i the angle of the light from the smooth normal (Estevez,
    Lecocq and Stein 2019).
    """

    position: np.ndarray  # (P, 3) m
    view: np.ndarray  # (P, 3) towards the camera
    normal: np.ndarray  # (P, 3) shading normal of the specular lobe
    diffuse_normal: np.ndarray  # (P, 3) shading normal of the diffuse lobe
    roughness: np.ndarray  # (P,) in [0, 1]
    specular_f0: np.ndarray  # (P, 3)
    specular_f90: np.ndarray  # (P, 3)
    dielectric: np.ndarray  # (P, 3) weight of the dielectric lobe; (P,) is taken for all colors
    ior: np.ndarray  # (P,) relative index of refraction of the dielectric lobe
    diffuse_albedo: np.ndarray  # (P, 3)
    geometric_normal: np.ndarray | None = None  # (P, 3) for the horizon of the specular lobe; default: `normal`
    smooth_normal: np.ndarray | None = None  # (P, 3) interpolated, without bump maps; default: `diffuse_normal`
    bump_alpha2: np.ndarray | None = None  # (P,); default: 0
    specular_dip: np.ndarray | None = None  # (P, 3) of F82 metals; default: 0
    diffuse_roughness: np.ndarray | None = None  # (P,) sigma of Oren and Nayar in [0, 1]; default: 0
    diffuse_rebound: np.ndarray | None = None  # (P, 3) multiple scattering of such a surface; default: 0
    sheen_a: np.ndarray | None = None  # (P,) 0: no sheen; below 0: -sigma of velvet; default: 0
    sheen_b: np.ndarray | None = None  # (P,); default: 0
    receiver: np.ndarray | None = None  # (P,) integers that `Light.receivers` names; default: 0
    anisotropy: np.ndarray | None = None  # (P,) in (-1, 1); default: 0
    tangent: np.ndarray | None = None  # (P, 3); its part along `normal` does not matter; default: 0

    def __post_init__(self):
        count = np.shape(self.position)[0]
        defaults = {"geometric_normal": self.normal, "smooth_normal": self.diffuse_normal, "receiver": 0}
        if np.ndim(self.dielectric) == 1:
            object.__setattr__(self, "dielectric", np.broadcast_to(np.asarray(self.dielectric)[:, None], (count, 3)))
        for field in fields(self):
            value, expected = getattr(self, field.name), (count,) if field.name in SCALAR_FIELDS else (count, 3)
            if value is None:
                value = defaults.get(field.name, 0.0)
                value = np.broadcast_to(value, expected) if np.isscalar(value) else value
            value = np.asarray(value)
            if value.shape != expected:
                raise ValueError(f"surface samples: {field.name} has shape {value.shape}, expected {expected}")
            object.__setattr__(self, field.name, value)

    def __len__(self) -> int:
        return self.position.shape[0]

    @property
    def sharpest_roughness(self) -> np.ndarray:
        """Roughness (P,): the square root of the smaller of the two alphas of GGX."""
        if not self.anisotropy.any():
            return self.roughness
        across = np.maximum(1.0 - self.anisotropy, 1e-6)
        return self.roughness * np.sqrt(np.minimum(across, 1.0 / across))

    def take(self, index) -> "SurfaceSamples":
        """The samples at `index`: integers (Q,), a boolean mask (P,) or a slice."""
        count = len(self.position[index])
        return replace(self, **{field.name: _taken(getattr(self, field.name), index, count) for field in fields(self)})

    @classmethod
    def joined(cls, pieces: "list[SurfaceSamples]") -> "SurfaceSamples":
        """The samples of all `pieces`, at least one, one after another."""
        if len(pieces) == 1:
            return pieces[0]
        names = [field.name for field in fields(cls)]
        return cls(**{name: _one_after_another([getattr(piece, name) for piece in pieces]) for name in names})


def is_constant(values: np.ndarray) -> bool:
    """True for a broadcast scalar, which most fields of samples are."""
    return values.size > 0 and not any(values.strides)


def _taken(values: np.ndarray, index, count: int) -> np.ndarray:
    """The `count` rows at `index`."""
    return np.broadcast_to(values.flat[0], (count, *values.shape[1:])) if is_constant(values) else values[index]


def _one_after_another(pieces: list[np.ndarray]) -> np.ndarray:
    """All rows of the `pieces`."""
    if all(map(is_constant, pieces)) and len({piece.flat[0] for piece in pieces}) == 1:
        return np.broadcast_to(pieces[0].flat[0], (sum(map(len, pieces)), *pieces[0].shape[1:]))
    return np.concatenate(pieces)
