"""Finished pictures beside Cycles and its denoiser at equal processor time of whole processes, by three figures.

python tests/benchmarks/finished.py [--scenes NAME ...] [--budgets S ...] [--samples N ...] [--seeds N]

Pictures of so many seconds, or of so many samples of Cycles without a budget.

The figures: relative L2 over all pixels, and without the brightest 0.2 %, both free of the noise of the truth; FLIP.
The room is what direct light without noise and cost would leave of Cycles' error: the perfect direct light, and
Combined - direct of as many samples as Cycles has in the time, denoised. The goal is its square root: half of the gain.
Settings of finished pictures are chosen on TUNED; HELD_OUT are only looked at. Truths and rooms stay in --cache.
"""

import argparse
import ast
import hashlib
import importlib.metadata
import json
import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import measure  # noqa: E402

from ltsh_addon import imaging  # noqa: E402
from ltsh_addon.blender.process.blender_process import denoiser_libraries  # noqa: E402
from ltsh_addon.cycles.lobes import read_layer  # noqa: E402
from ltsh_addon.imaging.color import luminance  # noqa: E402
from ltsh_addon.imaging.denoise import open_denoiser  # noqa: E402
from ltsh_addon.imaging.exr import COMBINED, read_channels  # noqa: E402
from ltsh_addon.pipeline.compositing import ALBEDO, NORMAL  # noqa: E402
from ltsh_addon.workers.pool import cores  # noqa: E402

TUNED = ("product", "bathroom", "cloth", "window", "street", "arcade")
HELD_OUT = ("car", "foliage", "glow", "workshop", "food", "hall")
TRUE_SEEDS = 7919, 7920  # of the halves of the truth, which share no noise with any picture
BRIGHTEST = 0.002
# The names of a pass's light and color in Blender 4.5 and in later ones.
DIRECT = ((("Diffuse Direct", "DiffDir"), ("Diffuse Color", "DiffCol")),
          (("Glossy Direct", "GlossDir"), ("Glossy Color", "GlossCol")))  # fmt: skip
MOST_OFF = 0.06  # of Cycles' time, before it is rendered again
FIGURES = ("L2", f"L2 -{100 * BRIGHTEST:.1f} %", "FLIP")


def figures(pair, halves) -> np.ndarray:
    """The three figures of a picture against the truth, known as two `halves` (H, W, 3) that share no noise.

    `pair` is the picture twice; or with the direct light of one half each, which stands for light without noise.
    """
    middle = 0.5 * sum(halves)
    brightness = luminance(middle)
    is_dim = brightness <= np.quantile(brightness, 1.0 - BRIGHTEST)
    squares = [image - half for image, half in zip(pair, halves, strict=True)]
    squares, norms = np.prod(squares, axis=0).sum(axis=-1), np.prod(halves, axis=0).sum(axis=-1)
    ratios = squares.sum() / norms.sum(), squares[is_dim].sum() / norms[is_dim].sum()
    return np.array([*np.sqrt(np.maximum(ratios, 0.0)), imaging.mean_flip(middle, 0.5 * sum(pair))])


