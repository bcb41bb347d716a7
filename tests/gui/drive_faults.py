"""What the window says is what is so, by mouse and keys: previews and materials after undo and redo, H beside the eye
of a light, F12, a cancelled comparison, the mixer, a bake beside Cycles, results after saving, two views of a world.

Set by their properties are only sizes, numbers of samples, bounces, the nodes of a material and a world, the editors.
"""

import shutil

import bpy
import eyes
import hands
import numpy as np

SIZE = "1600x1100"
SECONDS = 3600
SETTLE_SECONDS = 4  # panels below one that became shorter move for a moment
WAIT = 900  # for a job or a picture, on a busy machine
# From the right and upper end of the sidebar, see `hands`: the first light of the list, the header of Bake, and with it
# open its button and settings; while a preview is on, the header of Materials and the first setting of Final Render.
FIRST_LIGHT, BAKE_HEADER, BAKE, BAKE_SETTINGS = (215, 176), (219, 478), (149, 537), (219, 591)
BESIDE_CYCLES, COMPLETE, MATERIALS = (161, 827), (258, 674), (219, 819)
# The same of the Image Editor: results of shading, and the power of the first light of the mixer.
SHADED, POWER = (227, 45), (108, 276)


def main(rig):
    hands.patient(rig)
    bpy.context.scene.render.resolution_percentage = 50
    hands.settings().cycles_samples, hands.settings().bake_size = 4, "256"
    bpy.context.preferences.view.render_display_type = "NONE"
    yield from hands.open_panel(rig)
    yield from hands.editor_beside_view(rig)
    yield 2
    yield from previewed(rig)
    yield from listed(rig)
    yield from completed(rig)
    yield from hidden(rig)
    yield from cancelled(rig)
    yield from mixed(rig)
    yield from baked(rig)
    yield from rendered(rig)
    yield from compared(rig)
    yield from saved(rig)
    yield from two_views(rig)
    yield from dark(rig)


def shading(rig):
    return bpy.context.scene.render.engine, rig.space.shading.type


def chosen():
    """What the Image Editor shows of the results."""
    results = hands.module("ui.results")
    return results.choice_of(hands.settings(), results.result_of(bpy.context.scene))


def previewed(rig):
    """The preview by its button; undo and redo leave it."""
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.comes(rig, lambda: shading(rig) == ("LTSH", "RENDERED"), "a click shows the preview")
    yield 3
    rig.shot("01_preview.png")
    yield from hands.over(rig)
    for name in ("ctrl+z", "ctrl+shift+z"):
        yield from hands.keys(rig, name)
        yield 1
        rig.check(shading(rig) == ("LTSH", "RENDERED"), f"{name} leaves it: {shading(rig)}")
    yield 3
    rig.shot("02_redone.png")


def listed(rig):
    """The list of materials has a sign for what the view says about one; with bounces both have nothing to say."""
    eyes.view().bounces = False
    tree = bpy.data.materials["floor tiles"].node_tree
    shader = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    tree.links.new(noise.outputs[0], shader.inputs["Roughness"])
    yield from hands.until(lambda: notes_of_views()[0], 60)
    entries = hands.module("ui.preflight").overview(bpy.context.scene).materials
    noted = [f"{entry.name}: {note.removeprefix('in the view: ')}" for entry in entries for note in entry.notes]
    said = notes_of_views()[0]
    rig.check(said != [] and set(said) <= set(noted), f"Materials has what the view says, {said}: {noted}")
    yield from hands.click_button(rig, MATERIALS)
    yield 2
    rig.shot("03_materials.png")
    yield from hands.click_button(rig, MATERIALS)
    tree.nodes.remove(noise)
    yield from hands.comes(rig, lambda: not notes_of_views()[0], "and nothing when it is resolved again", 60)
    eyes.view().bounces = True


def notes_of_views():
    """What the open views say."""
    return [view.mirror.notes for view in hands.module("engine.redraws").open_views]


