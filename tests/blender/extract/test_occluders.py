"""What blocks light, against the shadows of Cycles under a light so small that a point is lit or not."""

import re

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_instancer, into_collection
from material_scenes import Build
from panes import (
    LIGHT,
    add_light,
    assert_as_cycles,
    clear,
    hidden,
    invisible,
    pane,
    seen_by_cycles,
    seen_by_rays,
    shown,
    start,
    textured,
)

from ltsh_addon.blender.viewport.shadow_rays import view_occluders
from ltsh_addon.visibility import Occluders

# Shapes:


def cube(location=(0.0, 0.0, 1.0), size=1.0, material=None):
    bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    ob = hidden(bpy.context.object)
    if material is not None:
        ob.data.materials.append(material)
    return ob


def modified():
    ob = cube()
    for name, viewport, render in (("Subsurf", 0, 2), ("Other", 1, 3)):
        modifier = ob.modifiers.new(name, "SUBSURF")
        modifier.levels, modifier.render_levels = viewport, render
    ob.modifiers["Other"].show_render = False


def curve():
    bpy.ops.curve.primitive_bezier_circle_add(radius=1.0, location=(0.0, 0.0, 1.0))
    ob = hidden(bpy.context.object)
    ob.data.bevel_depth = 0.2
    ob.data.dimensions = "3D"


def text():
    bpy.ops.object.text_add(location=(-1.2, -0.4, 1.0))
    ob = hidden(bpy.context.object)
    ob.data.body, ob.data.size, ob.data.extrude = "HI", 1.5, 0.05


def metaballs():
    bpy.ops.object.metaball_add(type="BALL", radius=1.0, location=(0.0, 0.0, 1.0))
    hidden(bpy.context.object).data.render_resolution = 0.1


def nurbs_surface():
    bpy.ops.surface.primitive_nurbs_surface_sphere_add(radius=0.8, location=(0.0, 0.0, 1.0))
    hidden(bpy.context.object)


def collection_instances():
    """Instances of a collection that is itself not in the scene, mirrored and of different sizes."""
    collection = into_collection("Parts", cube((0.3, 0.0, 0.0), 0.6))
    for number, scale in enumerate(((1.0, 1.0, 1.0), (-0.7, 1.2, 0.5))):
        placement = {"location": (number - 0.8, 0.3, 1.0), "rotation": (0.3, 0.2, 0.4 * number), "scale": scale}
        add_instancer(collection, f"I{number}", **placement)


def vertex_instances():
    parent = hidden(scene_parts.add_plane(size=1.6, name="Parent", location=(0.0, 0.0, 1.0)))
    parent.instance_type = "VERTS"
    parent.show_instancer_for_render = False
    child = cube((0.0, 0.0, 0.0), 0.5)
    child.parent = parent


def generated_instances():
    """A geometry nodes modifier that puts two meshes it makes on points: a ball, and cubes."""
    ob = hidden(scene_parts.add_plane(size=1.6, name="Points", location=(0.0, 0.0, 1.0), rotation=(0.2, 0.1, 0.3)))
    tree, entry, end, on_points, made = scene_parts.add_geometry_nodes(ob, "InstanceOnPoints", "MeshCube")
    made.inputs["Size"].default_value = (0.5, 0.4, 0.3)
    tree.links.new(entry.outputs[0], on_points.inputs["Points"])
    tree.links.new(made.outputs[0], on_points.inputs["Instance"])
    tree.links.new(on_points.outputs[0], end.inputs[0])


def shared_data():
    first = cube((-0.8, 0.0, 1.0), 0.7)
    second = hidden(bpy.data.objects.new("Second", first.data))
    scene_parts.link(second, (0.7, 0.2, 1.1), (0.4, 0.1, 0.9), (0.5, 1.0, 1.3))


def not_in_the_picture():
    """Objects that the camera, reflections or the view layer do not show, but whose shadow is there."""
    a, b, c = cube((-1.0, 0.0, 1.0), 0.6), cube((0.2, 0.0, 1.0), 0.6), cube((1.0, 0.8, 1.0), 0.4)
    a.visible_diffuse = a.visible_glossy = False
    b.is_holdout = True
    bpy.context.scene.collection.children.link(into_collection("Indirect", c))
    bpy.context.view_layer.layer_collection.children["Indirect"].indirect_only = True


