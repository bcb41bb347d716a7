"""Which lights shine, and bounce, while Cycles bakes (runs in the child)."""

from contextlib import contextmanager
from dataclasses import replace

import bpy

from ..lights.emission import emission_of
from ..lights.world import may_shine
from ..materials import aovs, graph
from ..materials.bsdfs import emission_sockets

# BOUNCES: settings of Cycles on which indirect light depends, and which pictures of direct light switch off.
BOUNCES = ("max_bounces", "sample_clamp_indirect", "blur_glossy", "caustics_reflective", "use_fast_gi")
GLOW = "Glowing surfaces"  # the row of all that glow


def bounces_of(scene) -> list[tuple]:
    """The settings of the file, as for `changed_properties`, on which its indirect light depends."""
    owners = [(scene.cycles, name) for name in BOUNCES]
    owners += [(material.cycles, "emission_sampling") for material in bpy.data.materials]
    return [(owner, name, getattr(owner, name)) for owner, name in owners]


def lights_by_row(scene, world, lights: list) -> list:
    """The lights with the group by whose name they are baked for themselves: their own, else one of their name."""
    alone = _alone(scene, world)
    return [replace(one, group=(one.group or one.name) if one.name in alone else GLOW) for one in lights]


def _alone(scene, world) -> set[str]:
    """The names of the scene's own lamps and of its world, which have rows of their own."""
    return {ob.name for ob in scene.objects if ob.type == "LIGHT"} | ({world.name} if world is not None else set())


def rows_of_lights(scene) -> int:
    """About how many rows `lights_by_row` makes, told by the file alone."""
    rows = {ob.lightgroup or ob.name for ob in scene.objects if ob.type == "LIGHT" and not ob.hide_render}
    if scene.world is not None and may_shine(scene.world):
        rows.add(scene.world.lightgroup or scene.world.name)
    return len(rows) + any(emission_of(material).emits for material in aovs.materials_of(scene))


@contextmanager
def lit_by(opened, names: set[str] | None = None):
    """Within this context only the lights `names` of a `bake.BakeScene` shine, and bounce as the file has it; None: all
    do."""
    scene, world, dark, cuts = opened.scene, opened.world, [], []
    if names is not None:
        alone = _alone(scene, world)
        has_glow, lamps = not names <= alone, [ob for ob in bpy.data.objects if ob.type == "LIGHT"]
        # Lamps that only instances bring shine with what glows, or with one of the scene that has the same name.
        dark = [ob for ob in lamps if not (ob.name in names if ob.name in alone else has_glow)]
        world = world if world is not None and world.name in names else None
        cuts = [] if has_glow else _glowing_sockets()
    with graph.TreeChanges() as changes:
        for change in (*opened.bounces, (scene, "world", world), *((ob, "hide_render", True) for ob in dark)):
            changes.set(*change)
        for socket in cuts:
            changes.relink(socket)
            changes.set(socket, "default_value", 0.0)
        yield


def shader_nodes() -> list:
    """The nodes of all materials and of groups of shader nodes."""
    trees = [graph.tree_in_use(material) for material in bpy.data.materials] + list(bpy.data.node_groups)
    return [node for tree in trees if tree is not None and tree.type == "SHADER" for node in tree.nodes]


def _glowing_sockets() -> list:
    """The sockets by which surfaces glow, in materials and in groups."""
    return [sockets[1] for sockets in map(emission_sockets, shader_nodes()) if sockets]
