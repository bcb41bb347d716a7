"""Surface samples at texels, from a mesh, its materials and covered texels; and images as Cycles samples them.

Needs no bpy. Measured with 4.5.15 and 5.2.3: 8-bit images in sRGB are decoded after interpolation; with CLIP, the image
is black outside and blends to black within half a pixel.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ..scene import Light, SurfaceSamples
from .gbuffer import HITS_PER_BLOCK
from .horizons import end_at_horizons_of_cycles, unit
from .lobes import LOBE_AOVS, SurfaceHits, samples_of_lobes
from .uv import Texels

# Weights of Cycles' gray of a color: Rec.709 luminance.
GRAY = np.array([0.2126729, 0.7151522, 0.0721750])
EXTENSIONS = ("REPEAT", "EXTEND", "CLIP", "MIRROR")
INTERPOLATIONS = ("Linear", "Closest")


@dataclass(frozen=True)
class ImageTexture:
    """Pixels (H, W, 3), uint8 or float32, row 0 at the bottom, and how they are read."""

    pixels: np.ndarray
    extension: str  # one of EXTENSIONS
    interpolation: str  # one of INTERPOLATIONS
    srgb: bool

    def colors(self, uv: np.ndarray) -> np.ndarray:
        """Linear colors (Q, 3) at uv (Q, 2)."""
        height, width = self.pixels.shape[:2]
        values = interpolated(np.asarray(uv, dtype=np.float64), (width, height), self.interpolation, self._at)
        return srgb_decode(values) if self.srgb else values

    def _at(self, x, y):
        """Values (Q, 3) of pixels at integers x, y (Q,), which may lie outside the image."""
        height, width = self.pixels.shape[:2]
        columns, rows = (within(index, size, self.extension) for index, size in ((x, width), (y, height)))
        values = self.pixels[rows, columns].astype(np.float64)
        if self.pixels.dtype == np.uint8:
            values /= 255.0
        if self.extension == "CLIP":
            values[(x != columns) | (y != rows)] = 0.0
        return values


def srgb_decode(values: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


def interpolated(uv: np.ndarray, size: tuple[int, int], interpolation: str, pixel: Callable) -> np.ndarray:
    """Values at uv (Q, 2) of an image of `size` (width, height). `pixel(x, y)` returns the values of pixels, which may
    lie outside the image."""
    position = uv * np.array(size, uv.dtype)
    if interpolation == "Closest":
        return pixel(*np.floor(position).astype(np.int64).T)
    corner = np.floor(position - 0.5)
    x, y = corner.astype(np.int64).T
    corners = [pixel(x, y), pixel(x + 1, y), pixel(x, y + 1), pixel(x + 1, y + 1)]
    tx, ty = ((position - 0.5 - corner)[:, axis].reshape(-1, *[1] * (corners[0].ndim - 1)) for axis in (0, 1))
    below, above = ((1.0 - tx) * low + tx * high for low, high in (corners[:2], corners[2:]))
    return (1.0 - ty) * below + ty * above


def within(index: np.ndarray, size: int, extension: str) -> np.ndarray:
    """The columns or rows (Q,) of an image that extend it to `index` (Q,), which may lie outside."""
    if extension == "REPEAT":
        return index % size
    if extension == "MIRROR":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return np.clip(index, 0, size - 1)


# Value of texels that Cycles' bake left out, in its maps and its radiance.
NOT_BAKED = -1e9
# When Cycles bakes from the camera, it bends the view to at least this cosine from the normal.
SMALLEST_BAKED_COSINE = 0.2
# Then it bends the view to at least this cosine from the normal of the face.
SMALLEST_FACE_COSINE = 1e-5


@dataclass(frozen=True)
class TexelMesh:
    """Triangles of one evaluated object in world space."""

    corners: np.ndarray  # (T, 3, 3) m
    normals: np.ndarray  # (T, 3, 3) unit shading normals, custom normals included
    uv: np.ndarray  # (T, 3, 2)
    material: np.ndarray  # (T,) number of the material
    mirrored: bool | np.ndarray = False  # True: the transform turns right hands into left ones
    receiver: int | np.ndarray = 0  # as in `SurfaceSamples`
    object: int | np.ndarray = 0  # number of the object of the atlas

    @classmethod
    def joined(cls, meshes: "Sequence[TexelMesh]") -> "TexelMesh":
        """All `meshes` as one; what may hold for a whole mesh must be arrays (T,)."""
        return cls(**{item.name: np.concatenate([getattr(mesh, item.name) for mesh in meshes]) for item in fields(cls)})

    def true_normals(self) -> np.ndarray:
        """Unit normals (T, 3) of the faces. A smooth normal may point to the other side, for example on a bent quad."""
        sides = self.corners[:, 1:] - self.corners[:, :1]
        return unit(np.cross(sides[:, 0], sides[:, 1])) * np.where(self.mirrored, -1.0, 1.0).reshape(-1, 1)

    def save(self, path) -> None:
        """Write an .npz."""
        np.savez(path, **{item.name: getattr(self, item.name) for item in fields(self)})

    @classmethod
    def load(cls, path) -> "TexelMesh":
        """Read what `save` wrote."""
        with np.load(Path(path)) as data:
            return cls(**{item.name: data[item.name] for item in fields(cls)})


@dataclass(frozen=True)
class BakeView:
    """From where a surface is seen. `kind` is "above" (along its normal), "point" (from a position) or "direction"
    (from afar; a unit vector towards the viewer). `bent` views are bent as in Cycles' bake, see
    SMALLEST_BAKED_COSINE."""

    kind: str
    vector: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bent: bool = False

    def towards(self, position: np.ndarray, normal: np.ndarray, true_normal: np.ndarray) -> np.ndarray:
        """Unit vectors (P, 3) to the viewer from positions (P, 3) with shading normals and face normals (P, 3)."""
        if self.kind == "above":
            return normal
        vector = np.array(self.vector, dtype=np.float64)
        view = unit(vector - position) if self.kind == "point" else np.broadcast_to(vector, position.shape)
        if not self.bent:
            return view
        cosine = np.sum(view * normal, axis=-1, keepdims=True)
        bent = unit(view - normal * (cosine - SMALLEST_BAKED_COSINE))
        # The more a surface faces away, the closer to its normal it is seen from.
        behind = np.clip(-cosine, 0.0, 1.0)
        view = np.where(cosine > SMALLEST_BAKED_COSINE, view, unit(bent * (1.0 - behind) + normal * behind))
        cosine = np.sum(view * true_normal, axis=-1, keepdims=True)
        above = view - true_normal * (cosine - SMALLEST_FACE_COSINE)
        return np.where(cosine > SMALLEST_FACE_COSINE, view, unit(above))


@dataclass(frozen=True)
class MapValue:
    """A quantity that varies over the surface, in a baked map."""

    map: int  # number of the map
    channel: int = 0  # of a quantity that is no color


@dataclass(frozen=True)
class TextureValue:
    """A quantity that varies over the surface, in an image."""

    texture: int  # number in `BakeMaterial.textures`
    component: str  # "color", "gray", or the number of a channel


def _value_of(record):
    """The value of a JSON record: a MapValue, a TextureValue, a number or a color."""
    if not isinstance(record, dict):
        return record
    return MapValue(**record) if "map" in record else TextureValue(**record)


@dataclass(frozen=True)
class TextureFile:
    """An image that a material shows unchanged, and how it is read; see `ImageTexture`."""

    uv: str  # the UV map, "" for the one that renders
    extension: str
    interpolation: str
    srgb: bool
    file: str = ""  # name of the .npy with its pixels


@dataclass(frozen=True)
class BakeMaterial:
    """The lobes of one material, each with values for `lobes.LOBE_AOVS`."""

    corrected: bool
    lobes: tuple[dict[str, MapValue | TextureValue | float | list], ...]
    textures: tuple[tuple[ImageTexture, np.ndarray], ...] = ()  # each with its UV map (T, 3, 2)
    moved: tuple[int, ...] = ()  # displaced: the maps of `maps.SURFACE`

    @classmethod
    def of(cls, record: dict, images: Path, uv_maps: dict[str, Path]) -> "BakeMaterial":
        """From a JSON record, the folder of `images`, and the files of UV maps by name."""
        textures = []
        for entry in record["textures"]:
            texture = TextureFile(**entry)
            pixels = np.load(images / texture.file, mmap_mode="r")
            image = ImageTexture(pixels, texture.extension, texture.interpolation, texture.srgb)
            textures.append((image, np.load(uv_maps[texture.uv])))
        lobes = tuple({name: _value_of(value) for name, value in lobe.items()} for lobe in record["lobes"])
        return cls(record["corrected"], lobes, tuple(textures), tuple(record["moved"]))

    def colors(self, number: int, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colors (Q, 3) of texture `number` at points of triangles (Q,), given by barycentric weights (Q, 3)."""
        texture, uv = self.textures[number]
        return texture.colors(_interpolated(uv, triangle, weights))


