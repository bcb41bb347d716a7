"""`python -m tables export --layout`: the files as each engine reads them, in each engine's formula, beside our `ltc`.

The formulas are in tests/helpers/engine_shaders.py. Headers are compared with the bytes that the formats prescribe.
"""

import base64
import json
import re
import shutil
import struct
import subprocess
from pathlib import Path

import engine_shaders
import numpy as np
import pytest
from table_exports import run

from ltsh_addon import shading
from tables import header, layouts

ROOT = Path(__file__).resolve().parents[2]
TABLE = shading.load_table("ltc")


@pytest.fixture(scope="module")
def files():
    return {name: layouts.layout_files(layout, TABLE) for name, layout in layouts.LAYOUTS.items()}


@pytest.fixture(scope="module")
def rectangles():
    """cos_theta_o, roughness and corners of 400 rectangles, and their integrals with our `ltc`."""
    cosine, roughness, corners = engine_shaders.random_rectangles()
    return cosine, roughness, corners, shading.integrate_polygon(TABLE, cosine, roughness, corners)


# Readers, each as its engine reads:


def read_three(data):
    text = data["RectAreaLightTexturesLib.js"].decode("ascii")
    texts = re.findall(r"^const (?:FIRST|SECOND) = '([A-Za-z0-9+/=]*)';$", text, re.M)
    return [np.frombuffer(base64.b64decode(text), "<f4").reshape(64, 64, 4) for text in texts]


def read_babylon(data):
    encoded = np.frombuffer(data["areaLightsLTC.bin"], "<u2").reshape(-1, 8)
    assert len(encoded) == 64 * 64
    return [np.ascontiguousarray(half).view(np.float16).reshape(64, 64, 4) for half in (encoded[:, :4], encoded[:, 4:])]


def read_playcanvas(data):
    luts = json.loads(data["area-light-luts.json"])
    assert list(luts) == ["LTC_MAT_1", "LTC_MAT_2"]
    return [np.array(values, np.float16).reshape(64, 64, 4) for values in luts.values()]


def read_bevy(data):
    """The KTX 2.0 specification, sections 3 and 5; Khronos Data Format 1.3, section 5."""
    data = data["ltc.ktx2"]
    words = struct.unpack_from("<9I", data, 12)
    #     vkFormat R16G16B16A16_SFLOAT, typeSize, width, height, depth, layers, faces, levels, no supercompression
    assert data[:12] == bytes.fromhex("AB4B5458203230BB0D0A1A0A") and words == (97, 2, 64, 64, 0, 2, 1, 1, 0)
    descriptor, descriptor_size, keys, keys_size = struct.unpack_from("<4I", data, 48)
    *supercompression, level, size, uncompressed = struct.unpack_from("<5Q", data, 64)
    assert supercompression == [0, 0] and size == uncompressed == 2 * 64 * 64 * 8
    assert (descriptor, descriptor_size, keys) == (104, 92, 196) and level % 8 == 0 and level + size == len(data)
    kinds = enumerate(("c0", "c1", "c2", "cf"))
    samples = "".join(f"{16 * number:02x}000f{kind}00000000000080bf0000803f" for number, kind in kinds)
    expected = "5c000000000000000200580001010100000000000800000000000000" + samples
    assert data[104:196].hex() == expected
    length = struct.unpack_from("<I", data, keys)[0]
    assert data[keys + 4 : keys + 4 + length].startswith(b"KTXwriter\0LTSH ") and data[keys + 3 + length] == 0
    assert keys_size == length + 4 + -length % 4 and not any(data[keys + 4 + length : level])
    return np.frombuffer(data[level:], "<f2").reshape(2, 64, 64, 4)


def read_godot(data):
    """Godot skips 148 bytes. They must be those of DDS_HEADER and DDS_HEADER_DXT10, of which this is the whole text."""
    start = b"DDS " + struct.pack("<7I", 124, 0x1 | 0x2 | 0x4 | 0x8 | 0x1000, 64, 64, 64 * 16, 1, 1) + bytes(44)
    start += struct.pack("<2I", 32, 0x4) + b"DX10" + bytes(20) + struct.pack("<I", 0x1000) + bytes(16)
    start += struct.pack("<5I", 2, 3, 0, 1, 0)
    textures = []
    for name in ("ltc_lut1.dds", "ltc_lut2.dds"):
        assert data[name][:148] == start and len(data[name]) == 148 + 64 * 64 * 16
        textures.append(np.frombuffer(data[name], "<f4", offset=148).reshape(64, 64, 4))
    return textures


