"""Where shadow rays start: on the triangle of a sample, or as far above it as Cycles lifts them."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ..lobes.polygon import dot
from ..scene import SurfaceSamples
from .occluders import ALL_RAYS, GAP, OBLIQUE, STEP, Hits, OccluderMesh, Occluders

# Distance from its triangle at which a ray does not meet it, as a share of the size of coordinates: 8 times their
# rounding in single precision. 2 times are too few; 4 seem to suffice.
CLEARANCE = 2.0**-21
# NEARBY: distance from a sample, in m near the origin, within which its surface is looked for. LAYERS: most surfaces
# looked at. CERTAIN: share of that distance, 8 roundings far from the origin, at which a surface is that of the sample.
NEARBY, LAYERS, CERTAIN = 2.0**-14, 4, 2.0**-6


class ShadowTerminator:
    """Finds the triangles of `occluders` on which samples lie. `caster` is a `rays.EmbreeCaster`."""

    def __init__(self, occluders: Occluders, caster):
        self._occluders, self._caster = occluders, caster
        uses = np.bincount(occluders.mesh, minlength=len(occluders.meshes))
        self._is_applied = uses[occluders.mesh] == 1
        self._thickness = np.zeros(len(occluders.mesh))  # the largest of each instance, in m
        thick = [mesh.thickness is not None and len(mesh.triangles) > 0 for mesh in occluders.meshes]
        for number in np.flatnonzero(np.array(thick, bool)[occluders.mesh]):
            self._thickness[number] = self._thickness_of(number, slice(None)).max()
        self._opposed: OpposedFaces | None = None  # made by the first call of `ray_origins`

    def ray_origins(self, samples: SurfaceSamples) -> "RayOrigins":
        """Where rays from `samples` start: as in Cycles, on the triangle, which they leave without meeting it.

        A smooth surface would hide light that falls on its triangles at a grazing angle. There, rays start on a curved
        surface above the triangles (`shadow_terminator_geometry_offset`). A sample that is on no triangle of the
        occluders keeps a small distance from its surface. The triangles' own normals are used, because a sample has the
        smooth one where a lobe ends at the smooth horizon.
        """
        position, normal, smooth_normal = (
            np.array(values, np.float32, order="C")
            for values in (samples.position, samples.geometric_normal, samples.smooth_normal)
        )
        count, chunk = len(position), self._caster.chunk
        reach = np.abs(position).max(axis=1, initial=0.0)
        clearance = (CLEARANCE * 8.0 * reach).astype(np.float32)
        lift, terminator = np.zeros((2, count, 3), np.float32), np.zeros(count, np.float32)
        for start in range(0, count, chunk):
            rows = slice(start, start + chunk)
            hits = self._triangles_at(position[rows], normal[rows], (NEARBY * (1.0 + reach[rows])).astype(np.float32))
            index, shape = start + hits.ray, _TrianglePoints.of(self._occluders, hits, self._is_applied)
            clearance[index] = CLEARANCE * (reach[index] + shape.size)
            is_thick = self._thickness[hits.instance] > 0.0
            # Graphics cards interpolate positions less exactly than Cycles; such rays would meet their own surface.
            moved = shape.point - position[index]
            off = (_dot(moved, moved) > (0.5 * clearance[index]) ** 2) & ~is_thick
            position[index[off]] = shape.point[off]
            for number in np.unique(hits.instance[is_thick]):
                here = hits.instance == number
                clearance[index[here]] += self._thickness_of(number, hits.triangle[here])
            normal[index] = np.where(
                is_thick[:, None], normal[index], shape.face_normals(normal[index], smooth_normal[index])
            )
            smooth = np.flatnonzero(shape.is_smooth)
            index = index[smooth]
            lift[:, index] = shape.take(smooth).lifts(normal[index])
            terminator[index] = self._occluders.terminators[hits.instance[smooth]] * lift[:, index].any(axis=(0, 2))
        if self._opposed is None:
            self._opposed = OpposedFaces(self._occluders, self._caster)
        touching = self._opposed.at(position, normal, clearance)
        return RayOrigins(position, normal, smooth_normal, clearance, lift, terminator, *touching)

    def _thickness_of(self, instance, triangle) -> np.ndarray:
        """World-space thickness (Q,) of triangles of an instance that has one, in m."""
        thickness = self._occluders.meshes[self._occluders.mesh[instance]].thickness
        scale = np.linalg.norm(self._occluders.matrices[instance][:, :3], axis=0).max()
        return thickness[triangle] * np.float32(scale)

    def _triangles_at(self, position, normal, reach) -> Hits:
        """Hits on the triangles on which samples lie, within `reach` (P,) m or within the triangles' thickness."""
        hits = _nearest(self._caster, position, normal, reach)
        thickest = np.float32(self._thickness.max(initial=0.0))
        if thickest == 0.0:
            return hits
        rest = np.ones(len(position), bool)
        rest[hits.ray] = False
        rest = np.flatnonzero(rest)
        wider = _nearest(self._caster, position[rest], normal[rest], np.full(len(rest), thickest))
        within = np.zeros(len(wider.ray), bool)
        for number in np.unique(wider.instance[self._thickness[wider.instance] > 0.0]):
            here = np.flatnonzero(wider.instance == number)
            within[here] = wider.distance[here] <= self._thickness_of(number, wider.triangle[here])
        wider = Hits(rest[wider.ray], *(getattr(wider, field.name) for field in fields(Hits)[1:]))
        joined = zip(*((getattr(each, field.name) for field in fields(Hits)) for each in (hits, wider)), strict=True)
        return Hits(*(np.concatenate([one, other[within]]) for one, other in joined))

    def close(self) -> None:
        """Free what the casters of opposed faces hold."""
        if self._opposed is not None:
            self._opposed.close()


