"""What a picture was lit with, and the light of lights that stay the same while others change."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from .pictures import SampleSum

# With more lights, telling which of them have changed takes longer than it saves.
MOST_COMPARED = 512


@dataclass(frozen=True)
class LightingState:
    """What lit a picture: state of surfaces and view (see `same_state`), lights, and sources of their visibility."""

    state: tuple
    lights: tuple
    sources: tuple

    def changes(self, new: LightingState) -> frozenset[int] | None:
        """Numbers of the lights that are others in the picture `new`; None where more has changed."""
        count = len(self.lights)
        if not same_state(new.state, self.state) or len(new.lights) != count or count > MOST_COMPARED:
            return None
        pairs = zip(self.lights, new.lights, strict=True)
        return frozenset(number for number, (a, b) in enumerate(pairs) if not is_equal(a, b))

    def has_same_visibility(self, new: LightingState, changed: frozenset[int]) -> bool:
        """True if the visibility is the same, but for that of the lights `changed`."""
        if len(self.sources) != len(new.sources):
            return False
        static = [number for number in range(len(self.sources)) if number not in changed]
        return all(a is b for number in static for a, b in zip(self.sources[number], new.sources[number], strict=True))


def is_equal(a, b) -> bool:
    """True for lights that look the same, and for their parts: arrays, cones, patterns, words and numbers."""
    if a is b or type(a) is not type(b):
        return a is b
    if not is_dataclass(a):
        return np.array_equal(a, b)
    names = (item.name for item in fields(a) if item.name != "children")
    return all(is_equal(getattr(a, name), getattr(b, name)) for name in names)


@dataclass(frozen=True)
class StaticLighting:
    """The light of all lights but the `moving` ones, kept while these change."""

    lit: LightingState
    moving: frozenset[int]
    pictures: list[SampleSum]

    def fits(self, new: LightingState) -> bool:
        """True if it is a part of the picture `new`."""
        changes = self.lit.changes(new)
        return changes is not None and changes <= self.moving and self.lit.has_same_visibility(new, self.moving)


def same_state(new, old) -> bool:
    """True if two states have identical objects of the scene, their first part, and equal values, their second."""
    return old is not None and new[1] == old[1] and all(a is b for a, b in zip(new[0], old[0], strict=True))