def texel_samples(
    mesh: TexelMesh, materials: list[BakeMaterial], texels: Texels, read_map, view: BakeView, lights: tuple[Light, ...]
) -> tuple[SurfaceSamples, np.ndarray]:
    """Samples (S) of texels (Q), and the texel (S,) of each, 0 to Q - 1. The samples of a texel are consecutive.

    read_map(number) returns a baked map at the texels, (Q, 3).
    """
    pieces, index = [], []
    for start, samples, texel in _lobes_of_texels(mesh, materials, texels, read_map, view):
        samples, of_sample = end_at_horizons_of_cycles(samples, lights, texel, is_baked=True)
        pieces.append(samples)
        index.append(texel[of_sample] + start)
    return SurfaceSamples.joined(pieces), np.concatenate(index)


def texel_guides(mesh: TexelMesh, materials: list[BakeMaterial], texels: Texels, read_map) -> np.ndarray:
    """The diffuse color and the normal, (Q, 6), of texels (Q); for `read_map` see `texel_samples`."""
    guides = np.zeros((len(texels.index), 6), np.float32)
    for start, samples, texel in _lobes_of_texels(mesh, materials, texels, read_map, BakeView("above")):
        np.add.at(guides[start:, :3], texel, samples.diffuse_albedo)
        # The normals of lobes count by their color.
        weight = samples.diffuse_albedo.mean(axis=1) + 1e-3
        np.add.at(guides[start:, 3:], texel, weight[:, None] * samples.diffuse_normal)
    guides[:, 3:] = unit(guides[:, 3:])
    return guides