class OpposedFaces:
    """Faces that touch others and face them, as where a box stands on a floor: what they block of the rays that start
    on these. `caster` is one of the `occluders`."""

    def __init__(self, occluders: Occluders, caster):
        self._occluders, self._triangles, self._casters = occluders, [], []
        opposed = occluders.opposed()
        normals = np.cross(*np.moveaxis(opposed.corners[:, 1:] - opposed.corners[:, :1], 1, 0))
        normals *= occluders.handedness()[opposed.instance, None]
        for side in (1.0, -1.0):
            triangles = opposed.take(side * (normals @ OBLIQUE) > 0.0)
            corners = triangles.corners.reshape(-1, 3)
            self._triangles.append(triangles)
            mesh = OccluderMesh(corners, np.arange(len(corners)).reshape(-1, 3))
            self._casters.append(caster.of(Occluders((mesh,), [0], [np.eye(3, 4)])))

    def close(self) -> None:
        """Free what the casters hold."""
        for caster in self._casters:
            caster.close()

    def at(self, position, normal, clearance) -> tuple[np.ndarray, np.ndarray]:
        """The masks (P,) of the faces that touch samples from above, within their clearances (P,) m, 0 for none; and
        the shares (P,) of light that these let through.

        As in Cycles, what is in the plane of a sample blocks, and what is below by more than rounding does not. A face
        that is seen from behind faces as those do, and blocks nothing of its own light.
        """
        occluders, is_up = self._occluders, normal @ OBLIQUE > 0.0
        masks, shares = np.zeros(len(position), np.uint32), np.ones(len(position), np.float32)
        sides = zip(self._triangles, self._casters, self._casters[::-1], (~is_up, is_up), strict=True)
        for triangles, caster, of_samples, chosen in sides:
            for start in range(0, len(position) if len(triangles.instance) else 0, caster.chunk):
                index = start + np.flatnonzero(chosen[start : start + caster.chunk])
                reach = (NEARBY * (1.0 + np.abs(position[index]).max(axis=1, initial=0.0))).astype(np.float32)
                hits = _nearest(caster, position[index], normal[index], reach)
                index, reach, faces = index[hits.ray], reach[hits.ray], triangles.take(hits.triangle)
                height = _dot(faces.corners[:, 0].astype(np.float32) - position[index], normal[index])
                rounding = GAP * np.abs(_dot(position[index], normal[index]))
                touches = np.flatnonzero((height >= -rounding) & (height <= clearance[index]))
                at = index[touches]
                touches = touches[_nearest(of_samples, position[at], normal[at], reach[touches]).ray]
                masks[index[touches]] = occluders.masks[faces.instance[touches]]
                mesh = occluders.mesh[faces.instance]
                for number in np.unique(mesh[touches]):
                    here, clear = touches[mesh[touches] == number], occluders.meshes[number].transparency
                    rows = faces.triangle[here], hits.u[here], hits.v[here], np.ones(len(here))
                    shares[index[here]] = 0.0 if clear is None else clear.transmittance(*rows)
        return masks, shares