def completed(rig):
    """F12 with Cycles' part: its setting is in sight, and "denoised" is said where a denoiser has run."""
    rig.check(eyes.view().complete, "Complete is on at first")
    rig.shot("04_complete.png")
    yield from pressed_f12(rig)
    said, denoisers = reports(rig), hands.module("process.blender_process").denoiser_libraries()
    rig.fact("what F12 says", said.splitlines()[-4:])
    rig.check(bool(denoisers) != ("not denoised" in said), f"what is not denoised is not said to be: {denoisers}")
    yield from hands.click_button(rig, COMPLETE)
    rig.check(not eyes.view().complete, "a click leaves it, in a panel that is open")
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.comes(rig, lambda: shading(rig)[1] == "SOLID", "a click ends the preview")
    yield SETTLE_SECONDS


def pressed_f12(rig):
    """Press F12 over the view, and wait for the picture and its mixer."""
    ended = []
    for kind in ("complete", "cancel"):
        getattr(bpy.app.handlers, f"render_{kind}").append(lambda *_, kind=kind: ended.append(kind))
    yield from hands.over(rig)
    rig.xdo("key", eyes.F12)
    yield from hands.until(lambda: ended, WAIT)
    rig.check(ended == ["complete"], f"F12 ends well: {ended}")
    for kind in ("complete", "cancel"):
        getattr(bpy.app.handlers, f"render_{kind}").pop()
    yield 2


def reports(rig):
    """What Blender has reported so far."""
    area = rig.area("DOPESHEET_EDITOR")
    area.type = "INFO"
    hands.operate(rig, bpy.ops.info.select_all, action="SELECT", kind="INFO")
    report_copy = bpy.ops.info.report_copy
    hands.operate(rig, report_copy, kind="INFO")
    area.ui_type = "TIMELINE"
    clipboard = bpy.context.window_manager.clipboard
    return clipboard


def hidden(rig):
    """H hides a light, Alt H shows it: the eye in the list says so."""
    yield from hands.click_button(rig, FIRST_LIGHT)
    light = bpy.context.view_layer.objects.active
    rig.check(light is not None and light.type == "LIGHT", f"a click in the list selects {light and light.name}")
    yield from hands.typed(rig, "h")
    yield from hands.until(light.hide_get)
    rig.check(light.hide_get() and light.ltsh_light.mute, "H closes the eye of the light")
    yield 1
    rig.shot("05_hidden.png")
    yield from hands.keys(rig, "alt+h")
    yield from hands.until(lambda: not light.hide_get())
    rig.check(not light.ltsh_light.mute, "Alt H opens it")
    # A light that is chosen has fields above the buttons.
    yield from hands.over(rig, x=0.2, y=0.15)
    rig.xdo("click", 1)
    yield from hands.until(lambda: bpy.context.view_layer.objects.active.name == "floor")
    rig.check(bpy.context.view_layer.objects.active.name == "floor", "a click in the view selects the floor")
    yield SETTLE_SECONDS


def cancelled(rig):
    """A comparison that is cancelled leaves whole pictures of the techniques."""
    hands.settings().cycles_samples = 1 << 16
    yield from hands.start_comparison(rig)
    yield from hands.until(lambda: hands.job() is None or hands.job().shown, WAIT)
    results, scene = hands.module("ui.results"), bpy.context.scene
    rig.check("Cycles" in results.lacks(results.result_of(scene)), "what lacks is said while Cycles renders")
    yield 2
    rig.shot("06_comparing.png")
    yield from hands.typed(rig, "Escape")
    yield from hands.until(lambda: hands.job() is None)
    rig.check(results.lacks(results.result_of(scene)) == "", "and not when nothing will come any more")
    yield 3
    rig.shot("07_cancelled.png")
    hands.settings().cycles_samples = 4


