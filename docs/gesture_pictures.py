"""Makes docs/gestures.png: a scene, and what four gestures make of it.

python docs/gesture_pictures.py        with pip's bpy; needs matplotlib
"""

import subprocess
import sys
from pathlib import Path

import bpy
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from mathutils import Vector

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.blender.lights.textures import ShownTextures  # noqa: E402
from ltsh_addon.blender.ui.highlight_place import hits_around, place_of  # noqa: E402
from ltsh_addon.blender.ui.light_pose import LightPose, power_for  # noqa: E402
from ltsh_addon.blender.ui.lit_point import surface_hit  # noqa: E402
from ltsh_addon.blender.ui.shadow_edge import OccluderRays, shadow_edge_near  # noqa: E402

matplotlib.use("Agg")
WIDTH, HEIGHT, EXPOSURE = 420, 320, 0.9
OUT = ROOT / "out" / "gesture_pictures"
# Pixels, from the lower left: the highlight on the ball, the edge of the ball's shadow, and places on the floor.
HIGHLIGHT, SHADOW, BRIGHTER = ((150, 204), (206, 196)), ((318, 108), (352, 76)), ((90, 60), (90, 120))
AIM = (190, 130), (90, 60)


def scene() -> bpy.types.Object:
    """A ball on a floor under a lamp, and a weak light from the other side; the lamp."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for name, color, roughness in (("Floor", (0.5, 0.5, 0.5, 1.0), 0.5), ("Ball", (0.7, 0.12, 0.06, 1.0), 0.25)):
        if name == "Floor":
            bpy.ops.mesh.primitive_plane_add(size=30.0)
        else:
            bpy.ops.mesh.primitive_uv_sphere_add(segments=128, ring_count=64, radius=0.8, location=(0.0, 0.0, 0.8))
            bpy.ops.object.shade_smooth()
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        inputs = material.node_tree.nodes["Principled BSDF"].inputs
        inputs["Base Color"].default_value, inputs["Roughness"].default_value = color, roughness
        bpy.context.object.data.materials.append(material)
    lights = []
    for name, location, power in (("Lamp", (-2.2, -1.6, 3.0), 120.0), ("Fill", (3.0, -4.0, 3.0), 25.0)):
        lights.append(bpy.data.objects.new(name, bpy.data.lights.new(name, "AREA")))
        lights[-1].location, lights[-1].data.energy, lights[-1].data.size = location, power, 0.4
        lights[-1].rotation_euler = (Vector(location) - Vector((0.0, 0.0, 0.5))).to_track_quat("Z", "Y").to_euler()
        bpy.context.collection.objects.link(lights[-1])
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.6, -6.0, 3.0)
    camera.rotation_euler = (camera.location - Vector((0.3, 0.0, 0.55))).to_track_quat("Z", "Y").to_euler()
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = WIDTH, HEIGHT
    bpy.context.view_layer.update()
    return lights[0]


def hit(pixel):
    """What the camera shows at a pixel."""
    camera = bpy.context.scene.camera
    corners = [camera.matrix_world @ corner for corner in camera.data.view_frame(scene=bpy.context.scene)]
    right, up = corners[0] - corners[3], corners[0] - corners[1]
    point = corners[2] + float(pixel[0]) / WIDTH * right + float(pixel[1]) / HEIGHT * up
    start = camera.matrix_world.translation.copy()
    return surface_hit(bpy.context.scene, bpy.context.evaluated_depsgraph_get(), start, (point - start).normalized())


def picture(name: str) -> np.ndarray:
    """The open scene as LTSH shades it."""
    path = OUT / f"{name}.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    command = [sys.executable, "-m", "ltsh_addon", "shade", str(path), "-o", str(OUT / name), "--aa", "4", "--quiet"]
    subprocess.run([*command, "--overwrite"], cwd=ROOT, check=True)
    return imaging.to_srgb8(EXPOSURE * imaging.read_layers(OUT / name / "shade.exr")["ltsh4c.combined"][..., :3])


def main() -> None:
    """Write the picture."""
    OUT.mkdir(parents=True, exist_ok=True)
    lamp = scene()
    pictures = {"Before": (picture("before"), None)}
    pose = LightPose.of(lamp)
    around = hits_around(lambda offsets: [hit(HIGHLIGHT[1] + offset) for offset in offsets])
    distance = (pose.matrix.translation - around.hits[0].position).length
    matrix, note = place_of(lamp, pose, around, distance, ShownTextures())
    print("highlight:", note or "at the mouse")
    pose.put(lamp, matrix)
    pictures["Drag Highlight"] = picture("highlight"), HIGHLIGHT
    pose.put_back(lamp)
    bpy.context.view_layer.update()
    rays = OccluderRays(bpy.context.scene, bpy.context.evaluated_depsgraph_get(), lamp)
    edge, note = shadow_edge_near(rays, lambda offset: hit(np.array(SHADOW[0]) + offset), pose.matrix, "AREA", 24.0)
    place, more = edge.light_for(rays, hit(SHADOW[1]))
    print("shadow:", note or more or "at the mouse")
    pose.put(lamp, pose.facing(*place))
    pictures["Drag Shadow"] = picture("shadow"), SHADOW
    pose.put_back(lamp)
    aim = hit(AIM[1]).position
    way = pose.matrix.translation - aim
    pose.put(lamp, pose.facing(aim, way.normalized(), way.length))
    pictures["Aim Light"] = picture("aim"), AIM
    pose.put_back(lamp)
    lamp.data.energy = power_for(2.0 ** ((BRIGHTER[1][1] - BRIGHTER[0][1]) / 100.0), lamp.data.energy, 0.9)
    pictures["Drag Brightness"] = picture("brightness"), BRIGHTER
    figure, axes = plt.subplots(1, 5, figsize=(17.0, 2.9), constrained_layout=True)
    for axis, (title, (image, drag)) in zip(axes, pictures.items(), strict=True):
        axis.imshow(image)
        axis.set_title(title)
        axis.axis("off")
        if drag is not None:
            start, end = ((x, HEIGHT - y) for x, y in drag)
            arrow = {"arrowstyle": "->", "color": "#ffd000", "lw": 2.0, "shrinkA": 0.0, "shrinkB": 0.0}
            axis.annotate("", xy=end, xytext=start, arrowprops=arrow)
    figure.savefig(ROOT / "docs" / "gestures.png", dpi=100)


if __name__ == "__main__":
    main()
