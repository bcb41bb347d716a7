"""Rays through occluders, by the library Embree 4 that Blender ships, called through ctypes.

Embree is a C library; its functions and their arguments are those of the headers rtcore_*.h of Embree 4. A ray packet
is a block of rows, one for each component, of as many rays as the processor takes at once. Python calls Embree once
for each packet, and these calls are too short for threads to share a process: a `Tracer` uses one core, and each
process that traces opens its own.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import repeat

import numpy as np

from ..scene import SceneError, SurfaceSamples, error_line, listed
from .occluders import ALL_RAYS, ChosenBy, OccluderMesh, Occluders, Transparency

# Names under which the system may know the library.
SYSTEM_LIBRARIES = ("libembree4.so.4", "libembree4.4.dylib", "libembree4.dylib", "embree4.dll")
# Rays in a chunk: its packets stay in the second-level cache.
CHUNK = 4096
# Rows of a packet of rays, and of one of rays with what they hit; the last two are room for what some builds add.
ORIGIN, NEAR, DIRECTION, FAR, MASK = slice(0, 3), 3, slice(4, 7), 8, 9
RAY_ROWS, U, V, TRIANGLE, GEOMETRY, INSTANCE, HIT_ROWS = 12, 15, 16, 17, 18, 19, 22
NONE, MOST_LEVELS = 0xFFFFFFFF, 32
# Of the size of coordinates: 8 times their rounding in single precision; 2 times are too few, 4 seem to suffice.
CLEARANCE = 2.0**-21
# A sample is looked for so far from its place, in m for one near the origin, in so many surfaces, until it is as near
# to one as that share of the way.
NEARBY, LAYERS, CERTAIN = 2.0**-14, 4, 2.0**-3
# A ray goes on from a transparent surface by so much of its distance.
STEP = np.float32(1.0 + 2.0**-21)

_TRIANGLES, _INSTANCES = 0, 121  # RTCGeometryType
_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1  # RTCBufferType
_UINT3, _FLOAT3, _FLOAT3X4 = 0x5003, 0x9003, 0x9134  # RTCFormat; row by row
_ROBUST = 4  # RTCSceneFlags: no ray slips between triangles, as in Cycles
_VERSION, _NATIVE_16, _NATIVE_8, _HAS_MASKS, _HAS_TRIANGLES = 0, 34, 33, 64, 96  # RTCDeviceProperty
_POINTER, _SIZE, _UINT = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint
_FUNCTIONS = {
    "rtcNewDevice": (_POINTER, ctypes.c_char_p),
    "rtcReleaseDevice": (None, _POINTER),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, _POINTER, ctypes.c_int),
    "rtcGetDeviceError": (ctypes.c_int, _POINTER),
    "rtcNewScene": (_POINTER, _POINTER),
    "rtcReleaseScene": (None, _POINTER),
    "rtcSetSceneFlags": (None, _POINTER, ctypes.c_int),
    "rtcCommitScene": (None, _POINTER),
    "rtcNewGeometry": (_POINTER, _POINTER, ctypes.c_int),
    "rtcReleaseGeometry": (None, _POINTER),
    "rtcSetSharedGeometryBuffer": (
        *(None, _POINTER, ctypes.c_int, _UINT, ctypes.c_int),
        *(_POINTER, _SIZE, _SIZE, _SIZE),
    ),
    "rtcSetGeometryInstancedScene": (None, _POINTER, _POINTER),
    "rtcSetGeometryTransform": (None, _POINTER, _UINT, ctypes.c_int, _POINTER),
    "rtcSetGeometryMask": (None, _POINTER, _UINT),
    "rtcCommitGeometry": (None, _POINTER),
    "rtcAttachGeometry": (_UINT, _POINTER, _POINTER),
}
_ERRORS = ("no error", "unknown", "invalid argument", "invalid operation", "out of memory", "unsupported processor")


class _Unfit(Exception):
    """A library cannot be used; the text says why."""


class _Embree:
    """The functions of one library, and a device of it."""

    def __init__(self, library: str):
        self.path = library
        try:
            self._library = ctypes.CDLL(library)
            # Keeps Python's lock during a call, which is too short to hand it over.
            quick = ctypes.PyDLL(library)
            for name, (result, *arguments) in _FUNCTIONS.items():
                function = getattr(self._library, name)
                function.restype, function.argtypes = result, arguments
                setattr(self, name.removeprefix("rtc"), function)
            device = self.NewDevice(b"")
        except (OSError, AttributeError) as error:
            raise _Unfit(error_line(error)) from None
        if not device:
            raise _Unfit("it makes no device")
        self.device = device
        version = self._property(_VERSION)
        self.version = f"{version // 10000}.{version // 100 % 100}.{version % 100}"
        if version // 10000 != 4:
            raise _Unfit(f"it is version {self.version}, expected 4")
        if not self._property(_HAS_MASKS) or not self._property(_HAS_TRIANGLES):
            raise _Unfit("it was built without ray masks, or without triangles")
        self.width = 16 if self._property(_NATIVE_16) else 8 if self._property(_NATIVE_8) else 4
        self.occluded = self._packet_function(quick, "rtcOccluded")
        self.intersect = self._packet_function(quick, "rtcIntersect")

    def _property(self, number) -> int:
        return self.GetDeviceProperty(self.device, number)

    def _packet_function(self, library, name):
        function = getattr(library, f"{name}{self.width}")
        function.restype, function.argtypes = None, (_POINTER,) * 4
        return function

    def check(self) -> None:
        """Raise MemoryError or RuntimeError where a call since the last check has failed."""
        code = self.GetDeviceError(self.device)
        if code == 4:
            raise MemoryError("occluders: Embree found no memory for them")
        if code:
            raise RuntimeError(f"Embree {self.version}: error {_ERRORS[code] if code < len(_ERRORS) else code}")


def _aligned(count: int, dtype=np.float32) -> np.ndarray:
    """Zeros (count,) of 4 bytes each from an address that 64 divides."""
    memory = np.zeros(count + 16, dtype)
    start = -(memory.ctypes.data // 4) % 16
    return memory[start : start + count]


class _Packets:
    """Room for CHUNK rays in packets of `width`, with `rows` rows, and the addresses of the packets."""

    def __init__(self, width: int, rows: int):
        count = CHUNK // width
        # A build of Embree with more levels of instances would write beyond the last packet, before it is found unfit.
        values = _aligned((count * rows + 2 * MOST_LEVELS) * width)
        self.values = values[: count * rows * width].reshape(count, rows, width)
        self.numbers = self.values.view(np.uint32)
        self.values[:, DIRECTION] = 1.0
        start, size = self.values.ctypes.data, rows * width * 4
        self.addresses = [_POINTER(start + number * size) for number in range(count)]
        self._valid = _aligned(width, np.int32)
        self._valid[:] = -1
        self._width = width

    def set(self, row, values) -> None:
        """Write `values` (R,) or (R, 3) to a row, or three."""
        width, target = self._width, self.values if values.dtype == np.float32 else self.numbers
        whole = len(values) // width
        if values.ndim == 1:
            target[:whole, row] = values[: whole * width].reshape(whole, width)
            if whole * width < len(values):
                rest = values[whole * width :]
                target[whole, row, : len(rest)] = rest
                target[whole, row, len(rest) :] = rest[-1]
            return
        target[:whole, row] = values[: whole * width].reshape(whole, width, 3).transpose(0, 2, 1)
        if whole * width < len(values):
            rest = values[whole * width :].T
            target[whole, row, : rest.shape[1]] = rest
            target[whole, row, rest.shape[1] :] = rest[:, -1:]

    def get(self, row, count: int, numbers: bool = False) -> np.ndarray:
        """A copy (count,) of a row."""
        whole = -(-count // self._width)
        return (self.numbers if numbers else self.values)[:whole, row].reshape(-1)[:count]

    def trace(self, function, scene, count: int) -> None:
        """Call an Embree function for the packets of `count` rays."""
        addresses = self.addresses[: -(-count // self._width)]
        valid = _POINTER(self._valid.ctypes.data)
        deque(map(function, repeat(valid), repeat(scene), addresses, repeat(None)), maxlen=0)


class _Scene:
    """The instances `index` of `occluders` as a scene of Embree."""

    def __init__(self, embree: _Embree, occluders: Occluders, index: np.ndarray):
        self._embree, self._kept, self._scenes = embree, [], []
        self.scene, self.instances = None, index
        uses = np.bincount(occluders.mesh[index], minlength=len(occluders.meshes))
        parts: dict[int, int] = {}
        self.scene = self._new_scene()
        try:
            for number in index:
                mesh, mask = int(occluders.mesh[number]), int(occluders.masks[number])
                matrix = occluders.matrices[number]
                if uses[mesh] == 1:
                    self._add_triangles(self.scene, occluders.meshes[mesh], matrix, mask)
                else:
                    if mesh not in parts:
                        parts[mesh] = self._new_scene()
                        self._add_triangles(parts[mesh], occluders.meshes[mesh], None, ALL_RAYS)
                        embree.CommitScene(parts[mesh])
                    self._add_instance(parts[mesh], matrix, mask)
            embree.CommitScene(self.scene)
            embree.check()
        except BaseException:
            self.close()
            raise

    def _new_scene(self):
        scene = self._embree.NewScene(self._embree.device)
        self._scenes.append(scene)
        self._embree.SetSceneFlags(scene, _ROBUST)
        return scene

    def _add_triangles(self, scene, mesh: OccluderMesh, matrix, mask) -> None:
        embree, vertices = self._embree, mesh.vertices
        if matrix is not None:
            vertices = vertices.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]
        # Embree reads 4 bytes beyond the last vertex.
        buffer = _aligned(3 * len(vertices) + 1)
        buffer[:-1] = vertices.reshape(-1)
        geometry = embree.NewGeometry(embree.device, _TRIANGLES)
        for kind, data, form, count in (
            (_VERTEX_BUFFER, buffer, _FLOAT3, len(vertices)),
            (_INDEX_BUFFER, mesh.triangles, _UINT3, len(mesh.triangles)),
        ):
            embree.SetSharedGeometryBuffer(geometry, kind, 0, form, data.ctypes.data, 0, 12, count)
            self._kept.append(data)
        self._attach(scene, geometry, mask)

    def _add_instance(self, part, matrix, mask) -> None:
        embree, values = self._embree, np.ascontiguousarray(matrix, np.float32)
        geometry = embree.NewGeometry(embree.device, _INSTANCES)
        embree.SetGeometryInstancedScene(geometry, part)
        embree.SetGeometryTransform(geometry, 0, _FLOAT3X4, values.ctypes.data)
        self._attach(self.scene, geometry, mask)

    def _attach(self, scene, geometry, mask) -> None:
        embree = self._embree
        embree.SetGeometryMask(geometry, mask)
        embree.CommitGeometry(geometry)
        embree.AttachGeometry(scene, geometry)
        embree.ReleaseGeometry(geometry)

    def close(self) -> None:
        while self._scenes:
            self._embree.ReleaseScene(self._scenes.pop(0))
        self._kept.clear()


@dataclass(frozen=True)
class _Shape:
    """Q points on triangles of one instance: corners (Q, 3, 3) and normals there, all in the space in which Cycles has
    them, or no normals where they are flat; shares (Q, 3) of the corners; and what takes directions to world space."""

    corners: np.ndarray
    normals: np.ndarray | None
    shares: np.ndarray
    to_world: np.ndarray | None
    size: np.ndarray  # (Q,) m, how far a corner is from the point, or the point from the origin of the instance

    @classmethod
    def of(cls, occluders: Occluders, hits: Hits, here, is_applied: bool) -> _Shape:
        """Those of the `hits` that are `here`, all on one instance."""
        instance, triangle, u, v = hits.instance[here][0], hits.triangle[here], hits.u[here], hits.v[here]
        mesh, matrix = occluders.meshes[occluders.mesh[instance]], occluders.matrices[instance]
        named = mesh.triangles[triangle]
        corners, normals = mesh.vertices[named].astype(np.float64), mesh.normals
        if normals is not None:
            normals = (normals[named] if normals.ndim == 2 else normals[triangle]).astype(np.float64)
        shares = np.stack([1.0 - u - v, u, v], axis=-1)
        in_world = corners @ matrix[:, :3].T
        size = np.abs(in_world - in_world[:, :1]).max(axis=(1, 2))
        if not is_applied:
            return cls(corners, normals, shares, matrix[:, :3], size + np.abs(in_world).max(axis=(1, 2)))
        if normals is not None:
            normals = normals @ _cofactors(matrix[:, :3]).T
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
        return cls(in_world + matrix[:, 3], normals, shares, None, size)

    def face_normals(self, geometric_normal: np.ndarray, smooth_normal: np.ndarray) -> np.ndarray:
        """Unit normals (Q, 3) of the triangles in world space: on the side of `geometric_normal` (Q, 3) where they are
        flat, else of the side that has `smooth_normal` (Q, 3), which may point to the other side of its triangle.

        Where a triangle has no area it is the former.
        """
        edges = self.corners[:, 1:] - self.corners[:, :1]
        if self.to_world is not None:
            edges = edges @ self.to_world.T
        normal = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        if self.normals is None:
            facing = _dot(normal, geometric_normal)
        else:
            own = np.einsum("qc,qck->qk", self.shares, self.normals)
            facing = _dot(own if self.to_world is None else own @ _cofactors(self.to_world).T, smooth_normal)
        normal *= np.where(facing < 0.0, -1.0, 1.0)[:, None]
        return np.divide(normal, length, out=geometric_normal.astype(np.float64), where=length > 0.0)

    def lifts(self, geometric_normal: np.ndarray) -> np.ndarray:
        """How far (2, Q, 3) a smooth surface would be above the points, for light from the side of `geometric_normal`
        (Q, 3), and from the other: `shadow_ray_smooth_surface_offset` of Cycles."""
        (v0, v1, v2), (n0, n1, n2) = np.moveaxis(self.corners, 1, 0), np.moveaxis(self.normals, 1, 0)
        point, normal = (np.einsum("qc,qck->qk", self.shares, values) for values in (self.corners, self.normals))
        s, t = self.shares[:, 0], self.shares[:, 1]
        a, b, c = _dot(n2 - n0, v0 - v2), _dot(n2 - n1, v1 - v2), _dot(n1 - n0, v1 - v0)
        parabola = 0.5 * (a * s * (s - 1.0) + (a + b + c) * s * t + b * t * (t - 1.0))
        corners = ((v0, v1, v2, n0), (v1, v0, v2, n1), (v2, v0, v1, n2))
        heights = []
        for side in (1.0, -1.0):
            envelope = [
                np.maximum(
                    side * _dot(own - point, n)
                    + np.maximum(np.maximum(side * _dot(one - own, n), side * _dot(other - own, n)), 0.0),
                    0.0,
                )
                for own, one, other, n in corners
            ]
            heights.append(side * np.maximum(np.minimum.reduce(envelope), side * parabola))
        normal = normal if self.to_world is None else normal @ self.to_world.T
        above = _dot(normal, geometric_normal) > 0.0
        heights = np.where(above, heights, heights[::-1])
        return heights[:, :, None] * normal


def _cofactors(matrix):
    """What takes normals (3,) along with points: the inverse transposed times the determinant."""
    return np.array([np.cross(matrix[1], matrix[2]), np.cross(matrix[2], matrix[0]), np.cross(matrix[0], matrix[1])])


class EmbreeCaster:
    """Casts rays through both scenes of `occluders`: what blocks, and what is transparent.

    A caster tells what at most `chunk` rays meet; `Tracer` makes shares of light of that.
    """

    chunk = CHUNK

    def __init__(self, occluders: Occluders, embree: _Embree):
        self.description, self.library = f"Embree {embree.version}", embree.path
        self._embree, self._scenes = embree, []
        for index in occluders.split():
            self._scenes.append(_Scene(embree, occluders, index))
        self._packets = _Packets(embree.width, RAY_ROWS)
        self._hits = _Packets(embree.width, HIT_ROWS)

    def close(self) -> None:
        """Free the memory that Embree has taken."""
        for scene in self._scenes:
            scene.close()

    def blocked(self, origins, directions, distances, masks) -> np.ndarray:
        """Mask (R,) of the rays that something blocks."""
        packets, count, scene = self._packets, len(origins), self._scenes[0]
        for row, values in ((ORIGIN, origins), (DIRECTION, directions), (FAR, distances), (MASK, masks)):
            packets.set(row, values)
        packets.trace(self._embree.occluded, scene.scene, count)
        return packets.get(FAR, count) < 0.0  # Embree writes -inf

    def closest(self, is_clear: bool, origins, directions, near, far, masks) -> Hits:
        """What the rays meet first from `near` to `far` of what is transparent, or of what blocks."""
        packets, count, scene = self._hits, len(origins), self._scenes[is_clear]
        for row, values in ((ORIGIN, origins), (NEAR, near), (DIRECTION, directions), (FAR, far), (MASK, masks)):
            packets.set(row, values)
        packets.numbers[:, GEOMETRY : INSTANCE + 1] = NONE
        packets.trace(self._embree.intersect, scene.scene, count)
        geometry, part = packets.get(GEOMETRY, count, True), packets.get(INSTANCE, count, True)
        ray = np.flatnonzero(geometry != NONE)
        number = np.where(part == NONE, geometry, part)[ray]
        distance, u, v = (packets.get(row, count)[ray] for row in (FAR, U, V))
        return Hits(ray, distance, scene.instances[number], packets.get(TRIANGLE, count, True)[ray], u, v)


@dataclass(frozen=True)
class Hits:
    """What H of R rays meet: the `ray`, how far away, which triangle of which instance, where on it."""

    ray: np.ndarray  # (H,)
    distance: np.ndarray  # (H,) m
    instance: np.ndarray  # (H,)
    triangle: np.ndarray  # (H,)
    u: np.ndarray  # (H,) share of the second corner
    v: np.ndarray  # (H,) share of the third


class Tracer:
    """Rays through `occluders`; see `open_tracer`. Use it as a context, or call `close`.

    `caster` is as EmbreeCaster, and `description` says which it is. Other processes can open the file `library`; None:
    they cannot.
    """

    def __init__(self, occluders: Occluders, caster):
        self.occluders, self.description = occluders, caster.description
        self.library = getattr(caster, "library", None)
        self._caster, self._lock = caster, threading.Lock()
        self._has = [len(index) > 0 for index in occluders.split()]
        uses = np.bincount(occluders.mesh, minlength=len(occluders.meshes))
        self._is_applied = uses[occluders.mesh] == 1
        self._thickness = np.zeros(len(occluders.mesh))  # the largest of each instance, in m
        thick = [mesh.thickness is not None and len(mesh.triangles) > 0 for mesh in occluders.meshes]
        for number in np.flatnonzero(np.array(thick, bool)[occluders.mesh]):
            self._thickness[number] = self._thickness_of(number, slice(None)).max()

    def __enter__(self) -> Tracer:
        return self

    def __exit__(self, *error) -> None:
        self.close()

    def close(self) -> None:
        """Free what the caster has taken."""
        with self._lock:
            self._caster.close()

    def transmittance(
        self, origins: np.ndarray, directions: np.ndarray, distances: np.ndarray, masks: np.ndarray | None = None
    ) -> np.ndarray:
        """Share (R,) float32 of light that comes from `distances` (R,) in m, which may be inf, along unit `directions`
        (R, 3) to `origins` (R, 3): 0 where something blocks it, 1 where nothing is met.

        `masks` (R,) are as those of `Occluders`; left out: everything counts. Rays of the same origin, one after
        another, are faster.
        """
        origins, directions, distances = (np.asarray(values, np.float32) for values in (origins, directions, distances))
        count, chunk = len(origins), self._caster.chunk
        masks = np.broadcast_to(np.uint32(ALL_RAYS), (count,)) if masks is None else np.asarray(masks, np.uint32)
        shares = np.ones(count, np.float32)
        with self._lock:
            for start in range(0, count, chunk):
                part = slice(start, start + chunk)
                rays = origins[part], directions[part], distances[part], masks[part]
                if self._has[False]:
                    shares[part][self._caster.blocked(*rays)] = 0.0
                if self._has[True]:
                    self._attenuate(shares[part], *rays)
        return shares

    def _attenuate(self, shares, origins, directions, distances, masks):
        """Multiply `shares` (R,) by those of the transparent surfaces that the rays meet."""
        near = np.zeros(len(shares), np.float32)
        index = np.flatnonzero(shares > 0.0)
        for _ in range(self.occluders.transparent_surfaces + 1):
            if not len(index):
                return
            rays = origins[index], directions[index], near[index], distances[index], masks[index]
            hits = self._caster.closest(True, *rays)
            index = index[hits.ray]
            mesh = self.occluders.mesh[hits.instance]
            for number in np.unique(mesh):
                here = mesh == number
                clear = self.occluders.meshes[number].transparency
                shares[index[here]] *= clear.shares(hits.triangle[here], hits.u[here], hits.v[here])
            near[index] = hits.distance * STEP
            index = index[shares[index] > 0.0]
        shares[index] = 0.0

    def mask_of(self, light: str) -> int:
        """Mask of the rays to the light of that name, which `transmittance` takes; 0: nothing is in its way."""
        return self.occluders.mask_of(light)

    def chosen_by(self, light: str) -> ChosenBy:
        """Which rays to the light of that name there are."""
        return self.occluders.chosen_by(light)

    def starts(self, samples: SurfaceSamples) -> Starts:
        """Where rays from `samples` start: as in Cycles, on the triangle, which they leave without meeting it.

        Where a smooth surface is about to hide the light that falls on its triangles at a grazing angle, they start
        from a curved surface above them (`shadow_terminator_geometry_offset`). A sample that is on no triangle of the
        occluders keeps a small distance from its surface. Triangles have their own normals here: that of a sample is
        the smooth one where a lobe ends at the smooth horizon.
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
            part = slice(start, start + chunk)
            found = self._triangles_at(position[part], normal[part], (NEARBY * (1.0 + reach[part])).astype(np.float32))
            for number in np.unique(found.instance):
                here = found.instance == number
                shape = _Shape.of(self.occluders, found, here, self._is_applied[number])
                index = start + found.ray[here]
                clearance[index] = CLEARANCE * (reach[index] + shape.size)
                if self._thickness[number] > 0.0:
                    clearance[index] += self._thickness_of(number, found.triangle[here])
                else:
                    normal[index] = shape.face_normals(normal[index], smooth_normal[index])
                if shape.normals is not None:
                    lifts = shape.lifts(normal[index])
                    lift[:, index] = lifts
                    terminator[index] = self.occluders.terminators[number] * np.any(lifts, axis=(0, 2))
        return Starts(position, normal, smooth_normal, clearance, lift, terminator)

    def _thickness_of(self, instance, triangle) -> np.ndarray:
        """World-space thickness (Q,) of triangles of an instance that has one, in m."""
        thickness = self.occluders.meshes[self.occluders.mesh[instance]].thickness
        scale = np.linalg.norm(self.occluders.matrices[instance][:, :3], axis=0).max()
        return thickness[triangle] * np.float32(scale)

    def _triangles_at(self, position, normal, reach) -> Hits:
        """Which triangles samples lie on, within `reach` (P,) m or their thickness, as if rays had met them."""
        found = self._nearest(position, normal, reach)
        thickest = np.float32(self._thickness.max(initial=0.0))
        if thickest == 0.0:
            return found
        rest = np.ones(len(position), bool)
        rest[found.ray] = False
        rest = np.flatnonzero(rest)
        wider = self._nearest(position[rest], normal[rest], np.full(len(rest), thickest))
        within = np.zeros(len(wider.ray), bool)
        for number in np.unique(wider.instance[self._thickness[wider.instance] > 0.0]):
            here = np.flatnonzero(wider.instance == number)
            within[here] = wider.distance[here] <= self._thickness_of(number, wider.triangle[here])
        wider = Hits(rest[wider.ray], *(getattr(wider, field.name) for field in fields(Hits)[1:]))
        joined = zip(*((getattr(hits, field.name) for field in fields(Hits)) for hits in (found, wider)), strict=True)
        return Hits(*(np.concatenate([one, other[within]]) for one, other in joined))

    def _nearest(self, position, normal, reach) -> Hits:
        """The triangles nearest to samples along their normals, up to `reach`; `distance` is how near."""
        count = len(position)
        origins, everything = position + reach[:, None] * normal, np.full(count, ALL_RAYS, np.uint32)
        off = np.full(count, np.inf, np.float32)
        best = Hits(np.arange(count), off, *(np.zeros(count, kind) for kind in (int, int, np.float32, np.float32)))
        with self._lock:
            for is_clear in (False, True):
                near, index = np.zeros(count, np.float32), np.arange(count)
                # The first triangle may be that of another surface, close above.
                for _ in range(LAYERS if self._has[is_clear] else 0):
                    rays = origins[index], -normal[index], near[index], 2.0 * reach[index], everything[index]
                    hits = self._caster.closest(is_clear, *rays)
                    index = index[hits.ray]
                    found = np.abs(hits.distance - reach[index])
                    closer = found < off[index]
                    for field in fields(Hits)[2:]:
                        getattr(best, field.name)[index[closer]] = getattr(hits, field.name)[closer]
                    off[index[closer]] = found[closer]
                    near[index] = hits.distance * STEP
                    index = index[off[index] > CERTAIN * reach[index]]
        there = np.isfinite(off)
        return Hits(*(getattr(best, field.name)[there] for field in fields(Hits)))


