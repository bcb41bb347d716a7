"""Random small scenes, made by a seed: lights, occluders, materials and transforms, half of them snapped to a grid."""

from __future__ import annotations

import math

import bpy
import numpy as np
import scene_parts as parts

SIZE = (32, 24)
STEP = 0.25  # m of the grid of snapped scenes
AREA_SHAPES = ("SQUARE", "RECTANGLE", "DISK", "ELLIPSE")
LIGHTS = ("area", "area", "area", "point", "spot", "sun", "glow")
OCCLUDERS = ("plane", "box", "ball", "instance", "alpha", "transparent")
MATERIALS = ("diffuse", "plastic", "rough", "metal", "coat", "sheen", "anisotropic", "mix")
TRANSFORMS = ("plain", "plain", "uneven", "mirrored", "parent", "sheared")
# UNITS, ORIGINS: meters of a unit of the scene, and its place in units, of which most scenes take the first.
UNITS = (1.0, 1.0, 1.0, 0.01, 100.0)
ORIGINS = (0.0, 0.0, 0.0, 100.0, 3000.0)


class RandomScene:
    """The scene of a `seed`, built in this process; `words` tell what is in it."""

    def __init__(self, seed: int):
        self.random = np.random.default_rng(seed)
        self.words: list[str] = []
        self.snapped = bool(seed % 2)
        self.unit, self.origin = self._pick(UNITS), self._pick(ORIGINS) * np.array([1.0, -0.5, 0.25])
        parts.empty_scene(*SIZE)
        self.root = parts.link(bpy.data.objects.new("Root", None))
        self.root.location, self.root.scale = self.unit * self.origin, (self.unit,) * 3
        bpy.context.scene.cycles.transparent_max_bounces = 32
        parts.add_plane(self._material(), size=8.0, name="Floor").parent = self.root
        if self.random.random() < 0.4:
            wall = parts.add_plane(self._material(), size=8.0, name="Wall")
            wall.parent, wall.location, wall.rotation_euler = self.root, (0.0, 2.0, 2.0), (math.pi / 2, 0.0, 0.0)
        for number in range(self.random.integers(1, 4)):
            self._occluder(f"Occluder {number}")
        for number in range(self.random.integers(1, 4)):
            self._light(f"Light {number}")
        self._world()
        self._camera()

    def __str__(self):
        grid = "snapped" if self.snapped else "unsnapped"
        return f"{grid}, unit {self.unit:g} m, origin {self.origin[0]:g}: {', '.join(self.words)}"

    def _pick(self, choices):
        return choices[self.random.integers(len(choices))]

    def _between(self, low, high, count=None):
        """Random numbers, on the grid where the scene is snapped."""
        values = self.random.uniform(low, high, count)
        return np.round(values / STEP) * STEP if self.snapped else values

    def _rotation(self, most=math.pi):
        """Random Euler angles; those of snapped scenes turn about z alone, by steps of 45 degrees."""
        if self.snapped:
            return (0.0, 0.0, math.pi / 4 * self.random.integers(8))
        return self.random.uniform(-most, most, 3)

    def _color(self):
        return (*self.random.uniform(0.2, 0.9, 3), 1.0)

    def _material(self):
        kind, roughness = self._pick(MATERIALS), self.random.uniform(0.15, 0.9)
        self.words.append(kind)
        if kind == "diffuse":
            return parts.bsdf_material("ShaderNodeBsdfDiffuse", "Diffuse", Color=self._color())[0]
        inputs = {"Base Color": self._color(), "Roughness": roughness}
        if kind == "rough":
            inputs["Diffuse Roughness"] = self.random.uniform(0.2, 1.0)
        elif kind == "metal":
            inputs["Metallic"] = 1.0
        elif kind == "coat":
            inputs |= {"Coat Weight": self.random.uniform(0.3, 1.0), "Coat Roughness": self.random.uniform(0.15, 0.5)}
        elif kind == "sheen":
            inputs |= {"Sheen Weight": self.random.uniform(0.3, 1.0), "Sheen Roughness": self.random.uniform(0.2, 0.8)}
        elif kind == "anisotropic":
            inputs |= {"Metallic": 1.0, "Anisotropic": self.random.uniform(0.2, 0.8)}
        material, node = parts.principled(kind.title(), **inputs)
        if kind == "mix":
            diffuse = parts.add_node(material.node_tree, "ShaderNodeBsdfDiffuse", Color=self._color())
            self._mixed(material.node_tree, node, diffuse)
        return material

    def _mixed(self, tree, one, other):
        """Make the surface of a material a mix of two nodes."""
        mix = parts.add_node(tree, "ShaderNodeMixShader", **{"Fac": self.random.uniform(0.2, 0.8)})
        tree.links.new(one.outputs[0], mix.inputs[1])
        tree.links.new(other.outputs[0], mix.inputs[2])
        output = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeOutputMaterial")
        tree.links.new(mix.outputs[0], output.inputs["Surface"])

    def _placed(self, ob, location, rotation):
        """Put an object somewhere, below one of the `TRANSFORMS`."""
        kind = self._pick(TRANSFORMS)
        ob.location, ob.rotation_euler, ob.parent = location, rotation, self.root
        if kind == "uneven":
            ob.scale = self.random.uniform(0.5, 1.5, 3)
        elif kind == "mirrored":
            ob.scale = self._pick(((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -0.7, 1.0)))
        elif kind in ("parent", "sheared"):
            above = parts.link(bpy.data.objects.new("Parent", None), location)
            ob.location, above.parent, ob.parent = (0.0, 0.0, 0.0), self.root, above
            above.scale = (1.4, 0.7, 1.0) if kind == "sheared" else (1.2, 1.2, 1.2)
            above.rotation_euler = self._rotation(0.5)
        self.words[-1] += f" ({kind})" if kind != "plain" else ""
        return ob

    def _occluder(self, name):
        kind = self._pick(OCCLUDERS)
        self.words.append(kind)
        if kind in ("alpha", "transparent"):
            material, node = parts.principled(name, **{"Base Color": self._color(), "Roughness": 0.5})
            if kind == "alpha":
                node.inputs["Alpha"].default_value = self.random.uniform(0.1, 0.9)
            else:
                self._mixed(material.node_tree, node, parts.add_node(material.node_tree, "ShaderNodeBsdfTransparent"))
        else:
            material = None
        location = (*self._between(-1.2, 1.2, 2), self._between(0.25, 1.0))
        if kind == "ball":
            radius = self.random.uniform(0.2, 0.5)
            ob = parts.add_sphere(self._material(), radius, name, bool(self.random.random() < 0.7))
        elif kind in ("box", "instance"):
            bpy.ops.mesh.primitive_cube_add(size=0.5 if self.snapped else self.random.uniform(0.3, 0.8))
            ob = bpy.context.object
            ob.data.materials.append(self._material())
            if kind == "instance":
                collection = bpy.data.collections.new(name)
                bpy.context.scene.collection.objects.unlink(ob)
                collection.objects.link(ob)
                ob = parts.link(bpy.data.objects.new(name, None))
                ob.instance_type, ob.instance_collection = "COLLECTION", collection
        else:
            ob = parts.add_plane(material or self._material(), self._between(0.5, 1.5), name)
        self._placed(ob, location, self._rotation())

    def _light(self, name):
        kind = self._pick(LIGHTS)
        self.words.append(kind)
        location = np.array([*self._between(-1.5, 1.5, 2), self._between(1.5, 3.0)])
        # Toward the ground near the origin; straight down where the scene is snapped.
        target = location * [1.0, 1.0, 0.0] if self.snapped else self.random.uniform(-0.8, 0.8, 3) * [1.0, 1.0, 0.0]
        rotation = facing(target - location)
        power = self.random.uniform(30.0, 120.0)
        if kind == "glow":
            material = parts.bsdf_material("ShaderNodeEmission", name, Color=self._color(), Strength=power / 8.0)[0]
            self._placed(parts.add_plane(material, self._between(0.5, 1.0), name), location, rotation)
            return
        data = bpy.data.lights.new(name, kind.upper())
        data.energy, data.color = power * self.unit**2, self._color()[:3]
        if kind == "area":
            data.shape = self._pick(AREA_SHAPES)
            data.size, data.size_y = self._between(0.25, 1.5), self._between(0.25, 1.5)
            if self.random.random() < 0.3:
                data.spread = self.random.uniform(0.5, 2.5)
                self.words[-1] += f" spread {data.spread:.2f}"
            self.words[-1] += f" {data.shape.lower()}"
        elif kind == "sun":
            data.energy, data.angle = self.random.uniform(0.5, 3.0), self.random.uniform(0.0, 0.5)
        else:
            data.shadow_soft_size = self.unit * self.random.uniform(0.0, 0.3)
            if kind == "spot":
                data.spot_size, data.spot_blend = self.random.uniform(0.5, 2.2), self.random.uniform(0.0, 1.0)
        # Cycles takes sizes of area lights from the scale, and radii of points as they are.
        self._placed(parts.link(bpy.data.objects.new(name, data)), location, rotation)

    def _world(self):
        kind = self._pick(("none", "constant", "gradient"))
        self.words.append(f"world {kind}")
        if kind == "none":
            return
        strength = self.random.uniform(0.05, 0.4)
        world, background = parts.add_world(Color=self._color(), Strength=strength)
        if kind == "gradient":
            tree = world.node_tree
            place, ramp = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeTexGradient")
            tree.links.new(place.outputs["Generated"], ramp.inputs["Vector"])
            tree.links.new(ramp.outputs["Color"], background.inputs["Color"])

    def _camera(self):
        location = np.array([0.0, -4.5, 2.5]) + self.random.uniform(-0.5, 0.5, 3)
        camera = parts.add_camera(self.unit * (self.origin + location), facing(np.array([0, 0, 0.4]) - location))
        camera.data.clip_start, camera.data.clip_end = 0.01 * self.unit, 100.0 * self.unit


def facing(direction):
    """Euler angles that turn -z into a direction (3,)."""
    x, y, z = direction
    return (math.atan2(math.hypot(x, y), -z), 0.0, math.atan2(-x, y) if math.hypot(x, y) > 0 else 0.0)
