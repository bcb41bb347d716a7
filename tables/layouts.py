"""LTC tables in the layouts of engines: the files of `python -m tables export --layout ENGINE`.

`LAYOUTS` describes each layout. All are textures of 64 x 64 texels: roughness runs along the rows, uniform from 0 to 1;
the view angle runs down the columns, by one of the functions of `ANGLES`. The channels of a texel are some of these
fields:

- w00, w02, w11, w20, w22: the matrix W = M^-1 that turns directions into those of a clamped cosine about z, in the
  frame of the shading normal, where the view direction has x >= 0;
- m00, m02, m11, m20, m22: its inverse M;
- mass, schlick: the integrals of the lobe over the whole sphere for F = 1 and for (1 - c)^5;
- sphere: `clipped_sphere_factor` of the texel's position;
- zero.

A lobe is the same for any multiple of its matrix. `Layout.unit` says which multiple is stored.
"""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltsh_addon.lobes.lookup_table import LookupTable, TableError
from ltsh_addon.scene import VERSION

from .header import dds

TEXTURE_SIZE = 64  # texels along each side
_ABOUT = f"Made by `python -m tables export` of LTSH {VERSION}. Public domain (SPDX-License-Identifier: CC0-1.0)."


@dataclass(frozen=True)
class Layout:
    """The files that an engine takes, and how its shader reads them."""

    engine: str  # and the version that has been read
    source: str  # of the lookup: path in the engine's repository, and commit
    files: tuple[str, ...]
    destination: str  # of the files
    container: Callable[[np.ndarray], list[bytes]]  # contents of `files` for textures (N, 64, 64, 4)
    dtype: type
    textures: tuple[tuple[str, str, str, str], ...]  # the fields of each texture's channels
    unit: str  # the entry of the matrix that is 1; "norm" if the squares of all entries add up to 1
    angle: str  # a key of ANGLES
    least_roughness: float = 0.0
    dropped: tuple[str, ...] = ()  # what of our `ltc` the engine does not use, and what that costs


def layout_files(layout: Layout, table: LookupTable) -> dict[str, bytes]:
    """The contents of the layout's files, by name. Raises TableError."""
    return dict(zip(layout.files, layout.container(layout_textures(layout, table)), strict=True))


def layout_textures(layout: Layout, table: LookupTable) -> np.ndarray:
    """(N, 64, 64, 4) of the layout's type: the textures of a table of the family "ltc". Raises TableError."""
    if table.family != "ltc":
        raise TableError(f"table {table.name}: {layout.engine} takes LTC, this one has spherical harmonics; choose ltc")
    position = np.linspace(0.0, 1.0, TEXTURE_SIZE)
    row, column = (grid.ravel() for grid in np.meshgrid(position, position, indexing="ij"))
    fields = _fields(table, ANGLES[layout.angle](row), np.maximum(column, layout.least_roughness))
    fields["sphere"] = clipped_sphere_factor(2.0 * column - 1.0, row)
    matrix = "".join(name for texture in layout.textures for name in texture if name[1:].isdigit())[0]
    entries = {name: fields[name] for name in fields if name[0] == matrix and name[1:].isdigit()}
    norm = np.sqrt(sum(entry**2 for entry in entries.values())) if layout.unit == "norm" else entries[layout.unit]
    fields |= {name: entry / norm for name, entry in entries.items()}
    stacked = np.stack([np.stack([fields[name] for name in texture], axis=-1) for texture in layout.textures])
    if not np.abs(stacked).max() <= np.finfo(layout.dtype).max:
        raise TableError(f"table {table.name}: its largest number for {layout.engine} is {np.abs(stacked).max():g}")
    return stacked.reshape(-1, TEXTURE_SIZE, TEXTURE_SIZE, 4).astype(layout.dtype)


