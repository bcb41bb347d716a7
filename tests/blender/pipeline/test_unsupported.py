"""One file with all that is not shaded, or not as in a plain render: it goes through, and each thing is named."""

import subprocess
from pathlib import Path

import bpy
import numpy as np
import programs
import scene_parts

from ltsh_addon import imaging

ROOT = Path(__file__).resolve().parents[3]
EXTRAS = {
    "Glass": {"Transmission_Weight": 1.0},
    "Wax": {"Subsurface_Weight": 1.0},
    "Lacquer": {"Coat_Weight": 1.0},
    "Velvet": {"Sheen_Weight": 1.0},
    "Brushed": {"Anisotropic": 0.8, "Metallic": 1.0},
}
# Those of EXTRAS that no lobe at the surface stands for; the others are shaded or named.
NEVER_A_LOBE = ("Glass", "Wax")


def add_light(kind, name, **settings):
    light = bpy.data.lights.new(name, kind)
    light.energy = 50.0
    for key, value in settings.items():
        setattr(light, key, value)
    return scene_parts.link(bpy.data.objects.new(name, light), (1.0, 1.0, 2.0))


def add_lights():
    scene_parts.add_area_light("Key")
    for kind in ("POINT", "SPOT", "SUN"):
        add_light(kind, f"My {kind.lower()}")
    textured = scene_parts.add_area_light("Screen", location=(-1.0, 0.0, 1.5)).data
    if bpy.app.version < (5, 0, 0):
        textured.use_nodes = True
    tree = textured.node_tree
    emission = next(node for node in tree.nodes if node.type == "EMISSION")
    tree.links.new(tree.nodes.new("ShaderNodeLayerWeight").outputs["Facing"], emission.inputs["Strength"])


def add_surfaces(folder):
    """Small planes of the materials that are approximated, on a floor with a texture that is not there."""
    floor, node = scene_parts.principled("Floor")
    texture = floor.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.new("Lost picture", 4, 4)
    texture.image.source, texture.image.filepath = "FILE", str(folder / "lost.png")
    floor.node_tree.links.new(texture.outputs["Color"], node.inputs["Base Color"])
    scene_parts.add_plane(floor, name="Floor plane")
    for k, (name, inputs) in enumerate(EXTRAS.items()):
        material = scene_parts.principled(name, **inputs)[0]
        scene_parts.add_plane(material, size=0.5, name=f"{name} plane", location=(k * 0.6 - 1.2, 0.0, 0.1))
    plain = scene_parts.principled("Plain")[0]
    scene_parts.add_plane(plain, size=0.4, name="Catcher", location=(0.0, 1.0, 0.1)).is_shadow_catcher = True
    scene_parts.add_plane(plain, size=0.4, name="Hole", location=(1.0, 1.0, 0.1)).is_holdout = True


def add_other_objects():
    scene_parts.link(bpy.data.objects.new("Smoke", bpy.data.volumes.new("Smoke")))
    hair = bpy.data.hair_curves.new("Fur")
    hair.add_curves([3, 3])
    points = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2), (1, 0, 0), (1, 0, 1), (1, 0, 2)], dtype=np.float32) * 0.3
    hair.points.foreach_set("position", points.ravel())
    hair.materials.append(bpy.data.materials["Plain"])
    scene_parts.link(bpy.data.objects.new("Fur", hair), (0.0, -1.0, 0.0))


def lose_a_library(folder):
    """Link an object from another file, which then is no more."""
    path = folder / "props.blend"
    cube = bpy.data.objects.new("Prop", bpy.data.meshes.new("Prop"))
    bpy.data.libraries.write(str(path), {cube})
    bpy.data.objects.remove(cube)
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects = ["Prop"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    return path


def change_the_scene(scene):
    world = scene.world = bpy.data.worlds.new("Sky")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    background = next((node for node in world.node_tree.nodes if node.type == "BACKGROUND"), None)
    background = background or world.node_tree.nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = 1.0
    pano = scene_parts.add_camera(name="Panorama")
    pano.data.type = "PANO"
    camera = scene_parts.add_top_camera()
    camera.name, camera.data.dof.use_dof = "Main", True
    scene.view_layers.new("Second layer")
    scene.cycles.film_exposure = 0.5
    render = scene.render
    render.use_motion_blur = render.use_multiview = render.use_freestyle = render.film_transparent = True
    render.use_border, render.border_max_x, render.pixel_aspect_x = True, 0.9, 1.2
    if bpy.app.version >= (5, 0, 0):
        scene.compositing_node_group = bpy.data.node_groups.new("Grade", "CompositorNodeTree")
    else:
        scene.use_nodes = True
    strips = scene.sequence_editor_create().strips
    known = strips.bl_rna.functions["new_effect"].parameters.keys()
    length = {"length": 9} if "length" in known else {"frame_end": 10}
    strips.new_effect(name="Black", type="COLOR", channel=1, frame_start=1, **length)


# A substring for each thing; all of them stand in one line together where there are several.
EXPECTED = [
    *(("light", f"'My {kind}'") for kind in ("point", "spot", "sun")),
    ("'Screen'",),
    *(("material", f"'{name}'") for name in NEVER_A_LOBE),
    ("world", "'Sky'"),
    ("volume", "'Smoke'"),
    ("'Catcher'", "shadow catcher"),
    ("image", "'Lost picture'", "missing"),
    ("library", "props.blend", "missing"),
    ("only view layer", "of 2"),
    ("depth of field", "'Main'"),
    ("motion blur",),
    ("stereoscopy",),
    ("Freestyle",),
    ("compositing",),
    ("sequencer",),
]


def test_a_file_full_of_unsupported_things_is_shaded_and_each_is_named(tmp_path):
    scene = scene_parts.empty_scene(32, 20)
    add_lights()
    add_surfaces(tmp_path)
    add_other_objects()
    change_the_scene(scene)
    library = lose_a_library(tmp_path)
    path = tmp_path / "everything.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    library.unlink()
    before = path.read_bytes()
    command = programs.command_line("compare", path, "-o", tmp_path / "out", "--cycles-samples", "8")
    command += ["--aa", "2", "--techniques", "ltc,ltsh4", "--json", "--quiet"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, encoding="utf-8", timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    report = programs.document(done.stdout)
    warnings = report["warnings"]
    missing = [words for words in EXPECTED if not any(all(word in line for word in words) for line in warnings)]
    assert not missing, (missing, warnings)
    assert all(line and "\n" not in line for line in warnings) and len(set(warnings)) == len(warnings)
    assert report["camera"] == "Main" and report["exposure"] == 0.5 and report["border"]["width"] == 28
    layers = imaging.read_layers(tmp_path / "out" / "compare.exr")
    assert all(np.isfinite(image).all() for image in layers.values()) and layers["ltsh4.diffuse"].any()
    assert path.read_bytes() == before


def test_the_panoramic_camera_of_such_a_file_is_refused(tmp_path):
    scene = scene_parts.empty_scene(32, 20)
    add_lights()
    add_surfaces(tmp_path)
    change_the_scene(scene)
    path = tmp_path / "everything.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    command = programs.command_line("shade", path, "-o", tmp_path / "out", "--camera", "Panorama")
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, encoding="utf-8", timeout=600, check=False)
    assert done.returncode == 1 and programs.said_nothing(done.stdout)
    assert "camera 'Panorama' is panoramic" in done.stderr.splitlines()[-1]
