"""How many actions place three highlights on a ball: with Drag Highlight, and with Blender's own G and R.

An action is a click on a light, the choice of a tool, or one transform: G in the plane of the view, R, or G along the
light's own axis. Who uses G and R is assumed to see the picture live and to do the best that each single action can
do, so the count is a lower bound: G brings the highlight to its target, R faces the light to it, G along its axis gives
it its distance back, and again, until all three are as wanted.

python tests/benchmarks/highlight_actions.py
"""

import sys
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1] / "helpers")]

from surface_scenes import area_light, unit  # noqa: E402

from ltsh_addon.scene import SurfaceSamples  # noqa: E402
from ltsh_addon.shading import shade  # noqa: E402
from ltsh_addon.shading.highlight import STENCIL, MovedLight, place_for_highlight  # noqa: E402

EYE, PIXEL, HALF = np.array([0.0, -5.0, 2.0]), 0.0011, 0.2  # of the light
# As wanted: pixels from the target, the angle in degrees between the light's axis and the target, and the distance.
PIXELS, DEGREES, DISTANCE = 2.0, 5.0, 0.05
TARGETS = ((-90.0, 70.0), (60.0, 110.0), (110.0, -40.0))  # pixels from the middle of the ball
LIGHTS = ((-2.5, -1.0, 2.5), (0.5, -0.5, 3.0), (3.0, -2.0, 0.5))
MOST = 40

TOWARD = -unit(EYE)
RIGHT = unit(np.cross(TOWARD, [0.0, 0.0, 1.0]))
UP = np.cross(RIGHT, TOWARD)


def samples_at(pixels, roughness):
    """What is seen at `pixels` (P, 2) of a ball of radius 1 around the origin; those beside it are left out."""
    ray = unit(TOWARD + PIXEL * (pixels[:, :1] * RIGHT + pixels[:, 1:] * UP))
    along, off = -(ray @ EYE), (EYE @ EYE) - (ray @ EYE) ** 2
    hit = off < 0.999
    position = EYE + (along - np.sqrt(np.maximum(1.0 - off, 0.0)))[:, None] * ray
    position, ray = position[hit], ray[hit]
    count, white = len(position), np.ones((len(position), 3))
    return SurfaceSamples(
        position=position, view=-ray, normal=position, diffuse_normal=position, roughness=np.full(count, roughness),
        specular_f0=0.8 * white, specular_f90=white, dielectric=np.zeros(count), ior=np.full(count, 1.5),
        diffuse_albedo=0.0 * white,
    ), pixels[hit]  # fmt: skip


def light_at(matrix):
    """A square at a matrix (4, 4)."""
    u, v, backward, center = matrix[:3].T
    return area_light(center=center, half_u=HALF * u, half_v=HALF * v, direction=-backward)


def matrix_at(center, toward):
    """The matrix (4, 4) of a light at `center` that faces the point `toward`."""
    backward = unit(center - toward)
    u = unit(np.cross(backward, np.eye(3)[np.argmin(np.abs(backward))]))
    matrix = np.eye(4)
    matrix[:3] = np.stack([u, np.cross(backward, u), backward, center], axis=-1)
    return matrix


def peak(matrix, roughness):
    """The pixel (2,) of the largest specular radiance; by steps of 1 pixel where it is, by 8 at first."""
    middle, span = np.zeros(2), 256.0
    for step in (8.0, 1.0):
        steps = np.arange(-span, span + 1.0, step)
        grid = middle + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        samples, pixels = samples_at(grid, roughness)
        radiance = shade(samples, [light_at(matrix)], passes=("specular",), workers=1).specular.sum(axis=(0, 2))
        best = int(np.argmax(radiance))
        middle, span = pixels[best], 10.0
    near, around = samples_at(middle + 2.0 * STENCIL, roughness)
    if len(around) < len(STENCIL):
        return middle
    radiance = shade(near, [light_at(matrix)], passes=("specular",), workers=1).specular.sum(axis=(0, 2))
    rows = np.stack([np.ones(9), *STENCIL.T, *(0.5 * STENCIL**2).T, STENCIL.prod(axis=1)], axis=-1)
    _, x, y, xx, yy, xy = np.linalg.lstsq(rows, np.log(np.maximum(radiance, 1e-30)), rcond=None)[0]
    offset = np.linalg.lstsq(np.array([[xx, xy], [xy, yy]]), -np.array([x, y]), rcond=None)[0]
    return middle + 2.0 * np.clip(offset, -1.0, 1.0)


