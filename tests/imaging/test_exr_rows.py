"""An EXR written by blocks of rows reads back as one written at once; nothing is left of one that is not finished."""

import numpy as np
import pytest

from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.imaging.exr_rows import writing_rows

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