def _fields(table, cosine, roughness) -> dict[str, np.ndarray]:
    """All fields of the module's docstring but "sphere", at cosine (P,) and roughness (P,)."""
    lobe = table.lookup(cosine, roughness, curves=2)
    # Rotate the axis of the cosine into z.
    sine, cosine = np.sin(lobe.tilt), np.cos(lobe.tilt)
    w00, w02 = cosine * lobe.xx, cosine * lobe.xz - sine * lobe.zz
    w20, w22 = sine * lobe.xx, sine * lobe.xz + cosine * lobe.zz
    determinant = w00 * w22 - w02 * w20
    mass, schlick = lobe.coefficients[:, 0]
    return {
        "w00": w00, "w02": w02, "w11": lobe.yy, "w20": w20, "w22": w22,
        "m00": w22 / determinant, "m02": -w02 / determinant, "m11": 1.0 / lobe.yy, "m20": -w20 / determinant,
        "m22": w00 / determinant, "mass": mass, "schlick": schlick, "zero": np.zeros_like(mass),
    }  # fmt: skip


def clipped_sphere_factor(height: np.ndarray, form_factor: np.ndarray) -> np.ndarray:
    """Form factor of a sphere in a direction with z = `height` over the horizon, relative to `form_factor`, its form
    factor straight above.

    Snyder 1996, "Area light sources for real-time graphics", Microsoft Research MSR-TR-96-11, as in Heitz et al. 2016.
    """
    squared = np.maximum(form_factor, 1e-9)
    sigma = np.arcsin(np.sqrt(np.minimum(squared, 1.0)))
    omega = np.arccos(np.clip(height, -1.0, 1.0))
    whole = np.maximum(height, 0.0) * squared
    # This is for spheres that the horizon cuts.
    ratio = np.clip(np.cos(sigma) / np.maximum(np.sin(omega), 1e-9), -1.0, 1.0)
    gamma = np.arcsin(ratio)
    under_root = np.maximum(squared - np.cos(gamma) ** 2, 0.0)
    turned = np.arcsin(np.clip(np.cos(gamma) / np.sin(sigma), -1.0, 1.0))
    g = 0.5 * np.pi - 2.0 * np.sin(omega) * np.cos(sigma) * np.cos(gamma) - gamma + np.sin(gamma) * np.cos(gamma)
    h = height * (np.cos(gamma) * np.sqrt(under_root) + squared * turned)
    above = height * squared + (g - h) / np.pi
    cut = np.where(omega < 0.5 * np.pi, above, (g + h) / np.pi)
    is_cut = np.abs(omega - 0.5 * np.pi) < sigma
    return np.maximum(np.where(is_cut, cut, whole), 0.0) / squared


# Angles: cosine of the view angle at positions in [0, 1] down the columns.


def _cosine_of_root(position):
    return 1.0 - position * position


def _cosine_of_godot(position):
    """Godot looks up theta / 90 degrees, with an approximation of the arc cosine that is up to 0.5 degrees off. This is
    its inverse, so that the approximation does no harm."""
    cosine = np.linspace(0.0, 1.0, 1 << 16)
    angle = (0.5 * np.pi - 0.156583 * cosine) * np.sqrt(1.0 - cosine)
    return np.interp(0.5 * np.pi * position, angle[::-1], cosine[::-1])


ANGLES = {"sqrt(1 - n.v)": _cosine_of_root, "theta / 90 degrees": _cosine_of_godot}


# Containers:


def _dds_files(textures):
    return [dds(texture[None]) for texture in textures]


def _javascript_module(textures):
    """A module in the place of the one that three.js takes its textures from."""
    texts = [base64.b64encode(texture.astype("<f4").tobytes()).decode("ascii") for texture in textures]
    return [_JAVASCRIPT.format(about=_ABOUT, first=texts[0], second=texts[1], size=TEXTURE_SIZE).encode("ascii")]


