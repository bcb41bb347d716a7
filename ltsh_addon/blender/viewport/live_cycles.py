"""Worlds and lights with nodes as Cycles sees them: a second Blender looks at them while views go on."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ...cycles.environment import CUBE, SkyPicture
from ...files import save_array, temporary_folder
from ...scene import Cancelled, Light, SceneError, error_line
from ..lights.emission import ObjectFacts, nodes_as_text, open_studio, trees_of
from ..lights.textures import NodeEmission, NodeLight, node_emission, state_of
from ..lights.world import background_pictures, light_of_world, light_pictures
from ..materials.graph import images_behind, tree_in_use
from ..process import view
from ..process.view import NODE_LIGHTS, NodeLightFile, NodeLightJob, WorldJob
from ..render_settings import working_space
from .light_texels import BACKGROUND_SIZE, ShownSky, coarse, unfolded, varied_sky
from .mirror import NOT_RESOLVED, NOT_YET


@dataclass
class _LightsJob:
    """The work of a second Blender that renders the nodes of lights."""

    states: dict[tuple, tuple]  # states by key of the lights without results so far
    results: list[tuple[tuple, NodeEmission]] = field(default_factory=list)  # with the keys of their lights
    error: str = ""
    is_stopped: bool = False
    thread: threading.Thread | None = None


class LiveNodeLights:
    """The nodes of lights as Cycles sees them, for all windows.

    A second Blender looks at new and changed lights while the views go on. Lights are identified by the `key` of
    `NodeLight`.
    """

    def __init__(self):
        self._known: dict[tuple, tuple[tuple, NodeEmission | str]] = {}  # state of a light's nodes, and the result
        self._wanted: dict[tuple, tuple] = {}  # states of lights to look at
        self._sources: dict[tuple, NodeLight] = {}  # the lights of these states
        self._changed, self._images = 0.0, 0  # time of the last change; counts changes of images
        self._job: _LightsJob | None = None

    def pattern(self, data, source: NodeLight) -> NodeEmission | str:
        """The last result for a light, or a note that there is none yet. Requests a new look if the light changed."""
        key, state = source.key, state_of(data, source, self._images)
        known, result = self._known.get(key, ((), NOT_YET))
        on_its_way = self._wanted.get(key) or (self._job.states.get(key) if self._job is not None else None)
        if known == state:
            self._wanted.pop(key, None)
        elif on_its_way != state:
            self._wanted[key], self._sources[key], self._changed = state, source, time.monotonic()
        return result

    def note_images(self) -> None:
        """Images have changed: look at lights with images again."""
        self._images += 1

    @property
    def is_busy(self) -> bool:
        """True while results are to come."""
        return bool(self._wanted) or self._job is not None

    def stop(self) -> None:
        """Drop all requests: nobody waits for results any more."""
        self._wanted.clear()
        if self._job is not None:
            self._job.is_stopped, self._job = True, None

    def step(self, frame: int) -> bool:
        """Do the next step, in the main thread; True if there is news."""
        job = self._job
        if job is None:
            return bool(self._wanted) and time.monotonic() - self._changed > REST_SECONDS and self._begin(frame)
        has_ended = not job.thread.is_alive()
        news = bool(job.results)
        while job.results:
            key, result = job.results.pop(0)
            self._known[key] = job.states.pop(key), result
        if has_ended:
            self._job = None
            for key, state in job.states.items():
                if job.error:
                    self._known[key] = state, job.error
                else:
                    self._wanted.setdefault(key, state)
            news |= bool(job.error)
        # Stop if a light has changed again since.
        job.is_stopped |= any(key in job.states for key in self._wanted)
        return news

    def _begin(self, frame: int) -> bool:
        """Start a second Blender; True if that failed, which is news."""
        present = {light.session_uid: light for light in bpy.data.lights}
        self._known = {key: known for key, known in self._known.items() if key[0] in present}
        job = _LightsJob({key: state for key, state in self._wanted.items() if key[0] in present})
        self._wanted.clear()
        if not job.states:
            return False
        keys = list(job.states)
        lights = [present[key[0]] for key in keys]

        def take(number: int, factor: np.ndarray, traits: list[float]) -> bool:
            job.results.append((keys[number], NodeEmission(factor, *traits)))
            return not job.is_stopped

        def work(folder: Path, paths: list[Path]) -> None:
            files = [
                NodeLightFile(str(path), name, source.matrix.tolist(), source.flags, vars(source.facts))
                for path, name, source in zip(paths, names, sources, strict=True)
            ]
            try:
                view.render_node_lights(files, frame, folder, take)
            except Cancelled:
                pass
            except Exception as error:
                job.error = f"{NOT_RESOLVED}: {error_line(error)}"

        names, sources = [light.name for light in lights], [self._sources[key] for key in keys]
        try:
            job.thread = _start("lamps", lights, work)
        except (OSError, RuntimeError) as error:
            self._known.update({key: (job.states[key], f"{NOT_RESOLVED}: {error_line(error)}") for key in keys})
            return True
        self._job = job
        return False


# REST_SECONDS: how long worlds and lights must stay unchanged before Cycles looks at them.
REST_SECONDS = 0.3


def _start(name: str, blocks: list, work: Callable[[Path, list[Path]], None]) -> threading.Thread:
    """A thread that runs `work(folder, paths)` with a temporary folder, and the .blend to load each of `blocks` from.

    Linked data-blocks are in their library. Raises OSError and RuntimeError where the others cannot be written.
    """
    stack = ExitStack()
    with stack:
        folder = stack.enter_context(temporary_folder())
        path, local = folder / f"{name}.blend", {block for block in blocks if block.library is None}
        bpy.data.libraries.write(str(path), local, path_remap="ABSOLUTE", fake_user=True)
        paths = [path if block in local else Path(bpy.path.abspath(block.library.filepath)) for block in blocks]
        stack = stack.pop_all()

    def run() -> None:
        with stack:
            work(folder, paths)

    thread = threading.Thread(target=run, name=f"LTSH {name}", daemon=True)
    thread.start()
    return thread


class _WorldLook:
    """A world as Cycles sees it, for all views that show it: a second Blender renders it while the views go on."""

    def __init__(self, name: str):
        self.name, self.users, self.stopped = name, 0, threading.Event()
        self.state: tuple | None = None  # `_state_of_world` that it has looked at; None: not known
        # The sky that was found (None after errors) and notes about it; None: it was not looked at yet.
        self.outcome: tuple[ShownSky | None, list[str]] | None = None
        self.sky: ShownSky | None = None  # the last one that was found
        self.changed: float | None = None  # time of the last request that no work has begun for
        self.thread: threading.Thread | None = None
        self._result: tuple[ShownSky, list[str]] | Exception | None = None

    @property
    def is_final(self) -> bool:
        """True if the sky of its `state` was found, and no other is wanted."""
        was_found = self.outcome is not None and self.outcome[0] is not None
        return self.state is not None and was_found and self.changed is None and self.thread is None

    def step(self, frame: int) -> None:
        """Do the next step, in the main thread."""
        if self.thread is None:
            if self.changed is not None and time.monotonic() - self.changed > REST_SECONDS:
                self._begin(frame)
        elif not self.thread.is_alive():
            self.thread, result = None, self._result
            if isinstance(result, Exception):
                self.outcome = None, [f"{self.name}: {error_line(result)}"]
            elif self.changed is None:  # else it has changed again
                self.outcome, self.sky = result, result[0]

    def _begin(self, frame: int) -> None:
        self.changed = None
        world = next((one for one in bpy.data.worlds if one.name_full == self.name), None)
        if world is None:
            return
        name, like, stopped, self.state = world.name, light_of_world(world), self.stopped, _state_of_world(world)

        def work(folder: Path, paths: list[Path]) -> None:
            try:
                result = view.render_world(WorldJob(paths[0], name, frame), folder, lambda *_: not stopped.is_set())
                light = [SkyPicture(*axes, one) for axes, one in zip(CUBE, result.light, strict=False)]
                self._result = varied_sky(like, light, result.lights, result.background), result.warnings
            except Exception as error:
                self._result = error

        self.thread = _start("world", [world], work)


# By the full name of the world; those that no view shows any more stay, until their world has changed.
_world_looks: dict[str, _WorldLook] = {}


def _state_of_world(world) -> tuple | None:
    """All that a look at a world depends on; None where that cannot be told, as of images that are painted.

    Files are told by their dates: to read them, as `extract.dependencies` does, would hold up the window.
    """
    if any(getattr(node, "filepath", "") for tree in trees_of([world]) for node in tree.nodes):
        return None  # an IES texture or a script
    files = []
    for image in images_behind(world):
        path = Path(image.filepath_from_user())
        if image.source != "FILE" or image.packed_file is not None or image.is_dirty or not path.is_file():
            return None
        files.append((str(path), path.stat().st_mtime_ns, image.colorspace_settings.name, image.alpha_mode))
    sees, names = world.cycles_visibility, ("camera", "diffuse", "glossy", "transmission", "scatter")
    traits = tuple(world.color), world.lightgroup, *(getattr(sees, name) for name in names)
    return working_space()["name"], tree_in_use(world) is not None, nodes_as_text(world), files, *traits


class LiveWorld:
    """The world of a view as Cycles sees it. Views of one world share what Cycles has found out."""

    def __init__(self):
        self._look: _WorldLook | None = None
        self._taken: tuple | None = None

    def stop(self) -> None:
        """Nobody waits for the world any more: cancel the work, if no other view has this world."""
        look, self._look = self._look, None
        if look is not None:
            look.users -= 1
            if not look.users:
                look.stopped.set()
                if not look.is_final:
                    _world_looks.pop(look.name, None)

    def look(self, world) -> ShownSky | None:
        """Request a look at a new or changed `world`. Returns its last result; None where there is none."""
        is_other = self._look is None or self._look.name != world.name_full
        if is_other:
            self.stop()
            look = _world_looks.get(world.name_full)
            # Other views of this world know its changes; after a while without any it may have changed.
            if look is None or not look.users and look.state != _state_of_world(world.original):
                look = _world_looks[world.name_full] = _WorldLook(world.name_full)
                look.changed = time.monotonic()
            look.users += 1
            look.stopped.clear()
            self._look = look
        else:
            self._look.changed = time.monotonic()
        return self._look.sky

    @property
    def is_busy(self) -> bool:
        """True while a result is to come."""
        look = self._look
        has_work = look is not None and (look.changed is not None or look.thread is not None)
        return has_work or (look is not None and look.outcome is not self._taken)

    def step(self, frame: int) -> tuple[ShownSky | None, list[str]] | None:
        """Do the next step, in the main thread. Returns the sky that was found and notes about it; None: no news."""
        if self._look is not None:
            self._look.step(frame)
        before, self._taken = self._taken, None if self._look is None else self._look.outcome
        return None if self._taken is before else self._taken


def rendered_world(scene, world, warn: Callable) -> tuple[list[SkyPicture], list[Light], np.ndarray]:
    """The `world` as Cycles renders it: pictures of its light ([] where it is dark), the small bright lights in it, and
    its background (N, N, 3). `scene` is left as it was."""
    like, light, lights = light_of_world(world), [], []
    if like is not None:
        light, lights = light_pictures(scene, world, like, warn)
    behind = background_pictures(scene, world, warn, light)
    background = unfolded(behind, min(2 * len(behind[0].radiance), BACKGROUND_SIZE))
    return [coarse(picture) for picture in light], lights, background


def render_world(job: WorldJob, folder: Path, progress) -> dict:
    """Do the `job`: writes pictures into `folder`, returns lights and warnings."""
    warnings: list[str] = []
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    with bpy.data.libraries.load(job.path) as (_, wanted):
        wanted.worlds = [job.world]
    (scene.world,) = wanted.worlds
    scene.frame_set(job.frame)
    light, lights, background = rendered_world(scene, scene.world, warnings.append)
    save_array(folder / "light.npy", np.array([picture.radiance for picture in light], np.float32))
    save_array(folder / "background.npy", background.astype(np.float32))
    return {"lights": [one.record() for one in lights], "warnings": warnings}


def render_node_lights(job: NodeLightJob, folder: Path, progress: Callable) -> dict:
    """Do the `job`: writes the factors of each light's nodes into `folder`."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, files = bpy.context.scene, [NodeLightFile(**fields) for fields in job.lights]
    scene.frame_set(job.frame)
    for number, file in enumerate(files):
        with bpy.data.libraries.load(file.path) as (there, wanted):
            if file.name not in there.lights:
                raise SceneError(f"{file.path}: has no light {file.name!r}")
            wanted.lights = [file.name]
        facts = ObjectFacts(**file.facts)
        source = NodeLight(wanted.lights[0], np.array(file.matrix), facts=facts, **file.flags)
        with open_studio(scene) as studio:
            pattern = node_emission(source, studio)
        save_array(folder / f"{number}.npy", pattern.factor.astype(np.float32))
        save_array(folder / f"{number}_traits.npy", np.array([pattern.lost, pattern.start, pattern.blurred]))
        progress(NODE_LIGHTS, (number + 1) / len(files))
    return {}
