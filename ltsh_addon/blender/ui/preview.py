"""What buttons do to 3D views: show the scene with our engine, and place lights in it.

Files are saved with the artist's engine and viewport shading, so that they open and render elsewhere as before. Undo
and redo leave the preview as it is: it is no change of the scene.
"""

import math

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty
from bpy_extras import view3d_utils
from bpy_extras.io_utils import ImportHelper
from mathutils import Vector

from ...scene import error_line
from ..materials import graph
from ..saving import keeps_engine
from ..viewport.second_blender import end_spare

ENGINE = "LTSH"


class LTSHOperator:
    """What our operators share: Blender knows `LTSH_OT_bake` as "ltsh.bake", and `reason_against` grays its button."""

    NEEDS_OBJECT_MODE = False

    def __init_subclass__(cls):
        super().__init_subclass__()
        cls.bl_idname = cls.__name__.lower().replace("_ot_", ".")

    @classmethod
    def poll(cls, context):
        if reason := cls.reason_against(context):
            cls.poll_message_set(reason)
        return not reason

    @classmethod
    def reason_against(cls, context) -> str:
        """Why it cannot begin; "" if it can."""
        if context.scene is None:
            return "There is no scene"
        return "Only in Object Mode" if cls.NEEDS_OBJECT_MODE and context.mode != "OBJECT" else ""


def is_previewing(scene) -> bool:
    """True while `scene` has our engine for a preview."""
    return scene.render.engine == ENGINE and bool(scene.ltsh_view.artist_engine)


class LTSH_OT_preview(LTSHOperator, bpy.types.Operator):
    """Show the scene in this view with LTSH; once more: give the former engine and shading back"""

    bl_label = "Preview with LTSH"

    def execute(self, context):
        scene = context.scene
        if is_previewing(scene):
            stop_preview(scene)
            return {"FINISHED"}
        space = view_of(context)
        if scene.render.engine != ENGINE:
            _former_shading[scene.session_uid] = {view.as_pointer(): view.shading.type for view in _views_of(scene)}
            _former_shading[scene.session_uid][None] = "SOLID" if space is None else space.shading.type
            start_preview(scene)
        if space is not None:
            space.shading.type = "RENDERED"
        return {"FINISHED"}


# By the session_uid of a scene with a preview: the shading that views had before it, by their address, and under None
# the one for views that are opened meanwhile. Only in memory, since files are saved without previews.
_former_shading: dict[int, dict] = {}


def view_of(context):
    """The 3D view of `context`, or the window's first one."""
    space = context.space_data
    if space is None or space.type != "VIEW_3D":
        screen = context.screen or (context.window.screen if context.window else None)
        areas = screen.areas if screen is not None else ()
        space = next((area.spaces.active for area in areas if area.type == "VIEW_3D"), None)
    return space


def _views_of(scene) -> list:
    """All 3D views, but for those of windows that show another scene."""
    elsewhere = {window.screen for window in bpy.context.window_manager.windows if window.scene != scene}
    areas = [area for screen in bpy.data.screens if screen not in elsewhere for area in screen.areas]
    return [space for area in areas for space in area.spaces if space.type == "VIEW_3D"]


def _give_views_back(scene) -> list:
    """Let the views that show the preview of `scene` have their former shading, and return them.

    Views whose shading was changed by hand since then stay as they are.
    """
    former, given = _former_shading.get(scene.session_uid, {}), []
    for space in _views_of(scene):
        shading = former.get(space.as_pointer(), former.get(None, "RENDERED"))
        if space.shading.type == "RENDERED" != shading:
            space.shading.type = shading
            given.append(space)
    return given


def start_preview(scene) -> None:
    """Let `scene` have our engine, and remember the artist's."""
    scene.ltsh_view.artist_engine = scene.render.engine
    scene.render.engine = ENGINE


def stop_preview(scene) -> None:
    """End the preview of `scene`: restore the artist's engine and the shading of views."""
    wanted = scene.ltsh_view.artist_engine
    scene.ltsh_view.artist_engine = ""
    _give_views_back(scene)
    _former_shading.pop(scene.session_uid, None)
    try:
        scene.render.engine = wanted
    except TypeError:
        # The former engine is not registered any more.
        scene.render.engine = "CYCLES"
    end_spare()


