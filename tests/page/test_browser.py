"""The browser that other tests use: what it draws comes back as it is, what goes wrong in a page is an error."""

import browser
import numpy as np
import pytest

PAGE = """<!DOCTYPE html><meta charset="utf-8"><style>html, body { margin: 0; background: rgb(30, 60, 90) }</style>
<canvas id="canvas" width="40" height="30"></canvas>
<script>
window.events = [];
for (const kind of ["pointerdown", "pointermove", "pointerup", "keydown", "touchstart"]) {
    addEventListener(kind, event => events.push([kind, event.key ?? Math.round(event.clientX ?? -1)]));
}
const gl = document.getElementById("canvas").getContext("webgl2");
gl.clearColor(1, 0.5, 0, 1);
gl.clear(gl.COLOR_BUFFER_BIT);
function readBack() {
    const target = gl.createTexture(), buffer = gl.createFramebuffer();
    gl.getExtension("EXT_color_buffer_float");
    gl.bindTexture(gl.TEXTURE_2D, target);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, 4, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    gl.clearBufferfv(gl.COLOR, 0, [0.1, 1e-7, 3e8, -2]);
    const pixels = new Float32Array(48);
    gl.readPixels(0, 0, 4, 3, gl.RGBA, gl.FLOAT, pixels);
    return pixels;
}
</script>"""
THREE = """<!DOCTYPE html>
<script type="importmap">{"imports": {"three": "/packages/three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(16, 16);
renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
const scene = new THREE.Scene();
const material = new THREE.MeshBasicMaterial({ color: new THREE.Color(0.2, 0.4, 0.8) });
scene.add(new THREE.Mesh(new THREE.PlaneGeometry(4, 4), material));
renderer.render(scene, new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1));
const pixels = new Uint8Array(1024), gl = renderer.getContext();
gl.readPixels(0, 0, 16, 16, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
window.pixels = pixels;
</script>"""


@pytest.fixture
def page(chromium, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(PAGE, encoding="utf-8")
    page = chromium.page(path, 200, 100)
    yield page
    page.close()


def test_numbers_and_pictures_come_back_as_they_were_drawn(page, tmp_path):
    assert (page.array("readBack()", np.float32).reshape(12, 4) == np.float32([0.1, 1e-7, 3e8, -2])).all()
    picture = page.screenshot(tmp_path / "shot.png")
    assert picture.shape == (100, 200, 3) and (tmp_path / "shot.png").read_bytes().startswith(b"\x89PNG")
    assert (picture[90, 190] == (30, 60, 90)).all()
    assert np.abs(picture[10, 10].astype(int) - (255, 128, 0)).max() <= 1  # .5 is 127 or 128


def test_mouse_fingers_and_keys_reach_the_page(page):
    page.mouse("pressed", 5, 5)
    page.mouse("moved", 9, 5)
    page.mouse("released", 9, 5)
    page.key("ArrowLeft")
    # Chromium may tell first that its mouse has come to 0, 0.
    events = [tuple(event) for event in page.evaluate("events") if event[1] != 0]
    assert events == [("pointerdown", 5), ("pointermove", 9), ("pointerup", 9), ("keydown", "ArrowLeft")]
    page.resize(120, 100, touch=True)
    page.touch("start", (7, 7))
    page.touch("end")
    page.wait_for("events.some(event => event[0] == 'touchstart')", 5)


def test_what_a_page_throws_and_misses_is_told(page):
    with pytest.raises(browser.BrowserError, match="ReferenceError: nothing is not defined"):
        page.evaluate("nothing.at_all")
    with pytest.raises(browser.BrowserError, match="window.never: not so within 0.1 s"):
        page.wait_for("window.never", 0.1)
    page.evaluate("setTimeout(() => { throw new Error('later'); }); fetch('http://example.org/x').catch(() => 1)")
    page.wait_for("true")
    page.evaluate("new Promise(done => setTimeout(done, 50))")
    assert any("Error: later" in text for text in page.complaints())
    assert page.requests()[1:] == ["http://example.org/x"]
    assert any("ERR_NAME_NOT_RESOLVED" in text for text in page.complaints())  # no other machine is reached


def test_three_js_of_the_package_draws(chromium, tmp_path):
    (tmp_path / "index.html").write_text(THREE, encoding="utf-8")
    with browser.served(tmp_path) as address:
        page = chromium.page(f"{address}/index.html")
        page.wait_for("window.pixels", 20)
        pixels = page.array("pixels", np.uint8).reshape(-1, 4)
        assert page.complaints() == []
        page.close()
    assert (pixels == (51, 102, 204, 255)).all()