def mixed(rig):
    """A value of the mixer shows the mix; undo takes both back, and redo brings them."""
    yield from hands.click_button(rig, hands.SHADE)
    yield from hands.job_started(rig, "a click on Shade Camera View starts a job")
    yield from hands.wait_for_job(rig, WAIT)
    yield 3
    rig.shot("08_shaded.png")
    plain = hands.image_pixels("LTSH Comparison")
    yield from hands.field(rig, POWER, "4", "IMAGE_EDITOR")
    yield from power_is(rig, 4.0, "typing sets it")
    mix = hands.image_pixels("LTSH Comparison")
    rig.check(mix != plain and chosen().mode == "MIX", "a value shows the mix")
    rig.shot("09_mixed.png")
    yield from hands.typed(rig, "ctrl+z", kind="IMAGE_EDITOR")
    yield from power_is(rig, 1.0, "undo takes it back")
    rig.check(hands.image_pixels("LTSH Comparison") == plain, "and the picture")
    rig.shot("10_undone.png")
    yield from hands.keys(rig, "ctrl+shift+z")
    yield from power_is(rig, 4.0, "redo brings it")
    rig.check(hands.image_pixels("LTSH Comparison") == mix, "with its picture")


def power_is(rig, power, what):
    yield from hands.until(lambda: hands.settings().mixed[0].power == power)
    found = hands.settings().mixed[0].power
    rig.check(found == power, f"the power in the mixer, {what}: {found}")
    yield 2


def baked(rig):
    """A bake with Compare leaves the mix: the wipe has one picture left of the line and another one right of it."""
    yield from hands.click_button(rig, BAKE_HEADER)
    yield 2
    yield from hands.click_button(rig, BAKE_SETTINGS)
    yield 2
    yield from hands.click_button(rig, BESIDE_CYCLES)
    rig.check(hands.settings().bake_error, "a click chooses Compare with Cycles")
    rig.shot("11_bake.png")
    yield from hands.click_button(rig, BAKE)
    yield from hands.job_started(rig, "a click on Bake Selected starts a job")
    yield from hands.wait_for_job(rig, WAIT)
    yield 3
    rig.shot("12_baked.png")
    rig.check(hands.settings().mode == chosen().mode == "WIPE", f"a bake leaves the mix: {chosen().mode}")
    check_wipe(rig)
    yield from hands.click_button(rig, BAKE_HEADER)
    yield SETTLE_SECONDS


def check_wipe(rig):
    """The Image Editor has the first picture left of the line, and another one right of it."""
    choice, shown = chosen(), pixels("LTSH Comparison")
    names = [
        f"LTSH {choice.group} {name}.{choice.pass_name}".replace("  ", " ") for name in (choice.first, choice.second)
    ]
    first, second = (pixels(name) for name in names)
    middle = round(hands.settings().split * shown.shape[1])
    rig.check(np.array_equal(shown[:, :middle], first[:, :middle]), f"left of the line is {names[0]}")
    rig.check(np.array_equal(shown[:, middle:], second[:, middle:]), f"right of it is {names[1]}")
    rig.check(not np.array_equal(first, second), "which is another picture")


def pixels(name):
    image = bpy.data.images[name]
    return np.array(image.pixels, np.float32).reshape(image.size[1], image.size[0], 4)


def shaded_again(rig, power):
    """Show what was shaded by a click, with this power in its mixer."""
    yield from hands.click(rig, *hands.to_window(rig, "IMAGE_EDITOR", "UI", *SHADED))
    command = hands.module("ui.results").result_of(bpy.context.scene).command
    rig.check((command, chosen().mode) == ("shade", "A"), f"a click shows what was shaded: {chosen()}")
    yield 2
    yield from hands.field(rig, POWER, power, "IMAGE_EDITOR")
    yield from power_is(rig, float(power), "typing sets it")


def rendered(rig):
    """A final render leaves the mix, and its mixer has no value of an earlier picture."""
    yield from shaded_again(rig, "5")
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: shading(rig) == ("LTSH", "RENDERED"))
    yield from pressed_f12(rig)
    powers = [item.power for item in hands.settings().mixed]
    rig.check(set(powers) == {1.0}, f"the mixer starts with the lights as rendered: {powers}")
    rig.check("MIX" not in (hands.settings().mode, chosen().mode), f"F12 leaves the mix: {chosen().mode}")
    rig.shot("13_rendered.png")
    yield from hands.click_button(rig, hands.PREVIEW)
    yield SETTLE_SECONDS