def _nearest(caster, position, normal, reach) -> Hits:
    """Hits of a `caster` on the triangles nearest to samples along their normals, up to `reach` (P,) m away."""
    count = len(position)
    origins, everything = position + reach[:, None] * normal, np.full(count, ALL_RAYS, np.uint32)
    off = np.full(count, np.inf, np.float32)
    best = Hits(np.arange(count), off, *(np.zeros(count, kind) for kind in (int, int, np.float32, np.float32)))
    for is_clear in (False, True):
        near, index = np.zeros(count, np.float32), np.arange(count)
        # The first triangle may belong to another surface close above.
        for _ in range(LAYERS if caster.has[is_clear] else 0):
            rays = origins[index], -normal[index], near[index], 2.0 * reach[index], everything[index]
            hits = caster.closest(is_clear, *rays)
            index = index[hits.ray]
            offset = np.abs(hits.distance - reach[index])
            closer = offset < off[index]
            for field in fields(Hits)[2:]:
                getattr(best, field.name)[index[closer]] = getattr(hits, field.name)[closer]
            off[index[closer]] = offset[closer]
            near[index] = hits.distance * STEP
            index = index[off[index] > CERTAIN * reach[index]]
    there = np.isfinite(off)
    return Hits(*(getattr(best, field.name)[there] for field in fields(Hits)))