_JAVASCRIPT = """\
// {about}
import {{
    ClampToEdgeWrapping, DataTexture, DataUtils, FloatType, HalfFloatType, LinearFilter, NearestFilter, RGBAFormat,
    UVMapping
}} from 'three';

const FIRST = '{first}';
const SECOND = '{second}';

function decoded( text ) {{
    return new Float32Array( Uint8Array.from( atob( text ), ( letter ) => letter.charCodeAt( 0 ) ).buffer );
}}

function texture( data, type ) {{
    const made = new DataTexture( data, {size}, {size}, RGBAFormat, type, UVMapping, ClampToEdgeWrapping,
        ClampToEdgeWrapping, LinearFilter, NearestFilter, 1 );
    made.needsUpdate = true;
    return made;
}}

class RectAreaLightTexturesLib {{
    static init() {{
        for ( const [ number, text ] of [ [ 1, FIRST ], [ 2, SECOND ] ] ) {{
            const data = decoded( text );
            const halves = Uint16Array.from( data, DataUtils.toHalfFloat );
            this[ `LTC_FLOAT_${{ number }}` ] = texture( data, FloatType );
            this[ `LTC_HALF_${{ number }}` ] = texture( halves, HalfFloatType );
        }}
        return this;
    }}
}}

export {{ RectAreaLightTexturesLib }};
"""


def _interleaved(textures):
    """All channels of a texel side by side."""
    return [np.concatenate(list(textures), axis=-1).astype("<f2").tobytes()]


def _json_arrays(textures):
    arrays = {
        f"LTC_MAT_{number}": [float(str(value)) for value in texture.ravel()]
        for number, texture in enumerate(textures, start=1)
    }
    return [json.dumps(arrays).encode("ascii")]


def _ktx2(textures):
    """A KTX 2.0 array texture of VK_FORMAT_R16G16B16A16_SFLOAT, one level, not compressed."""
    layers, height, width, _ = textures.shape
    data = textures.astype("<f2").tobytes()
    # A basic data format descriptor of four signed floats, linear BT.709; the range of each is -1 .. 1.
    samples = b"".join(
        struct.pack("<HBB4x2f", 16 * number, 15, 0xC0 | channel, -1.0, 1.0)
        for number, channel in enumerate((0, 1, 2, 15))
    )
    block = struct.pack("<I2H4B4x8B", 0, 2, 24 + len(samples), 1, 1, 1, 0, 8, 0, 0, 0, 0, 0, 0, 0) + samples
    descriptor = struct.pack("<I", 4 + len(block)) + block
    writer = f"KTXwriter\0LTSH {VERSION}\0".encode("ascii")
    writer = struct.pack("<I", len(writer)) + writer + bytes(-len(writer) % 4)
    start = 80 + 24  # after the header and the index of one level
    offset = start + len(descriptor) + len(writer)
    padding = -offset % 8
    header = struct.pack("<12s9I", b"\xabKTX 20\xbb\r\n\x1a\n", 97, 2, width, height, 0, layers, 1, 1, 0)
    index = struct.pack("<4I2Q", start, len(descriptor), start + len(descriptor), len(writer), 0, 0)
    level = struct.pack("<3Q", offset + padding, len(data), len(data))
    return [header + index + level + descriptor + writer + bytes(padding) + data]


def _csharp_array(textures):
    """The source of a C# array of half floats."""
    rows = textures[0].view(np.uint16).reshape(TEXTURE_SIZE, -1)
    lines = "\n".join(f"            {', '.join(map(str, row))}," for row in rows)
    return [_CSHARP.format(about=_ABOUT, size=TEXTURE_SIZE, lines=lines).encode("ascii")]


_CSHARP = """\
// {about}
namespace UnityEngine.Rendering.HighDefinition
{{
    internal partial class LTCAreaLight
    {{
        internal static ushort[] s_LtcMatrixData_BRDF_GGX = new ushort[{size} * {size} * 4]
        {{
{lines}
        }};
    }}
}}
"""


# The layouts:

_INVERSE = ("w00", "w20", "w02", "w22"), ("mass", "schlick", "zero", "sphere")
_SPHERE = (
    "the engine cuts lights at the horizon as if they were spheres: its integrals are 4 % (mean) from ours above the "
    "horizon, 15 % where the horizon cuts a light"
)
_ONE_HORIZON = "the engine cuts lights at the horizon of the cosine alone, not at the surface's: 1 % (mean) there"
_TWO_CURVES = "of the five Fresnel curves only F = 1 and (1 - c)^5 are used: no dielectrics, no F82 tint of metals"
_HALVES = "half floats: +0.06 % of the error of the fit"

