"""Preferences of the add-on: cores, memory, the folder of results, what is logged.

Limits reach the shading and every child process through the environment, which all of them inherit: a farm sets the
same variables. A preference of 0 leaves a variable as Blender was started with.
"""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...shading.workers import CORES_VARIABLE

# "bl_ext.user_default.ltsh" in Blender, where add-ons are known by it; "ltsh_addon" when imported from elsewhere.
ADDON = __package__.rsplit(".", 3)[0]
LOGGER = __package__.rsplit(".", 2)[0]
MEMORY_VARIABLE = "LTSH_MEMORY_MIB"
RESULTS = "results"
LOG_LEVELS = (
    ("ERROR", "Errors", "Only what failed"),
    ("WARNING", "Warnings", "Also what went another way than asked"),
    ("INFO", "Information", "Also what is done and how long it takes"),
    ("DEBUG", "Details", "Everything, to find the cause of a fault"),
)
_DEFAULT_LOG_LEVEL = "WARNING"
_NO_LIMIT = 0


@dataclass(frozen=True)
class Preferences:
    """What is set; 0 means no limit of the add-on's own. `output_folder` is absolute and need not exist."""

    cores: int
    memory_mib: int
    output_folder: Path
    log_level: str


def preferences(context) -> Preferences:
    """The preferences of the running Blender, or the defaults where the add-on is loaded without being enabled."""
    addon = context.preferences.addons.get(ADDON)
    stored = addon.preferences if addon is not None else None
    if stored is None:
        return Preferences(_NO_LIMIT, _NO_LIMIT, default_output_folder(), _DEFAULT_LOG_LEVEL)
    chosen = stored.output_folder.strip()
    folder = Path(bpy.path.abspath(chosen)).absolute() if chosen else default_output_folder()
    return Preferences(stored.cores, stored.memory_mib, folder, stored.log_level)


def default_output_folder() -> Path:
    """The folder for files of this extension, which stays when it is updated."""
    if ADDON.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ADDON, path=RESULTS))
    return Path(bpy.utils.user_resource("DATAFILES", path="ltsh")) / RESULTS


class LTSH_AddonPreferences(bpy.types.AddonPreferences):
    bl_idname = ADDON

    cores: bpy.props.IntProperty(
        name="Processor Cores",
        description="How many cores shading, baking and the Cycles reference may use; 0 takes all of them",
        min=0, max=1024, soft_max=64, default=_NO_LIMIT, update=lambda self, context: apply(context),
    )  # fmt: skip
    memory_mib: bpy.props.IntProperty(
        name="Memory Limit",
        description="A job that needs more than this many MiB is refused before it starts; "
        "0 allows what the machine has free",
        min=0, soft_max=2**20, step=1024, default=_NO_LIMIT, update=lambda self, context: apply(context),
    )  # fmt: skip
    output_folder: bpy.props.StringProperty(
        name="Output Folder",
        description="Where pictures, reports and baked textures are written; // is the folder of the .blend. "
        "Empty takes a folder of the extension's own, which goes when the extension is uninstalled",
        subtype="DIR_PATH", default="",
    )  # fmt: skip
    log_level: bpy.props.EnumProperty(
        name="Log",
        description="What the add-on writes to the console that Blender was started from",
        items=LOG_LEVELS, default=_DEFAULT_LOG_LEVEL, update=lambda self, context: apply(context),
    )  # fmt: skip

    def draw(self, context):
        from .availability import missing_libraries

        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        missing = missing_libraries()
        if missing:
            layout.label(text=missing, icon="ERROR", translate=False)
        limits = layout.column(align=True)
        limits.prop(self, "cores", text="Processor Cores (0: All)")
        limits.prop(self, "memory_mib", text="Memory Limit, MiB (0: All Free)")
        layout.prop(self, "output_folder", placeholder=str(default_output_folder()))
        layout.prop(self, "log_level")


_variables_before: dict[str, str | None] = {}
_log_handlers: list[logging.Handler] = []


def apply(context) -> None:
    """Put limits and log level into effect, here and for processes started from now on."""
    chosen = preferences(context)
    for name, value in ((CORES_VARIABLE, chosen.cores), (MEMORY_VARIABLE, chosen.memory_mib)):
        before = _variables_before.setdefault(name, os.environ.get(name))
        _set_variable(name, str(value) if value != _NO_LIMIT else before)
    logger = logging.getLogger(LOGGER)
    logger.setLevel(chosen.log_level)
    if not _log_handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("LTSH %(levelname)s: %(message)s"))
        logger.addHandler(handler)
        _log_handlers.append(handler)


def _set_variable(name: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value


def register() -> None:
    """Add the preferences and put them into effect."""
    bpy.utils.register_class(LTSH_AddonPreferences)
    apply(bpy.context)


def unregister() -> None:
    """Take the preferences and their effects back."""
    logger = logging.getLogger(LOGGER)
    while _log_handlers:
        logger.removeHandler(_log_handlers.pop())
    logger.setLevel(logging.NOTSET)
    while _variables_before:
        _set_variable(*_variables_before.popitem())
    bpy.utils.unregister_class(LTSH_AddonPreferences)