def missed(matrix, target, roughness):
    """How many pixels the highlight is from its target; 0 where that has 99 % of its radiance."""
    highest = peak(matrix, roughness)
    samples, _ = samples_at(np.array([highest, target]), roughness)
    first, second = shade(samples, [light_at(matrix)], passes=("specular",), workers=1).specular.sum(axis=(0, 2))
    return 0.0 if second >= 0.99 * first else np.linalg.norm(highest - target)


def best_move(matrix, target, roughness):
    """G in the plane of the view, which brings the highlight as near to its target as it can: Gauss and Newton, with
    steps halved until they lead nearer."""
    now = peak(matrix, roughness) - target
    for slope in (0.1, 0.3, 0.03, 1.0) * 4:
        if np.linalg.norm(now) < 0.5:
            break
        slopes = [(peak(_moved(matrix, slope * axis), roughness) - target - now) / slope for axis in (RIGHT, UP)]
        way = np.linalg.lstsq(np.array(slopes).T, -now, rcond=None)[0]
        way *= min(1.0, 1.5 / np.linalg.norm(way))
        for size in (1.0, 0.5, 0.25, 0.1, 0.03):
            tried = _moved(matrix, size * (way[0] * RIGHT + way[1] * UP))
            there = peak(tried, roughness) - target
            if np.linalg.norm(there) < np.linalg.norm(now):
                matrix, now = tried, there
                break
    return matrix


def _moved(matrix, way):
    matrix = matrix.copy()
    matrix[:3, 3] += way
    return matrix


def actions_with_g_and_r(center, target, roughness):
    """How many actions one light takes, its selection included, and how far its highlight is from the target."""
    point = samples_at(np.array([target]), roughness)[0].position[0]
    matrix, distance, count = matrix_at(np.array(center), np.zeros(3)), np.linalg.norm(center - point), 1
    while count < MOST:
        to_light = matrix[:3, 3] - point
        off = missed(matrix, target, roughness)
        turned = np.degrees(np.arccos(np.clip(unit(to_light) @ matrix[:3, 2], -1.0, 1.0)))
        if off > PIXELS:
            matrix = best_move(matrix, target, roughness)
        elif turned > DEGREES:
            matrix = matrix_at(matrix[:3, 3], point)
        elif abs(np.linalg.norm(to_light) / distance - 1.0) > DISTANCE:
            matrix = matrix.copy()
            matrix[:3, 3] = point + distance * unit(to_light)
        else:
            return count, off
        count += 1
    return count, off


def actions_by_drag(center, target, roughness):
    """As `actions_with_g_and_r`: a click on the light, and a drag that ends at the target."""
    samples, _ = samples_at(target + 2.0 * STENCIL, roughness)
    point = samples.position[0]
    distance = np.linalg.norm(center - point)
    light = MovedLight(lambda direction: matrix_at(point + distance * direction, point), light_at)
    place = place_for_highlight(samples, light)
    return 2, missed(light.matrix_at(place.direction), target, roughness)


def main():
    """Print a table."""
    print("roughness | Drag Highlight | pixels off | G and R | pixels off")
    for roughness in (0.1, 0.25, 0.5):
        drag, own = (
            np.array([how(light, np.array(target), roughness) for light, target in zip(LIGHTS, TARGETS, strict=True)])
            for how in (actions_by_drag, actions_with_g_and_r)
        )
        # One more action chooses the tool, for all three.
        print(f"{roughness:9} | {1 + drag[:, 0].sum():14.0f} | {drag[:, 1].max():10.2f} | "
              f"{own[:, 0].sum():7.0f} | {own[:, 1].max():.2f}    {own[:, 0].astype(int).tolist()}")  # fmt: skip


if __name__ == "__main__":
    main()
