"""Lights of a finished picture that have moved: `MovedLights` shades them where they are, by their own rays alone."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cycles.gbuffer import with_one_shadow
from ..files import temporary_folder
from ..scene import AreaLight
from ..visibility import BLOCK_SAMPLES, Company, Occluders, Setting, task_of_light
from . import picture
from .lighting import KEPT_SUFFIX, OCCLUDERS_SUFFIX, KeptPicture, rays_of_samples
from .mixer import Row, bounced_light

# So many, that all processes take about as long; with fewer samples a block costs more than they do.
BLOCKS, FEWEST_OF_BLOCK = 16, 1 << 11


class MovedLights:
    """Pictures of lights of a kept picture where they are now, by their own rays and lobes alone.

    With the first of them processes start that keep the samples, so that others take half a second; `close` ends them.
    Threads may share it.
    """

    def __init__(self, read: Callable[[], tuple[KeptPicture, Occluders | None]]):
        """`read` is called when the first picture is asked for, which raises what it raises."""
        self._read, self._kept, self._occluders = read, None, None
        self._company, self._ending = None, ExitStack()
        # Also for who forgets to, and where Python ends.
        weakref.finalize(self, self._ending.close)
        self._lock, self._is_ready = threading.Lock(), False

    @classmethod
    def load(cls, path: Path) -> MovedLights:
        """Those of the picture that kept its samples in `path`: OSError and ValueError where that cannot be read."""

        def read():
            kept, occluders = KeptPicture.load(path), None
            if kept.shadows is not None:
                occluders = Occluders.load(path.with_name(path.name.removesuffix(KEPT_SUFFIX) + OCCLUDERS_SUFFIX))
            return kept, occluders

        return cls(read)

    def get_ready(self, light: AreaLight) -> None:
        """Begin, once and in a thread, with what the first picture takes; `light` is any of those that there are."""
        if not self._is_ready:
            self._is_ready = True
            threading.Thread(target=self._try, args=(light,), name="LTSH lights", daemon=True).start()

    def _try(self, light: AreaLight) -> None:
        with suppress(Exception):  # who asks for a picture gets to know
            self.picture(light)

    def picture(self, light: AreaLight, row: Row | None = None) -> np.ndarray:
        """The picture (H, W, 3) of one light, with what the `row` of it bounced before. Raises SceneError."""
        with self._lock:
            return self._picture(light, row)

    def _picture(self, light: AreaLight, row: Row | None) -> np.ndarray:
        if self._company is None:
            self._start()
        kept, film, task = self._kept, self._kept.extraction.film, None
        light = light.moved(-kept.extraction.origin)
        if self._tracer is not None:
            rays = rays_of_samples(kept.options["shadow_rays"], film)
            task = task_of_light(self._starting, light, self._tracer, kept.options["passes"], rays)
        found = self._company.lit(light, task)
        image = np.zeros((film.height, film.width, 3), np.float32)
        for name in kept.options["passes"]:
            own = np.zeros((len(film.pixel), 3), np.float32)
            own[self._order] = np.concatenate([radiance[name] for radiance in found])
            image += kept.shown(name, moved=True) * film.image(kept.extraction.exposure * own)
        return image if row is None else image + bounced_light(kept, row)

    def close(self) -> None:
        """End the processes; the next light starts others."""
        with self._lock:
            self._company = None
            self._ending.close()

    def _start(self) -> None:
        from ..blender.process.blender_rays import open_rays

        if self._kept is None:
            self._kept, self._occluders = self._read()
        kept, film = self._kept, self._kept.extraction.film
        samples = kept.extraction.samples
        samples = replace(samples, position=samples.position - kept.extraction.origin)
        starting, place = samples, np.arange(len(samples))
        if film.count is not None:
            starting, film, place = with_one_shadow(samples, film)
        self._starting, self._order = starting, np.argsort(place, kind="stable")
        # Which samples are neighbors is all that rays ask of their film.
        film, blocks = film.unspread(), []
        size = min(BLOCK_SAMPLES, max(len(starting) // BLOCKS, FEWEST_OF_BLOCK))
        for first in range(0, max(len(starting), 1), size):
            begin, end = np.searchsorted(place[self._order], (first, first + size))
            own, part = self._order[begin:end], slice(first, first + size)
            blocks.append((samples.take(own), starting.take(part), film.take(part), place[own] - first))
        (table,) = picture.load_tables((kept.technique,)).values()
        with ExitStack() as stack:
            self._tracer = None
            if self._occluders is not None:
                folder = stack.enter_context(temporary_folder())
                self._tracer = stack.enter_context(open_rays(self._occluders, folder, lambda warning: None))
            self._company = Company(Setting(tuple(blocks), table, tuple(kept.options["passes"])), self._tracer)
            stack.callback(self._company.close)
            self._ending.callback(stack.pop_all().close)
