"""Twelve scenes of unlike kinds for finished pictures, as users of Blender build them, and some plain ones; needs bpy.

python tests/benchmarks/finished_scenes.py NAME FOLDER SEED ...    writes FOLDER/NAME_SEED.blend
"""

import math
import sys
from pathlib import Path

import bpy
import numpy as np
from scene_builders import (  # fmt: skip
    ball,
    box,
    brushed,
    bump,
    camera,
    copies,
    daylight,
    drive,
    empty_scene,
    glass,
    glowing,
    gradient_world,
    grid,
    lathe,
    material,
    mesh,
    panel,
    point,
    put,
    rod,
    save_seeds,
    shader,
    softbox,
    spot,
    texture,
    tiles,
    wood,
    world,
    worn,
)

DEMO = Path(__file__).resolve().parents[2] / "ltsh_addon" / "blender" / "demo.blend"
SIZE = (240, 135)
WHITE, WARM, COOL = (0.8, 0.8, 0.78), (1.0, 0.85, 0.65), (0.8, 0.9, 1.0)


def product():
    """A bottle, a stool of brushed legs and wood, chrome and glass before a cyclorama; three softboxes, a gradient."""
    bend = np.linspace(0.0, np.pi / 2, 9)
    profile = [(-4, 0), *zip(1.2 + 0.8 * np.sin(bend), 0.8 - 0.8 * np.cos(bend), strict=True), (2.0, 4.0)]
    points = np.array([[(x, y, z) for y, z in profile] for x in (5, -5)], dtype=float)
    grid("Cyclorama", points, material("Paper", (0.75, 0.74, 0.72), 0.6))
    plastic = material("Plastic", (0.7, 0.03, 0.03), 0.35, Coat_Weight=1.0, Coat_Roughness=0.06)
    rod("Bottle", plastic, (-0.6, 0, 0.6), (0.28, 1.2), bevel=0.06)
    leg = brushed("Brushed")
    for number, (x, y) in enumerate(((0.5, 0.5), (1.1, 0.5), (0.5, -0.1), (1.1, -0.1))):
        rod(f"Leg {number}", leg, (x, y, 0.35), (0.05, 0.7))
    box("Seat", (0.4, -0.2, 0.7), (1.2, 0.6, 0.76), wood("Wood"))
    chrome = material("Chrome", (0.95, 0.95, 0.95), 0.03, Metallic=1.0)
    ball("Chrome", chrome, (0.05, -0.7, 0.3), 0.3)
    ball("Glass", glass("Glass"), (0.85, -0.75, 0.25), 0.25)
    gradient_world((0.05, 0.06, 0.09), (0.8, 0.85, 1.0), 0.6)
    softbox("Key", 90, (1.2, 1.2), (-2.4, -1.8, 2.6), (0, 0, 0.4), (1.0, 0.95, 0.9))
    softbox("Strip", 40, (0.3, 2.0), (2.5, -0.6, 1.4), (0.2, 0, 0.5), (0.85, 0.92, 1.0))
    softbox("Top", 40, 1.5, (0.3, 0.6, 3.0), (0.2, 0.2, 0.3))
    camera((0.2, -4.6, 1.5), (0.15, 0, 0.5))


def bathroom():
    """Glazed tiles, a mirror under a glowing tube, a basin, chrome, a pane of glass; a panel in the ceiling."""
    tile = tiles("Tiles", (0.55, 0.72, 0.72), (0.5, 0.5, 0.48), 1.2)
    floor = tiles("Floor", (0.12, 0.12, 0.13), (0.4, 0.4, 0.4), 1.0, 0.25, 0.5, 0.5)
    paint, white = material("Paint", WHITE, 0.8), material("Ceramic", (0.85, 0.85, 0.84), 0.08)
    chrome = material("Chrome", (0.9, 0.9, 0.9), 0.06, Metallic=1.0)
    panel("Floor", (-1.6, -2.4, 0), (3.2, 0, 0), (0, 3.4, 0), floor, 2.0)
    panel("Back", (-1.6, 1.0, 0), (3.2, 0, 0), (0, 0, 2.5), tile, 3.0)
    panel("Left", (-1.6, -2.4, 0), (0, 3.4, 0), (0, 0, 2.5), tile, 3.0)
    panel("Right", (1.6, 1.0, 0), (0, -3.4, 0), (0, 0, 2.5), paint)
    panel("Front", (1.6, -2.4, 0), (-3.2, 0, 0), (0, 0, 2.5), paint)
    panel("Ceiling", (-1.6, 1.0, 2.5), (3.2, 0, 0), (0, -3.4, 0), paint)
    mirror = material("Mirror", (0.92, 0.92, 0.92), 0.0, Metallic=1.0)
    box("Mirror", (-0.9, 0.97, 1.2), (0.3, 0.99, 2.0), mirror)
    box("Tube", (-0.7, 0.9, 2.06), (0.1, 0.95, 2.1), glowing("Tube", (1.0, 0.92, 0.8), 30.0))
    box("Cabinet", (-0.9, 0.45, 0.35), (0.3, 0.99, 0.8), wood("Oak", scale=2.0), bevel=0.01)
    bowl = [(0.0, 0.03), (0.16, 0.03), (0.24, 0.14), (0.25, 0.16), (0.27, 0.16), (0.25, 0.08), (0.18, 0.0), (0.0, 0.0)]
    lathe("Basin", bowl, white, (-0.3, 0.7, 0.8))
    rod("Tap", chrome, (-0.3, 0.92, 0.92), (0.02, 0.24), bevel=0.005)
    rod("Spout", chrome, (-0.3, 0.84, 1.03), (0.015, 0.2), (math.pi / 2, 0, 0), bevel=0.005)
    cup = [(0.0, 0.0), (0.035, 0.0), (0.04, 0.11), (0.036, 0.11), (0.032, 0.01), (0.0, 0.01)]
    lathe("Cup", cup, glass("Cup"), (0.15, 0.8, 0.8))
    lathe("Soap", [(0.0, 0.0), (0.035, 0.0), (0.035, 0.12), (0.012, 0.14), (0.012, 0.17), (0.0, 0.17)],
                material("Soap", (0.6, 0.25, 0.1), 0.25, Coat_Weight=1.0), (-0.75, 0.8, 0.8))  # fmt: skip
    box("Pane", (0.62, -0.6, 0.02), (0.63, 0.99, 2.0), glass("Pane", color=(0.93, 0.98, 0.96)))
    box("Rail", (0.61, -0.6, 2.0), (0.64, 0.99, 2.03), chrome)
    towel = material("Towel", (0.75, 0.35, 0.25), 0.9, Sheen_Weight=0.6)
    bump(towel, texture(towel.node_tree, "Voronoi", 90.0), 0.8, 0.01)
    box("Towel", (-1.58, -0.3, 0.9), (-1.53, 0.25, 1.6), towel, bevel=0.02)
    softbox("Panel", 45, (1.2, 0.6), (0.0, -0.6, 2.48), (0.0, -0.6, 0.0), (1.0, 0.96, 0.9))
    camera((0.5, -2.2, 1.5), (-0.25, 1.0, 1.1), 28)


