"""The page of `python -m tables page` in a browser, beside numpy: what it draws, what one can do with it.

Its shaders are the exported headers. Of their pixels, numpy's are the truth: `shading.shade` with the shipped tables,
and the true BRDF by `shading.reference`.
"""

import browser
import numpy as np
import pytest

from ltsh_addon.imaging import color
from ltsh_addon.scene import QuadLight, SurfaceSamples
from ltsh_addon.shading import shade
from tables import __main__, bench

TABLES = ("ltc", "ltsh2", "ltsh4", "ltsh4c")
WIDTH, HEIGHT = 80, 45


CENTER_OF_LIGHT = """(() => {
    const box = document.getElementById("handle").getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})()"""


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("page")
    assert __main__.main(["page", "-o", str(path), "--width", str(WIDTH)]) == 0
    return path


@pytest.fixture(scope="module")
def page(chromium, folder):
    page = chromium.page(folder / "index.html", 1280, 900)
    # Nothing goes on by itself, so that tests of single pixels are alone.
    page.wait_for("window.bench && bench.compiled && [...bench.names, 'reference'].every(name => bench.canDraw(name))")
    yield page
    problems = [text for text in page.complaints() if "GPU stall due to ReadPixels" not in text]
    page.close()
    assert problems == []


def pixels_of(page, expression) -> np.ndarray:
    """Pixels (P, 4) of a target that an expression gives."""
    return page.array(f"bench.renderer.read({expression})", np.float32).reshape(-1, 4)


def drawn(page, name, number) -> np.ndarray:
    target = f"bench.renderer.target('test', {WIDTH}, {HEIGHT})"
    page.evaluate(f"bench.renderer.drawTechnique('{name}', bench.content.scenes[{number}], {target}), 0")
    return pixels_of(page, target)


def drawn_by_webgpu(page, name, number) -> np.ndarray:
    size = f"{WIDTH}, {HEIGHT}"
    return page.array(
        f"""(async () => {{
            const webGpu = await WebGpu.make(bench.renderer);
            return (await webGpu.draw('{name}', bench.content.scenes[{number}], {size})).pixels;
        }})()""",
        np.float32,
    ).reshape(-1, 4)


def off_edges(scene) -> np.ndarray:
    """The pixels (P,) whose ray meets the same object in single precision: rays beside it by 1e-5 do."""
    eye, rays = bench.rays_of(scene, WIDTH)
    rng = np.random.default_rng(7)
    objects = [bench.surfaces(eye, rays + offset)[0] for offset in rng.normal(0.0, 1e-5, (6, 3))]
    normals = [bench.surfaces(eye, rays + offset)[2] for offset in rng.normal(0.0, 1e-5, (6, 3))]
    spread = np.ptp(normals, axis=0).max(axis=1)
    return (np.ptp(objects, axis=0) == 0) & (spread < 0.1)


def shown(radiance, scene) -> np.ndarray:
    return 255.0 * color.srgb_encode(np.clip(radiance * 2.0**scene.exposure, 0.0, 1.0))


def largest_difference(page, name, number, draw=drawn) -> float:
    """Between pixels of the page and of numpy, in steps of 8 bits as shown."""
    scene = bench.SCENES[number]
    expected = bench.picture(scene, WIDTH, name).reshape(-1, 3)
    found, inside = draw(page, name, number), off_edges(scene)
    surface = np.isfinite(expected[:, 0])
    assert ((found[:, 3] > 0) == surface)[inside].all()
    inside &= surface
    assert inside.mean() > 0.5
    return np.abs(shown(found[inside, :3], scene) - shown(expected[inside], scene)).max()


def test_every_technique_shades_a_scene_as_numpy_does(page):
    assert max(largest_difference(page, name, 0) for name in TABLES) < 1.0


@pytest.mark.soak
@pytest.mark.parametrize("name", TABLES)
def test_every_technique_shades_all_frozen_scenes_as_numpy_does(page, name):
    differences = {scene.name: largest_difference(page, name, n) for n, scene in enumerate(bench.SCENES)}
    assert max(differences.values()) < 1.0, differences


