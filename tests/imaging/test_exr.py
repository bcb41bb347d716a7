"""EXR layers: bit for bit, by name, complete or not at all."""

import numpy as np
import OpenEXR
import pytest

from ltsh_addon.imaging import Layer, read_layers, write_layers
from ltsh_addon.imaging.exr import read_channels, write_channels, writing_rows

ACES = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)


def layers():
    generator = np.random.default_rng(3)
    color = generator.normal(size=(7, 11, 3)).astype(np.float32)
    color[0, 0], color[0, 1, 0], color[1, 1, 2] = (-3.0e38, 3.0e38, 1e-42), np.nan, -np.inf
    return {
        "ltsh4.specular": color,
        "ltsh4.specular@Key": color * 0.5,
        "samples.position": Layer(generator.normal(size=(7, 11, 3)).astype(np.float32), "XYZ"),
        "coverage.hit": Layer(generator.uniform(size=(7, 11)).astype(np.float32), "V"),
    }


def assert_same(read, written):
    assert set(read) == set(written)
    for name, pixels in written.items():
        assert np.array_equal(read[name].view(np.uint32), pixels.view(np.uint32)), name


def test_layers_come_back_bit_for_bit_and_openexr_itself_sees_names_rows_and_attributes(tmp_path):
    path, written = tmp_path / "a.exr", layers()
    write_layers(path, written, {"ltsh:scene": "room"}, chromaticities=ACES, pixel_aspect=1.5)
    assert_same(read_layers(path), {name: getattr(layer, "pixels", layer) for name, layer in written.items()})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels, header = file.channels(), file.header()
        assert header["ltsh:scene"] == "room" and header["pixelAspectRatio"] == 1.5
        assert np.allclose(header["chromaticities"], ACES, atol=1e-7)
        assert {"ltsh4.specular.R", "samples.position.X", "coverage.hit.V"} <= set(channels)
        assert channels["ltsh4.specular.R"].pixels[0, 0] == np.float32(-3.0e38)


def test_channels_come_back_bit_for_bit(tmp_path):
    """Of names that are no layers, and of arrays whose rows do not stand one after the other."""
    generator, path = np.random.default_rng(5), tmp_path / "a.exr"
    names = ("warp.A", "curve0.c_2_1", "curve10.average_albedo", "plain")
    channels = {name: generator.normal(size=(3, 5)).astype(np.float32) for name in names}
    write_channels(path, {**channels, "plain": channels["plain"].T.copy().T}, {"ltsh:note": "{}"})
    assert_same(read_channels(path), channels)


def test_a_file_of_one_part_per_pass_reads_like_one_of_a_single_part(tmp_path):
    pixels = {name: np.full((4, 5), value, dtype=np.float32) for name, value in (("X", 1.0), ("Y", 2.0), ("Z", 3.0))}
    parts = [
        OpenEXR.Part({}, {"ViewLayer.Position." + key: value for key, value in pixels.items()}, "ViewLayer.Position"),
        OpenEXR.Part({}, {"ViewLayer.Depth.V": pixels["X"]}, "ViewLayer.Depth"),
    ]
    path = tmp_path / "parts.exr"
    with OpenEXR.File(parts) as file:
        file.write(str(path))
    channels = read_channels(path)
    assert set(channels) == {*(f"ViewLayer.Position.{letter}" for letter in "XYZ"), "ViewLayer.Depth.V"}
    assert (channels["ViewLayer.Position.Z"] == 3.0).all()


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match="missing.exr"):
        read_channels(tmp_path / "missing.exr")


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        ({}, "at least one"),
        ({"": np.zeros((2, 2))}, "channel ''"),
        ({"n" * 256: np.zeros((2, 2))}, "1 to 255 bytes"),
        ({"a": np.zeros((2, 2, 1))}, "channel 'a': an array of shape"),
        ({"a": np.zeros((0, 2))}, "channel 'a': an array of shape"),
        ({"a": np.zeros((2, 2)), "b": np.zeros((2, 3))}, "channel 'b' is 3x2"),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_is_written(tmp_path, bad, complaint):
    with pytest.raises(ValueError, match=complaint):
        write_channels(tmp_path / "a.exr", bad)
    two = np.zeros((2, 2, 2))
    for layer in ({"a": two}, {"a": np.zeros(5)}, {"a": Layer(two, "XYZ")}, {"a": np.array([["x", "y"]])}):
        with pytest.raises(ValueError):
            write_layers(tmp_path / "a.exr", layer)
    for wrong in (ACES[:7], (*ACES[:7], np.nan)):
        with pytest.raises(ValueError, match="chromaticities"):
            write_layers(tmp_path / "a.exr", {"a": np.zeros((2, 3))}, chromaticities=wrong)
    assert list(tmp_path.iterdir()) == []


