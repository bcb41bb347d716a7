"""EXR layers: bit for bit, by name, complete or not at all."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from ltsh_addon.imaging import Layer, read_layers, write_layers
from ltsh_addon.imaging.exr import read_channels, write_channels, writing_rows


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


def test_layers_come_back_bit_for_bit(tmp_path):
    path = tmp_path / "a.exr"
    written = layers()
    write_layers(path, written, {"ltsh:scene": "room"})
    read = read_layers(path)
    assert set(read) == set(written)
    for name, layer in written.items():
        pixels = layer.pixels if isinstance(layer, Layer) else layer
        assert np.array_equal(read[name].view(np.uint32), pixels.view(np.uint32)), name


def test_openexr_itself_sees_the_channel_names_and_rows_from_the_top(tmp_path):
    path = tmp_path / "a.exr"
    write_layers(path, layers(), {"ltsh:scene": "room"})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        assert file.header()["ltsh:scene"] == "room"
        assert {"ltsh4.specular.R", "samples.position.X", "coverage.hit.V"} <= set(channels)
        assert channels["ltsh4.specular.R"].pixels[0, 0] == np.float32(-3.0e38)


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


@pytest.mark.parametrize("damage", ["truncated", "text", "empty"])
def test_a_damaged_file_is_named(tmp_path, damage):
    path = tmp_path / "a.exr"
    write_layers(path, layers())
    data = path.read_bytes()
    path.write_bytes({"truncated": data[: len(data) // 2], "text": b"not an image", "empty": b""}[damage])
    with pytest.raises(ValueError, match="a.exr"):
        read_channels(path)


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match="missing.exr"):
        read_channels(tmp_path / "missing.exr")


def test_channels_with_long_names_come_back_bit_for_bit(tmp_path):
    generator = np.random.default_rng(5)
    names = ("warp.A", "curve0.c_2_1", "curve10.average_albedo", "plain")
    channels = {name: generator.normal(size=(3, 5)).astype(np.float32) for name in names}
    path = tmp_path / "a.exr"
    write_channels(path, {**channels, "plain": channels["plain"].T.copy().T}, {"ltsh:note": "{}"})
    read = read_channels(path)
    assert set(read) == set(names)
    for name, plane in channels.items():
        assert np.array_equal(read[name].view(np.uint32), plane.view(np.uint32)), name
    with OpenEXR.File(str(path), header_only=True) as file:
        assert file.header()["ltsh:note"] == "{}"


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
def test_channels_that_do_not_fit_are_refused_and_nothing_is_written(tmp_path, bad, complaint):
    with pytest.raises(ValueError, match=complaint):
        write_channels(tmp_path / "a.exr", bad)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "bad",
    [
        {"a": np.zeros((2, 2, 2))},
        {"a": np.zeros(5)},
        {"a": np.zeros((2, 2, 3)), "b": np.zeros((3, 2, 3))},
        {"a": Layer(np.zeros((2, 2, 3)), "XY")},
        {"a": np.array([["x", "y"]])},
    ],
)
def test_layers_that_do_not_fit_are_refused_and_nothing_is_written(tmp_path, bad):
    with pytest.raises(ValueError):
        write_layers(tmp_path / "a.exr", bad)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_bytes(b"old")

    class Failing:
        def __init__(self, name, header):
            Path(name).write_bytes(b"half")

        def writePixels(self, data, rows):
            raise RuntimeError("no space left")

        def close(self):
            pass

    monkeypatch.setattr(OpenEXR, "OutputFile", Failing)
    with pytest.raises(OSError, match="a.exr"):
        write_layers(path, layers())
    assert [item.name for item in tmp_path.iterdir()] == ["a.exr"]
    assert path.read_bytes() == b"old"


def test_chromaticities_stand_in_the_header(tmp_path):
    given = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
    write_layers(tmp_path / "a.exr", {"a": np.zeros((2, 3))}, chromaticities=given, pixel_aspect=1.5)
    header = OpenEXR.File(str(tmp_path / "a.exr"), header_only=True).header()
    assert np.allclose(header["chromaticities"], given, atol=1e-7) and header["pixelAspectRatio"] == 1.5


@pytest.mark.parametrize("wrong", [(0.3,) * 7, (0.3,) * 7 + (np.nan,)])
def test_chromaticities_are_eight_numbers(tmp_path, wrong):
    with pytest.raises(ValueError, match="chromaticities"):
        write_layers(tmp_path / "a.exr", {"a": np.zeros((2, 3))}, chromaticities=wrong)
    assert list(tmp_path.iterdir()) == []


NAMES = ("ltsh4.specular.R", "ltsh4.specular.G", "coverage.hit.V")


def write(path, image, blocks, **options):
    height, width = next(iter(image.values())).shape
    with writing_rows(path, NAMES, width, height, **options) as writer:
        for start, stop in zip(blocks[:-1], blocks[1:], strict=True):
            writer.write({name: plane[start:stop] for name, plane in image.items()})


@pytest.fixture
def image():
    generator = np.random.default_rng(0)
    planes = {name: generator.normal(size=(70, 33)).astype(np.float32) for name in NAMES}
    planes[NAMES[0]][3, 4:7] = np.nan, np.inf, -np.inf
    return planes


def test_rows_read_back_bit_for_bit(tmp_path, image):
    write(tmp_path / "a.exr", image, (0, 1, 17, 32, 70), metadata={"ltsh:object": "Würfel"})
    found = read_channels(tmp_path / "a.exr")
    assert set(found) == set(NAMES)
    for name, plane in image.items():
        assert np.array_equal(found[name].view(np.uint32), plane.view(np.uint32)), name


def test_the_bytes_do_not_depend_on_the_blocks(tmp_path, image):
    write(tmp_path / "a.exr", image, (0, 70))
    write(tmp_path / "b.exr", image, (0, 5, 33, 34, 70))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_wrong_rows_are_refused(tmp_path, image):
    with writing_rows(tmp_path / "a.exr", NAMES, 33, 70) as writer:
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
    for length in {*range(0, len(data), 97), *range(len(data) - 5, len(data))}:
        cut.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"cut\.exr"):
            read_channels(cut)


@pytest.mark.parametrize("rows", [0, 16, 40, 64, 70])
def test_what_a_killed_writer_leaves_is_not_taken_for_the_whole(tmp_path, image, rows):
    """The table that says where lines are is written last; a reader puts it together from the lines that are there.
    Where those are not all, it is told."""
    with writing_rows(tmp_path / "a.exr", NAMES, 33, 70) as writer:
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


def test_chromaticities_and_pixel_aspect_stand_in_the_header(tmp_path, image):
    given = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    write(tmp_path / "a.exr", image, (0, 5, 70), chromaticities=given, pixel_aspect=2.0)
    header = OpenEXR.File(str(tmp_path / "a.exr"), header_only=True).header()
    assert np.allclose(header["chromaticities"], given, atol=1e-7) and header["pixelAspectRatio"] == 2.0
    found = read_channels(tmp_path / "a.exr")
    assert all(np.array_equal(found[name], plane, equal_nan=True) for name, plane in image.items())