def car():
    """A body with flakes under a clear coat, dark windows, rubber and rims in a dark studio with long strips."""
    along = np.linspace(-1.0, 1.0, 49)
    around = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    nose = np.clip(1.0 - np.abs(along) ** 6, 0.0, 1.0) ** 0.5
    cos, sin = np.cos(around), np.sin(around)
    side = np.sign(cos) * np.abs(cos) ** 0.5
    up = np.sign(sin) * np.abs(sin) ** 0.6
    waist = 0.27 * nose[:, None] * up
    across = 0.85 * (0.3 + 0.7 * nose[:, None]) * side
    points = np.stack([2.0 * along[:, None] + 0.0 * up, across, 0.62 + waist], axis=-1)
    points[[0, -1]] = points[[0, -1]].mean(axis=1, keepdims=True)
    paint = material("Paint", (0.25, 0.02, 0.03), 0.35, Metallic=0.8, Coat_Weight=1.0, Coat_Roughness=0.02)
    flake = texture(paint.node_tree, "Voronoi", 160.0)
    bump(paint, flake, 0.25, 0.004)
    clean = texture(paint.node_tree, "Noise", 60.0)
    drive(paint, "Base Color", clean, (0.2, 0.01, 0.015), (0.5, 0.04, 0.05), (0.4, 0.6))
    grid("Body", points, paint, closed=True)
    dark = material("Windows", (0.01, 0.01, 0.012), 0.03)
    ball("Cabin", dark, (0.15, 0, 0.82), (1.15, 0.72, 0.48))
    ball("Roof", paint, (0.15, 0, 1.05), (0.85, 0.6, 0.27))
    rubber = worn("Rubber", (0.02, 0.02, 0.02), 0.7, 20.0)
    rim = brushed("Rim", (0.75, 0.75, 0.77), 0.25)
    for x in (-1.25, 1.25):
        for y in (-0.78, 0.78):
            turn = (math.pi / 2, 0, 0)
            put("torus", "Tire", rubber, (x, y, 0.36), turn, major_radius=0.27, minor_radius=0.1)
            rod("Rim", rim, (x, y * 1.06, 0.36), (0.22, 0.06), turn, bevel=0.02)
            for angle in np.arange(0.0, 6.2, 1.257):
                spot = (x + 0.12 * math.cos(angle), 1.1 * y, 0.36 + 0.12 * math.sin(angle))
                put("cube", "Spoke", dark, spot, (0, -angle, 0), (0.14, 0.02, 0.04), size=1)
    for y in (-0.45, 0.45):
        ball("Lamp", glowing("Lamp", (0.9, 0.95, 1.0), 6.0), (-1.9, y, 0.66), (0.05, 0.14, 0.05))
    panel("Floor", (-9, -9, 0.06), (18, 0, 0), (0, 18, 0), worn("Floor", (0.06, 0.06, 0.065), 0.25, 3.0))
    panel("Wall", (-9, 5, 0), (18, 0, 0), (0, 0, 7), material("Wall", (0.2, 0.2, 0.22), 0.7))
    for number, y in enumerate((-1.6, 0.0, 1.6)):
        softbox(f"Strip {number}", 130, (5.0, 0.25), (0.0, y, 3.0), (0.0, y, 0.0))
    softbox("Side", 120, (3.0, 0.6), (-2.5, -4.0, 1.4), (0.0, 0.0, 0.7), COOL)
    softbox("Rim light", 150, (0.4, 2.5), (4.0, 2.5, 1.8), (0.0, 0.0, 0.7), WARM)
    world((0.02, 0.022, 0.03))
    camera((-4.3, -4.6, 1.7), (0.0, 0.0, 0.62), 50)


def cloth():
    """A draped sheet, velvet, knitted wool, a leather cushion and silk, by a softbox and a window's cool light."""
    x, y = np.meshgrid(np.linspace(-1.3, 1.3, 120), np.linspace(0.0, 1.0, 20), indexing="ij")
    folds = 0.09 * np.sin(9.0 * x + 2.0 * np.sin(3.0 * x)) * (0.3 + y)
    silk = material("Silk", (0.55, 0.5, 0.42), 0.35, Anisotropic=0.6, Sheen_Weight=0.2)
    grid("Curtain", np.stack([x, 0.9 + folds, 1.9 - 1.9 * y], axis=-1), silk)
    u, v = np.meshgrid(np.linspace(-1, 1, 120), np.linspace(-1, 1, 120), indexing="ij")
    out, turn = np.hypot(u, v), np.arctan2(v, u)
    fall = 0.4 * np.exp(-((out / 0.5) ** 4)) + 0.1 * np.exp(-((out / 0.3) ** 2)) + 0.04
    ripple = 0.06 * np.sin(9.0 * turn + 2.0 * np.sin(3.0 * turn)) * np.clip(2.0 * out - 0.6, 0.0, 0.5)
    wrinkle = 0.012 * np.sin(11.0 * u + 3.0 * np.sin(5.0 * v))
    velvet = material("Velvet", (0.16, 0.01, 0.03), 0.8, Sheen_Weight=1.0, Sheen_Roughness=0.3)
    shader(velvet).inputs["Sheen Tint"].default_value = (0.9, 0.35, 0.45, 1.0)
    grid("Velvet", np.stack([0.85 * u - 0.5, 0.75 * v, fall + ripple + wrinkle], axis=-1), velvet)
    wool = material("Wool", (0.62, 0.55, 0.42), 0.9, Sheen_Weight=0.4)
    knit = texture(wool.node_tree, "Wave", 18.0, **{"bands_direction": "DIAGONAL", "Distortion": 2.0})
    bump(drive(wool, "Base Color", knit, (0.42, 0.34, 0.24), (0.66, 0.6, 0.48)), knit, 0.9, 0.02)
    for number, (a, b, r) in enumerate(((0.62, -0.35, 0.2), (0.98, -0.2, 0.17), (0.78, -0.58, 0.13))):
        ball(f"Ball {number}", wool, (a, b, r + 0.02), r, (0.5 * number, 0.3, 0))
    hide = worn("Leather", (0.12, 0.05, 0.025), 0.4, 30.0, 0.15)
    grain = texture(hide.node_tree, "Voronoi", 45.0)
    bump(hide, grain, 0.35, 0.01)
    pillow = put("cube", "Cushion", hide, (0.75, 0.3, 0.3), (1.2, 0.0, 0.25), (0.75, 0.75, 0.3), size=1)
    pillow.modifiers.new("Round", "SUBSURF").levels = 3
    pillow.modifiers["Round"].render_levels = 3
    pillow.data.polygons.foreach_set("use_smooth", [True] * 6)
    panel("Floor", (-4, -4, 0), (8, 0, 0), (0, 6, 0), wood("Boards", scale=1.2))
    panel("Wall", (-4, 1.2, 0), (8, 0, 0), (0, 0, 4), worn("Plaster", (0.5, 0.48, 0.45), 0.8, 4.0, 0.1, 0.3))
    softbox("Key", 160, (1.0, 1.4), (-2.2, -1.6, 2.2), (0.0, 0.0, 0.3), WARM)
    softbox("Window", 80, (1.2, 2.0), (2.6, -0.8, 1.6), (0.0, 0.2, 0.4), COOL)
    spot("Accent", 90, (0.4, -1.4, 2.8), (0.75, -0.2, 0.2), WARM, 0.6)
    world((0.3, 0.35, 0.45), 0.15)
    camera((0.15, -3.2, 1.5), (0.15, 0.1, 0.55), 45)


