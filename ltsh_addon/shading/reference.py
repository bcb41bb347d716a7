"""Quadrature of the true BRDF over area lights, with an estimate of its error: the technique `reference`.

W (see `lookup_table`) with A = B = C = 1, the limit of GGX for alpha -> 0, warps the light, which flattens the lobe's
peak. No fitted number enters. With an apex p inside the warped light and the light's boundary w(t),

    int f dw = contour_integral (w x dw) . p  int_0^rho f J sin(r) dr / sin^2(rho),

where rho is the angle between p and w(t), the inner integral runs along the arc from p to w(t), and J is the Jacobian
of the warp. The integrands are analytic on every piece of the boundary, so Gauss-Legendre rules converge fast. Their
order grows until two orders agree. Lights are exact ellipses, convex pieces of polygons, and the parts of these in a
cone.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from ..emitters import light_profile
from ..emitters.facing import FacingDisk, emission
from ..emitters.light_polygons import in_front, light_view, to_local, visible_polygons
from ..lobes import brdf
from ..lobes.brdf import HalfBoundary, HalfVectors
from ..lobes.edge_integrals import arc_factors
from ..lobes.lookup_table import MIN_ALPHA, WARP_REGULARIZATION, Lobe
from ..lobes.polygon import convex_pieces, dot, one_plus_cosine, project_to_sphere, split_at_horizon
from ..scene import Light, PolygonLight

_ELLIPSE_PIECES = 8
# Evaluations per batch, few enough for the arrays of one batch to stay in the cache.
_BATCH = 30_000
# Chords per arc of a cone's edge, where the factor of the spread is 0.
_CONE_CHORDS = 4


@dataclass(frozen=True)
class Effort:
    """The orders tried for an integral, and the error at which that ends."""

    orders: tuple[tuple[int, int], ...]  # Gauss-Legendre orders along each piece of the boundary and a radius, in turn
    tolerance: float
    round_corners: int  # of the polygon for a round light that is not integrated as an exact ellipse


EXACT = Effort(((5, 6), (8, 10), (14, 16), (24, 26), (40, 44), (72, 72)), 1e-4, 128)
# For anisotropic lobes in techniques with a table. QUICK: orders for an arc. QUICK_NEAR: orders for an arc whose ends
# are less than NEAR from the apex. QUICK_CORNERS: corners of a round light.
QUICK, QUICK_NEAR = (3, 4), (2, 3)
QUICK_CORNERS, NEAR = 32, 0.35


@dataclass(frozen=True)
class PolygonBoundary:
    """Warped spherical polygons with the corners `unit` (3, V, P)."""

    unit: np.ndarray

    @classmethod
    def warped(cls, warp: Lobe, polygon: np.ndarray) -> "PolygonBoundary":
        """For polygons (3, V, P) in the local frame."""
        return cls(project_to_sphere(warp.to_original_domain(polygon)))

    pieces = property(lambda self: self.unit.shape[1])

    def take(self, index) -> "PolygonBoundary":
        """The boundaries of the points `index` (Q,)."""
        return PolygonBoundary(self.unit[:, :, index])

    def apex(self) -> np.ndarray:
        """Unit vectors (3, P) inside: the peak of the lobe, e_z, if it is inside, otherwise the mean corner."""
        following = np.roll(self.unit, -1, axis=1)
        side = self.unit[0] * following[1] - self.unit[1] * following[0]
        inside = (side >= 0.0).all(axis=0) | (side <= 0.0).all(axis=0)
        return _peak_or_mean(inside, self.unit)

    def nodes(self, order: int):
        """Unit vectors w (3, B, P) on the boundary, and (w x dw) times the quadrature weight (3, B, P)."""
        fractions, weights = _unit_interval(order)
        start, end = self.unit[:, :, None], np.roll(self.unit, -1, axis=1)[:, :, None]
        cosine = (start * end).sum(axis=0)
        normal = np.cross(start, end, axis=0)
        theta = np.arctan2(np.sqrt((normal**2).sum(axis=0)), cosine)
        points = _slerp(start, end, theta, fractions[:, None])
        measure = normal * arc_factors(one_plus_cosine(start + end))[0] * weights[:, None]
        count = self.unit.shape[2]
        return points.reshape(3, -1, count), measure.reshape(3, -1, count)


@dataclass(frozen=True)
class EllipseBoundary:
    """Warped ellipses center + cos(t) half_u + sin(t) half_v, each (3, P). They are above the horizon for
    |t - middle| < reach; a chord along the horizon closes the boundary."""

    center: np.ndarray
    half_u: np.ndarray
    half_v: np.ndarray
    middle: np.ndarray  # (P,)
    reach: np.ndarray  # (P,), pi if the whole ellipse is above the horizon, 0 if none of it is

    @classmethod
    def warped(cls, warp: Lobe, center, half_u, half_v) -> "EllipseBoundary":
        """For ellipses with centers and half axes (3, P) in the local frame."""
        center, half_u, half_v = (warp.to_original_domain(vector) for vector in (center, half_u, half_v))
        swing = np.hypot(half_u[2], half_v[2])
        ratio = np.divide(-center[2], swing, out=np.where(center[2] > 0.0, -1.0, 1.0), where=swing > 0.0)
        return cls(center, half_u, half_v, np.arctan2(half_v[2], half_u[2]), np.arccos(np.clip(ratio, -1.0, 1.0)))

    pieces = _ELLIPSE_PIECES + 1

    def take(self, index) -> "EllipseBoundary":
        """The boundaries of the points `index` (Q,)."""
        vectors = (self.center[:, index], self.half_u[:, index], self.half_v[:, index])
        return EllipseBoundary(*vectors, self.middle[index], self.reach[index])

    def apex(self) -> np.ndarray:
        """As `PolygonBoundary.apex`; e_z is inside if the z axis meets the ellipse."""
        normal = np.cross(self.half_u, self.half_v, axis=0)
        height = dot(normal, self.center) / np.where(normal[2] != 0.0, normal[2], 1.0)
        offset = -self.center + height * np.array([0.0, 0.0, 1.0])[:, None]
        scale = dot(normal, normal)
        scale = np.where(scale > 0.0, scale, 1.0)
        u = dot(np.cross(offset, self.half_v, axis=0), normal) / scale
        v = dot(np.cross(self.half_u, offset, axis=0), normal) / scale
        inside = (normal[2] != 0.0) & (height > 0.0) & (u * u + v * v <= 1.0)
        turns = (np.arange(16) + 0.5) / 8.0 - 1.0
        return _peak_or_mean(inside, project_to_sphere(self._at(turns[:, None])))

    def nodes(self, order: int):
        """As `PolygonBoundary.nodes`."""
        fractions, weights = _unit_interval(order)
        turns = (2.0 * (np.arange(_ELLIPSE_PIECES)[:, None] + fractions) / _ELLIPSE_PIECES - 1.0).ravel()[:, None]
        vectors = self._at(turns)
        angle = self.middle + turns * self.reach
        velocity = np.cos(angle) * self.half_v[:, None] - np.sin(angle) * self.half_u[:, None]
        step = np.tile(weights, _ELLIPSE_PIECES)[:, None] * 2.0 / _ELLIPSE_PIECES * self.reach
        measure = np.cross(vectors, velocity, axis=0) * step / dot(vectors, vectors)
        closing = PolygonBoundary(project_to_sphere(self._at(np.array([[1.0], [-1.0]]))))
        points, closing_measure = closing.nodes(order)
        # A polygon of two corners has two edges. Only the first is the chord, and only if the ellipse is clipped.
        closing_measure = np.where(self.reach < np.pi, closing_measure[:, :order], 0.0)
        return (
            np.concatenate([project_to_sphere(vectors), points[:, :order]], axis=1),
            np.concatenate([measure, closing_measure], axis=1),
        )

    def _at(self, turns):
        angle = self.middle + turns * self.reach
        return self.center[:, None] + np.cos(angle) * self.half_u[:, None] + np.sin(angle) * self.half_v[:, None]


@dataclass(frozen=True)
class FacingEmission:
    """As `Cone`, for lights that face every point, in local frames. `offset` goes from the points to their centers."""

    light: Light
    frame: np.ndarray  # (3, 3, P)
    offset: np.ndarray  # (3, P) in the world

    @property
    def axis(self) -> np.ndarray:
        """Zero: it has no meaning here."""
        return np.zeros_like(self.offset)

    @property
    def at_foot(self) -> np.ndarray:
        """False everywhere: there is no tip."""
        return np.zeros(self.offset.shape[1], bool)

    def take(self, index) -> "FacingEmission":
        """The emission for the points `index` (Q,)."""
        return FacingEmission(self.light, self.frame[:, :, index], self.offset[:, index])

    def factor(self, direction: np.ndarray) -> np.ndarray:
        """Factors (..., P) for unit directions (3, ..., P) in local frames."""
        world = np.stack([sum(self.frame[row, axis] * direction[row] for row in range(3)) for axis in range(3)])
        offset = self.offset.reshape(3, *[1] * (direction.ndim - 2), -1)
        return emission(self.light, np.broadcast_to(offset, world.shape), world)


@dataclass(frozen=True)
class Cone:
    """The profiles of lights as functions of the angle from `axis`."""

    axis: np.ndarray  # (3, P) from the points straight to the lights' planes
    distance: np.ndarray  # (P,) from the points to the planes
    profile: light_profile.Profile
    at_foot: np.ndarray  # (P,) True if the light is best integrated around `axis`, where the factor has its tip

    def take(self, index) -> "Cone":
        """The cones of the points `index` (Q,)."""
        return Cone(self.axis[:, index], self.distance[index], self.profile, self.at_foot[index])

    def factor(self, direction: np.ndarray) -> np.ndarray:
        """Factors (..., P) for unit directions (3, ..., P)."""
        across = np.cross(direction, np.broadcast_to(self._axis_for(direction), direction.shape), axis=0)
        along = dot(direction, self._axis_for(direction))
        tangent = np.sqrt(dot(across, across)) / np.maximum(along, 1e-30)
        return self.profile.at(tangent * self.distance, self.distance)

    def _axis_for(self, direction):
        return self.axis.reshape(3, *[1] * (direction.ndim - 2), -1)


def lobe_integrals(
    make_boundary,
    setting: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    effort: Effort = EXACT,
    cone: Cone | FacingEmission | None = None,
    metal=None,
):
    """Integrals (4, P) of the GGX BRDF times cosine over lights, and error estimates (P,).

    `setting` is cos_theta_o, alpha and the relative ior of a dielectric, (P,) each. `make_boundary(warp)` returns the
    warped boundary of the part with z >= 0 of each light, which must be convex, in the local frame of cos_theta_o. The
    rows have the Fresnel factors 1, (1 - c)^5, c (1 - c)^6 and that of the dielectric. The order grows until two
    successive orders differ by less than the tolerance times the first row plus 1e-6. The estimate is the last
    difference, infinite after a single order. With a `cone`, the integrand includes its factor. With a `metal`, f0, f90
    and dip (P, 3), three more rows follow: how far its reflectance falls below 0.
    """
    cos_theta_o, alpha, ior = setting
    warp = limit_warp(cos_theta_o, alpha)
    boundary = make_boundary(warp)
    apex = boundary.apex()
    if cone is not None:
        apex = np.where(cone.at_foot, project_to_sphere(warp.to_original_domain(cone.axis)), apex)
    count = len(cos_theta_o)
    result, error = np.zeros((4 if metal is None else 7, count)), np.full(count, np.inf)
    open_points = np.arange(count)
    for level, order in enumerate(effort.orders):
        batch = max(_BATCH // (boundary.pieces * order[0] * order[1]), 1)
        for start in range(0, len(open_points), batch):
            index = open_points[start : start + batch]
            here = (warp.take(index), cos_theta_o[index], np.maximum(alpha[index], MIN_ALPHA), ior[index])
            its_cone = None if cone is None else cone.take(index)
            its_metal = None if metal is None else [term[index] for term in metal]
            value = _fixed_order(order, boundary.take(index), apex[:, index], here, its_cone, its_metal)
            if level > 0:
                error[index] = np.abs(value - result[:, index]).max(axis=0)
            result[:, index] = value
        open_points = open_points[error[open_points] > effort.tolerance * np.abs(result[0, open_points]) + 1e-6]
        if len(open_points) == 0:
            break
    return np.maximum(result, 0.0), error


def half_vector_integrals(halves: HalfVectors, polygon, ior, *, cone=None, metal=None, quick=False):
    """As `lobe_integrals`, for the anisotropic lobes of `halves` (P,) over polygons (3, V, P) above the horizon.

    `quick` uses single precision and few points, and gives no estimates.
    """
    boundary = HalfBoundary.of(halves, polygon)
    apex = boundary.apex()
    if cone is not None:
        apex = np.where(cone.at_foot, project_to_sphere(halves.to_original_domain(cone.axis)), apex)
    toward, count, owner = apex[:, boundary.owner], len(ior), boundary.owner
    setting = (halves, ior, cone, metal)

    def sums(order, arcs, dtype):
        total = np.zeros((4 if metal is None else 7, count))
        batch = max(_BATCH // (order[0] * order[1]), 1)
        for start in range(0, len(arcs), batch):
            chosen = arcs[start : start + batch]
            owner_index = owner[chosen]
            rows = _arc_sums(
                order, (boundary, chosen, toward[:, chosen]), [_taken(part, owner_index, dtype) for part in setting]
            )
            for row, values in zip(total, rows, strict=True):
                row += np.bincount(owner_index, values, count)
        return total

    if quick:
        away = boundary.first - toward, boundary.last - toward
        is_near = np.maximum(dot(away[0], away[0]), dot(away[1], away[1])) < NEAR**2
        kinds = (QUICK, np.nonzero(~is_near)[0]), (QUICK_NEAR, np.nonzero(is_near)[0])
        return np.abs(sum(sums(order, arcs, np.float32) for order, arcs in kinds)), np.zeros(count)
    result, error, is_open = 0.0, np.full(count, np.inf), np.ones(count, bool)
    for order in EXACT.orders:
        value = np.where(is_open, np.abs(sums(order, np.nonzero(is_open[owner])[0], np.float64)), result)
        error = np.where(is_open & (order is not EXACT.orders[0]), np.abs(value - result).max(axis=0), error)
        result, is_open = value, error > EXACT.tolerance * value[0] + 1e-6
        if not is_open.any():
            break
    return result, error


def _taken(values, index, dtype):
    """The points `index` of `part`: None, an array (P, ...) or an object with `take`. In `dtype`, except for cones."""
    if isinstance(values, HalfVectors):
        return values.take(index).astype(dtype)
    if isinstance(values, list):
        return [term[index].astype(dtype) for term in values]
    if isinstance(values, np.ndarray):
        return values[index].astype(dtype)
    return None if values is None else values.take(index)


def _arc_sums(order, fan, setting):
    """The rows of `lobe_integrals`, (4, A) or (7, A), with a sign, over triangles of an arc of a boundary and an apex.
    `fan` is (boundary, arcs, apices (3, A))."""
    boundary, arcs, apex = fan
    halves, ior, cone, metal = setting
    dtype = ior.dtype
    points, wedge = boundary.nodes(order[0], arcs, apex, dtype)
    apex = apex.astype(dtype)[:, None]
    away = points - apex
    rho = np.maximum(2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(dot(away, away)), 1.0)), dtype.type(1e-7))
    fractions, weights = (values[:, None, None].astype(dtype) for values in _unit_interval(order[1]))
    sine = np.sin(rho)
    near, far = np.sin(rho * (1.0 - fractions)) / sine, np.sin(rho * fractions) / sine  # (m, B, A)
    stretched = [near * apex[axis] + far * points[axis] for axis in range(3)]
    values, half, direction = halves.lobe(stretched)
    values *= (wedge * rho / sine) * (weights * far)
    if cone is not None:
        values = values * cone.factor(np.stack(direction))
    return _sums(values, half, ior, metal)


def limit_warp(cosine, alpha) -> Lobe:
    """The warp in the limit alpha -> 0, for cosines (P,) of theta_o and alpha (P,)."""
    alpha = np.maximum(alpha, MIN_ALPHA)
    squared = cosine**2 + WARP_REGULARIZATION**2 * alpha**2
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return Lobe(squared, np.sqrt(squared) * sine, np.ones_like(alpha), 2.0 * alpha, None, np.empty((0, 0, len(alpha))))


def _peak_or_mean(inside, unit):
    mean = project_to_sphere(unit.sum(axis=1, keepdims=True))[:, 0]
    return np.where(inside, np.array([0.0, 0.0, 1.0])[:, None], mean)


def _fixed_order(order, boundary, apex, setting, cone, metal):
    """Integrals (4, P) or (7, P) with fixed Gauss-Legendre orders."""
    warp, cos_theta_o, alpha, ior = setting
    points, measure = boundary.nodes(order[0])
    wedge = dot(measure, apex[:, None])  # (B, P)
    wedge = wedge * np.sign(wedge.sum(axis=0))
    rho = np.maximum(np.arccos(np.clip(dot(points, apex[:, None]), -1.0, 1.0)), 1e-7)[:, None]
    fractions, weights = _unit_interval(order[1])
    fractions = fractions[:, None]
    inner_sine, sine = np.sin(rho * fractions), np.sin(rho)
    near, far = np.sin(rho * (1.0 - fractions)) / sine, inner_sine / sine  # (B, m, P)
    weight = wedge[:, None] * weights[:, None] * rho / sine * far
    warped = [near * apex[axis] + far * points[axis][:, None] for axis in range(3)]
    values, half, direction = _unwarped_lobe(warped, warp, cos_theta_o, alpha)
    values *= weight
    if cone is not None:
        values *= cone.factor(np.moveaxis(direction, -1, 0))
    return _sums(values, half, ior, metal)


def _sums(values, half, ior, metal):
    """The rows of `lobe_integrals` from weighted values (B, m, P)."""
    schlick = values * brdf.schlick_curve(half)
    dip = (schlick * (half * (1.0 - half))).sum(axis=(0, 1))
    schlick = schlick.sum(axis=(0, 1))
    dielectric = (values * brdf.dielectric_reflectance(half, ior)).sum(axis=(0, 1))
    rows = [values.sum(axis=(0, 1)), schlick, dip, dielectric]
    for channel in range(3) if metal is not None else ():
        reflectance = brdf.f82_reflectance(half, *(term[:, channel] for term in metal))
        rows.append((values * np.maximum(-reflectance, 0.0)).sum(axis=(0, 1)))
    return np.stack(rows)


def _unit_interval(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _slerp(start, end, angle, fraction):
    """Points at `fraction` of arcs of length `angle`. The ends coincide if the angle is zero."""
    sine = np.sin(angle)
    curved = sine > 1e-9
    safe = np.where(curved, sine, 1.0)
    near = np.where(curved, np.sin((1.0 - fraction) * angle) / safe, 1.0 - fraction)
    far = np.where(curved, np.sin(fraction * angle) / safe, fraction)
    return near * start + far * end


def _unwarped_lobe(warped, warp, cos_theta_o, alpha):
    """At warped unit vectors [x, y, z]: BRDF times cosine times Jacobian, the cosine of the half angle, and the unit
    direction as the last axis."""
    z = warped[2] / warp.zz
    x = (warped[0] - warp.xz * z) / warp.xx
    y = warped[1] / warp.yy
    length = np.sqrt(x * x + y * y + z * z)
    direction = np.stack([x / length, y / length, z / length], axis=-1)
    # Axes (B, m, P): the kernels of `brdf` broadcast over leading axes, of which the last is the sample axis.
    values = brdf.ggx_brdf_cosine(cos_theta_o, alpha, direction[..., None, :])[..., 0]
    half = brdf.half_angle_cosine(cos_theta_o, direction[..., None, :])[..., 0]
    return values / ((warp.xx * warp.yy * warp.zz) * length**3), half, direction


def reference_integrals(framed, cosine, light, corners, candidates, error):
    """Yield (index, integrals (4, Q)) by quadrature. Integrals of the same point add up. Adds estimates to `error`
    (P,).

    If the reflectance of metals falls below 0, three rows follow: what their sum misses because of that.
    """
    is_anisotropic = framed.samples.anisotropy[candidates] != 0.0
    for halves, chosen in ((False, candidates[~is_anisotropic]), (True, candidates[is_anisotropic])):
        if len(chosen):
            halves = HalfVectors.of(framed.samples, framed.frame, cosine) if halves else None
            for index, integrals, estimate in _integrals(framed, (cosine, halves, False), light, corners, chosen):
                error[index] += estimate
                yield index, integrals


def anisotropic_integrals(framed, halves, light, corners, candidates):
    """As `reference_integrals`, for anisotropic lobes, in the quick way. `halves` are those of all samples."""
    for index, integrals, _ in _integrals(framed, (halves.cosine, halves, True), light, corners, candidates):
        yield index, integrals


def _integrals(framed, lobes, light, corners, candidates):
    """Yield (index, integrals, error estimates (Q,)). `lobes` is the cosines (P,) of theta_o, the HalfVectors of
    anisotropic lobes, and whether to do these in the quick way."""
    samples, frame = framed.samples, framed.frame
    cosine, halves, quick = lobes
    terms = (samples.specular_f0, samples.specular_f90, samples.specular_dip)
    clipped = brdf.clipped_metals(samples)
    if light.is_round:
        corners = light.polygon(QUICK_CORNERS if quick else EXACT.round_corners)
    if light.has_spread:
        batches = _cone_parts(framed, cosine, light, corners, candidates)
    elif light.is_round and halves is None:
        batches = _ellipses(framed, light, corners, candidates)
    else:
        pieces = convex_pieces(corners) if isinstance(light, PolygonLight) else [corners]
        batches = (batch for piece in pieces for batch in _polygons(framed, light, piece, candidates))
    profile = light_profile.Profile.of(light) if light.has_falloff else None
    for index, outline, cone in batches:
        if light.is_facing and not light.is_uniform:
            cone = FacingEmission(light, frame[:, :, index], (light.center - samples.position[index]).T)
        elif cone is None and light.has_falloff:
            cone = _whole_cone(framed, light, index, profile)
        ior, metal = samples.ior[index], None
        if clipped[index].any():
            metal = [term[index] * clipped[index, None] for term in terms]
        if halves is not None:
            half_vectors = halves.take(index)
            integrals, estimate = half_vector_integrals(half_vectors, outline, ior, cone=cone, metal=metal, quick=quick)
        else:
            make_boundary = (
                partial(PolygonBoundary.warped, polygon=outline) if isinstance(outline, np.ndarray) else outline
            )
            setting = (cosine[index], samples.roughness[index] ** 2, ior)
            integrals, estimate = lobe_integrals(make_boundary, setting, cone=cone, metal=metal)
        if light.is_facing:
            integrals *= FacingDisk.of(light, (light.center - samples.position[index]).T, frame[2][:, index]).gain
        yield index, integrals, estimate


def _whole_cone(framed, light, index, profile) -> Cone:
    """The falloff of a light without a spread, which is smooth over the whole light."""
    axis = to_local(framed.frame[:, :, index], -light.direction[:, None])
    distance = ((framed.samples.position[index] - light.center) * light.direction).sum(axis=1)
    return Cone(axis, distance, profile, np.zeros(len(index), bool))


def _polygons(framed, light, corners, candidates):
    """Yield (index, polygons (3, V, Q) in local frames, None)."""
    for index, polygon in visible_polygons(framed, light, corners, candidates, framed.samples.geometric_normal):
        yield index, polygon[:3], None


def _ellipses(framed, light, corners, candidates):
    """As `_polygons`. If the geometric horizon does not cut an ellipse, the outline is a function that makes the exact
    ellipse's boundary from a warp."""
    cut, whole, local = _uncut_ellipses(framed, light, candidates)
    if len(whole):
        yield whole, lambda warp: EllipseBoundary.warped(warp, *local), None
    yield from _polygons(framed, light, corners, cut)


