"""`ltsh view`: the viewport's picture without a window is that of `ltsh shade`, and refines as a view at rest does."""

import gc
import json
import os
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import programs
import pytest
import random_surfaces
import scene_parts as parts
from fake_scene import run
from graphics_card import edits_with_graphics, with_graphics
from lit_plane import into_collection, light_tree
from view_pictures import OpenView, textured

from ltsh_addon import imaging
from ltsh_addon.blender.extract.occluders import collect_occluders
from ltsh_addon.blender.render_settings import filter_points
from ltsh_addon.blender.viewport import shadows
from ltsh_addon.blender.viewport.drawing import read_texture
from ltsh_addon.blender.viewport.lighting import LightingPass
from ltsh_addon.blender.viewport.pictures import ShownPicture, is_equal
from ltsh_addon.blender.viewport.shadow_rays import ShadowRays, ViewTracer, too_many
from ltsh_addon.blender.viewport.shadows import LiveShadows
from ltsh_addon.scene import Cancelled, Pattern

ROOT = Path(__file__).resolve().parents[3]
SIZE = (72, 48)


def set_up_scene():
    """A textured, dusty floor, a smooth metal sphere and a glowing sign, lit from two sides; through a shifted, turned
    camera with pixels that are no squares. The camera."""
    scene = parts.empty_scene(*SIZE)
    floor, node, _ = textured("floor", "Base Color")
    node.inputs["Diffuse Roughness"].default_value = 0.8
    parts.add_plane(floor, size=6.0)
    metal = parts.bsdf_material("ShaderNodeBsdfAnisotropic", "metal", Color=(0.9, 0.7, 0.4, 1.0), Roughness=0.3)[0]
    parts.add_sphere(metal, radius=0.8, location=(-0.4, 0.2, 0.8))
    black = {"Base Color": (0.0, 0.0, 0.0, 1.0), "Specular IOR Level": 0.0}
    glow = {"Emission Color": (0.1, 0.2, 0.4, 1.0), "Emission Strength": 0.5}
    glowing = parts.principled("glowing", **black, **glow)[0]
    parts.add_plane(glowing, name="Sign", size=0.7, location=(1.2, 0.6, 0.6), rotation=(1.2, 0.0, -0.4))
    parts.add_area_light(location=(1.5, -1.0, 2.5), rotation=(0.4, 0.5, 0.0), size=1.0, size_y=0.5)
    parts.add_area_light("Left", location=(-3.0, 0.0, 1.0), rotation=(0.0, -1.3, 0.0), shape="DISK", size=1.5)
    camera = parts.add_camera((0.3, -4.0, 2.6), (1.02, 0.1, 0.05))
    camera.data.shift_x = 0.05
    scene.render.pixel_aspect_y = 1.2
    scene.view_settings.view_transform = "Standard"
    scene.cycles.film_exposure = 1.5
    bpy.context.view_layer.update()
    return camera


def made(capsys, command, path, folder, *words):
    """Report and layers of the picture that a command makes in a folder, without a word on stderr."""
    code, stdout, stderr = run(capsys, command, path, "-o", folder, *words, "--json", "--quiet")
    assert (code, stderr) == (0, "")
    return json.loads(stdout), imaging.read_layers(folder / f"{command}.exr")