def read_unity(data):
    text = data["LtcData.BRDF_GGX.cs"].decode("ascii")
    declared = re.search(r"partial class LTCAreaLight\s*{\s*internal static ushort\[\] s_LtcMatrixData_BRDF_GGX = "
                         r"new ushort\[64 \* 64 \* 4\]\s*{([\d,\s]*)};", text)  # fmt: skip
    assert "namespace UnityEngine.Rendering.HighDefinition" in text and text.count("{") == text.count("}") == 3
    numbers = [int(word) for word in declared[1].split(",") if word.strip()]
    return [np.array(numbers, np.uint16).view(np.float16).reshape(64, 64, 4)]


READERS = {
    "three": read_three, "babylon": read_babylon, "playcanvas": read_playcanvas, "bevy": read_bevy,
    "godot": read_godot, "unity": read_unity,
}  # fmt: skip


def shaded(name, textures, rectangles, **options):
    cosine, roughness, corners, _ = rectangles
    more = (TABLE.albedos(cosine, roughness)[0].astype(float),) if name == "unity" else ()
    return engine_shaders.SHADERS[name](textures, cosine, roughness, corners, *more, **options)


def documented():
    """kB, and per cent by layout in docs/engines.md: above the horizon, and where the horizon cuts."""
    text = (ROOT / "docs" / "engines.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| [^|]* \| (\d+) kB \| ([\d.]+) % \| ([\d.]+) % \|", text, re.M)
    return {name: (int(size), float(above), float(cut)) for name, size, above, cut in rows}


@pytest.mark.parametrize("name", layouts.LAYOUTS)
def test_the_engine_shades_with_the_file_as_the_documents_say(name, files, rectangles):
    """Errors relative to our `ltc`, to the last documented digit. What is left of them is the engine's horizon; without
    it they are at most 0.8 % (Unity multiplies with the albedo above the horizon, we with that of the whole sphere)."""
    textures = READERS[name](files[name])
    above, cut, _ = engine_shaders.relative_errors(shaded(name, textures, rectangles), rectangles[3], rectangles[2])
    size, documented_above, documented_cut = documented()[name]
    assert size == round(sum(map(len, files[name].values())) / 1000.0)
    assert (100.0 * above, 100.0 * cut) == pytest.approx((documented_above, documented_cut), abs=0.0051)


@pytest.mark.parametrize("name", ["bevy", "godot"])
def test_engines_that_clip_exactly_are_within_a_tenth_of_a_percent_above_the_horizon(name, files, rectangles):
    values = shaded(name, READERS[name](files[name]), rectangles)
    assert engine_shaders.relative_errors(values, rectangles[3], rectangles[2])[0] < 0.001


def test_unity_without_its_sphere_is_within_one_percent(files, rectangles):
    values = shaded("unity", read_unity(files["unity"]), rectangles, exact_horizon=True)
    above, cut, _ = engine_shaders.relative_errors(values, rectangles[3], rectangles[2])
    assert above < 0.01 and cut < 0.01


@pytest.mark.parametrize("name", ["godot", "unity"])
def test_the_file_of_three_is_wrong_for_engines_with_other_matrices(name, files, rectangles):
    """Their loaders take it without complaint, so the documents must warn."""
    values = shaded(name, read_three(files["three"]), rectangles)
    assert engine_shaders.relative_errors(values, rectangles[3], rectangles[2])[0] > 0.5


def test_the_formulas_clip_as_the_exact_integral_does(rectangles):
    """The oracle: with exact numbers at each point, the formulas of Bevy give the form factor that this package has."""
    corners = rectangles[2]
    polygon, lit = engine_shaders._clipped(corners)
    values = engine_shaders._edges(polygon, engine_shaders._rational_edge)[:, 2]
    # The rational approximation of theta / sin(theta) is good to 2e-4.
    assert lit.all() and np.abs(values) == pytest.approx(shading.clamped_form_factor(corners), abs=2e-4)


