"""The preview stays what the panel says, whatever an artist does: undo and redo with edits in between, a second window,
a render region, local view, a light as camera, another file, the add-on disabled. Lights that the mouse places."""

import itertools
import random

import bpy
import eyes
import hands
import numpy as np

SIZE = "1400x1000"
SECONDS = 1800
STEPS = 30


def main(rig):
    hands.patient(rig)
    other = hands.file_copy()
    # A picture that is there at once, and the same each time.
    bpy.context.scene.ltsh.shadows = eyes.view().bounces = False
    eyes.pixel_centers()
    yield from hands.open_panel(rig)
    rig.space.overlay.show_overlays = False
    yield 1
    rig.shot("00_start.png")
    yield from undone_and_redone(rig)
    yield from added(rig)
    yield from highlighted(rig)
    yield from looked_through(rig)
    yield from regions(rig)
    yield from second_window(rig)
    yield from reloaded(rig)
    yield from other_file(rig, other)


def state(rig):
    """Engine, shading, what the panel says, and whether the view's lights are those of the scene."""
    scene, preview = bpy.context.scene, hands.module("ui.preview")
    return scene.render.engine, rig.space.shading.type, preview.is_previewing(scene)


def started(rig):
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: state(rig) == ("LTSH", "RENDERED", True))
    rig.check(state(rig) == ("LTSH", "RENDERED", True), f"a click starts the preview: {state(rig)}")


def ended(rig, engine):
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: state(rig) == (engine, "SOLID", False))
    rig.check(state(rig) == (engine, "SOLID", False), f"a click ends the preview: {state(rig)}")


def heights():
    return round(bpy.data.objects["Neon"].location.z, 3)


def undone_and_redone(rig):
    """A walk of edits, Ctrl Z and Shift Ctrl Z, from before the preview on; each state shows the same picture again."""
    artist, chosen = bpy.context.scene.render.engine, random.Random(1)
    hands.select(rig, bpy.data.objects["Neon"])
    hands.operate(rig, bpy.ops.ed.undo_push, message="Selected")
    steps, at, pictures = [heights()], 0, {}
    for _ in range(2):
        at = yield from edited(rig, steps, at)
    yield from started(rig)
    for number in range(STEPS):
        kind = chosen.choice(["undo", "undo", "redo", "edit"])
        if number < 3:
            kind = "undo"
        move = {"undo": -1, "redo": 1, "edit": 0}[kind]
        if kind == "edit" or not 0 <= at + move < len(steps):
            at = yield from edited(rig, steps, at)
        else:
            yield from hands.typed(rig, "ctrl+z" if kind == "undo" else "ctrl+shift+z")
            at += move
        yield from hands.until(lambda at=at: heights() == steps[at])
        rig.check(heights() == steps[at], f"step {number}, {kind}: the light is where it was: {heights()}, {steps}")
        rig.check(state(rig) == ("LTSH", "RENDERED", True), f"step {number}, {kind}: the preview is on: {state(rig)}")
        if heights() in pictures:
            # Reading a screenshot loads an image, after which the view is drawn anew: it must come to rest first.
            yield from eyes.settled(rig, "01_walk.png")
            is_same = np.array_equal(view_alone(rig), pictures[heights()])
            if not is_same:
                rig.shot(f"01_other_{number}.png")
            rig.check(is_same, f"step {number}, {kind}: the view shows the same picture as before")
        else:
            yield from eyes.settled(rig, "01_walk.png")
            pictures[heights()] = view_alone(rig)
            rig.check(pictures[heights()].std() > 0.02, f"step {number}: the view shows a picture")
    rig.check(all(np.abs(one - other).max() > 0.02 for one, other in itertools.combinations(pictures.values(), 2)),
              "each place of the light has a picture of its own")  # fmt: skip
    yield from ended(rig, artist)
    yield from hands.typed(rig, *["ctrl+z"] * len(steps), *["ctrl+shift+z"] * len(steps))
    rig.check(state(rig) == (artist, "SOLID", False), f"no undo and no redo brings it back: {state(rig)}")
    rig.shot("02_ended.png")


def view_alone(rig):
    """What the view shows left of the sidebar, whose panels differ."""
    pixels = eyes.view_pixels(rig, "01_walk.png")
    return pixels[200:-100, 100 : rig.region("VIEW_3D", "UI").x - rig.region().x - 150]