def glowing():
    cube(material=scene_parts.bsdf_material("ShaderNodeEmission", "Glow", Strength=0.0)[0])


def glass():
    cube(material=scene_parts.bsdf_material("ShaderNodeBsdfGlass", "Glass")[0])


def no_surface_shader():
    cube(material=scene_parts.new_material("Nothing")[0])


def overridden():
    clear = scene_parts.bsdf_material("ShaderNodeBsdfTransparent", "Clear")[0]
    cube(material=clear)
    bpy.context.view_layer.material_override = bpy.data.materials["Floor"]


SHAPES = {
    function.__name__: function
    for function in (
        *(modified, curve, text, metaballs, nurbs_surface, collection_instances, vertex_instances, shared_data),
        *(generated_instances,),
        *(not_in_the_picture, glowing, glass, no_surface_shader, overridden),
    )
}


# Whose instances share a mesh.
INSTANCES = ("collection_instances", "vertex_instances", "shared_data", "generated_instances")


@pytest.mark.parametrize("name", SHAPES)
def test_shadows_of_shapes_are_those_of_cycles(tmp_path, name):
    start()
    SHAPES[name]()
    occluders = assert_as_cycles(tmp_path)
    if name in INSTANCES:
        assert len(occluders.meshes) == 2 and len(occluders.mesh) > 2  # the floor is one


def test_what_casts_no_shadow_blocks_nothing(tmp_path):
    start()
    for ob, name in ((cube((-1, 0, 1)), "A"), (cube((1, 0, 1)), "B"), (cube((0, 0, 1)), "C")):
        ob.name = name
    invisible(bpy.data.objects["A"])
    bpy.data.objects["B"].hide_render = True
    bpy.data.objects["C"].data.materials.append(scene_parts.bsdf_material("ShaderNodeBsdfTransparent", "Clear")[0])
    volume = Build("Mist")
    volume.link(volume.shader("VolumePrincipled", Density=0.0), volume.output.inputs["Volume"])
    cube((0, 0, 2), material=volume.material)
    parent = hidden(scene_parts.add_plane(size=1.0, name="Parent", location=(0.0, 0.0, 1.0)))
    invisible(parent).instance_type = "VERTS"
    cube((0.0, 0.0, 0.0), 0.5).parent = parent
    assert seen_by_cycles(tmp_path) == pytest.approx(1.0, abs=2e-3)
    occluders, warnings = scene_parts.collected_occluders()
    assert warnings == [] and len(occluders.mesh) == 1  # the floor


# Materials:


def noise(made):
    return made.tree.nodes.new("ShaderNodeTexNoise").outputs[0]


def procedural(made):
    return made.mix(noise(made), made.leaf(0.5), clear(made))


def with_alpha(made, alpha):
    """A Principled BSDF with the output of a node as its alpha."""
    inside = made.shader("BsdfPrincipled")
    made.tree.links.new(alpha, inside.node.inputs["Alpha"])
    return inside


def alpha_image(made, **settings):
    return with_alpha(made, textured(made, "Alpha", **settings))


def counted(made, source, *steps, number_first=False):
    """The output of Math nodes after `source`, each (operation, number, clamp)."""
    for operation, number, clamp in steps:
        node = made.tree.nodes.new("ShaderNodeMath")
        node.operation, node.use_clamp, node.inputs[1 - number_first].default_value = operation, clamp, number
        made.tree.links.new(source, node.inputs[int(number_first)])
        source = node.outputs[0]
    return source


def cut_alpha(made, *steps, operation="GREATER_THAN", **settings):
    """The alpha of an image, above or below a threshold, and what `steps` of `counted` make of it."""
    return counted(made, textured(made, "Alpha", **settings), (operation, 0.4, False), *steps)


def cut_image(made, **settings):
    return with_alpha(made, cut_alpha(made, **settings))


def clamped_cut(made, **settings):
    """A threshold of which a clamped difference is taken: alphas of 0.25 and 0.75."""
    return with_alpha(made, cut_alpha(made, ("SUBTRACT", 0.5, True), ("ADD", 0.25, False), **settings))