def _leaf(name, color):
    """A leaf on a card: the alpha and the veins of an image, and light that goes through it."""
    size = 64
    along, across = (np.mgrid[0:size, 0:size] + 0.5) / size
    middle = np.abs(across - 0.5)
    pixels = np.ones((size, size, 4), np.float32)
    vein = (middle < 0.02) | (np.abs(((along - middle) * 7) % 1.0 - 0.5) < 0.06)
    pixels[..., :3] = np.where(vein[..., None], 1.6, 1.0) * np.array(color)
    pixels[..., 3] = middle < 0.36 * np.sin(np.pi * np.clip(along, 0, 1)) ** 0.7
    image = bpy.data.images.new(name, size, size, alpha=True, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    surface = material(name, color, 0.4)
    tree = surface.node_tree
    sample = tree.nodes.new("ShaderNodeTexImage")
    sample.image = image
    tree.links.new(sample.outputs["Color"], shader(surface).inputs["Base Color"])
    tree.links.new(sample.outputs["Alpha"], shader(surface).inputs["Alpha"])
    return surface


def foliage():
    """A bush and grass of alpha cards by a stone wall, terracotta and a ball, in the sun under a sky."""
    random = np.random.default_rng(4)
    ground = worn("Soil", (0.16, 0.1, 0.06), 0.9, 12.0, 0.1, 0.6)
    panel("Ground", (-6, -6, 0), (12, 0, 0), (0, 12, 0), ground)
    stone = tiles("Stone", (0.42, 0.38, 0.33), (0.25, 0.23, 0.2), 0.9, 0.7)
    panel("Wall", (-5, 1.6, 0), (10, 0, 0), (0, 0, 2.2), stone, 2.0)
    pot = [(0.0, 0.0), (0.22, 0.0), (0.32, 0.42), (0.36, 0.42), (0.36, 0.5), (0.31, 0.5), (0.28, 0.42), (0.0, 0.42)]
    clay = worn("Clay", (0.5, 0.2, 0.1), 0.75, 9.0, 0.1, 0.2)
    lathe("Pot", pot, clay, (-0.35, 0.2, 0.0))
    ball("Ball", worn("Copper", (0.8, 0.45, 0.3), 0.25, 5.0, Metallic=1.0), (0.85, -0.35, 0.24), 0.24)
    card = np.stack(np.meshgrid(np.linspace(0, 0.26, 5), np.linspace(-0.09, 0.09, 3), indexing="ij"), axis=-1)
    card = np.concatenate([card, (-1.5 * card[..., :1] ** 2 + 4.0 * card[..., 1:] ** 2)], axis=-1)
    for number, color in enumerate(((0.06, 0.2, 0.03), (0.1, 0.28, 0.04), (0.2, 0.3, 0.05))):
        leaf = grid(f"Leaf {number}", card, _leaf(f"Leaf {number}", color))
        where = random.normal(size=(130, 3))
        where /= np.linalg.norm(where, axis=1)[:, None]
        radius = random.uniform(0.35, 1.0, (130, 1)) ** 0.5
        spots = where * radius * [0.62, 0.5, 0.5] + [-0.35, 0.2, 1.0]
        turns = random.uniform((-1.0, -1.2, 0.0), (1.0, 0.6, 0.0), (130, 3))
        turns[:, 2] = np.arctan2(where[:, 1], where[:, 0])
        copies(leaf, spots, turns, random.uniform(0.6, 1.3, 130))
        leaf.location = (-0.35, -0.3, 0.62)
    blade = mesh("Blade", [(-0.012, 0, 0), (0.012, 0, 0), (0.008, 0.03, 0.16), (-0.006, 0.1, 0.3)],
                       [(0, 1, 2, 3)], material("Grass", (0.12, 0.25, 0.04), 0.45), smooth=True)  # fmt: skip
    spots = np.concatenate([random.uniform((-2.6, -1.3), (2.6, 1.5), (420, 2)), np.zeros((420, 1))], axis=1)
    copies(blade, spots, random.normal(size=(420, 3)) * [0.25, 0.25, 3.0], random.uniform(0.5, 1.2, 420))
    rod("Stem", material("Bark", (0.1, 0.06, 0.03), 0.8), (-0.35, 0.2, 0.7), (0.025, 0.6))
    daylight(38, 235, sun=4.0, sky=0.35)
    camera((0.3, -4.2, 1.5), (0.1, 0.0, 0.65), 42)


def window():
    """A furnished room that has light through one window with bars only: the sun and a sky."""
    white, oak = worn("Plaster", WHITE, 0.75, 3.0, 0.1, 0.15), wood("Oak", scale=1.5)
    panel("Floor", (-2, -2.5, 0), (4, 0, 0), (0, 5, 0), wood("Parquet", scale=2.0))
    box("Ceiling", (-2.1, -2.6, 2.6), (2.1, 2.6, 2.7), white)
    box("Back", (-2.1, 2.5, 0), (2.1, 2.6, 2.6), material("Green", (0.25, 0.35, 0.28), 0.7))
    box("Front", (-2.1, -2.6, 0), (2.1, -2.5, 2.6), white)
    box("Right", (2.0, -2.5, 0), (2.1, 2.5, 2.6), white)
    for name, low, high in (("Sill", (-2.5, 0.0), (2.5, 0.7)), ("Lintel", (-2.5, 2.3), (2.5, 2.6)),
                            ("Near", (-2.5, 0.7), (-0.7, 2.3)), ("Far", (1.4, 0.7), (2.5, 2.3)),
                            ("Bar", (0.32, 0.7), (0.37, 2.3)), ("Cross", (-0.7, 1.6), (1.4, 1.65))):  # fmt: skip
        box(name, (-2.12, *low), (-2.0, *high), white)
    box("Table", (-0.9, 0.5, 0.68), (0.7, 1.4, 0.73), oak, bevel=0.01)
    for x in (-0.85, 0.6):
        for y in (0.55, 1.3):
            box("Leg", (x, y, 0.0), (x + 0.05, y + 0.05, 0.68), oak)
    vase = [(0.0, 0.0), (0.07, 0.0), (0.12, 0.1), (0.1, 0.2), (0.04, 0.28), (0.06, 0.33)]
    lathe("Vase", vase, material("Glaze", (0.05, 0.15, 0.35), 0.1, Coat_Weight=0.5), (-0.35, 1.0, 0.73))
    lathe("Bowl", [(0.0, 0.01), (0.1, 0.02), (0.19, 0.1), (0.2, 0.1), (0.11, 0.0), (0.0, 0.0)],
                brushed("Brass", (0.85, 0.62, 0.3), 0.3), (0.2, 0.85, 0.73))  # fmt: skip
    fruits = (0.14, 0.83, (0.6, 0.05, 0.03)), (0.26, 0.88, (0.7, 0.4, 0.05)), (0.2, 0.78, (0.3, 0.5, 0.08))
    for number, (x, y, color) in enumerate(fruits):
        skin = material("Fruit", color, 0.3, Subsurface_Weight=0.3, Subsurface_Scale=0.02)
        ball(f"Fruit {number}", skin, (x, y, 0.82), 0.06)
    for number, color in enumerate(((0.5, 0.1, 0.08), (0.1, 0.2, 0.4), (0.75, 0.7, 0.6), (0.1, 0.3, 0.2))):
        x, cover = 0.9 + 0.06 * number, material("Cover", color, 0.5)
        box(f"Book {number}", (x, 2.2, 1.2), (x + 0.05, 2.42, 1.45 + 0.03 * (number % 3)), cover, bevel=0.004)
    box("Shelf", (0.4, 2.2, 1.16), (1.6, 2.5, 1.2), oak)
    box("Frame", (-1.2, 2.46, 1.2), (-0.4, 2.5, 1.9), material("Frame", (0.03, 0.03, 0.03), 0.3))
    poster = tiles("Print", (0.7, 0.3, 0.1), (0.1, 0.2, 0.3), 3.0, 0.4)
    box("Picture", (-1.15, 2.45, 1.25), (-0.45, 2.47, 1.85), poster)
    rug = material("Rug", (0.35, 0.12, 0.1), 0.95, Sheen_Weight=0.3)
    check = texture(rug.node_tree, "Voronoi", 14.0)
    bump(drive(rug, "Base Color", check, (0.4, 0.1, 0.08), (0.6, 0.5, 0.35), (0.3, 0.6)), check, 0.5)
    box("Rug", (-1.3, -0.6, 0.0), (1.0, 1.9, 0.015), rug)
    daylight(28, 190, sun=6.0, sky=1.2, angle=0.02)
    camera((1.6, -2.3, 1.5), (-0.4, 1.2, 0.85), 26)
    bpy.context.scene.view_settings.exposure = 1.8


def street():
    """A wet street at night between houses, with 60 lamps: lanterns on poles, lamps above doors and shop windows."""
    random = np.random.default_rng(2)
    road = worn("Asphalt", (0.05, 0.05, 0.055), 0.35, 2.0, 0.28, 0.15)
    panel("Road", (-3, -4, 0), (6, 0, 0), (0, 44, 0), road)
    pavement = tiles("Pavement", (0.2, 0.19, 0.18), (0.06, 0.06, 0.06), 2.0, 0.5)
    glow, dark = glowing("Lit window", (1.0, 0.72, 0.4), 2.5), material("Pane", (0.02, 0.02, 0.03), 0.05)
    iron = material("Iron", (0.03, 0.03, 0.03), 0.45, Metallic=1.0)
    bulb = glowing("Bulb", (1.0, 0.75, 0.45), 40.0)
    for side in (-1, 1):
        box("Pavement", (min(side * 3, side * 5), -4, 0), (max(side * 3, side * 5), 40, 0.12), pavement)
        for number in range(6):
            y, height = -3.0 + 7.0 * number, random.uniform(5.5, 9.0)
            tone = random.uniform(0.15, 0.4) * np.array(
                ((1, 0.8, 0.65), (0.9, 0.9, 0.85), (0.8, 0.55, 0.45))[number % 3]
            )
            wall = tiles(f"House {side} {number}", tuple(tone), tuple(0.7 * tone), 2.0, 0.8)
            ends = sorted((side * 5, side * 9))
            box("House", (ends[0], y, 0), (ends[1], y + 6.9, height), wall)
            for floor in range(1, int(height / 2.4)):
                for place in range(3):
                    x = side * 4.97
                    lit = glow if random.random() < 0.3 else dark
                    box("Window", (x - 0.05, y + 0.8 + 2.0 * place, 2.4 * floor + 0.5),
                              (x + 0.05, y + 1.9 + 2.0 * place, 2.4 * floor + 1.9), lit)  # fmt: skip
            # Two lamps above the doors of each house, and a shop window of two strips in every second one
            for place in (1.5, 5.0):
                color = (1.0, 0.8, 0.55) if random.random() < 0.6 else (0.7, 0.85, 1.0)
                spot("Door", 60, (side * 4.7, y + place, 2.5), (side * 4.3, y + place, 0), color, 2.0)
            if number % 2 == 0:
                for place, color in ((2.2, (1.0, 0.35, 0.5)), (4.2, (0.4, 0.8, 1.0))):
                    softbox("Shop", 35, (1.4, 1.0), (side * 4.9, y + place, 1.4), (0.0, y + place, 0.6), color)
        for number in range(12):
            y = -1.0 + 3.2 * number + (1.6 if side > 0 else 0.0)
            rod("Pole", iron, (side * 3.2, y, 1.7), (0.045, 3.4))
            ball("Bulb", bulb, (side * 3.2, y, 3.5), 0.09)
            point("Lantern", 70, (side * 2.95, y, 3.3), (1.0, 0.72, 0.42), 0.08)
    paint = material("Car", (0.03, 0.06, 0.2), 0.25, Metallic=0.6, Coat_Weight=1.0, Coat_Roughness=0.03)
    for x, y in ((-2.2, 5.0), (2.2, 9.5)):
        box("Car", (x - 0.75, y - 1.9, 0.3), (x + 0.75, y + 1.9, 0.8), paint, bevel=0.15)
        box("Cabin", (x - 0.65, y - 0.9, 0.8), (x + 0.65, y + 1.1, 1.3), dark, bevel=0.2)
        for a, b in ((-0.75, -1.2), (-0.75, 1.2), (0.75, -1.2), (0.75, 1.2)):
            rod("Wheel", iron, (x + a, y + b, 0.32), (0.32, 0.2), (0, math.pi / 2, 0))
    world((0.01, 0.014, 0.03))
    camera((0.5, -3.6, 1.7), (0.0, 8.0, 1.9), 30)


def _screen(name, colors, strength):
    """A screen whose picture, of blocks and lines, shines."""
    width, height = 48, 32
    random = np.random.default_rng(len(name))
    pixels = np.ones((height, width, 4), np.float32)
    rows, columns = random.integers(0, len(colors), (8, 12)), np.kron
    pixels[..., :3] = columns(np.array(colors)[rows].transpose(2, 0, 1), np.ones((4, 4))).transpose(1, 2, 0)
    pixels[::4, :, :3] *= 0.3
    image = bpy.data.images.new(name, width, height, float_buffer=True)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    surface = material(name, (0.01, 0.01, 0.01), 0.15, Emission_Strength=strength)
    sample = surface.node_tree.nodes.new("ShaderNodeTexImage")
    sample.image = image
    surface.node_tree.links.new(sample.outputs["Color"], shader(surface).inputs["Emission Color"])
    return surface


def glow():
    """A desk at night that glows: three screens, neon tubes on the wall, a lava lamp, keys with light below them."""
    panel("Floor", (-4, -4, 0), (8, 0, 0), (0, 6, 0), worn("Floor", (0.08, 0.08, 0.09), 0.3, 4.0))
    bricks = tiles("Bricks", (0.3, 0.16, 0.12), (0.2, 0.2, 0.2), 2.0, 0.7)
    panel("Wall", (-4, 1.2, 0), (8, 0, 0), (0, 0, 4), bricks, 2.0)
    box("Desk", (-1.5, -0.2, 0.72), (1.5, 0.8, 0.76), worn("Lacquer", (0.04, 0.035, 0.04), 0.2, 5.0), bevel=0.01)
    black = material("Black", (0.02, 0.02, 0.02), 0.35)
    screens = (("Code", ((0.02, 0.03, 0.05), (0.1, 0.5, 0.3), (0.05, 0.2, 0.5)), -0.75, 0.35),
               ("Editor", ((0.05, 0.05, 0.06), (0.7, 0.7, 0.75), (0.9, 0.5, 0.1), (0.1, 0.1, 0.12)), 0.05, 0.0),
               ("Game", ((0.6, 0.05, 0.4), (0.05, 0.3, 0.7), (0.9, 0.6, 0.1)), 0.85, -0.35))  # fmt: skip
    for name, colors, x, turn in screens:
        across = np.array([math.cos(turn), math.sin(turn), 0.0])
        corner = np.array([x, 0.35 + 0.15 * abs(x), 0.86]) - 0.36 * across
        panel(name, corner, 0.72 * across, (0, 0, 0.42), _screen(name, colors, 3.0), 1.0 / 0.72)
        middle = corner + 0.36 * across + (0, 0.03, 0.21)
        put("cube", f"{name} back", black, middle, (0, 0, turn), (0.74, 0.04, 0.46), size=1)
        box(f"{name} foot", (x - 0.1, 0.42, 0.76), (x + 0.1, 0.62, 0.9), black)
    pink, tube = glowing("Pink", (1.0, 0.1, 0.45), 18.0), {"major_radius": 0.35, "minor_radius": 0.015}
    put("torus", "Ring", pink, (-0.9, 1.12, 1.95), (math.pi / 2, 0, 0), major_segments=64, **tube)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    along = np.linspace(0, 1, 60)
    line = np.stack([0.2 + 1.1 * along, np.full(60, 1.14), 1.95 + 0.2 * np.sin(12 * along)], axis=1)[:, None]
    ring = 0.014 * np.stack([np.zeros(12), np.cos(angle), np.sin(angle)], axis=1)
    grid("Wave", line + ring, glowing("Cyan", (0.1, 0.75, 1.0), 18.0), closed=True)
    box("Strip", (-1.5, 0.81, 0.7), (1.5, 0.83, 0.72), glowing("Violet", (0.45, 0.15, 1.0), 12.0))
    lava = glowing("Lava", (1.0, 0.25, 0.05), 3.0)
    for number, (z, r) in enumerate(((0.88, 0.05), (0.98, 0.035), (1.06, 0.025))):
        ball(f"Lava {number}", lava, (-1.3, 0.2, z), r)
    bottle, chrome = glass("Bottle", color=(1.0, 0.85, 0.8)), material("Chrome", (0.9, 0.9, 0.9), 0.1, Metallic=1.0)
    lathe("Lava lamp", [(0.0, 0.82), (0.08, 0.82), (0.06, 1.12), (0.0, 1.12)], bottle, (-1.3, 0.2, 0.0))
    lathe("Base", [(0.05, 0.76), (0.09, 0.76), (0.07, 0.82), (0.0, 0.82)], chrome, (-1.3, 0.2, 0.0))
    box("Board", (-0.35, -0.12, 0.76), (0.35, 0.1, 0.775), black)
    key, lit = material("Key", (0.05, 0.05, 0.055), 0.4), glowing("Key light", (0.2, 0.5, 1.0), 2.0)
    box("Key light", (-0.33, -0.1, 0.775), (0.33, 0.08, 0.778), lit)
    for row in range(4):
        for column in range(14):
            x, y = -0.33 + 0.0475 * column, -0.1 + 0.046 * row
            box("Key", (x, y, 0.778), (x + 0.04, y + 0.038, 0.79), key)
    mug = [(0.0, 0.77), (0.04, 0.77), (0.045, 0.88), (0.04, 0.88), (0.036, 0.78), (0.0, 0.78)]
    lathe("Mug", mug, material("Mug", (0.7, 0.7, 0.72), 0.12), (0.65, 0.0, 0.0))
    ball("Figure", material("Gold", (0.9, 0.65, 0.3), 0.2, Metallic=1.0), (1.15, 0.05, 0.87), 0.11)
    world((0.02, 0.02, 0.04), 0.3)
    camera((0.3, -2.3, 1.65), (0.0, 0.6, 1.2), 32)


def workshop():
    """A bench of steel with turned, brushed and drilled metal under two tubes and a work lamp."""
    steel = brushed("Steel", (0.62, 0.62, 0.64), 0.35)
    brass, copper = brushed("Brass", (0.85, 0.65, 0.3), 0.25), brushed("Copper", (0.9, 0.5, 0.35), 0.3)
    cast = worn("Cast iron", (0.12, 0.12, 0.13), 0.55, 18.0, 0.15, 0.3, Metallic=0.9)
    paint = worn("Machine green", (0.08, 0.22, 0.16), 0.35, 4.0, 0.1)
    box("Bench", (-1.6, -0.5, -0.06), (1.6, 0.9, 0.0), steel, bevel=0.01)
    panel("Wall", (-4, 1.3, -1), (8, 0, 0), (0, 0, 4), worn("Wall", (0.4, 0.42, 0.42), 0.7, 3.0, 0.1, 0.1))
    panel("Floor", (-4, -4, -1), (8, 0, 0), (0, 6, 0), worn("Concrete", (0.25, 0.25, 0.24), 0.7, 5.0, 0.2, 0.2))
    box("Vise base", (-1.1, 0.0, 0.0), (-0.5, 0.5, 0.12), paint, bevel=0.02)
    box("Jaw", (-1.05, 0.02, 0.12), (-0.85, 0.48, 0.36), paint, bevel=0.02)
    box("Jaw 2", (-0.7, 0.02, 0.12), (-0.55, 0.48, 0.36), paint, bevel=0.02)
    box("Work", (-0.85, 0.1, 0.2), (-0.7, 0.4, 0.46), brass, bevel=0.005)
    rod("Spindle", steel, (-0.42, 0.25, 0.18), (0.03, 0.4), (0, math.pi / 2, 0))
    rod("Handle", cast, (-0.25, 0.25, 0.18), (0.014, 0.34), (0.5, 0, 0))
    shaft = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.06), (0.09, 0.06), (0.09, 0.2), (0.07, 0.2), (0.07, 0.42)]
    shaft += [(0.045, 0.44), (0.045, 0.6), (0.0, 0.6)]
    lathe("Shaft", shaft, steel, (0.25, 0.35, 0.0), 64)
    lathe("Bush", [(0.05, 0.0), (0.12, 0.0), (0.12, 0.16), (0.05, 0.16), (0.05, 0.0)], copper, (0.62, 0.15, 0.0), 64)
    gear = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    teeth = np.where(np.arange(96) // 3 % 2, 0.2, 0.165)
    outline = np.stack([teeth * np.cos(gear), teeth * np.sin(gear)], axis=1)
    rows = [
        np.column_stack([scale * outline, np.full(96, z)])
        for scale, z in ((0.2, 0.0), (1.0, 0.0), (1.0, 0.06), (0.2, 0.06))
    ]
    wheel = grid("Gear", np.stack(rows), steel, smooth=False, closed=True)
    wheel.location, wheel.rotation_euler = (0.95, 0.42, 0.2), (1.25, 0.0, -0.3)
    for number in range(9):
        x, y = 0.0 + 0.13 * (number % 5), -0.32 + 0.16 * (number // 5)
        metal = (steel, brass, cast)[number % 3]
        rod("Bolt", metal, (x, y, 0.02), (0.04, 0.04), (0, 0, 0.3 * number), bevel=0.003, vertices=6)
        rod("Thread", steel, (x, y, 0.075), (0.02, 0.07))
    plate = box("Plate", (-0.95, -0.42, 0.002), (-0.3, -0.1, 0.014), brushed("Plate", (0.75, 0.75, 0.76), 0.25))
    plate.rotation_euler = (0, 0, 0.25)
    grip = material("Grip", (0.6, 0.08, 0.04), 0.4)
    for number in range(7):
        height = 0.75 + 0.08 * (number % 3)
        x = -1.2 + 0.3 * number
        box("Tool", (x, 1.24, height), (x + 0.04, 1.28, height + 0.5), (steel, cast)[number % 2], bevel=0.006)
        box("Grip", (x - 0.01, 1.23, height - 0.16), (x + 0.05, 1.29, height), grip, bevel=0.012)
    softbox("Tube 1", 40, (1.6, 0.08), (-0.6, 0.0, 1.9), (-0.6, 0.1, 0.0), (0.9, 1.0, 0.98))
    softbox("Tube 2", 40, (1.6, 0.08), (0.9, -0.6, 1.9), (0.6, 0.1, 0.0), (0.9, 1.0, 0.98))
    spot("Work lamp", 70, (-1.3, -0.7, 1.1), (-0.6, 0.2, 0.2), WARM, 0.9)
    world((0.4, 0.45, 0.5), 0.08)
    camera((0.15, -1.9, 0.95), (0.0, 0.25, 0.22), 38)


def food():
    """A breakfast by a window: bread, cheese, tomatoes, an orange, a fried egg and milk, all of which light enters."""
    cloth_ = material("Linen", (0.6, 0.6, 0.58), 0.9, Sheen_Weight=0.3)
    weave = texture(cloth_.node_tree, "Wave", 22.0, **{"Distortion": 1.5})
    bump(cloth_, weave, 0.25, 0.005)
    panel("Table", (-1.5, -1.2, 0), (3, 0, 0), (0, 2.4, 0), cloth_)
    panel("Wall", (-3, 1.2, -1), (6, 0, 0), (0, 0, 3), worn("Wall", (0.35, 0.42, 0.45), 0.8, 2.0, 0.1, 0.1))

    def soft(name, color, rough, radius, scale, depth=0.0, **more):
        below = {"Subsurface_Weight": 1.0, "Subsurface_Radius": radius, "Subsurface_Scale": scale}
        return worn(name, color, rough, 60.0, 0.1, depth, **below, **more)

    porcelain = material("Porcelain", (0.82, 0.82, 0.8), 0.1, Subsurface_Weight=0.3, Subsurface_Scale=0.01)
    plate = [(0.0, 0.012), (0.2, 0.012), (0.24, 0.02), (0.33, 0.045), (0.335, 0.04), (0.2, 0.0), (0.0, 0.0)]
    lathe("Plate", plate, porcelain, (-0.1, 0.0, 0.0), 64)
    tomato = soft("Tomato", (0.7, 0.05, 0.02), 0.2, (1.0, 0.3, 0.1), 0.03, Coat_Weight=0.5, Coat_Roughness=0.05)
    stalk = material("Stalk", (0.08, 0.2, 0.03), 0.6)
    tomatoes = (0.08, -0.06, 0.06), (0.12, 0.08, 0.065), (0.0, 0.13, 0.055), (0.5, -0.2, 0.065)
    for number, (x, y, r) in enumerate(tomatoes):
        z = 0.012 + 0.85 * r if x < 0.3 else 0.85 * r
        ball(f"Tomato {number}", tomato, (x, y, z), (r, r, 0.85 * r), (0.2, 0.15 * number, 0))
        rod("Stalk", stalk, (x, y, z + 0.9 * r), (0.3 * r, 0.1 * r), vertices=5)
    cheese = soft("Cheese", (0.85, 0.6, 0.18), 0.35, (0.6, 0.4, 0.15), 0.04, depth=0.1)
    corner = [(0, 0), (0.22, -0.06), (0.22, 0.08)]
    wedge = [(x, y, z) for z in (0.0, 0.1) for x, y in corner]
    slab = mesh("Cheese", wedge, [(2, 1, 0), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)], cheese)
    slab.location, slab.rotation_euler = (-0.33, 0.1, 0.018), (0, 0, -0.5)
    white = soft("Egg white", (0.85, 0.84, 0.8), 0.2, (0.5, 0.5, 0.4), 0.02, depth=0.15)
    yolk = soft("Yolk", (0.9, 0.45, 0.02), 0.15, (1.0, 0.5, 0.1), 0.03)
    ball("White", white, (-0.12, -0.13, 0.018), (0.1, 0.085, 0.012))
    ball("Yolk", yolk, (-0.13, -0.13, 0.03), (0.036, 0.036, 0.022))
    crumb = soft("Bread", (0.72, 0.52, 0.3), 0.85, (0.6, 0.35, 0.15), 0.02, depth=0.9)
    crust = worn("Crust", (0.35, 0.16, 0.05), 0.6, 20.0, 0.1, 0.5)
    for number in range(3):
        turn = (0.0, -0.75 - 0.12 * number, 0.5)
        rod(f"Slice {number}", crust, (0.45 + 0.07 * number, 0.3, 0.13), (0.14, 0.026), turn)
        rod(f"Crumb {number}", crumb, (0.45 + 0.07 * number, 0.3, 0.13), (0.128, 0.028), turn)
    peel = soft("Orange", (0.9, 0.3, 0.02), 0.3, (1.0, 0.4, 0.1), 0.03)
    bump(peel, texture(peel.node_tree, "Voronoi", 60.0), 0.4, 0.004)
    for number, (x, y) in enumerate(((-0.55, 0.35), (-0.42, 0.48))):
        ball(f"Orange {number}", peel, (x, y, 0.085), 0.085)
    tumbler = [(0.0, 0.0), (0.04, 0.0), (0.05, 0.17), (0.046, 0.17), (0.037, 0.008), (0.0, 0.008)]
    lathe("Tumbler", tumbler, glass("Tumbler"), (0.3, 0.12, 0.0))
    milk = soft("Milk", (0.85, 0.84, 0.8), 0.15, (0.8, 0.7, 0.5), 0.05)
    lathe("Milk", [(0.0, 0.009), (0.036, 0.009), (0.043, 0.12), (0.0, 0.12)], milk, (0.3, 0.12, 0.0))
    box("Knife", (-0.52, -0.3, 0.004), (-0.5, 0.02, 0.008), brushed("Knife", roughness=0.2))
    box("Grip", (-0.523, -0.46, 0.002), (-0.497, -0.3, 0.014), wood("Grip"), bevel=0.004)
    softbox("Window", 40, (0.9, 1.2), (-1.5, 0.5, 1.0), (0.0, 0.0, 0.05), (0.95, 0.97, 1.0))
    softbox("Fill", 6, 0.8, (1.3, -0.9, 0.9), (0.0, 0.0, 0.05), WARM)
    world((0.5, 0.55, 0.6), 0.25)
    camera((0.1, -1.25, 0.72), (0.03, 0.08, 0.05), 50)


def hall():
    """A hall of columns with a marble floor under 300 lights: panels, spots at the columns, lamps on the walls."""
    random = np.random.default_rng(3)
    marble = worn("Marble", (0.5, 0.47, 0.42), 0.15, 1.5, 0.06)
    vein = texture(marble.node_tree, "Noise", 1.2, **{"Detail": 8.0, "Distortion": 2.5})
    drive(marble, "Base Color", vein, (0.2, 0.18, 0.17), (0.6, 0.56, 0.5), (0.4, 0.6))
    stone, gold = worn("Stone", (0.5, 0.45, 0.38), 0.6, 4.0, 0.15, 0.1), brushed("Gold", (0.9, 0.65, 0.3), 0.25)
    panel("Floor", (-8, -2, 0), (16, 0, 0), (0, 32, 0), marble)
    panel("Ceiling", (-8, 30, 6), (16, 0, 0), (0, -32, 0), material("Ceiling", (0.55, 0.53, 0.5), 0.8))
    panel("Left", (-8, -2, 0), (0, 32, 0), (0, 0, 6), material("Red wall", (0.35, 0.08, 0.06), 0.6))
    panel("Right", (8, 30, 0), (0, -32, 0), (0, 0, 6), material("Blue wall", (0.08, 0.12, 0.3), 0.6))
    panel("Back", (-8, 30, 0), (16, 0, 0), (0, 0, 6), stone)
    column = [(0.5, 0.0), (0.5, 0.3), (0.36, 0.4), (0.33, 5.3), (0.5, 5.6), (0.5, 6.0)]
    for number in range(10):
        y = 2.0 + 3.0 * number
        for x in (-4.0, 4.0):
            lathe("Column", column, stone, (x, y, 0.0), 32)
            lathe("Collar", [(0.37, 0.42), (0.42, 0.42), (0.42, 0.5), (0.36, 0.5)], gold, (x, y, 0.0), 32)
            for angle in (0.0, 1.571, 3.142, 4.712):
                dx, dy = 0.75 * math.cos(angle), 0.75 * math.sin(angle)
                spot("Column spot", 25, (x + dx, y + dy, 0.15), (x + 0.2 * dx, y + 0.2 * dy, 4.0), WARM, 0.9)
        for x in range(-5, 6, 1):
            color = (1.0, 0.9, 0.75) if abs(x) < 3 else COOL
            softbox("Panel", 16.0, (0.5, 0.5), (1.4 * x, y + 1.5, 5.95), (1.4 * x, y + 1.5, 0.0), color)
        point("Pendant", 40, (0, y, 4.2), WARM, 0.15)
        for side in (-1, 1):
            for height in (1.8, 2.6, 3.4, 4.2, 5.0):
                color = 1.0, random.uniform(0.5, 0.9), random.uniform(0.2, 0.8)
                point("Wall lamp", 7.0, (side * 7.7, y + 0.3 * height, height), color, 0.06)
    for number, (x, y) in enumerate(((-1.3, 2.6), (1.5, 3.6), (0.2, 6.5))):
        box("Plinth", (x - 0.3, y - 0.3, 0), (x + 0.3, y + 0.3, 0.9), stone, bevel=0.03)
        color = ((0.9, 0.9, 0.9), (0.85, 0.6, 0.3), (0.6, 0.35, 0.2))[number]
        metal = worn(f"Statue {number}", color, 0.15 + 0.1 * number, 6.0, 0.08, Metallic=1.0)
        put("monkey" if number == 1 else "uv_sphere", "Statue", metal, (x, y, 1.3), (0, 0, 0.3), (0.4, 0.4, 0.4))
    world((0.02, 0.02, 0.03))
    camera((0.6, -1.6, 1.7), (0.0, 9.0, 2.1), 26)


def arcade():
    """The scene of `ltsh demo`: an arcade of plastic and metal under area lights, with thousands of small bulbs."""
    bpy.ops.wm.open_mainfile(filepath=str(DEMO))


def studio():
    """Balls of many roughnesses on a plane under four softboxes; nothing of it is hard. `animation.py` looks at it."""
    panel("Floor", (-7, -7, 0), (14, 0, 0), (0, 14, 0), material("Floor", (0.4, 0.4, 0.42), 0.35))
    for number in range(5):
        surface = material("Ball", (0.8, 0.3 + 0.1 * number, 0.2), 0.15 + 0.12 * number, Metallic=number % 2)
        ball(f"Ball {number}", surface, (-2.4 + 1.2 * number, 0.2 * number, 0.55), 0.55)
    for number, place in enumerate(((-4, -3, 3.5), (4, -2, 3), (0, 4, 4), (-1, -4, 5))):
        softbox(f"Box {number}", 150, (1.6, 1.0), place, (0.0, 0.0, 0.4))
    camera((0.0, -6.0, 2.0), (0.0, 0.0, 0.8), 35)


def contact():
    """Small parts that lie on a table: shadows end where they touch it. `shadows.py` takes it and the next two."""
    random = np.random.default_rng(1)
    panel("Table", (-3, -3, 0), (6, 0, 0), (0, 6, 0), material("Table", (0.45, 0.42, 0.4), 0.35))
    paints = [material("Part", color, 0.3) for color in ((0.7, 0.2, 0.1), (0.9, 0.8, 0.6), (0.1, 0.3, 0.7))]
    for number, place in enumerate(np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-2, 3)), axis=-1).reshape(-1, 2)):
        x, y = 0.38 * place + random.uniform(-0.03, 0.03, 2)
        surface, turn = paints[number % 3], random.uniform(0.0, math.pi)
        if number % 3 == 0:
            rod("Rod", surface, (x, y, 0.04), (0.04, 0.25), (0.5 * math.pi, 0.0, turn))
        elif number % 3 == 1:
            put("cube", "Cube", surface, (x, y, 0.07), (0.0, 0.0, turn), size=0.14)
        else:
            ball("Ball", surface, (x, y, 0.1), 0.1)
    softbox("Key", 60, (0.8, 0.5), (1.8, -0.6, 2.2), (0.0, 0.0, 0.0))
    softbox("Rim", 40, (1.4, 0.3), (-1.0, 2.4, 1.4), (0.0, 0.2, 0.0))
    softbox("Spot", 15, 0.25, (-2.0, -1.0, 1.8), (0.0, 0.0, 0.0))
    camera((0.0, -3.2, 1.9), (0.0, 0.1, 0.0), 35)


