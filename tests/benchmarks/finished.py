"""Finished pictures beside Cycles with Open Image Denoise at equal processor time, each against converged Cycles.

python tests/benchmarks/finished.py [SCENE ...]    2, 8 and 30 s, 240 x 135 pixels
python tests/benchmarks/finished.py picture        the first picture of the README, and Cycles' time at equal error
"""

import itertools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.blender.process.blender_process import denoiser_libraries, shared_blender  # noqa: E402
from ltsh_addon.blender.process.finished import FinishedJob, render_finished  # noqa: E402
from ltsh_addon.cli.commands import DEMO_SCENE  # noqa: E402
from ltsh_addon.cycles.lobes import read_layer  # noqa: E402
from ltsh_addon.imaging.denoise import open_denoiser  # noqa: E402
from ltsh_addon.pipeline import RenderOptions, compositing, render  # noqa: E402
from ltsh_addon.workers.pool import cores  # noqa: E402

# Without compiled modules on disk, every Blender would compile those that it imports; an installed one has them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# The settings of finished pictures were chosen on all but the last.
SCENES = ("artist", "studio", "closed", "lamp", "window", "demo")
SIZE, BUDGETS, TRUE_SAMPLES = (240, 135), (2.0, 8.0, 30.0), 1024
OTHER_SEED = 7919  # of the truth, so that no noise is shared


def build(name: str, path: Path) -> None:
    """The .blend of a scene."""
    if name == "demo":
        shutil.copy(DEMO_SCENE, path)
        return
    script = Path(__file__).with_name("finished_scenes.py")
    subprocess.run([sys.executable, str(script), name, str(path)], check=True, stdout=subprocess.DEVNULL)


def by_cycles(path: Path, folder: Path, *, samples=None, seconds=None, denoise=True) -> tuple[np.ndarray, float, int]:
    """What Cycles alone makes (H, W, 3), processor seconds with the start of Blender, samples."""
    own = Path(tempfile.mkdtemp(dir=folder))
    start = time.process_time()
    with shared_blender(own):
        # As much as starting Blender, opening the file and denoising take.
        left = None if seconds is None else max(seconds - START, 0.1)
        job = FinishedJob(path, None, None, None, None, *SIZE, samples, left, edges=False)
        made = render_finished(job, own)
    image = read_layer(made.channels, "Combined", "RGB")
    if denoise:
        albedo, normal = (read_layer(made.guides, *guide) for guide in (compositing.ALBEDO, compositing.NORMAL))
        with open_denoiser(denoiser_libraries(), cores()) as denoiser:
            (image,) = denoiser.all_denoised([image], albedo, normal)
    return image, made.processor_seconds + time.process_time() - start, made.samples


START = 1.4


def ours(path: Path, folder: Path, **options) -> tuple[np.ndarray, dict, dict]:
    """What `ltsh render` makes, its seconds and its report."""
    with shared_blender(folder):
        made = render.finish(RenderOptions(path, output=folder, resolution=SIZE, **options))
    return made.combined[..., :3], made.seconds["processor"], made.report


def seeded(path: Path, seed: int) -> Path:
    """A copy of the .blend with other random numbers."""
    copy = path.with_name(f"{path.stem}_{seed}.blend")
    code = (
        f"import bpy; bpy.ops.wm.open_mainfile(filepath={str(path)!r}); bpy.context.scene.cycles.seed = {seed}; "
        f"bpy.ops.wm.save_as_mainfile(filepath={str(copy)!r}, copy=True)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    return copy


def error(image: np.ndarray, halves: tuple[np.ndarray, np.ndarray]) -> float:
    """Relative L2 without the noise of the truth, known as two halves that share no noise."""
    first, second = halves
    squared = ((image - first) * (image - second)).sum() / (first * second).sum()
    return float(np.sqrt(max(squared, 0.0)))


def errors(image: np.ndarray, halves: tuple[np.ndarray, np.ndarray]) -> str:
    """The same in words, and FLIP with the noise of the truth."""
    return f"{100.0 * error(image, halves):7.2f} %{imaging.mean_flip(0.5 * sum(halves), image):9.4f}"


def truth(name: str, folder: Path, samples: int) -> tuple[Path, tuple[np.ndarray, np.ndarray]]:
    """The .blend of a scene, and its converged halves; tells what they took."""
    path = folder / f"{name}.blend"
    build(name, path)
    halves = [
        by_cycles(seeded(path, OTHER_SEED + half), folder, samples=samples // 2, denoise=False) for half in range(2)
    ]
    seconds = sum(half[1] for half in halves)
    print(f"  {name:<10}{'':>8}  Cycles, {samples} samples, {seconds:.0f} s: the truth", flush=True)
    return path, tuple(half[0] for half in halves)


def beside(name: str, budget: float, path: Path, folder: Path, true, *, is_ours: bool) -> float:
    """Print what one of both makes in a budget; its error."""
    if is_ours:
        image, seconds, report = ours(path, folder, budget=budget)
        label, took = f"LTSH {report['sub_samples']} + {report['cycles_samples']}", seconds["total"]
    else:
        image, took, samples = by_cycles(path, folder, seconds=budget)
        label = f"Cycles {samples}"
    print(f"  {name:<10}{budget:>6.0f} s  {label:<18}{took:>8.1f} s{errors(image, true)}", flush=True)
    return error(image, true)


def heading() -> None:
    print(f"finished pictures of {SIZE[0]} x {SIZE[1]}, load {os.getloadavg()[0]:.1f}")
    print(f"  {'scene':<10}{'budget':>8}  {'':<18}{'processor':>10}{'rel. L2':>10}{'FLIP':>9}")


def main(names=SCENES, true_samples=TRUE_SAMPLES, budgets=BUDGETS) -> None:
    heading()
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            path, true = truth(name, Path(folder), true_samples)
            for budget, is_ours in itertools.product(budgets, (False, True)):
                beside(name, budget, path, Path(folder), true, is_ours=is_ours)


def picture(name="artist", budget=40.0) -> None:
    """A larger picture, and Cycles with longer and longer budgets until it is as near."""
    heading()
    with tempfile.TemporaryDirectory() as folder:
        path, true = truth(name, Path(folder), TRUE_SAMPLES)
        found = beside(name, budget, path, Path(folder), true, is_ours=True)
        while beside(name, budget, path, Path(folder), true, is_ours=False) > found and budget < 1000.0:
            budget *= np.sqrt(2.0)


if __name__ == "__main__":
    if sys.argv[1:] == ["picture"]:
        SIZE = 640, 360
        picture()
    else:
        main(*([sys.argv[1:]] if sys.argv[1:] else []))