def mixed_by_cut(made, **settings):
    cut = cut_alpha(made, operation="LESS_THAN", **settings)
    factor = counted(made, cut, ("SUBTRACT", 1.0, False), number_first=True)
    return made.mix(factor, clear(made, 0.9), made.mix(made.value(0.5), made.leaf(0.5), clear(made)))


def mixed_by_more_than_one(made, **settings):
    """By an alpha of up to 2, which Cycles clamps."""
    factor = counted(made, textured(made, "Alpha", **settings), ("MULTIPLY", 2.0, False))
    return made.mix(factor, clear(made, 0.2), clear(made, 0.8))


def limited(made, **settings):
    node = made.tree.nodes.new("ShaderNodeClamp")
    node.clamp_type, node.inputs["Min"].default_value, node.inputs["Max"].default_value = "RANGE", 0.7, 0.2
    made.tree.links.new(textured(made, "Alpha", **settings), node.inputs[0])
    return with_alpha(made, node.outputs[0])


def by_ray(made, output, first, second):
    return made.mix(made.tree.nodes.new("ShaderNodeLightPath").outputs[output], first, second)


def mapped_image(made):
    inside = alpha_image(made)
    texture = next(node for node in made.tree.nodes if node.bl_idname == "ShaderNodeTexImage")
    mapping, place = made.tree.nodes.new("ShaderNodeMapping"), made.tree.nodes.new("ShaderNodeTexCoord")
    mapping.inputs["Rotation"].default_value[2] = 0.6
    mapping.inputs["Scale"].default_value = (2.0, 3.0, 1.0)
    made.tree.links.new(place.outputs["UV"], mapping.inputs["Vector"])
    made.tree.links.new(mapping.outputs[0], texture.inputs["Vector"])
    return inside


def mixed_by_image(made, **settings):
    return made.mix(textured(made, "Color", space="sRGB", **settings), clear(made, 0.2), clear(made, 0.8))


def stack(made):
    return made.mix(made.value(0.5), clear(made, 0.5), made.mix(made.value(0.25), made.leaf(0.5), clear(made)))


def ramped(made, steps="CONSTANT", **settings):
    node = made.tree.nodes.new("ShaderNodeValToRGB")
    node.color_ramp.interpolation = steps
    node.color_ramp.elements[0].position, node.color_ramp.elements[1].position = 0.2, 0.7
    made.tree.links.new(textured(made, "Alpha", **settings), node.inputs[0])
    return with_alpha(made, node.outputs["Color"])


CUT = {"above a threshold": cut_image, "below a threshold": mixed_by_cut, "ramp of steps": ramped,
       "linear ramp": lambda made, **settings: ramped(made, "LINEAR", **settings),
       "clamped threshold": clamped_cut, "factor beyond 1": mixed_by_more_than_one, "limited": limited}  # fmt: skip

# What a pane's share is, if it is the same everywhere.
MATERIALS = {
    "constant": (lambda made: made.mix(made.value(0.3), made.leaf(0.5), clear(made)), 0.3),
    "alpha beyond 1": (lambda made: made.mix(made.value(0.5), clear(made), with_alpha(made, made.value(1.6))), 0.5),
    "principled alpha": (lambda made: made.shader("BsdfPrincipled", Alpha=0.35), 0.65),
    "added": (lambda made: made.add(clear(made, 0.25), made.add(clear(made, 0.25), made.leaf(0.5))), 0.5),
    "nested": (stack, 0.375),
    "holdout": (lambda made: made.mix(made.value(0.5), made.shader("Holdout"), clear(made)), 0.5),
    "shadow rays": (lambda made: by_ray(made, "Is Shadow Ray", made.shader("BsdfGlass"), clear(made, 0.7)), 0.7),
    "camera rays": (lambda made: by_ray(made, "Is Camera Ray", made.leaf(0.5), clear(made)), 0.0),
    "alpha of an image": (alpha_image, None),
    "clipped image": (lambda made: alpha_image(made, extension="CLIP"), None),
    "mapped image": (mapped_image, None),
    "mixed by a color": (mixed_by_image, None),
    "mixed by a clipped color": (lambda made: mixed_by_image(made, extension="CLIP"), None),
    "clipped and cut": (lambda made: cut_image(made, extension="CLIP"), None),
    **{name: (make, None) for name, make in CUT.items()},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_shadows_of_materials_are_those_of_cycles(tmp_path, name):
    make, share = MATERIALS[name]
    start()
    ob = pane(shown(make))
    if "clipped" in name:
        uv = ob.data.uv_layers[0].uv
        uv.foreach_set("vector", 1.6 * np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32) - 0.3)
    occluders = assert_as_cycles(tmp_path)
    if share is not None:
        assert seen_by_rays(occluders)[0].min() == pytest.approx(share, abs=1e-5)


