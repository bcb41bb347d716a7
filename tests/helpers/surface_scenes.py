"""Surface samples and area lights for the tests of shading."""

from dataclasses import replace

import numpy as np

from ltsh_addon.scene import SurfaceSamples, light_of


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_samples(count, seed=0, lowest_roughness=0.05):
    """Points in a cube of 2 m around the origin, seen from the side of their normals; metals, dielectrics and both."""
    generator = np.random.default_rng(seed)
    normal = unit(generator.normal(size=(count, 3)))
    view = unit(normal + unit(generator.normal(size=(count, 3))) * generator.uniform(0.2, 0.95, size=(count, 1)))
    bumped = unit(normal + 0.1 * generator.normal(size=(count, 3)))
    metal = (generator.random(count) < 0.5).astype(float)
    f0 = generator.random((count, 3)) * metal[:, None]
    return SurfaceSamples(
        position=generator.uniform(-1.0, 1.0, size=(count, 3)),
        view=view,
        normal=normal,
        diffuse_normal=bumped,
        roughness=lowest_roughness + (1.0 - lowest_roughness) * generator.random(count),
        specular_f0=f0,
        specular_f90=np.broadcast_to(metal[:, None], (count, 3)).copy(),
        dielectric=1.0 - metal,
        ior=1.1 + 1.4 * generator.random(count),
        diffuse_albedo=generator.random((count, 3)) * (1.0 - metal)[:, None],
    )


def area_light(name="Lamp", shape="RECTANGLE", center=(0, 0, 3), half_u=(1, 0, 0), half_v=(0, -0.6, 0), **options):
    """An area light that shines along cross(half_u, half_v), by default down."""
    if "direction" not in options:
        options["direction"] = unit(np.cross(np.asarray(half_u, dtype=float), np.asarray(half_v, dtype=float)))
    values = {"name": name, "shape": shape, "center": center, "half_u": half_u, "half_v": half_v}
    return light_of({**values, "radiance": (5.0, 3.0, 1.0), **options})


def four_lights():
    """One of each shape around the cube of `random_samples`, facing it, in three groups."""
    return (
        area_light("Key", "RECTANGLE", (0.3, 0.2, 3.0), (1.2, 0.1, 0.0), (0.05, -0.6, 0.0), group="Key"),
        area_light("Fill", "SQUARE", (-3.0, 0.5, 0.4), (0.0, 0.7, 0.0), (0.0, 0.0, 0.7), group="Fill"),
        area_light("Rim", "DISK", (2.6, 1.0, 1.0), (0.0, 0.5, 0.0), (0.0, 0.0, -0.5), group="Key"),
        area_light("Kick", "ELLIPSE", (0.4, -2.8, 0.2), (-0.9, 0.0, 0.0), (0.0, 0.0, 0.3), radiance=(0.5, 2.0, 9.0)),
    )


def single_sample(position=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), view=(0.0, 0.0, 1.0), **fields):
    """One point; white Lambertian, no specular lobe unless told otherwise."""
    row = {
        "position": position,
        "view": unit(np.asarray(view, dtype=float)),
        "normal": unit(np.asarray(normal, dtype=float)),
        "diffuse_normal": unit(np.asarray(normal, dtype=float)),
        "roughness": 0.5,
        "specular_f0": (0.0, 0.0, 0.0),
        "specular_f90": (0.0, 0.0, 0.0),
        "dielectric": 0.0,
        "ior": 1.5,
        "diffuse_albedo": (1.0, 1.0, 1.0),
        **fields,
    }
    return SurfaceSamples(**{name: np.asarray(value, dtype=float)[None] for name, value in row.items()})


def moved(samples, lights, rotation=None, shift=(0.0, 0.0, 0.0)):
    """Samples and lights under one rigid motion."""
    rotation = np.eye(3) if rotation is None else rotation
    vectors = ("view", "normal", "diffuse_normal", "geometric_normal", "smooth_normal")
    fields = {name: getattr(samples, name) for name in samples.__dataclass_fields__}
    fields.update({name: fields[name] @ rotation.T for name in vectors})
    fields["position"] = samples.position @ rotation.T + np.asarray(shift)
    turned = [
        replace(
            light,
            center=rotation @ light.center + np.asarray(shift),
            half_u=rotation @ light.half_u,
            half_v=rotation @ light.half_v,
            direction=rotation @ light.direction,
        )
        for light in lights
    ]
    return SurfaceSamples(**fields), turned


def shifted(light, offset):
    """`light` moved by `offset` (3,) in m; distant lights stay as they are."""
    if light.is_distant:
        return light
    changes = {"center": light.center + offset, "children": tuple(shifted(child, offset) for child in light.children)}
    if light.corners is not None:
        changes["corners"] = light.corners + offset
    return light.altered(**changes)


def random_rotation(seed):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


STAR = np.array([[np.cos(n * np.pi / 7), np.sin(n * np.pi / 7)] for n in range(14)]) * np.where(
    np.arange(14) % 2 == 0, 1.0, 0.35
).reshape(-1, 1)


def polygon_light(flat, center=(0.2, -0.1, 2.0), **options):
    """A light with corners (V, 2) that shines down, or toward `direction`."""
    flat = np.asarray(flat, dtype=float)
    direction = unit(np.asarray(options.pop("direction", (0.1, 0.2, -1.0)), dtype=float))
    first = unit(np.cross(direction, (0.0, 1.0, 0.0)))
    second = np.cross(direction, first)
    corners = np.asarray(center) + flat[:, :1] * first + flat[:, 1:] * second
    options = {"half_u": first, "half_v": second, "radiance": (1, 1, 1), **options}
    return area_light(shape="POLYGON", center=center, direction=direction, corners=corners, **options)


def all_kinds_of_samples(count, seed):
    """Every Fresnel kind, all roughness, bump maps, geometric normals that differ, in one set."""
    samples = random_samples(count, seed, lowest_roughness=0.0)
    generator = np.random.default_rng(seed + 1)
    kind = np.arange(count) % 4
    metal = np.where(kind[:, None] < 3, 1.0, 0.0) * np.ones(3)
    f0 = np.where(kind[:, None] == 0, metal, 0.5 * metal)
    bent = unit(samples.normal + 0.2 * generator.normal(size=(count, 3)))
    flat = (generator.random(count) < 0.5)[:, None]
    return replace(
        samples,
        specular_f0=f0,
        specular_f90=metal,
        dielectric=np.where(kind >= 2, 0.7, 0.0),
        geometric_normal=np.where(flat, samples.normal, bent),
        smooth_normal=np.where(flat, samples.diffuse_normal, bent),
        bump_alpha2=0.3 * generator.random(count),
        diffuse_albedo=generator.random((count, 3)),
    )
