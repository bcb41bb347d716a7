"""Operators that mend what stands in the way of a job, each one undo step."""

from __future__ import annotations

import math

import bpy
from bpy.props import StringProperty


class LTSH_OT_add_camera(bpy.types.Operator):
    """Add a camera that looks as the 3D viewport does, and make it the scene's active camera"""

    bl_idname = "ltsh.add_camera"
    bl_label = "Add Camera"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        context.collection.objects.link(camera)
        context.scene.camera = camera
        view = _viewport(context)
        if view is not None:
            camera.matrix_world = view.view_matrix.inverted()
        else:
            camera.location, camera.rotation_euler = (0.0, -6.0, 3.0), (math.radians(65.0), 0.0, 0.0)
        return {"FINISHED"}


class LTSH_OT_make_perspective(bpy.types.Operator):
    """Make the scene's active camera a perspective one"""

    bl_idname = "ltsh.make_perspective"
    bl_label = "Make Perspective"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return context.scene.camera is not None and context.scene.camera.type == "CAMERA"

    def execute(self, context):
        data = context.scene.camera.data
        if data.library is not None:
            self.report({"ERROR"}, f"Camera {data.name!r} is linked from {data.library.filepath}: make it local")
            return {"CANCELLED"}
        data.type = "PERSP"
        return {"FINISHED"}


class LTSH_OT_add_area_light(bpy.types.Operator):
    """Add an area light above the origin that shines down"""

    bl_idname = "ltsh.add_area_light"
    bl_label = "Add Area Light"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        light = bpy.data.lights.new("Area", "AREA")
        light.shape, light.size, light.size_y, light.energy = "RECTANGLE", 2.0, 1.0, 200.0
        ob = bpy.data.objects.new("Area", light)
        context.collection.objects.link(ob)
        ob.location = (0.0, 0.0, 4.0)
        return {"FINISHED"}


class LTSH_OT_show_in_render(bpy.types.Operator):
    """Show the object in renders"""

    bl_idname = "ltsh.show_in_render"
    bl_label = "Show in Renders"
    bl_options = {"REGISTER", "UNDO"}

    object_name: StringProperty(name="Object", description="Name of the object")

    def execute(self, context):
        ob = context.scene.objects.get(self.object_name)
        if ob is None:
            self.report({"ERROR"}, f"Object {self.object_name!r} is not in the scene any more")
            return {"CANCELLED"}
        ob.hide_render = False
        return {"FINISHED"}


class LTSH_OT_add_uv_map(bpy.types.Operator):
    """Unwrap the object into a new UV map (Smart UV Project)"""

    bl_idname = "ltsh.add_uv_map"
    bl_label = "Unwrap"
    bl_options = {"REGISTER", "UNDO"}

    object_name: StringProperty(name="Object", description="Name of the object")

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT"

    def execute(self, context):
        ob = context.view_layer.objects.get(self.object_name)
        if ob is None or ob.type != "MESH" or ob.hide_get():
            self.report({"ERROR"}, f"Object {self.object_name!r} is not a visible mesh of this view layer")
            return {"CANCELLED"}
        selected, active = context.selected_objects, context.view_layer.objects.active
        try:
            for other in selected:
                other.select_set(False)
            ob.select_set(True)
            context.view_layer.objects.active = ob
            bpy.ops.object.mode_set(mode="EDIT")
            bpy.ops.mesh.select_all(action="SELECT")
            bpy.ops.uv.smart_project(island_margin=0.02)
        finally:
            if ob.mode == "EDIT":
                bpy.ops.object.mode_set(mode="OBJECT")
            ob.select_set(False)
            for other in selected:
                other.select_set(True)
            context.view_layer.objects.active = active
        return {"FINISHED"}


class LTSH_OT_pack_image(bpy.types.Operator):
    """Keep the changes of the image in the .blend"""

    bl_idname = "ltsh.pack_image"
    bl_label = "Pack Image"
    bl_options = {"REGISTER", "UNDO"}

    image_name: StringProperty(name="Image", description="Name of the image")

    def execute(self, context):
        image = bpy.data.images.get(self.image_name)
        if image is None:
            self.report({"ERROR"}, f"Image {self.image_name!r} is not there any more")
            return {"CANCELLED"}
        image.pack()
        return {"FINISHED"}


def _viewport(context):
    """The view of some 3D viewport of the window, None where there is none."""
    screen = context.screen or (context.window.screen if context.window else None)
    for area in screen.areas if screen is not None else ():
        if area.type == "VIEW_3D":
            return area.spaces.active.region_3d
    return None


CLASSES = (
    LTSH_OT_add_camera,
    LTSH_OT_make_perspective,
    LTSH_OT_add_area_light,
    LTSH_OT_show_in_render,
    LTSH_OT_add_uv_map,
    LTSH_OT_pack_image,
)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