def test_an_image_is_interpolated_as_in_cycles(tmp_path):
    start()
    pane(shown(lambda made: alpha_image(made, interpolation="Linear")))
    expected = seen_by_cycles(tmp_path)
    found, _ = seen_by_rays(scene_parts.collected_occluders()[0])
    # The light is 2 mm wide, and alpha changes by at most 1 from one pixel of the image, of 0.5 m, to the next.
    assert np.abs(found - expected).max() < 0.02


@pytest.mark.parametrize("name", CUT)
def test_images_are_cut_after_interpolation_as_in_cycles(tmp_path, name):
    """The light is 2 mm wide, so that the edge of a shadow is in few pixels; a cut pixel of the image is 0.5 m wide."""
    start()
    pane(shown(lambda made: CUT[name](made, interpolation="Linear")))
    expected = seen_by_cycles(tmp_path)
    found, _ = seen_by_rays(scene_parts.collected_occluders()[0])
    assert (np.abs(found - expected) > 0.02).mean() < 0.01 and np.ptp(expected) > 0.3


def test_transparent_shadows_may_be_off(tmp_path):
    start()
    material = shown(lambda made: clear(made))
    material.use_transparent_shadow = False
    pane(material)
    assert seen_by_rays(assert_as_cycles(tmp_path))[0].min() == 0.0


def test_each_slot_has_its_own_transparency(tmp_path):
    start()
    ob = pane(shown(lambda made: clear(made, 0.5)))
    ob.data.materials.append(scene_parts.principled("Other")[0])
    corners = [(x, y, z) for z in (0.3, 0.6) for x, y in ((-1, -1), (0.2, -1), (0.2, 1), (-1, 1))]
    other = hidden(scene_parts.add_mesh("Both", corners, [(0, 1, 2, 3), (4, 5, 6, 7)], location=(0.2, 0.0, 1.5)))
    other.data.materials.append(ob.data.materials[0])
    other.data.materials.append(None)
    other.data.polygons[1].material_index = 1
    other.material_slots[1].link = "OBJECT"
    other.material_slots[1].material = shown(lambda made: clear(made, 0.25))
    found = seen_by_rays(assert_as_cycles(tmp_path))[0]
    assert {0.5, 0.125, 0.0625} <= set(np.round(found, 5))


def test_more_panes_than_cycles_goes_through_block(tmp_path):
    for most in (2, 3):
        scene = start()
        scene.cycles.transparent_max_bounces = most
        for number in range(3):
            pane(shown(lambda made: clear(made, 0.9))).location.z += 0.1 * number
        found = seen_by_rays(assert_as_cycles(tmp_path))[0]
        assert found.min() == pytest.approx(0.0 if most == 2 else 0.729, abs=1e-5)


NAMED = {
    "procedural": "'Pane'",
    "colored": "by its mean, up to 50 % of the light off",
    "color under alpha": "only Cycles can tell",
    "displaced": "displacement",
    "hidden from reflections": "light that surfaces choose counts as glossy",
    "in the same place": "in the same place as 'Pane'",
    "instance in the same place": "in the same place as 'Pane'",
    "doubled": "67 % of its faces where others are",
    "overlapped": "50 % of its faces where others are",
    "back to back": "100 % of its faces where others face the other way",
    "rug in its plane": "100 % of those of 'Pane' in 'Rug'",
    "light in its plane": "in the plane of a face: 'Flush' in 'Pane'",
    "point in its plane": "in the plane of a face: 'Flush' in 'Pane'",
    "spot in its plane": "in the plane of a face: 'Flush' in 'Pane'",
}