@pytest.mark.parametrize("number", [0, *(pytest.param(n, marks=pytest.mark.soak) for n in range(1, 10))])
def test_webgpu_shades_as_numpy_does(page, number):
    assert max(largest_difference(page, name, number, drawn_by_webgpu) for name in TABLES) < 1.0


def test_without_webgpu_the_page_is_the_same(chromium, folder):
    page = chromium.page(folder / "index.html", 600, 900)
    page.evaluate("navigator.gpu.requestAdapter = async () => null")
    page.wait_for("window.bench?.webGpu && document.querySelector('#table td').textContent", 60)
    assert page.evaluate("[bench.webGpu.size, document.querySelectorAll('#table th').length]") == [0, 7]
    assert "WebGPU" not in page.evaluate("document.body.innerText")
    page.close()


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.soak), 9])
def test_the_points_of_the_reference_tend_to_the_quadrature_of_numpy(page, number):
    """Sharp, broad and anisotropic lobes. The page says how large its noise is: at most, as its points lie more evenly
    than random ones."""
    scene = bench.SCENES[number]
    page.evaluate(f"""(() => {{
        for (let first = 0; first < 512; first += 32) {{
            window.sums = bench.renderer.drawReference(bench.content.scenes[{number}], first, 32, {WIDTH}, {HEIGHT});
        }}
    }})()""")
    found, inside = pixels_of(page, "sums"), off_edges(scene)
    expected = bench.picture(scene, WIDTH).reshape(-1, 3)
    inside &= np.isfinite(expected[:, 0])
    error = np.sqrt(np.square(found[inside, :3] - expected[inside]).sum() / np.square(expected[inside]).sum())
    noise = page.evaluate("(() => { const all = bench.renderer.read(sums); return difference(all, all, 16).noise; })()")
    assert error < 1.5 * noise < 0.03
    off = np.abs(shown(found[inside, :3], scene) - shown(expected[inside], scene))
    assert off.mean() < 0.5 and np.quantile(off, 0.99) < 4.0


def test_the_frozen_pictures_are_those_of_numpy(page):
    scene = bench.SCENES[3]
    stored = page.array("bench.content.scenes[3].picture", np.float32).reshape(-1, 4)[:, :3]
    expected = np.nan_to_num(bench.picture(scene, WIDTH).reshape(-1, 3))
    # Half floats: 11 bits, and steps of 6e-8.
    assert stored == pytest.approx(expected, rel=2.0**-11, abs=1e-7)


def test_the_page_draws_what_one_does_with_it_and_needs_no_network(page):
    page.evaluate("bench.choose(0)")
    page.wait_for("[...bench.results.values()].filter(result => result.difference).length === 5", 60)
    errors = {name: page.evaluate(f"bench.results.get('{name}').difference.error") for name in TABLES}
    assert errors["ltsh4c"] < errors["ltsh4"] < errors["ltsh2"] < errors["ltc"] < 0.2
    (x, y), before = page.evaluate(CENTER_OF_LIGHT), page.evaluate("bench.state.x")
    page.mouse("pressed", x, y)
    page.mouse("moved", x + 60, y)
    page.mouse("released", x + 60, y)
    assert page.evaluate("bench.scene") == -1 and page.evaluate("bench.state.x") > before + 0.1
    page.wait_for("bench.points >= 16 && bench.results.get('ltsh4')?.difference", 60)
    x = page.evaluate("bench.state.x")
    page.evaluate("document.getElementById('picture').focus()")
    page.key("ArrowRight")
    page.key("2")
    page.key("e")
    assert page.evaluate("[bench.technique, bench.showsError]") == ["ltsh2", True]
    assert page.evaluate("bench.state.x") > x
    assert len(page.requests()) == 1, page.requests()


