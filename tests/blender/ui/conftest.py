"""Fixtures of several tests of the interface."""

import numpy as np
import pytest
from job_window import add_on_in_room

from ltsh_addon.blender.ui import comparison, results
from ltsh_addon.imaging.exr import write_channels
from ltsh_addon.pipeline import display_layers

EMPTY = {"passes": {}, "warnings": []}


@pytest.fixture
def scene(tmp_path):
    """The add-on and a saved file that can be shaded."""
    with add_on_in_room(tmp_path / "room.blend") as found:
        yield found
        results.state["job"] = None


@pytest.fixture
def show_results():
    """A function that shows random results as `ltsh compare` leaves them; it returns {layer: (H, W, 3)}."""

    def show(scene, folder, seed=1, names=("ltc", "ltsh4c", "cycles"), report=EMPTY, partial=""):
        random, passes = np.random.default_rng(seed), tuple(report["passes"]) or ("specular", "diffuse")
        output = folder / "ltsh" / "compare"
        output.mkdir(parents=True, exist_ok=True)
        pictures = {f"{name}.{part}": random.random((6, 10, 3), np.float32) * 4.0 - 0.5
                    for name in (*names, "cycles_A", "cycles_B") for part in passes}  # fmt: skip
        channels = {"coverage.hit.V": np.ones((6, 10), np.float32)}
        for layer, pixels in pictures.items():
            channels |= {f"{layer}.{letter}": pixels[..., index] for index, letter in enumerate("RGB")}
        write_channels(output / "compare.exr", channels)
        results.show(scene, display_layers.write("compare", output, report, partial))
        comparison.refresh(scene)
        combined = {f"{name}.combined": sum(pictures[f"{name}.{part}"] for part in passes) for name in names}
        return pictures | combined

    return show