@pytest.mark.parametrize("name", NAMED)
def test_what_is_not_as_in_cycles_is_named(name):
    start()
    if name == "procedural":
        pane(shown(procedural))
    elif name == "colored":
        pane(shown(lambda made: made.shader("BsdfTransparent", Color=(1.0, 0.5, 0.0, 1.0))))
    elif name == "color under alpha":
        pane(shown(mixed_by_image))
        bpy.data.images["Mask"].alpha_mode = "STRAIGHT"
    elif name == "hidden from reflections":
        ob = pane(scene_parts.principled("Pane")[0])
        ob.name, ob.visible_glossy = "Pane", False
    elif name.endswith("same place"):
        ob = pane(scene_parts.principled("Material")[0])
        ob.name = "Pane"
        twin = ob.copy()
        twin.data = ob.data if name.startswith("instance") else ob.data.copy()
        scene_parts.link(twin, ob.location)
    elif name.endswith("t in its plane"):
        ob = pane(scene_parts.principled("Pane")[0])
        ob.name = "Pane"
        size = {"size": 0.1} if name[0] == "l" else {"shadow_soft_size": 0.0}
        kind = {"l": "AREA", "p": "POINT", "s": "SPOT"}[name[0]]
        for light_name, height in (("Flush", 0.0), ("Below", -1e-4), ("Above", 1e-4)):
            light = scene_parts.new_light(light_name, kind, **size)
            scene_parts.link(light, (ob.location.x, ob.location.y, ob.location.z + height))
    elif name == "rug in its plane":
        corners = [(-1, -1, 0), (1, -1, 0), (0, 1, 0)]
        hidden(scene_parts.add_mesh("Pane", corners, [(0, 1, 2)], location=(0.3, 0.2, 1.0)))
        pane(scene_parts.principled("Rug")[0]).name = "Rug"
    elif name == "doubled":
        # Two squares are one; of the triangles above one is the back of the other.
        square, up = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(-1, -1, 0.1), (1, -1, 0.1), (0, 1, 0.1)]
        faces = [(0, 1, 2), (2, 3, 0), (6, 4, 5), (6, 7, 4), (10, 9, 8), (8, 9, 10)]
        hidden(scene_parts.add_mesh("Pane", 2 * square + up, faces, location=(0.3, 0.2, 1.0)))
    elif name == "back to back":
        square = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
        turned = {"location": (0.3, 0.2, 1.0), "rotation": (0.4, 0.3, 0.2)}
        hidden(scene_parts.add_mesh("Pane", 2 * square, [(0, 1, 2, 3), (7, 6, 5, 4)], **turned))
    elif name == "overlapped":
        # Two squares in one plane share half of each, as tiles of an Array modifier do.
        squares = [(x + left, y, 0) for left in (-1.5, -0.5) for x, y in ((0, -1), (2, -1), (2, 1), (0, 1))]
        hidden(scene_parts.add_mesh("Pane", squares, [(0, 1, 2, 3), (4, 5, 6, 7)], location=(0.3, 0.2, 1.0)))
    else:
        made = Build("Pane")
        made.show(made.leaf(0.5))
        made.material.displacement_method = "DISPLACEMENT"
        node = made.tree.nodes.new("ShaderNodeDisplacement")
        made.tree.links.new(node.outputs[0], made.output.inputs["Displacement"])
        pane(made.material)
    occluders, warnings = scene_parts.collected_occluders()
    assert len(warnings) == 1 and NAMED[name] in warnings[0] and "'Pane'" in warnings[0], warnings
    share = {"procedural": 0.5, "colored": 0.5, "color under alpha": 0.4}.get(name, 0.0)
    assert seen_by_rays(occluders)[0].min() == pytest.approx(share, abs=1e-5)


# Materials whose transparency Cycles alone knows, and half of the most that they may let through.
UNREAD = {
    "between two": (lambda made: made.mix(noise(made), clear(made, 0.2), clear(made, 0.9)), 0.45),
    "a fifth": (lambda made: made.mix(0.2, made.leaf(0.5), procedural(made)), 0.1),
    "alpha": (lambda made: with_alpha(made, noise(made)), 0.5),
    "and a half more": (lambda made: made.mix(0.5, clear(made), procedural(made)), 0.5),
}


