"""A bake in three.js, by the loader of docs/lightmaps.md: its pixels are base color times our light."""

import re
from pathlib import Path

import browser
import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.cycles.texels import ImageTexture  # noqa: E402
from ltsh_addon.cycles.uv import UvTriangles  # noqa: E402
from ltsh_addon.imaging import to_srgb8  # noqa: E402
from ltsh_addon.pipeline import BakeOptions, bake_files, bake_scene  # noqa: E402

SIDE, SIZE, COLOR = 128, 96, (0.6, 0.4, 0.3)
DOCUMENT = (Path(__file__).parents[2] / "docs" / "lightmaps.md").read_text(encoding="utf-8")
LOADER = re.search(r"```js\n(async function addLightmaps.*?)```", DOCUMENT, re.S)[1]
PAGE = """<!DOCTYPE html>
<script type="importmap">{"imports": {"three": "/packages/three/build/three.module.js",
                                      "three/addons/": "/packages/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { EXRLoader } from "three/addons/loaders/EXRLoader.js";
LOADER
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(SIZE, SIZE);
const gltf = await new GLTFLoader().loadAsync("FILE");
if ("FILE" === "scene.glb") await addLightmaps(gltf.scene, "./", new EXRLoader());
const camera = new THREE.OrthographicCamera(-2, 2, 2, -2, 0.1, 20);
camera.position.set(0, 10, 0);
camera.lookAt(0, 0, 0);
renderer.render(gltf.scene.children.length ? new THREE.Scene().add(gltf.scene) : gltf.scene, camera);
const pixels = new Uint8Array(4 * SIZE * SIZE), gl = renderer.getContext();
gl.readPixels(0, 0, SIZE, SIZE, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
window.pixels = pixels;
</script>"""


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """The folder of a bake of a floor and a box, seen from above below: textures, .glb with lightmaps and unlit."""
    import scene_parts
    from scene_parts import add_plane, principled

    folder = tmp_path_factory.mktemp("glb")
    scene_parts.empty_scene()
    scene_parts.add_area_light("Key", location=(0.9, 0.4, 1.5), energy=60.0)
    material = principled("Paint", Base_Color=(*COLOR, 1.0), Roughness=0.9)[0]
    floor = add_plane(material, size=3.0, name="Floor")
    floor.data.uv_layers.remove(floor.data.uv_layers[0])
    bpy.ops.mesh.primitive_cube_add(size=0.8, location=(-0.3, 0.2, 0.41), rotation=(0.0, 0.0, 0.4))
    bpy.context.object.name = "Box"
    bpy.context.object.data.materials.append(material)
    path = scene_parts.save(folder / "scene.blend")
    passes = ("diffuse_light", "diffuse")
    report = bake_scene(BakeOptions(path, folder, atlas=SIDE, passes=passes, view="above", export="glb"))
    assert report["exported"] == ["Lightmap.lightmap.exr", "Lightmap.lightmap.png", "scene.glb", "scene_unlit.glb"]
    assert report["warnings"] == report["problems"] == []
    return folder


def seen_from_above(glb, channel):
    """The UV coordinates (Q, 2) of pixels (Q,) of a picture SIZE x SIZE of 4 m, row 0 below, by the file itself."""
    document, data = bake_files.read_glb(glb)

    def values(number):
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
        flat = np.frombuffer(data, kind, accessor["count"] * width, view["byteOffset"] + accessor.get("byteOffset", 0))
        return flat.reshape(-1, width)

    corners, uv = [], []
    for node in document["nodes"]:
        x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
        turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        index, attributes = values(primitive["indices"])[:, 0], primitive["attributes"]
        at = values(attributes["POSITION"]) @ turn.T + node.get("translation", (0.0, 0.0, 0.0))
        corners.append(at[index].reshape(-1, 3, 3))
        uv.append(values(attributes[f"TEXCOORD_{channel}"])[index].reshape(-1, 3, 2))
    corners, uv = np.concatenate(corners), np.concatenate(uv)
    # Of triangles over one another the last one is seen. glTF: y is up, z towards the viewer at the lower edge.
    order = np.argsort(corners[:, :, 1].mean(axis=1))
    corners, uv = corners[order], uv[order]
    places = np.stack([corners[..., 0], -corners[..., 2]], axis=-1) / 4.0 + 0.5
    texels = UvTriangles.in_tile(places, SIZE, SIZE).texels(0, SIZE)
    return texels.index, np.einsum("qcx,qc->qx", uv[texels.triangle], texels.barycentric)


@pytest.mark.parametrize("file", ["scene.glb", "scene_unlit.glb"])
def test_three_shows_the_texture_of_the_bake(baked, chromium, file):
    page_text = PAGE.replace("LOADER", LOADER).replace("FILE", file).replace("SIZE", str(SIZE))
    (baked / "page.html").write_text(page_text, encoding="utf-8")
    with browser.served(baked) as address:
        page = chromium.page(f"{address}/page.html", 200, 200)
        page.wait_for("window.pixels")
        shown = page.array("window.pixels", np.uint8).reshape(-1, 4)[:, :3].astype(int)
        assert not [line for line in page.complaints() if "Performance" not in line]
        page.close()
    layers = imaging.read_layers(baked / "Lightmap.exr")
    index, uv = seen_from_above((baked / file).read_bytes(), 1)
    if file == "scene.glb":
        light = ImageTexture(layers["ltsh4c.diffuse_light"], "EXTEND", "Linear", False).colors(uv)
        wanted = to_srgb8(light * COLOR).astype(int)
    else:
        picture = to_srgb8(layers["ltsh4c.diffuse"])
        wanted = to_srgb8(ImageTexture(picture, "EXTEND", "Linear", True).colors(uv)).astype(int)
    assert len(index) > 0.5 * SIZE * SIZE and np.ptp(wanted) > 100
    # Half floats, and the rounding of 8 bits twice; pixels on edges may show the other face.
    assert np.mean(np.abs(shown[index] - wanted).max(axis=1) <= 2) >= 0.95
