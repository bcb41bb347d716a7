"""What of a scene the viewport shows at all: what cameras see, holdouts, what glows."""

import bpy
import numpy as np
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from lit_plane import add_instancer, into_collection
from view_pictures import SIZE, OpenView, away_from_edges, patches_of, sampled_pictures, times_too_far, viewport_picture

from ltsh_addon.blender.viewport.mirror import object_notes


def chalk():
    return parts.bsdf_material("ShaderNodeBsdfDiffuse", "Chalk", Color=(0.2, 0.5, 0.8, 1.0))[0]


@edits_with_graphics
def test_what_cameras_do_not_see_is_not_shown(tmp_path):
    _, camera = patches_of([chalk] * 4)
    planes = [ob for ob in bpy.data.objects if ob.type == "MESH"]
    planes[0].visible_camera = False
    inside = into_collection("Inside", parts.add_plane(chalk(), location=(1.5, 0.5, 0.2), name="Inside"))
    add_instancer(inside).visible_camera = False
    # What lies behind a holdout is not seen either.
    planes[2].is_holdout = True
    parts.add_plane(chalk(), size=8.0, location=(0.0, 0.0, -0.3))
    bpy.context.view_layer.update()
    ((picture, notes),) = with_graphics(lambda: [viewport_picture(camera, "diffuse")])
    expected, square = sampled_pictures(tmp_path / "hidden.blend", ("diffuse",), 1)
    assert notes == ["Plane.002: the holdout shows the world in views, renders show black"]
    hidden = expected["diffuse"].max(axis=-1) == 0.0
    assert hidden.sum() > 100 and not hidden.all()
    same = (times_too_far(picture, expected["diffuse"]) < 1.0).all(axis=-1)
    assert same[away_from_edges(np.where(hidden, 99, square))].all()

    def with_rest():
        with OpenView(camera) as opened:
            return [opened.mirror.notes_with_rest(is_everything) for is_everything in (False, True)]

    # With bounces too, but where all of the picture is Cycles'.
    assert with_graphics(with_rest) == [notes, []]
    bpy.context.scene.render.film_transparent = True
    bpy.context.view_layer.update()
    assert with_graphics(lambda: [viewport_picture(camera, "diffuse")])[0][1] == []


@edits_with_graphics
def test_points_are_balls_also_where_nodes_make_them(tmp_path):
    _, camera = patches_of([chalk] * 4)
    cloud = parts.link(bpy.data.objects.new("Cloud", parts.point_cloud(6)))
    cloud.data.materials.append(chalk())
    cloud.scale, cloud.location = (1.5, 1.5, 1.5), (0.0, 0.0, -1.0)
    nodes = bpy.data.node_groups.new("Points", "GeometryNodeTree")
    nodes.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    made, painted, end = (
        nodes.nodes.new(kind) for kind in ("GeometryNodePoints", "GeometryNodeSetMaterial", "NodeGroupOutput")
    )
    made.inputs["Count"].default_value, made.inputs["Radius"].default_value = 1, 0.5
    made.inputs["Position"].default_value, painted.inputs["Material"].default_value = (1.0, 0.0, 0.5), chalk()
    nodes.links.new(made.outputs[0], painted.inputs[0])
    nodes.links.new(painted.outputs[0], end.inputs[0])
    bpy.data.objects["Plane"].modifiers.new("Points", "NODES").node_group = nodes
    bpy.context.view_layer.update()
    ((picture, notes),) = with_graphics(lambda: [viewport_picture(camera, "diffuse")])
    expected = sampled_pictures(tmp_path / "points.blend", ("diffuse",), 1)[0]["diffuse"]
    assert notes == []
    lit, shown = (one.max(axis=-1) > 0.0 for one in (expected, picture))
    # Balls of 1,280 flat faces reach up to .5 % of their radius less far, and shade by the normals of spheres.
    assert (lit != shown).sum() < 0.01 * lit.sum()
    far = np.abs(picture - expected).max(axis=-1) > 0.1 * expected.mean()
    assert far.sum() < 0.03 * lit.sum()


@edits_with_graphics
def test_what_does_nothing_is_seen_through():
    _, camera = patches_of([chalk] * 4)
    ((expected, _),) = with_graphics(lambda: [viewport_picture(camera, "combined")])
    for number, kind in enumerate(("BsdfTransparent", "VolumePrincipled")):
        material, tree, output = parts.new_material("Air")
        tree.links.new(tree.nodes.new(f"ShaderNode{kind}").outputs[0], output.inputs["Volume" if number else "Surface"])
        parts.add_plane(material, size=8.0, location=(0.0, 0.0, 0.3 + 0.1 * number), name="Air")
    bpy.context.view_layer.update()
    ((picture, _),) = with_graphics(lambda: [viewport_picture(camera, "combined")])
    assert expected.any() and np.array_equal(picture, expected)


@edits_with_graphics
def test_what_glows_is_as_bright_as_it_is_and_hidden_by_what_is_nearer():
    glow = (0.2, 0.4, 0.9)

    def lamp():
        return parts.bsdf_material("ShaderNodeEmission", "Lamp", Strength=3.0, Color=(*glow, 1.0))[0]

    def lit():
        return parts.principled("Lit", Emission_Strength=0.5, Emission_Color=(*glow, 1.0))[0]

    _, camera = patches_of([lamp, lit, lamp, lamp])
    # Seen from behind the third shines too; the fourth lies below another square.
    bpy.data.objects["Plane.002"].rotation_euler.x = np.pi
    parts.add_plane(chalk(), size=1.0, location=(1.5, 0.0, 0.05), name="Cover")
    bpy.context.view_layer.update()
    shown = ("combined", "specular", "diffuse")
    pictures = with_graphics(lambda: [viewport_picture(camera, name)[0] for name in shown])
    emitted = pictures[0] - pictures[1] - pictures[2]
    matrix = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=SIZE[0], y=SIZE[1])
    matrix = np.array(matrix @ camera.matrix_world.inverted())
    for column, strength in enumerate((3.0, 0.5, 3.0, 0.0)):
        place = matrix @ [column - 1.5, 0.0, 0.0, 1.0]
        x, y = (0.5 + 0.5 * place[:2] / place[3]) * SIZE
        np.testing.assert_allclose(emitted[SIZE[1] - 1 - int(y), int(x)], strength * np.array(glow), atol=1e-5)


def test_metaballs_that_a_view_misses_are_named():
    """Balls at random places: Blender makes no face of those that its steps pass by."""
    random, missing, silent = np.random.default_rng(4), 0, 0
    for _ in range(40):
        parts.empty_scene()
        balls = bpy.data.metaballs.new("Balls")
        balls.resolution, balls.render_resolution, balls.threshold = (
            random.uniform(0.1, 1.0),
            0.05,
            random.uniform(0.2, 1),
        )
        ball = balls.elements.new()
        ball.co, ball.radius, ball.stiffness = random.uniform(-1.0, 1.0, 3), random.uniform(0.2, 1.5), 2.0
        parts.link(bpy.data.objects.new("Balls", balls))
        bpy.context.view_layer.update()
        graph = bpy.context.evaluated_depsgraph_get()
        faces = sum(len(one.object.to_mesh().polygons) for one in graph.object_instances if one.object.type == "MESH")
        notes = object_notes(graph, {})
        missing += faces == 0
        silent += not notes
        assert faces or "Balls: balls smaller" in notes[0]
        balls.render_resolution = balls.resolution
        bpy.context.view_layer.update()
        assert not object_notes(bpy.context.evaluated_depsgraph_get(), {})  # renders miss it too
    assert missing > 4 and silent > 4
