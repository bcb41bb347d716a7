"""What engines get: RGBM, and .glb files with lightmaps or unlit colors."""

import json
import struct

import numpy as np

from ltsh_addon.pipeline import bake_files


def test_rgbm_decodes_to_the_colors_within_half_a_step_of_its_alpha():
    rng = np.random.default_rng(3)
    pixels = (5.0 * rng.random((16, 24, 3)) ** 4).astype(np.float32)
    pixels[0, 0] = 0.0
    encoded = bake_files.rgbm(pixels, 5.0)
    assert encoded.dtype == np.uint8 and encoded[..., 3].min() >= 1
    alpha = encoded[..., 3:] / 255.0
    decoded = encoded[..., :3] / 255.0 * alpha * 5.0
    # Half a step of rgb, which alpha and the range scale.
    assert (np.abs(decoded - pixels) <= 0.501 / 255.0 * alpha * 5.0).all()


def triangle():
    """A document of one triangle that two nodes show, and its data."""
    document = {
        "asset": {"version": "2.0"}, "nodes": [{"name": "A", "mesh": 0}, {"name": "B", "mesh": 0}, {"name": "C"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}], "materials": [{"name": "old"}],
    }  # fmt: skip
    return document, b"abcdef"


def test_a_glb_is_read_as_it_was_written_with_whole_words():
    document, data = triangle()
    glb = bake_files.write_glb(document, data)
    # glTF 2.0, section 4.4: magic, version 2, length of all; chunks of whole words.
    assert glb[:4] == b"glTF" and struct.unpack_from("<II", glb, 4) == (2, len(glb)) and len(glb) % 4 == 0
    read, more = bake_files.read_glb(glb)
    assert read == document and more[:6] == data and read["buffers"] == [{"byteLength": 6}]


def test_nodes_that_share_a_mesh_show_textures_of_their_own():
    document, data = triangle()
    more = bytearray(data)
    for name, png in (("A", b"png a"), ("B", b"png b")):
        bake_files._show_unlit(document, more, png, {name: 1})
    for node, png in zip(document["nodes"], (b"png a", b"png b"), strict=False):
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        material = document["materials"][primitive["material"]]
        assert "KHR_materials_unlit" in material["extensions"]
        texture = material["pbrMetallicRoughness"]["baseColorTexture"]
        assert texture["texCoord"] == 1
        view = document["bufferViews"][
            document["images"][document["textures"][texture["index"]]["source"]]["bufferView"]
        ]
        assert bytes(more[view["byteOffset"] :][: view["byteLength"]]) == png and view["byteOffset"] % 4 == 0
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    json.dumps(document)