def relative(picture, expected):
    return np.linalg.norm(picture - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize(("count", "most"), [(1, 0.01), pytest.param(16, 0.02, marks=pytest.mark.newest)])
def test_a_view_is_the_picture_of_shade(capsys, tmp_path, count, most):
    with_graphics(lambda: None)
    set_up_scene()
    path = parts.save(tmp_path / "room.blend")
    both = ("--shadows", "off", "--techniques", "ltsh4,ltc")
    report, found = made(capsys, "view", path, tmp_path / "view", "--refine", count, *both)
    assert report["resolution"] == list(SIZE) and report["sub_samples"] == count
    _, expected = made(capsys, "shade", path, tmp_path / "shade", "--aa", count, *both)
    for technique in ("ltsh4", "ltc"):
        for name in ("specular", "diffuse"):
            layer = f"{technique}.{name}"
            assert relative(found[layer], expected[layer]) < most, layer
    # All that shines by itself is in the combined picture alone.
    emitted = found["ltsh4.combined"] - found["ltsh4.specular"] - found["ltsh4.diffuse"]
    whole = np.abs(emitted - 1.5 * 0.5 * np.array([0.1, 0.2, 0.4])).max(axis=-1) < 1e-5
    assert 40 < whole.sum() < 400 and (np.abs(emitted[~whole]).max(axis=-1) < 1e-5).mean() > 0.85
    coverage = np.abs(found["coverage.hit"] - expected["coverage.hit"])
    assert coverage.max() <= 2.0 / count and coverage.mean() < 0.01
    # The PNG is the same picture as screens show it, within steps of 256 values.
    shown = bpy.data.images.load(str(tmp_path / "view" / "view.png"))
    pixels = np.array(shown.pixels[:]).reshape(SIZE[1], SIZE[0], 4)[::-1, :, :3]
    linear = np.clip(found["ltsh4.combined"], 0.0, 1.0)
    screen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    assert np.abs(pixels - screen).max() <= 1.01 / 255.0
    bpy.data.images.remove(shown)


@pytest.mark.newest
def test_shadows_of_a_view_are_those_of_shade(capsys, tmp_path):
    with_graphics(lambda: None)
    set_up_scene()
    path = parts.save(tmp_path / "room.blend")
    (of_view, view), (of_shade, shade) = (
        made(capsys, command, path, tmp_path / command, option, 4, "--techniques", "ltsh4")
        for command, option in (("view", "--refine"), ("shade", "--aa"))
    )
    shadows = of_view["shadows"], of_shade["shadows"]
    assert all(one["rays"] > 0 for one in shadows)
    for name in ("specular", "diffuse"):
        layer = f"ltsh4.{name}"
        both = np.hypot(*(one["noise"][name] for one in shadows))
        # The unshadowed pictures of so few points are up to 2 % apart at edges.
        assert relative(view[layer], shade[layer]) < 0.02 + 2.0 * both, name
    # There is something to see.
    assert relative(shade["ltsh4_unshadowed.diffuse"], shade["ltsh4.diffuse"]) > 0.1


@pytest.mark.newest
def test_a_lamp_of_very_many_faces_hides_itself_as_in_pictures(capsys, tmp_path):
    """Half of the faces of an open mesh shine inside. Rays to the polygons that stand for them would get there: the
    floor was 1.3 times too bright."""
    with_graphics(lambda: None)
    parts.empty_scene(*SIZE)
    black = {"Base Color": (0.0, 0.0, 0.0, 1.0), "Specular IOR Level": 0.0}
    glowing = parts.principled("glowing", **black, **{"Emission Color": (1.0, 1.0, 1.0, 1.0), "Emission Strength": 5.0})
    bpy.ops.mesh.primitive_monkey_add(location=(0.0, 0.0, 1.3))
    bpy.context.object.data.materials.append(glowing[0])
    parts.add_plane(parts.principled("floor")[0], size=6.0)
    parts.add_camera((0.3, -4.0, 2.6), (1.02, 0.1, 0.05))
    path = parts.save(tmp_path / "lamp.blend")
    (_, view), (_, shade) = (made(capsys, command, path, tmp_path / command) for command in ("view", "shade"))
    # Of one point, with the noise of both pictures' shadows.
    assert relative(view["ltsh4c.diffuse"], shade["ltsh4c.diffuse"]) < 0.2
    assert view["ltsh4c.diffuse"].sum() / shade["ltsh4c.diffuse"].sum() == pytest.approx(1.0, abs=0.05)


def test_a_view_shows_lamps_of_files_as_pictures_do(capsys, tmp_path):
    """Measured beams (IES) of a point and of a spot light."""
    with_graphics(lambda: None)
    parts.empty_scene(*SIZE)
    parts.add_plane(parts.principled("Floor", Roughness=0.3)[0], size=6.0)
    for kind, x in (("POINT", -1.2), ("SPOT", 1.2)):
        light = parts.new_light(kind, kind, energy=80.0, shadow_soft_size=0.1)
        parts.link(light, (x, 0.0, 1.6), (0.3, 0.2, 0.0))
        tree, emission = light_tree(light)
        node = tree.nodes.new("ShaderNodeTexIES")
        node.mode, node.ies = "INTERNAL", bpy.data.texts.new(kind)
        rows = ["IESNA:LM-63-1995", "TILT=NONE", "1 -1 1 7 1 1 2 0 0 0", "1 1 100", "0 15 30 45 60 90 180", "0"]
        node.ies.write("\n".join([*rows, "900 300 800 200 500 100 0"]))
        tree.links.new(node.outputs[0], emission.inputs["Strength"])
    parts.add_camera((0.0, -4.0, 3.4), (0.85, 0.0, 0.0))
    path = parts.save(tmp_path / "lamps.blend")
    both = ("--shadows", "off", "--techniques", "ltsh4")
    _, found = made(capsys, "view", path, tmp_path / "view", "--refine", "1", *both)
    _, expected = made(capsys, "shade", path, tmp_path / "shade", *both)
    for name in ("specular", "diffuse"):
        layer = f"ltsh4.{name}"
        assert expected[layer].max() > 0.0
        assert relative(found[layer], expected[layer]) < 0.02, layer


def test_of_very_many_lights_shadows_are_left_out_and_named():
    assert too_many(64, (1920, 1080)) == ""
    assert "2000 lights" in too_many(2000, (1920, 1080)) and "15.4 GiB" in too_many(2000, (1920, 1080))


def test_shadows_that_are_stopped_leave_nothing_of_their_picture():
    """At once, not when Python looks for circles the next time: samples of a window take hundreds of MiB."""

    class Picture:
        def visibility(self, progress):
            raise Cancelled("stopped")

    gc.collect()
    gc.disable()
    try:
        live, picture = LiveShadows(), Picture()
        live._trace([picture])
        left = [weakref.ref(live), weakref.ref(picture)]
        live.stop()
        del live, picture
        assert [one() for one in left] == [None] * 2
    finally:
        gc.enable()


def test_what_only_views_or_only_renders_show_is_named(tmp_path, capsys):
    with_graphics(lambda: None)
    set_up_scene()
    scene, hidden = bpy.context.scene, bpy.data.collections.new("Hidden in renders")
    scene.collection.children.link(hidden)
    hidden.hide_render = True
    inside, eye, camera, grid, empty = (parts.add_plane(name=name, size=0.1, location=(0, 0, -9)) for name in (
        "In it", "Eye", "Camera icon", "Grid", "Of both"))  # fmt: skip
    hidden.objects.link(inside)
    scene.collection.objects.unlink(inside)
    eye.hide_set(True)
    camera.hide_render = True
    grid.instance_type, grid.show_instancer_for_render = "VERTS", False
    empty.hide_viewport = empty.hide_render = True
    lamp = parts.add_area_light("Lamp", energy=1.0)
    lamp.hide_viewport = True
    parts.link(bpy.data.objects.new("Null", None)).hide_render = True
    path = parts.save(tmp_path / "room.blend")
    code, stdout, _ = run(
        capsys, "view", path, "-o", tmp_path / "out", "--refine", 1, "--resolution", "16x12", "--json", "--quiet"
    )
    warnings = json.loads(stdout)["warnings"]
    assert code == 0
    assert "only views show Camera icon, Grid, In it" in warnings and "only renders show Eye, Lamp" in warnings


def test_what_a_view_leaves_out_is_named(capsys, tmp_path):
    with_graphics(lambda: None)
    camera = set_up_scene()
    camera.data.dof.use_dof = True
    same, other = (parts.add_plane(parts.principled(name)[0], name=name).modifiers.new("", "SUBSURF")
                   for name in ("Same", "Other"))  # fmt: skip
    same.levels, same.render_levels, other.levels, other.render_levels = 1, 1, 1, 2
    path = parts.save(tmp_path / "room.blend")
    code, stdout, _ = run(
        capsys, "view", path, "-o", tmp_path / "out", "--refine", 1, "--frames", "3,5", "--resolution", "16x12",
        "--json", "--quiet",
    )  # fmt: skip
    document = json.loads(stdout)
    assert code == 0
    assert [(one["name"], one["frame"]) for one in document["reports"]] == [("view_0003", 3), ("view_0005", 5)]
    warnings = "\n".join(document["reports"][0]["warnings"])
    assert "depth of field" in warnings and "levels of subdivision of Other\n" in f"{warnings}\n"
    assert {path.name for path in (tmp_path / "out").glob("view_*")} == {
        f"view_000{frame}.{suffix}" for frame in (3, 5) for suffix in ("exr", "png")
    }


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere graphics cannot be taken away")
def test_a_machine_without_graphics_is_told_in_one_line(tmp_path, own_blender):
    path = parts.metal_room(tmp_path / "room.blend")
    command = programs.command_line("view", path, "-o", tmp_path / "out", "--quiet")
    without = {**os.environ, "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path), "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    done = subprocess.run(command, cwd=ROOT, env=without, capture_output=True, text=True, timeout=120, check=False)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1 and "no graphics card" in line and "shade" in line
    assert not (tmp_path / "out").exists()


def drawn_by_samples():
    """Means of 1, 2, ... points of a view at rest, the same points drawn alone, and what follows a change."""
    camera = set_up_scene()
    for mesh in bpy.data.meshes:  # horizons of smooth ones change from point to point
        mesh.shade_flat()
    bpy.context.view_layer.update()
    points, shown = filter_points("BLACKMAN_HARRIS", 1.5, 3), ShownPicture("ltsh4", "combined")
    with OpenView(camera, SIZE) as still, OpenView(camera, SIZE) as moved:
        refined, alone, counts = [], [], []
        for _ in range(len(points) + 1):
            refined.append(still.draw(shown, points))
            counts.append(still.renderer.samples)
        for point in points:
            moved.view = still.view.shifted(point, SIZE)
            alone.append(moved.draw(shown))
        for one in (still, moved):
            one.mirror.lights = tuple(one.mirror.lights[:1])
        changed, moved.view = (still.draw(shown, points), still.renderer.samples), still.view
        return refined, counts, alone, changed, moved.draw(shown)


@edits_with_graphics
def test_a_view_at_rest_is_the_mean_of_its_points_and_starts_again_after_a_change():
    refined, counts, alone, (changed, samples), expected = with_graphics(drawn_by_samples)
    assert counts == [1, 2, 3, 3] and samples == 1
    for number, picture in enumerate(refined):
        np.testing.assert_allclose(picture, np.mean(alone[: number + 1], axis=0), rtol=1e-5, atol=1e-6)
    assert not np.array_equal(alone[0], alone[1])
    np.testing.assert_array_equal(changed, expected)


class LiveView(OpenView):
    """A view with live shadows, its scene, and what it draws of a pass."""

    def __init__(self, passes="diffuse", add=lambda: None):
        camera, self.passes, self.live = set_up_scene(), passes, LiveShadows()
        add()
        bpy.context.view_layer.update()
        super().__init__(camera, SIZE)

    def drawn(self, shadows, *points):
        """The picture (H, W, 3)."""
        self.live.follow((0,), self.occluders)
        self.renderer.shadows = shadows
        return self.light("ltsh4", self.passes, *points)

    def __exit__(self, *error):
        self.live.stop()
        super().__exit__(*error)

    def occluders(self):
        return collect_occluders(bpy.context.evaluated_depsgraph_get(), None, lambda text: None)

    def traced(self):
        """The picture after the thread has ended, and numbers of the lights and level of what it has done."""
        request = self.live._request
        self.live._thread.join()
        return self.drawn(self.live), request.numbers, request.level


def stopped_shares(scene):
    """Of which lights there are shares where finer ones of four lights are stopped: at once, and later."""
    places, known = [], scene.live._known
    scene.live._known = {}
    request = scene.live._request_of(1, scene.renderer._surfaces._gbuffer, scene.view)
    scene.live._known = known
    for most in (0, 2):
        left = list(range(most))

        def go_on(*_, left=left):
            return bool(left) and left.pop() >= 0

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(shadows, "BATCH", 1)
            try:
                places.append(set(request.visibility(go_on)))
            except Cancelled:
                places.append(None)
    return places


def live_pictures():
    with LiveView() as scene:
        plain, exact = scene.drawn(None), scene.drawn(ShadowRays(ViewTracer(scene.occluders()), 256))
        first = scene.drawn(scene.live)
        levels = [scene.traced() for _ in range(2)]
        rest = scene.live.is_busy
        lights = scene.mirror.lights
        scene.mirror.lights = tuple(replace(light, radiance=2.0 * light.radiance) for light in lights)
        recolored = scene.drawn(scene.live), scene.live.is_busy
        moved = replace(lights[0], center=lights[0].center + [0.0, 0.2, 0.1])
        scene.mirror.lights = (moved, *lights[1:])
        scene.drawn(scene.live)
        scene.live._thread.join()
        after_move = [(request.numbers, request.level) for request, _ in scene.live._outcomes]
        after_move = after_move, scene.drawn(scene.live), scene.drawn(ShadowRays(ViewTracer(scene.occluders()), 256))
        partial = stopped_shares(scene)
        scene.drawn(scene.live)
        scene.live.follow((1,), lambda: 1 / 0)
        scene.live._traced_scene.before = (1,)
        scene.live.take_news()
        scene.live.visibility(scene.renderer._surfaces._gbuffer, scene.view, scene.renderer._lights.lights, 0)
        return plain, exact, first, levels, rest, recolored, after_move, partial, scene.live.problem


@edits_with_graphics
def test_live_shadows_come_coarse_and_end_as_those_of_pictures():
    plain, exact, first, levels, rest, (recolored, traces), moved, partial, problem = with_graphics(live_pictures)
    np.testing.assert_allclose(first, plain, rtol=1e-5, atol=1e-6)
    without = relative(plain, exact)
    coarse, fine = (relative(picture, exact) for picture, _, _ in levels)
    # Two lights, and the two sides of the sign.
    assert [(numbers, level) for _, numbers, level in levels] == [((0, 1, 2, 3), level) for level in range(2)]
    assert without > 0.1 and coarse < 0.7 * without and fine < 0.05 and fine < coarse
    assert not rest and not traces, "at rest, and for other colors, nothing is traced"
    np.testing.assert_allclose(recolored, 2.0 * levels[-1][0], rtol=1e-3, atol=1e-5)
    # Of the other lights all is known; and the points need not be read again for the finer ones.
    after_move, picture, expected = moved
    assert after_move == [((0,), 0), ((0,), 1)] and relative(picture, expected) < 0.05
    assert partial == [None, {0, 1}]
    assert problem == "shadows: division by zero"


def kept_pictures(has_shadows):
    """After each change of light 0: the numbers of the lights that were drawn, the picture, and that of the next call,
    which draws them all."""
    scene, numbers, found = LiveView(), [], []
    draw = LightingPass.draw

    def listening(*arguments, **keywords):
        numbers.append(keywords["numbers"])
        draw(*arguments, **keywords)

    def moved(light, step):
        return replace(light, center=light.center + [0.0, 0.05 * step, 0.0])

    def after(edit):
        first, *others = scene.mirror.lights
        # Objects of the other lights are new, as after every update of a scene.
        scene.mirror.lights = (edit(first), *map(replace, others))
        numbers.clear()
        picture = scene.drawn(live)
        if live is not None and live._thread is not None:  # the shadows of the light that was moved
            live._thread.join()
            numbers.clear()
            picture = scene.drawn(live)
        return list(numbers), picture, scene.drawn(live), numbers[-1]

    live = scene.live if has_shadows else None
    edits = [lambda light, step=step: moved(light, step) for step in range(1, 4)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LightingPass, "draw", listening)
        # Coarse shadows alone: when finer ones come depends on the time.
        patch.setattr(LiveShadows, "_may_begin", lambda self, level, number: level == 0 and self._is_free)
        with scene:
            scene.drawn(live)
            if live is not None:
                live._thread.join()
                scene.drawn(live)
            for edit in (*edits, lambda light: replace(light, radiance=0.5 * light.radiance), *edits[:1]):
                found.append(after(edit))
            return found


@edits_with_graphics
@pytest.mark.parametrize("has_shadows", [False, True])
def test_while_one_light_changes_the_others_are_not_drawn_again(has_shadows):
    found = with_graphics(lambda: kept_pictures(has_shadows))
    asked = [set(numbers) for numbers, _, _, _ in found]
    # The first move is drawn in two parts, with the world (4) among what stays; with shadows, what is drawn when these
    # come is the moved light alone.
    assert asked[0] == ({frozenset({0})} if has_shadows else {frozenset({1, 2, 3, 4}), frozenset({0})})
    assert asked[1:] == [{frozenset({0})}] * 4
    for _, kept, whole, last in found:
        assert last is None, "at rest all lights are drawn"
        np.testing.assert_allclose(kept, whole, rtol=1e-4, atol=1e-6)
    steps = [relative(first[2], second[2]) for first, second in zip(found, found[1:], strict=False)]
    assert min(steps) > 1e-3, "each change is seen"


@pytest.mark.parametrize("kind", ["plain", "disk", "polygon", "ball", "spot", "spot disk", "bulb", "sun"])
def test_lights_that_are_read_again_are_equal_until_they_change(kind):
    def read():
        light = random_surfaces.light(kind, 0, np.random.default_rng(1))
        return replace(light, pattern=Pattern(np.eye(3), np.ones((2, 3)))) if light.is_facing else light

    light = read()
    assert is_equal(light, read())
    changes = [{"center": light.center + 1e-3}, {"radiance": 2.0 * light.radiance}, {"name": "Other"}]
    if light.cone is not None:
        changes.append({"cone": replace(light.cone, cosine=0.5 * light.cone.cosine)})
    if light.pattern is not None:
        changes.append({"pattern": Pattern(np.eye(3), np.full((2, 3), 0.5))})
    assert not any(is_equal(light, replace(read(), **change)) for change in changes)


def late_pictures():
    """Shaders of the lighting for the first picture of live shadows and for all; the level of shadows of a view whose
    thread ends late; and what of its renderer is left when nobody has it any more."""
    scene, points, may_end = LiveView(), filter_points("BLACKMAN_HARRIS", 1.5, 3), threading.Event()
    trace = LiveShadows._trace

    def trace_and_linger(live, requests):
        trace(live, requests)
        may_end.wait(60.0)

    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(LiveShadows, "_trace", trace_and_linger)
            scene.drawn(scene.live, points)
            shaders = [set(scene.renderer._lighting["ltsh4"]._shaders)]
            while not scene.live._outcomes:
                time.sleep(0.01)
            # These are seen, but finer ones cannot begin yet.
            scene.drawn(scene.live, points)
            may_end.set()
        for _ in range(30):
            scene.drawn(scene.live, points)
            if scene.live._thread is not None:
                scene.live._thread.join()
        shaders.append(set(scene.renderer._lighting["ltsh4"]._shaders))
        level = max(scene.live._known[scene.live._keys[0]]), scene.renderer.samples
    finally:
        may_end.set()
        scene.live.stop()
    gc.collect()
    gc.disable()
    try:
        renderer = scene.renderer
        parts_of_it = renderer, renderer._surfaces._surfaces, renderer._lighting["ltsh4"], scene.live
        left = [weakref.ref(part) for part in parts_of_it]
        scene.renderer = scene.live = None
        del renderer, parts_of_it
        return shaders, level, [one() for one in left]
    finally:
        gc.enable()


@edits_with_graphics
def test_shadows_wait_for_no_shader_and_no_thread_and_a_view_that_is_left_is_freed_at_once():
    shaders, level, left = with_graphics(late_pictures)
    assert shaders[0] == shaders[1] != set()
    assert level == (1, 3), "a thread that ends late does not keep the coarse shadows"
    assert left == [None] * 4


def glass_pictures():
    """Specular pictures of a pane of glass before the sphere, which hides a light: without shadows, exact, by live
    shadows at rest, and after a light has moved with exact ones; and where the pane is."""

    def add_pane():
        glass = parts.bsdf_material("ShaderNodeBsdfGlass", "glass", Roughness=0.4)[0]
        parts.add_plane(glass, name="Pane", size=2.6, location=(0.0, -0.6, 0.02))
        # Its reflection would be where that of the sphere is.
        parts.add_area_light("Back", location=(-0.4, 3.0, 2.6), rotation=(-1.0, 0.0, 0.0), energy=100.0)

    scene = LiveView("specular", add_pane)

    def at_rest():
        for _ in range(20):
            picture = scene.drawn(scene.live)
            threads = [one._thread for one in scene.live._both if one._thread is not None]
            if not threads:
                return picture
            assert len(threads) == 1, "one traces at a time"
            threads[0].join()
        raise AssertionError("shadows never end")

    with scene:
        plain, exact = scene.drawn(None), scene.drawn(ShadowRays(ViewTracer(scene.occluders()), 256))
        pane = read_texture(scene.renderer._glass._gbuffer.position)[..., 3] > 0.0
        live, lights = at_rest(), scene.mirror.lights
        scene.mirror.lights = (replace(lights[0], center=lights[0].center + [0.0, 0.2, 0.1]), *lights[1:])
        moved = at_rest(), scene.drawn(ShadowRays(ViewTracer(scene.occluders()), 256))
        return plain, exact, live, moved, pane


@edits_with_graphics
def test_the_reflection_of_glass_has_live_shadows():
    plain, exact, live, (moved, expected), pane = with_graphics(glass_pictures)
    assert 200 < pane.sum() < pane.size / 2
    assert relative(plain[pane], exact[pane]) > 0.3
    # The rays differ: 32 for a pixel, or 256.
    assert relative(live[pane], exact[pane]) < 0.05 and relative(moved[pane], expected[pane]) < 0.05
    assert relative(exact[pane], expected[pane]) > 0.05, "the first shadows would not do after the move"


def refined_pictures():
    """A view at rest with live shadows: its picture, how many points it has, how often it waited, its versions and
    points over time, and what many rays at every point give."""
    points = filter_points("BLACKMAN_HARRIS", 1.5, 20)
    with LiveView() as scene:
        waited, versions = 0, []
        for _ in range(80):
            live = scene.drawn(scene.live, points)
            versions.append((scene.live.version, scene.renderer.samples))
            if scene.live._thread is not None:
                waited += scene.live.waits and scene.live._request.level == 2
                scene.live._thread.join()
            elif scene.renderer.samples == len(points):
                break
        samples, rays = scene.renderer.samples, ShadowRays(ViewTracer(scene.occluders()), 256)
        for _ in points:
            exact = scene.drawn(rays, points)
        return live, samples, waited, versions, exact


@edits_with_graphics
def test_shadows_of_a_view_at_rest_get_new_rays_as_its_points_do():
    live, samples, waited, versions, exact = with_graphics(refined_pictures)
    assert samples == 20
    # The first eight points have the shadows of the centers, the others those of their groups: each waits once.
    assert waited == 3
    # But for the two levels at the start, no picture has fewer points than the one before.
    counts = [count for version, count in versions if version == 2]
    assert versions[-1][0] == 2 and counts == sorted(counts)
    assert relative(live, exact) < 0.02


def test_what_helps_to_trace_ends_at_rest_but_not_at_work():
    live, closed, going = LiveShadows(), [], threading.Event()
    live._traced_scene.tracing = SimpleNamespace(close=lambda: closed.append(True))
    live.of_glass._thread = threading.Thread(target=going.wait)
    live.of_glass._thread.start()
    try:
        live.rest()
        assert not closed
    finally:
        going.set()
        live.of_glass._thread.join()
    live.rest()
    assert closed


def test_what_a_view_leaves_out_is_named_and_hides_nothing(capsys, tmp_path):
    """Hair, fur and a shadow catcher; and what only contributes indirectly, which nobody sees."""
    with_graphics(lambda: None)
    set_up_scene()
    wall = parts.add_plane(None, 4.0, "Wall", location=(0.0, -1.0, 1.0), rotation=(1.4, 0.0, 0.0))
    wall.visible_shadow = wall.visible_diffuse = wall.visible_glossy = False
    bpy.context.scene.collection.children.link(into_collection("Indirect", wall))
    bpy.context.view_layer.layer_collection.children["Indirect"].indirect_only = True
    path = parts.save(tmp_path / "without.blend")
    parts.link(bpy.data.objects.new("Hair", parts.hair_curves(3)))
    bpy.data.objects["Sign"].modifiers.new("Fur", "PARTICLE_SYSTEM")
    bpy.data.objects["Sign"].particle_systems[0].settings.type = "HAIR"
    bpy.data.objects["Plane"].is_shadow_catcher = True
    more = parts.save(tmp_path / "more.blend")
    plain, (report, layers) = (
        made(capsys, "view", file, tmp_path / file.stem, "--refine", 1, "--shadows", "off") for file in (path, more)
    )
    assert plain[0]["warnings"] == []
    for part in ("Hair", "Sign", "Plane: shown as any surface"):
        assert any(part in line for line in report["warnings"]), (part, report["warnings"])
    np.testing.assert_array_equal(plain[1]["ltsh4c.combined"], layers["ltsh4c.combined"])
    _, shade = made(capsys, "shade", path, tmp_path / "shade", "--techniques", "ltsh4c")
    assert np.abs(layers["coverage.hit"] - shade["coverage.hit"]).mean() < 0.01


def test_a_view_after_a_render_with_grease_pencil(capsys, tmp_path):
    """It takes the graphics away from Blender's scripts; both are done by one Blender here."""
    with_graphics(lambda: None)
    set_up_scene()
    kinds = bpy.data.grease_pencils_v3 if hasattr(bpy.data, "grease_pencils_v3") else bpy.data.grease_pencils
    parts.link(bpy.data.objects.new("Strokes", kinds.new("Strokes")))
    path, found = parts.save(tmp_path / "room.blend"), []
    for _ in range(2):
        report, layers = made(capsys, "view", path, tmp_path / "view", "--refine", 1, "--shadows", "off")
        assert any(line.startswith("Strokes: grease pencil is not in") for line in report["warnings"])
        found.append(layers["ltsh4c.combined"])
        made(capsys, "render", path, tmp_path / "render", "--resolution", "8x8", "--cycles-samples", 2)
    np.testing.assert_array_equal(*found)
