"""Light groups of `match`: one for each light whose settings can be changed."""

from ...scene import SceneError, listed


def own_light_groups(scene, lights: tuple[str, ...]) -> dict[str, list]:
    """Names of a light group for each of the light objects called `lights`, () for all, and its objects: those that
    share their data. Lights whose settings cannot be changed are in none. Raises SceneError for a name of no light."""
    known = {ob.name: ob for ob in scene.objects if ob.type == "LIGHT" and not ob.hide_render}
    if unknown := [name for name in lights if name not in known]:
        names = listed(map(repr, known)) or "none"
        raise SceneError(f"light {unknown[0]!r} is not in scene {scene.name!r}; lights there: {names}")
    chosen = [ob for name, ob in sorted(known.items()) if name in (lights or known) and not reason_to_keep(ob)]
    several = dict.fromkeys(ob.data for ob in chosen)
    return {f"Light {n}": [ob for ob in known.values() if ob.data == data] for n, data in enumerate(several, 1)}


def regroup(scene, lights: tuple[str, ...]) -> list[str]:
    """Put `lights`, () for all, into light groups of their own, and nothing else into any; returns the groups."""
    for ob in scene.objects:
        ob.lightgroup = ""
    if scene.world is not None:
        scene.world.lightgroup = ""
    groups = own_light_groups(scene, lights)
    for name, objects in groups.items():
        for ob in objects:
            ob.lightgroup = name
    return list(groups)


def reason_to_keep(ob) -> str:
    """Why the settings of a light object cannot be changed; "" if they can."""
    if ob.library is not None or ob.data.library is not None:
        return "it is linked from another file"
    return "its settings are animated or driven" if is_animated(ob.data) else ""


def reason_to_stay(ob) -> str:
    """Why a light object may not be moved; "" if it may."""
    if is_linked(ob):
        return "it is linked from another file"
    if active := [constraint.name for constraint in ob.constraints if constraint.enabled]:
        return f"its constraint {active[0]!r} moves it: switch it off or apply it"
    if is_animated(ob):
        return "it is animated or driven"
    if any(ob.lock_rotation) or (any(ob.lock_location) and ob.data.type != "SUN"):
        return "its location or rotation is locked: unlock it in the tab Item"
    return ""


def is_linked(block) -> bool:
    """True for what another file owns, overrides that may not be edited included."""
    override = block.override_library
    return block.library is not None or (override is not None and override.is_system_override)


def is_animated(owner, path: str = "") -> bool:
    """True if keyframes or drivers set properties of an object or its data; with a `path`, that property."""
    animation = owner.animation_data
    if animation is None:
        return False
    if not path:
        return bool(animation.action or len(animation.drivers))
    strips = [strip for track in animation.nla_tracks for strip in track.strips]
    pairs = [(used.action, used.action_slot) for used in (animation, *strips) if used.action is not None]
    curves = [*animation.drivers]
    for action, slot in pairs:
        bags = [strip.channelbag(slot) for layer in action.layers for strip in layer.strips] if slot else []
        curves += [curve for bag in bags if bag is not None for curve in bag.fcurves]
    return any(curve.data_path == path for curve in curves)