@dataclass(frozen=True)
class RayOrigins:
    """Where shadow rays of P samples start, see `ShadowTerminator`. `origins` returns the start of each ray."""

    position: np.ndarray  # (P, 3) float32
    geometric_normal: np.ndarray  # (P, 3)
    smooth_normal: np.ndarray  # (P, 3)
    clearance: np.ndarray  # (P,) m, distance from its plane at which a ray surely misses the sample's own triangle
    lift: np.ndarray  # (2, P, 3) m, to where a smooth surface would be: for light from outside, and from inside
    terminator: np.ndarray  # (P,) as Occluders.terminators; 0 on flat triangles
    # Faces that touch samples from above: masks (P,) of the rays that they block, 0: there is none, and the shares (P,)
    # of light that they let through.
    touching: np.ndarray
    touching_share: np.ndarray

    @classmethod
    def empty(cls, count: int) -> "RayOrigins":
        """Room for those of `count` samples, see `put`."""
        vectors, numbers = np.zeros((5, count, 3), np.float32), np.zeros((3, count), np.float32)
        return cls(*vectors[:3], numbers[0], vectors[3:], numbers[1], np.zeros(count, np.uint32), numbers[2])

    def put(self, block: slice, values: "RayOrigins") -> None:
        """Set those of the samples of a block."""
        for field in fields(self):
            rows = getattr(self, field.name)
            (rows[:, block] if field.name == "lift" else rows[block])[:] = getattr(values, field.name)

    def take(self, index) -> "RayOrigins":
        """The starts of the samples at `index`: integers (Q,) or a slice."""
        lift = self.lift[:, index]
        return RayOrigins(*(lift if each.name == "lift" else getattr(self, each.name)[index] for each in fields(self)))

    def past_touching(self, index: np.ndarray, directions: np.ndarray, masks: np.ndarray) -> tuple | None:
        """The rays (H,) that meet faces which touch their samples, and the shares (H,) that these let through; of rays
        from the samples `index` (R,) along `directions` (3, R) with `masks`. None where nothing touches."""
        if not self.is_touched:
            return None
        rays = np.flatnonzero(self.touching[index] & masks)
        sample = index[rays]
        meets = dot(self.geometric_normal[sample].T, directions[:, rays]) > 0.0
        return rays[meets], self.touching_share[sample[meets]]

    @cached_property
    def is_touched(self) -> bool:
        """True if a face touches one of the samples."""
        return bool(self.touching.any())

    def origins(self, index: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Origins (R, 3) of rays along unit `directions` (R, 3) from the samples `index` (R,)."""
        return self._origins_of_rows(index, directions.T[:, None])[0][:, 0].T

    def _origins_of_rows(self, index: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins (3, S, Q) of S rays from each of the samples `index` (Q,), along unit `directions` (3, S, Q), and the
        flat numbers (R,) of those that are lifted: all others are those of `from_surface`."""
        normal, reach = self.geometric_normal[index].T[:, None], self.terminator[index]
        facing = dot(normal, directions)
        origins = np.copysign(self.clearance[index], facing) * normal
        origins += self.position[index].T[:, None]
        if not reach.any():
            return origins, np.zeros(0, int)
        height = dot(self.smooth_normal[index].T[:, None], directions)
        flipped = np.where(height < 0.0, np.float32(-1.0), np.float32(1.0))
        facing *= flipped
        np.abs(height, out=height)
        lifted = np.flatnonzero((facing < reach + np.maximum(reach - height, 0.0)) & (reach > 0.0))
        facing, height, flipped = (values.ravel()[lifted] for values in (facing, height, flipped))
        sample, reach = index[lifted % len(index)], reach[lifted % len(index)]
        amount = np.clip(1.0 + np.maximum(1.0 - height / reach, 0.0) - facing / reach, 0.0, 1.0)
        # As in Cycles, light from behind the sample's own triangle meets it.
        moved = self.clearance[sample] * flipped * self.geometric_normal[sample].T + self.position[sample].T
        moved += amount * self.lift[np.where(flipped < 0.0, 1, 0), sample].T
        origins.reshape(3, -1)[:, lifted] = moved
        return origins, lifted

    def from_surface(
        self, index: np.ndarray, directions: np.ndarray, distances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `aimed`, for one ray per sample, (R,), that starts at the sample itself. Rays that Cycles sends on from a
        surface do so."""
        normal = self.geometric_normal[index].T
        moved = np.copysign(self.clearance[index], dot(normal, directions)) * normal
        return moved + self.position[index].T, *toward(directions, distances, moved)

    def aimed(
        self, index: np.ndarray, directions: np.ndarray, distances: np.ndarray, at_surface: bool = False
    ) -> tuple[np.ndarray, ...]:
        """Origins and unit directions (3, S, Q) and distances (S, Q) of S rays from each of the samples `index` (Q,),
        and the flat numbers (R,) of those that are lifted above their surface.

        Wherever a ray starts, it ends at `distances`, finite, along `directions` from the sample. Rays that start just
        the clearance above the sample keep their direction. With `at_surface` they do not: they end on a face that
        blocks rays itself, as the faces of mesh lights do, and at a grazing angle would meet it too early.
        """
        origins, lifted = self._origins_of_rows(index, directions)
        if at_surface:
            return origins, *toward(directions, distances, origins - self.position[index].T[:, None]), lifted
        sample = index[lifted % len(index)]
        moved = origins.reshape(3, -1)[:, lifted] - self.position[sample].T
        high = dot(moved, moved) > 4.0 * self.clearance[sample] ** 2
        if high.any():
            directions, distances, chosen = directions.copy(), distances.copy(), lifted[high]
            rows, ends = directions.reshape(3, -1), distances.ravel()
            rows[:, chosen], ends[chosen] = toward(rows[:, chosen], ends[chosen], moved[:, high])
        return origins, directions, distances, lifted


def toward(directions, distances, moved):
    """Unit directions (3, ...) and distances (...) of rays that start `moved` (3, ...) m away from others, and end
    where these end."""
    toward = directions * distances - moved
    length = np.sqrt(dot(toward, toward))
    return toward / np.maximum(length, np.float32(1e-30)), length


def _dot(first, second):
    """Dot products (R,) of vectors (R, 3)."""
    return np.einsum("rk,rk->r", first, second)


@dataclass(frozen=True)
class _TrianglePoints:
    """Q points on triangles. Corners and normals are in the space in which Cycles has them."""

    corners: np.ndarray  # (Q, 3, 3)
    normals: np.ndarray  # (Q, 3, 3) at the corners, if `is_smooth`
    is_smooth: np.ndarray  # (Q,)
    weights: np.ndarray  # (Q, 3) weights of the corners
    to_world: np.ndarray  # (Q, 3, 3) takes directions to world space
    point: np.ndarray  # (Q, 3) in world space
    size: np.ndarray  # (Q,) m, extent of the triangle, plus its distance from the origin of the instance if not applied

    @classmethod
    def of(cls, occluders: Occluders, hits: Hits, is_applied: np.ndarray) -> "_TrianglePoints":
        """For `hits`. Instances for which `is_applied` (I,) is True are in world space."""
        corners, normals = np.zeros((2, len(hits.ray), 3, 3))
        is_smooth, mesh = np.zeros(len(hits.ray), bool), occluders.mesh[hits.instance]
        order = np.argsort(mesh, kind="stable")
        for here in np.split(order, np.flatnonzero(np.diff(mesh[order])) + 1) if len(order) else ():
            object_mesh, triangle = occluders.meshes[mesh[here[0]]], hits.triangle[here]
            named = object_mesh.triangles[triangle]
            corners[here] = object_mesh.vertices[named]
            if object_mesh.normals is not None:
                at_vertices = object_mesh.normals.ndim == 2
                normals[here] = object_mesh.normals[named if at_vertices else triangle]
                is_smooth[here] = True
        matrix, applied = occluders.matrices[hits.instance], is_applied[hits.instance][:, None, None]
        in_world = _turned(corners, matrix)
        size = np.abs(in_world - in_world[:, :1]).max(axis=(1, 2))
        size += np.where(applied[:, 0, 0], 0.0, np.abs(in_world).max(axis=(1, 2)))
        u, v = hits.u.astype(np.float64), hits.v.astype(np.float64)
        weights = np.stack([1.0 - u - v, u, v], axis=-1)
        turned = _turned(normals, _cofactors(matrix))
        turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-30)
        return cls(
            np.where(applied, in_world + matrix[:, None, :, 3], corners),
            np.where(applied, turned, normals),
            is_smooth,
            weights,
            np.where(applied, np.eye(3), matrix[:, :, :3]),
            np.einsum("qc,qck->qk", weights, in_world) + matrix[:, :, 3],
            size,
        )

    def take(self, index: np.ndarray) -> "_TrianglePoints":
        """The points at `index`."""
        return _TrianglePoints(*(getattr(self, each.name)[index] for each in fields(self)))

    def face_normals(self, geometric_normal: np.ndarray, smooth_normal: np.ndarray) -> np.ndarray:
        """Unit normals (Q, 3) of the triangles in world space. Those of flat triangles point to the side of
        `geometric_normal` (Q, 3). Those of smooth ones have the sign with which `smooth_normal` (Q, 3) agrees with the
        interpolated normal, which may be on the other side of the triangle.

        A triangle without area gets `geometric_normal`.
        """
        first, second = np.moveaxis(_turned(self.corners[:, 1:] - self.corners[:, :1], self.to_world), 1, 0)
        normal = _crossed(first, second)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        interpolated = np.einsum("qc,qck->qk", self.weights, self.normals)
        interpolated = _turned(interpolated[:, None], _cofactors(self.to_world))[:, 0]
        facing = np.where(self.is_smooth, _dot(interpolated, smooth_normal), _dot(normal, geometric_normal))
        normal *= np.where(facing < 0.0, -1.0, 1.0)[:, None]
        return np.divide(normal, length, out=geometric_normal.astype(np.float64), where=length > 0.0)

    def lifts(self, geometric_normal: np.ndarray) -> np.ndarray:
        """How far (2, Q, 3) above the points a smooth surface would be, for light from the side of `geometric_normal`
        (Q, 3) and from the other side: Cycles' `shadow_ray_smooth_surface_offset`."""
        (v0, v1, v2), (n0, n1, n2) = np.moveaxis(self.corners, 1, 0), np.moveaxis(self.normals, 1, 0)
        point, normal = (np.einsum("qc,qck->qk", self.weights, values) for values in (self.corners, self.normals))
        s, t = self.weights[:, 0], self.weights[:, 1]
        a, b, c = _dot(n2 - n0, v0 - v2), _dot(n2 - n1, v1 - v2), _dot(n1 - n0, v1 - v0)
        parabola = 0.5 * (a * s * (s - 1.0) + (a + b + c) * s * t + b * t * (t - 1.0))
        corners = ((v0, v1, v2, n0), (v1, v0, v2, n1), (v2, v0, v1, n2))
        heights = []
        for side in (1.0, -1.0):
            envelope = [
                np.maximum(
                    side * _dot(corner - point, n)
                    + np.maximum(np.maximum(side * _dot(one - corner, n), side * _dot(other - corner, n)), 0.0),
                    0.0,
                )
                for corner, one, other, n in corners
            ]
            heights.append(side * np.maximum(np.minimum.reduce(envelope), side * parabola))
        normal = _turned(normal[:, None], self.to_world)[:, 0]
        above = _dot(normal, geometric_normal) > 0.0
        heights = np.where(above, heights, heights[::-1])
        return heights[:, :, None] * normal


def _turned(vectors, matrices):
    """Vectors (Q, N, 3) times the first three columns of matrices (Q, 3, ...)."""
    return sum(vectors[:, :, k, None] * matrices[:, None, :, k] for k in range(3))


def _cofactors(matrices):
    """Matrices (Q, 3, 3) that take normals along with points: the inverse transposed times the determinant."""
    a, b, c = np.moveaxis(matrices[:, :, :3], 1, 0)
    return np.stack([_crossed(b, c), _crossed(c, a), _crossed(a, b)], axis=1)


def _crossed(first, second):
    """Cross products (Q, 3)."""
    (a, b, c), (x, y, z) = first.T, second.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)
