"""Occluders: triangle meshes, instances of them, and how much light they let through."""

import json
import os
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from ..cycles.texels import EXTENSIONS, INTERPOLATIONS, interpolated, within
from ..files import replacing

# Mask of all kinds of rays.
ALL_RAYS = 0xFFFFFFFF
# Cycles' default of `Object.cycles.shadow_terminator_geometry_offset`.
TERMINATOR_OFFSET = 0.1
# Cycles' default of transparent bounces. A ray that meets more transparent surfaces is blocked.
TRANSPARENT_SURFACES = 8
# A ray continues behind a transparent surface at this multiple of its distance.
STEP = np.float32(1.0 + 2.0**-21)
# GAP: a step of single precision, as a share of the coordinates. What is within 4 of them of a plane is in it.
GAP = float(np.finfo(np.float32).eps)
# For overlaps in a plane: how many triangles are looked at, how many of a mesh tell its planes, how many points are
# tried, and how many pairs of a point and a triangle by plane. PLANE_STEPS: the unit normals of planes, and their
# heights in units of the largest coordinate, round to as many steps; PLANE_KEYS make a number of that.
MOST_IN_PLANES, LARGEST, PLANE_POINTS, MOST_TESTS, PLANE_STEPS = 1 << 17, 1024, 2048, 2_000_000, 1e4
PLANE_KEYS = np.array([1, 3_000_017, 9_000_000_000_023, 27_000_000_000_000_029])
# Tells the two sides of planes apart; no common plane holds it.
OBLIQUE = np.array([0.61, 0.553, 0.567])


@dataclass(frozen=True)
class Transparency:
    """Share of light that a surface lets through: `share`, times the value of `image` at `uv` if there is one.

    Colors count by their mean. The image (H, W) holds shares, with row 0 at the bottom. `uv` (T, 3, 2) places the
    corners of the triangles on it. With `cosines` (A,), which increase, it holds (A, H, W): by the cosine of the ray
    back to the shaded point and the normal, negative from behind.
    """

    share: float = 1.0
    image: np.ndarray | None = None
    uv: np.ndarray | None = None
    extension: str = "REPEAT"  # one of EXTENSIONS
    interpolation: str = "Linear"  # one of INTERPOLATIONS
    outside: float = 1.0  # value beside the image if `extension` is CLIP
    # Values and shares, both increasing, or the shares decreasing: turns interpolated values of the image into shares.
    curve: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    cosines: tuple[float, ...] | None = None

    def __post_init__(self):
        if not 0.0 <= self.share <= 1.0:
            raise ValueError(f"transparency: share is {self.share!r}, expected a number from 0 to 1")
        if (self.image is None) != (self.uv is None):
            raise ValueError("transparency: expected an image and its uv, or neither")
        if self.extension not in EXTENSIONS or self.interpolation not in INTERPOLATIONS:
            raise ValueError(
                f"transparency: {self.extension!r} and {self.interpolation!r}, expected one of {', '.join(EXTENSIONS)} "
                f"and one of {', '.join(INTERPOLATIONS)}"
            )

    @property
    def is_opaque(self) -> bool:
        """True if no pixel of the image lets light through, as of pictures with an alpha channel that is full."""
        beside = self.outside if self.extension == "CLIP" else 0.0
        return self.image is not None and not (self.transmittance_of(self.image).any() or self.transmittance_of(beside))

    def transmittance(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, cosine=None) -> np.ndarray:
        """Shares (Q,) at the points (1 - u - v) a + u b + v c of triangles (Q,) with corners a, b, c.

        `cosine` (Q,) is needed only with `cosines`.
        """
        if self.image is None:
            return np.full(len(triangle), self.share, np.float32)
        a, b, c = np.moveaxis(self.uv[triangle], 1, 0)
        u, v = u[:, None], v[:, None]
        uv = (1.0 - u - v) * a + u * b + v * c
        if self.cosines is None:
            return self.transmittance_of(self._image_at(uv))
        level = np.interp(cosine, self.cosines, np.arange(len(self.cosines)))
        below = np.minimum(level.astype(np.int64), len(self.cosines) - 2)
        first, second = (self._image_at(uv, (number,)) for number in (below, below + 1))
        return self.transmittance_of(first + (level - below) * (second - first))

    def transmittance_of(self, values) -> np.ndarray:
        """Shares (...) for values (...) of the image."""
        values_of_curve = values if self.curve is None else np.interp(values, *self.curve)
        return (self.share * np.clip(values_of_curve, 0.0, 1.0)).astype(np.float32)

    def _image_at(self, uv, level=()):
        height, width = self.image.shape[-2:]
        return interpolated(uv, (width, height), self.interpolation, partial(self._pixel, level))

    def _pixel(self, level, x, y):
        """Values of pixels, which may lie outside the image."""
        height, width = self.image.shape[-2:]
        columns, rows = within(x, width, self.extension), within(y, height, self.extension)
        values = self.image[(*level, rows, columns)]
        if self.extension == "CLIP":
            values = np.where((x == columns) & (y == rows), values, self.outside)
        return values


