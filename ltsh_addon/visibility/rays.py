"""Rays through occluders, traced by the library Embree 4 that Blender ships, called through ctypes.

Embree is a C library; its functions and their arguments are those of the headers rtcore_*.h of Embree 4. A ray packet
has one row for each component; a row holds as many rays as the processor takes at once. Python calls Embree once for
each packet. These calls are too short for threads to share a process, so a `Tracer` uses one core, and each process
that traces opens its own.
"""

import ctypes
import os
import threading
from collections import deque
from collections.abc import Iterable
from itertools import repeat

import numpy as np

from ..scene import SceneError, SurfaceSamples, error_line, listed
from .occluders import ALL_RAYS, STEP, Hits, OccluderMesh, Occluders, Transparency
from .shadow_terminator import RayOrigins, ShadowTerminator

# Names under which the system may know the library.
SYSTEM_LIBRARIES = ("libembree4.so.4", "libembree4.4.dylib", "libembree4.dylib", "embree4.dll")
# Rays in a chunk, few enough for its packets to stay in the second-level cache.
CHUNK = 4096
# Rows of a packet of rays, and of a packet of rays with their hits. The last two rows are for what some builds add.
ORIGIN, NEAR, DIRECTION, FAR, MASK = slice(0, 3), 3, slice(4, 7), 8, 9
RAY_ROWS, U, V, TRIANGLE, GEOMETRY, INSTANCE, HIT_ROWS = 12, 15, 16, 17, 18, 19, 22
NONE, MOST_LEVELS = 0xFFFFFFFF, 32

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
    """The functions of one library, and a device made by it."""

    def __init__(self, library: str):
        self.path = library
        try:
            self._library = ctypes.CDLL(library)
            # PyDLL keeps Python's lock during a call; the calls are too short to release it.
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
        """Raise MemoryError or RuntimeError if a call since the last check has failed."""
        code = self.GetDeviceError(self.device)
        if code == 4:
            raise MemoryError("occluders: Embree found no memory for them")
        if code:
            raise RuntimeError(f"Embree {self.version}: error {_ERRORS[code] if code < len(_ERRORS) else code}")