@pytest.mark.newest
@pytest.mark.parametrize("name", UNREAD)
def test_what_cycles_alone_knows_is_half_of_the_most_and_at_most_as_much_off(name):
    """As views take it, beside what Cycles bakes."""
    start()
    build, share = UNREAD[name]
    pane(shown(build))
    occluders, (warning,) = scene_parts.collected_occluders()
    assert f"lets {100.0 * share:.0f} % of the light through, at most as much off" in warning
    found, baked = (seen_by_rays(one)[0] for one in (occluders, scene_parts.baked_occluders()[0]))
    behind = found < 1.0
    np.testing.assert_allclose(found[behind], share, atol=1e-5)
    # The bake has 8 bits at least.
    assert behind.any() and np.abs(found - baked).max() <= share + 0.004
    assert np.abs(found - baked)[behind].mean() < baked[behind].mean()


def tinted(made, other=(1.0, 0.5, 0.3, 1.0)):
    return made.shader("BsdfTransparent", Color=other)


# Materials that let colors through, and the most that one of them is off the mean of all three.
COLORED = {
    "constant": (tinted, 40.0),
    "image": (lambda made: made.mix(textured(made, "Alpha"), tinted(made), clear(made, 0.2)), 40.0),
    "by the angle": (
        lambda made: made.mix(made.tree.nodes.new("ShaderNodeFresnel").outputs[0], tinted(made), made.leaf(0.5)),
        38.0,
    ),
    "noise": (lambda made: made.mix(noise(made), tinted(made), made.leaf(0.5)), 30.0),
    "faint": (lambda made: tinted(made, (0.5, 0.51, 0.5, 1.0)), None),
}


@pytest.mark.newest
@pytest.mark.parametrize("name", COLORED)
def test_colored_transparency_is_named_with_its_size(name):
    start()
    build, size = COLORED[name]
    pane(shown(build))
    warnings = [line for line in scene_parts.baked_occluders()[1] if "colored" in line]
    assert len(warnings) == (size is not None)
    for line in warnings:
        assert float(re.search(r"up to (\S+) % of the light off", line)[1]) == pytest.approx(size, abs=3.0), line


@pytest.mark.newest
@pytest.mark.parametrize(("doubled", "others", "named"), [(0.01, 2.0, ""), (2.0, 0.01, "100 % of its faces where")])
def test_doubled_faces_count_by_their_area(doubled, others, named):
    """A triangle twice among 20 others: of 5e-6 of the area nothing is said, however many faces there are."""
    start()
    sizes = np.array([doubled, doubled, *[others] * 20])
    corners = sizes[:, None, None] * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    corners[2:, :, 2] += np.arange(1.0, 21.0)[:, None] + 0.03  # in no plane of a light
    vertices, faces = corners.reshape(-1, 3).tolist(), np.arange(66).reshape(-1, 3).tolist()
    hidden(scene_parts.add_mesh("Pane", vertices, faces, location=(0.3, 0.2, 1.0)))
    warnings = scene_parts.collected_occluders()[1]
    assert len(warnings) == bool(named) and all(named in line for line in warnings), warnings


# By name: what culls a cube beside the view of +-3 m, 4.2 m from the middle and 7 m below the camera; the margins of
# camera and distance, and whether it is culled.
CULLED = {
    "seen by the margin": ("camera", (0.5, 50.0), False),
    "beyond the margin": ("camera", (0.1, 50.0), True),
    "far away": ("distance", (0.1, 3.0), True),
    "near enough": ("distance", (0.1, 9.0), False),
    "beside but near": ("camera distance", (0.1, 9.0), False),
    "beside and far away": ("camera distance", (0.1, 3.0), True),
}


@pytest.mark.newest
@pytest.mark.parametrize("name", CULLED)
def test_what_simplify_culls_has_no_shadow(name, tmp_path):
    scene, light = start(), np.array([5.5, 0.0, 3.0])
    flags, margins, is_culled = CULLED[name]
    scene.render.use_simplify = True
    scene.cycles.camera_cull_margin, scene.cycles.distance_cull_margin = margins
    bpy.data.objects["Key"].location = light
    cube((0.6, -0.4, 1.0), 0.4)
    beside = cube((4.2, 0.0, 2.0), 0.5)
    for flag in flags.split():
        setattr(scene.cycles, f"use_{flag}_cull", True)
        setattr(beside.cycles, f"use_{flag}_cull", True)
    shown = seen_by_cycles(tmp_path)
    occluders, warnings = scene_parts.collected_occluders()
    beside.hide_render = True
    assert np.array_equal(shown, seen_by_cycles(tmp_path)) == is_culled
    assert not warnings and len(occluders.mesh) == 3 - is_culled  # the floor, another cube and this one


