"""Nothing is silently black: what is not shaded, and what no light reaches, is said first."""

import json

import bpy
import pytest
import scene_parts
from fake_scene import run

from ltsh_addon import imaging
from ltsh_addon.blender.engine.final_picture import FinalJob, final_picture

OPTIONS = {
    "shade": ["--techniques", "ltc"],
    "compare": ["--techniques", "ltc", "--cycles-samples", "2"],
    "bake": ["--techniques", "ltc", "--size", "64"],
}
REASON = "material 'Fur' has no shader that is supported, found 'Hair BSDF'"


def hair(share=1.0):
    """Planes side by side from above, of which one, of that share of the picture, is of a hair BSDF."""
    scene_parts.empty_scene(16, 12)
    scene_parts.add_top_camera(6.0)
    scene_parts.add_area_light("Key", location=(0.0, 0.0, 2.0), size=3.0)
    if share > 0.0:
        fur, _ = scene_parts.bsdf_material("ShaderNodeBsdfHair", "Fur")
        scene_parts.add_plane(fur, size=6.0, location=(6.0 * (share - 1.0), 0.0, 0.0), name="Furry")
    scene_parts.add_plane(scene_parts.principled("Floor")[0], size=6.0, location=(6.0 * share, 0.0, 0.0), name="Floor")


def turned_away():
    """A floor below a light that shines up."""
    hair(0.0)
    bpy.data.objects["Key"].rotation_euler = (3.14, 0.0, 0.0)


def lost_light():
    """A second one that shines up."""
    hair(0.0)
    scene_parts.add_area_light("Lost", location=(0.0, 0.0, 2.0), rotation=(3.14, 0.0, 0.0))


def black_floor():
    """A floor without any shader."""
    hair(0.0)
    bpy.data.objects["Floor"].data.materials[0] = scene_parts.new_material("Nothing")[0]


# Scene, command -> exit code, and how the lines on stderr start.
CAMERA = "what camera 'Camera' sees"
PICTURES = {
    "all": (
        hair,
        1,
        (f"failed: 100 % of {CAMERA} is not shaded: {REASON}", "warning: material 'Fur': node 'Hair BSDF'"),
    ),
    "most": (lambda: hair(0.75), 1, (f"failed: 75 % of {CAMERA} is not shaded: {REASON}", "warning: material 'Fur'")),
    "half": (
        lambda: hair(0.5),
        0,
        ("warning: 50 % of the samples are not shaded: material 'Fur'", "warning: material 'Fur': node 'Hair BSDF'"),
    ),
    "turned away": (turned_away, 0, (f"warning: no light reaches {CAMERA}: the picture is black",)),
    "lost light": (lost_light, 0, ("warning: nothing that camera 'Camera' sees is lit by 'Lost'",)),
    "black": (
        black_floor,
        0,
        (
            "warning: nothing that camera 'Camera' sees reflects",
            "warning: material 'Nothing': it has no surface shader",
        ),
    ),
}


@pytest.mark.parametrize("command", ["shade", "compare"])
@pytest.mark.parametrize("case", PICTURES)
def test_a_black_picture_says_why(capsys, tmp_path, command, case):
    make, expected, starts = PICTURES[case]
    make()
    path, out = scene_parts.save(tmp_path / "scene.blend"), tmp_path / "out"
    code, _, stderr = run(capsys, command, path, "-o", out, "--quiet", *OPTIONS[command])
    lines = stderr.splitlines()
    assert code == expected and len(lines) == len(starts)
    assert all(line.startswith(start) for line, start in zip(lines, starts, strict=True)), lines
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert len(report["problems"]) == expected and (out / f"{command}.exr").is_file()
    code, stdout, _ = run(capsys, command, path, "-o", out, "--quiet", "--json", *OPTIONS[command])
    assert code == expected and json.loads(stdout)["problems"] == report["problems"]
    if command == "compare":
        page = (out / "report.html").read_text(encoding="utf-8")
        assert ("is not shaded" in page.partition("<table>")[0]) == bool(expected)


def test_of_several_pictures_the_black_ones_are_named(capsys, tmp_path):
    hair()
    path, out = scene_parts.save(tmp_path / "scene.blend"), tmp_path / "out"
    code, stdout, stderr = run(capsys, "shade", path, "-o", out, "--quiet", "--frames", "1-2", *OPTIONS["shade"])
    expected = [f"failed: shade_000{frame}: 100 % of {CAMERA} is not shaded: {REASON}" for frame in (1, 2)]
    assert code == 1 and stderr.splitlines()[:2] == expected
    assert json.loads((out / "report.json").read_text(encoding="utf-8"))["problems"] == [
        line.removeprefix("failed: ") for line in expected
    ]


@pytest.mark.parametrize("sub_samples", [1, 3])
def test_the_engine_and_the_panels_have_the_same_problem(tmp_path, sub_samples):
    hair()
    scene = bpy.context.scene
    path = scene_parts.save(tmp_path / "scene.blend")
    job = FinalJob(scene.name, scene.view_layers[0].name, None, sub_samples, "ltc", "combined")
    (problem,) = final_picture(job, path, lambda stage, fraction: True).problems
    assert problem == f"100 % of {CAMERA} is not shaded: {REASON}"


def test_a_black_texture_says_why(capsys, tmp_path):
    hair(0.5)
    clear, _ = scene_parts.bsdf_material("ShaderNodeBsdfTransparent", "Glass")
    scene_parts.add_plane(clear, name="Pane", location=(0.0, 0.0, 0.5))
    scene_parts.add_plane(
        scene_parts.principled("Ceiling")[0], name="Ceiling", location=(0.0, 0.0, 4.0), rotation=(0.3, 0.0, 0.0)
    )
    path, out = scene_parts.save(tmp_path / "scene.blend"), tmp_path / "out"
    code, _, stderr = run(capsys, "bake", path, "-o", out, "--quiet", *OPTIONS["bake"])
    assert code == 1
    assert stderr.splitlines()[:2] == [
        f"not baked: object 'Furry': 100 % of its texels are not shaded: {REASON}",
        "not baked: object 'Pane': 100 % of its texels are not shaded: material 'Glass' is transparent",
    ]
    assert "warning: object 'Ceiling': no light reaches it, or it reflects none: its texture is black" in stderr
    assert "'Floor'" not in stderr and imaging.read_layers(out / "Floor.exr")["ltc.diffuse"].any()
    assert len(json.loads((out / "report.json").read_text(encoding="utf-8"))["problems"]) == 2
