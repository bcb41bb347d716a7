"""Settings that Cycles' add-on keeps with scenes, lights and materials, also where that add-on is off."""

from __future__ import annotations

DEFAULTS = {"film_exposure": 1.0, "is_portal": False, "use_bump_map_correction": True}


def cycles_setting(owner, name: str):
    """`owner.cycles.<name>`, or Cycles' default."""
    return getattr(getattr(owner, "cycles", None), name, DEFAULTS[name])
