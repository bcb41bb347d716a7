"""Many lights at once: lights that are far away, face away or count little are shaded together.

The lights of a group are the leaves of a binary tree. Neighboring samples form a tile. In every branch, a tile takes
the coarsest node that is small, or whose error is at most ERROR of the light that the tile gets from the group on
average. These are far fewer nodes than there are lights. A node becomes one point, two or four, with the mean and the
variances of its brightness and the mean of each color; the normals of its lights count as uniform around their mean.

The error is estimated as the light of the node times the fourth power of its size, in units of the length over which
the integrand changes (see `small_lights`). Distances and angles are bounded for the whole tile. Where a horizon or the
plane of one of the lights may cross the node, some of the node's light adds to the error. Points in the tail of an
"ltsh" lobe get its true value there, as in `tails`.

If a tile has many leaves that are still too large, smaller tiles look at them again. The leaves that remain are shaded
together as polygons; where they are many of one convex body, all of it is shaded as its outline. On smooth surfaces,
the light of ten samples of a tile is interpolated to the others, except for near nodes. (Walter et al. 2005,
"Lightcuts", with tiles instead of points, doi:10.1145/1073204.1073318.)
"""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ..lobes.polygon import dot
from ..scene import Light
from . import light_nodes, small_lights
from .mesh_polygons import ConvexBody
from .tails import NEAR_RADII

# A group with fewer lights is shaded light by light.
FEWEST = 64
# Size of a node in units of the length over which the integrand changes. SMALL: such nodes are used whatever their
# light. LARGEST: no larger node is used. ERROR: in between, a node is used if its error is at most this share of the
# light that a tile gets from the group, for diffuse and for specular lobes.
SMALL, LARGEST, ERROR = 0.25, 3.0, (4e-4, 2.5e-4)
# Size of the nodes from which that light is estimated.
COARSE = 0.6
# Smaller nodes are one point, others four, and so are those of lights of different colors, if their size times how far
# colors are off the center, in standard deviations, exceeds the square of this.
POINT = 0.08
# The error of a node's points, in units of its light times the fourth power of its size.
FOURTH_ORDER = 1.0
# Leaves are shaded as polygons if their error exceeds LEAF_ERROR of the tile's light, or their size LEAF_SIZE. In the
# finer tiles below the limit is FINER_LEAF_ERROR: these differ in where their lobes point, so that their light may be
# far below its bound.
LEAF_ERROR, FINER_LEAF_ERROR, LEAF_SIZE = 2e-3, 5e-4, 1.0
# The light of a node is interpolated between ten samples if the error of cubics is at most ERROR. That error is
# INTERPOLATED times the fourth power of the tile's size as seen from the node.
INTERPOLATED = 0.3
# Lower limit of divisors: lengths in m, and cosines.
LEAST = np.float32(1e-12)
# TILE: most samples of a tile, for diffuse and for specular lobes. PAIRS: pairs of a sample and a point per chunk.
TILE, PAIRS = (400, 200), 32768
# A tile that must shade more than MANY_LEAVES leaves as polygons is cut into tiles of at most FINER_TILE samples.
FINER_TILE, MANY_LEAVES = 25, 20
# Bodies of which a tile must shade more lights as polygons are shaded as outlines.
MANY_OF_A_BODY = 2
# Least swing of a node, as a share of its power. Up to twice that, its lights count as parallel.
TURNED = 1e-6
# CROSSED: largest error of a node that a horizon crosses, as a share of its light times the sine of its radius. SWUNG:
# the same as a share of the swing of its lights, if some of them may face away.
CROSSED, SWUNG = 0.1, 0.02

# The four points (4, 3) of a node along its axes. They have its variances; for a square they are the Gauss points.
CORNERS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])


def is_special(light: Light) -> bool:
    """True for a light that no tree takes."""
    is_plain = not (light.has_profile or light.is_distant or light.is_facing or light.cone is not None)
    return not is_plain or min(radiance := light.radiance.tolist()) < 0.0 or max(radiance) == 0.0


