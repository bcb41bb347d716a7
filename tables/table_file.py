"""Writes fitted tables, reproducible byte by byte, and keeps the state of fits that are under way."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np

from ltsh_addon.shading.lookup_table import FORMAT_VERSION

from . import linearization, projection, refine, walk
from .fresnel_basis import CURVE_NAMES


def write_table(path: Path, fitted) -> None:
    """Write a `fit.Fitted` with its metadata: the same arrays give the same bytes."""
    family = fitted.family
    metadata = {
        "format_version": FORMAT_VERSION,
        "name": path.stem,
        "family": family.kind,
        "degree": family.degree,
        "original_distribution": family.name,
        "brdf": fitted.model.description,
        "axes": "rows: roughness, uniform in [0, 1]; columns: theta_o, uniform in 1 - sqrt(1 - theta_o / 90 deg)",
        "fresnel_curve_names": CURVE_NAMES,
        "settings": settings(family, fitted.model, len(fitted.node_errors)),
        "node_error_mean": float(fitted.node_errors.mean()),
        "node_error_median": float(np.median(fitted.node_errors)),
        "command": f"python -m ltsh_addon tables fit {family.name}{_options(fitted)}",
    }
    arrays = {**fitted.arrays, "node_errors": fitted.node_errors.astype(np.float32)}
    _write_npz(path, {**arrays, "metadata": np.array(json.dumps(metadata))})


def _options(fitted):
    size = len(fitted.node_errors)
    brdf = "" if fitted.model.name == "ggx" else f" --brdf {fitted.model.name}"
    return brdf + ("" if size == 64 else f" --size {size}")


def settings(family, model, size) -> dict:
    """What a fit depends on, beside the code."""
    return {
        "family": family.name,
        "brdf": model.name,
        "size": size,
        "ridge": projection.RIDGE,
        "walk_penalty": walk.PENALTY,
        "iterations": refine.ITERATIONS,
        "albedo_weight": linearization.ALBEDO_WEIGHT,
        "negative_weight": linearization.NEGATIVE_WEIGHT,
        "negative_share": linearization.NEGATIVE_SHARE,
        "excess_weight": linearization.EXCESS_WEIGHT,
        "light_weight": linearization.LIGHT_WEIGHT,
        "error_floor": linearization.ERROR_FLOOR,
    }


class Checkpoint:
    """The state of one fit in a file beside its table; ignored where it was made with other settings."""

    def __init__(self, path: Path, settings: dict):
        self.path = path
        self.settings = json.dumps(settings, sort_keys=True)

    def load(self) -> dict[str, np.ndarray]:
        """The arrays saved last; none where there is no readable file of the same settings."""
        try:
            with open(self.path, "rb") as file, np.load(file) as archive:
                arrays = {key: archive[key] for key in archive.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError):
            return {}
        return arrays if str(arrays.pop("settings", "")) == self.settings else {}

    def save(self, arrays: dict) -> None:
        """Replace the file."""
        arrays = {key: np.asarray(value) for key, value in arrays.items()}
        _write_npz(self.path, {**arrays, "settings": np.array(self.settings)}, compress=False)

    def remove(self) -> None:
        """Remove the file: the fit is complete."""
        self.path.unlink(missing_ok=True)


def _write_npz(path, arrays, compress=True):
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    temporary = path.with_name(path.name + ".part")
    with zipfile.ZipFile(temporary, "w", method, compresslevel=9) as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = method
            archive.writestr(entry, stream.getvalue())
    os.replace(temporary, path)