def lights_of(scene) -> list:
    """The light objects of `scene`, hidden ones included."""
    return [ob for ob in scene.objects if ob.type == "LIGHT"]


def active_light(context):
    """The active object, which is the chosen one in the list of lights; None if it is not a light."""
    ob = context.view_layer.objects.active
    return ob if ob is not None and ob.type == "LIGHT" else None


def select_alone(context, ob) -> None:
    """Select only this object, and make it active, if the view layer has it."""
    layer = context.view_layer
    if ob.name not in layer.objects:
        return
    if context.mode != "OBJECT" and bpy.ops.object.mode_set.poll():
        bpy.ops.object.mode_set(mode="OBJECT")
    for other in layer.objects:
        if other.select_get():
            other.select_set(False)
    ob.select_set(True)
    layer.objects.active = ob


# Of a light that is added to a surface: its distance by the width that the view shows there, its largest share of the
# free room over the surface, its size by its distance, and its power by the square of it, which makes white about 1.
DISTANCE, FREE_SHARE, LIGHT_SIZE, LIGHT_POWER = 0.35, 0.6, 0.6, 10.0
# ROLES: of lights that are placed by the view instead of the surface: degrees to the right of the eye and above the
# horizon as the point sees them, the factors of size and power of the light.
ROLES = {
    "SURFACE": ("Facing the Surface", None),
    "KEY": ("Key Light", (-45.0, 40.0, 1.0, 1.0)),
    "FILL": ("Fill Light", (50.0, 15.0, 2.0, 0.25)),
    "RIM": ("Rim Light", (155.0, 45.0, 1.0, 1.0)),
}
MOST_CROSSED = 16  # surfaces of the object itself that the way to such a light may cross
# Of events that go on meanwhile: moving the view, and jobs.
PASSED_ON = ("MIDDLE", "WHEEL", "TRACKPAD", "NDOF", "TIMER")


class LTSH_OT_add_light(LTSHOperator, bpy.types.Operator):
    """Add an area light: click a surface in a 3D view, which the light then faces"""

    bl_label = "Add Light"
    bl_options = {"REGISTER", "UNDO"}
    NEEDS_OBJECT_MODE, _light = True, None

    location: FloatVectorProperty(name="Location", description="What the light shines on", subtype="TRANSLATION")
    normal: FloatVectorProperty(name="Normal", description="From there to the light", default=(0.0, 0.0, 1.0))
    distance: FloatProperty(
        name="Distance", description="Of both; size and power follow", subtype="DISTANCE", min=1e-4, default=4.0
    )
    role: EnumProperty(
        name="Role", items=[(key, label, "") for key, (label, _) in ROLES.items()], default="SURFACE",
        description="Facing the surface; or by the view: before it on the left, beside it, behind it",
        options={"HIDDEN", "SKIP_SAVE"},
    )  # fmt: skip
    selects: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})  # the light, and nothing else

    def invoke(self, context, event):
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set("Add Light: click a surface in a 3D view    Esc: Cancel")
        context.window.cursor_modal_set("CROSSHAIR")
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """The light follows the mouse until a click."""
        if event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type.startswith(PASSED_ON):
            return {"PASS_THROUGH"}
        region, mouse = view_under(context, pointer(event))
        surface = None if region is None else surface_at(context, region, mouse, self.role)
        if surface is None:
            return {"RUNNING_MODAL"}
        self.location, self.normal, self.distance = surface
        self._put(context)
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"RUNNING_MODAL"}
        self._end(context)
        return self.execute(context)

    def execute(self, context):
        self._put(context)
        if self.selects:
            select_alone(context, self._light)
        return {"FINISHED"}

    def cancel(self, context):
        """Leave the scene as it was; also called by Blender when the window is closed."""
        self._end(context)
        if self._light is not None:
            bpy.data.lights.remove(self._light.data)

    def _end(self, context) -> None:
        context.workspace.status_text_set(None)
        context.window.cursor_modal_restore()

    def _put(self, context) -> None:
        """Put the light, which is made at first, over the surface."""
        if self._light is None:
            name = "Area" if self.role == "SURFACE" else ROLES[self.role][0]
            self._light = bpy.data.objects.new(name, bpy.data.lights.new(name, "AREA"))
            context.collection.objects.link(self._light)
            context.view_layer.update()
            view = view_of(context)
            if view is not None and view.local_view is not None:
                self._light.local_view_set(view, True)
        normal, data = Vector(self.normal).normalized(), self._light.data
        self._light.location = Vector(self.location) + self.distance * normal
        self._light.rotation_euler = normal.to_track_quat("Z", "Y").to_euler()
        *_, larger, stronger = ROLES[self.role][1] or (1.0, 1.0)
        data.size, data.energy = larger * LIGHT_SIZE * self.distance, stronger * LIGHT_POWER * self.distance**2