# -- where shadow rays start -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Starts:
    """Where shadow rays of P samples start, see `Tracer.starts`; `origins` tells it for each ray."""

    position: np.ndarray  # (P, 3) float32
    geometric_normal: np.ndarray  # (P, 3)
    smooth_normal: np.ndarray  # (P, 3)
    clearance: np.ndarray  # (P,) m, so far from its plane a ray surely does not meet the sample's own triangle
    lift: np.ndarray  # (2, P, 3) m, to where a smooth surface would be: for light from outside, and from inside
    terminator: np.ndarray  # (P,) as Occluders.terminators, 0 for all that is flat

    def origins(self, index: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Origins (R, 3) of rays along unit `directions` (R, 3) from the samples `index` (R,)."""
        return self.origins_of_rows(index, directions.T[:, None])[:, 0].T

    def origins_of_rows(self, index: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Origins (3, S, Q) of S rays each from the samples `index` (Q,), along unit `directions` (3, S, Q)."""
        normal, terminator = self.geometric_normal[index].T[:, None], self.terminator[index]
        facing = _dot_rows(normal, directions)
        side = np.copysign(self.clearance[index], facing)
        smooth = np.flatnonzero(terminator)
        lift = None
        if len(smooth):
            part = slice(None) if len(smooth) == len(index) else smooth
            rays = directions[:, :, part], facing[:, part], terminator[part]
            lift, own = self._lifts(index[part], *rays)
            side[:, part] = np.where(own, np.abs(side[:, part]) * own, side[:, part])
        found = side * normal
        found += self.position[index].T[:, None]
        if lift is not None:
            found[:, :, part] += lift
        return found

    def at_surface(self, index: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Origins (3, R) of rays along unit `directions` (3, R) that start at the samples `index` (R,) themselves, as
        those that Cycles sends on from a surface."""
        normal = self.geometric_normal[index].T
        found = np.copysign(self.clearance[index], _dot_rows(normal, directions)) * normal
        found += self.position[index].T
        return found

    def aimed(self, index: np.ndarray, directions: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, ...]:
        """Origins and unit directions (3, S, Q) and distances (S, Q) of S rays each from the samples `index` (Q,).

        They end at `distances`, finite, along `directions` from the sample, wherever they start.
        """
        origins = self.origins_of_rows(index, directions)
        moved = origins - self.position[index].T[:, None]
        lifted = np.flatnonzero(_dot_rows(moved, moved) > 4.0 * self.clearance[index] ** 2)
        if len(lifted):
            directions, distances = directions.copy(), distances.copy()
            rows = directions.reshape(3, -1)
            toward = rows[:, lifted] * distances.ravel()[lifted] - moved.reshape(3, -1)[:, lifted]
            length = np.sqrt(_dot_rows(toward, toward))
            rows[:, lifted] = toward / np.maximum(length, np.float32(1e-30))
            distances.ravel()[lifted] = length
        return origins, directions, distances

    def _lifts(self, index, directions, facing, terminator):
        """How far (3, S, Q) rays of smooth samples start from the sample, and where they start not to pass their own
        triangle (S, Q): above it (1), below (-1) or where the direction tells (0)."""
        smooth_facing = _dot_rows(self.smooth_normal[index].T[:, None], directions)
        is_inside = smooth_facing < 0.0
        flipped = np.where(is_inside, np.float32(-1.0), np.float32(1.0))
        facing, smooth_facing = facing * flipped, np.abs(smooth_facing)
        grazing = 1.0 + np.maximum(1.0 - smooth_facing / terminator, 0.0) - facing / terminator
        amount = np.clip(grazing, 0.0, 1.0)
        outside, inside = self.lift[:, index].transpose(0, 2, 1)[:, :, None]
        # As in Cycles, light from behind the own triangle meets it.
        own = np.where((amount > 0.0) & (facing <= 0.0), flipped, np.float32(0.0))
        return amount * np.where(is_inside, inside, outside), own


def _dot_rows(first, second):
    """Scalar products (S, Q) of vectors (3, S, Q)."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


def _dot(first, second):
    """Scalar products (R,) of vectors (R, 3)."""
    return np.einsum("rk,rk->r", first, second)


# -- which library --------------------------------------------------------------------------------------------------

_trusted: dict[str, _Embree] = {}


def open_tracer(occluders: Occluders, libraries: Iterable[str | os.PathLike] = ()) -> Tracer:
    """A tracer by the first of `libraries`, files of Embree 4, that passes a test; the system's own comes last.

    Raises SceneError where there is none; names what is wrong with each.
    """
    reasons = []
    for library in (*map(str, libraries), *SYSTEM_LIBRARIES):
        try:
            if library not in _trusted:
                embree = _Embree(library)
                _probe(embree)
                _trusted[library] = embree
            return Tracer(occluders, EmbreeCaster(occluders, _trusted[library]))
        except _Unfit as error:
            reasons.append(f"{library}: {error}")
    raise SceneError(f"no library to trace shadow rays with: {listed(reasons, 8, '; ')}")


def _probe(embree: _Embree) -> None:
    """Raise _Unfit where rays of known answer get another one."""
    square = OccluderMesh([[0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]], [[0, 1, 2], [1, 3, 2]])
    clear = OccluderMesh(square.vertices, square.triangles, Transparency(0.25))
    here, higher, highest = np.eye(3, 4), np.eye(3, 4), np.eye(3, 4)
    higher[2, 3], highest[2, 3] = 2.0, 4.0
    turned = np.array([[0.0, 0, 1, 20], [1, 0, 0, 0], [0, 1, 0, 0]])  # its normal is x, at x = 20
    occluders = Occluders((square, square, clear), [0, 1, 1, 2], [here, higher, turned, highest], [1, 2, 4, 8])
    up, along = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    rays = (  # origin, direction, distance, mask, answer
        ([1, 1, -1], up, np.inf, 1, 0.0),
        ([1, 1, -1], up, np.inf, 2, 0.0),
        ([1, 1, -1], up, np.inf, 4, 1.0),
        ([1, 1, -1], up, 0.9, 1, 1.0),
        ([1, 1, -1], up, 2.9, 2, 1.0),
        ([5, 1, -1], up, np.inf, ALL_RAYS, 1.0),
        ([3, 3, -1], up, np.inf, 8 | 4, 0.25),
        ([3, 3, -1], up, np.inf, 8 | 1, 0.0),
        ([3, 3, -1], up, 4.9, 8, 1.0),
        ([0, 1, 1], along, np.inf, 4, 0.0),
        ([0, 1, 1], along, 19.9, 4, 1.0),
        ([0, 5, 1], along, np.inf, 4, 1.0),
    )
    origins, directions, distances, masks, answers = map(np.array, zip(*rays, strict=True))
    with Tracer(occluders, EmbreeCaster(occluders, embree)) as tracer:
        found = tracer.transmittance(origins, directions, distances, masks)
    if not np.array_equal(found, answers.astype(np.float32)):
        raise _Unfit(f"version {embree.version}: rays of known answer got others")
