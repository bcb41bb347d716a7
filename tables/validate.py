"""Measures a lookup table between its nodes, where a renderer uses it: `python -m tables validate`.

The quadrature shares nothing with the fit. The balance heuristic (Veach 1997) combines two sets of points: visible
normals of GGX (Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"), and points that are dense
at the horizon and at the plane of incidence. The second set matters because a linearly transformed lobe can hide a
needle at the horizon that samples of the BRDF alone never see.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np

from ltsh_addon.lobes import brdf
from ltsh_addon.lobes.lookup_table import LookupTable
from ltsh_addon.scene import EllipseLight, SurfaceSamples
from ltsh_addon.shading import evaluate_lobe, shade

from . import header, layouts
from .families import gauss_legendre

IOR = (1.1, 1.2, 1.33, 1.5, 1.8, 2.4, 3.0)
# Largest theta_o of the points, in degrees.
MOST_THETA = 88.0
# Samples of the hemisphere. RADIAL, ANGULAR: of visible normals. HORIZON: of heights above the horizon.
RADIAL, ANGULAR, HORIZON = 56, 56, 40
# Disk-shaped lights of the light error. LIGHTS: how many directions. LIGHT_RADII: their radii in degrees, in turn.
LIGHTS = 96
LIGHT_RADII = (10.0, 20.0, 35.0)


@dataclass(frozen=True)
class TableStatistics:
    """Errors of lookups between the nodes, relative to the lobe's L2 norm or to its albedo."""

    mean: float  # L2 error over the upper hemisphere, F = 1
    median: float
    percentile_90: float
    maximum: float
    solved_mean: float  # the same with the coefficients solved at the point itself, under the interpolated warp
    light_error: float  # root mean square error of integrals over disks, relative to their root mean square
    albedo_mean: float
    albedo_maximum: float
    negative_mass_mean: float
    negative_mass_maximum: float

    def to_dict(self) -> dict:
        """The figures by name."""
        return asdict(self)


def validate(table: LookupTable, count: int = 28) -> TableStatistics:
    """Statistics over count x count cell-centered points of (roughness, theta_o in degrees)."""
    errors, solved, albedo, negative, lights, light_errors = np.array(
        [_measure(table, *point) for point in grid(count)]
    ).T
    return TableStatistics(
        float(errors.mean()),
        float(np.median(errors)),
        float(np.quantile(errors, 0.9)),
        float(errors.max()),
        float(solved.mean()),
        float(np.sqrt(light_errors.sum() / lights.sum())),
        float(albedo.mean()),
        float(albedo.max()),
        float(negative.mean()),
        float(negative.max()),
    )


def grid(count, roughness=(0.1, 1.0)):
    """(cos_theta_o, roughness) of count x count cell-centered points, sorted by roughness."""
    center = (np.arange(count) + 0.5) / count
    rough = roughness[0] + center * (roughness[1] - roughness[0])
    return [(mu, value) for value in rough for mu in np.cos(np.radians(center * MOST_THETA))]


def error_map(table: LookupTable, count: int = 28, roughness=(0.1, 1.0)) -> np.ndarray:
    """Relative L2 errors (count, count) at the points of `validate`: roughness by row, theta_o by column."""
    return np.array([_measure(table, *point)[0] for point in grid(count, roughness)]).reshape(count, count)


def curvature(table: LookupTable, count: int = 28) -> float:
    """Mean second difference of the lobe along both axes, for steps of a cell of 64 x 64 nodes, relative to its norm,
    at the points of `validate`. Kinks between cells and waves of a fit make it larger."""
    step, differences = 1.0 / 63.0, []
    for mu, roughness in grid(count):
        directions, weights = (part[0] for part in hemisphere_samples(np.array([mu]), np.array([roughness**2])))
        position = np.clip(1.0 - np.sqrt(1.0 - np.arccos(mu) * 2.0 / np.pi), step, 1.0 - step)
        positions = position + step * np.array([0.0, -1.0, 1.0, 0.0, 0.0])
        rough = np.minimum(roughness, 1.0 - step) + step * np.array([0.0, 0.0, 0.0, -1.0, 1.0])
        cosine = np.cos(0.5 * np.pi * (1.0 - (1.0 - positions) ** 2))
        lobes = evaluate_lobe(table, cosine, rough, np.broadcast_to(directions, (5, *directions.shape)))
        bends = lobes[[1, 3]] - 2.0 * lobes[0] + lobes[[2, 4]]
        differences.append(np.sqrt((weights * bends**2).sum(axis=1) / (weights * lobes[0] ** 2).sum()).sum())
    return float(np.mean(differences))