def add_lights_to_menu(menu, context) -> None:
    """Draw the lights by role in Blender's own menu of lights."""
    column = menu.layout.column()
    column.operator_context = "INVOKE_REGION_WIN"
    column.separator()
    for role, (label, _) in ROLES.items():
        column.operator("ltsh.add_light", text=f"LTSH {label}", icon="LIGHT_AREA").role = role


def toward_role(role: str, toward_eye: Vector) -> Vector:
    """The direction in which a point that the eye sees in the direction `toward_eye` has a light of this role."""
    degrees, height = (math.radians(angle) for angle in ROLES[role][1][:2])
    back = Vector((toward_eye.x, toward_eye.y, 0.0))
    # From right above, the light is as seen from the south.
    back = back.normalized() if back.length > 1e-3 * toward_eye.length else Vector((0.0, -1.0, 0.0))
    beside = Vector((-back.y, back.x, 0.0))
    flat = math.cos(degrees) * back + math.sin(degrees) * beside
    return math.cos(height) * flat + Vector((0.0, 0.0, math.sin(height)))


def region_under(context, x: int, y: int):
    """The region of a 3D view at a pixel of the window; None where there is none, or where a panel lies over it."""
    for area in context.window.screen.areas:
        regions = [one for one in area.regions if 0 <= x - one.x < one.width > 1 and 0 <= y - one.y < one.height > 1]
        if area.type == "VIEW_3D" and [region.type for region in regions] == ["WINDOW"]:
            return regions[0]
    return None


def pointer(event) -> np.ndarray:
    """Where the mouse is (2,) in the window."""
    return np.array([event.mouse_x, event.mouse_y], float)


def view_under(context, mouse: np.ndarray) -> tuple:
    """The region of the 3D view under the `mouse` (2,) of the window, None where there is none, and the pixel in it."""
    region = region_under(context, *mouse.tolist())
    return region, mouse if region is None else mouse - (region.x, region.y)


def surface_at(context, region, pixel, role: str = "SURFACE") -> tuple[Vector, Vector, float] | None:
    """The point of a surface at a pixel of a 3D view, the direction from there to a light of this role, by default its
    normal towards the view, and the light's distance; None where there is none."""
    scene, depsgraph, data = context.scene, context.evaluated_depsgraph_get(), region.data
    start = view3d_utils.region_2d_to_origin_3d(region, data, pixel)
    direction = view3d_utils.region_2d_to_vector_3d(region, data, pixel)
    is_hit, point, normal, _, own, _ = scene.ray_cast(depsgraph, start, direction)
    if not is_hit:
        return None
    if normal.dot(direction) > 0.0:
        normal.negate()
    ends = [view3d_utils.region_2d_to_location_3d(region, data, (end, pixel[1]), point) for end in (0, region.width)]
    distance = DISTANCE * (ends[1] - ends[0]).length
    toward = normal if role == "SURFACE" else toward_role(role, -direction)
    start = point + 1e-3 * distance * normal
    for _ in range(MOST_CROSSED):
        is_hit, other, _, _, ob, _ = scene.ray_cast(depsgraph, start, toward)
        if not is_hit or role == "SURFACE" or ob != own:
            break
        start = other + 1e-3 * distance * toward
    return point, toward, min(distance, FREE_SHARE * (other - point).length) if is_hit else distance


