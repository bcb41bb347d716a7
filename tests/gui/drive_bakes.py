"""A bake of several objects with bounces, by the mouse: each is shown when it is done, the time left is told, and with
Only Changed a second bake does what changed.
"""

import time

import bpy
import hands

SECONDS = 1200
SIZE = "1600x900"
# From the right and upper end of the sidebar, see `hands`; the list of objects is there.
BAKE_HEADER, BAKE = (223, 477), (149, 625)
# The time left is told from so many seconds on, and is right within a factor of WITHIN.
TOLD_SECONDS, WITHIN, LEAST_SECONDS = 10.0, 2.0, 8.0
BAKE_SECONDS = 500


def main(rig):
    hands.patient(rig)
    yield from scene(rig)
    states = yield from baked(rig, "first")
    rig.check(set(states.values()) == {"done"}, f"the first bake does all: {states}")
    states = yield from baked(rig, "again")
    rig.check(set(states.values()) == {"unchanged"}, f"a second one does none: {states}")
    hands.settings().bake_bounces = False
    states = yield from baked(rig, "direct")
    rig.check(set(states.values()) == {"done"}, f"without bounces all are others: {states}")
    material = bpy.data.objects["Box"].material_slots[0].material
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.1, 0.3, 0.9, 1.0)
    states = yield from baked(rig, "color")
    # Direct light on the others does not depend on it.
    rig.check(of(states, "done") == {"Box"}, f"a new color is baked again, and nothing else: {states}")
    bpy.context.scene.camera.location.x = 1.0
    states = yield from baked(rig, "camera")
    rig.check(not of(states, "done"), f"seen from above, none needs the camera: {states}")
    bpy.data.objects["Ball"].scale.z = 1.5
    states = yield from baked(rig, "shape")
    rig.check(of(states, "done") == set(states), f"another shape has other shadows on all: {states}")


def of(states, state):
    """The objects of a state."""
    return {name for name, one in states.items() if one == state}


def scene(rig):
    """Four objects with materials of their own, and lamps; all are selected, the panel Bake is open."""
    for ob in list(bpy.context.scene.objects):
        bpy.data.objects.remove(ob)
    for name, kind, place, options in (
        ("Floor", "plane", (0, 0, 0), {"size": 6}),
        ("Ball", "uv_sphere", (-0.8, 0.3, 0.6), {"radius": 0.6}),
        ("Box", "cube", (0.9, 0.2, 0.4), {"size": 0.8}),
        ("Ring", "torus", (0.1, -1.2, 0.2), {"major_radius": 0.5, "minor_radius": 0.18}),
    ):
        hands.operate(rig, getattr(bpy.ops.mesh, f"primitive_{kind}_add"), location=place, **options)
        ob = bpy.context.view_layer.objects.active
        ob.name = name
        material = bpy.data.materials.new(name)
        if bpy.app.version < (5, 0, 0):
            material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.7, 0.6, 0.5, 1.0)
        ob.data.materials.append(material)
    for x in (-1.5, 1.5):
        hands.operate(rig, bpy.ops.object.light_add, type="AREA", location=(x, -0.5, 2.5))
        bpy.context.view_layer.objects.active.data.energy = 60.0
    hands.operate(rig, bpy.ops.object.camera_add, location=(0, -6, 4), rotation=(1.0, 0, 0))
    bpy.context.scene.camera = bpy.context.view_layer.objects.active
    hands.operate(rig, bpy.ops.object.select_by_type, type="MESH")
    bpy.context.view_layer.objects.active = bpy.data.objects["Floor"]
    settings = hands.settings()
    settings.bake_size, settings.bake_view, settings.bake_bounces, settings.bake_rest_samples = "256", "above", True, 16
    yield from hands.typed(rig, "n")
    yield 1
    rig.tab("LTSH")
    yield 2
    yield from hands.click_button(rig, BAKE_HEADER)
    yield 2
    rig.shot("bakes_panel.png")


def baked(rig, name):
    """Click Bake Selected, and wait for the job; the states of the objects in the end."""
    yield from hands.click_button(rig, BAKE)
    yield from hands.job_started(rig, f"{name}: a click on Bake Selected starts a job")
    job, start, told, shown = hands.job(), time.monotonic(), [], 0
    while hands.job() is job and time.monotonic() < start + BAKE_SECONDS:
        seconds = time.monotonic() - start
        if seconds > TOLD_SECONDS:
            told.append((seconds, job.plan.seconds_left()))
        if job.shown > shown:
            shown = job.shown
            rig.shot(f"bakes_{name}_shown_{shown}.png")
        yield 0.5
    whole, states = time.monotonic() - start, dict(job.objects)
    rig.fact(f"{name}: seconds", round(whole, 1))
    off = [left / (whole - seconds) for seconds, left in told if whole - seconds > LEAST_SECONDS]
    rig.fact(f"{name}: seconds told as left, of those that there were", [round(one, 2) for one in off[::4]])
    within = [1.0 / WITHIN <= one <= WITHIN for one in off]
    rig.fact(f"{name}: share within a factor of {WITHIN:g}", sum(within) / max(len(within), 1))
    yield 2
    rig.shot(f"bakes_{name}.png")
    for window in list(bpy.context.window_manager.windows)[1:]:
        hands.close_window(window)
    yield 1
    return states
