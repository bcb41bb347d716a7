"""A child process that is none: `extract` answers with a small scene made here, so that no test needs Blender."""

from __future__ import annotations

import numpy as np

from ltsh_addon import cli, imaging, shading
from ltsh_addon.blender.process import finished, pixels
from ltsh_addon.imaging.color import to_srgb8
from ltsh_addon.pipeline import PictureOptions
from ltsh_addon.pipeline.tasks import BatchJob
from ltsh_addon.scene import Cancelled, Film, Light, QuadLight, SurfaceSamples
from ltsh_addon.visibility import OccluderMesh, Occluders

WIDTH, HEIGHT, SUB_SAMPLES = 6, 4, 2
# Of both halves of the Cycles image around the true one; the factor of A is 1 + NOISE, of B 1 - NOISE.
NOISE = 0.03
# What surfaces emit, and the background with its alpha.
EMISSION, BACKGROUND = 0.25, np.array([0.1, 0.2, 0.3, 0.75])
WARNING = "material 'Glass': transmission is not shaded"


def run(capsys, *arguments, **options):
    """Exit code, stdout and stderr of a command line; bpy tells on stdout that a test saved a scene before."""
    capsys.readouterr()
    code = cli.main([str(argument) for argument in arguments], **options)
    return code, *capsys.readouterr()


def film() -> Film:
    """The top row sees nothing, one pixel of the second row is half covered."""
    pixel = np.repeat(np.arange(WIDTH, WIDTH * HEIGHT), SUB_SAMPLES)
    return Film(WIDTH, HEIGHT, pixel[1:], SUB_SAMPLES)


def samples(count: int, seed: int = 4) -> SurfaceSamples:
    """Points of the plane z = 0; even ones are metals, odd ones dielectrics."""
    generator = np.random.default_rng(seed)
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    view = up + generator.uniform(-1.0, 1.0, (count, 3)) * (1.0, 1.0, 0.3)
    metal = (np.arange(count) % 2 == 0).astype(float)
    return SurfaceSamples(
        position=generator.uniform(-1.0, 1.0, (count, 3)) * (1.0, 1.0, 0.0),
        view=view / np.linalg.norm(view, axis=1, keepdims=True),
        normal=up,
        diffuse_normal=up,
        roughness=generator.uniform(0.2, 0.8, count),
        specular_f0=generator.uniform(0.5, 0.9, (count, 3)) * metal[:, None],
        specular_f90=np.tile(metal[:, None], 3),
        dielectric=1.0 - metal,
        ior=np.full(count, 1.5),
        diffuse_albedo=generator.uniform(0.1, 0.9, (count, 3)) * (1.0 - metal)[:, None],
    )


def lights(groups=("Key", "Fill.001", "")) -> tuple[Light, ...]:
    """One square light over the plane per group."""
    return tuple(
        QuadLight(
            name=f"Light {index}",
            shape="SQUARE",
            center=(0.7 * index - 0.7, 0.2 * index, 1.5),
            half_u=(0.4, 0.0, 0.0),
            half_v=(0.0, -0.4, 0.0),
            direction=(0.0, 0.0, -1.0),
            radiance=(3.0, 2.0 + index, 1.0),
            group=group,
        )
        for index, group in enumerate(groups)
    )


def halves(points, some_lights, some_film) -> dict[str, np.ndarray]:
    """Both halves of a Cycles image: the quadrature of the true BRDF, made brighter and darker by NOISE."""
    truth = shading.shade(points, some_lights, shading.REFERENCE, workers=1)
    reference = {}
    for name in shading.PASSES:
        image = some_film.image(getattr(truth, name).sum(axis=0))
        reference[name] = np.stack([(1.0 + NOISE) * image, (1.0 - NOISE) * image]).astype(np.float32)
    return reference


def wall(height: float, left: float = -9.0) -> Occluders:
    """A level rectangle from `left` to the right."""
    corners = [(left, -9.0, height), (9.0, -9.0, height), (9.0, 9.0, height), (left, 9.0, height)]
    mesh = OccluderMesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]))
    return Occluders((mesh,), np.zeros(1, int), np.eye(4)[None, :3])


class FakeChild:
    """Stands in for the second Blender; `asked` tells how `extract_pixels` was called."""

    def __init__(self, *, groups=("Key", "Fill.001", ""), empty=False, error=None, wall=None, change=None):
        self.groups, self.empty, self.error = groups, empty, error
        self.wall, self.change = wall, change  # an occluder (see `wall`), and what becomes of the lights
        self.asked: list[pixels.PixelJob] = []

    def install(self, monkeypatch) -> FakeChild:
        monkeypatch.setattr(pixels, "extract_pixels", self.extract)
        monkeypatch.setattr(finished, "show_finished", self.show_finished)
        return self

    def show_finished(self, scene, scene_name, frame, folder, name, *, progress=None):
        picture = np.load(folder / finished.PICTURE)
        imaging.write_png(folder / name, to_srgb8(picture[..., :3]))

    def extract(self, options, *, progress=None, look=None):
        self.asked.append(options)
        if self.error is not None:
            raise self.error
        some_film = Film(WIDTH, HEIGHT, np.zeros(0, dtype=np.int64)) if self.empty else film()
        points, some_lights = samples(len(some_film.pixel)), lights(self.groups)
        some_lights = some_lights if self.change is None else self.change(some_lights)
        for stage in ("samples", "Cycles A", "Cycles B"):
            if progress is not None and progress(stage, 1.0) is False:
                raise Cancelled(f"cancelled at {stage}")
        picture = pixels.PictureFacts(
            options.frame if options.frame is not None else 7, options.camera or "Camera", "5.2.3"
        )
        cycles = pixels.CyclesPasses(
            halves(points, some_lights, some_film) if options.cycles_samples else None,
            np.full((HEIGHT, WIDTH, 3), EMISSION) if options.rest else None,
            np.full((HEIGHT, WIDTH, 4), BACKGROUND) if options.rest else None,
        )
        return pixels.Extraction(
            lights=some_lights,
            samples=points,
            film=some_film,
            warnings=("camera 'Camera' sees no surface that can be shaded",) if self.empty else (WARNING,),
            picture=picture,
            cycles=cycles,
            times=pixels.ExtractionTimes({"start": 0.1, "samples": 0.2, "cycles": 0.3}),
            occluders=self.wall if options.shadows == "on" else None,
        )


def small_job(room, output, command="shade", **changes) -> BatchJob:
    """A job of one technique and one pass."""
    options = PictureOptions(room, output, techniques=("ltc",), passes=("diffuse",), cycles_samples=4)
    return BatchJob(command, options, **{"scenes": (room,), **changes})
