"""Lights of an evaluated scene (runs in the child).

They are as in Cycles 4.5 and 5.2, measured to 2e-5. The strength is S = color * temperature color * energy *
2^exposure. The radiance L follows from it:

- Area lights: L = S / (pi area), or S / pi without Normalize. They emit along the local -Z axis only. The first two
  columns of the world matrix scale their size and shape.
- Points and spots of radius r, balls or disks: L = S / (4 pi^2 r^2), or S / pi without Normalize. The object does not
  scale the radius, but it does scale the cone of a spot.
- Suns of half angle h: L = S / (pi sin^2 h), or S without Normalize.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np

from ...scene import FARTHEST, EllipseLight, Light, PointLight, QuadLight, SpotCone, SpotLight, SunLight, listed
from ..evaluated import EmitterTraits, RenderedSurface, surface_instancer
from ..materials.aovs import CyclesReasons, OpaqueInput
from ..materials.graph import tree_in_use
from ..render_settings import cycles_setting
from .emission import Falloff, ObjectFacts, emission_of, emission_warnings, open_studio
from .linking import Receivers
from .meshes import SIDE_PROPERTY, MeshLight, collect_mesh_lights, mark_transparent, mesh_area_lights
from .textures import NodeLight, with_node_emission

# SHEAR_COSINE: a transform is sheared if the cosine between two of its axes is larger.
SHEAR_COSINE = 1e-4
# LEAST_SPREAD: full angle in degrees of the narrowest beam that is shaded.
LEAST_SPREAD = 0.1
# Size of lights that have none; only their solid angle times their radiance matters. LEAST_RADIUS: in m.
# LEAST_ANGLE: half angle of a sun in rad.
LEAST_RADIUS, LEAST_ANGLE = 1e-6, 2e-5
# WIDEST_SUN: largest half angle of a sun in rad. Its disk is in a plane in front of the eye and cannot fill pi / 2.
WIDEST_SUN = 1.5698
# SHARPEST: `SpotCone.sharpness` of a cone without blend.
SHARPEST = 1e9


@dataclass
class LightInventory:
    """The lights of a scene that can be shaded, and warnings about those that cannot."""

    lights: list[Light] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    left_out: set[str] = field(default_factory=set)  # full names of the objects to leave out of the reference
    node_lights: dict[int, NodeLight] = field(default_factory=dict)  # by position in `lights`
    receivers: Receivers = field(default_factory=lambda: Receivers([]))
    meshes: list[MeshLight] = field(default_factory=list)
    instancers: dict[str, RenderedSurface] = field(default_factory=dict)  # by full name
    unshaded: list[str] = field(default_factory=list)  # reasons why materials are not shaded, see `inject_aovs`
    hit: set[str] = field(default_factory=set)  # names of the lights that random rays hit, if some overlap
    world: Any = None  # the world that lights the scene
    sky_detail: float = 0.0  # see `environment.fine_detail`
    look_until: float = np.inf  # processor time
    behind: Any = None  # the world that is seen behind the surfaces
    occluders: Any = None  # visibility.Occluders, if shadows are wanted
    made_opaque: list[OpaqueInput] = field(default_factory=list)  # see `inject_aovs`
    glass: list = field(default_factory=list)  # materials that are seen through, see `inject_aovs`
    settings: dict[str, list[float]] = field(default_factory=dict)  # see `Extraction.light_settings`
    left_to_cycles: CyclesReasons = field(default_factory=CyclesReasons)  # what finished pictures leave to Cycles

    def __post_init__(self):
        self._noted = set(self.warnings)

    @property
    def emitting_materials(self) -> frozenset[str]:
        """Full names of the materials that may emit."""
        return frozenset(name for mesh in self.meshes for name in mesh.emitting_materials)

    def warn(self, message: str) -> None:
        """Add `message` to the warnings, once."""
        if message not in self._noted:
            self._noted.add(message)
            self.warnings.append(message)


def collect_lights(depsgraph, override=None) -> LightInventory:
    """All lights in a render of `depsgraph`, instances included; the material `override` replaces all others.

    What `node_lights` and `meshes` of the inventory emit is known only after `rendered_lights` has rendered them.
    """
    receivers = Receivers([instance.object.original for instance in depsgraph.object_instances])
    inventory = LightInventory(receivers=receivers)
    placed, hit = [], []  # hit: lights that random rays from surfaces can hit
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type != "LIGHT" or not instance.show_self:
            continue
        matrix = np.array(instance.matrix_world, dtype=np.float64)
        problem = reason_to_leave_out(ob, matrix)
        if problem:
            inventory.left_out.add(ob.original.name_full)
            if not cycles_setting(ob.data, "is_portal"):  # which only guides the sampling of the world
                left_out = f"its {ob.data.energy:g} W are left out of the Cycles reference as well"
                inventory.warn(f"light {ob.original.name!r}: {problem}; {left_out}")
                inventory.left_to_cycles.everything.append(f"light {ob.original.name!r}, {problem}")
            continue
        light = area_light(ob, matrix, EmitterTraits.of(instance), receivers)
        if np.any(light.radiance != 0.0):
            placed.append((ob.original.name_full, light, node_light(ob, matrix, inventory, instance)))
            inventory.settings[light.name] = [ob.data.energy, ob.data.exposure, *ob.data.color]
            if cycles_setting(ob.data, "use_multiple_importance_sampling") and ob.data.type == "AREA":
                hit.append(light)
            note_unsupported(ob, matrix, inventory)
            if _is_sheared(ob, matrix):
                inventory.left_to_cycles.everything.append(f"light {ob.original.name!r}, whose transform is sheared")
            instancer = surface_instancer(instance)
            if instancer is not None:
                inventory.instancers[instancer.original.name_full] = instancer
    # If one instance is unusable, all instances of the object are left out: the reference can only drop the object.
    for name, light, source in placed:
        if name not in inventory.left_out:
            if source is not None:
                inventory.node_lights[len(inventory.lights)] = source
            inventory.lights.append(light)
    if overlapping_pairs(hit):
        inventory.hit = {light.name for light in hit}
    lost: list[str] = []
    inventory.meshes = collect_mesh_lights(depsgraph, override, receivers, lost.append)
    for reason in lost:
        inventory.warn(reason)
    inventory.left_to_cycles.everything += lost
    for mesh in inventory.meshes:
        inventory.instancers.update(mesh.instancers)
    for light in [*inventory.lights, *(mesh.light for mesh in inventory.meshes)]:
        if light.affects_diffuse != light.affects_specular:
            inventory.warn(half_hidden(light))
    return inventory


# NAMED_PAIRS: how many lights, or pairs of overlapping ones, a warning names. LEAST_COLORS: least `color_spread` named.
NAMED_PAIRS, LEAST_COLORS = 3, 0.05
# MOST_PAIRS: the search ends after this many pairs.
MOST_PAIRS = 1000
_AREA_LIGHTS = {shape: kind for kind in (QuadLight, EllipseLight) for shape in kind.SHAPES}
# TRIED: points along each side of a light that are tested for an overlap.
TRIED = 16
# CHUNK: how many lights are compared with all others at once.
CHUNK = 256


def overlapping_pairs(lights: list[Light]) -> list[tuple[Light, Light, float]]:
    """Pairs of overlapping lights, each with the share of the smaller light that lies in the other; at most MOST_PAIRS.

    Both lights lie in one plane, up to single precision, shine to the same side and light a common object.
    """
    if len(lights) < 2:
        return []
    axis = np.ptp([light.center for light in lights], axis=0).argmax()
    lights = sorted(lights, key=lambda light: light.center[axis])
    center, direction, half_u, half_v = (
        np.array([getattr(light, name) for light in lights]) for name in ("center", "direction", "half_u", "half_v")
    )
    reach = np.sqrt((half_u**2 + half_v**2).sum(axis=1))
    rounding = 4.0 * np.spacing((np.abs(center).max(axis=1) + reach).astype(np.float32))
    pairs = []
    for start in range(0, len(lights), CHUNK):
        chunk = slice(start, start + CHUNK)
        # Lights before `start` have already been compared with these.
        end = np.searchsorted(center[:, axis], center[chunk, axis].max() + reach[chunk].max() + reach.max(), "right")
        other = slice(start, end)
        offset = center[None, other] - center[chunk, None]
        near = (offset**2).sum(axis=-1) < (reach[chunk, None] + reach[other]) ** 2
        near &= np.abs((offset * direction[chunk, None]).sum(axis=-1)) <= np.maximum(
            rounding[chunk, None], rounding[other]
        )
        near &= direction[chunk] @ direction[other].T > 1.0 - 1e-6
        for first, second in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            lights_of_pair = lights[start + first], lights[start + second]
            receivers = [light.receivers for light in lights_of_pair]
            never_meet = None not in receivers and not set(receivers[0]) & set(receivers[1])
            small, large = sorted(lights_of_pair, key=lambda light: np.linalg.norm(light.area_vector))
            share = 0.0 if never_meet else float(np.mean(_is_inside(_points_of(small), large)))
            if share > 0.0:
                pairs.append((*lights_of_pair, share))
            if len(pairs) == MOST_PAIRS:
                return pairs
    return pairs


def _points_of(light: Light) -> np.ndarray:
    """Points (Q, 3) all over a flat light."""
    steps = (np.arange(TRIED) + 0.5) / TRIED * 2.0 - 1.0
    s, t = (values.ravel() for values in np.meshgrid(steps, steps))
    inside = np.hypot(s, t) < 1.0 if light.is_round else np.ones(len(s), bool)
    return light.center + s[inside, None] * light.half_u + t[inside, None] * light.half_v


def _is_inside(points: np.ndarray, light: Light) -> np.ndarray:
    """Mask (Q,) of the points in the plane of a flat light that lie in it."""
    u, v = ((points - light.center) @ half / np.dot(half, half) for half in (light.half_u, light.half_v))
    return (np.hypot(u, v) if light.is_round else np.maximum(np.abs(u), np.abs(v))) < 1.0


def note_overlaps(inventory: LightInventory) -> None:
    """Warn of overlapping lights: Cycles takes one of two hits at the same distance, and so loses light."""
    pairs = overlapping_pairs([light for light in inventory.lights if light.name in inventory.hit])
    if not pairs:
        return
    names = [f"{first.name!r} and {second.name!r} ({100.0 * share:.0f} %)" for first, second, share in pairs]
    brightness = [[np.abs(light.radiance).sum() for light in pair[:2]] for pair in pairs]
    lost = max(max(pair) / sum(pair) for pair in brightness)
    inventory.warn(
        f"lights {listed(names, NAMED_PAIRS)}: each pair overlaps in one plane, by that share of the smaller light; "
        f"there Cycles loses up to {100.0 * lost:.0f} % of their light, most in sharp reflections, the techniques lose "
        "nothing; move one of each pair forward by 0.1 mm"
    )


def note_colors(inventory: LightInventory) -> None:
    """Warn of lights of several colors, whose shadows are gray: each light, and the sky, has one visibility."""
    groups = [[light] for light in inventory.lights if not light.is_side and light.children]
    groups += [sides] if (sides := [light for light in inventory.lights if light.is_side]) else []
    spreads = {group[0].name: color_spread([leaf for light in group for leaf in light.leaves]) for group in groups}
    names = [
        f"{name!r} ({100.0 * spread:.0f} %)"
        for name, spread in sorted(spreads.items(), key=lambda item: -item[1])
        if spread > LEAST_COLORS
    ]
    if names:
        inventory.warn(
            f"shadows: lights of several colors: {listed(names, NAMED_PAIRS)}: where some of these colors are hidden "
            "and others are not, up to that share of the light is off in a color, as a light has one shadow"
        )


def color_spread(leaves: list[Light]) -> float:
    """By how much the share of a light that is hidden may differ between a color and the mean of all colors."""
    area, center, radiance = (
        np.array([getattr(leaf, name) for leaf in leaves]) for name in ("area_vector", "center", "radiance")
    )
    size = np.linalg.norm(area, axis=1)
    if leaves[0].is_distant:  # solid angles from the origin
        size = np.abs((area * center).sum(axis=1)) / np.maximum((center * center).sum(axis=1) ** 1.5, 1e-30)
    power = np.abs(radiance) * size[:, None]
    shares = power / np.maximum(power.sum(axis=0), 1e-30)
    gray = power.sum(axis=1) / max(power.sum(), 1e-30)
    off = 0.5 * np.abs(shares - gray[:, None]).sum(axis=0)
    return float(off[power.sum(axis=0) > 1e-6 * power.sum()].max(initial=0.0))


def half_hidden(light: Light) -> str:
    """The warning about a light that is hidden from diffuse or from glossy rays, but not from both."""
    kind = "glossy" if light.affects_diffuse else "diffuse"
    kinds, off = ("world", "8 % of diffuse and 35 %") if light.is_side else ("light", "3 % of diffuse and 19 %")
    return (
        f"{kinds} {light.name!r}: it is hidden from {kind} rays; on surfaces that are both diffuse and glossy Cycles "
        f"takes some for others, up to {off} of specular light, most of what is large; the techniques do not"
    )


def rendered_lights(scene, inventory: LightInventory) -> list[Light]:
    """The lights of `inventory`, with the emission of node trees and materials as Cycles renders it.

    Objects that must let light through in the reference, and their materials, get the custom property SIDE_PROPERTY.
    """
    for block in (*bpy.data.objects, *bpy.data.materials):
        if SIDE_PROPERTY in block:
            del block[SIDE_PROPERTY]
    for instancer in inventory.instancers.values():
        mark_transparent(instancer.original, 0, [slot.material for slot in instancer.material_slots])
    if not inventory.node_lights and not inventory.meshes:
        return inventory.lights
    eye = np.array(scene.camera.matrix_world, dtype=np.float64)[:3, 3]
    with open_studio(scene) as studio:
        studio.look_until = inventory.look_until
        lights = with_node_emission(inventory.lights, inventory.node_lights, studio, inventory.warn)
        of_meshes = mesh_area_lights(inventory.meshes, studio, eye, inventory.warn)
    dark = [mesh.ob.name for mesh in inventory.meshes if mesh.is_dropped]
    inventory.left_to_cycles.everything += [f"object {name!r}, which emits from too many faces" for name in dark]
    return lights + of_meshes


def reason_to_leave_out(ob, matrix: np.ndarray) -> str:
    """Why the evaluated light `ob` at `matrix` (4, 4) is not shaded; "" where it is."""
    light = ob.data
    if not np.isfinite(matrix).all():
        return "its transform is not finite"
    if not np.isfinite([light.energy, *light.color]).all():
        return "its power or color is not finite"
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if light.type != "AREA":
        return _reason_to_leave_out_point(light, matrix, lengths)
    if light.shape not in _AREA_LIGHTS:
        return f"shape {light.shape} is not supported"
    if cycles_setting(light, "is_portal"):
        return "it is a light portal, which only guides the sampling of the world"
    if max(np.abs(matrix[:3, 3]).max(), max(_sizes(light)) * lengths.max()) > FARTHEST:
        return f"it is farther away, or larger, than {FARTHEST:g} m"
    if min(_sizes(light)) * lengths[:2].min() <= 0.0 or lengths[2] <= 0.0:
        return "its size or scale is zero"
    if math.degrees(light.spread) < LEAST_SPREAD:
        return f"its spread is {math.degrees(light.spread):g} degrees, expected at least {LEAST_SPREAD:g}"
    return ""


def _reason_to_leave_out_point(light, matrix, lengths) -> str:
    """As `reason_to_leave_out`, for a point, spot or sun light."""
    if light.type not in ("POINT", "SPOT", "SUN"):
        return f"{light.type} lights are not shaded"
    if light.type != "SUN" and max(np.abs(matrix[:3, 3]).max(), light.shadow_soft_size) > FARTHEST:
        return f"it is farther away, or larger, than {FARTHEST:g} m"
    if light.type == "SPOT" and lengths.min() <= 1e-6 * lengths.max() or light.type == "SUN" and lengths[2] <= 0.0:
        return "its scale is zero"
    return ""


def _sizes(light) -> tuple[float, float]:
    """Full side lengths, or diameters, in m before scaling."""
    return light.size, light.size if light.shape in ("SQUARE", "DISK") else light.size_y


def area_light(ob, matrix: np.ndarray, traits: EmitterTraits, receivers: Receivers) -> Light:
    """The `Light` of the evaluated light `ob` at `matrix` (4, 4), without regard to its node tree."""
    light = ob.data
    shared = {
        "group": traits.group,
        "affects_diffuse": traits.diffuse,
        "affects_specular": traits.glossy,
        "receivers": receivers.of(ob.original),
    }
    if light.type != "AREA":
        return point_light(ob, matrix, **shared)
    size_u, size_v = _sizes(light)
    half_u, half_v = 0.5 * size_u * matrix[:3, 0], 0.5 * size_v * matrix[:3, 1]
    return _AREA_LIGHTS[light.shape](
        name=ob.original.name,
        shape=light.shape,
        center=matrix[:3, 3],
        half_u=half_u,
        half_v=half_v,
        direction=-matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]),
        radiance=_radiance(light, half_u, half_v),
        spread=min(light.spread, math.pi),
        **shared,
    )


def _radiance(light, half_u: np.ndarray, half_v: np.ndarray) -> np.ndarray:
    """Emitted radiance (3,) in W m^-2 sr^-1."""
    value = strength(light) / math.pi
    if light.normalize:
        area = 4.0 * np.linalg.norm(half_u) * np.linalg.norm(half_v)
        value /= area * (math.pi / 4.0 if light.shape in ("DISK", "ELLIPSE") else 1.0)
    return value


def node_light(ob, matrix: np.ndarray, inventory: LightInventory, instance=None) -> NodeLight | None:
    """How to render the light `ob` for its node tree; None if it has none, or only one white Emission node.

    That node is the default tree since 5.0.
    """
    light = ob.data
    if tree_in_use(light) is None:
        return None
    emission = emission_of(light)
    if emission.plain:
        return None
    if light.type == "SUN":
        # As in Cycles: a sun has no distance.
        emission.falloff = Falloff()
    for problem in emission_warnings(emission, is_light=True, is_flat=light.type == "AREA"):
        inventory.warn(f"light {ob.original.name!r}: {problem}")
    is_made = instance is not None and instance.is_instance
    of_parent = (instance.parent.original.name_full, *instance.persistent_id) if is_made else ()
    shared = {
        "falloff": emission.falloff or Falloff(),
        "facts": ObjectFacts.of(ob, instance),
        "instance": (ob.original.name_full, *of_parent),
    }
    if light.type in ("AREA", "SUN"):
        is_placed = light.type == "SUN" or emission.is_placed
        return NodeLight(light.original, matrix, emission.varies, is_placed=is_placed, **shared)
    is_ball = not light.use_soft_falloff and light.shadow_soft_size > 0.0
    # In Cycles the UV coordinates of a spot depend on the direction. A disk that turns to each point shines along its
    # normal, so its emission depends on the direction, too.
    by_spot = light.type == "SPOT" and emission.by_uv
    within = bool(emission.directional) or by_spot
    axes = matrix[:3, :3]
    is_placed = emission.is_placed or by_spot or np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR_COSINE
    return NodeLight(
        light.original, matrix, emission.varies, is_placed=emission.varies and is_placed,
        by_ray=within or not is_ball, within=within, by_spot=by_spot, is_mixed=emission.by_place, **shared,
    )  # fmt: skip


def note_unsupported(ob, matrix: np.ndarray, inventory: LightInventory) -> None:
    """Warn of a negative power and of a sheared transform."""
    light, name = ob.data, ob.original.name
    if light.energy < 0.0:
        inventory.warn(f"light {name!r}: negative power {light.energy:g} W subtracts light")
    if _is_sheared(ob, matrix):
        u, v = matrix[:3, 0], matrix[:3, 1]
        more = np.linalg.norm(u) * np.linalg.norm(v) / max(np.linalg.norm(np.cross(u, v)), 1e-30) - 1.0
        skew = abs(np.dot(u, v)) / max(np.linalg.norm(u) * np.linalg.norm(v), 1e-30)
        off = f"some {100.0 * more:.2g} % too bright far away, some {100.0 * skew:.2g} % off near it"
        size = f"Cycles samples it as a rectangle, {off}"
        inventory.warn(f"light {name!r}: its transform is sheared: {size}")


def _is_sheared(ob, matrix: np.ndarray) -> bool:
    if ob.data.type != "AREA":
        return False
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    return np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR_COSINE


def point_light(ob, matrix: np.ndarray, **traits) -> Light:
    """The `Light` of the evaluated point, spot or sun light `ob` at `matrix` (4, 4); `traits` are fields of it."""
    light, axis = ob.data, -matrix[:3, 2] / max(np.linalg.norm(matrix[:3, 2]), 1e-30)
    if light.type == "SUN":
        return _sun(light, ob.original.name, axis, traits)
    radius = max(light.shadow_soft_size, 0.0)
    # Without a size the strength is an intensity: divide it by the area of the small disk that stands for the light.
    area = math.pi * max(radius, LEAST_RADIUS) ** 2 if radius <= LEAST_RADIUS else 1.0
    scale = 1.0 / math.pi / area
    if light.normalize:
        scale /= 4.0 * math.pi * radius**2 if radius > LEAST_RADIUS else 4.0
    radius = max(radius, LEAST_RADIUS)
    is_spot = light.type == "SPOT"
    kind, cone = SpotLight if is_spot else PointLight, {}
    if is_spot:
        cosine = math.cos(0.5 * light.spot_size)
        sharpness = min(1.0 / max((1.0 - cosine) * light.spot_blend, 1e-30), SHARPEST)
        cone["cone"] = SpotCone(np.linalg.inv(matrix[:3, :3]), cosine, sharpness)
    return kind(
        name=ob.original.name,
        shape="FACING_DISK" if light.use_soft_falloff else "BALL",
        center=matrix[:3, 3],
        half_u=np.array([radius, 0.0, 0.0]),
        half_v=np.array([0.0, radius, 0.0]),
        direction=axis if is_spot else np.array([0.0, 0.0, -1.0]),
        radiance=strength(light) * scale,
        **cone,
        **traits,
    )


def strength(light) -> np.ndarray:
    """The strength S (3,): color times power; see the top of this file."""
    value = np.array(light.color, dtype=np.float64) * light.energy * 2.0**light.exposure
    if light.use_temperature:
        value *= np.array(light.temperature_color, dtype=np.float64)[:3]
    return value


def _sun(light, name, axis, traits) -> Light:
    half = 0.5 * light.angle
    value, is_point = strength(light), half <= LEAST_ANGLE
    half = max(half, LEAST_ANGLE)
    if is_point or light.normalize:
        value = value / (math.pi * math.sin(half) ** 2)
    half = min(half, WIDEST_SUN)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first *= math.sin(half) / np.linalg.norm(first)
    return SunLight(
        name=name,
        center=-math.cos(half) * axis,
        half_u=first,
        half_v=np.cross(axis, first),
        direction=axis,
        radiance=value,
        **traits,
    )