def edited(rig, steps, at):
    """Move the light up by keys; the number of the state after it."""
    yield from hands.typed(rig, "g", "z", "0", "period", "1", "Return")
    del steps[at + 1 :]
    steps.append(round(steps[at] + 0.1, 3))
    yield from hands.until(lambda: heights() == steps[-1])
    return len(steps) - 1


def lights():
    return {ob.name for ob in bpy.context.scene.objects if ob.type == "LIGHT"}


def added(rig):
    """Add Light: it follows the mouse, Escape takes it away, a click leaves it, one undo takes it back."""
    yield from started(rig)
    before = lights()
    yield from eyes.settled(rig, "03_before.png")
    for end in ("Escape", "click"):
        hands.operate(rig, bpy.ops.ltsh.add_light, "INVOKE_DEFAULT")
        yield from hands.over(rig, x=0.45, y=0.3)
        yield from hands.over(rig, x=0.4, y=0.25)
        yield from hands.until(lambda: len(lights()) > len(before))
        (name,) = lights() - before
        yield 2
        rig.shot(f"04_adding_{end}.png")
        if end == "Escape":
            yield from hands.keys(rig, "Escape")
            yield from hands.comes(rig, lambda: lights() == before, lambda: f"Escape takes it away: {lights()}")
    rig.xdo("click", 1)
    yield 1
    ob = bpy.context.view_layer.objects.active
    rig.check(ob.name == name and bpy.context.selected_objects == [ob], f"a click leaves it, selected: {ob.name}")
    yield from eyes.settled(rig, "05_added.png")
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.until(lambda: lights() == before)
    rig.check(lights() == before and state(rig)[2], f"one undo takes it back: {lights()}")
    yield from hands.keys(rig, "ctrl+shift+z")
    yield from hands.comes(rig, lambda: name in lights(), "and redo brings it")
    # A copy that the mouse moves.
    hands.operate(rig, bpy.ops.ltsh.duplicate_light, "INVOKE_DEFAULT")
    yield from hands.over(rig, x=0.5, y=0.5)
    yield from hands.over(rig, x=0.6, y=0.5)
    rig.xdo("click", 1)
    yield 1
    copy = bpy.context.view_layer.objects.active
    moved = (copy.matrix_world.translation - bpy.data.objects[name].matrix_world.translation).length
    rig.check(len(lights()) == len(before) + 2 and moved > 0.01, f"a copy is moved by the mouse: {lights()}, {moved}")
    yield from eyes.settled(rig, "06_copied.png")
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.until(lambda: len(lights()) == len(before) + 1)
    rig.check(lights() == before | {name}, f"one undo takes the copy back: {lights()}")


def highlighted(rig):
    """Drag Highlight: the light follows the mouse over surfaces, Escape puts it back, a release leaves it, one undo
    takes it back."""
    ob = bpy.data.objects["Neon"]
    hands.select(rig, ob)

    def place():
        return np.array(bpy.data.objects["Neon"].matrix_world).round(4).tolist()

    before = place()
    for end in ("Escape", "release"):
        hands.operate(rig, bpy.ops.ltsh.drag_highlight, "INVOKE_DEFAULT")
        yield from hands.over(rig, x=0.4, y=0.3)
        rig.xdo("mousedown", 1)
        yield from hands.until(lambda: place() != before)
        first = place()
        yield from hands.over(rig, x=0.35, y=0.22)
        yield from hands.comes(rig, lambda first=first: place() not in (before, first), f"{end}: it follows the mouse")
        yield 2
        rig.shot(f"05_highlight_{end}.png")
        if end == "Escape":
            yield from hands.keys(rig, "Escape")
            yield from hands.comes(rig, lambda: place() == before, lambda: f"Escape puts it back: {place()}")
        rig.xdo("mouseup", 1)
        yield 1
    rig.check(place() != before, "a release leaves it")
    yield from eyes.settled(rig, "05_highlight_left.png")
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.comes(rig, lambda: place() == before, lambda: f"one undo takes it back: {place()}")
    rig.check(state(rig)[2], "and the preview is on")


def looked_through(rig):
    before = yield from eyes.settled(rig, "07_camera.png")
    ob = bpy.context.view_layer.objects.active
    camera = bpy.context.scene.camera
    hands.operate(rig, bpy.ops.ltsh.look_through_light)
    yield from eyes.differs(rig, "08_light.png", before, "a light is looked through")
    place = ob.matrix_world.copy()
    yield from hands.typed(rig, "ctrl+alt+KP_2", "KP_6")
    rig.check(ob.matrix_world != place and bpy.context.scene.camera == camera, "moving the view moves the light")
    hands.operate(rig, bpy.ops.ltsh.look_through_light)
    yield 1
    rig.check(rig.space.region_3d.view_perspective == "CAMERA" and rig.space.camera == camera, "and back")
    yield from eyes.settled(rig, "09_back.png")
    with rig.override():
        bpy.ops.ltsh.delete_light()
    yield from eyes.settled(rig, "10_deleted.png")
    rig.check(state(rig)[2], "the preview is on")


