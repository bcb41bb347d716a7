"""What stands in the way of light: triangle meshes, instances of them, and how much light they let through."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..cycles.images import EXTENSIONS, INTERPOLATIONS, interpolated, within
from ..files import replacing

# Bits of a mask: all kinds of rays.
ALL_RAYS = 0xFFFFFFFF
# Cycles' default of `Object.cycles.shadow_terminator_geometry_offset`.
TERMINATOR_OFFSET = 0.1
# Cycles' default of transparent bounces: further transparent surfaces block.
TRANSPARENT_SURFACES = 8
# A ray goes on from a transparent surface by so much of its distance.
STEP = np.float32(1.0 + 2.0**-21)


@dataclass(frozen=True)
class Transparency:
    """Share of light that a surface lets through: `share`, where there is an image times what it has at `uv`.

    Colors count by their mean. The image (H, W) holds shares, row 0 below; `uv` (T, 3, 2) has the corners of the
    triangles on it.
    """

    share: float = 1.0
    image: np.ndarray | None = None
    uv: np.ndarray | None = None
    extension: str = "REPEAT"  # one of EXTENSIONS
    interpolation: str = "Linear"  # one of INTERPOLATIONS
    outside: float = 1.0  # what stands for the image beside it, where `extension` is CLIP

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

    def shares(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Shares (Q,) at the points (1 - u - v) a + u b + v c of the triangles (Q,)."""
        if self.image is None:
            return np.full(len(triangle), self.share, np.float32)
        a, b, c = np.moveaxis(self.uv[triangle], 1, 0)
        u, v = u[:, None], v[:, None]
        found = np.clip(self._image_at((1.0 - u - v) * a + u * b + v * c), 0.0, 1.0)
        return (self.share * found).astype(np.float32)

    def _image_at(self, uv):
        height, width = self.image.shape
        return interpolated(uv, (width, height), self.interpolation, self._pixel)

    def _pixel(self, x, y):
        """Shares of pixels anywhere in the plane; all light passes where there is no image."""
        height, width = self.image.shape
        columns, rows = within(x, width, self.extension), within(y, height, self.extension)
        found = self.image[rows, columns]
        if self.extension == "CLIP":
            found = np.where((x == columns) & (y == rows), found, self.outside)
        return found


@dataclass(frozen=True)
class OccluderMesh:
    """Triangles in the space of an object.

    `normals` are those of smooth shading, at vertices (V, 3) or at corners (T, 3, 3); left out: it is flat. Triangles
    that stand for a hair or a point have a `thickness` (T,): what is shaded is no farther from them.
    """

    vertices: np.ndarray  # (V, 3) float32
    triangles: np.ndarray  # (T, 3) uint32
    transparency: Transparency | None = None  # None: it blocks
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
        if self.normals is not None:
            normals = np.ascontiguousarray(self.normals, np.float32)
            if normals.shape not in (vertices.shape, (len(triangles), 3, 3)):
                raise ValueError(f"mesh: normals {normals.shape}, expected {vertices.shape} or {len(triangles), 3, 3}")
            object.__setattr__(self, "normals", normals)
        if self.thickness is not None:
            thickness = np.ascontiguousarray(self.thickness, np.float32)
            if thickness.shape != (len(triangles),):
                raise ValueError(f"mesh: thickness {thickness.shape}, expected {(len(triangles),)}")
            object.__setattr__(self, "thickness", thickness)
        uv = None if self.transparency is None else self.transparency.uv
        if uv is not None and uv.shape != (len(triangles), 3, 2):
            raise ValueError(f"mesh: uv {uv.shape}, expected {len(triangles), 3, 2}")


@dataclass(frozen=True)
class ChosenBy:
    """Which shadow rays Cycles sends to a light: those that the light chooses, without Cast Shadow none, and those that
    the surface chooses, without multiple importance sampling none."""

    light: bool = True
    surface: bool = True


@dataclass(frozen=True)
class Occluders:
    """`meshes` and I instances: `mesh` (I,) is the number of each one's mesh, `matrices` (I, 3, 4) take it to world
    space. An instance blocks rays that have a bit of its `masks` (I,) uint32; left out: all.

    `terminators` (I,) are as `shadow_terminator_geometry_offset` of Cycles; left out: its default.
    A ray through more than `transparent_surfaces` ends. `light_masks` are the masks of rays to lights, by their names,
    and `lone_choices` says which lights are met by rays that the "light" or the "surface" chooses alone.
    """

    meshes: tuple[OccluderMesh, ...]
    mesh: np.ndarray
    matrices: np.ndarray
    masks: np.ndarray | None = None
    terminators: np.ndarray | None = None
    transparent_surfaces: int = TRANSPARENT_SURFACES
    light_masks: dict[str, int] = field(default_factory=dict)
    lone_choices: dict[str, str] = field(default_factory=dict)

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
        """Numbers of the instances that block, and of those that let light through; without triangles: neither."""
        is_clear = np.array([mesh.transparency is not None for mesh in self.meshes], bool)[self.mesh]
        is_there = np.array([len(mesh.triangles) > 0 for mesh in self.meshes], bool)[self.mesh]
        return np.flatnonzero(is_there & ~is_clear), np.flatnonzero(is_there & is_clear)

    def mask_of(self, light: str) -> int:
        """Mask of the rays to the light of that name; 0: nothing is in its way."""
        return self.light_masks.get(light, 1)

    def chosen_by(self, light: str) -> ChosenBy:
        """Which rays to the light of that name there are."""
        alone = self.lone_choices.get(light)
        return ChosenBy(light=alone != "surface", surface=alone != "light")

    @property
    def triangle_count(self) -> int:
        """Number of triangles, those of each instance counted."""
        sizes = np.array([len(mesh.triangles) for mesh in self.meshes], np.int64)
        return int(sizes[self.mesh].sum()) if len(self.mesh) else 0

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
            record = {name: getattr(clear, name) for name in ("share", "extension", "interpolation", "outside")}
            if clear.image is not None:
                images.setdefault(id(clear.image), clear.image)
                record["image"] = list(images).index(id(clear.image))
                arrays[f"uv{number}"] = clear.uv
            about.append(record)
        arrays |= {f"image{number}": image for number, image in enumerate(images.values())}
        head = {
            "meshes": about,
            **{name: getattr(self, name) for name in ("transparent_surfaces", "light_masks", "lone_choices")},
        }
        arrays["about"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Occluders:
        """What `save` wrote. Raises OSError, ValueError."""
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
        own = {name: head[name] for name in ("transparent_surfaces", "light_masks", "lone_choices")}
        return cls(tuple(meshes), **instances, **own)


@dataclass(frozen=True)
class Hits:
    """What H of R rays meet: the `ray`, how far away, which triangle of which instance, where on it."""

    ray: np.ndarray  # (H,)
    distance: np.ndarray  # (H,) m
    instance: np.ndarray  # (H,)
    triangle: np.ndarray  # (H,)
    u: np.ndarray  # (H,) share of the second corner
    v: np.ndarray  # (H,) share of the third
