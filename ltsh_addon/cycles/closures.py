"""Reflectance of Cycles' closures: Fresnel terms, and albedos of microfacet, glass and sheen lobes."""

from functools import cache
from pathlib import Path

import numpy as np

from .. import shading
from ..lobes.brdf import dielectric_reflectance, schlick_curve

GLASS_NODES = 16
NORMALS_PER_AXIS = 24
SMALLEST_COSINE = 1e-4
MAX_F0 = 0.99
# Constant and slope of the fit in `dielectric_average`.
DIELECTRIC_AVERAGE = 4.08567, 1.00071


@cache
def glass_albedos(inside: bool) -> tuple[np.ndarray, np.ndarray]:
    """Share (R, C, Z) of the light that a surface reflects or transmits, seen from outside or from `inside`, by
    roughness, cosine of the view and ((ior - 1) / (ior + 1))^(1/2); and the integral (R, Z) of 2 mu times that."""
    nodes = np.clip(np.linspace(0.0, 1.0, GLASS_NODES), SMALLEST_COSINE, 1.0)
    albedo = np.empty((GLASS_NODES, GLASS_NODES, GLASS_NODES))
    root = np.sqrt(np.minimum(nodes**4, MAX_F0))
    for row, roughness in enumerate(nodes):
        normals = _visible_normals(roughness**2, nodes)
        for column, ior in enumerate((1.0 + root) / (1.0 - root)):
            albedo[row, :, column] = _albedo(normals, nodes, roughness**2, 1.0 / ior if inside else ior)
    # The albedo is linear between nodes, but mu times it is not, so each piece takes Simpson's rule.
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    ends = nodes[:, None] * albedo
    between = middle[:, None] * 0.5 * (albedo[:, 1:] + albedo[:, :-1])
    pieces = (ends[:, 1:] + ends[:, :-1] + 4.0 * between) * np.diff(nodes)[:, None] / 6.0
    return albedo, 2.0 * pieces.sum(axis=1)


def _visible_normals(alpha, cosine):
    """Equally probable visible normals (N, C, 3) for views with y = 0 and `cosine` (C,)."""
    steps = (np.arange(NORMALS_PER_AXIS) + 0.5) / NORMALS_PER_AXIS
    radius, turn = np.meshgrid(np.sqrt(steps), 2.0 * np.pi * steps)
    s, t = (radius * np.cos(turn)).reshape(-1, 1), (radius * np.sin(turn)).reshape(-1, 1)
    view = np.stack([alpha * np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    first = np.broadcast_to([0.0, 1.0, 0.0], view.shape)
    second = np.cross(view, first)
    half = 0.5 * (1.0 + view[:, 2])
    t = (1.0 - half) * np.sqrt(1.0 - s * s) + half * t
    height = np.sqrt(np.maximum(1.0 - s * s - t * t, 0.0))
    normal = s[..., None] * first + t[..., None] * second + height[..., None] * view
    normal[..., :2] *= alpha
    normal[..., 2] = np.maximum(normal[..., 2], 0.0)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _albedo(normals, cosine, alpha, ior):
    """Albedo (C,) for views with `cosine` (C,); `normals` are the `_visible_normals`."""
    view = np.stack([np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)
    towards = np.maximum((normals * view).sum(axis=-1), 0.0)
    fresnel = dielectric_reflectance(towards, ior)
    refracted = np.sqrt(np.maximum(1.0 - (1.0 - towards**2) / ior**2, 0.0))
    up = 2.0 * towards * normals[..., 2] - cosine
    down = (refracted - towards / ior) * normals[..., 2] + cosine / ior
    reflected, transmitted = (_smith_visibility(height, cosine, alpha) for height in (up, down))
    return (fresnel * reflected + (1.0 - fresnel) * transmitted).mean(axis=0)


def _smith_visibility(height, cosine, alpha):
    """Share of the light towards directions with cosine `height` that height-correlated Smith masking lets through, if
    the normal is visible; 0 below the horizon."""
    cosines = cosine, np.maximum(height, 1e-9)
    entering, leaving = (0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / value**2 - 1.0)) - 1.0) for value in cosines)
    return np.where(height > 0.0, (1.0 + entering) / (1.0 + entering + leaving), 0.0)


PATH = Path(__file__).with_name("sheen.npy")
SHEEN_NODES = 32
SMALLEST_ROUGHNESS = 1e-3