LAYOUTS = {
    "three": Layout(
        engine="three.js r187",
        source="src/renderers/shaders/ShaderChunk/lights_physical_pars_fragment.glsl.js of the npm package 0.187.0",
        files=("RectAreaLightTexturesLib.js",),
        destination="examples/jsm/lights/",
        container=_javascript_module,
        dtype=np.float32,
        textures=_INVERSE,
        unit="w11",
        angle="sqrt(1 - n.v)",
        dropped=(_SPHERE, _TWO_CURVES),
    ),
    "babylon": Layout(
        engine="Babylon.js 9",
        source="packages/dev/core/src/Lights/LTC/ltcTextureTool.ts at 0cdf4e6, "
        "packages/dev/core/src/Shaders/ShadersInclude/ltcHelperFunctions.fx at 1ae8039",
        files=("areaLightsLTC.bin",),
        destination="what scene.areaLightLTCProvider loads",
        container=_interleaved,
        dtype=np.float16,
        textures=_INVERSE,
        unit="w11",
        angle="sqrt(1 - n.v)",
        dropped=(_SPHERE, _TWO_CURVES, _HALVES),
    ),
    "playcanvas": Layout(
        engine="PlayCanvas 2.22",
        source="src/scene/area-light-luts.js, src/scene/shader-lib/glsl/chunks/lit/frag/ltc.js at 0aaef5e",
        files=("area-light-luts.json",),
        destination="app.setAreaLightLuts(luts.LTC_MAT_1, luts.LTC_MAT_2)",
        container=_json_arrays,
        dtype=np.float32,
        textures=_INVERSE,
        unit="w11",
        angle="sqrt(1 - n.v)",
        dropped=(
            _SPHERE,
            _TWO_CURVES,
            _HALVES,
            "the engine looks up the square of 1 - gloss as roughness, which is sharper than its own GGX",
        ),
    ),
    "bevy": Layout(
        engine="Bevy 0.20-dev",
        source="crates/bevy_pbr/src/render/pbr_lighting.wesl, crates/bevy_pbr/src/lib.rs at 4805ca7",
        files=("ltc.ktx2",),
        destination="crates/bevy_pbr/src/ltc/, then build",
        container=_ktx2,
        dtype=np.float16,
        textures=_INVERSE,
        unit="w11",
        angle="sqrt(1 - n.v)",
        dropped=(_ONE_HORIZON, _TWO_CURVES, _HALVES),
    ),
    "godot": Layout(
        engine="Godot 4.7",
        source="servers/rendering/renderer_rd/shaders/area_lights_inc.glsl at 0385d21, "
        "servers/rendering/storage/make_ltc_lut.py at 59ff07d",
        files=("ltc_lut1.dds", "ltc_lut2.dds"),
        destination="servers/rendering/storage/ltc/, then build",
        container=_dds_files,
        dtype=np.float32,
        textures=(("m00", "m20", "m11", "m02"), ("m22", "mass", "schlick", "zero")),
        unit="norm",
        angle="theta / 90 degrees",
        dropped=(_ONE_HORIZON, _TWO_CURVES, "the engine takes a roughness of at least 0.02"),
    ),
    "unity": Layout(
        engine="Unity HDRP 16 and later",
        source="Packages/com.unity.render-pipelines.high-definition/Runtime/Material/LTCAreaLight/LTCAreaLight.hlsl at "
        "9c2ee61, LTCAreaLight.cs at 7753541, Packages/com.unity.render-pipelines.core/ShaderLibrary/AreaLighting.hlsl "
        "at 2a67652",
        files=("LtcData.BRDF_GGX.cs",),
        destination="Runtime/Material/LTCAreaLight/Generated/ of the package",
        container=_csharp_array,
        dtype=np.float16,
        textures=(("w00", "w20", "w11", "w02"),),
        unit="w22",
        angle="sqrt(1 - n.v)",
        least_roughness=1e-3**0.5,
        dropped=(
            _SPHERE,
            "albedo and Fresnel are the engine's own: ours are not used",
            "the tables of the engine's other BRDFs stay: Disney diffuse, Charlie, Kajiya-Kay, Cook-Torrance, Ward, "
            "Oren-Nayar",
            "alpha is at least 0.001",
            _HALVES,
        ),
    ),
}
