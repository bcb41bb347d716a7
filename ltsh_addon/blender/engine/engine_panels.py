"""Blender's own panels under the engine LTSH: materials, lights, cameras and output are edited as under Cycles."""

from __future__ import annotations

import bpy

from .view_properties import ENGINE

# Settings of Cycles' renders in these tabs mean nothing to other engines.
RENDER_TABS = ("render", "view_layer", "output")


def _is_cycles(panel) -> bool:
    """True for panels that Cycles' add-on brings along."""
    return "cycles" in panel.__module__.split(".")


def shared_panels() -> list[type]:
    """Panels that are about what LTSH shades too: those that Cycles shows, but for its own render settings."""
    panels = [panel for panel in _below(bpy.types.Panel) if ENGINE not in getattr(panel, "COMPAT_ENGINES", (ENGINE,))]
    shown = [panel for panel in panels if "CYCLES" in panel.COMPAT_ENGINES]
    if not shown:
        # Cycles' add-on is off.
        return [panel for panel in panels if "BLENDER_RENDER" in panel.COMPAT_ENGINES]
    return [panel for panel in shown if not _is_cycles(panel) or _is_about_scene(panel)]


def _is_about_scene(panel) -> bool:
    """False for the settings of Cycles' own renders."""
    tab, space = getattr(panel, "bl_context", ""), getattr(panel, "bl_space_type", "")
    return (space == "PROPERTIES" and tab not in ("", *RENDER_TABS)) or space == "NODE_EDITOR"


def _below(panel) -> list[type]:
    """All classes derived from `panel`, each once."""
    found = {}
    for own in panel.__subclasses__():
        found[own] = None
        found.update(dict.fromkeys(_below(own)))
    return list(found)


# Panels that show themselves under our engine, and the engines that they had of their own (None: inherited ones).
_changed: dict[type, set | None] = {}


def register() -> None:
    """Show them."""
    for panel in shared_panels():
        # A set of its own: Cycles' panels share one, those for its render settings included.
        _changed[panel] = vars(panel).get("COMPAT_ENGINES")
        panel.COMPAT_ENGINES = {*panel.COMPAT_ENGINES, ENGINE}


def unregister() -> None:
    """Hide them again."""
    while _changed:
        panel, engines = _changed.popitem()
        if engines is None:
            del panel.COMPAT_ENGINES
        else:
            panel.COMPAT_ENGINES = engines