def layout_errors(table: LookupTable, count: int = 28) -> dict[str, float]:
    """Mean L2 errors, as in `validate`, of the layouts for other engines by name."""
    halves = header.half_layers(table)
    rows, columns, parameters = table.warp.shape
    channels = np.moveaxis(halves, 0, 2).reshape(rows, columns, -1).astype(np.float32)
    coefficients = channels[..., parameters : parameters + table.coefficients[0, 0].size]
    rounded = replace(
        table, warp=channels[..., :parameters], coefficients=coefficients.reshape(table.coefficients.shape)
    )
    found = {"half": float(error_map(rounded, count).mean())}
    if table.family == "ltc":
        textures = layouts.layout_textures(layouts.LAYOUTS["three"], table)
        found["two_textures"] = float(np.mean([_textures_error(textures, *point) for point in grid(count)]))
    return found


def _textures_error(textures, mu, roughness) -> float:
    """L2 error of the two textures when shaders look them up."""
    directions, weights = (part[0] for part in hemisphere_samples(np.array([mu]), np.array([roughness**2])))
    lobe = brdf.ggx_brdf_cosine(mu, roughness**2, directions)
    size = textures.shape[1]
    row, column = np.sqrt(1.0 - mu) * (size - 1), roughness * (size - 1)
    i, j = min(int(row), size - 2), min(int(column), size - 2)
    (a, b), (c, d) = textures[:, i : i + 2, j : j + 2].swapaxes(0, 1).swapaxes(1, 2).astype(float)
    row, column = row - i, column - j
    first, second = (a * (1.0 - column) + b * column) * (1.0 - row) + (c * (1.0 - column) + d * column) * row
    m00, m20, m02, m22 = first
    x, y, z = directions.T
    warped = np.stack([m00 * x + m02 * z, y, m20 * x + m22 * z])
    length = np.linalg.norm(warped, axis=0)
    fitted = second[0] * np.maximum(warped[2], 0.0) / np.pi * abs(m00 * m22 - m02 * m20) / length**4
    return float(np.sqrt((weights * (fitted - lobe) ** 2).sum() / (weights * lobe**2).sum()))


def _measure(table, mu, roughness):
    """(L2 error, L2 error with solved coefficients, albedo error, negative mass, squared disk integrals and errors)."""
    directions, weights = (part[0] for part in hemisphere_samples(np.array([mu]), np.array([roughness**2])))
    directions, weights = directions[weights > 0.0], weights[weights > 0.0]
    lobe = brdf.ggx_brdf_cosine(mu, roughness**2, directions)
    fitted = evaluate_lobe(table, np.array([mu]), np.array([roughness]), directions[None])[0]
    squared, mass = (weights * lobe**2).sum(), (weights * lobe).sum()
    basis = _basis_at(table, mu, roughness, directions)
    weighted = basis * weights
    best = np.linalg.lstsq(weighted @ basis.T, weighted @ lobe, rcond=1e-13)[0] @ basis
    lit = disks(directions) * weights
    exact, approximate = lit @ lobe / mass, lit @ fitted / mass
    return (
        np.sqrt((weights * (fitted - lobe) ** 2).sum() / squared),
        np.sqrt((weights * (best - lobe) ** 2).sum() / squared),
        abs((weights * fitted).sum() / mass - 1.0),
        (weights * np.maximum(-fitted, 0.0)).sum() / mass,
        (exact**2).sum(),
        ((approximate - exact) ** 2).sum(),
    )


def _basis_at(table, mu, roughness, directions):
    """Warped basis functions (K, S) of the table at one point."""
    lobe = table.lookup(np.array([mu]), np.array([roughness]))
    x, y, z = directions.T
    warped = np.stack([lobe.xx * x + lobe.xz * z, lobe.yy * y, lobe.zz * z], axis=-1)
    length = np.linalg.norm(warped, axis=-1)
    unit = warped / length[:, None]
    if lobe.tilt is None:
        basis = table.basis(unit)
    else:
        basis = np.maximum(np.sin(lobe.tilt) * unit[:, 0] + np.cos(lobe.tilt) * unit[:, 2], 0.0)[None]
    basis = basis / length**3
    return basis / np.sqrt((basis * basis).mean(axis=1, keepdims=True))