@dataclass
class Scene:
    """A scene with what is known of it, in a folder that is named after its source."""

    name: str
    cache: Path
    size: tuple[int, int]
    true_samples: int
    fixed: float = 0.0  # processor seconds of Cycles with one sample
    each: float = 0.0  # and of each further one
    halves: list = field(default_factory=list)  # (H, W, 3) truths
    direct: list = field(default_factory=list)  # (H, W, 3) their direct light

    def __post_init__(self):
        folder = Path(__file__).parent
        source = (folder / "finished_scenes.py").read_text()
        functions = {one.name: one for one in ast.parse(source).body if isinstance(one, ast.FunctionDef)}
        helpers = [name for name in functions if name.startswith("_")]
        texts = [ast.unparse(functions[name]) for name in (self.name, *helpers)]
        texts += [(folder / file).read_text() for file in ("scene_builders.py", "cycles_picture.py")]
        texts += [importlib.metadata.version("bpy"), str(self.size)]
        key = hashlib.sha256("".join(texts).encode()).hexdigest()[:12]
        self.cache = self.cache / f"{self.name}_{key}"
        self.cache.mkdir(parents=True, exist_ok=True)

    def blend(self, seed: int) -> Path:
        """The .blend with this seed of Cycles."""
        path = self.cache / f"{self.name}_{seed}.blend"
        if not path.exists():
            measure.run(Path(__file__).with_name("finished_scenes.py"), self.name, self.cache, seed)
        return path

    def cycles(self, seed: int, samples: int, *passes: str, blend: Path | None = None) -> tuple[dict, float]:
        """Channels of Cycles alone, of this scene or of a file, and its processor seconds."""
        blend = blend or self.blend(0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "cycles.exr"
            script = Path(__file__).with_name("cycles_picture.py")
            seconds = measure.run(script, blend, path, *self.size, samples, seed, *passes).processor
            return read_channels(path), seconds

    def find_truth(self) -> None:
        """The truth and the cost of samples, from the cache or from Cycles."""
        path = self.cache / f"truth_{self.true_samples}.npz"
        if not path.exists():
            count = self.true_samples // 2
            renders = [self.cycles(seed, count, "passes") for seed in TRUE_SEEDS]
            fixed = self.cycles(0, 1)[1]
            each = (sum(seconds for _, seconds in renders) / 2 - fixed) / count
            halves = [read_layer(channels, "Combined", "RGB") for channels, _ in renders]
            direct = [direct_light(channels) for channels, _ in renders]
            np.savez(path, halves=halves, direct=direct, cost=[fixed, each])
        with np.load(path) as data:
            self.halves, self.direct = list(data["halves"].astype(float)), list(data["direct"].astype(float))
            self.fixed, self.each = data["cost"]

    def by_cycles(self, seed: int, seconds: float) -> tuple[np.ndarray, float, int]:
        """The figures of Cycles and its denoiser with so many processor seconds, its seconds and samples."""
        for _ in range(3):
            samples = max(round((seconds - self.fixed) / self.each), 1)
            channels, took = self.cycles(seed, samples)
            self.each = max((took - self.fixed) / samples, 1e-3 * took / samples)
            if samples == 1 or abs(took / seconds - 1.0) < MOST_OFF:
                break
        image = read_layer(channels, "Combined", "RGB").astype(float)
        return figures((image, image), self.halves), took, samples

    def room(self, seed: int, samples: int) -> np.ndarray:
        """Figures (2, 3) with perfect direct light and of Cycles alone with about so many samples, both denoised."""
        samples = round(2.0 ** (round(4.0 * np.log2(samples)) / 4.0))  # a few numbers only, which the cache will have
        path = self.cache / f"room_{self.true_samples}_{samples}_{seed}.json"
        if not path.exists():
            channels, _ = self.cycles(seed, samples, "passes")
            whole = read_layer(channels, "Combined", "RGB").astype(float)
            guides = [read_layer(channels, *guide) for guide in (ALBEDO, NORMAL)]
            with open_denoiser(denoiser_libraries(), cores()) as denoiser:
                rest, whole = denoiser.all_denoised([whole - direct_light(channels), whole], *guides)
            pairs = [rest + direct for direct in self.direct], [whole, whole]
            path.write_text(json.dumps([figures(pair, self.halves).tolist() for pair in pairs]))
        return np.array(json.loads(path.read_text()))

    def ours(self, seed: int, more) -> tuple[np.ndarray, float, dict]:
        """The figures of `ltsh render` with `more` options, its processor seconds and its report."""
        with tempfile.TemporaryDirectory() as folder:
            size = "x".join(map(str, self.size))
            options = ("--resolution", size, "--quiet", *more)
            seconds = measure.run("-m", "ltsh_addon", "render", self.blend(seed), "-o", folder, *options).processor
            image = read_layer(read_channels(Path(folder) / "render.exr"), COMBINED, "RGB").astype(float)
            report = json.loads((Path(folder) / "report.json").read_text())
        return figures((image, image), self.halves), seconds, report


def direct_light(channels: dict) -> np.ndarray:
    """Diffuse and glossy direct light (H, W, 3) of Cycles' passes."""

    def one(names):
        name = next(name for name in names if any(f"{name}.R" in key for key in channels))
        return read_layer(channels, name, "RGB").astype(float)

    return sum(one(light) * one(color) for light, color in DIRECT)


def compare(scene: Scene, amount: str, seeds: int, more) -> np.ndarray:
    """Print the lines of a scene with `more` options, which say the `amount`; ratio, room and goal (3, 3)."""
    ours = [scene.ours(seed, more) for seed in range(seeds)]
    theirs = [scene.by_cycles(seed, seconds) for seed, (_, seconds, _) in enumerate(ours)]
    rooms = np.median([scene.room(seed, one[2]) for seed, one in enumerate(theirs)], axis=0)
    report = ours[0][2]
    kind = "held out" if scene.name in HELD_OUT else "tuned"
    points = 0 if report["finished"]["all_by_cycles"] else report["sub_samples"]
    labels = f"LTSH {points} + {report['cycles_samples']}", f"Cycles {theirs[0][2]}"
    medians = [np.median([one[0] for one in runs], axis=0) for runs in (ours, theirs)]
    took = [np.median([one[1] for one in runs]) for runs in (ours, theirs)]
    for row, label in enumerate(labels):
        start = f"{scene.name:<10}{kind:<9}{amount:>6}" if row == 0 else " " * 25
        first, second, flip = medians[row]
        print(f"{start}  {label:<16}{took[row]:>7.1f} s{100 * first:>10.2f} %{100 * second:>10.2f} %{flip:>12.4f}")
    # An error that drowns in the noise of the truth is 0.
    ratio, room = (first / np.maximum(second, 1e-9) for first, second in (medians, rooms))
    table = np.array([ratio, room, np.sqrt(room)])
    for label, values in zip(("ratio", "room", "goal"), table, strict=True):
        print(f"{'':<27}{label:<25}" + "".join(f"{value:>12.2f}" for value in values))
    sys.stdout.flush()
    return table


def main(arguments=()) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=TUNED + HELD_OUT, metavar="NAME", help="or: tuned, held-out")
    parser.add_argument("--budgets", nargs="*", type=float, default=[8.0, 30.0], metavar="S")
    parser.add_argument("--samples", nargs="+", type=int, default=[], metavar="N")
    parser.add_argument("--seeds", type=int, default=3, metavar="N")
    parser.add_argument("--true-samples", type=int, default=4096, metavar="N")
    parser.add_argument("--size", default="240x135", metavar="WxH")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "ltsh_truth", metavar="FOLDER")
    parser.add_argument("--options", default="", help="further options of render, such as '--techniques ltc'")
    options = parser.parse_args(arguments)
    names = {"tuned": TUNED, "held-out": HELD_OUT}.get(options.scenes[0], options.scenes)
    size = tuple(map(int, options.size.split("x")))
    print(
        f"finished pictures of {options.size}, load {os.getloadavg()[0]:.1f}, truth of {options.true_samples} samples"
    )
    print(
        f"{'scene':<19}{'budget':>6}  {'points + samples':<16}{'processor':>9}"
        + "".join(f"{one:>12}" for one in FIGURES)
    )
    amounts = {f"{one:g} s": ("--budget", one) for one in options.budgets}
    amounts |= {str(one): ("--cycles-samples", one) for one in options.samples}
    tables = {}
    for name in names:
        scene = Scene(name, options.cache, size, options.true_samples)
        scene.find_truth()
        for amount, more in amounts.items():
            tables[name, amount] = compare(scene, amount, options.seeds, (*more, *options.options.split()))
    for amount in amounts:
        middle = np.median([table for (_, one), table in tables.items() if one == amount], axis=0)
        words = zip(("ratio", "room", "goal"), middle, strict=True)
        print(
            f"median, {amount}: " + "; ".join(f"{label} " + ", ".join(f"{v:.2f}" for v in row) for label, row in words)
        )


if __name__ == "__main__":
    main(sys.argv[1:])
