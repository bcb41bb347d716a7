"""An EXR written by blocks of rows reads back as one written at once; nothing is left of one that is not finished."""

import numpy as np
import OpenEXR
import pytest

from ltsh_addon.imaging.exr import read_channels, writing_rows

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


def test_an_exception_leaves_the_old_file_and_nothing_else(tmp_path, image):
    write(tmp_path / "a.exr", image, (0, 70))
    before = (tmp_path / "a.exr").read_bytes()
    with pytest.raises(KeyError), writing_rows(tmp_path / "a.exr", NAMES, 33, 70) as writer:
        writer.write({name: plane[:20] for name, plane in image.items()})
        raise KeyError("stop")
    with pytest.raises(ValueError, match="50 rows were written, expected 70"):
        write(tmp_path / "a.exr", image, (0, 50))
    assert (tmp_path / "a.exr").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


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


def test_a_folder_that_is_missing_is_named(tmp_path, image):
    with pytest.raises(OSError, match="none"):
        write(tmp_path / "none" / "a.exr", image, (0, 70))


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
