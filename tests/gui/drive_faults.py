"""What the window says is what is so: redo of a preview, H and the eye, Mix left by other results, saving elsewhere."""

import bpy
import hands

SIZE = "1600x900"
SECONDS = 1200


def main(rig):
    hands.patient(rig)
    yield from hands.open_panel(rig)
    yield 2
    yield from previewed(rig)
    yield from hidden(rig)
    yield from cancelled(rig)
    yield from mixed(rig)
    yield from saved(rig)


def shading(rig):
    return bpy.context.scene.render.engine, rig.space.shading.type


def previewed(rig):
    """The preview by its button, taken back and brought back by keys."""
    before = shading(rig)
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: shading(rig) == ("LTSH", "RENDERED"))
    rig.check(shading(rig) == ("LTSH", "RENDERED"), "a click shows the preview")
    yield 3
    rig.shot("1_preview.png")
    yield from hands.over(rig)
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.until(lambda: shading(rig) == before)
    rig.check(shading(rig) == before, f"undo ends it: {shading(rig)}")
    yield from hands.keys(rig, "ctrl+shift+z")
    yield from hands.until(lambda: shading(rig) == ("LTSH", "RENDERED"))
    rig.check(shading(rig) == ("LTSH", "RENDERED"), f"redo brings it back into the view: {shading(rig)}")
    yield 3
    rig.shot("2_redone.png")
    yield from hands.click_button(rig, hands.PREVIEW)
    yield from hands.until(lambda: shading(rig) == before)
    rig.check(shading(rig) == before, "a click ends it")


def hidden(rig):
    """H hides a light, Alt H shows it: the eye in the list says so."""
    light = next(ob for ob in bpy.context.scene.objects if ob.type == "LIGHT")
    hands.select(rig, light)
    yield 1
    yield from hands.over(rig)
    yield from hands.keys(rig, "h")
    yield from hands.until(light.hide_get)
    rig.check(light.hide_get() and light.ltsh_light.mute, "H closes the eye of the light")
    yield 1
    rig.shot("3_hidden.png")
    yield from hands.keys(rig, "alt+h")
    yield from hands.until(lambda: not light.hide_get())
    rig.check(not light.ltsh_light.mute, "Alt H opens it")


def cancelled(rig):
    """A comparison that is cancelled leaves whole pictures of the techniques."""
    hands.settings().resolution_percentage, hands.settings().cycles_samples = 50, 4096
    # The light that is chosen now has fields above the button.
    hands.operate(rig, bpy.ops.ltsh.compare, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "comparing starts")
    yield from hands.until(lambda: hands.job() is None or hands.job().shown, 400)
    results, scene = hands.module("ui.results"), bpy.context.scene
    rig.check("Cycles" in results.lacks(results.result_of(scene)), "what lacks is said while Cycles renders")
    yield from hands.over(rig)
    yield from hands.keys(rig, "Escape")
    yield from hands.until(lambda: hands.job() is None)
    rig.check(results.lacks(results.result_of(scene)) == "", "and not when nothing will come any more")
    yield from hands.results_opened(rig)
    yield 2
    rig.shot("4_cancelled.png")


def mixed(rig):
    """The mixer is left by other results; undo takes its values and its picture back."""
    settings, results = hands.settings(), hands.module("ui.results")
    settings.mode = "SIDE"
    hands.operate(rig, bpy.ops.ltsh.shade, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "shading starts")
    yield from hands.wait_for_job(rig, 600)
    yield 2
    hands.operate(rig, bpy.ops.ed.undo_push, message="Before")
    plain = hands.image_pixels("LTSH Comparison")
    settings.mixed[0].power = 4.0
    hands.operate(rig, bpy.ops.ed.undo_push, message="Power")
    yield 1
    rig.check(hands.image_pixels("LTSH Comparison") != plain and settings.mode == "MIX", "a value shows the mix")
    yield from hands.over(rig, "IMAGE_EDITOR")
    yield from hands.keys(rig, "ctrl+z")
    yield from hands.until(lambda: hands.settings().mixed[0].power == 1.0)
    yield 1
    rig.check(hands.settings().mixed[0].power == 1.0, "undo takes the value back")
    rig.check(hands.image_pixels("LTSH Comparison") == plain, "and the picture")
    rig.shot("5_undone.png")
    hands.settings().mixed[0].power = 4.0
    yield 1
    hands.settings().cycles_samples = 4
    hands.operate(rig, bpy.ops.ltsh.compare, "INVOKE_DEFAULT")
    yield from hands.job_started(rig, "comparing starts again")
    yield from hands.wait_for_job(rig, 600)
    yield 2
    choice = results.choice_of(hands.settings(), results.result_of(bpy.context.scene))
    rig.check(hands.settings().mode == choice.mode == "SIDE", f"a comparison leaves the mix: {hands.settings().mode}")
    rig.check(choice.first != choice.second, f"and compares two pictures: {choice.first}, {choice.second}")
    rig.shot("6_compared.png")


def saved(rig):
    """The results of both commands are there when the file is saved elsewhere; the file has no pictures."""
    operators, scene = hands.module("ui.operators"), bpy.context.scene
    before = {command: operators.last_folder(scene, command).resolve() for command in ("shade", "compare")}
    folder = rig.out / "elsewhere"
    folder.mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "renamed.blend"))
    yield 2
    scene, results = bpy.context.scene, hands.module("ui.results")
    after = {command: operators.last_folder(scene, command).resolve() for command in before}
    rig.check(before == after, f"results are found after saving elsewhere: {after}")
    rig.check(all(results.result_in(str(path)) is not None for path in after.values()), "all of them")
    rig.shot("7_saved.png")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "copy.blend"), copy=True)
    with bpy.data.libraries.load(str(folder / "copy.blend")) as (there, _):
        names = [name for name in there.images if name.startswith("LTSH ") and name != "LTSH Comparison"]
    rig.check(names == [], f"no picture is in the file: {names}")