def sheen_lobe(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Albedo, a and b (3, P) of sheen, for `cosine` (P,) between view and normal and for Blender's `roughness` (P,).

    The lobe times cosine is albedo z / pi (a / ((a x + b z)^2 + (a y)^2 + z^2))^2, where z is along the normal and x
    points to the side of the view. It is a linearly transformed cosine (Zeltner, Burley and Chiang 2022, "Practical
    multiple-scattering sheen using linearly transformed cosines"). Albedo and lobe agree with Cycles 4.5 and 5.2 to
    1e-4.
    """
    roughness = np.maximum(roughness, SMALLEST_ROUGHNESS)
    lobe = np.stack([_interpolate(table, cosine, roughness) for table in _sheen_tables()])
    lobe[0] = np.maximum(lobe[0], 0.0)
    return lobe


def velvet_albedo(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Albedo (P,) of velvet, for `cosine` (P,) between view and normal and for `roughness` (P,).

    It agrees with Cycles to 1 % from a roughness of 0.3 on, and to 5 % at 0.1. Ashikhmin, Premoze and Shirley 2000, "A
    microfacet-based BRDF generator", section 4.3, without Fresnel.
    """
    return _interpolate(_velvet_table(), cosine, roughness)


@cache
def _sheen_tables() -> np.ndarray:
    """Albedo, a and b of sheen (3, N, N) by cosine and roughness."""
    return np.load(PATH).astype(np.float64).reshape(3, SHEEN_NODES, SHEEN_NODES)


@cache
def _velvet_table() -> np.ndarray:
    """Albedos of velvet (N, N) by cosine and roughness, by the midpoint rule over light directions."""
    steps = np.linspace(0.0, 1.0, SHEEN_NODES)
    view, sigma = np.meshgrid(np.maximum(steps, 0.5 / SHEEN_NODES), np.maximum(steps, 0.01), indexing="ij")
    view, sigma = view.reshape(-1, 1), sigma.reshape(-1, 1)
    angle = (np.arange(VELVET_STEPS) + 0.5) / VELVET_STEPS
    theta, phi = (angles.ravel() for angles in np.meshgrid(0.5 * np.pi * angle, np.pi * angle))
    light, across = np.cos(theta), np.sin(theta) * np.cos(phi)
    half2 = 0.5 * (1.0 + view * light + np.sqrt(1.0 - view**2) * across)  # squared cosine of view and half vector
    normal2 = np.clip((view + light) ** 2 / (4.0 * half2), 0.0, 1.0 - 1e-9)  # squared cosine of normal and half vector
    ratio = 2.0 * np.sqrt(normal2 / half2)
    masked = np.minimum(1.0, ratio * np.minimum(view, light))
    density = np.exp(-normal2 / ((1.0 - normal2) * sigma**2)) / (np.pi * (sigma * (1.0 - normal2)) ** 2)
    area = np.sin(theta) * np.pi**2 / VELVET_STEPS**2  # both halves of the circle
    return (density * masked / (4.0 * view) * area).sum(axis=-1).reshape(SHEEN_NODES, SHEEN_NODES)


VELVET_STEPS = 48
ALBEDO_NODES = 32
# FIT_COSINES: where conductors are fitted. CONDUCTOR_FIT_IOR: index of the dielectric curve in that fit.
FIT_COSINES = (np.arange(64) + 0.5) / 64.0
CONDUCTOR_FIT_IOR = 1.5


def f0_of_ior(ior: np.ndarray) -> np.ndarray:
    """Reflectance at normal incidence of a dielectric of relative `ior`."""
    return np.square((ior - 1.0) / (ior + 1.0))


def specular_level_applied(ior: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of refraction (Q,) and f0 (Q,) of a Principled dielectric; f0 is that of `ior` times 2 `level`."""
    f0 = f0_of_ior(ior) * np.where(level == 0.5, 1.0, 2.0 * np.maximum(level, 0.0))
    root = np.sqrt(np.minimum(f0, MAX_F0))
    scaled = (1.0 + root) / (1.0 - root)
    return np.where(level == 0.5, ior, np.where(ior < 1.0, 1.0 / scaled, scaled)), f0


def f82_term(f0: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """Factor (Q, 3) of -c (1 - c)^6 in the reflectance of a metal, which is Schlick's times `tint` at c = 1 / 7 (Kutz,
    Hasan and Edmondson 2021, "Novel aspects of the Adobe Standard Material", the F82-tint model)."""
    schlick = f0 + (1.0 - f0) * (6.0 / 7.0) ** 5
    return schlick * (1.0 - tint) * 7.0 / (6.0 / 7.0) ** 6


def metal_average(f0: np.ndarray, f82_factor: np.ndarray) -> np.ndarray:
    """Integral (Q, 3) of 2 c F(c) for an F82 metal."""
    return f0 + (1.0 - f0) / 21.0 - f82_factor / 126.0


def dielectric_average(ior: np.ndarray) -> np.ndarray:
    """Integral of 2 c F(c) for a dielectric, from the fit that Cycles uses (Kulla and Conty 2017, "Revisiting
    physically based shading at Imageworks"). It is accurate to 0.006 for an `ior` of 1 to 3."""
    start, slope = DIELECTRIC_AVERAGE
    below = 0.997118 + ior * (0.1014 - ior * (0.965241 + ior * 0.130607))
    return np.where(ior < 1.0, below, (ior - 1.0) / (start + slope * ior))


def dielectric_blend_average(f0: np.ndarray, ior: np.ndarray) -> np.ndarray:
    """Integral (Q, 3) of 2 c F(c) for a dielectric whose reflectance runs from `f0` (Q, 3) to 1."""
    plain = f0_of_ior(ior)
    share = np.clip((dielectric_average(ior) - plain) / (1.0 - plain), 0.0, 1.0)
    return f0 + (1.0 - f0) * share[:, None]


def multiple_scattering(average: np.ndarray, albedo: np.ndarray, average_albedo: np.ndarray) -> np.ndarray:
    """Factor (Q, 3) that Multiscatter GGX puts on a lobe of mean reflectance `average` (Q, 3).

    It is 1 + Fms (1 - E) / E, where Fms = F Ea / (1 - F (1 - Ea)), F = `average`, E = `albedo` (Q,), and Ea =
    `average_albedo` (Q,) (Kulla and Conty 2017, with one factor F less, because the lobe brings it).
    """
    mean = average_albedo[:, None]
    scattered = average * mean / (1.0 - average * (1.0 - mean))
    return 1.0 + scattered * ((1.0 - albedo) / albedo)[:, None]


def conductor_reflectance(cosine, index: np.ndarray, extinction: np.ndarray, exact: bool = True) -> np.ndarray:
    """Unpolarized Fresnel reflectance of a conductor of complex index `index` + i `extinction`; broadcasts.

    `exact` is the formula of Cycles 5 (Born and Wolf, "Principles of optics", section 14.2). Otherwise it is the
    formula of Cycles 4.5, the limit for |index + i extinction| much larger than 1.
    """
    index, extinction = np.maximum(index, 1e-6), np.maximum(extinction, 0.0)
    squares, cosine2 = index * index + extinction * extinction, cosine * cosine
    if not exact:
        double = 2.0 * index * cosine
        parallel = (squares * cosine2 - double + 1.0) / (squares * cosine2 + double + 1.0)
        return 0.5 * (parallel + (squares - double + cosine2) / (squares + double + cosine2))
    sine2 = 1.0 - cosine2
    difference = index * index - extinction * extinction - sine2
    length = np.sqrt(difference * difference + 4.0 * np.square(index * extinction))
    double = 2.0 * cosine * np.sqrt(np.maximum(0.5 * (length + difference), 0.0))
    perpendicular = (length + cosine2 - double) / (length + cosine2 + double)
    upper = cosine2 * length + sine2 * sine2
    return 0.5 * perpendicular * (1.0 + (upper - double * sine2) / (upper + double * sine2))


def conductor_fit(index: np.ndarray, extinction: np.ndarray, exact: bool):
    """(f0, f90, f82_factor, dielectric) (Q, 3): the least-squares fit of a conductor's reflectance. Its dielectric
    curve is that of CONDUCTOR_FIT_IOR."""
    values = conductor_reflectance(FIT_COSINES[:, None, None], index, extinction, exact)
    constant, schlick, f82_factor, dielectric = np.einsum("kc,cqx->kqx", _fit_matrix(), values)
    return constant, constant + schlick, -f82_factor, dielectric


def conductor_average(index: np.ndarray, extinction: np.ndarray, exact: bool) -> np.ndarray:
    """Mean reflectance (Q, 3) by which Cycles scales the multiple scattering of conductors: that of an F82 metal with
    the same reflectance at the cosines 1 and 1 / 7."""
    f0, low = (conductor_reflectance(cosine, index, extinction, exact) for cosine in (1.0, 1.0 / 7.0))
    schlick = f0 + (1.0 - f0) * (6.0 / 7.0) ** 5
    return np.clip(metal_average(f0, (schlick - low) * 7.0 / (6.0 / 7.0) ** 6), 0.0, 1.0)


def dielectric_terms(f0: np.ndarray, ior: np.ndarray):
    """(f0, f90, f82_factor, dielectric) (Q, 3) of a dielectric whose reflectance runs from `f0` (Q, 3) to 1.

    Cycles has F = mix(f0, 1, (F_d - f_d) / (1 - f_d)), where f_d is F_d at normal incidence; this is linear in F_d.
    """
    plain = f0_of_ior(ior)[:, None]
    constant, factor = (f0 - plain) / (1.0 - plain), (1.0 - f0) / (1.0 - plain)
    return constant, constant, np.zeros_like(constant), factor


def glass_scattering(tint: np.ndarray, ior: np.ndarray, roughness: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Factor (Q, 3) that Multiscatter GGX puts on the reflection of glass of color `tint` (Q, 3)."""
    factor = np.empty_like(tint)
    for inside in (False, True):
        at = np.nonzero((ior < 1.0) == inside)[0]
        if len(at):
            (table, average), coordinate = glass_albedos(inside), _ior_coordinate(ior[at])
            albedo = _interpolate(table, roughness[at], cosine[at], coordinate)
            factor[at] = multiple_scattering(tint[at], albedo, _interpolate(average, roughness[at], coordinate))
    return factor


def albedos(roughness: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E (Q,), and its average (Q,) over directions, interpolated as in Cycles."""
    directional, average = albedo_tables()
    return _interpolate(directional, roughness, cosine), _interpolate(average, roughness)


def dielectric_albedo(f0: np.ndarray, ior: np.ndarray, roughness: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Albedo (Q, 3) divided by E of a dielectric whose reflectance runs from `f0` (Q, 3) to 1, as in Cycles."""
    share = _interpolate(_blend_table(), roughness, cosine, _ior_coordinate(ior))[:, None]
    return f0 + (1.0 - f0) * share


@cache
def albedo_tables() -> tuple[np.ndarray, np.ndarray]:
    """E (N, N) by roughness and cosine, and its average (N,) by roughness, at uniform nodes over [0, 1]."""
    table = shading.load_table("ltsh4")
    nodes = np.clip(np.linspace(0.0, 1.0, ALBEDO_NODES), SMALLEST_COSINE, 1.0)
    roughness, cosine = np.meshgrid(nodes, nodes, indexing="ij")
    directional = table.lookup(cosine.ravel(), roughness.ravel(), curves=1).albedo()[0]
    return np.clip(directional.reshape(roughness.shape), 1e-3, 1.0), np.clip(table.average_albedos(nodes)[0], 1e-3, 1.0)


@cache
def _blend_table():
    """Position of a dielectric's albedo between f0 and 1, by roughness, cosine, and ((ior - 1) / (ior + 1))^(1/2)."""
    table = shading.load_table("ltsh4")
    nodes = np.clip(np.linspace(0.0, 1.0, GLASS_NODES), SMALLEST_COSINE, 1.0)
    roughness, cosine = np.meshgrid(nodes, nodes, indexing="ij")
    curves = table.lookup(cosine.ravel(), roughness.ravel()).albedo()
    f0 = np.minimum(nodes**4, MAX_F0)
    ior = np.clip((1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0)), table.fresnel_ior[0], table.fresnel_ior[-1])
    f0 = f0_of_ior(ior)
    share = (np.einsum("fz,fq->qz", table.dielectric_weights(ior), curves / curves[0]) - f0) / (1.0 - f0)
    return np.clip(share, 0.0, 1.0).reshape(*roughness.shape, GLASS_NODES)


def _ior_coordinate(ior):
    return np.sqrt(np.abs((ior - 1.0) / (ior + 1.0)))


@cache
def _fit_matrix():
    """Matrix (4, C) that turns values at FIT_COSINES into the coefficients of the four curves of samples."""
    c, weight = FIT_COSINES, np.sqrt(FIT_COSINES)
    curves = [np.ones_like(c), schlick_curve(c), schlick_curve(c) * c * (1.0 - c)]
    curves.append(dielectric_reflectance(c, CONDUCTOR_FIT_IOR))
    return np.linalg.pinv(np.stack(curves, axis=1) * weight[:, None], rcond=1e-6) * weight


def _interpolate(table: np.ndarray, *coordinates: np.ndarray) -> np.ndarray:
    """Multilinear interpolation (Q,) in `table`, whose axes have uniform nodes over [0, 1]."""
    corners, fractions = [], []
    for size, coordinate in zip(table.shape, coordinates, strict=True):
        position = np.clip(coordinate, 0.0, 1.0) * (size - 1)
        corner = np.minimum(position.astype(np.intp), size - 2)
        corners.append(corner)
        fractions.append(position - corner)
    result = np.zeros(np.shape(coordinates[0]))
    for offsets in np.ndindex(*(2,) * len(corners)):
        weight = np.ones_like(result)
        for offset, fraction in zip(offsets, fractions, strict=True):
            weight = weight * (fraction if offset else 1.0 - fraction)
        result += weight * table[tuple(corner + offset for corner, offset in zip(corners, offsets, strict=True))]
    return result
