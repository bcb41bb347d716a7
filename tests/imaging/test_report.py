"""The report as JSON, as a page and as a sheet of pictures."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest

from ltsh_addon.imaging import Tile, comparison_sheet, report, sheet
from ltsh_addon.imaging.color import exposure_factor, to_srgb8


def document(scene="room.blend", noise=True):
    figures = {"unbiased_relative_error": 0.0123, "bias": None}
    passes = {"specular": {"techniques": {"ltsh4": {"against_cycles": figures}}}}
    if noise:
        passes["specular"]["noise"] = 0.02
    return {
        "scene": scene,
        "camera": "Camera",
        "frame": 3,
        "resolution": [48, 27],
        "border": {"left": 3, "top": 2, "width": 48, "height": 27, "full_width": 96, "full_height": 54},
        "pixel_aspect": 1.5,
        "pixel_filter": "GAUSSIAN 2 px",
        "exposure": 0.5,
        "color_space": "ACEScg",
        "sub_samples": 1,
        "cycles_samples": 16,
        "versions": {"blender": "5.2.3"},
        "passes": passes,
        "warnings": ["material '<script>alert(1)</script>': anisotropy is not shaded"],
    }


def test_json_keeps_order_and_turns_numpy_and_nan_into_json():
    text = report.json_text({"b": np.float32(0.5), "a": [np.int64(2), float("nan"), np.inf], "c": np.arange(3)})
    assert json.loads(text) == {"b": 0.5, "a": [2, None, None], "c": [0, 1, 2]}
    assert list(json.loads(text)) == ["b", "a", "c"]


class Tags(HTMLParser):
    """Open tags must close in order; collects tags and text."""

    VOID = {"meta", "img"}

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("noise", [True, False])
def test_page_is_well_formed_and_escapes_names(tmp_path, noise):
    texts = ["Cycles", "<b>LTC</b>"], ["specular: <b>1 %</b>"]
    report.write_html(tmp_path, "report.html", ("compare.exr", "compare.png"), texts, document("<b>&.blend", noise))
    page = Tags()
    page.feed((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.open == []
    assert "script" not in page.seen and "b" not in page.seen
    assert "<b>LTC</b>" in page.text and "specular: <b>1 %</b>" in page.text
    assert "<b>&.blend" in page.text and "<script>alert(1)</script>" in page.text
    assert "1.230 %" in page.text
    assert "GAUSSIAN 2 px" in page.text and "pixels 1.5 times as wide" in page.text
    assert "ACEScg" in page.text and "3, 2 of 96 x 54" in page.text and "film exposure 0.5" in page.text


def picture(width, height, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 2.0, (height, width, 3))


def contains(page, part):
    """Whether the pixels `part` stand somewhere in `page`."""
    rows, columns = np.nonzero((page == part[0, 0]).all(axis=-1))
    height, width = part.shape[:2]
    return any(np.array_equal(page[y : y + height, x : x + width], part) for y, x in zip(rows, columns, strict=True))


@pytest.mark.parametrize("count", [1, 4, 7])
def test_every_picture_stands_on_the_sheet_pixel_for_pixel(count):
    reference = picture(240, 30)
    tiles = [Tile(f"T{k}", picture(240, 30, k + 1), picture(240, 30, k + 20) - 1.0) for k in range(count)]
    page, text = comparison_sheet(reference, tiles)
    assert page.dtype == np.uint8
    exposure = exposure_factor(reference)
    assert f"exposure {np.log2(exposure):+.1f} EV" in text and "from \u22121 to +1" in text
    for image in (reference, *(tile.image for tile in tiles)):
        assert contains(page, to_srgb8(exposure * image))


def test_large_images_are_reduced_without_changing_their_mean():
    image = picture(1000, 333)
    reduced = sheet._reduced(image)
    assert reduced.shape == (111, 333, 3)
    assert reduced.mean() == pytest.approx(image[:, :999].mean(), rel=1e-9)


def test_pixels_that_were_not_taken_are_gray_and_change_no_mean():
    """Each pixel of the sheet is the mean of those that were taken."""
    for width, height in ((16, 9), (960, 12)):
        missing = np.random.default_rng(1).random((height, width)) < 0.7
        image = np.where(missing[..., None], 0.0, 0.5) * np.ones(3)
        page, _ = comparison_sheet(np.full((height, width, 3), 0.5), [Tile("T", image, 0.0 * image, missing)])
        bright, gray = to_srgb8(np.array([0.9, 0.9, 0.9])), np.array([128, 128, 128], np.uint8)
        share = sheet._reduced((~missing[..., None]).astype(float))
        assert contains(page, np.where(share > 0.0, bright, gray).astype(np.uint8))
        assert not (page == 0).all(axis=-1).any()


def test_odd_images_make_a_sheet_and_images_of_different_size_are_refused():
    image, error = picture(32, 18), picture(32, 18, 1) - 1.0
    broken = np.where(image > 1.9, np.nan, np.where(image < 0.1, np.inf, image))
    assert np.isnan(broken).any() and np.isinf(broken).any()
    for odd in ((0.0 * image, error), (image, 0.0 * error), (image, broken), (broken, error)):
        assert comparison_sheet(odd[0], [Tile("T", *odd)])[0].ndim == 3
    with pytest.raises(ValueError, match="'T'.*shape"):
        comparison_sheet(image, [Tile("T", picture(16, 9), picture(16, 9))])


def test_warnings_of_one_kind_are_one_line_with_a_count_and_all_names():
    own_light = "object {!r}: its faces may stand in their own light, shaded as if they did not"
    names = [f"P{number}" for number in range(49)] + ["it's", "a; b"]
    (line,) = report.grouped(own_light.format(name) for name in names)
    assert line.startswith(own_light.format("P0") + " (50 more: ") and all(repr(name) in line for name in names)
    (shown,) = report.on_screen([line])
    assert shown == own_light.format("P0") + " (50 more: 'P1'; 'P2'; 'P3' and 47 more)"
    assert report.grouped([line]) == [line]


def test_groups_of_several_tasks_merge_as_their_lines_would():
    lines = [f"object 'Leaf {n}': {n + 1}.5 % of its texels are left out" for n in range(7)]
    (together,) = report.grouped([*lines, "object 'Leaf 3': 4.5 % of its texels are left out"])
    merged = report.grouped([*report.grouped(lines[4:]), *report.grouped(lines[:5])])
    assert len(merged) == 1 and "(6 more: " in together and "(6 more: " in merged[0]
    assert together.startswith(lines[6])  # the worst
    assert all(f"'Leaf {n}' {n + 1}.5 %" in merged[0] for n in range(6))


def test_the_most_harmful_warnings_come_first_and_at_most_eight_are_shown():
    harmless = [
        "motion blur is switched off, in the Cycles reference as well",
        "direct light is Cycles' own: 99 % of it",
    ]
    sizes = zip("abcdefg", (3, 41, 0.5, 7, 20, 1, 2), strict=True)
    sized = [f"light 'A': kind {letter} is {size} % off" for letter, size in sizes]
    absent = ["object 'B': it emits from too many faces; it lights nothing, in the Cycles reference neither"]
    lines = report.grouped([*harmless, *sized, *absent])
    assert lines[0] == absent[0] and lines[-2:] == harmless[::-1]
    assert [line.split()[-3] for line in lines[1:-2]] == ["41", "20", "7", "3", "2", "1", "0.5"]
    shown = report.on_screen(lines, "out/report.json")
    assert shown == [*lines[:8], "2 more kinds of warnings are in out/report.json"]
