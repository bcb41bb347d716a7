"""The report as JSON and as a page."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest

from ltsh_addon.imaging import report


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
    report.write_html(tmp_path, "report.html", "compare.png", "compare.exr", document("<b>&.blend", noise))
    page = Tags()
    page.feed((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.open == []
    assert "script" not in page.seen and "b" not in page.seen
    assert "<b>&.blend" in page.text and "<script>alert(1)</script>" in page.text
    assert "1.230 %" in page.text
    assert "GAUSSIAN 2 px" in page.text and "pixels 1.5 times as wide" in page.text
    assert "ACEScg" in page.text and "3, 2 of 96 x 54" in page.text and "film exposure 0.5" in page.text


def test_files_are_replaced_as_a_whole(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(TypeError):
        report.write_json(path, {"a": object()})
    assert path.read_text() == "old"
    report.write_json(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["report.json"]