class OnActiveLight(LTSHOperator):
    """An operator on the active light."""

    NEEDS_OBJECT_MODE = True

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        return super().reason_against(context) or ("No light is active" if active_light(context) is None else "")


class LTSH_OT_duplicate_light(OnActiveLight, bpy.types.Operator):
    """Duplicate the active light; in a 3D view the mouse moves the copy until a click"""

    bl_label = "Duplicate Light"
    bl_options = {"REGISTER", "UNDO"}

    def invoke(self, context, event):
        if context.area.type != "VIEW_3D":
            return self.execute(context)
        select_alone(context, active_light(context))
        bpy.ops.object.duplicate_move("INVOKE_DEFAULT")
        # The step of undo is that of Blender's operator, when it ends.
        return {"CANCELLED"}

    def execute(self, context):
        select_alone(context, active_light(context))
        return bpy.ops.object.duplicate()


class LTSH_OT_delete_light(OnActiveLight, bpy.types.Operator):
    """Delete the active light"""

    bl_label = "Delete Light"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        with context.temp_override(selected_objects=[active_light(context)]):
            return bpy.ops.object.delete(confirm=False)


# Of views that look through lights, by their address: camera, whether it is local and locked, perspective,
# location, rotation and distance.
_before_looking: dict[int, tuple] = {}


def looks_through(space):
    """The light through which a 3D view looks; None if there is none."""
    is_local = space is not None and space.use_local_camera and space.region_3d.view_perspective == "CAMERA"
    return space.camera if is_local and space.camera is not None and space.camera.type == "LIGHT" else None


class LTSH_OT_look_through_light(LTSHOperator, bpy.types.Operator):
    """Look through the active light as through a camera, and move it by moving the view; once more: return"""

    bl_label = "Look Through Light"

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        space = view_of(context)
        is_lit = active_light(context) is not None or looks_through(space) is not None
        return super().reason_against(context) or ("" if space is not None and is_lit else "No light is active")

    def execute(self, context):
        space, light = view_of(context), active_light(context)
        former, region, key = looks_through(space), space.region_3d, space.as_pointer()
        moves = region.view_location.copy(), region.view_rotation.copy(), region.view_distance
        if former is None:
            camera = space.camera, space.use_local_camera, space.lock_camera
            _before_looking[key] = *camera, region.view_perspective, *moves
        if light is not None and light != former:
            # Only of this view: renders keep the camera of the scene.
            space.use_local_camera = space.lock_camera = True
            space.camera, region.view_perspective = light, "CAMERA"
            return {"FINISHED"}
        state = _before_looking.pop(key, (context.scene.camera, False, False, "PERSP", *moves))
        space.camera, space.use_local_camera, space.lock_camera = state[:3]
        region.view_perspective, region.view_location, region.view_rotation, region.view_distance = state[3:]
        return {"FINISHED"}


def environment_of(world) -> tuple:
    """The Background node of a world and the Environment Texture that colors it; None for what is not there."""
    surface = graph.surface_of(world) if world is not None else None
    source = graph.source_of(surface) if surface is not None else None
    if source is None or source.node is None or source.node.bl_idname != "ShaderNodeBackground":
        return None, None
    color = source.input("Color")
    is_texture = color is not None and color.node is not None and color.node.bl_idname == "ShaderNodeTexEnvironment"
    return source.node, color.node if is_texture else None


def _put_before(socket, kind: str):
    """A new node that feeds the input `socket`, left of its node."""
    node = socket.id_data.nodes.new(kind)
    node.location = socket.node.location - Vector((300.0, 0.0))
    socket.id_data.links.new(node.outputs[0], socket)
    return node