NAMES = ("ltsh4.specular.R", "ltsh4.specular.G", "coverage.hit.V")


def write(path, image, blocks, **options):
    height, width = next(iter(image.values())).shape
    with writing_rows(path, NAMES, (width, height), **options) as writer:
        for start, stop in zip(blocks[:-1], blocks[1:], strict=True):
            writer.write({name: plane[start:stop] for name, plane in image.items()})


@pytest.fixture
def image():
    generator = np.random.default_rng(0)
    planes = {name: generator.normal(size=(70, 33)).astype(np.float32) for name in NAMES}
    planes[NAMES[0]][3, 4:7] = np.nan, np.inf, -np.inf
    return planes


def test_rows_read_back_bit_for_bit_and_the_bytes_do_not_depend_on_the_blocks(tmp_path, image):
    options = {"metadata": {"ltsh:object": "Würfel"}, "chromaticities": ACES, "pixel_aspect": 2.0}
    write(tmp_path / "a.exr", image, (0, 1, 17, 32, 70), **options)
    assert_same(read_channels(tmp_path / "a.exr"), image)
    header = OpenEXR.File(str(tmp_path / "a.exr"), header_only=True).header()
    assert np.allclose(header["chromaticities"], ACES, atol=1e-7) and header["pixelAspectRatio"] == 2.0
    for blocks in ((0, 70), (0, 5, 33, 34, 70)):
        write(tmp_path / "b.exr", image, blocks, **options)
        assert (tmp_path / "b.exr").read_bytes() == (tmp_path / "a.exr").read_bytes()


def test_wrong_rows_are_refused(tmp_path, image):
    with writing_rows(tmp_path / "a.exr", NAMES, (33, 70)) as writer:
        with pytest.raises(ValueError, match=r"channels \['coverage.hit.V'\], expected"):
            writer.write({NAMES[2]: image[NAMES[2]]})
        with pytest.raises(ValueError, match=r"shape \(70, 32\), expected \(70, 33\)"):
            writer.write({name: plane[:, :32] for name, plane in image.items()})
        writer.write(image)
        with pytest.raises(ValueError, match="rows 70 to 71"):
            writer.write({name: plane[:1] for name, plane in image.items()})
    with pytest.raises(ValueError, match="belongs to the EXR format"):
        write(tmp_path / "b.exr", image, (0, 70), metadata={"channels": "x"})


def test_no_part_of_a_file_is_taken_for_the_whole(tmp_path, image):
    """Cut anywhere, the last byte included."""
    write(tmp_path / "a.exr", image, (0, 70))
    data, cut = (tmp_path / "a.exr").read_bytes(), tmp_path / "cut.exr"
    parts = [data[:length] for length in {*range(0, len(data), 97), *range(len(data) - 5, len(data))}]
    for part in (*parts, b"not an image"):
        cut.write_bytes(part)
        with pytest.raises(ValueError, match=r"cut\.exr"):
            read_channels(cut)


@pytest.mark.parametrize("rows", [0, 16, 40, 64, 70])
def test_what_a_killed_writer_leaves_is_not_taken_for_the_whole(tmp_path, image, rows):
    """The table that says where lines are is written last; a reader puts it together from the lines that are there.
    Where those are not all, it is told."""
    with writing_rows(tmp_path / "a.exr", NAMES, (33, 70)) as writer:
        if rows:
            writer.write({name: plane[:rows] for name, plane in image.items()})
        (half,) = tmp_path.glob(".a.exr.*.tmp")
        (tmp_path / "copy.exr").write_bytes(half.read_bytes())
        if rows < 70:
            writer.write({name: plane[rows:] for name, plane in image.items()})
    try:
        found = read_channels(tmp_path / "copy.exr")
    except ValueError as error:
        assert "copy.exr" in str(error)
    else:
        assert rows == 70 and all(np.array_equal(found[name], plane, equal_nan=True) for name, plane in image.items())