def _uncut_ellipses(framed, light, candidates):
    """The candidates whose light the geometric horizon cuts; the others that see it; and for these, the center and half
    axes of the ellipse in local frames."""
    samples, frame = framed.samples, framed.frame
    index = in_front(samples, light, candidates)
    offset = (light.center - light.viewpoint(samples.position[index])).T
    half_u, half_v = light.half_u[:, None], light.half_v[:, None]
    if light.is_facing:
        disk = FacingDisk.of(light, offset, frame[2][:, index])
        offset, half_u, half_v = disk.offset, disk.half_u, disk.half_v
    ellipse = np.stack(np.broadcast_arrays(offset, half_u, half_v))
    height, swing = _ellipse_extent(samples.geometric_normal[index].T, ellipse)
    cut = index[(height < swing) & (height > -swing)]
    index, ellipse = index[height >= swing], ellipse[:, :, height >= swing]
    height, swing = _ellipse_extent(samples.normal[index].T, ellipse)
    index, ellipse = index[height > -swing], ellipse[:, :, height > -swing]
    axes = frame[:, :, index]
    return cut, index, [to_local(axes, vector) for vector in ellipse]


def _ellipse_extent(normal, ellipse):
    """Heights (P,) of centers over the planes with `normal` (3, P), and how far (P,) the ellipses reach up and down.
    `ellipse` is centers and half axes, (3, 3, P)."""
    offset, half_u, half_v = ellipse
    return dot(normal, offset), np.hypot(dot(normal, half_u), dot(normal, half_v))