def test_all_errors_are_shown_before_the_stage_is_drawn_finely(page):
    """What one waits for after a drag comes first, in a frame before; the fine stage has all of its rows."""
    events = page.evaluate("""(async () => {
        let frame = 0, events = [];
        const count = () => { ++frame; counting = requestAnimationFrame(count); };
        let counting = requestAnimationFrame(count);
        const own = ["compare", "drawBand"];
        for (const name of own) {
            bench[name] = (...given) => (events.push([name, frame]), Bench.prototype[name].apply(bench, given));
        }
        bench.show("ltsh4", false);
        bench.change({ x: bench.state.x - 0.1 });
        while (bench.stageShows !== "fine") {
            await new Promise(requestAnimationFrame);
        }
        own.forEach(name => delete bench[name]);
        cancelAnimationFrame(counting);
        return events;
    })()""")
    frames = {name: [frame for kind, frame in events if kind == name] for name in ("compare", "drawBand")}
    assert len(frames["compare"]) >= 5 and max(frames["compare"][:5]) < min(frames["drawBand"])
    in_bands, whole = (
        page.array(
            f"""(() => {{
                const target = bench.renderer.target("band", 60, 40);
                {draw}
                return bench.renderer.read(target);
            }})()""",
            np.float32,
        )
        for draw in (
            "bench.renderer.drawTechnique(bench.technique, bench.content.scenes[2], target);"
            "bench.state = {...bench.content.scenes[3]}; while (!bench.drawBand(target, 0.15));",
            "bench.renderer.drawTechnique(bench.technique, bench.content.scenes[3], target);",
        )
    )
    assert (in_bands == whole).all()


def test_a_shader_of_ones_own_is_drawn_and_its_errors_name_the_line(page):
    page.evaluate("""(() => {
        const source = document.getElementById("source");
        source.value = "// one\\nvec3 shade(Surface s, Light light)\\n{\\n    return vec3(0.5) * nothing;\\n}";
        source.dispatchEvent(new Event("input"));
    })()""")
    page.wait_for("bench.ownError", 30)
    assert "line 4: 'nothing'" in page.evaluate("document.getElementById('own-errors').textContent")
    page.evaluate("""(() => {
        const source = document.getElementById("source");
        source.value = source.value.replace("nothing", "s.normal.z");
        source.dispatchEvent(new Event("input"));
    })()""")
    page.wait_for("bench.ownError === null && bench.ownChanged === null && bench.canDraw('own')", 30)
    found = drawn(page, "own", 3)
    eye, rays = bench.rays_of(bench.SCENES[3], WIDTH)
    objects, position, normal, _ = bench.surfaces(eye, rays)
    light = bench.SCENES[3].light
    before = (light.center - position) @ light.direction < -1e-3
    chosen = off_edges(bench.SCENES[3]) & (objects >= 0) & before
    assert found[chosen, 0] == pytest.approx(0.5 * bench.RADIANCE * normal[chosen, 2], abs=1e-4)


def drag_vertically(page, x, y, way):
    page.touch("start", (x, y))
    for step in range(1, 9):
        page.touch("move", (x, y + way * step / 8))
    page.touch("end")


def test_the_page_fits_a_phone(chromium, folder):
    page = chromium.page(folder / "index.html", 390, 844, touch=True)
    page.wait_for("window.bench")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    small = page.evaluate("[...document.querySelectorAll('.choice button')].filter(b => b.clientHeight < 32).length")
    assert small == 0
    # A finger on the light drags it.
    drag_vertically(page, *page.evaluate(CENTER_OF_LIGHT), 24)
    assert page.evaluate("[scrollY, bench.scene]") == [0, -1] and page.evaluate("bench.state.z") < 1.1
    # A finger that scrolls the page changes nothing.
    page.evaluate("bench.choose(2)")
    x, y = page.evaluate(CENTER_OF_LIGHT)
    drag_vertically(page, 390 - x, y + 120, -80)
    page.wait_for("scrollY > 20 && !bench.isDragging", 10)
    assert page.evaluate("[bench.scene, bench.state.rise, bench.state.orbit]") == [2, 16, 0]
    page.close()