def disks(directions):
    """Coverage (D, S) of each direction by D pairs of mirror-symmetric disk-shaped lights, spread evenly."""
    centers, radii = _centers_of_disks()
    reach = np.cos(radii)[:, None]
    mirrored = directions * np.array([1.0, -1.0, 1.0])
    return 0.5 * (centers @ directions.T > reach) + 0.5 * (centers @ mirrored.T > reach)


def _centers_of_disks():
    """Directions (D, 3) of the disks and their radii (D,) in radians."""
    k = np.arange(LIGHTS) + 0.5
    z, azimuth = 1.0 - k / LIGHTS, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    centers = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    return centers, np.radians(np.resize(LIGHT_RADII, LIGHTS))


@dataclass(frozen=True)
class CornerStatistics:
    """Errors for smooth surfaces, and figures of the corner of the table where these are seen at grazing angles."""

    smooth_mean: float  # L2 error, roughness 0.02 .. 0.1, theta_o 0 .. 88 degrees
    smooth_maximum: float
    lowest_albedo: float  # roughness 0 .. 0.02 and theta_o 88 .. 90 degrees; NaN if anything is not finite
    highest_albedo: float
    largest_albedo_step: float  # between neighbors of a 65 x 65 grid there
    largest_number: float  # stored

    def to_dict(self) -> dict:
        """The figures by name."""
        return asdict(self)


def validate_corners(table: LookupTable, count: int = 14) -> CornerStatistics:
    """Statistics of smooth surfaces, and of mirror-like ones at grazing angles."""
    errors = error_map(table, count, (0.02, 0.1))
    rough, theta = np.meshgrid(np.linspace(0.0, 0.02, 65), np.radians(np.linspace(88.0, 90.0, 65)), indexing="ij")
    lobe = table.lookup(np.cos(theta).ravel().clip(0.0), rough.ravel())
    albedo = lobe.albedo()[0].reshape(rough.shape)
    steps = max(np.abs(np.diff(albedo, axis=axis)).max() for axis in (0, 1))
    largest = max(np.abs(table.warp).max(), np.abs(table.coefficients).max())
    finite = all(np.isfinite(part).all() for part in (lobe.xx, lobe.xz, lobe.yy, lobe.zz, lobe.coefficients))
    lowest = albedo.min() if finite else np.nan
    return CornerStatistics(
        float(errors.mean()), float(errors.max()), float(lowest), float(albedo.max()), float(steps), float(largest)
    )


def fresnel_basis_error(table: LookupTable, count: int = 7) -> dict[float, tuple[float, float]]:
    """For each index of refraction, the largest relative errors of the directional albedo and of the lobe (L2). These
    are the errors of combining the table's Fresnel curves with the exact GGX lobe, at count x count points of
    `validate`."""
    worst = {index: (0.0, 0.0) for index in IOR}
    cosines = np.linspace(0.0, 1.0, table.fresnel_curves.shape[1])
    weights_of = table.dielectric_weights(np.array(IOR))
    for mu, roughness in grid(count):
        directions, weights = (part[0] for part in hemisphere_samples(np.array([mu]), np.array([roughness**2])))
        lobe = brdf.ggx_brdf_cosine(mu, roughness**2, directions)
        half = brdf.half_angle_cosine(mu, directions)
        for column, index in enumerate(IOR):
            exact = lobe * brdf.dielectric_reflectance(half, index)
            combined = lobe * np.interp(half, cosines, weights_of[:, column] @ table.fresnel_curves)
            albedo = abs((weights * combined).sum() / (weights * exact).sum() - 1.0)
            norm = np.sqrt((weights * (combined - exact) ** 2).sum() / (weights * exact**2).sum())
            worst[index] = (max(worst[index][0], float(albedo)), max(worst[index][1], float(norm)))
    return worst