# Hair and points:


def test_points_have_the_shadow_of_balls(tmp_path):
    start()
    cloud = hidden(scene_parts.link(bpy.data.objects.new("Points", scene_parts.point_cloud(60))))
    cloud.rotation_euler = (0.1, 0.2, 0.3)
    assert_mean_shadow(tmp_path, "balls", 0.01)


def assert_mean_shadow(folder, note, tolerance):
    """The shadow is that of Cycles but at silhouettes, which facets move both ways."""
    expected = seen_by_cycles(folder)
    occluders, warnings = scene_parts.collected_occluders()
    found, _ = seen_by_rays(occluders)
    assert len(warnings) == 1 and note in warnings[0], warnings
    assert 0.03 < 1.0 - expected.mean() < 0.6
    assert found.mean() == pytest.approx(expected.mean(), abs=tolerance)
    assert (np.abs(found - expected) > 0.5).mean() < 4.0 * tolerance
    return occluders


def test_hair_curves_have_the_shadow_of_tubes(tmp_path):
    start()
    hidden(scene_parts.link(bpy.data.objects.new("Hair", scene_parts.hair_curves(25))))
    assert_mean_shadow(tmp_path, "tubes", 0.015)


def particle_hair(count=60):
    """A ball with hair 80 cm long and 3 to 10 cm thick."""
    start()
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.3, location=(0.0, 0.0, 1.5))
    ob = hidden(bpy.context.object)
    bpy.ops.object.particle_system_add()
    settings = ob.particle_systems[0].settings
    settings.type, settings.count, settings.hair_length, settings.render_step = "HAIR", count, 0.8, 3
    settings.root_radius, settings.tip_radius, settings.radius_scale = 1.0, 0.3, 0.1
    ob.location.x = 0.2
    return settings


@pytest.mark.parametrize("kind", ["plain", "children", "spiral", "spiral children"])
def test_hair_of_particles_has_the_shadow_of_tubes(tmp_path, kind):
    """Children hide their parents; spirals have points of their own."""
    settings = particle_hair(20 if "children" in kind else 60)
    if "children" in kind:
        settings.child_type, settings.rendered_child_count = "SIMPLE", 3
        settings.child_radius = 0.4
    if "spiral" in kind:
        settings.kink, settings.kink_extra_steps, settings.kink_amplitude = "SPIRAL", 12, 0.1
    assert_mean_shadow(tmp_path, "tubes", 0.015)


@pytest.mark.parametrize("steps", [1, 12])
def test_spirals_end_where_their_last_turn_does(steps):
    """The point after it is the world's origin, or no number at all."""
    settings = particle_hair(20)
    settings.child_type, settings.rendered_child_count = "SIMPLE", 3
    settings.kink, settings.kink_extra_steps, settings.kink_amplitude = "SPIRAL", steps, 0.1
    tubes = max(scene_parts.collected_occluders()[0].meshes, key=lambda mesh: len(mesh.triangles))
    points = tubes.vertices.reshape(60, 8 + steps, 3, 3).mean(axis=2)
    assert np.linalg.norm(np.diff(points, axis=1), axis=-1).max() < 0.2  # a hair of 80 cm has 8 pieces before them


@pytest.mark.newest
@pytest.mark.parametrize("percentage", [100, 50])
def test_hair_of_particles_ends_where_views_show_its_end(percentage):
    """What a view does not know of a hair would be at the world's origin."""
    settings = particle_hair()
    settings.child_type, settings.child_percent, settings.display_percentage = "SIMPLE", 2, percentage
    settings.display_step = 2
    graph = bpy.context.evaluated_depsgraph_get()
    assert graph.mode == "VIEWPORT"
    tubes = max(view_occluders(graph, lambda *_: None).meshes, key=lambda mesh: len(mesh.triangles))
    points = tubes.vertices.reshape(-1, 5, 3, 3).mean(axis=2)
    assert len(points) == 120 * percentage // 100
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1)
    assert lengths == pytest.approx(0.8, rel=0.05)