def test_three_js_shades_its_rect_area_lights_by_ltsh(chromium, folder):
    """A floor: radiance of `shade` on the same rays, as three.js shows it in 8 bits."""
    home = folder / "three"
    (home / "node_modules").symlink_to(browser.package("three").parent)
    with browser.served(home) as address:
        page = chromium.page(f"{address}/index.html#plain", 96, 64)
        page.wait_for("window.example", 60)
        numbers = page.evaluate("""(() => {
            const { THREE, camera, light, floor, renderer, draw } = example;
            for (const child of [...floor.parent.children]) {
                child.visible = child === floor || child === light;
            }
            draw();
            const gl = renderer.getContext(), pixels = new Uint8Array(96 * 64 * 4);
            gl.readPixels(0, 0, 96, 64, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
            window.pixels = pixels;
            light.updateMatrixWorld();
            const rays = camera.projectionMatrixInverse.toArray(), color = floor.material.color.toArray();
            return { rays, camera: camera.matrixWorld.toArray(), light: light.matrixWorld.toArray(), color };
        })()""")
        pixels = page.array("pixels", np.uint8).reshape(-1, 4)[:, :3].astype(float)
        problems = [text for text in page.complaints() if "GPU stall" not in text]
        page.close()
    assert problems == []
    inverse, world, placed = (np.reshape(numbers[key], (4, 4)).T for key in ("rays", "camera", "light"))
    x, y = (2.0 * (np.arange(count) + 0.5) / count - 1.0 for count in (96, 64))
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    far = np.stack([x, y, np.ones_like(x), np.ones_like(x)]).T @ inverse.T
    rays = (far[:, :3] / far[:, 3:]) @ world[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    eye = world[:3, 3]
    distance = -eye[1] / rays[:, 1]
    position = eye + distance[:, None] * rays
    inside = (distance > 0.0) & (np.abs(position[:, [0, 2]]).max(axis=1) < 5.9)
    position, view = position[inside], -rays[inside]
    normal, base = np.tile([0.0, 1.0, 0.0], (len(view), 1)), np.tile(numbers["color"], (len(view), 1))
    samples = SurfaceSamples(
        position, view, normal, normal, np.full(len(view), 0.35), 0.02 + 0.5 * base, np.ones_like(base),
        np.zeros(len(view)), np.full(len(view), 1.5), 0.5 * base,
    )  # fmt: skip
    u, v, direction = placed[:3, 0], 0.5 * placed[:3, 1], -placed[:3, 2]
    light = QuadLight("light", placed[:3, 3], u, v, direction, np.full(3, 5.0))
    expected = 255.0 * color.srgb_encode(np.clip(shade(samples, [light], "ltsh4").combined, 0.0, 1.0))
    off = np.abs(pixels[inside] - expected)
    # Rounding to 8 bits is .5. The largest, 4.3, are in a row beside the light's own plane.
    assert inside.mean() > 0.4 and np.quantile(off, 0.99) < 1.5 and off.max() < 6.0


def test_the_first_picture_gets_as_fine_as_the_stage(chromium, folder):
    page = chromium.page(folder / "index.html", 600, 900)
    page.wait_for("window.bench && bench.stageShows === 'fine'")
    # How fine depends on the machine; 40 times as long as usual would still give twice as many pixels.
    assert page.evaluate("document.getElementById('picture').width") >= 2 * WIDTH
    page.close()


@pytest.mark.soak
def test_the_whole_page_is_small(chromium, tmp_path):
    """At full size, on software drawing. How long it takes is printed, it decides nothing (see `-s`)."""
    files = bench.write_page(tmp_path)
    assert sum(path.stat().st_size for path in files) < 2e6
    page = chromium.page(tmp_path / "index.html", 1280, 900)
    page.wait_for("window.bench && bench.stageShows")
    print(f"first picture after {page.evaluate('bench.firstAt'):.0f} ms")
    page.wait_for("bench.names.every(name => bench.times.has(name))", 120)
    print("ms of a picture:", page.evaluate("Object.fromEntries(bench.times)"))
    page.mouse("pressed", 300, 300)
    for x in range(300, 360, 4):
        page.mouse("moved", x, 300)
        page.evaluate("new Promise(requestAnimationFrame)")
    frames = page.evaluate("bench.frames")
    page.mouse("released", 360, 300)
    start = page.evaluate("performance.now()")
    page.wait_for("bench.results.size === 5 && [...bench.results.values()].every(result => result.difference)", 60)
    print("ms between frames while dragging:", frames, "; all after", page.evaluate("performance.now()") - start, "ms")
    page.close()
