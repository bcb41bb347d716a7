"""Stands for bpy.types.UILayout, which Blender makes in a window alone.

Refuses what that would refuse, and remembers the rest.
"""

import types
from dataclasses import dataclass, field
from types import SimpleNamespace

import bpy

FUNCTIONS = bpy.types.UILayout.bl_rna.functions
NESTED = ("row", "column", "box", "split", "grid_flow", "column_flow")


@dataclass(frozen=True)
class Shown:
    """One thing in a panel: `kind` is the function of the layout, `what` its text, property or operator.

    A button has a `text` and the `values` of its operator, and may be `pressed`.
    """

    kind: str
    what: str
    enabled: bool
    icon: str = ""
    text: str = ""
    pressed: bool = False
    values: object = field(default=None, compare=False)


class _Values:
    """Properties of an operator behind a button; only those that it has can be set."""

    def __init__(self, properties):
        object.__setattr__(self, "_properties", properties)

    def __setattr__(self, name, value):
        assert name in self._properties, f"the operator has no property {name!r}"
        object.__setattr__(self, name, value)


class Layout:
    """A layout that records into `shown`, whose enabled state goes down to what is nested in it."""

    def __init__(self, shown=None, parent=None):
        self.shown, self._parent = [] if shown is None else shown, parent
        self.enabled = self.active = True

    def __setattr__(self, name, value):
        own = ("shown", "_parent")
        assert name in own or name in bpy.types.UILayout.bl_rna.properties, f"layouts have no {name!r}"
        object.__setattr__(self, name, value)

    def __getattr__(self, name):
        assert name in FUNCTIONS, f"layouts have no {name!r}"

        def call(*values, **named):
            return self._called(name, _arguments(FUNCTIONS[name], values, named))

        return call

    def _enabled(self) -> bool:
        return self.enabled and (self._parent is None or self._parent._enabled())

    def _called(self, name, given):
        nested = Layout(self.shown, self)
        if name in NESTED:
            return nested
        if name == "panel":
            self._note(name, given["idname"], given)
            return nested, Layout(self.shown, self)
        if name.startswith("operator"):
            values = _Values(_operator(given["operator"]).properties)
            self._note("operator", given["operator"], given, values)
            return values
        if name.startswith("prop"):
            for data, key in (("data", "property"), ("search_data", "search_property")):
                if data in given:
                    properties = given[data].bl_rna.properties
                    assert given[key] in properties, f"{given[data]!r} has no property {given[key]!r}"
            self._note("prop", given["property"], given)
        elif name == "popover":
            assert hasattr(bpy.types, given["panel"]), given["panel"]
            self._note(name, given["panel"], given)
        elif name == "progress":
            self._note(name, given["text"], given)
        elif name == "label":
            self._note(name, given.get("text", ""), given)
        return None

    def _note(self, kind, what, given, values=None):
        icon, text, pressed = given.get("icon", ""), given.get("text", ""), given.get("depress", False)
        self.shown.append(Shown(kind, what, self._enabled(), icon, text, pressed, values))


def _arguments(function, values, named) -> dict:
    """Arguments by name, checked as Blender does."""
    wanted = [item for item in function.parameters if not item.is_output]
    given = {item.identifier: value for item, value in zip(wanted, values, strict=False)} | named
    for name, value in given.items():
        assert name in function.parameters, f"{function.identifier}() has no argument {name!r}"
        if name == "icon":
            assert value in function.parameters[name].enum_items, f"{function.identifier}(): no icon {value!r}"
        if name == "text":
            assert isinstance(value, str), f"{function.identifier}(): text is {value!r}"
    return given


def _operator(name: str):
    """Type of the operator; an error where there is none."""
    module, _, function = name.partition(".")
    return getattr(getattr(bpy.ops, module), function).get_rna_type()


def stand_in(panel) -> type:
    """A class with the methods of `panel` that can be instantiated, which Blender's own panels cannot."""
    found = object
    for kind in reversed(panel.__mro__):
        if not kind.__module__.startswith(("bpy", "_bpy", "builtins")):
            cell = types.CellType()
            values = vars(kind).items()
            members = {name: _bound_to(value, cell) for name, value in values if callable(value) or name == "key"}
            found = type("StandIn", (found,), members)
            cell.cell_contents = found
    return found


def _bound_to(value, cell):
    """`value`; a method that calls super() is made one of the class in `cell`."""
    if not isinstance(value, types.FunctionType) or "__class__" not in value.__code__.co_freevars:
        return value
    pairs = zip(value.__code__.co_freevars, value.__closure__, strict=True)
    closure = tuple(cell if name == "__class__" else own for name, own in pairs)
    return types.FunctionType(value.__code__, value.__globals__, value.__name__, value.__defaults__, closure)


def drawn(panel, function="draw", width=300, scale=1.0, **context) -> list[Shown]:
    """What `panel` draws in a region `width` pixels wide."""
    found = stand_in(panel)()
    found.layout = Layout()
    space = SimpleNamespace(type=panel.bl_space_type, image=None, use_local_camera=False)
    getattr(found, function)(context_of(width, scale, **{"space_data": space, **context}))
    return found.layout.shown


def context_of(width=300, scale=1.0, **context):
    """Stands for the context of a region `width` pixels wide."""
    preferences = SimpleNamespace(system=SimpleNamespace(ui_scale=scale), addons=bpy.context.preferences.addons)
    now = {name: getattr(bpy.context, name) for name in ("scene", "object", "selected_objects", "view_layer", "mode",
                                                       "screen")}  # fmt: skip
    now |= {"region": SimpleNamespace(width=width), "preferences": preferences}
    return SimpleNamespace(**{**now, **context})


def texts(shown) -> str:
    """All labels, joined: wrapped text reads as one."""
    return " ".join(item.what for item in shown if item.kind == "label")


def buttons(shown) -> dict[str, bool]:
    """Operators of the buttons, and whether they can be clicked."""
    return {item.what: item.enabled for item in shown if item.kind == "operator"}
