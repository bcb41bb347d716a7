"""What the panels' settings are on the command line, and where the results go. Changes nothing."""

from __future__ import annotations

from pathlib import Path

import bpy

from . import preflight
from .preferences import preferences

NO_CYCLES = "Not complete: without Cycles"
REFERENCE = "reference"


def runs(context, command: str, scene_file: Path) -> list[dict]:
    """The command lines of a job (see `job_steps.perform`)."""
    if command == "bake":
        return [_run(bake_arguments(context, scene_file))]
    if command == "shade":
        return [_run(picture_arguments(context.scene, "shade", scene_file))]
    # The techniques are there long before Cycles is: they are shown, and stay where the rest is stopped.
    first = [name for name in chosen(context.scene.ltsh, "techniques") if name != REFERENCE]
    early = [_run(picture_arguments(context.scene, "shade", scene_file, first), NO_CYCLES)] if first else []
    return [*early, _run(picture_arguments(context.scene, "compare", scene_file))]


def _run(arguments: list[str], partial: str = "") -> dict:
    return {"arguments": arguments, "output": arguments[arguments.index("-o") + 1], "partial": partial}


def picture_arguments(scene, command: str, scene_file: Path, techniques: list[str] | None = None) -> list[str]:
    """Arguments of `ltsh shade` or `ltsh compare`."""
    settings = scene.ltsh
    width, height = preflight.picture_of(scene)
    arguments = [
        *(command, str(scene_file), "-o", str(output_folder(scene, command))),
        *("--techniques", ",".join(techniques or chosen(settings, "techniques"))),
        *("--passes", ",".join(chosen(settings, "passes"))),
        *("--resolution", f"{width}x{height}", "--aa", str(settings.anti_aliasing)),
    ]
    return arguments + (["--cycles-samples", str(settings.cycles_samples)] if command == "compare" else [])


def bake_arguments(context, scene_file: Path) -> list[str]:
    """Arguments of `ltsh bake` for the selected objects that can be baked."""
    scene, settings = context.scene, context.scene.ltsh
    arguments = ["bake", str(scene_file), "-o", str(output_folder(scene, "bake"))]
    for ob in preflight.bake_objects(context)[0]:
        arguments.append(f"--object={ob.name}")
    arguments += [
        *("--techniques", ",".join(chosen(settings, "techniques"))),
        *("--passes", ",".join(chosen(settings, "bake_passes"))),
        *("--size", settings.bake_size, "--margin", str(settings.bake_margin), "--view", settings.bake_view),
    ]
    if settings.bake_uv_map:
        arguments.append(f"--uv={settings.bake_uv_map}")
    if settings.bake_error:
        arguments += ["--error", "--cycles-samples", str(settings.cycles_samples)]
    return arguments


def chosen(settings, key: str) -> list[str]:
    """The members of a set of choices, in the order in which they are offered."""
    items = settings.bl_rna.properties[key].enum_items.keys()
    return [name for name in items if name in getattr(settings, key)]


def output_folder(scene, command: str) -> Path:
    """Where `command` writes: the folder of the settings, or that of the preferences where it is empty or where the
    .blend that it is relative to is not saved."""
    folder = scene.ltsh.output_folder.strip()
    if folder and (bpy.data.filepath or not folder.startswith("//")):
        root = Path(bpy.path.abspath(folder))
    else:
        root = preferences(bpy.context).output_folder / (Path(bpy.data.filepath).stem or "untitled")
    if len(bpy.data.scenes) > 1:
        root /= bpy.path.clean_name(scene.name)
    return root / command
