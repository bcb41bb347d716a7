"""The bench: a page that shades a small scene with every technique, for `python -m tables page`.

The page is one file, index.html. Its sources are in `page/`. This module puts into them the exported headers, their
tables with two Fresnel curves in half floats, and ten frozen scenes with pictures by `shading.reference`.

The scene is a floor with a sphere, a cylinder and a box under one rectangular light, without shadows. `surfaces` knows
it in numpy, page/surface.glsl as a shader; both take their numbers from here.
"""

import base64
import json
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ltsh_addon.files import write_bytes
from ltsh_addon.imaging import color
from ltsh_addon.lobes.lookup_table import LookupTable
from ltsh_addon.scene import REFERENCE, SHIPPED_TABLES, QuadLight, SurfaceSamples
from ltsh_addon.shading import load_table, shade
from ltsh_addon.shading.header import filled, float_literal

from . import header
from .pack import with_two_curves

SOURCES = Path(__file__).with_name("page")
WIDTH = 240  # of pictures, in pixels; they are 16 : 9
RADIANCE = 10.0  # of the light, W m^-2 sr^-1
TAN_HALF_WIDTH = 0.46  # of the camera
TARGET, DISTANCE = np.array([0.0, 0.0, 0.42]), 4.6  # m; the camera looks from that distance at this point
TEXTURE_WIDTH = 1024

FLOOR_RADIUS = 9.0
SPHERE_CENTER, SPHERE_RADIUS = np.array([-1.15, 0.05, 0.5]), 0.5
CYLINDER_CENTER, CYLINDER_RADIUS, CYLINDER_HEIGHT = np.array([0.0, 0.45]), 0.4, 1.05
BOX_CENTER, BOX_HALVES, BOX_ANGLE = np.array([1.12, -0.02, 0.36]), np.array([0.42, 0.3, 0.36]), np.radians(34.0)
COLORS = {
    "FLOOR": (0.42, 0.42, 0.44),
    "SPHERE": (1.0, 0.77, 0.34),
    "CYLINDER": (0.95, 0.64, 0.54),
    "BOX": (0.5, 0.64, 0.86),
}
DIELECTRIC_F0 = 0.04
# Errors from -1 to 1, (7, 4): the error and its color; linear in between.
_STOPS = np.array([-1.0, -0.6, -0.25, 0.0, 0.25, 0.6, 1.0])
ERROR_COLORS = np.column_stack([_STOPS, color.signed_error_colors(_STOPS[None], 1.0)[0]])


@dataclass(frozen=True)
class BenchScene:
    """What the page can change. Angles are in degrees, lengths in m."""

    name: str
    x: float = 0.0  # center of the light
    y: float = 1.5
    z: float = 1.0
    width: float = 1.6
    height: float = 0.9
    turn: float = 0.0  # of the light around z; 0: it shines toward -y
    tilt: float = 20.0  # of the light, downward
    roughness: float = 0.25  # of the objects
    metal: float = 0.9
    anisotropy: float = 0.0
    floor: float = 0.3  # roughness of the floor
    orbit: float = 0.0  # of the camera around z
    rise: float = 16.0  # of the camera over the horizon
    exposure: float = 0.0  # in stops

    @property
    def light(self) -> QuadLight:
        turn, tilt = np.radians([self.turn, self.tilt])
        direction = np.array([np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt), -np.sin(tilt)])
        along = np.array([np.cos(turn), np.sin(turn), 0.0])
        halves = 0.5 * self.width * along, 0.5 * self.height * np.cross(direction, along)
        return QuadLight("light", np.array([self.x, self.y, self.z]), *halves, direction, np.full(3, RADIANCE))


SCENES = (
    BenchScene("Window", x=-1.9, y=0.9, z=1.15, width=1.9, height=1.3, turn=38.0, tilt=18.0, metal=0.8, exposure=-0.3),
    BenchScene("Sharp", x=0.3, y=1.7, z=1.25, roughness=0.12, floor=0.12, tilt=25.0, metal=0.7, exposure=-0.3),
    BenchScene("Rough", x=0.6, y=-1.0, z=1.9, turn=180.0, tilt=50.0, roughness=0.6, floor=0.7, exposure=0.5),
    BenchScene("Grazing", x=0.0, y=2.6, z=0.5, width=3.0, height=0.5, tilt=2.0, floor=0.4, rise=7.0, metal=0.5),
    BenchScene("Plastic", x=-1.2, y=-0.6, z=1.7, width=1.0, turn=150.0, tilt=50.0, metal=0.0, floor=0.5),
    BenchScene("Tube", y=-0.4, z=1.6, width=3.2, height=0.08, tilt=85.0, roughness=0.3, exposure=1.8),
    BenchScene("Standing", x=-2.0, y=0.6, z=0.95, width=0.35, height=1.8, turn=62.0, tilt=0.0, roughness=0.2),
    BenchScene("Near", x=0.1, y=0.1, z=1.45, height=1.5, tilt=88.0, roughness=0.4, floor=0.45, exposure=-1.0),
    BenchScene("Below", x=1.9, y=0.9, z=0.35, width=1.2, height=1.4, turn=-48.0, tilt=-4.0, floor=0.2, metal=0.6),
    BenchScene("Brushed", x=-0.4, y=-0.6, z=1.9, width=1.6, height=0.5, tilt=78.0, anisotropy=0.6, roughness=0.35),
)  # fmt: skip