def compared(rig):
    """A comparison beside Cycles leaves the mix of what was shaded before."""
    yield from shaded_again(rig, "3")
    yield from hands.start_comparison(rig)
    yield from hands.wait_for_job(rig, WAIT)
    yield 3
    rig.check(hands.settings().mode == chosen().mode == "WIPE", f"a comparison leaves the mix: {chosen().mode}")
    check_wipe(rig)
    rig.shot("14_compared.png")


def saved(rig):
    """The results of all commands are there when the file is saved elsewhere; the file has no pictures."""
    operators, scene = hands.module("ui.operators"), bpy.context.scene
    commands = ("shade", "compare", "bake")
    before = {command: operators.last_folder(scene, command).resolve() for command in commands}
    folder = rig.out / "elsewhere"
    folder.mkdir(exist_ok=True)
    yield from hands.typed(rig, "ctrl+shift+s")
    yield from hands.saved_in(rig, folder, "renamed.blend")
    scene, results = bpy.context.scene, hands.module("ui.results")
    after = {command: operators.last_folder(scene, command).resolve() for command in commands}
    rig.check(before == after, f"results are found after saving elsewhere: {after}")
    rig.check(all(results.result_in(str(path)) is not None for path in after.values()), "all of them")
    yield from hands.click(rig, *hands.to_window(rig, "IMAGE_EDITOR", "UI", *SHADED))
    yield 2
    rig.check(results.result_of(scene).command == "shade", "a click shows those of shading")
    rig.shot("15_saved.png")
    # Blender loads nothing from the file that is open.
    with bpy.data.libraries.load(shutil.copy(bpy.data.filepath, str(folder / "copy.blend"))) as (there, _):
        names = [name for name in there.images if name.startswith("LTSH ") and name != "LTSH Comparison"]
    rig.check(names == [], f"no picture is in the file: {names}")


def two_views(rig):
    """A second view of a world with nodes does not wait for it again."""
    live, engine = hands.module("viewport.live_cycles"), hands.module("engine.redraws")
    world = bpy.context.scene.world = bpy.data.worlds.new("Sky")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    tree = world.node_tree
    background = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeBackground")
    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs[1], background.inputs["Color"])
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: live._world_looks and any("until" in note for note in notes_of_views()[0]), 60)
    yield from hands.until(lambda: not any("until" in note for note in notes_of_views()[0]), WAIT)
    rig.check(notes_of_views() == [[]], f"one view knows the world: {notes_of_views()}")
    look = live._world_looks[world.name_full]
    area = rig.area("IMAGE_EDITOR")
    area.ui_type = "VIEW_3D"
    yield 2
    region = next(region for region in area.regions if region.type == "WINDOW")
    rig.xdo("mousemove", region.x + region.width // 3, rig.size[1] - region.y - region.height // 4)
    yield hands.CLICK_SECONDS
    # The menu of shading, and in it Rendered.
    yield from hands.keys(rig, "z", "8")
    yield from hands.until(lambda: len(engine.open_views) == 2, 60)
    yield 5
    rig.check(len(engine.open_views) == 2, f"there are two views: {len(engine.open_views)}")
    rig.check(notes_of_views() == [[], []], f"the second one knows it at once: {notes_of_views()}")
    skies = {id(view.mirror.sky) for view in engine.open_views}
    rig.check(len(skies) == 1 and look.thread is None, "from the first one")
    rig.shot("16_two_views.png")
    area.ui_type = "IMAGE_EDITOR"
    yield 2
    yield from hands.click_button(rig, hands.PREVIEW)


def dark(rig):
    """Without lights the panel asks for none to be clicked."""
    yield SETTLE_SECONDS
    for _ in [ob for ob in bpy.context.scene.objects if ob.type == "LIGHT"]:
        yield from hands.click_button(rig, FIRST_LIGHT)
        yield from hands.typed(rig, "Delete")
        yield 1
    rig.check(not hands.module("ui.settings").lights_of(bpy.context.scene), "Delete removes the lights of the list")
    yield SETTLE_SECONDS
    rig.shot("17_no_light.png")
