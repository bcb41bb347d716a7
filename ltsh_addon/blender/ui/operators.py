"""Operators that start, follow and stop jobs, that show and save results, and that open the manual."""

import atexit
import json
import logging
import re
import shutil
import tempfile
import time
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_iface as translated
from bpy.props import EnumProperty, StringProperty

from ...files import replacing
from ...imaging.exr import write_channels
from ...pipeline.bake_files import bake_members
from ...scene import SceneError, error_line, listed
from ..extract.apply import restore_materials, show_texture, shows_texture
from ..process.bake import BakedTextures
from ..saving import save_working_copy
from . import comparison, light_pose, preflight, results
from . import job as jobs
from .preview import LTSHOperator

TIMER_SECONDS, WAITING_SECONDS = 0.1, 0.005


def running_job() -> jobs.Job | None:
    """The job that runs now, or None."""
    return results.state["job"]


class WatchedOperator(LTSHOperator):
    """An operator that a timer follows until it ends: it begins by `_begin`, and `_wait` waits for it."""

    _timer = None

    def invoke(self, context, event):
        if not self._begin(context):
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(TIMER_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        self._show_progress(context)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        """Without a window, as from scripts, wait for the end."""
        return self._wait(context) if self._begin(context) else {"CANCELLED"}

    def _show_progress(self, context) -> None:
        comparison.redraw_panels()

    def _end_timer(self, context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None


class _JobOperator(WatchedOperator):
    """A job; Esc ends it."""

    # Not REGISTER: "Repeat Last" would run `execute`, which waits.
    bl_options = {"UNDO"}
    command = ""
    _opened = False  # the next results are set in the scene, but the comparison does not show them yet
    _progress = None

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        busy = "A job is running: wait for it, or cancel it"
        return super().reason_against(context) or (busy if running_job() is not None else "")

    def _wait(self, context):
        try:
            self._job.wait()
            self._show_all_results(context)
            return self._finish(context)
        except Exception as error:
            return self._fail(context, error)

    def modal(self, context, event):
        try:
            return self._step(context, event)
        except Exception as error:
            return self._fail(context, error)

    def _step(self, context, event):
        job = self._job
        if running_job() is not job or job.cancelled:  # the button, or another file
            return self._finish(context)
        if event.type == "ESC" and event.value == "PRESS":
            job.cancel()
            return self._finish(context)
        if event.type == "TIMER":
            job.poll()
            if self._show_some_results(context):
                return {"PASS_THROUGH"}
            if job.finished:
                return self._finish(context)
            self._show_progress(context)
        return {"PASS_THROUGH"}

    def cancel(self, context):
        """Called by Blender when the window is closed: another window watches the job from now on."""
        self._end_timer(context)
        job = self._job
        # By a timer, once this window is gone. A Blender that quits calls no timers any more.
        bpy.app.timers.register(lambda: _watch_elsewhere(job), first_interval=0.0)

    def _fail(self, context, error: Exception):
        """End the job with one line about the unexpected `error`; the console shows more by its log level."""
        logging.getLogger(__name__).info("unexpected error", exc_info=error)
        self._job.cancel()
        self._job.error = f"{self._job.title} failed: {error_line(error)}"
        return self._finish(context)

    def _begin(self, context) -> bool:
        reason = preflight.blocking(context, self.command)
        if reason:
            self.report({"ERROR"}, reason)
            return False
        folder = Path(tempfile.mkdtemp(prefix="ltsh-"))
        copy = folder / (Path(bpy.data.filepath).name or "untitled.blend")
        runs = jobs.runs_of(context, self.command, copy)
        job = jobs.Job(
            self.bl_label,
            jobs.Plan(jobs.steps(runs), measured=jobs.session_times),
            folder,
            self.command,
            context.scene.session_uid,
        )
        job.output = runs[-1].options.output
        try:
            if self.command == "match":
                jobs.write_target(context.scene, folder)
            save_working_copy(copy)
            job.start([run.to_dict() for run in runs], background=not bpy.app.background)
        except (RuntimeError, OSError, SceneError) as error:
            job.remove_folder()
            self.report({"ERROR"}, error_line(error))
            return False
        self._job = results.state["job"] = job
        if self.command == "bake":
            results.state["baked"] = job.scene, job.objects
        return True

    def _show_progress(self, context) -> None:
        """Redraw progress if its text has changed."""
        job = self._job
        done = f"{job.title}: {jobs.stage_title(job.stage)}  {jobs.progress_text(job.plan, job.seconds())}"
        text = f"{done}    {translated('Esc')}: {translated('Cancel')}"
        shown = text, jobs.clock(job.seconds())
        if shown != self._progress:
            self._progress = shown
            context.workspace.status_text_set(text)
            comparison.redraw_panels()

    def _show_some_results(self, context) -> bool:
        """Show the next part of new results. Large files are read one per call, so that the window need not wait long.

        Returns True if there was something to show, or will be.
        """
        scene, job = results.scene_of(self._job.scene), self._job
        if scene is None or job.shown == len(job.results):
            return False
        if not self._opened:
            if not results.is_mixer_read(scene, job.results[job.shown]):
                return True
            results.show(scene, job.results[job.shown])
            self._opened = True
        elif not comparison.read_a_picture(scene):
            comparison.refresh(scene)
            # Only the first pictures open a window: it may have been closed before the next ones are there.
            show = comparison.open_editor if job.shown == 0 and self._timer is not None else comparison.put_in_editor
            show(context, scene)
            self._opened = False
            job.shown += 1
        return True

    def _show_all_results(self, context) -> None:
        while self._show_some_results(context):
            time.sleep(WAITING_SECONDS)

    def _finish(self, context):
        job = self._job
        self._end_timer(context)
        if not job.error:
            self._show_all_results(context)
        if running_job() is job:
            results.state["job"] = None
        for workspace in bpy.data.workspaces:
            workspace.status_text_set(None)
        # Pictures too: labels and views say whether a job or a picture of Cycles is there.
        comparison.redraw_editors(*comparison.PANEL_REGIONS)
        if job.error:
            self.report({"ERROR"}, job.error)
        elif job.cancelled:
            remains = self._what_remains()
            self.report({"WARNING"}, f"{job.title} was cancelled; {remains}")
        elif job.command == "match":
            self._put_lights()
        else:
            self._report_success()
        return {"FINISHED"} if job.shown else {"CANCELLED"}

    def _what_remains(self) -> str:
        scene, job = results.scene_of(self._job.scene), self._job
        result = results.result_of(scene) if scene is not None and job.shown else None
        if result is not None and job.command == "bake":
            return f"kept: {listed(record['name'] for record in result.report['objects'])}"
        if result is None:
            return f"what was finished is in {job.output}" if job.command == "bake" else "nothing was finished yet"
        names = next(iter(result.groups.values()))["labels"].values()
        return f"kept: {', '.join(names)}"

    def _put_lights(self) -> None:
        """Give the lights of the scene the places and powers with which it comes closest to the target."""
        scene, report = results.scene_of(self._job.scene), json.loads((self._job.output / "report.json").read_text())
        if scene is None:
            return
        moved, problems = light_pose.match_lights(scene, report["lights"])
        for problem in [*problems, *report["warnings"]]:
            self.report({"WARNING"}, problem)
        before, after = (f"{100.0 * report[f'error_{when}']:.1f} %" for when in ("before", "after"))
        took = f"{self._job.title} took {jobs.clock(self._job.seconds())}"
        self.report({"INFO"}, f"{took}: the picture is {after} from the target, it was {before}; moved: {moved}")
        self._job.shown = 1

    def _report_success(self) -> None:
        result = results.result_in(str(self._job.results[-1])) if self._job.results else None
        report = result.report if result is not None else {"warnings": ()}
        for problem in report.get("problems", ()):
            self.report({"WARNING"}, problem)
        count = len(report["warnings"])
        noted = f", {count} warning{'s' if count > 1 else ''}" if count else ""
        if unchanged := sum(state == "unchanged" for state in self._job.objects.values()):
            noted += f", not baked again since nothing has changed: {unchanged} of {len(self._job.objects)}"
        self.report({"INFO"}, f"{self._job.title} took {jobs.clock(self._job.seconds())}{noted}")


class LTSH_OT_shade(_JobOperator, bpy.types.Operator):
    """Shade what the active camera sees, with the chosen technique"""

    bl_label = "Shade Camera View"
    command = "shade"


class LTSH_OT_compare(_JobOperator, bpy.types.Operator):
    """Shade what the active camera sees, render it with Cycles too, and measure the difference.
    Direct light on both sides, without bounces"""

    bl_label = "Compare with Cycles"
    command = "compare"


class LTSH_OT_bake(_JobOperator, bpy.types.Operator):
    """Bake the light on the selected objects into textures, one EXR for each"""

    bl_label = "Bake Selected"
    command = "bake"


class LTSH_OT_match_move(_JobOperator, bpy.types.Operator):
    """Move and turn the lights of the scene and change their powers, so that its finished picture, bounces included,
    comes closest to the target. Takes a minute or more"""

    bl_label = "Match and Move"
    command = "match"

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        if reason := super().reason_against(context) or results.reason_without_target(context.scene):
            return reason
        target = context.scene.ltsh.match_target
        direct = "was painted on direct light alone: render with Complete and Keep Lights, paint on that"
        return f"{target.name} {direct}" if target.get(results.DIRECT_ONLY) else ""


class _OnRunningJob(LTSHOperator):
    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        return "No job is running" if running_job() is None else ""


class LTSH_OT_watch(_OnRunningJob, _JobOperator, bpy.types.Operator):
    """Watch the job that runs, whose own window was closed"""

    bl_label = "Watch Job"
    bl_options = {"UNDO", "INTERNAL"}

    def _begin(self, context) -> bool:
        self._job = running_job()
        return True


class LTSH_OT_cancel(_OnRunningJob, bpy.types.Operator):
    """Stop the job; pictures that are finished are kept"""

    bl_label = "Cancel"

    def execute(self, context):
        running_job().cancel()
        comparison.redraw_panels()
        return {"FINISHED"}


def _watch_elsewhere(job: jobs.Job) -> None:
    """Let the first remaining window watch `job`."""
    windows = bpy.context.window_manager.windows
    if running_job() is job and windows:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ltsh.watch("INVOKE_DEFAULT")


@bpy.app.handlers.persistent
def _stop(*_):
    """Stop the job before another file is opened, since its scene goes."""
    job = running_job()
    if job is not None:
        results.state["job"] = None
        job.cancel()


def _end_now() -> None:
    job = running_job()
    if job is not None:
        results.state["job"] = None
        job.end_now()


MANUAL = Path(__file__).resolve().parents[3] / "docs" / "manual.md"
# Lines of pictures, which Blender's Text Editor cannot show.
PICTURE_LINE = re.compile(r"^!\[.*\)\n\n?", re.MULTILINE)
COMMANDS = (
    ("shade", "Shade", "What Shade Camera View left last"),
    ("compare", "Compare", "What Compare with Cycles left last"),
    ("bake", "Bake", "What Bake Selected left last"),
)


class _NeedsResults(LTSHOperator):
    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        missing = context.scene is None or results.result_of(context.scene) is None
        return "There are no results yet: shade, compare or bake first" if missing else ""


class LTSH_OT_open_results(_NeedsResults, bpy.types.Operator):
    """Show the pictures in an Image Editor that is open, or in a window of their own"""

    bl_label = "Open in Image Editor"

    def execute(self, context):
        comparison.refresh(context.scene)
        if comparison.open_editor(context, context.scene):
            return {"FINISHED"}
        self.report({"ERROR"}, "No window could be opened: leave full screen, or find the pictures in the image list")
        return {"CANCELLED"}


class LTSH_OT_show_results(LTSHOperator, bpy.types.Operator):
    """Look at what this command left last"""

    bl_label = "Show Results"
    bl_options = {"UNDO"}

    command: EnumProperty(name="Command", description="Whose results", items=COMMANDS)

    def execute(self, context):
        folder = last_folder(context.scene, self.command)
        if results.result_in(str(folder)) is None:
            self.report({"ERROR"}, f"{folder} holds no results: run the command first")
            return {"CANCELLED"}
        results.show(context.scene, folder)
        comparison.refresh(context.scene)
        comparison.put_in_editor(context, context.scene)
        return {"FINISHED"}


class LTSH_OT_choose(LTSHOperator, bpy.types.Operator):
    """Choose what is shown of the results"""

    bl_label = "Choose"
    bl_options = {"UNDO", "INTERNAL"}

    key: StringProperty(options={"HIDDEN"})  # of Scene.ltsh
    value: StringProperty(options={"HIDDEN"})

    @classmethod
    def description(cls, context, properties):
        return context.scene.ltsh.bl_rna.properties[properties.key].enum_items[properties.value].description

    def execute(self, context):
        setattr(context.scene.ltsh, self.key, self.value)
        return {"FINISHED"}


class LTSH_OT_swap(_NeedsResults, bpy.types.Operator):
    """Exchange the two pictures"""

    bl_label = "Swap A and B"
    bl_options = {"UNDO"}

    def execute(self, context):
        settings = context.scene.ltsh
        choice = results.choice_of(settings, results.result_of(context.scene))
        settings.first, settings.second = choice.second, choice.first
        return {"FINISHED"}


class LTSH_OT_apply_bake(LTSHOperator, bpy.types.Operator):
    """Let the objects of the last bake show their textures: they get copies of their materials"""

    bl_label = "Apply Bake"
    bl_options = {"REGISTER", "UNDO"}
    NEEDS_OBJECT_MODE = True

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        reason = super().reason_against(context)
        return reason or ("There is no bake yet: bake first" if last_bake(context.scene) is None else "")

    def execute(self, context):
        result, gone, shown = last_bake(context.scene), [], []
        for record in result.report["objects"]:
            names = bake_members(record)
            gone += [name for name in names if name not in context.scene.objects]
            objects = [context.scene.objects[name] for name in names if name in context.scene.objects]
            if not objects:
                continue
            try:
                show_texture(objects, baked_texture(context.scene, result, record))
            except (OSError, RuntimeError, KeyError, ValueError) as error:
                name = objects[0].name
                self.report({"ERROR"}, f"Object {name!r} cannot show its texture ({error_line(error)}): bake again")
                continue
            shown += [ob.name for ob in objects]
        if gone:
            self.report({"WARNING"}, f"Not in the scene any more: {listed(map(repr, gone))}")
        if not shown:
            return {"CANCELLED"}
        self.report({"INFO"}, f"Showing baked textures: {listed(shown)}")
        return {"FINISHED"}


class LTSH_OT_restore_materials(LTSHOperator, bpy.types.Operator):
    """Give objects that show baked textures their materials back"""

    bl_label = "Restore Materials"
    bl_options = {"REGISTER", "UNDO"}
    NEEDS_OBJECT_MODE = True

    @classmethod
    def reason_against(cls, context) -> str:
        """As `LTSHOperator.reason_against`."""
        reason = super().reason_against(context)
        return reason or ("" if any(map(shows_texture, context.scene.objects)) else "No object shows a baked texture")

    def execute(self, context):
        restored = [ob.name for ob in context.scene.objects if restore_materials(ob)]
        self.report({"INFO"}, f"Materials are back: {listed(restored)}")
        return {"FINISHED"}


def last_folder(scene, command: str) -> Path:
    """The folder of the last results of `command`, wherever the file and new results are saved since."""
    return results.folder_of(scene, command, jobs.output_folder(scene, command) / "images")


def last_bake(scene):
    """The results of the last bake of `scene`; None if there is none."""
    result = results.result_in(str(last_folder(scene, "bake")))
    return result if result is not None and result.command == "bake" and result.report["objects"] else None


def baked_texture(scene, result, record: dict) -> BakedTextures:
    """The texture of an object for `show_texture`: the mix that is shown, else its combined light, or its first pass.

    The pictures are copied to files of their own, which stay when the next bake replaces the pictures. Raises OSError,
    ValueError.
    """
    files = []
    for number, tile in record["tiles"].items():
        stem = Path(tile["file"]).stem
        group = result.groups[stem]
        layer = f"{group['names'][0]}.{'combined' if 'combined' in group['passes'] else group['passes'][0]}"
        source = result.folder / group["files"][layer]
        name = f"{stem}.{layer}" if len(record["tiles"]) == 1 else f"{stem.rpartition('.')[0]}.{layer}.{number}"
        path = result.folder.parent / f"{name}.exr"
        mixture = results.mixed_texture(scene, result, stem)
        if mixture is None:
            with replacing(path) as temporary:
                shutil.copyfile(source, temporary)
        else:
            write_channels(path, {letter: mixture[..., number] for number, letter in enumerate("RGB")})
        files.append({"path": str(path), "tile": int(number)})
    return BakedTextures(bake_members(record), record["uv"], f"{record['name']} {layer}", files)


class LTSH_OT_manual(LTSHOperator, bpy.types.Operator):
    """Read the manual of LTSH, one page, in a new window"""

    bl_label = "Manual"

    def execute(self, context):
        text = next((text for text in bpy.data.texts if text.name == "LTSH Manual"), None)
        if text is None:
            try:
                content = MANUAL.read_text(encoding="utf-8")
            except OSError as error:
                self.report({"ERROR"}, f"{MANUAL}: cannot be read: {error.strerror}; install the extension again")
                return {"CANCELLED"}
            text = bpy.data.texts.new("LTSH Manual")
            text.write(PICTURE_LINE.sub("", content))
            text.cursor_set(0)
        if context.window is None:
            return {"FINISHED"}
        bpy.ops.wm.window_new()
        area = context.window_manager.windows[-1].screen.areas[0]
        area.type = "TEXT_EDITOR"
        space = area.spaces.active
        space.text, space.top = text, 0
        space.show_word_wrap, space.show_line_numbers, space.show_syntax_highlight = True, False, False
        return {"FINISHED"}


HANDLERS = (("load_pre", _stop),)


def register():
    atexit.register(_end_now)


def unregister():
    _end_now()
    atexit.unregister(_end_now)
