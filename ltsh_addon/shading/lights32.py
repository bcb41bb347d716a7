"""The lights of one pass as single precision takes them: trees of many, lights with equally many corners, skies."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..emitters import small_lights
from ..emitters.light_tree import FEWEST, LightTree, is_special
from ..emitters.mesh_polygons import ConvexBody, convex_bodies
from ..emitters.sky_map import SkyMap
from ..lobes.lobe_integrals import NARROWEST

# Half the directions of an anisotropic lobe to a constant sky: it is .5 % off (root mean square over lobes).
OF_CONSTANT = 96


@dataclass(frozen=True)
class AlikeLights:
    """L lights with equally many corners: vectors (3, L) and numbers (L,), all but `centers` in single precision."""

    centers: np.ndarray  # (2, 3, L) center and centroid
    corners: np.ndarray  # (V, 3, L) of `Light.polygon`, relative to the center
    half_u: np.ndarray
    half_v: np.ndarray
    direction: np.ndarray
    radiance: np.ndarray
    area_vector: np.ndarray
    radius: np.ndarray  # m, around the centroid
    diagonal: np.ndarray  # as in `small_lights.SmallLight`
    numbers: np.ndarray  # among all lights
    column: np.ndarray  # (N,) column here of each of the N lights; -1 for those not here or too narrow

    @classmethod
    def of(cls, lights, numbers) -> "AlikeLights":
        """Those of `lights`, (light, row, corners), with these `numbers` (L,)."""
        alike = [lights[number][0] for number in numbers]
        centroid, area, _, diagonal, radius = small_lights.moments_of(alike)
        center = np.array([light.center for light in alike])
        corners = np.array([lights[number][2] for number in numbers])
        names = ("half_u", "half_v", "direction", "radiance")
        vectors = [np.array([getattr(light, name) for light in alike]) for name in names]
        longest = np.square(corners - corners[:, :1]).sum(axis=2).max(axis=1)
        is_narrow = np.sqrt(np.square(area).sum(axis=1)) < NARROWEST * longest
        column = np.full(len(lights), -1)
        column[numbers] = np.where(is_narrow, -1, np.arange(len(numbers)))
        corners = (corners - center[:, None]).transpose(1, 2, 0)
        others = (values.T.astype(np.float32, order="C") for values in (*vectors, area, radius, diagonal))
        return cls(np.stack([center.T, centroid.T]), corners.astype(np.float32, order="C"), *others, numbers, column)


class Lights(list):
    """Lights (light, row, corners) that affect one pass. Trees of many lights are built once, and kept by the first.

    The last `leaf_count` are leaves of textured lights.
    """

    leaf_count = 0

    @classmethod
    def of(cls, lights, name, leaves=()) -> "Lights":
        """Those of `lights` and `leaves` that affect the pass `name`. A Lights object is returned as it is."""
        if isinstance(lights, Lights):
            return lights
        lights, leaves = ([one for one in many if getattr(one[0], f"affects_{name}")] for many in (lights, leaves))
        result = cls(lights + leaves)
        result.leaf_count = len(leaves)
        if len(result) < FEWEST:
            return result
        cached = vars(result[0][0]).setdefault("_lights", result)
        pairs = zip(result, cached, strict=False)
        is_same = (len(cached), cached.leaf_count) == (len(result), len(leaves))
        if not (is_same and all(one[0] is other[0] and one[1] == other[1] for one, other in pairs)):
            cached = vars(result[0][0])["_lights"] = result
        return cached

    @cached_property
    def trees(self) -> list[tuple[LightTree, np.ndarray]]:
        """Trees of many lights, and the positions here of their lights."""
        kinds: dict[tuple, list[int]] = {}
        for number, (light, row, _) in enumerate(self):
            if not is_special(light):
                kinds.setdefault((row, light.receivers), []).append(number)
        trees = []
        for numbers in kinds.values():
            if len(numbers) >= FEWEST:
                lights, _, corners = zip(*(self[number] for number in numbers), strict=True)
                trees.append((LightTree.of(lights, convex_bodies(lights, corners)), np.array(numbers)))
        return trees

    @cached_property
    def bodies(self) -> list[tuple[ConvexBody, np.ndarray]]:
        """The bodies of all trees, without leaves of textured lights, and the positions here of their lights."""
        bodies = [(body, numbers[body.numbers]) for tree, numbers in self.trees for body in tree.bodies]
        return [(body, numbers) for body, numbers in bodies if numbers.max() < len(self) - self.leaf_count]

    @cached_property
    def alike(self) -> list[AlikeLights]:
        """The lights in trees that are not round, grouped by their number of corners."""
        kinds: dict[int, list[int]] = {}
        for number in (number for _, numbers in self.trees for number in numbers):
            kinds.setdefault(0 if self[number][0].is_round else len(self[number][2]), []).append(number)
        return [AlikeLights.of(self, np.array(numbers)) for count, numbers in kinds.items() if count]

    @cached_property
    def alone(self) -> list[int]:
        """The positions here of the lights that are in no tree."""
        taken = {number for _, numbers in self.trees for number in numbers}
        return [number for number in range(len(self)) if number not in taken]

    @cached_property
    def skies(self) -> list[tuple[SkyMap, object, int]]:
        """Maps of lights that are all `float64.has_patches`, each with one of its lights and their row."""
        kinds: dict[tuple, list] = {}
        for light, row, _ in self:
            kinds.setdefault((row, light.receivers), []).append(light)
        maps = [SkyMap.of(lights) for lights in kinds.values()]
        if len(maps) > 1:
            # With the same directions for all, the parts of a sky in several rows add up.
            most = np.max([sky.directions for sky in maps], axis=0)
            maps = [replace(sky, directions=most) for sky in maps]
        return [(sky, lights[0], row) for sky, ((row, _), lights) in zip(maps, kinds.items(), strict=True)]

    @cached_property
    def whole_skies(self) -> list[tuple[SkyMap, object, int, list[int]]]:
        """Maps of skies whose six sides are constant, each with one of its lights, their row, and their positions."""
        kinds: dict[tuple, list[int]] = {}
        for number, (light, row, _) in enumerate(self):
            if light.is_side and not light.children:
                kinds.setdefault((row, light.receivers), []).append(number)
        skies = []
        for (row, _), numbers in kinds.items():
            sides = [self[number][0] for number in numbers]
            if len({tuple(side.center) for side in sides}) == len(sides) == 6:
                sky = SkyMap.of([replace(side, children=(side,)) for side in sides])
                skies.append(
                    (replace(sky, directions=np.full(len(sky.directions), OF_CONSTANT)), sides[0], row, numbers)
                )
        return skies
