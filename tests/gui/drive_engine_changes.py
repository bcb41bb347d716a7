"""The engine LTSH while the scene changes under it: other cameras, deleting and undo, edit mode, removed images,
two windows, another scene, another file.

To be opened with the example scene.
"""

import bpy
import eyes
import numpy as np
from bpy_extras import view3d_utils
from hands import close_window, comes, file_copy, operate, select, typed

SECONDS = 1800
EXPOSURE = -1.5


def main(rig):
    scene = bpy.context.scene
    scene.ltsh_view.technique, scene.ltsh.anti_aliasing = "ltsh4", 1
    yield from eyes.engine_started(rig)
    eyes.bare_view(rig)
    eyes.plain_colors(scene, EXPOSURE)
    # The view has none.
    scene.ltsh.shadows = False
    yield from cameras(rig)
    whole = yield from eyes.settled(rig, "changes_2_whole.png")
    yield from deleted_and_undone(rig, whole)
    yield from edited(rig, whole)
    yield from removed_image(rig)
    yield from two_windows(rig)
    yield from another_scene(rig)
    yield from another_file(rig)


def cameras(rig):
    """The view through a shifted and an orthographic lens is the final render of the same camera."""
    scene = bpy.context.scene
    camera, size = scene.camera, (scene.render.resolution_x, scene.render.resolution_y)
    shift, kind = camera.data.shift_x, camera.data.type
    for name, values in {
        "shifted": {"shift_x": 0.2, "shift_y": -0.1},
        "orthographic": {"type": "ORTHO", "ortho_scale": 6.0},
    }.items():
        for key, value in values.items():
            setattr(camera.data, key, value)
        rig.camera_view()
        seen = yield from eyes.settled(rig, f"changes_1_{name}.png")
        scene.camera = eyes.camera_like_view(rig, f"Like the view, {name}")
        found = yield from eyes.final_render(rig)
        rig.xdo("key", "Escape")
        yield 2
        scene.camera = camera
        scene.render.resolution_x, scene.render.resolution_y = size
        picture = found["LTSH Specular"] + found["LTSH Diffuse"]
        eyes.check_against_numpy(rig, name, seen, picture, EXPOSURE, frame_of_camera(rig))
    camera.data.shift_x, camera.data.shift_y, camera.data.type = shift, 0.0, kind
    eyes.free_view(rig, camera)


def frame_of_camera(rig):
    """Pixels (H, W) of the view inside the camera's frame: outside Blender draws it darker."""
    region, data = rig.region(), rig.space.region_3d
    corners = bpy.context.scene.camera.data.view_frame(scene=bpy.context.scene)
    matrix = np.array(data.perspective_matrix) @ np.array(bpy.context.scene.camera.matrix_world)
    at = np.array([[*corner, 1.0] for corner in corners]) @ matrix.T
    at = (at[:, :2] / at[:, 3:] * 0.5 + 0.5) * (region.width, region.height)
    (left, low), (right, high) = at.min(axis=0) + 2.0, at.max(axis=0) - 2.0
    x, y = np.arange(region.width) + 0.5, region.height - np.arange(region.height) - 0.5
    return eyes.inside(((x > left) & (x < right))[None, :] & ((y > low) & (y < high))[:, None])


def deleted_and_undone(rig, whole):
    """By the keyboard: what is deleted is gone, what is undone is back."""
    target = biggest_object_in_view(rig)
    select(rig, target)
    operate(rig, bpy.ops.ed.undo_push, message="Selected")
    name = target.name
    yield from typed(rig, "Delete")
    yield from comes(rig, lambda: name not in bpy.data.objects, f"Delete removes {name}")
    yield from eyes.differs(rig, "changes_3_deleted.png", whole, "and the view no longer shows it")
    yield from typed(rig, "ctrl+z")
    yield from comes(rig, lambda: name in bpy.data.objects, "Ctrl Z brings it back")
    yield from eyes.same_again(rig, "changes_3_undone.png", whole, "and the picture is what it was")


def biggest_object_in_view(rig):
    """The mesh object, no glowing one, on most of some rays through the view."""
    region, data, count = rig.region(), rig.space.region_3d, {}
    graph = bpy.context.evaluated_depsgraph_get()
    for x in np.linspace(0.3, 0.7, 9):
        for y in np.linspace(0.2, 0.6, 9):
            point = x * region.width, y * region.height
            start = view3d_utils.region_2d_to_origin_3d(region, data, point)
            hit = bpy.context.scene.ray_cast(graph, start, view3d_utils.region_2d_to_vector_3d(region, data, point))
            if hit[0]:
                count[hit[4].original] = count.get(hit[4].original, 0) + 1
    return max(count, key=count.get)