def hemisphere_samples(cos_theta_o, alpha):
    """Directions (P, S, 3) with y > 0 and weights (P, S), for cos_theta_o (P,) and alpha (P,).

    The weighted sum of a function that is even in y is its integral over the upper hemisphere. S = RADIAL * ANGULAR +
    HORIZON * (3 HORIZON / 2). Directions below the horizon have weight 0.
    """
    visible, visible_share = _visible_normal_samples(cos_theta_o, alpha)
    low, low_share = _horizon_samples()
    count = len(cos_theta_o)
    directions = np.concatenate([visible, np.broadcast_to(low, (count, *low.shape))], axis=1)
    share = np.concatenate([visible_share, low_share])
    density = _visible_normal_density(cos_theta_o, alpha, directions) + _horizon_density(directions)
    return directions, np.where(directions[..., 2] > 0.0, share / density, 0.0)


def _visible_normal_samples(cos_theta_o, alpha):
    u, u_weights = gauss_legendre(RADIAL)
    azimuth = (np.arange(ANGULAR) + 0.5) / ANGULAR * np.pi
    u, azimuth = (grid.ravel() for grid in np.meshgrid(u, azimuth, indexing="ij"))
    sin_o = np.sqrt(1.0 - cos_theta_o**2)
    stretched = np.stack([alpha * sin_o, cos_theta_o], axis=0) / np.hypot(alpha * sin_o, cos_theta_o)
    z = (1.0 - u) * (1.0 + stretched[1][:, None]) - stretched[1][:, None]
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    half = np.stack(
        [
            alpha[:, None] * (radius * np.cos(azimuth) + stretched[0][:, None]),
            alpha[:, None] * radius * np.sin(azimuth),
            z + stretched[1][:, None],
        ],
        axis=-1,
    )
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    view = np.stack([sin_o, np.zeros_like(sin_o), cos_theta_o], axis=-1)[:, None]
    directions = 2.0 * (half * view).sum(axis=-1, keepdims=True) * half - view
    return directions, np.repeat(u_weights, ANGULAR) / ANGULAR


def _visible_normal_density(cos_theta_o, alpha, directions):
    view = np.stack([np.sqrt(1.0 - cos_theta_o**2), np.zeros_like(cos_theta_o), cos_theta_o], axis=-1)[:, None]
    x, y, z = np.moveaxis(directions + view, -1, 0)
    return brdf.visible_normal_density(cos_theta_o[:, None], x * x + y * y, z * z, (alpha**2)[:, None])


def _horizon_samples():
    u, weights = gauss_legendre(HORIZON)
    azimuths = HORIZON + HORIZON // 2
    azimuth = 0.5 * np.pi * (1.0 - np.cos(np.pi * (np.arange(azimuths) + 0.5) / azimuths))
    z, azimuth = (grid.ravel() for grid in np.meshgrid(u * u, azimuth, indexing="ij"))
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    return directions, np.repeat(weights, azimuths) / azimuths


def _horizon_density(directions):
    z = np.maximum(directions[..., 2], 1e-12)
    azimuth = np.arctan2(np.abs(directions[..., 1]), directions[..., 0])
    # azimuth = pi/2 (1 - cos(pi s)), s uniform; half of the density for either sign of y
    crowding = np.maximum(2.0 / np.pi * np.sqrt(np.maximum(azimuth * (np.pi - azimuth), 0.0)), 1e-9)
    return 0.5 / (2.0 * np.sqrt(z)) / (0.5 * np.pi**2 * crowding)


# ANISOTROPIES: settings of the nodes. AZIMUTHS: directions of the view around the normal at each point.
ANISOTROPIES, AZIMUTHS = (0.2, 0.5, 0.75, 0.95), 4
# Points of the independent quadrature: rings of visible normals, and points of each ring.
RINGS = (160, 320)