def regions(rig):
    """A render region in the view and in the camera, local view, and a wipe."""
    whole = yield from eyes.settled(rig, "11_whole.png")
    render, space = bpy.context.scene.render, rig.space
    # The view shows all of its picture, and F12 the region.
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.3, 0.6, 0.3, 0.6
    render.use_border = True
    yield from eyes.same_again(rig, "12_border.png", whole, "a render region of the camera leaves the view whole")
    render.use_border = False
    hands.select(rig, bpy.data.objects["floor"])
    space.region_3d.view_perspective = "PERSP"
    free = yield from eyes.settled(rig, "13_free.png")
    yield from hands.typed(rig, "ctrl+b")
    yield from hands.drag(rig, *((rig.region().x + x, hands.view_middle(rig)[1] + x // 2) for x in (200, 500)))
    rig.check(space.use_render_border, "Ctrl B draws a render region")
    yield from eyes.settled(rig, "14_border_free.png")
    yield from hands.typed(rig, "ctrl+alt+b")
    yield from eyes.same_again(rig, "14_no_border.png", free, "the view is whole without it")
    hands.operate(rig, bpy.ops.view3d.localview, frame_selected=False)
    yield from eyes.differs(rig, "15_local.png", free, "local view shows one object")
    hands.operate(rig, bpy.ops.view3d.localview, frame_selected=False)
    yield from eyes.same_again(rig, "16_not_local.png", free, "and all of them again")
    eyes.view().mode = "split"
    yield from eyes.settled(rig, "17_split.png")
    yield from hands.typed(rig, "ctrl+z", "ctrl+shift+z")
    rig.check(state(rig) == ("LTSH", "RENDERED", True), f"undo in a split view: {state(rig)}")
    eyes.view().mode = "single"
    rig.camera_view()


def second_window(rig):
    """A window that is opened meanwhile shows the preview; it ends in both."""
    artist = eyes.view().artist_engine
    hands.operate(rig, bpy.ops.screen.area_dupli, "INVOKE_DEFAULT")
    yield 2
    second = bpy.context.window_manager.windows[-1]
    yield 3
    rig.shot("18_two_windows.png")
    views = [area.spaces.active for window in bpy.context.window_manager.windows for area in window.screen.areas
             if area.type == "VIEW_3D"]  # fmt: skip
    for view in views:
        view.shading.type = "RENDERED"
    yield 3
    hands.operate(rig, bpy.ops.ltsh.preview)
    yield 1
    found = [view.shading.type for view in views]
    rig.check(found == ["SOLID"] * 2 and bpy.context.scene.render.engine == artist, f"it ends in both: {found}")
    hands.close_window(second)
    yield 1


def reloaded(rig):
    """The add-on is disabled during the preview and enabled again."""
    artist = bpy.context.scene.render.engine
    yield from started(rig)
    name = hands.ADDON.rpartition(".")[0]
    bpy.ops.preferences.addon_disable(module=name)
    yield 2
    found = bpy.context.scene.render.engine, rig.space.shading.type
    rig.check(found == (artist, "SOLID"), f"disabling ends the preview: {found}")
    rig.shot("19_disabled.png")
    bpy.ops.preferences.addon_enable(module=name)
    yield 2
    rig.tab("LTSH")
    yield 2
    rig.check(state(rig) == (artist, "SOLID", False), f"enabled again there is none: {state(rig)}")
    yield from started(rig)
    yield from eyes.settled(rig, "20_enabled.png")
    hands.select(rig, bpy.data.objects["Neon"])
    yield from hands.narrow(rig)
    yield 2
    rig.shot("20_narrow.png")


def other_file(rig, other):
    artist = eyes.view().artist_engine
    for load_ui in (True, False):
        if not load_ui:
            yield from hands.open_panel(rig)
            yield 1
            yield from started(rig)
        bpy.ops.wm.open_mainfile(filepath=other, load_ui=load_ui)
        yield 2
        found = state(rig)
        rig.check(found == (artist, "SOLID", False), f"another file has no preview, its interface {load_ui}: {found}")
    rig.shot("21_file.png")