@dataclass(frozen=True)
class OccluderMesh:
    """Triangles in the space of an object.

    `normals` are those of smooth shading, at vertices (V, 3) or at corners (T, 3, 3); a flat mesh has none. Triangles
    that stand for hairs or points have a `thickness` (T,): the largest distance of a shaded point from them.
    """

    vertices: np.ndarray  # (V, 3) float32
    triangles: np.ndarray  # (T, 3) uint32
    transparency: Transparency | None = None  # None: it blocks all light
    normals: np.ndarray | None = None
    thickness: np.ndarray | None = None

    def __post_init__(self):
        vertices = np.ascontiguousarray(self.vertices, np.float32)
        triangles = np.ascontiguousarray(self.triangles, np.uint32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
            raise ValueError(f"mesh: vertices {vertices.shape}, triangles {triangles.shape}, expected (V, 3), (T, 3)")
        if triangles.size and triangles.max() >= len(vertices):
            raise ValueError(f"mesh: a triangle names vertex {triangles.max()}, expected less than {len(vertices)}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)
        allowed = {"normals": (vertices.shape, (len(triangles), 3, 3)), "thickness": ((len(triangles),),)}
        for name, shapes in allowed.items():
            if (values := getattr(self, name)) is not None:
                values = np.ascontiguousarray(values, np.float32)
                if values.shape not in shapes:
                    raise ValueError(f"mesh: {name} {values.shape}, expected {' or '.join(map(str, shapes))}")
                object.__setattr__(self, name, values)
        uv = None if self.transparency is None else self.transparency.uv
        if uv is not None and uv.shape != (len(triangles), 3, 2):
            raise ValueError(f"mesh: uv {uv.shape}, expected {len(triangles), 3, 2}")

    def cosines(self, triangle, u, v, directions: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """The cosines (Q,) of `Transparency.cosines` for rays that go on in unit `directions` (Q, 3) at points of
        triangles (Q,), as in `Transparency.transmittance`. `inverse` (Q, 3, 3) are the inverses of their instances'
        matrices."""
        corners = self.triangles[triangle]
        a, b, c = np.moveaxis(self.vertices[corners].astype(np.float64), 1, 0)
        flat = smooth = np.cross(b - a, c - a)
        if self.normals is not None:
            normals = self.normals[corners] if self.normals.ndim == 2 else self.normals[triangle]
            smooth = np.einsum("kq,qkc->qc", [1.0 - u - v, u, v], normals)
        toward, side = (np.einsum("qi,qij,qj->q", normal, inverse, -directions) for normal in (smooth, flat))
        length = np.linalg.norm(np.einsum("qi,qij->qj", smooth, inverse), axis=1)
        return np.copysign(toward / np.maximum(length, 1e-30), side)


@dataclass(frozen=True)
class ChosenBy:
    """Which shadow rays Cycles sends to a light: rays that the `light` chooses (not without Cast Shadow), and rays that
    the `surface` chooses (not without multiple importance sampling)."""

    light: bool = True
    surface: bool = True


@dataclass(frozen=True)
class Occluders:
    """`meshes`, and I instances. `mesh` (I,) is the number of each one's mesh; `matrices` (I, 3, 4) take it to world
    space. An instance blocks rays that share a bit with its `masks` (I,) uint32; by default, all rays.

    `terminators` (I,) are Cycles' `shadow_terminator_geometry_offset`; by default, its default. A ray through more than
    `transparent_surfaces` is blocked. `light_masks` are the masks of rays to lights, by their names. `lone_choices`
    names the lights that only rays chosen by the "light", or only rays chosen by the "surface", can meet. Rays that the
    surface chooses have the mask of the light shifted by `surface_shift` bits, because some objects block only these,
    or all but these.
    """

    meshes: tuple[OccluderMesh, ...]
    mesh: np.ndarray
    matrices: np.ndarray
    masks: np.ndarray | None = None
    terminators: np.ndarray | None = None
    transparent_surfaces: int = TRANSPARENT_SURFACES
    light_masks: dict[str, int] = field(default_factory=dict)
    lone_choices: dict[str, str] = field(default_factory=dict)
    surface_shift: int = 0

    def __post_init__(self):
        mesh = np.asarray(self.mesh, np.int64)
        count = len(mesh)
        masks = np.full(count, ALL_RAYS) if self.masks is None else self.masks
        terminators = np.full(count, TERMINATOR_OFFSET) if self.terminators is None else self.terminators
        values = {
            "mesh": mesh,
            "matrices": np.asarray(self.matrices, np.float64).reshape(-1, 3, 4),
            "masks": np.asarray(masks, np.uint32),
            "terminators": np.asarray(terminators, np.float32),
        }
        for name, value in values.items():
            if len(value) != count:
                raise ValueError(f"occluders: {name} has {len(value)} instances, expected {count}")
            object.__setattr__(self, name, value)
        if count and (mesh.min() < 0 or mesh.max() >= len(self.meshes)):
            raise ValueError(f"occluders: an instance names mesh {mesh.max()}, expected 0 to {len(self.meshes) - 1}")
        object.__setattr__(self, "meshes", tuple(self.meshes))

    def split(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the instances that block, and of those that let light through. Those without triangles are in
        neither."""
        is_clear = [mesh.transparency is not None and not mesh.transparency.is_opaque for mesh in self.meshes]
        is_clear = np.array(is_clear, bool)[self.mesh]
        is_there = np.array([len(mesh.triangles) > 0 for mesh in self.meshes], bool)[self.mesh]
        return np.flatnonzero(is_there & ~is_clear), np.flatnonzero(is_there & is_clear)

    def mask_of(self, light: str) -> int:
        """Mask of the rays to the light of that name; 0 if nothing is in its way."""
        return self.light_masks.get(light, 1)

    def surface_mask_of(self, light: str) -> int:
        """As `mask_of`, for rays that the surface chooses."""
        return self.mask_of(light) << self.surface_shift

    def chosen_by(self, light: str) -> ChosenBy:
        """Which kinds of rays to the light of that name exist."""
        alone = self.lone_choices.get(light)
        return ChosenBy(light=alone != "surface", surface=alone != "light")

    def holding(self, points: np.ndarray, normal: np.ndarray | None) -> np.ndarray:
        """Numbers of the instances with a face that holds one of the `points` (N, 3) of a plane of unit `normal`; of a
        plane of any normal if that is None."""
        near = 4.0 * GAP * (np.abs(points[0]) @ (np.ones(3) if normal is None else np.abs(normal)))
        ends = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in self.meshes]
        low, high = np.array(ends, np.float64).reshape(-1, 2, 3)[self.mesh].swapaxes(0, 1)
        centers = np.einsum("nij,nj->ni", self.matrices[:, :, :3], 0.5 * (low + high)) + self.matrices[:, :, 3]
        halves = np.einsum("nij,nj->ni", np.abs(self.matrices[:, :, :3]), 0.5 * (high - low))
        reach = halves + np.ptp(points, axis=0) / 2.0 + near
        close = np.flatnonzero((np.abs(centers - points.mean(axis=0)) <= reach).all(axis=1))
        result = []
        for number in close:
            corners = self._in_plane(number, points[0], normal, near)[1]
            offset, face = corners[:, None] - points[:, None], _crosses(corners)[:, None, None]
            sides = (np.cross(offset, np.roll(offset, -1, axis=2)) * face).sum(axis=-1)
            if ((sides >= 0.0).all(axis=2) & (sides > 0.0).any(axis=2)).any():
                result.append(number)
        return np.array(result, np.int64)

    def _in_plane(self, number, point, normal, near):
        """The triangles (T,) of an instance that are nearer to a plane than `near`, in m, and their corners (T, 3, 3);
        if `normal` is None, those whose planes are nearer to the point."""
        mesh, matrix = self.meshes[self.mesh[number]], self.matrices[number]
        vertices = mesh.vertices @ matrix[:, :3].T + matrix[:, 3]
        if normal is not None:
            is_near = np.abs((vertices - point) @ normal) <= near
            index = np.flatnonzero(is_near[mesh.triangles[:, 0]])
            index = index[is_near[mesh.triangles[index]].all(axis=1)]
            return index, vertices[mesh.triangles[index]]
        corners = vertices[mesh.triangles]
        face = _crosses(corners)
        height = np.abs((face * (corners[:, 0] - point)).sum(axis=1))
        index = np.flatnonzero(height <= near * np.linalg.norm(face, axis=1))
        return index, corners[index]

    def overlaps(self, owners: np.ndarray) -> dict[tuple[int, int], float]:
        """By pairs of two of the `owners` (I,) of the instances, which faces of one are in faces of the other: the
        share of its faces in that plane. An owner below 0 does not count."""
        triangles, planes = self._large_triangles(np.flatnonzero(owners >= 0))
        is_sheet, shared = planes.sheets(owners[triangles.instance]), planes.shared_by(owners[triangles.instance])
        found = self._all_in_planes(triangles, planes, shared[planes.group])
        corners, owners = found.corners, owners[found.instance]
        is_mirrored = self.handedness()[found.instance] < 0.0
        corners[is_mirrored] = corners[is_mirrored, ::-1]
        pairs = overlaps_in_planes(corners, owners)
        first, other = owners[pairs.triangle], owners[pairs.other]
        # Of a box that stands on another nothing shows, of sheets one side or the other.
        shown = pairs.take(pairs.faces_alike | is_sheet[first] & is_sheet[other])
        pairs = shown.take(np.unique(shown.point, return_index=True)[1])
        result, columns = {}, (owners[pairs.triangle], owners[pairs.other], pairs.share)
        for first, other, share in zip(*map(np.ndarray.tolist, columns), strict=True):
            result[first, other] = result.get((first, other), 0.0) + share
        return result

    def opposed(self) -> "PlacedTriangles":
        """The triangles in whose planes others face the other way, as where a box stands on a floor."""
        triangles, planes = self._large_triangles(np.flatnonzero(self.masks != 0))
        facing = planes.facing * self.handedness()[triangles.instance]
        return self._all_in_planes(triangles, planes, planes.shared_by(facing)[planes.group])

    def handedness(self) -> np.ndarray:
        """-1 for instances (I,) that are mirrored, 1 for others."""
        return np.where(np.linalg.det(self.matrices[:, :, :3]) < 0.0, -1.0, 1.0)

    def _large_triangles(self, chosen):
        """The largest triangles of the instances `chosen`, and their planes."""
        chosen = chosen[: MOST_IN_PLANES // 2]
        most = min(max(MOST_IN_PLANES // max(len(chosen), 1), 2), LARGEST)
        largest = {number: _largest(self.meshes[number], most) for number in set(self.mesh[chosen].tolist())}
        index, corners = _joined([largest[self.mesh[number]] for number in chosen])
        number = np.repeat(chosen, [len(largest[self.mesh[number]][0]) for number in chosen])
        matrix = self.matrices[number]
        corners = np.einsum("tkj,tij->tki", corners, matrix[:, :, :3]) + matrix[:, None, :, 3]
        triangles = PlacedTriangles(number, index, corners)
        triangles = triangles.take(np.isfinite(corners).all(axis=(1, 2)))
        return triangles, _Planes.of(triangles.corners)

    def _all_in_planes(self, triangles, planes, chosen):
        """All triangles of the instances of those `chosen` that are in planes with these."""
        heights = np.rint(planes.height / GAP / 8.0)
        _, index = np.unique(
            np.column_stack([planes.group, triangles.instance, heights])[chosen], axis=0, return_index=True
        )
        index = np.flatnonzero(chosen)[index]
        rest, faces = 32 * MOST_IN_PLANES, []
        for number in index:
            instance, corners = triangles.instance[number], triangles.corners[number]
            rest -= len(self.meshes[self.mesh[instance]].triangles)
            near = 4.0 * GAP * np.abs(corners).max()
            in_plane = self._in_plane(instance, corners[0], planes.normal[number], near) if rest > 0 else None
            faces.append(in_plane or (triangles.triangle[number, None], corners[None]))
        number, corners = _joined(faces)
        return PlacedTriangles(np.repeat(triangles.instance[index], [len(one) for one, _ in faces]), number, corners)

    def save(self, path: str | os.PathLike) -> None:
        """Write an .npz, all or nothing, which `load` reads back bit for bit."""
        images: dict[int, np.ndarray] = {}
        arrays = {name: getattr(self, name) for name in ("mesh", "matrices", "masks", "terminators")}
        about = []
        for number, mesh in enumerate(self.meshes):
            clear = mesh.transparency
            arrays |= {f"vertices{number}": mesh.vertices, f"triangles{number}": mesh.triangles}
            for name in ("normals", "thickness"):
                if getattr(mesh, name) is not None:
                    arrays[f"{name}{number}"] = getattr(mesh, name)
            if clear is None:
                about.append(None)
                continue
            record = {name: getattr(clear, name) for name in _OF_CLEAR}
            if clear.image is not None:
                images.setdefault(id(clear.image), clear.image)
                record["image"] = list(images).index(id(clear.image))
                arrays[f"uv{number}"] = clear.uv
            about.append(record)
        arrays |= {f"image{number}": image for number, image in enumerate(images.values())}
        head = {"meshes": about, **{name: getattr(self, name) for name in _SETTINGS}}
        arrays["about"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Occluders":
        """The occluders that `save` wrote. Raises OSError and ValueError."""
        with np.load(Path(path)) as data:
            arrays = {name: data[name] for name in data.files}
        if "about" not in arrays:
            raise ValueError(f"{path}: no occluders, 'about' is missing")
        head = json.loads(arrays["about"].tobytes())
        meshes = []
        for number, record in enumerate(head["meshes"]):
            clear = None
            if record is not None:
                image = record.pop("image", None)
                pixels = None if image is None else arrays[f"image{image}"]
                clear = Transparency(**record, image=pixels, uv=arrays.get(f"uv{number}"))
            shape = (arrays[f"{name}{number}"] for name in ("vertices", "triangles"))
            more = (arrays.get(f"{name}{number}") for name in ("normals", "thickness"))
            meshes.append(OccluderMesh(*shape, clear, *more))
        instances = {name: arrays[name] for name in ("mesh", "matrices", "masks", "terminators")}
        settings = {name: head[name] for name in _SETTINGS}
        return cls(tuple(meshes), **instances, **settings)


_OF_CLEAR = "share", "extension", "interpolation", "outside", "curve", "cosines"
_SETTINGS = "transparent_surfaces", "light_masks", "lone_choices", "surface_shift"


def overlaps_within(meshes: list[OccluderMesh]) -> tuple[float, float]:
    """The shares of the area of the triangles of an object that lie in others of the same plane, which face alike, and
    which face any way; at least so much if there are more than MOST_IN_PLANES."""
    corners = _joined([_largest(mesh, MOST_IN_PLANES) for mesh in meshes])[1]
    pairs = overlaps_in_planes(corners, np.zeros(len(corners), np.int64), np.arange(len(corners)))
    alike = pairs.take(pairs.faces_alike)
    points, alike_points = (np.unique(one.point, return_index=True)[1] for one in (pairs, alike))
    return float(alike.share[alike_points].sum()), float(pairs.share[points].sum())


def _crosses(corners):
    """The cross products (T, 3) of two sides of triangles (T, 3, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _largest(mesh, most):
    """The numbers (T,) of the `most` largest triangles of a mesh, and their corners (T, 3, 3), float64."""
    index = np.arange(len(mesh.triangles))
    if len(index) > most:
        areas = np.square(_crosses(mesh.vertices[mesh.triangles])).sum(axis=1)
        index = np.sort(np.argpartition(areas, -most)[-most:])
    return index, mesh.vertices[mesh.triangles[index]].astype(np.float64)


def _joined(triangles):
    """Many pairs of numbers (T,) and corners (T, 3, 3) as one."""
    empty = np.zeros(0, np.int64), np.zeros((0, 3, 3))
    return tuple(map(np.concatenate, zip(empty, *triangles, strict=True)))


@dataclass(frozen=True)
class PlacedTriangles:
    """Triangles in world space: their instances, their numbers in their meshes, and their corners in m."""

    instance: np.ndarray  # (T,)
    triangle: np.ndarray  # (T,)
    corners: np.ndarray  # (T, 3, 3)

    def take(self, index: np.ndarray) -> "PlacedTriangles":
        """The triangles at `index`: integers or a mask."""
        return PlacedTriangles(self.instance[index], self.triangle[index], self.corners[index])


@dataclass(frozen=True)
class _Planes:
    """The planes of T triangles: areas, unit normals, heights in units of the largest coordinate, whether the normals
    are those of the plane (1) or opposite (-1), and the number of the plane."""

    area: np.ndarray  # (T,)
    normal: np.ndarray  # (T, 3)
    height: np.ndarray  # (T,)
    facing: np.ndarray  # (T,)
    group: np.ndarray  # (T,)

    @classmethod
    def of(cls, corners: np.ndarray) -> "_Planes":
        """The planes of triangles (T, 3, 3)."""
        normal = _crosses(corners)
        length = np.linalg.norm(normal, axis=1)
        normal /= np.maximum(length, 1e-300)[:, None]
        facing = np.where(normal @ OBLIQUE < 0.0, -1.0, 1.0)
        height = (normal * corners[:, 0]).sum(axis=1) / np.abs(corners).max(initial=1e-300)
        # The offset keeps round numbers from where numbers round up or down.
        plane = np.rint(np.column_stack([normal, height]) * (facing * PLANE_STEPS)[:, None] + 0.123)
        group = np.unique(plane.astype(np.int64) @ PLANE_KEYS, return_inverse=True)[1]
        return cls(0.5 * length, normal, height, facing, group)

    def shared_by(self, numbers: np.ndarray) -> np.ndarray:
        """Mask of the planes whose triangles do not all have the same of the `numbers` (T,)."""
        some = np.zeros(self.group.max(initial=-1) + 1, np.int64)
        some[self.group] = numbers
        result = np.zeros(len(some), bool)
        result[self.group[numbers != some[self.group]]] = True
        return result

    def sheets(self, owners: np.ndarray) -> np.ndarray:
        """Mask of the `owners` (T,) whose triangles are in one plane; true for numbers that no triangle has."""
        some = np.zeros(owners.max(initial=-1) + 1, np.int64)
        some[owners] = self.group
        result = np.ones(len(some), bool)
        result[owners[self.group != some[owners]]] = False
        return result


@dataclass(frozen=True)
class PlanePairs:
    """S pairs of a point of a triangle and another triangle in the same plane that holds it."""

    point: np.ndarray  # (S,) its number
    triangle: np.ndarray  # (S,) of the point
    other: np.ndarray  # (S,)
    faces_alike: np.ndarray  # (S,) bool, False where both face opposite ways
    share: np.ndarray  # (S,) of the area of the owner of the triangle for which the point stands

    def take(self, index: np.ndarray) -> "PlanePairs":
        """The pairs at `index`: integers or a mask."""
        return PlanePairs(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def overlaps_in_planes(corners: np.ndarray, owners: np.ndarray, numbers: np.ndarray | None = None) -> PlanePairs:
    """Where triangles `corners` (T, 3, 3) of `owners` (T,) lie in triangles of other `numbers` (T,), by default of
    other owners."""
    numbers, planes = owners if numbers is None else numbers, _Planes.of(corners)
    group, sides = planes.group, corners[:, 1:] - corners[:, :1]
    areas = np.bincount(owners, planes.area).clip(min=1e-300)
    weight = np.cumsum(planes.area * planes.shared_by(numbers)[group] / areas[owners])
    if not weight[-1:].sum() > 0.0:
        empty = np.zeros(0, np.int64)
        return PlanePairs(empty, empty, empty, empty == 0, np.zeros(0))
    number = np.arange(PLANE_POINTS) + 0.5
    own = np.searchsorted(weight, number * (weight[-1] / PLANE_POINTS)).clip(max=len(group) - 1)
    # A sequence of Roberts 2018 ("The Unreasonable Effectiveness of Quasirandom Sequences"), folded into triangles.
    weights = np.outer(number, (0.7548776662466927, 0.5698402909980532)) % 1.0
    weights = np.where(weights.sum(axis=1, keepdims=True) > 1.0, 1.0 - weights, weights)
    points = corners[own, 0] + (weights[:, :, None] * sides[own]).sum(axis=1)
    near = 4.0 * GAP * np.abs(corners[own]).max(axis=(1, 2))
    plane, order = group[own], np.argsort(group, kind="stable")
    members, tried = np.bincount(group), np.bincount(plane, minlength=group.max() + 1)
    step = -(-tried * members // MOST_TESTS)
    rank = np.empty(len(own), np.int64)
    rank[np.argsort(plane, kind="stable")] = np.arange(len(own)) - np.repeat(np.cumsum(tried) - tried, tried)
    chosen = np.flatnonzero(rank % step[plane] == 0)
    stands_for = weight[-1] / PLANE_POINTS * (tried / np.bincount(plane[chosen], minlength=len(tried)).clip(min=1))
    # Rows of (3, 4, T) that give the barycentric coordinates of a point (x, y, z, 1) in a triangle, and its height.
    one, other = np.moveaxis(sides, 1, 0)
    rows = np.stack([np.cross(other, planes.normal), np.cross(planes.normal, one)])
    rows = np.append(rows / (2.0 * planes.area).clip(min=1e-300)[:, None], planes.normal[None], axis=0)
    rows = np.append(rows, -(rows * corners[:, 0]).sum(axis=2, keepdims=True), axis=2).transpose(0, 2, 1).copy()
    columns = np.append(points, np.ones((len(points), 1)), axis=1).T.copy()

    def values(row: int, point: np.ndarray, member: np.ndarray) -> np.ndarray:
        return sum(rows[row, k][member] * columns[k][point] for k in range(4))

    first, pairs = np.cumsum(members) - members, np.cumsum(members[plane[chosen]])
    result = []
    for block in np.split(chosen, np.flatnonzero(np.diff(pairs // MOST_TESTS)) + 1):
        count = members[plane[block]]
        point, number = np.repeat(block, count), np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        member = order[first[plane[point]] + number]
        u = values(0, point, member)
        is_in = (u > 1e-6) & (u < 1.0 - 1e-6) & (numbers[member] != numbers[own[point]])
        point, member, u = point[is_in], member[is_in], u[is_in]
        v = values(1, point, member)
        is_in = (v > 1e-6) & (u + v < 1.0 - 1e-6) & (np.abs(values(2, point, member)) <= near[point])
        point, member = point[is_in], member[is_in]
        alike = planes.facing[member] == planes.facing[own[point]]
        result.append((point, own[point], member, alike, stands_for[plane[point]]))
    return PlanePairs(*map(np.concatenate, zip(*result, strict=True)))


@dataclass(frozen=True)
class Hits:
    """What H of R rays meet: the number of the `ray`, the distance, the instance, its triangle, and the place on it."""

    ray: np.ndarray  # (H,)
    distance: np.ndarray  # (H,) m
    instance: np.ndarray  # (H,)
    triangle: np.ndarray  # (H,)
    u: np.ndarray  # (H,) weight of the second corner
    v: np.ndarray  # (H,) weight of the third corner