def edited(rig, whole):
    """Edit mode, a modifier, a new object and a glowing one change the picture and give it back."""
    target = biggest_object_in_view(rig)
    with rig.override():
        bpy.context.view_layer.objects.active = target
        target.select_set(True)
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
    yield from eyes.settled(rig, "changes_4_edit_mode.png")
    operate(rig, bpy.ops.transform.translate, value=(0.0, 0.0, 0.3))
    yield from eyes.differs(rig, "changes_4_edited.png", whole, "vertices moved in edit mode are seen at once")
    with rig.override():
        bpy.ops.transform.translate(value=(0.0, 0.0, -0.3))
        bpy.ops.object.mode_set(mode="OBJECT")
    modifier = target.modifiers.new("Displace", "DISPLACE")
    modifier.strength, modifier.mid_level = 0.3, 0.0
    yield from eyes.differs(rig, "changes_4_modifier.png", whole, "a modifier is seen at once")
    target.modifiers.remove(modifier)
    before = yield from eyes.settled(rig, "changes_4_back.png")
    error = eyes.relative_l2(before, whole, np.ones(whole.shape[:2], bool))
    rig.check(error < eyes.AGREEMENT, f"all taken back the picture is what it was: {error:.5f}")
    operate(rig, bpy.ops.mesh.primitive_plane_add, size=0.5, location=target.matrix_world.translation)
    plane = bpy.context.view_layer.objects.active
    plane.location.z += 1.0
    material, nodes, output = new_material("Glow", "ShaderNodeOutputMaterial")
    glow = nodes.new("ShaderNodeEmission")
    glow.inputs["Strength"].default_value = 30.0
    material.node_tree.links.new(glow.outputs[0], output.inputs[0])
    plane.data.materials.append(material)
    lit = yield from eyes.settled(rig, "changes_4_glow.png")
    rig.check(lit.mean() > before.mean() + 1e-3, "a glowing plane lights its surroundings")
    bpy.data.objects.remove(plane)
    bpy.data.materials.remove(material)
    yield from eyes.same_again(rig, "changes_4_no_glow.png", before, "removed, it lights nothing")


def new_material(name, kind):
    """A material with nodes: the material, its nodes, and the first node of that kind."""
    material = bpy.data.materials.new(name)
    if not material.node_tree:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    return material, nodes, next(node for node in nodes if node.bl_idname == kind)


def removed_image(rig):
    """An image that a material shows is removed from the file while it is seen."""
    image = bpy.data.images.new("Checks", 8, 8, alpha=False, float_buffer=True)
    checks = np.indices((8, 8)).sum(axis=0) % 2
    image.pixels.foreach_set(np.repeat(checks.astype(np.float32).ravel(), 4))
    image.update()
    target = biggest_object_in_view(rig)
    material, nodes, shader = new_material("Checked", "ShaderNodeBsdfPrincipled")
    slot = target.material_slots[0]
    former, slot.material = slot.material, material
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    material.node_tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    shown = yield from eyes.settled(rig, "changes_5_image.png")
    image.pixels.foreach_set(np.repeat(1.0 - checks.astype(np.float32).ravel(), 4))
    image.update_tag()
    painted = yield from eyes.settled(rig, "changes_5_painted.png")
    rig.check(np.abs(painted - shown).max() > 0.02, "what is painted on an image is seen at once")
    bpy.data.images.remove(image)
    gone = yield from eyes.settled(rig, "changes_5_removed.png")
    rig.check(gone.std() > 0.02, "without the image there is still a picture")
    slot.material = former
    bpy.data.materials.remove(material)


def two_windows(rig):
    """A light that moves is seen in both windows, and closing one leaves the other as it is."""
    operate(rig, bpy.ops.screen.area_dupli, "INVOKE_DEFAULT")
    yield 4
    windows = bpy.context.window_manager.windows
    rig.check(len(windows) == 2, "there are two windows")
    second = windows[-1]
    area = next(area for area in second.screen.areas if area.type == "VIEW_3D")
    # Blender lets no second view begin with Rendered shading.
    area.spaces.active.shading.type = "RENDERED"
    yield 6
    rig.shot("changes_6_two_windows.png")
    light = bpy.data.objects["Neon"]
    before = light.data.energy
    light.data.energy = 20.0 * before
    yield 6
    rig.shot("changes_6_brighter.png")
    close_window(second)
    yield 2
    brighter = yield from eyes.settled(rig, "changes_6_one_window.png")
    light.data.energy = before
    darker = yield from eyes.settled(rig, "changes_6_back.png")
    rig.check(brighter.mean() > darker.mean() + 1e-3, "after a window is closed the other follows the lights")


def another_scene(rig):
    """The window shows another scene, which is removed while it is seen."""
    former = bpy.context.scene
    before = eyes.view_pixels(rig, "changes_7_before.png")
    empty = bpy.data.scenes.new("Empty")
    empty.render.engine = "LTSH"
    eyes.plain_colors(empty, EXPOSURE)
    bpy.context.window.scene = empty
    pixels = yield from eyes.settled(rig, "changes_7_empty.png")
    rig.check(pixels.std() < 0.1 and np.abs(pixels - before).mean() > 1e-3, "the empty scene shows no surfaces")
    bpy.data.scenes.remove(empty)
    rig.check(bpy.context.window.scene == former, "Blender goes back to the first one")
    yield from eyes.same_again(rig, "changes_7_back.png", before, "whose picture is what it was")


def another_file(rig):
    """A file is opened, and a new one begun, while the engine draws."""
    other = file_copy()
    before = eyes.view_pixels(rig, "changes_8_before.png")
    for number in (1, 2):
        bpy.ops.wm.open_mainfile(filepath=other)
        yield 2
        rig.space.shading.type = "RENDERED"
        what = f"opened, the file shows the same picture ({number})"
        yield from eyes.same_again(rig, f"changes_8_opened_{number}.png", before, what)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield 2
    rig.check(bpy.context.scene.render.engine != "LTSH", "a new file has its own engine")