# Lights:


def two_lights(key_blockers=None, fill_blockers=None):
    """Two lights and two cubes; a light's blockers are {name of a cube: "INCLUDE" or "EXCLUDE"}."""
    start()
    fill = add_light("Fill", (-1.0, -0.8, 4.0))
    cube((-0.8, 0.0, 1.0), 0.7).name, cube((0.8, 0.0, 1.0), 0.7).name = "A", "B"
    for light, blockers in ((bpy.data.objects["Key"], key_blockers), (fill, fill_blockers)):
        if blockers is None:
            continue
        collection = bpy.data.collections.new(f"Blockers of {light.name}")
        for name, state in blockers.items():
            collection.objects.link(bpy.data.objects[name])
            collection.collection_objects[-1].light_linking.link_state = state
        light.light_linking.blocker_collection = collection


LINKED = {
    "neither": (None, None),
    "included": ({"A": "INCLUDE"}, None),
    "excluded": ({"A": "EXCLUDE"}, {"B": "EXCLUDE"}),
    "both kinds": ({"A": "INCLUDE", "B": "EXCLUDE"}, {"B": "INCLUDE"}),
}


@pytest.mark.parametrize("name", LINKED)
def test_blockers_of_lights_are_those_of_cycles(tmp_path, name):
    two_lights(*LINKED[name])
    places = {"Key": LIGHT, "Fill": np.array([-1.0, -0.8, 4.0])}
    for light in places:
        other = next(ob for ob in places if ob != light)
        bpy.data.objects[other].hide_render = True
        expected = seen_by_cycles(tmp_path, places[light])
        bpy.data.objects[other].hide_render = False
        occluders, warnings = scene_parts.collected_occluders()
        found, is_sure = seen_by_rays(occluders, places[light], light)
        assert warnings == [] and found.min() == 0.0
        assert (np.abs(found - expected)[is_sure] > 0.01).sum() <= 2


def test_more_sets_of_blockers_than_a_mask_has_bits_are_named():
    start()
    cube().name = "A"
    for number in range(33):
        light = add_light(f"Light {number:02}", LIGHT)
        collection = bpy.data.collections.new(light.name)
        collection.objects.link(bpy.data.objects["A" if number % 2 else "Floor"])
        light.light_linking.blocker_collection = collection
    occluders, warnings = scene_parts.collected_occluders()
    assert len(set(occluders.light_masks.values())) == 31
    assert seen_by_rays(occluders, name="Light 29")[0].min() == 0.0
    assert seen_by_rays(occluders, name="Light 30")[0].min() == 1.0
    assert seen_by_rays(occluders, name="Light 32")[0].min() == 0.0  # as without a collection
    assert len(warnings) == 1 and "'Light 31', 'Light 32'" in warnings[0]


@pytest.mark.parametrize("shadow, is_met", [(False, False), (False, True), (True, False)])
def test_which_rays_go_to_a_light_is_told(shadow, is_met):
    start()
    cube()
    key = bpy.data.objects["Key"].data
    key.use_shadow, key.cycles.use_multiple_importance_sampling = shadow, is_met
    occluders, warnings = scene_parts.collected_occluders()
    chosen = occluders.chosen_by("Key")
    assert warnings == [] and (occluders.mask_of("Key") == 0) == (not shadow and not is_met)
    if shadow or is_met:
        assert (chosen.light, chosen.surface) == (shadow, is_met)


def test_the_scene_is_left_as_it_was(tmp_path):
    start()
    pane(shown(alpha_image))
    text()
    before = [(block.name_full, block.users) for block in (*bpy.data.objects, *bpy.data.meshes, *bpy.data.materials)]
    occluders, _ = scene_parts.collected_occluders()
    occluders.save(tmp_path / "occluders.npz")
    after = [(block.name_full, block.users) for block in (*bpy.data.objects, *bpy.data.meshes, *bpy.data.materials)]
    assert before == after
    assert np.array_equal(seen_by_rays(Occluders.load(tmp_path / "occluders.npz"))[0], seen_by_rays(occluders)[0])
