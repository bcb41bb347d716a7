"""Errors of a bake against Cycles', summed up block by block, and a small picture of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from .. import imaging

LARGEST_PICTURE = 2048
# The darkest and brightest colors stand for this share of what Cycles' brightest texels show.
PICTURE_SCALE = 0.1
PICTURE_PERCENTILE = 99.0
EMPTY_COLOR = 0.55


class ErrorSums:
    """Sums over texels, from which the figures of `imaging.metrics` follow."""

    def __init__(self):
        self._products: dict[tuple[str, str], np.ndarray] = {}
        self._halves: dict[str, np.ndarray] = {}

    def add_halves(self, pass_name: str, a: np.ndarray, b: np.ndarray) -> None:
        """Two independent halves (Q, 3) of Cycles' bake."""
        a, b = a.astype(np.float64), b.astype(np.float64)
        sums = np.array([(a * b).sum(), ((a - b) ** 2).sum(), ((a + b) ** 2).sum(), 0.5 * (a + b).sum()])
        self._halves[pass_name] = self._halves.get(pass_name, 0.0) + sums

    def add(self, name: str, pass_name: str, shaded: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
        """What a technique has at the same texels (Q, 3)."""
        shaded, a, b = (values.astype(np.float64) for values in (shaded, a, b))
        sums = np.array([((shaded - a) * (shaded - b)).sum(), shaded.sum()])
        self._products[name, pass_name] = self._products.get((name, pass_name), 0.0) + sums

    def report(self) -> dict:
        """Per pass: noise of Cycles and for each technique the error without that noise, and the bias."""
        found = {}
        for pass_name, (norm, difference, total, light) in self._halves.items():
            techniques = {}
            for (name, of_pass), (product, shaded) in self._products.items():
                if of_pass == pass_name:
                    squared = product / norm if norm > 0.0 else 0.0
                    techniques[name] = {
                        "unbiased_error": math.sqrt(max(squared, 0.0)) if norm > 0.0 else None,
                        "unbiased_squared_error": squared,
                        "bias": shaded / light - 1.0 if light > 0.0 else None,
                    }
            noise = math.sqrt(difference / total) if total > 0.0 else None
            found[pass_name] = {"noise": noise, "techniques": techniques}
        return found


class ErrorPictures:
    """Every n-th texel of errors as PNG beside the EXR `path`: red too bright, blue too dark, gray not baked."""

    def __init__(self, width: int, height: int, path: Path, techniques: list[str], passes: list[str]):
        self.folder = path.parent
        self.step = max(1, -(-max(width, height) // LARGEST_PICTURE))
        layers = [(f"error_{name}.{pass_name}", pass_name) for pass_name in passes for name in techniques]
        self._pictures = {f"{path.stem}.{layer}.png": (layer, pass_name) for layer, pass_name in layers}
        self._rows: dict[str, dict[int, np.ndarray]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the files."""
        return list(self._pictures)

    def add(self, first: int, planes: dict[str, np.ndarray]) -> None:
        """Rows (R, W) of the EXR's channels from the row `first`, counted from the top."""
        picked = slice(-first % self.step, None, self.step), slice(None, None, self.step)
        for error, pass_name in self._pictures.values():
            for layer in (error, f"cycles.{pass_name}"):
                pixels = np.stack([planes[f"{layer}.{letter}"][picked] for letter in "RGB"], axis=-1)
                self._rows.setdefault(layer, {})[first] = pixels
        self._rows.setdefault("coverage", {})[first] = planes["coverage.hit.V"][picked]

    def write(self) -> None:
        """Write the files."""
        images = {layer: np.concatenate(list(rows.values())) for layer, rows in self._rows.items()}
        covered = images["coverage"] > 0.0
        for name, (layer, pass_name) in self._pictures.items():
            brightness = images[f"cycles.{pass_name}"].max(axis=-1)[covered]
            scale = PICTURE_SCALE * float(np.percentile(brightness, PICTURE_PERCENTILE)) if brightness.size else 0.0
            colors = imaging.signed_error_colors(images[layer], scale or 1.0)
            colors[~covered] = EMPTY_COLOR
            imaging.write_png(self.folder / name, np.round(255.0 * colors).astype(np.uint8))