class LTSH_OT_open_environment(LTSHOperator, bpy.types.Operator, ImportHelper):
    """Light the scene by a picture, an Environment Texture of the world. Nodes that are there stay, unlinked"""

    bl_label = "Open Environment Texture"
    bl_options = {"REGISTER", "UNDO"}

    filter_image: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context):
        try:
            image = bpy.data.images.load(self.filepath, check_existing=True)
        except RuntimeError as error:
            self.report({"ERROR"}, error_line(error))
            return {"CANCELLED"}
        world = context.scene.world
        if world is None or world.library is not None:
            world = context.scene.world = bpy.data.worlds.new("World")
        if graph.tree_in_use(world) is None:
            world.use_nodes = True
        nodes = world.node_tree.nodes
        background, texture = environment_of(world)
        if background is None:
            output = graph.material_output(world.node_tree) or nodes.new("ShaderNodeOutputWorld")
            background = _put_before(output.inputs["Surface"], "ShaderNodeBackground")
        if texture is None:
            texture = _put_before(background.inputs["Color"], "ShaderNodeTexEnvironment")
        texture.image = image
        return {"FINISHED"}


# What a file is saved without: scenes by name, and their views.
_saved: list[tuple[str, list]] = []


@persistent
def _before_saving(*_) -> None:
    # A copy for a render of our own keeps the engine: the render has begun.
    if keeps_engine():
        return
    for scene in filter(is_previewing, bpy.data.scenes):
        scene.render.engine = scene.ltsh_view.artist_engine
        _saved.append((scene.name, _give_views_back(scene)))


@persistent
def _after_saving(*_) -> None:
    for name, views in _saved:
        bpy.data.scenes[name].render.engine = ENGINE
        for space in views:
            space.shading.type = "RENDERED"
    _saved.clear()


# Which scenes had a preview before undo or redo, by their session_uid.
_before_undo: dict[int, bool] = {}


@persistent
def _note_previews(*_) -> None:
    _before_undo.clear()
    _before_undo.update({scene.session_uid: is_previewing(scene) for scene in bpy.data.scenes})


@persistent
def _restore_previews(*_) -> None:
    """Undo and redo also restore the engine of a scene: the preview is on or off as it was before them."""
    for scene in bpy.data.scenes:
        wanted = _before_undo.get(scene.session_uid, is_previewing(scene))
        if wanted != is_previewing(scene):
            (start_preview if wanted else stop_preview)(scene)


@persistent
def _end_previews(*_) -> None:
    for scene in filter(is_previewing, bpy.data.scenes):
        stop_preview(scene)


@persistent
def _after_loading(*_) -> None:
    """Files have no preview. Those that Blender has saved by itself, as Auto Save, may still have its engine."""
    _former_shading.clear()
    _before_looking.clear()
    _end_previews()
    for scene in bpy.data.scenes:
        scene.ltsh_view.artist_engine = ""
    _subscribe()


def _engine_changed() -> None:
    """End the preview if another engine was chosen by hand; called by Blender after every change of the engine."""
    for scene in bpy.data.scenes:
        if scene.render.engine != ENGINE and scene.ltsh_view.artist_engine:
            scene.ltsh_view.artist_engine = ""
            _former_shading.pop(scene.session_uid, None)


_subscriber = object()


def _subscribe() -> None:
    """Subscribe to changes of the engine; needed again after loading, when Blender drops subscriptions."""
    bpy.msgbus.clear_by_owner(_subscriber)
    bpy.msgbus.subscribe_rna(
        key=(bpy.types.RenderSettings, "engine"), owner=_subscriber, args=(), notify=_engine_changed
    )


HANDLERS = (
    ("save_pre", _before_saving),
    ("save_post", _after_saving),
    ("save_post_fail", _after_saving),
    ("undo_pre", _note_previews),
    ("redo_pre", _note_previews),
    ("undo_post", _restore_previews),
    ("redo_post", _restore_previews),
    ("load_pre", _end_previews),
    ("load_post", _after_loading),
)


def register() -> None:
    """Follow the engine, and add the lights to Blender's menu."""
    _subscribe()
    bpy.types.VIEW3D_MT_light_add.append(add_lights_to_menu)


def unregister() -> None:
    """End all previews."""
    bpy.types.VIEW3D_MT_light_add.remove(add_lights_to_menu)
    bpy.msgbus.clear_by_owner(_subscriber)
    _end_previews()