def _lobes_of_texels(mesh, materials, texels, read_map, view):
    """Blocks of texels: the first texel, the samples (S) of the block, and the texel (S,) of each, counted from it."""
    true_normals = mesh.true_normals()
    corrected = np.array([material.corrected for material in materials], dtype=bool)
    values = (value for material in materials for lobe in material.lobes for value in lobe.values())
    numbers = {value.map for value in values if isinstance(value, MapValue)}
    maps = {number: read_map(number) for number in numbers.union(*(material.moved for material in materials))}
    for start in range(0, max(len(texels.index), 1), HITS_PER_BLOCK):
        block = slice(start, start + HITS_PER_BLOCK)
        triangle, weights = texels.triangle[block], texels.barycentric[block]
        position = _interpolated(mesh.corners, triangle, weights)
        smooth_normal = unit(_interpolated(mesh.normals, triangle, weights))
        true_normal, unbumped = true_normals[triangle], smooth_normal.copy()
        number = mesh.material[triangle]
        for which, material in enumerate(materials):
            if material.moved:
                at = np.flatnonzero(number == which)
                surface = position, smooth_normal, true_normal, unbumped
                for quantity, of_map in zip(surface, material.moved, strict=False):
                    quantity[at] = maps[of_map][block][at]
        hits = SurfaceHits(
            position=position,
            view=view.towards(position, unbumped, true_normal),
            smooth_normal=smooth_normal,
            true_normal=true_normal,
            corrected=corrected[number],
            receiver=np.broadcast_to(mesh.receiver, (len(mesh.corners),))[triangle],
            diffuse_albedo=None,
        )
        of_block = {name: values[block] for name, values in maps.items()}
        yield start, *samples_of_lobes(hits, _lobes(materials, number, of_block, triangle, weights))


def _interpolated(values, triangle, weights):
    """Values (Q, C) at points of triangles (Q,), from `values` (T, 3, C) and barycentric weights (Q, 3)."""
    return sum(values[triangle, corner] * weights[:, corner, None] for corner in range(3))


def _lobes(materials, number, maps, triangle, weights) -> list[dict[str, np.ndarray]]:
    """The quantities of each slot at texels of the materials `number` (Q,). `maps` has the baked maps (Q, 3)."""
    texels = [np.flatnonzero(number == which) for which in range(len(materials))]
    colors = {}

    def varying(which, value, kind):
        at = texels[which]
        if isinstance(value, MapValue):
            baked = maps[value.map][at]
            return baked if kind == "COLOR" else baked[:, value.channel]
        key = which, value.texture
        if key not in colors:
            colors[key] = materials[which].colors(value.texture, triangle[at], weights[at])
        if value.component == "gray":
            return colors[key] @ GRAY
        return colors[key] if value.component == "color" else colors[key][:, int(value.component)]

    slots = []
    for slot in range(max((len(material.lobes) for material in materials), default=0)):
        names = {name for material in materials if len(material.lobes) > slot for name in material.lobes[slot]}
        values = {}
        for name in names | {"kind"}:
            kind, neutral = LOBE_AOVS[name]
            shape = (len(number), 3) if kind == "COLOR" else (len(number),)
            values[name] = np.zeros(shape) + (0.0 if neutral is None else neutral)
            for which, material in enumerate(materials):
                if len(material.lobes) <= slot or name not in material.lobes[slot]:
                    continue
                value = material.lobes[slot][name]
                if isinstance(value, MapValue | TextureValue):
                    value = varying(which, value, kind)
                elif kind == "COLOR":
                    value = np.asarray(value)[:3]
                values[name][texels[which]] = value
        slots.append(values)
    return slots


def light_bend(light: np.ndarray, index: np.ndarray, width: int) -> np.ndarray:
    """How much the light (Q, 3) of the texels `index` of a block bends at each (Q,), relative to its root mean square:
    at borders by the neighbor that there is, infinitely across strips of one texel."""
    picture = np.full((index[-1] // width + 3, width + 2, 3), np.nan, np.float32)
    row, column = index // width + 1, index % width + 1
    picture[row, column] = light
    bends = []
    for y, x in ((0, 1), (1, 0)):
        away = np.stack([picture[row + y, column + x], picture[row - y, column - x]]) - light
        bends.append(np.where(np.isnan(away).all(axis=0), np.inf, np.abs(np.nansum(away, axis=0))))
    return np.max(bends, axis=(0, 2)) / max(float(np.sqrt(np.square(light).mean())), 1e-30)