def highlight():
    """The mirror image of a long light in a glossy floor, half blocked by bars."""
    panel("Floor", (-5, -5, 0), (10, 0, 0), (0, 10, 0), material("Floor", (0.3, 0.3, 0.32), 0.15))
    for x, roughness in ((-1.1, 0.12), (1.1, 0.35)):
        ball("Ball", material("Metal", (0.85, 0.75, 0.6), roughness, Metallic=1.0), (x, 0.0, 0.45), 0.45)
    for height, width in ((0.8, 0.25), (1.3, 0.05), (1.55, 0.02)):
        box("Bar", (-2.6, 1.9, height), (2.6, 1.95, height + width), material("Bar", (0.1, 0.1, 0.1), 0.5))
    softbox("Tube", 120, (3.6, 0.8), (0.0, 3.2, 1.3), (0.0, 0.0, 0.4))
    camera((0.0, -4.5, 1.6), (0.0, 0.6, 0.3), 35)


def leaves():
    """Ground in the shadow of leaves, whose outlines are the alpha of an image; the camera sees none of them."""
    random = np.random.default_rng(1)
    panel("Ground", (-6, -6, 0), (12, 0, 0), (0, 12, 0), material("Ground", (0.35, 0.3, 0.22), 0.45))
    ball("Ball", material("Ball", (0.5, 0.1, 0.1), 0.3), (0.8, -0.2, 0.4), 0.4)
    leaf = panel("Leaf", (-0.2, -0.2, 0), (0.4, 0, 0), (0, 0.4, 0), _leaf("Leaf", (0.1, 0.4, 0.05)), 2.5)
    leaf.visible_camera = False
    places = random.uniform((-2.8, -1.8, 1.5), (2.8, 1.4, 2.5), (420, 3))
    copies(leaf, places, random.uniform((-0.9, -0.9, 0.0), (0.9, 0.9, 6.3), (420, 3)))
    softbox("Sun", 500, 0.9, (1.2, -1.2, 5.0), (0.0, 0.3, 0.0))
    softbox("Sky", 250, (2.5, 2.0), (-1.5, -0.5, 4.2), (0.0, 0.5, 0.3))
    camera((0.0, -4.6, 1.7), (0.0, 0.6, 0.6), 35)


SCENES = (product, bathroom, cloth, window, street, arcade, car, foliage, glow, workshop, food, hall, studio,
          contact, highlight, leaves)  # fmt: skip


def main(name: str, folder: str, *seeds: str) -> None:
    empty_scene(*SIZE)
    {scene.__name__: scene for scene in SCENES}[name]()
    save_seeds(Path(folder), name, map(int, seeds))


if __name__ == "__main__":
    main(*sys.argv[1:])
