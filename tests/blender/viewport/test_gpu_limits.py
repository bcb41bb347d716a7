"""What shaders ask of a graphics card: no more than OpenGL, Vulkan and Metal all give, and no word that is reserved."""

import itertools
import re
from dataclasses import replace

import bpy  # noqa: F401 (gpu is there after it alone)
import gpu
import pytest

from ltsh_addon import shading
from ltsh_addon.blender.viewport import drawing, lighting, meshes, pictures, shaders, surfaces

# Vulkan asks for 128 bytes of push constants and 16384 of a uniform buffer, Metal has 16 samplers per stage, and all
# can draw into 8 textures; Blender's OpenGL path has 31 locations of attributes and varyings.
PUSH_BYTES, BLOCK_BYTES, SAMPLERS, TARGETS = 128, 16384, 16, 8
BYTES = {"FLOAT": 4, "INT": 4, "VEC2": 8, "VEC3": 16, "VEC4": 16, "IVEC2": 8, "IVEC4": 16, "MAT4": 64}
# Types and address spaces of Metal's language, and what later versions of GLSL reserve.
RESERVED = (
    "half half3 uchar device constant thread threadgroup kernel vertex fragment texture sampler sample filter input "
    "output active common partition template this union goto inline static extern namespace using"
)


class Recorder:
    """Stands in for a create info, and notes what it is told."""

    def __init__(self, *arguments):
        self.calls = []

    def __getattr__(self, name):
        return lambda *arguments: self.calls.append((name, arguments))

    def of(self, name):
        return [arguments for called, arguments in self.calls if called == name]


@pytest.fixture
def recorded(monkeypatch):
    """A function that makes a shader by `function` and returns the recorders of its create infos."""
    made = []
    monkeypatch.setattr(gpu.types, "GPUShaderCreateInfo", lambda: made.append(Recorder()) or made[-1])
    monkeypatch.setattr(gpu.types, "GPUStageInterfaceInfo", Recorder)
    monkeypatch.setattr(gpu.shader, "create_from_info", lambda info: info)
    monkeypatch.setattr(drawing, "batch_for_shader", lambda *arguments: None)
    monkeypatch.setattr(drawing, "_compiled", {})  # what stands in for shaders is no shader of the session

    def run(function):
        made.clear()
        function()
        return list(made)

    return run


def check(info):
    """One shader keeps to the limits."""
    assert sum(BYTES[kind] for kind, *_ in info.of("push_constant")) <= PUSH_BYTES
    for calls, most in (("sampler", SAMPLERS), ("fragment_out", TARGETS)):
        slots = [arguments[0] for arguments in info.of(calls)]
        assert slots == list(range(len(slots))) and len(slots) <= most
    [[source]] = info.of("fragment_source")
    code = re.sub(r"/\*.*?\*/|//[^\n]*|^\s*#.*?$", " ", source, flags=re.DOTALL | re.MULTILINE)
    words = set(re.findall(r"[A-Za-z_]\w*", code)) - {"inline"}
    assert not words & set(RESERVED.split()), sorted(words & set(RESERVED.split()))
    assert "@" not in code
    assert not re.search(r"\w+\s*\[\s*\d*\s*\]\s*\(", code), "Metal has no array constructors"


@pytest.mark.parametrize("technique", shading.SHIPPED_TABLES)
def test_the_lighting_pass_keeps_to_the_limits(technique, recorded):
    table = shading.load_table(technique)
    for choice in itertools.product((False, True), repeat=6):
        features = shaders.Features(*choice)
        if features.specular or features.diffuse:
            [info] = recorded(lambda features=features: shaders.lighting_shader(table, features))
            check(info)
    # With all that there can be: both lobes in one, and those of rough surfaces by themselves.
    every = shaders.Features(**{name: True for name in shaders.Features.__dataclass_fields__})
    for features in (replace(every, rough=False), replace(every, specular=False, brushing=False, brushed=False)):
        check(recorded(lambda features=features: shaders.lighting_shader(table, features))[0])


def test_surfaces_and_pictures_keep_to_the_limits(recorded):
    for outputs in (surfaces.SURFACES, surfaces.NORMALS, surfaces.REBOUNDS, surfaces.EMISSION):
        [info] = recorded(lambda outputs=outputs: surfaces._shader(outputs))
        check(info)
    for info in (*recorded(pictures.PicturePass), *recorded(lighting.HorizonPass)):
        check(info)
    # All values are vec4 or matrices of them, which std140 lays out as arrays of floats are in Python.
    assert 16 * meshes.LOOK_SIZE <= BLOCK_BYTES