def camera_of(scene: BenchScene) -> tuple[np.ndarray, np.ndarray]:
    """The eye (3,) and the matrix (3, 3) that takes (x, y, 1), x and y from -1 to 1 over the picture, to a ray."""
    orbit, rise = np.radians([scene.orbit, scene.rise])
    forward = np.array([np.sin(orbit) * np.cos(rise), np.cos(orbit) * np.cos(rise), -np.sin(rise)])
    right = np.array([np.cos(orbit), -np.sin(orbit), 0.0])
    up = np.cross(right, forward)
    return TARGET - DISTANCE * forward, np.stack(
        [TAN_HALF_WIDTH * right, 9.0 / 16.0 * TAN_HALF_WIDTH * up, forward], axis=1
    )


def rays_of(scene: BenchScene, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The eye (3,) and the unit rays (P, 3) of the pixels of a picture, rows from below."""
    eye, matrix = camera_of(scene)
    height = width * 9 // 16
    x, y = (2.0 * (np.arange(count) + 0.5) / count - 1.0 for count in (width, height))
    places = np.stack([*(grid.ravel() for grid in np.meshgrid(x, y)), np.ones(width * height)], axis=1)
    rays = places @ matrix.T
    return eye, rays / np.linalg.norm(rays, axis=1)[:, None]


def surfaces(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What rays (P, 3) meet first: object (P,), -1 for none, 0 floor, 1 sphere, 2 cylinder, 3 box; position, normal and
    tangent (P, 3)."""
    count = len(rays)
    nearest, objects = np.full(count, np.inf), np.full(count, -1)
    normals, tangents = np.tile([0.0, 0.0, 1.0], (count, 1)), np.tile([1.0, 0.0, 0.0], (count, 1))

    def meet(number, distance, hit, normal, tangent):
        hit = hit & (distance > 0.0) & (distance < nearest)
        nearest[hit], objects[hit] = distance[hit], number
        normals[hit], tangents[hit] = normal[hit], tangent[hit]

    def around(vectors):
        return np.stack([-vectors[:, 1], vectors[:, 0], np.zeros(count)], axis=1)

    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -eye[2] / rays[:, 2]
        at = eye + distance[:, None] * rays
        meet(0, distance, (at[:, :2] ** 2).sum(axis=1) < FLOOR_RADIUS**2, normals.copy(), tangents.copy())

        offset = eye - SPHERE_CENTER
        along = -rays @ offset
        square = SPHERE_RADIUS**2 - ((offset + along[:, None] * rays) ** 2).sum(axis=1)
        distance = along - np.sqrt(np.maximum(square, 0.0))
        normal = (offset + distance[:, None] * rays) / SPHERE_RADIUS
        meet(1, distance, square > 0.0, normal, around(normal))

        offset = eye - [*CYLINDER_CENTER, 0.0]
        length = (rays[:, :2] ** 2).sum(axis=1)
        along = -rays[:, :2] @ offset[:2] / length
        square = (CYLINDER_RADIUS**2 - ((offset[:2] + along[:, None] * rays[:, :2]) ** 2).sum(axis=1)) / length
        distance = along - np.sqrt(np.maximum(square, 0.0))
        at = offset + distance[:, None] * rays
        normal = at * [1.0, 1.0, 0.0] / CYLINDER_RADIUS
        meet(2, distance, (square > 0.0) & (at[:, 2] > 0.0) & (at[:, 2] < CYLINDER_HEIGHT), normal, around(normal))
        distance = (CYLINDER_HEIGHT - offset[2]) / rays[:, 2]
        at = offset + distance[:, None] * rays
        on_top = (rays[:, 2] < 0.0) & ((at[:, :2] ** 2).sum(axis=1) < CYLINDER_RADIUS**2)
        meet(2, distance, on_top, np.tile([0.0, 0.0, 1.0], (count, 1)), around(at))

        cosine, sine = np.cos(BOX_ANGLE), np.sin(BOX_ANGLE)
        to_world = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        offset, turned = (eye - BOX_CENTER) @ to_world, rays @ to_world
        enter, leave = ((sign * np.sign(turned) * BOX_HALVES - offset) / turned for sign in (-1.0, 1.0))
        distance = enter.max(axis=1)
        side = -np.sign(turned) * (enter == distance[:, None])
        level = np.where(side[:, 2:] != 0.0, [1.0, 0.0, 0.0], around(side))
        meet(3, distance, distance < leave.min(axis=1), side @ to_world.T, level @ to_world.T)
    tangents /= np.linalg.norm(tangents + [1e-12, 0.0, 0.0], axis=1)[:, None]
    return objects, eye + np.where(objects < 0, 0.0, nearest)[:, None] * rays, normals, tangents


def samples_of(scene: BenchScene, width: int) -> tuple[np.ndarray, SurfaceSamples]:
    """The mask (P,) of the pixels that show a surface, rows from below, and the samples of these."""
    eye, rays = rays_of(scene, width)
    objects, position, normal, tangent = surfaces(eye, rays)
    shown = objects >= 0
    objects, position, normal, tangent = (values[shown] for values in (objects, position, normal, tangent))
    is_floor = objects == 0
    metal = np.where(is_floor, 0.0, scene.metal)[:, None]
    colors = np.array(list(COLORS.values()))[objects]
    return shown, SurfaceSamples(
        position=position,
        view=-rays[shown],
        normal=normal,
        diffuse_normal=normal,
        roughness=np.where(is_floor, scene.floor, scene.roughness),
        specular_f0=DIELECTRIC_F0 + metal * (colors - DIELECTRIC_F0),
        specular_f90=np.ones_like(colors),
        dielectric=np.zeros(len(objects)),
        ior=np.full(len(objects), 1.5),
        diffuse_albedo=(1.0 - metal) * colors,
        anisotropy=np.where(is_floor, 0.0, scene.anisotropy),
        tangent=tangent,
    )


def picture(scene: BenchScene, width: int, technique: str | LookupTable = REFERENCE) -> np.ndarray:
    """The radiance (H, W, 3) of a scene by numpy, rows from below; NaN where there is no surface.

    No table has anisotropy: techniques with one take the roughness alone, as a plain engine does.
    """
    shown, samples = samples_of(scene, width)
    if technique != REFERENCE:
        samples = replace(samples, anisotropy=np.zeros(len(samples)))
    pixels = np.full((len(shown), 3), np.nan)
    pixels[shown] = shade(samples, [scene.light], technique).combined
    return pixels.reshape(width * 9 // 16, width, 3)


def shader_header(table: LookupTable) -> str:
    """What a shader needs of the exported header."""
    text = header.header_text(table, table.name, f"{table.name}: `python -m tables export` writes the whole file.")
    return text[: text.index("/* GLSL and HLSL may end here")] + "#endif\n"


def write_page(
    folder: str | os.PathLike, width: int = WIDTH, progress: Callable[[str], None] | None = None
) -> list[Path]:
    """Write the page, index.html, and the example for three.js into `folder`, created if needed; returns the files.

    Pictures of the frozen scenes are `width` pixels wide, a multiple of 16. Raises OSError.
    """
    folder = Path(folder)
    tables = {name: with_two_curves(load_table(name)) for name in SHIPPED_TABLES}
    pictures = []
    for number, scene in enumerate(SCENES, start=1):
        if progress is not None:
            progress(f"reference picture {number} of {len(SCENES)}")
        pictures.append(picture(scene, width))
    texts = {
        "index.html": page_text(tables, pictures),
        **{f"three/{name}": _source(f"three/{name}") for name in ("index.html", "ltsh.js")},
        "three/ltsh4.js": _module_text(tables["ltsh4"]),
    }
    try:
        (folder / "three").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"output folder {folder}: cannot be made ({error.strerror}); choose another folder") from error
    for name, text in texts.items():
        write_bytes(folder / name, text.encode())
    return [folder / name for name in texts]


def _texture_of(table: LookupTable) -> np.ndarray:
    """The data of a header as half floats, filled up to whole rows of TEXTURE_WIDTH."""
    data = np.concatenate(list(header.data_blocks(table).values())).astype("<f2")
    return np.pad(data, (0, -len(data) % TEXTURE_WIDTH))


def _module_text(table: LookupTable) -> str:
    """A module of JavaScript with the header and the data of a table."""
    data = base64.b64encode(_texture_of(table).tobytes()).decode()
    text = json.dumps(shader_header(table))
    return f'export const width = {TEXTURE_WIDTH};\nexport const header = {text};\nexport const data = "{data}";\n'


def page_text(tables: dict[str, LookupTable], pictures: list[np.ndarray]) -> str:
    """The page with `tables` by name and the `pictures` (H, W, 3) of SCENES."""
    blobs, described = [], {}
    for name, table in tables.items():
        data = _texture_of(table)
        described[name] = {"header": shader_header(table), "count": len(data)}
        blobs.append(data.view(np.uint16))
    height, width = pictures[0].shape[:2]
    for pixels in pictures:
        # Rows from above, a color after the other, as differences of the bits: these are small.
        bits = np.where(np.isfinite(pixels), pixels, 0.0)[::-1].transpose(2, 0, 1).astype(np.float16).view(np.uint16)
        blobs.append(np.diff(bits.ravel(), prepend=np.uint16(0)))
    content = {
        "tables": described,
        "scenes": [scene.__dict__ for scene in SCENES],
        "width": width,
        "height": height,
        "texture_width": TEXTURE_WIDTH,
        "camera": {"target": TARGET.tolist(), "distance": DISTANCE, "tangent": TAN_HALF_WIDTH},
        "radiance": RADIANCE,
        "error_colors": ERROR_COLORS.tolist(),
        "shaders": _shaders(tables),
    }
    text = json.dumps(content).encode()
    payload = len(text).to_bytes(4, "little") + text + b"\0" * (len(text) % 2)
    payload += b"".join(_high_and_low(blob) for blob in blobs)
    values = {
        "STYLE": _source("bench.css"),
        "SCRIPT": "\n".join(_source(name) for name in ("renderer.js", "webgpu.js", "bench.js")),
        "PAYLOAD": base64.b64encode(zlib.compress(payload, 9)).decode(),
    }
    return filled(_source("index.html"), values)


def _high_and_low(bits: np.ndarray) -> bytes:
    """All high bytes, then all low ones, which packs better."""
    return np.ascontiguousarray(bits.astype("<u2").view(np.uint8).reshape(-1, 2)[:, ::-1].T).tobytes()


def _source(name: str) -> str:
    return (SOURCES / name).read_text(encoding="utf-8")


def _shaders(tables) -> dict[str, str]:
    """The texts of the shaders by name; a technique's own begins with `lobe_`."""
    numbers = {
        "FLOOR_RADIUS": FLOOR_RADIUS, "SPHERE_RADIUS": SPHERE_RADIUS, "CYLINDER_RADIUS": CYLINDER_RADIUS,
        "CYLINDER_HEIGHT": CYLINDER_HEIGHT, "DIELECTRIC_F0": DIELECTRIC_F0,
    }  # fmt: skip
    vectors = {
        "SPHERE_CENTER": SPHERE_CENTER, "CYLINDER_CENTER": CYLINDER_CENTER, "BOX_CENTER": BOX_CENTER,
        "BOX_HALVES": BOX_HALVES, "BOX_TURN": (np.cos(BOX_ANGLE), np.sin(BOX_ANGLE)),
        **{f"{name}_COLOR": values for name, values in COLORS.items()},
    }  # fmt: skip
    values = {name: _number(value) for name, value in numbers.items()}
    values |= {name: _vector(vector) for name, vector in vectors.items()}
    shaders = {name: _source(f"{name}.glsl") for name in ("technique", "reference", "display", "surfaces")}
    shaders["surface"] = filled(_source("surface.glsl"), values)
    shaders["display"] = filled(shaders["display"], {"ERROR_COLORS": _error_color_lines()})
    for name, table in tables.items():
        limits = _source("limits.glsl").rstrip() if table.family == "ltsh" else ""
        shaders[f"lobe_{name}"] = filled(_source("lobe.glsl"), {"prefix": name, "LIMITS": limits})
        shaders[f"wgsl_{name}"] = _wgsl(table)
    for path in sorted(SOURCES.glob("own_*.glsl")):
        shaders[path.stem] = filled(path.read_text(encoding="utf-8"), {"prefix": "ltsh4"})
    return shaders


def _wgsl(table: LookupTable) -> str:
    """The compute shader of a table for WebGPU."""
    values = {
        "prefix": table.name,
        "HEADER": header.wgsl_text(header.header_text(table, table.name, table.name), table.name),
        "LIMITS": _source("limits.wgsl").rstrip() if table.family == "ltsh" else "",
        "RADIANCE": _number(RADIANCE),
    }
    return filled(_source("lobe.wgsl"), values)


def _error_color_lines() -> str:
    """Statements that return the color of `position`, -1 to 1, piecewise linear as `color.signed_error_colors`."""
    lines = []
    for (start, *first), (end, *last) in zip(ERROR_COLORS, ERROR_COLORS[1:], strict=False):
        share = f"(position - {_number(start)}) / {_number(end - start)}".replace("- -", "+ ")
        condition = f"if (position <= {_number(end)}) " if end < 1.0 else ""
        lines.append(f"    {condition}return mix({_vector(first)}, {_vector(last)}, {share});")
    return "\n".join(lines)


def _number(value) -> str:
    """A literal of GLSL, which may end with an exponent but with no letter."""
    return float_literal(value).removesuffix("f")


def _vector(values) -> str:
    return f"vec{len(values)}({', '.join(map(_number, values))})"