@pytest.mark.skipif(shutil.which("node") is None, reason="runs JavaScript")
def test_the_module_for_three_makes_its_four_textures(files, tmp_path):
    package = tmp_path / "node_modules" / "three"
    package.mkdir(parents=True)
    (package / "package.json").write_text('{"type": "module", "main": "index.js"}')
    names = "ClampToEdgeWrapping FloatType HalfFloatType LinearFilter NearestFilter RGBAFormat UVMapping".split()
    (package / "index.js").write_text(
        "".join(f"export const {name} = '{name}';\n" for name in names)
        + "export const DataUtils = { toHalfFloat: (value) => Math.round(value * 1024) + 20000 };\n"
        + "export class DataTexture { constructor(...all) { this.all = all; } }\n"
    )
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "RectAreaLightTexturesLib.js").write_bytes(files["three"]["RectAreaLightTexturesLib.js"])
    (tmp_path / "main.js").write_text(
        "import { RectAreaLightTexturesLib as library } from './RectAreaLightTexturesLib.js';\n"
        "const made = library.init();\n"
        "const text = (texture) => [Array.from(texture.all[0]), texture.all.slice(1), texture.needsUpdate];\n"
        "console.log(JSON.stringify([1, 2].map((n) => [made[`LTC_FLOAT_${n}`], made[`LTC_HALF_${n}`]].map(text))));\n"
    )
    done = subprocess.run(["node", "main.js"], cwd=tmp_path, capture_output=True, text=True, check=True)
    for (floats, halves), texture in zip(json.loads(done.stdout), read_three(files["three"]), strict=True):
        assert np.array_equal(np.array(floats[0], np.float32), texture.ravel()) and floats[2] is halves[2] is True
        assert np.abs(np.array(halves[0]) - 20000 - 1024 * texture.ravel()).max() <= 0.5
        assert floats[1] == [64, 64, "RGBAFormat", "FloatType", "UVMapping", *["ClampToEdgeWrapping"] * 2,
                             "LinearFilter", "NearestFilter", 1]  # fmt: skip


def test_the_two_textures_of_the_default_are_those_of_three(files):
    textures = layouts.layout_textures(layouts.LAYOUTS["three"], TABLE)
    for texture, read in zip(textures, read_three(files["three"]), strict=True):
        assert np.array_equal(texture, read)
        assert np.frombuffer(header.dds(texture[None]), "<f4", offset=148).tobytes() == read.tobytes()


@pytest.mark.parametrize("name", layouts.LAYOUTS)
def test_the_command_writes_the_files_and_says_what_is_dropped(name, files, capsys, out):
    code, stdout, stderr = run(capsys, "--layout", name, "-o", out, "--json")
    document = json.loads(stdout)
    written = [Path(path) for path in document["tables"]["ltc"]]
    assert document["licenses"] == [str(out / "LICENSE-CC0.txt")]
    assert code == 0 and {path.name: path.read_bytes() for path in written} == files[name]
    layout = layouts.LAYOUTS[name]
    assert stderr.splitlines() == [f"tables: warning: ltc in {layout.engine}: {text}" for text in layout.dropped]
    assert layout.dropped


@pytest.mark.parametrize(
    ("arguments", "expected", "complaint"),
    [
        (["--layout", "unreal"], 2, "invalid choice: 'unreal'"),
        (["--layout", "bevy", "ltsh4"], 1, "Bevy 0.20-dev takes LTC, this one has spherical harmonics; choose ltc"),
        (["--layout", "godot", "ltc", "ltsh2"], 2, "--layout godot writes the files of one table, not of 2"),
    ],
)
def test_wrong_layouts_write_nothing(arguments, expected, complaint, capsys, out):
    code, stdout, stderr = run(capsys, *arguments, "-o", out)
    assert (code, stdout) == (expected, "") and complaint in stderr.splitlines()[-1] and not out.exists()


def test_the_documents_name_each_layout_and_its_source():
    text = (ROOT / "docs" / "engines.md").read_text(encoding="utf-8")
    assert set(documented()) == set(layouts.LAYOUTS)
    for layout in layouts.LAYOUTS.values():
        assert all(f"/{name}`" in text for name in layout.files) and layout.engine in text
        assert re.search(r"[0-9a-f]{7}\b|0\.187\.0", layout.source)
