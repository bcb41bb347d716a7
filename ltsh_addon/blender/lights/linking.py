"""Light linking: which objects a light reaches, and which block it (runs in the child).

Measured in 4.5.15 and 5.2.3: a light with a receiver collection reaches what the collection includes, or everything
if it includes nothing, except what it excludes. Each object and each child collection directly in the collection has
a state: included or excluded. Everything inside a child has the state of the child. If an object has several states,
its own wins over those of children, and that of the last child over those before. An instance follows its instancer
if that is in any receiver collection, otherwise its own object. Blocker collections work in the same way.
"""

from dataclasses import dataclass

import bpy

from ..materials.aovs import RECEIVER_PROPERTY
from ..render_settings import cycles_setting


@dataclass(frozen=True)
class LinkedObjects:
    """Full names of the objects that a receiver collection includes and excludes."""

    included: frozenset[str]
    excluded: frozenset[str]

    def reach(self, name: str) -> bool:
        """True if a light with this receiver collection lights the object of full name `name`."""
        return (not self.included or name in self.included) and name not in self.excluded


def linked_objects(collection) -> LinkedObjects:
    """What the receiver `collection` includes and excludes."""
    states = {}
    for item, child in zip(collection.collection_children, collection.children, strict=True):
        states.update(dict.fromkeys((ob.name_full for ob in child.all_objects), item.light_linking.link_state))
    for item, ob in zip(collection.collection_objects, collection.objects, strict=True):
        states[ob.name_full] = item.light_linking.link_state
    names = {
        state: {name for name, its_state in states.items() if its_state == state} for state in ("INCLUDE", "EXCLUDE")
    }
    return LinkedObjects(frozenset(names["INCLUDE"]), frozenset(names["EXCLUDE"]))


def receiver_collection(ob):
    """The receiver collection of the original light or mesh light `ob`; None: it reaches everything."""
    linking = getattr(ob, "light_linking", None)
    return None if linking is None else linking.receiver_collection


# A mask has 32 bits. OTHER_LIGHTS: the first bit, of lights without a blocker collection. MOST_BLOCKER_SETS: how many
# blocker collections get a bit of their own.
MOST_BLOCKER_SETS = 31
OTHER_LIGHTS = 1


class Blockers:
    """Bit masks of lights and of objects: an object blocks a light if their masks have a bit in common."""

    def __init__(self, emitters: list, most: int = MOST_BLOCKER_SETS):
        """`emitters` are the original objects that light; at most `most` blocker collections count."""
        self._sets, self.light_masks, self.lone_choices, self.unnumbered = [], {}, {}, []
        numbers: dict[str, int] = {}
        for ob in emitters:
            linking = getattr(ob, "light_linking", None)
            collection = None if linking is None else linking.blocker_collection
            mask = OTHER_LIGHTS
            if collection is not None:
                if collection.name_full not in numbers and len(numbers) < most:
                    numbers[collection.name_full] = len(numbers) + 1
                    self._sets.append(linked_objects(collection))
                if collection.name_full in numbers:
                    mask = 1 << numbers[collection.name_full]
                else:
                    self.unnumbered.append(ob.name)
            if ob.type == "LIGHT":
                # Random rays hit no light of zero size.
                size = {"POINT": "shadow_soft_size", "SPOT": "shadow_soft_size", "SUN": "angle"}.get(ob.data.type)
                is_met = cycles_setting(ob.data, "use_multiple_importance_sampling")
                is_met = is_met and (size is None or getattr(ob.data, size) > 0.0)
                if not ob.data.use_shadow and not is_met:
                    mask = 0
                elif not (ob.data.use_shadow and is_met):
                    self.lone_choices[ob.name] = "surface" if is_met else "light"
            self.light_masks[ob.name] = mask
        self._named = frozenset().union(*(linked.included | linked.excluded for linked in self._sets))

    def mask_of(self, instance) -> int:
        """The mask of a depsgraph instance as a blocker."""
        name = instance.object.original.name_full
        if instance.is_instance and instance.parent is not None and instance.parent.original.name_full in self._named:
            name = instance.parent.original.name_full
        return OTHER_LIGHTS | sum(2 << number for number, linked in enumerate(self._sets) if linked.reach(name))


class Receivers:
    """Numbered sets of objects that the same lights reach; set 0 holds those that no receiver collection names."""

    def __init__(self, emitters: list):
        """`emitters` are the original objects that light."""
        collections = {}
        for ob in emitters:
            collection = receiver_collection(ob)
            if collection is not None:
                collections[collection.name_full] = collection
        self._linked = {name: linked_objects(collection) for name, collection in collections.items()}
        self._sets = {tuple(linked.reach("") for linked in self._linked.values()): 0}
        self.numbers = {}
        for name in sorted(set().union(*(linked.included | linked.excluded for linked in self._linked.values()))):
            reached = tuple(linked.reach(name) for linked in self._linked.values())
            self.numbers[name] = self._sets.setdefault(reached, len(self._sets))
        self._reached = {
            name: tuple(number for reached, number in self._sets.items() if reached[position])
            for position, name in enumerate(self._linked)
        }

    def of(self, ob) -> tuple[int, ...] | None:
        """`Light.receivers` of the original object `ob`."""
        collection = receiver_collection(ob)
        return None if collection is None else self._reached[collection.name_full]

    def mark(self) -> None:
        """Give every mentioned object its number as RECEIVER_PROPERTY; delete that property of all other objects."""
        for ob in bpy.data.objects:
            if RECEIVER_PROPERTY in ob:
                del ob[RECEIVER_PROPERTY]
            if ob.name_full in self.numbers:
                ob[RECEIVER_PROPERTY] = self.numbers[ob.name_full]