def validate_anisotropic(count: int = 3, anisotropies=ANISOTROPIES) -> dict[str, dict[float, dict[str, float]]]:
    """Errors of integrals of anisotropic lobes over disks, by kind of node and anisotropy. They are the root mean
    square over all points of `grid` (count x count) and AZIMUTHS, relative to that of the integrals, and the largest of
    a point.

    *technique* is shading with a table (the same for every table), *reference* is the technique `reference`. Both are
    compared with a quadrature of the textbook formulas over visible normals. Roughness is that of the node; the alphas
    are those of Cycles.
    """
    found = {}
    for kind in ("principled", "glossy"):
        for anisotropy in anisotropies:
            samples, alphas = _brushed(kind, anisotropy, count)
            points = zip(samples.view, samples.tangent, alphas, strict=True)
            exact = np.stack([_integrals_over_disks(*point) for point in points])
            figures = {}
            for name, technique in (("technique", "ltsh4"), ("reference", "reference")):
                lights = list(_disk_lights())
                shaded = shade(samples, lights, technique, passes=("specular",), workers=1, rows=np.arange(len(lights)))
                errors = np.linalg.norm(shaded.specular[:, :, 0].T - exact, axis=1)
                figures[name] = float(np.linalg.norm(errors) / np.linalg.norm(exact))
                figures[f"{name}_maximum"] = float((errors / np.linalg.norm(exact, axis=1)).max())
            found.setdefault(kind, {})[anisotropy] = figures
    return found


def _brushed(kind, anisotropy, count):
    """Samples (P) of lobes with F = 1, and both alphas (P, 2)."""
    mu, roughness = np.repeat(np.array(grid(count)), AZIMUTHS, axis=0).T
    number = np.arange(len(mu))
    azimuth = 0.5 * np.pi * (number % AZIMUTHS + (0.618034 * (number // AZIMUTHS)) % 1.0)
    aspect = 1.0 / (1.0 - anisotropy) if kind == "glossy" else np.sqrt(1.0 - 0.9 * anisotropy)
    alphas = np.minimum(roughness[:, None] ** 2 * np.array([1.0 / aspect, aspect]), 1.0)
    zero, one = np.zeros(len(mu)), np.ones((len(mu), 3))
    up = np.stack([zero, zero, zero + 1.0], axis=1)
    return SurfaceSamples(
        position=np.zeros((len(mu), 3)),
        view=np.stack([np.sqrt(1.0 - mu * mu), zero, mu], axis=1),
        normal=up,
        diffuse_normal=up,
        roughness=np.sqrt(np.sqrt(alphas[:, 0] * alphas[:, 1])),
        specular_f0=one,
        specular_f90=one,
        dielectric=zero,
        ior=zero + 1.5,
        diffuse_albedo=0.0 * one,
        anisotropy=1.0 - np.sqrt(alphas[:, 1] / alphas[:, 0]),
        tangent=np.stack([np.cos(azimuth), np.sin(azimuth), zero], axis=1),
    ), alphas


def _disk_lights():
    for number, (center, radius) in enumerate(zip(*_centers_of_disks(), strict=True)):
        across = np.cross(center, [1.0, 0.0, 0.0])
        across *= np.tan(radius) / np.linalg.norm(across)
        yield EllipseLight(str(number), center, across, np.cross(center, across), -center, np.ones(3))


def _integrals_over_disks(view, tangent, alphas):
    """Integrals (D,) of one anisotropic lobe over disks: sums over equally important visible normals of GGX (Dupuy and
    Benyoub 2023), times the share of each that is not masked."""
    frame = np.stack([tangent, np.cross([0.0, 0.0, 1.0], tangent), [0.0, 0.0, 1.0]])
    own, stretch = frame @ view, np.array([*alphas, 1.0])
    axis = own * stretch / np.linalg.norm(own * stretch)
    z, turn = np.meshgrid((np.arange(RINGS[0]) + 0.5) / RINGS[0], (np.arange(RINGS[1]) + 0.5) / RINGS[1], indexing="ij")
    z, turn = (
        (1.0 - z.ravel()) * (1.0 + axis[2]) - axis[2],
        2.0 * np.pi * (turn + 0.618034 * np.arange(RINGS[0])[:, None]),
    )
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    cap = np.stack([radius * np.cos(turn.ravel()), radius * np.sin(turn.ravel()), z], axis=1)
    half = (cap + axis) * stretch
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    light = 2.0 * (half @ own)[:, None] * half - own
    light = light[light[:, 2] > 0.0]
    lambda_i, lambda_o = (
        0.5 * (np.sqrt(1.0 + ((vector[..., :2] * alphas) ** 2).sum(axis=-1) / vector[..., 2] ** 2) - 1.0)
        for vector in (light, own)
    )
    weight = (1.0 + lambda_o) / (1.0 + lambda_i + lambda_o) / len(z)
    centers, radii = _centers_of_disks()
    return (centers @ frame.T @ light.T > np.cos(radii)[:, None]) @ weight