@dataclass(frozen=True)
class LightTree:
    """N nodes with the root first. `number` is the light of a leaf, and -1 for a branch."""

    center: np.ndarray  # (N, 3) m, of brightness
    reach: np.ndarray  # (N,) m: sqrt(3) standard deviations of the brightness; for a square, half its diagonal
    radius: np.ndarray  # (N,) m: no point of the lights is farther from the center
    axes: np.ndarray  # (3, 3, N) m: principal axes of the brightness (first axis), a standard deviation long
    axis: np.ndarray  # (N, 3) mean direction into which the lights shine
    normal_spread: np.ndarray  # (N,) rad: largest angle of a light's direction from `axis`; float32, as reach and axis
    vector: np.ndarray  # (N, 3): mean radiance times area vectors
    swing: np.ndarray  # (N,) mean radiance times area: how much of a vector may belong to lights that face away
    turn: np.ndarray  # (3, 3, N) matrices of the squares of how far power times cosines may be off; float32
    color: np.ndarray  # (3, N) of the light, 1 on average
    tint: np.ndarray  # (3, 3, N): how far the mean of each color is off the center along each axis, in units of `axes`
    power: np.ndarray  # (N,) mean radiance times area
    diagonal: np.ndarray  # (N,) mean of `SmallLight.diagonal`; float32, as are swing and color
    children: np.ndarray  # (N, 2) numbers of nodes
    number: np.ndarray  # (N,) of the light
    body: np.ndarray  # (N,) number of the body to which all lights of the node belong, or -1
    bodies: tuple[ConvexBody, ...]
    is_even: bool  # all lights are equally bright

    @classmethod
    def of(cls, lights, bodies=()) -> "LightTree":
        """The tree of lights whose radiance is positive, some of which form `bodies`."""
        center, area, covariance, diagonal, rim = small_lights.moments_of(lights)
        radiance = np.array([light.radiance for light in lights])
        brightness, size = radiance.mean(axis=1), np.linalg.norm(area, axis=1)
        power, normal = brightness * size, area / size[:, None]
        body = np.arange(len(lights)) + len(bodies)
        for number_of_body, one in enumerate(bodies):
            body[one.numbers] = number_of_body
        order, start, end, children = light_nodes.node_ranges(center, normal, body=body if bodies else None)
        body_of_node = np.where(body[order[start]] == body[order[end - 1]], body[order[start]], -1)
        body_of_node[body_of_node >= len(bodies)] = -1
        sums = light_nodes.NodeSums(order, start, end)
        origin = center.mean(axis=0)
        offset = center - origin
        total, middle, spread, axis, length = sums.moments(power, offset, covariance, normal)
        alone = end - start == 1
        spread[alone] = covariance[order[start[alone]]]
        variances, axes = np.linalg.eigh(spread)
        variances = np.maximum(variances, 0.0)
        axes = (np.sqrt(variances)[:, None] * axes).transpose(2, 1, 0)
        vector = sums(brightness[:, None] * area)
        is_even = bool(np.ptp(radiance, axis=0).max() <= 1e-6 * radiance.max())
        powers = radiance * size[:, None]
        color = sums(powers).T / total
        away = sums(powers[:, :, None] * offset[:, None]).transpose(1, 2, 0)
        away = away / (total * np.maximum(color, 1e-12))[:, None] - middle.T
        tint = (away[:, None] * axes).sum(axis=2) / np.maximum((axes * axes).sum(axis=1), 1e-300)
        # No point gets less than nothing of a color.
        tint *= (color > 1e-12)[:, None] / np.maximum(np.abs(tint).sum(axis=1, keepdims=True), 1.0)
        color, tint = color.astype(np.float32), tint.astype(np.float32)
        mean = vector / total[:, None]
        turn = sums(power[:, None, None] * normal[:, :, None] * normal[:, None, :]) / total[:, None, None]
        # Cosines are taken as uniform over sqrt(3) standard deviations on either side of the mean; around a tube, over
        # 4 % more, which gives the mean of what faces a point there, 1 / pi.
        least, middle_one, _ = np.linalg.eigvalsh(turn).T
        width = 3.0 * (1.0 + 0.08 * (middle_one - least)) ** 2 * total**2
        turn = turn - mean[:, :, None] * mean[:, None, :] + TURNED**2 * np.eye(3)[None]
        turn = (width * turn.transpose(1, 2, 0)).astype(np.float32)
        turned = np.maximum(1.0 - (length / total) ** 2, 0.0) * (end - start > 1)
        swing = (total * np.maximum(np.sqrt(1.5 * turned), TURNED)).astype(np.float32)
        normal_spread = light_nodes.normal_spreads(axis, normal[order], start, end)
        number = np.where(end - start == 1, order[start], -1)
        diagonal = (sums(power * diagonal) / total).astype(np.float32)
        reach = np.sqrt(3.0 * variances.sum(axis=1))
        radius = light_nodes.over_lights(
            np.maximum,
            lambda node, light: light_nodes.lengths(offset[light] - middle[node]) + rim[light],
            (order, start, end),
        )
        sizes = (values.astype(np.float32) for values in (reach, radius))
        directions = (values.astype(np.float32) for values in (axis, normal_spread))
        lights_of_node = vector, swing, turn, color, tint, total, diagonal
        return cls(
            middle + origin, *sizes, axes, *directions, *lights_of_node, children, number, body_of_node, tuple(bodies),
            is_even,
        )  # fmt: skip

    @cached_property
    def is_turned(self) -> np.ndarray:
        """Mask (N,) of the nodes whose lights face differently."""
        return self.swing > 2.0 * TURNED * self.power

    @cached_property
    def tinted(self) -> np.ndarray:
        """The largest distance (N,) of a color from the center, in standard deviations."""
        return np.sqrt(np.square(self.tint).sum(axis=1)).max(axis=0)

    @cached_property
    def places(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Points (W N, 3), W for each node, and their colors (3, W N): for diffuse lobes, then for specular ones."""
        number = np.arange(len(self.center))
        # Of equally bright lights, two opposite corners are enough for specular lobes. Nodes take the pairs in turn, so
        # that their errors cancel.
        pairs = np.stack([CORNERS, -CORNERS], axis=1)[number % len(CORNERS)]
        four, points_by_lobe = CORNERS[0 * number[:, None] + np.arange(len(CORNERS))], []
        for corners in (four, pairs if self.is_even else four):
            points = self.center[:, None] + np.einsum("npk,kxn->npx", corners, self.axes)
            colors = self.color[..., None] * (1.0 + np.einsum("npk,ckn->cnp", corners, self.tint)) / corners.shape[1]
            points_by_lobe.append((points.reshape(-1, 3), colors.reshape(3, -1).astype(np.float32)))
        return points_by_lobe


def _angles(offset, distance, axis):
    """Angles (K,) in rad between vectors `offset` (K, 3), `distance` (K,) long, and the unit vectors `axis` (K, 3)."""
    return np.arccos(np.clip(light_nodes.products(offset, axis) / distance, -1.0, 1.0))


def _heights(ranges, offset, axis, cone):
    """Heights (K,) of nodes at `offset` (K, 3) over planes through tiles with the normals `axis` (K, 3), and how much
    they may differ (K,) within `ranges`: the radius (K,) of the node, half the box (K, 3) of the tile, and the largest
    distance (K,) between them. Normals are within `cone` (K,) in rad of the axis."""
    reach, half, farthest = ranges
    slack = reach + light_nodes.products(half, np.abs(axis)) + np.sin(np.minimum(cone, 0.5 * np.pi)) * farthest
    return light_nodes.products(offset, axis), slack


@dataclass(frozen=True)
class NodeDistances:
    """Where nodes are as seen from tiles, for K pairs; lengths in m."""

    offset: np.ndarray  # (K, 3) from center to center
    half: np.ndarray  # (K, 3) half the box of the tile
    reach: np.ndarray  # of the node
    extent: np.ndarray  # radius of the node
    radius: np.ndarray  # of the tile
    distance: np.ndarray  # between the centers
    nearest: np.ndarray  # from the box to the center of the node
    parallax: np.ndarray  # rad: how much directions from points of the tile to points of the node may differ

    @classmethod
    def of(cls, tree: LightTree, tiles: light_nodes.Tiles, tile, node) -> "NodeDistances":
        """For the numbers (K,) of tiles and nodes."""
        offset = (tree.center[node] - tiles.center[tile]).astype(np.float32)
        half, reach, extent, radius = tiles.half[tile], tree.reach[node], tree.radius[node], tiles.radius[tile]
        gap = np.maximum(np.abs(offset) - half, 0.0)
        distance, nearest = (np.maximum(light_nodes.lengths(vectors), LEAST) for vectors in (offset, gap))
        both = radius + extent
        parallax = np.where(both < distance, np.arcsin(np.minimum(both / distance, 1.0)), np.float32(np.pi))
        return cls(offset, half, reach, extent, radius, distance, nearest, parallax)

    def away(self, axes, cones):
        """Lower bound (K,) in rad on angles between directions to nodes and cones of directions; negative within."""
        return _angles(self.offset, self.distance, axes) - cones - self.parallax

    @property
    def ranges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The ranges for `_heights`."""
        return self.extent, self.half, self.distance + (self.radius + self.extent)


@dataclass
class TileNodePairs:
    """K pairs of a tile and a node: upper bounds on their light and on its error."""

    tile: np.ndarray
    node: np.ndarray
    are_leaves: np.ndarray
    are_points: np.ndarray  # a single point stands for the node
    is_dark: np.ndarray
    are_crossed: np.ndarray  # a horizon may cross the node
    is_smooth: np.ndarray  # light may be interpolated between samples
    are_in_tail: np.ndarray  # of all lobes
    is_wrong: np.ndarray  # no points may stand for the node
    size: np.ndarray  # of the node, in units of the length over which the integrand changes
    change: np.ndarray  # of the integrand over the tile
    light: np.ndarray  # upper bound for any sample
    mean: np.ndarray  # estimated mean over all samples; near a large tile few samples get the most
    crossed: np.ndarray  # light that is wrong where horizons and planes cross the node

    @classmethod
    def of(cls, tree: LightTree, tiles: light_nodes.Tiles, tile, node) -> "TileNodePairs":
        """For the numbers (K,) of tiles and nodes."""
        between = NodeDistances.of(tree, tiles, tile, node)
        size, tile_size = between.reach / between.nearest, between.radius / between.nearest
        # Where a horizon or its own plane crosses a light, the cosine is at most this.
        rim = np.minimum(2.0 * size, 1.0)
        light, plane, crossed, is_dark = _shining(tree, node, between, rim)
        are_crossed = np.zeros(len(node), bool)
        for number, (axes, cones) in enumerate(tiles.horizons):
            turn = cones[tile]
            height, slack = _heights(between.ranges, between.offset, axes[tile], turn)
            is_dark |= height < -slack
            is_crossed = height < slack
            are_crossed |= is_crossed
            if tiles.mirrored is None and number == len(tiles.horizons) - 1:
                steepest = np.cos(np.clip(between.away(axes[tile], turn), 0.0, 0.5 * np.pi))
                light *= steepest
                is_crossed = is_crossed * np.minimum(rim / np.maximum(steepest, LEAST), 1.0)
            crossed += CROSSED * is_crossed
        # One light goes dark all at once behind its plane; lights that face differently go dark one after another.
        is_smooth = ~are_crossed & ((plane == 0.0) | tree.is_turned[node])
        are_in_tail, is_wrong = np.zeros((2, len(node)), bool)
        if tiles.mirrored is not None:
            axes, cones = tiles.mirrored
            turn, width = cones[tile], tiles.width[tile]
            away = np.maximum(between.away(axes[tile], turn), 0.0)
            # The criterion of `TailLimits`, for each of the lights.
            near = NEAR_RADII * np.sqrt(tree.diagonal[node])
            are_in_tail = np.sin(np.minimum(away, 0.5 * np.pi)) * between.nearest > near
            if tiles.only_tails:
                are_in_tail &= away > small_lights.SHARP_TAIL
                is_wrong = ~are_in_tail
            light *= (width**2 / (width**2 + away**2)) ** 2
            length = np.minimum(width + away, 1.0)
            size, tile_size, turn = size / length, tile_size / length, turn / length
        light[is_dark] = 0.0
        mean = light / (1.0 + (between.radius / np.maximum(between.nearest, between.reach)) ** 2)
        change, are_leaves = np.minimum(tile_size + turn, 1.0), tree.number[node] >= 0
        are_points = (size < POINT) & (size * tree.tinted[node] < POINT**2)
        are = are_leaves, are_points, is_dark, are_crossed, is_smooth, are_in_tail, is_wrong
        return cls(tile, node, *are, size, change, light, mean, light * crossed)

    def are_fine(self, most) -> np.ndarray:
        """Mask (K,) of the nodes that may be used: their error is at most `most` (K,), or they are small."""
        small = (self.size < SMALL) & (self.crossed <= most)
        error = self.light * FOURTH_ORDER * np.minimum(self.size, 1.0) ** 4 + self.crossed
        return (small | (self.size < LARGEST) & (error <= most)) & ~self.is_wrong

    def are_near(self, most) -> np.ndarray:
        """Mask (K,) of the leaves to shade as polygons; their error as points may be `most` (K,)."""
        are_points = self.are_fine(most) & (self.size < LEAF_SIZE)
        return self.are_leaves & ~are_points

    def by_tile(self):
        """Yield (number of a tile, its pairs)."""
        pairs = self.take(np.argsort(self.tile, kind="stable"))
        numbers, first = np.unique(pairs.tile, return_index=True)
        for number, start, end in zip(numbers, first, np.append(first, len(pairs.tile))[1:], strict=True):
            yield number, pairs.take(slice(start, end))

    def take(self, index) -> "TileNodePairs":
        """The pairs at `index` (Q,)."""
        return TileNodePairs(*(getattr(self, item.name)[index] for item in fields(self)))

    @classmethod
    def joined(cls, pieces) -> "TileNodePairs":
        """All pairs of the `pieces`."""
        return cls(*(np.concatenate([getattr(pairs, item.name) for pairs in pieces]) for item in fields(cls)))


def _shining(tree: LightTree, node, between: NodeDistances, rim):
    """For K pairs: an upper bound on the light; the share of all light, and of this light, that may be wrong because a
    sample may be in the plane of a light; and whether the nodes face away."""
    angle, normal_spread = _angles(-between.offset, between.distance, tree.axis[node]), tree.normal_spread[node]
    shining = np.cos(np.clip(angle - normal_spread - between.parallax, 0.0, 0.5 * np.pi))
    power = tree.power[node]
    light = power * shining / np.maximum(between.nearest, between.reach) ** 2
    height, slack = _heights(between.ranges, -between.offset, tree.axis[node], normal_spread)
    plane = np.where(height < slack, np.minimum(SWUNG * (tree.swing[node] / power) + CROSSED * rim, 1.0), 0.0)
    return light, plane, np.minimum(plane / np.maximum(shining, LEAST), 1.0), height < -slack


def _refined(tree, tiles, is_fine) -> TileNodePairs:
    """The coarsest pairs of all tiles for which is_fine(pairs) holds or which are leaves, without dark ones."""
    fine, tile, node = [], np.arange(len(tiles.columns)), np.zeros(len(tiles.columns), int)
    while len(node) or not fine:
        pairs = TileNodePairs.of(tree, tiles, tile, node)
        done = pairs.are_leaves | is_fine(pairs)
        fine.append(pairs.take(done & ~pairs.is_dark))
        open_ones = ~(done | pairs.is_dark)
        tile, node = np.repeat(tile[open_ones], 2), tree.children[node[open_ones]].ravel()
    return TileNodePairs.joined(fine)


def add_far_lights(tree: LightTree, lobes, position, chosen, total) -> tuple[tuple, tuple]:
    """Add the light of the tree to `total` (F, 3, Q), for the columns `chosen` (Q',) of `lobes`, at x, y, z in
    `position` (3, Q). Returns the pairs (K,) that are left: columns, and numbers of the lights to shade as polygons;
    then columns, and numbers of the bodies to shade as outlines."""
    is_specular = lobes.sharpest is not None
    keys = light_nodes.neighbor_keys(lobes, position, chosen)
    tile_members = light_nodes.split_columns(keys, np.arange(len(chosen)), TILE[is_specular])
    tiles = light_nodes.Tiles.of(lobes, position, [chosen[members] for members in tile_members])
    cubics = light_nodes.TileCubics.of(tile_members, keys, lobes.shape[:, chosen])
    coarse = _refined(tree, tiles, lambda pairs: pairs.size < COARSE)
    light = np.bincount(coarse.tile, coarse.mean, len(tile_members))
    most = ERROR[is_specular] * light
    pairs = _refined(tree, tiles, lambda pairs: pairs.are_fine(most[pairs.tile]))
    bent = INTERPOLATED * pairs.change**4 * pairs.light
    pairs.is_smooth &= cubics.are_smooth[pairs.tile] & (bent <= most[pairs.tile])
    near = pairs.are_near(LEAF_ERROR * light[pairs.tile])
    light = np.bincount(pairs.tile[~near], pairs.mean[~near], len(tile_members))
    outlined = _bodies_near(tree, pairs, near)
    remains = ~np.isin(_tile_and_body(tree, pairs), outlined)
    pairs, near = pairs.take(remains), near[remains]
    for number, tile_pairs in pairs.take(~near).by_tile():
        columns = tiles.columns[number]
        smooth = tile_pairs.is_smooth
        if smooth.any():
            few, weights = columns[cubics.anchors[number]], cubics.weights[number, : len(columns)].T
            total[:, :, columns] += _light_of(tree, lobes, position[:, few], (few, tile_pairs.take(smooth))) @ weights
            tile_pairs = tile_pairs.take(~smooth)
        if not smooth.all():
            total[:, :, columns] += _light_of(tree, lobes, position[:, columns], (columns, tile_pairs))
    near, remaining, tile, node, finer = pairs.take(near), [], [], [], []
    for number, tile_pairs in near.by_tile():
        if len(tile_pairs.node) <= MANY_LEAVES:
            remaining.append((tiles.columns[number], tile_pairs))
            continue
        for members in light_nodes.split_columns(keys, tile_members[number], FINER_TILE):
            tile.append(np.full(len(tile_pairs.node), len(finer)))
            node.append(tile_pairs.node)
            finer.append((chosen[members], light[number]))
    if finer:
        columns, light = zip(*finer, strict=True)
        pairs = TileNodePairs.of(
            tree, light_nodes.Tiles.of(lobes, position, columns), np.concatenate(tile), np.concatenate(node)
        )
        pairs = pairs.take(~pairs.is_dark)
        light = light + np.bincount(pairs.tile, pairs.mean, len(finer))
        near = pairs.are_near(FINER_LEAF_ERROR * light[pairs.tile])
        for number, tile_pairs in pairs.take(~near).by_tile():
            members = columns[number]
            total[:, :, members] += _light_of(tree, lobes, position[:, members], (members, tile_pairs))
        remaining += [(columns[number], tile_pairs) for number, tile_pairs in pairs.take(near).by_tile()]
    columns = [np.repeat(members, len(tile_pairs.node)) for members, tile_pairs in remaining]
    numbers = [np.tile(tree.number[tile_pairs.node], len(members)) for members, tile_pairs in remaining]
    tile, body = np.divmod(outlined, max(len(tree.bodies), 1))
    outlined_columns = [tiles.columns[one] for one in tile]
    outlined_bodies = [np.full(len(columns), one) for columns, one in zip(outlined_columns, body, strict=True)]
    pairs = columns, numbers, outlined_columns, outlined_bodies
    columns, numbers, *outlined = (np.concatenate([np.empty(0, np.intp), *values]) for values in pairs)
    return (columns, numbers), tuple(outlined)


def _tile_and_body(tree, pairs) -> np.ndarray:
    """A number (K,) for each tile and body; -1 for nodes that are no part of a body."""
    body = tree.body[pairs.node]
    return np.where(body >= 0, pairs.tile * len(tree.bodies) + body, -1)


def _bodies_near(tree, pairs, near) -> np.ndarray:
    """Numbers from `_tile_and_body` of the bodies of which a tile must shade many of the `near` lights (K,) as
    polygons."""
    keys = _tile_and_body(tree, pairs)[near]
    keys, count = np.unique(keys[keys >= 0], return_counts=True)
    return keys[count > MANY_OF_A_BODY]


@dataclass(frozen=True)
class PointDirections:
    """Like `small_lights.RaysToCenters`, arrays (Q, K) from Q samples of a tile to K points."""

    ends: np.ndarray  # (4, K): offsets of the points from the middle of the tile, then 1
    origins: np.ndarray  # (4, Q): offsets of the samples, then 1
    squares: np.ndarray
    distance: np.ndarray
    flux: np.ndarray
    diagonal: np.ndarray  # (K,)
    slack: None = None

    def heights(self, vectors) -> np.ndarray:
        """Products (Q, K) of the rays with `vectors` (3, Q, 1)."""
        vectors = vectors[..., 0]
        return np.concatenate([vectors, -dot(vectors, self.origins)[None]]).T @ self.ends


class NodePoints:
    """The K points that stand for nodes of a tree in a tile."""

    def __init__(self, tree, pairs: TileNodePairs, middle, is_specular):
        nodes, single, crossed = pairs.node, pairs.are_points, pairs.are_crossed
        (places, colors), turned = tree.places[is_specular], tree.is_turned[nodes]
        # Nodes that take longer come last.
        order = np.argsort(2 * turned + crossed, kind="stable")
        most = len(places) // len(tree.center)
        count = np.where(single, 1, most)[order]
        node = np.repeat(nodes[order], count)
        ends = np.cumsum(count)
        number = most * node + np.arange(len(node)) - np.repeat(ends - count, count)
        points, self.colors = places[number], colors[:, number]
        alone = ends[count == 1] - 1
        points[alone], self.colors[:, alone] = tree.center[node[alone]], tree.color[:, node[alone]]
        points -= middle
        self.is_crossed, self.is_turned = np.repeat(crossed[order], count), np.repeat(turned[order], count)
        self.squared, vector = (points * points).sum(axis=1), tree.vector[node]
        self.ends, self.from_squares, self.from_plane = np.ones((3, 4, len(node)), np.float32)
        self.ends[:3] = points.T
        self.from_squares[:3], self.from_squares[3] = -2.0 * points.T, self.squared
        self.from_plane[:3], self.from_plane[3] = vector.T, -(vector * points).sum(axis=1)
        self.diagonal = tree.diagonal[node]
        # The squares of how far cosines may be off their mean, times the squared distance: a polynomial of the origin.
        turn, ends = tree.turn[..., node], self.ends[:3]
        bent = (turn * ends).sum(axis=1)
        self.from_turn = np.concatenate([turn.reshape(9, -1), -2.0 * bent, (bent * ends).sum(axis=0)[None]])

    def directions(self, block, origins) -> PointDirections:
        """Rays from `origins` (4, Q) to the points `block`, a slice."""
        ends, size = self.ends[:, block], dot(origins, origins)
        # Matrix products lose digits of the squares if points are near compared with the size of the tile.
        if self.squared[block].min() > 4.0 * size.max():
            squares = origins.T @ self.from_squares[:, block]
            squares += size[:, None]
        else:
            offset = ends[:3, None] - origins[:3, :, None]
            squares = dot(offset, offset)
        distance = np.sqrt(squares)
        flux = origins.T @ self.from_plane[:, block]
        if self.is_turned[block].any():
            pairs = (origins[:3, None] * origins[:3]).reshape(9, -1)
            swing = np.concatenate([pairs, origins]).T @ self.from_turn[:, block]
            flux = _mean_above_zero(flux, np.sqrt(np.maximum(swing, LEAST**2, out=swing), out=swing))
        else:
            np.maximum(flux, np.float32(0.0), out=flux)
        return PointDirections(ends, origins, squares, distance, flux, self.diagonal[block])


def _light_of(tree, lobes, position, tile) -> np.ndarray:
    """The light (F, 3, Q) of nodes. `tile` is the columns (Q,), at x, y, z in `position` (3, Q), and the pairs with the
    nodes."""
    columns, pairs = tile
    middle = position.mean(axis=1)
    origins = np.ones((4, len(columns)), np.float32)
    origins[:3] = position - middle[:, None]
    clipped = lobes.clip_rows if lobes.sharpest is not None or len(lobes.clip_rows) > 1 else ()
    # Samples are the first axis: their values for many points are then read once.
    columns = columns[:, None]
    horizons = [lobes.rows[row][:, columns] for row in clipped]
    sums = np.zeros((len(lobes.colors), 3, len(columns)), np.float32)
    step = max(PAIRS // len(columns), 1)
    for is_tail in (True, False):
        exact = is_tail and lobes.limits is not None
        points = NodePoints(tree, pairs.take(pairs.are_in_tail == is_tail), middle, lobes.sharpest is not None)
        for first in range(0, len(points.squared), step):
            block = slice(first, first + step)
            rays = points.directions(block, origins)
            if points.is_crossed[block].any():
                for normal in horizons:
                    rays.flux[rays.heights(normal) <= 0.0] = 0.0
            values = lobes.limits.at_centers(columns, rays, len(sums)) if exact else lobes.at_point(columns, rays)
            for target, value in zip(sums, values, strict=True):
                target += points.colors[:, block] @ value.T
    return sums


def _mean_above_zero(mean, swing):
    """Means (...) of max(0, x) for x uniform between mean - swing and mean + swing."""
    within = np.minimum(np.maximum(mean, -swing), swing)
    within += swing
    within *= within
    within /= np.float32(4.0) * swing
    within += np.maximum(mean - swing, np.float32(0.0))
    return within