def _aligned(count: int, dtype=np.float32) -> np.ndarray:
    """Zeros (count,) of 4 bytes each, at an address that is a multiple of 64."""
    memory = np.zeros(count + 16, dtype)
    start = -(memory.ctypes.data // 4) % 16
    return memory[start : start + count]


class _Packets:
    """Room for CHUNK rays in packets of `width` rays and `rows` rows, and the addresses of the packets."""

    def __init__(self, width: int, rows: int):
        count = CHUNK // width
        # A build of Embree with more levels of instances would write beyond the last packet before `_probe` rejects it.
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
        """Write `values` (R,) to one row, or (R, 3) to three rows."""
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
        """The first `count` values of a row, as a copy."""
        whole = -(-count // self._width)
        return (self.numbers if numbers else self.values)[:whole, row].reshape(-1)[:count]

    def trace(self, function, scene, count: int) -> None:
        """Call an Embree function for the packets of `count` rays."""
        addresses = self.addresses[: -(-count // self._width)]
        valid = _POINTER(self._valid.ctypes.data)
        deque(map(function, repeat(valid), repeat(scene), addresses, repeat(None)), maxlen=0)


class _Scene:
    """The instances `index` of `occluders` as an Embree scene."""

    def __init__(self, embree: _Embree, occluders: Occluders, index: np.ndarray):
        self._embree, self._buffers, self._scenes = embree, [], []
        self.scene, self.instances = None, index
        uses = np.bincount(occluders.mesh[index], minlength=len(occluders.meshes))
        shared: dict[int, int] = {}
        self.scene = self._new_scene()
        try:
            for number in index:
                mesh, mask = int(occluders.mesh[number]), int(occluders.masks[number])
                matrix = occluders.matrices[number]
                if uses[mesh] == 1:
                    self._add_triangles(self.scene, occluders.meshes[mesh], matrix, mask)
                else:
                    if mesh not in shared:
                        shared[mesh] = self._new_scene()
                        self._add_triangles(shared[mesh], occluders.meshes[mesh], None, ALL_RAYS)
                        embree.CommitScene(shared[mesh])
                    self._add_instance(shared[mesh], matrix, mask)
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

    def _add_triangles(self, scene, mesh, matrix, mask) -> None:
        embree, vertices, triangles = self._embree, mesh.vertices, mesh.triangles
        if matrix is not None:
            vertices = vertices.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]
        # Embree reads 4 bytes beyond the last vertex.
        buffer = _aligned(3 * len(vertices) + 1)
        buffer[:-1] = vertices.reshape(-1)
        geometry = embree.NewGeometry(embree.device, _TRIANGLES)
        for kind, data, form, count in (
            (_VERTEX_BUFFER, buffer, _FLOAT3, len(vertices)),
            (_INDEX_BUFFER, triangles, _UINT3, len(triangles)),
        ):
            embree.SetSharedGeometryBuffer(geometry, kind, 0, form, data.ctypes.data, 0, 12, count)
            self._buffers.append(data)
        self._attach(scene, geometry, mask)

    def _add_instance(self, mesh_scene, matrix, mask) -> None:
        embree, values = self._embree, np.ascontiguousarray(matrix, np.float32)
        geometry = embree.NewGeometry(embree.device, _INSTANCES)
        embree.SetGeometryInstancedScene(geometry, mesh_scene)
        embree.SetGeometryTransform(geometry, 0, _FLOAT3X4, values.ctypes.data)
        self._attach(self.scene, geometry, mask)

    def _attach(self, scene, geometry, mask) -> None:
        embree = self._embree
        embree.SetGeometryMask(geometry, mask)
        embree.CommitGeometry(geometry)
        embree.AttachGeometry(scene, geometry)
        embree.ReleaseGeometry(geometry)

    def __del__(self):
        # Views drop tracers that a thread may still use.
        self.close()

    def close(self) -> None:
        while self._scenes:
            self._embree.ReleaseScene(self._scenes.pop(0))
        self._buffers.clear()


class EmbreeCaster:
    """Casts rays through the two scenes of `occluders`: what blocks, and what is transparent.

    A caster tells what at most `chunk` rays meet; `Tracer` turns that into shares of light.
    """

    chunk = CHUNK

    def __init__(self, occluders: Occluders, embree: _Embree):
        self.description, self.library = f"Embree {embree.version}", embree.path
        self._embree, self._scenes = embree, []
        for index in occluders.split():
            self._scenes.append(_Scene(embree, occluders, index))
        self.has = tuple(len(scene.instances) > 0 for scene in self._scenes)
        self._packets = _Packets(embree.width, RAY_ROWS)
        self._hits = _Packets(embree.width, HIT_ROWS)

    def of(self, occluders: Occluders) -> "EmbreeCaster":
        """A caster for other occluders."""
        return EmbreeCaster(occluders, self._embree)

    def close(self) -> None:
        """Free the memory that Embree holds."""
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
        """The first hits of rays between `near` and `far`: on transparent surfaces if `is_clear`, otherwise on surfaces
        that block."""
        packets, count, scene = self._hits, len(origins), self._scenes[is_clear]
        for row, values in ((ORIGIN, origins), (NEAR, near), (DIRECTION, directions), (FAR, far), (MASK, masks)):
            packets.set(row, values)
        packets.numbers[:, GEOMETRY : INSTANCE + 1] = NONE
        packets.trace(self._embree.intersect, scene.scene, count)
        geometry, instance = packets.get(GEOMETRY, count, True), packets.get(INSTANCE, count, True)
        ray = np.flatnonzero(geometry != NONE)
        number = np.where(instance == NONE, geometry, instance)[ray]
        distance, u, v = (packets.get(row, count)[ray] for row in (FAR, U, V))
        return Hits(ray, distance, scene.instances[number], packets.get(TRIANGLE, count, True)[ray], u, v)


class Tracer:
    """Rays through `occluders`; see `open_tracer`. Use it as a context manager, or call `close`.

    `description` names the library, and `library` is its file.
    """

    def __init__(self, occluders: Occluders, caster):
        self.occluders, self.description = occluders, caster.description
        self.library = caster.library
        self._caster, self._lock = caster, threading.Lock()
        self._terminator = ShadowTerminator(occluders, caster)

    def __reduce__(self):
        # A worker process opens a tracer of its own.
        return open_tracer, (self.occluders, (self.library,))

    def __enter__(self) -> "Tracer":
        return self

    def __exit__(self, *error) -> None:
        self.close()

    def close(self) -> None:
        """Free what the caster holds."""
        with self._lock:
            self._caster.close()
            self._terminator.close()

    def transmittance(
        self, origins: np.ndarray, directions: np.ndarray, distances: np.ndarray, masks: np.ndarray | None = None
    ) -> np.ndarray:
        """Share (R,) float32 of light that reaches `origins` (R, 3) along unit `directions` (R, 3) from `distances`
        (R,) in m, which may be inf. It is 0 if something blocks the light, and 1 if nothing is met.

        `masks` (R,) are those of `Occluders`; by default, everything counts. It is faster if rays of the same origin
        are consecutive.
        """
        origins, directions, distances = (np.asarray(values, np.float32) for values in (origins, directions, distances))
        count, chunk = len(origins), self._caster.chunk
        masks = np.broadcast_to(np.uint32(ALL_RAYS), (count,)) if masks is None else np.asarray(masks, np.uint32)
        transmittance = np.ones(count, np.float32)
        with self._lock:
            if self._caster.has[False]:
                for start in range(0, count, chunk):
                    rows = slice(start, start + chunk)
                    blocked = self._caster.blocked(origins[rows], directions[rows], distances[rows], masks[rows])
                    transmittance[rows][blocked] = 0.0
            if self._caster.has[True]:
                self._attenuate(transmittance, origins, directions, distances, masks)
        return transmittance

    def _attenuate(self, transmittance, *rays):
        """Multiply `transmittance` (R,) by those of the transparent surfaces that the rays meet."""
        near = np.zeros(len(transmittance), np.float32)
        index = np.flatnonzero(transmittance > 0.0)
        for _ in range(self.occluders.transparent_surfaces + 1):
            met = []
            for start in range(0, len(index), self._caster.chunk):
                rows = index[start : start + self._caster.chunk]
                origins, directions, distances, masks = (values[rows] for values in rays)
                hits = self._caster.closest(True, origins, directions, near[rows], distances, masks)
                near[rows[hits.ray]] = hits.distance * STEP
                met.append((rows[hits.ray], hits.instance, hits.triangle, hits.u, hits.v))
            if not met:
                return
            index, instance, *places = map(np.concatenate, zip(*met, strict=True))
            mesh = self.occluders.mesh[instance]
            for number in np.unique(mesh):
                here = np.flatnonzero(mesh == number)
                occluder, place = self.occluders.meshes[number], [values[here] for values in places]
                cosine = None
                if occluder.transparency.cosines is not None:
                    several, which = np.unique(instance[here], return_inverse=True)
                    inverse = np.linalg.pinv(self.occluders.matrices[several, :, :3])[which]
                    cosine = occluder.cosines(*place, rays[1][index[here]], inverse)
                transmittance[index[here]] *= occluder.transparency.transmittance(*place, cosine)
            index = index[transmittance[index] > 0.0]
        transmittance[index] = 0.0

    def ray_origins(self, samples: SurfaceSamples) -> RayOrigins:
        """Where rays from `samples` start, see `ShadowTerminator.ray_origins`."""
        with self._lock:
            return self._terminator.ray_origins(samples)


# Which library:

_trusted: dict[str, _Embree] = {}


def open_tracer(occluders: Occluders, libraries: Iterable[str | os.PathLike] = ()) -> Tracer:
    """A tracer that uses the first of `libraries`, files of Embree 4, that passes a test. The system's own come last.

    Raises SceneError if there is none, which says what is wrong with each.
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
    raise SceneError(
        f"shadows need Embree 4, which Blender brings along, and none can be used: {listed(reasons, 8, '; ')}. Without "
        "shadows (--shadows off) it is not needed"
    )


def _probe(embree: _Embree) -> None:
    """Raise _Unfit if rays with known answers get others."""
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
        transmittance = tracer.transmittance(origins, directions, distances, masks)
    if not np.array_equal(transmittance, answers.astype(np.float32)):
        raise _Unfit(f"version {embree.version}: rays of known answer got others")