def _cone_parts(framed, cosine, light, corners, candidates):
    """As `_polygons`, but with the cone: the part of a light in the cone of each point. It is cut in two if both the
    foot, where the factor has its tip, and the peak of the lobe lie in it."""
    profile = light_profile.Profile.of(light)
    tangent = profile.tangent
    for index, polygon in visible_polygons(framed, light, corners, candidates, framed.samples.geometric_normal):
        warp = limit_warp(cosine[index], framed.samples.roughness[index] ** 2)
        view = light_view(framed, light, index, warp.to_original_domain)
        near = np.nonzero(light_profile.PolygonInDisks(polygon[3:]).least < tangent * view.distance)[0]
        if len(near) == 0:
            continue
        index, view = index[near], view.take(near)
        in_disks = light_profile.PolygonInDisks(polygon[3:, :, near])
        reach = tangent * view.distance
        flat = in_disks.inside(reach, _CONE_CHORDS)
        axis = view.foot[3:] / view.distance
        for chosen, boundary, at_foot in _around_foot_and_peak(in_disks, reach, flat, view):
            cone = Cone(axis[:, chosen], view.distance[chosen], profile, at_foot)
            yield index[chosen], boundary, cone


def _around_foot_and_peak(in_disks, reach, flat, view):
    """Yield (chosen (R,), polygons (3, W, R), mask (R,) of those to be integrated around the foot)."""
    peak, _, peak_visible, _ = view.peak()
    following = np.roll(in_disks.flat, -1, axis=1)
    along, offset = following - in_disks.flat, peak[:, None] - in_disks.flat
    side = along[0] * offset[1] - along[1] * offset[0]
    peak_inside = peak_visible & ((side >= 0.0).all(axis=0) | (side <= 0.0).all(axis=0))
    squared = peak[0] * peak[0] + peak[1] * peak[1]
    peak_inside &= squared < reach * reach
    both = in_disks.encloses & peak_inside & (squared > 0.0)
    corners = view.corners(flat)[3:]
    toward_peak = flat[0] * peak[0] + flat[1] * peak[1] - 0.5 * squared
    with_height = np.concatenate([corners, np.where(both, toward_peak, 1.0)[None]])
    for chosen, polygons in split_at_horizon(with_height, axis=3):
        yield chosen, polygons[:3], (in_disks.encloses & ~peak_inside)[chosen]
    cut = np.nonzero(both)[0]
    if len(cut):
        with_height = np.concatenate([corners, -toward_peak[None]])[:, :, cut]
        for chosen, polygons in split_at_horizon(with_height, axis=3):
            yield cut[chosen], polygons[:3], np.ones(len(chosen), bool)
