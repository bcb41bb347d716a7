"""Results as images of Blender: each picture of a job is a float image, loaded from its own EXR."""

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import bpy
import numpy as np

from ...imaging.report import index_stamp, read_index
from ...pipeline.display_layers import FILES
from ...pipeline.mixer import LightPictures, Mixer, MixerRow, mixer_file, moved_light
from ...pipeline.relight import OCCLUDERS_SUFFIX, RELIGHT_SUFFIX, RelightData, tint
from ...scene import Light, SceneError, SurfaceSamples
from ...visibility import Occluders
from ..evaluated import image_pixels

LAYER, SCENE = "ltsh_layer", "ltsh_scene"  # custom properties that mark our images
PREFIX = "LTSH "
ERROR = "error_"


@dataclass(frozen=True)
class Result:
    """The contents of a folder of pictures, written by `display_layers.write`."""

    folder: Path
    command: str  # that made them: shade, compare or bake
    partial: str  # what these pictures lack that their job adds later; "": nothing
    report: dict  # of the command
    groups: dict  # groups of pictures: of baked textures by the stem of their files, of the camera's picture by ""

    def group(self, name: str) -> tuple[str, dict]:
        """Name and contents of the group `name`; of the first group if there is no such one."""
        return (name, self.groups[name]) if name in self.groups else next(iter(self.groups.items()))


# Modes that need no second picture.
OF_ONE_PICTURE = "A", "MIX"


@dataclass(frozen=True)
class Choice:
    """The pictures to look at and how, as far as the result has them; `first` and `second` may be the same."""

    group: str
    first: str
    second: str
    pass_name: str
    mode: str


# The job that runs now, or None (see `operators.running_job`); the session uid of the scene that was baked last, with
# the states of its objects by name; True while this module sets values of the mixer; the
# `Update` that shades moved lights now, or None.
state: dict = {"job": None, "baked": (0, {}), "is_silent": False, "update": None}
_read: dict[str, tuple[tuple, Result]] = {}
_pixels: dict[str, tuple[tuple, np.ndarray]] = {}
PIXELS_KEPT = 8


def scene_of(uid: int):
    """The scene with this session uid, even if it was renamed; None if it was removed."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)


def result_of(scene) -> Result | None:
    """The results of `scene`; None if there are none or their folder is gone. Files are read once."""
    return result_in(scene.ltsh.result_folder) if scene.ltsh.result_folder else None


def lacks(result: Result) -> str:
    """What the pictures lack while the job runs that adds it; "": nothing, or they stay as they are."""
    job = state["job"]
    return result.partial if job is not None and result.folder in map(Path, job.results) else ""


def folder_of(scene, command: str, current: Path) -> Path:
    """The folder of the last results of `command`, wherever the file was saved since; `current` if it is gone."""
    last = scene.ltsh.last_results.get(command)
    return current if last is None or result_in(last.folder) is None else Path(bpy.path.abspath(last.folder))


def result_in(folder: str) -> Result | None:
    """The results in a folder, given as a path of Blender; None if there are none."""
    path = Path(bpy.path.abspath(folder))
    try:
        stamp = index_stamp(path)
        known = _read.get(str(path))
        if known is None or known[0] != stamp:
            known = stamp, Result(path, **read_index(path))
            _read[str(path)] = known
        return known[1]
    except (OSError, ValueError, TypeError):
        return None


def choice_of(settings, result: Result) -> Choice:
    """The choice in `settings` (Scene.ltsh), with other pictures in place of those that the result lacks."""
    name, group = result.group(settings.group)
    names, passes = group["names"], group["passes"]
    first = settings.first if settings.first in names else names[0]
    # A picture is never compared with itself, as long as there is another one.
    others = [name for name in names if name != first] or [first]
    second = settings.second if settings.second in others else others[-1]
    pass_name = settings.pass_name if settings.pass_name in passes else passes[-1]
    mode = settings.mode if settings.mode != "MIX" or has_mixer(settings.id_data, result) else settings.mode_before_mix
    # A picture alone is not compared.
    mode = mode if len(names) > 1 or mode in OF_ONE_PICTURE else "A"
    return Choice(name, first, second, pass_name, mode)


def show(scene, folder: Path) -> None:
    """Make the pictures in `folder` the results of `scene`, with images for the chosen pass."""
    before, scene.ltsh.result_folder = scene.ltsh.result_folder, blender_path(folder)
    _pixels.clear()
    forget_renders()
    result = result_of(scene)
    if result is None:
        return
    settings = scene.ltsh
    last = settings.last_results.get(result.command) or settings.last_results.add()
    last.name, last.folder = result.command, settings.result_folder
    if before != settings.result_folder or not has_mixer(scene, result):
        leave_mix(settings)
    settings.groups.clear()
    for name in result.groups:
        settings.groups.add().name = name
    choice = choice_of(settings, result)
    # By these names no update function is called.
    settings["group"] = choice.group
    wanted = {_full(name, layer) for name, group in result.groups.items() for layer in group["files"]}
    for image in [image for image in our_images(scene) if image[LAYER] not in wanted and image[LAYER]]:
        bpy.data.images.remove(image)
    images_of_pass(scene, result, choice)
    for image in our_images(scene):
        if image[LAYER]:
            image.reload()
    _take_rows(scene)


def images_of_pass(scene, result: Result, choice: Choice) -> None:
    """Load all pictures of the chosen pass as images."""
    files = result.group(choice.group)[1]["files"]
    for layer in files:
        if layer.rpartition(".")[2] == choice.pass_name:
            layer_image(scene, result, choice.group, layer)


def layer_image(scene, result: Result, group: str, layer: str):
    """The image of a layer, loaded if needed."""
    path = result.folder / result.groups[group]["files"][layer]
    full = _full(group, layer)
    image = next((image for image in our_images(scene) if image[LAYER] == full), None)
    if image is None:
        image = bpy.data.images.load(str(path), check_existing=False)
        image.name = PREFIX + full
        # Without users, files do not keep it: it is read again from the results.
        image[LAYER], image[SCENE] = full, scene.name
    is_error = layer.startswith(ERROR)
    _set(image, "filepath", blender_path(path))
    _set(image.colorspace_settings, "name", "Non-Color" if is_error else linear_space())
    _set(image, "use_view_as_render", not is_error)
    return image


def _set(owner, name: str, value) -> None:
    """Set a property if its value differs: Blender reads the whole file again even for the same path."""
    if getattr(owner, name) != value:
        setattr(owner, name, value)


def our_images(scene) -> list:
    """Images that show results of `scene`."""
    return [image for image in bpy.data.images if belongs(image, scene)]


def belongs(image, scene) -> bool:
    """True for an image of `scene`. An image whose scene was renamed or removed belongs to all scenes."""
    name = image.get(SCENE)
    return LAYER in image and name is not None and (name == scene.name or name not in bpy.data.scenes)


def pixels_of(image) -> np.ndarray:
    """Pixels (H, W, 4) float32 of an image, row 0 at the bottom; empty if they cannot be read.

    Those of the last few images are cached.
    """
    path = bpy.path.abspath(image.filepath)
    try:
        stamp = Path(path).stat().st_mtime_ns, tuple(image.size)
    except OSError:
        return np.empty((0, 0, 4), np.float32)
    known = _pixels.get(path)
    if known is None or known[0] != stamp:
        pixels = image_pixels(image)
        known = (Path(path).stat().st_mtime_ns, tuple(image.size)), pixels
        while len(_pixels) >= PIXELS_KEPT:
            _pixels.pop(next(iter(_pixels)))
        _pixels[path] = known
    return known[1]


def is_read(image) -> bool:
    """True if the pixels of an image are cached, so that its file need not be read."""
    path = bpy.path.abspath(image.filepath)
    try:
        return path in _pixels and _pixels[path][0][0] == Path(path).stat().st_mtime_ns
    except OSError:
        return False


def linear_space() -> str:
    """Name of the open file's scene-linear color space, in which pixels are stored unchanged."""
    spaces = bpy.types.ColorManagedInputColorspaceSettings.bl_rna.properties["name"].enum_items.keys()
    wanted = bpy.data.colorspace.working_space if bpy.app.version >= (5, 0, 0) else "Linear Rec.709"
    return next((name for name in (wanted, "Linear Rec.709", "Linear") if name in spaces), "Non-Color")


def _full(group: str, layer: str) -> str:
    return f"{group} {layer}".strip()


def blender_path(path, blend: str = "") -> str:
    """`path` relative to the .blend (the open one, or `blend`) if possible, so that both can move together."""
    blend = blend or bpy.data.filepath
    if not blend:
        return str(path)
    try:
        return bpy.path.relpath(str(path), start=str(Path(blend).parent))
    except ValueError:  # another drive of Windows
        return str(path)


def leave_mix(settings) -> None:
    """Show the pictures again as before the light mixer."""
    if settings.mode == "MIX":
        settings["mode"] = settings.bl_rna.properties["mode"].enum_items[settings.mode_before_mix].value


# The light mixer:

# The mixer of the picture that was asked for last, and its samples and occluders once a light has moved.
_mixer: dict = {"stamp": None, "mixer": None, "moved": None}
# Mixers that threads read, by the stamp of their file.
_readings: dict[tuple, Future] = {}
# Mixers and samples of final renders by the name of their scene, while nothing else is shown. They are in no file.
_rendered: dict[str, tuple[Mixer, RelightData | None]] = {}
MOST_BYTES = 1 << 31  # final renders with larger samples do not keep them for moved lights


def has_mixer(scene, result: Result) -> bool:
    """True if `mixer_of` has a mixer, without reading it."""
    return scene.name in _rendered or _mixer_path(scene.ltsh, result).exists()


def _mixer_path(settings, result: Result) -> Path:
    """The file of the mixer of the chosen group of `result`."""
    return result.folder / mixer_file(result.group(settings.group)[0])


def mixer_of(scene) -> Mixer | None:
    """The light mixer of the results of `scene`; None if they have no pictures of the lights."""
    if scene.name in _rendered:
        return _rendered[scene.name][0]
    result = result_of(scene)
    if result is None:
        return None
    path = _mixer_path(scene.ltsh, result)
    try:
        stamp = str(path), path.stat().st_mtime_ns
        if _mixer["stamp"] != stamp:
            _mixer.update(stamp=stamp, mixer=None, moved=None)
            reading = _readings.pop(stamp, None)
            _readings.clear()
            _mixer["mixer"] = Mixer(LightPictures.load(path)) if reading is None else reading.result()
    except (OSError, ValueError):
        _mixer.update(stamp=None, mixer=None, moved=None)
    return _mixer["mixer"]


# The property of images that were painted on a picture of direct light.
DIRECT_ONLY = "ltsh_direct_only"


def reason_without_target(scene) -> str:
    """Why nothing can be matched in `scene`; "" if it has a target."""
    return "Choose a target, or paint one" if scene.ltsh.match_target is None else ""


def is_direct_only(scene) -> bool:
    """True if the mixer of `scene` has a picture of direct light alone, without what Cycles adds."""
    if scene.name not in _rendered:
        return True
    data = _rendered[scene.name][1]
    return data is not None and not data.taken


def is_mixer_read(scene, folder: Path) -> bool:
    """True if `mixer_of` can return the mixer of the results in `folder` at once; else a thread begins to read it."""
    result = result_in(str(folder))
    if result is None:
        return True
    path = _mixer_path(scene.ltsh, result)
    try:
        stamp = str(path), path.stat().st_mtime_ns
    except OSError:
        return True
    if _mixer["stamp"] != stamp and stamp not in _readings:
        pool = ThreadPoolExecutor(1, "LTSH mixer")
        _readings[stamp] = pool.submit(lambda: Mixer(LightPictures.load(path)))
        pool.shutdown(wait=False)
    return _mixer["stamp"] == stamp or _readings[stamp].done()


def mix_render(scene, pictures: LightPictures, relight_data: RelightData) -> None:
    """Give the mixer of `scene` the lights of a final render, and the samples for lights that move."""
    forget_renders()
    size = sum(getattr(relight_data.extraction.samples, item.name).nbytes for item in fields(SurfaceSamples))
    _rendered[scene.name] = Mixer(pictures), relight_data if size <= MOST_BYTES else None
    # The picture shows the lights as they are in the scene.
    reset_mixer(scene)
    leave_mix(scene.ltsh)


def forget_renders() -> None:
    """Forget final renders, because another picture is shown, or a file is opened whose scenes may have these names."""
    if state["update"] is not None:
        state["update"].is_finished, state["update"] = True, None
    _rendered.clear()


class Update:
    """Shades lights of a scene's mixer that have moved, by the numbers of their rows.

    A thread shades them at their new places; `take` puts new pictures into the mixer.
    """

    def __init__(self, scene, moved: dict[int, Light]):
        self.mixer, self.moved, self.done = mixer_of(scene), moved, 0.0
        self.is_finished, self.error = False, None
        self._path = None if scene.name in _rendered else _mixer_path(scene.ltsh, result_of(scene))
        self._read, self._made = _reader(scene), queue.SimpleQueue()
        layers = self.mixer.pictures.layers
        self._before = {number: (self.mixer.rows[number], layers[number].copy()) for number in moved}
        threading.Thread(target=self._work, name="LTSH moved lights", daemon=True).start()

    def _work(self) -> None:
        error = None
        try:
            data, occluders = self._read()
            for position, (number, light) in enumerate(self.moved.items()):

                def report(share, position=position) -> bool:
                    self.done = (position + share) / len(self.moved)
                    return not self.is_finished

                self._made.put((number, moved_light(data, occluders, light, self._before[number][0], report)))
        except Exception as raised:
            error = raised
        self._made.put((None, error))

    def take(self) -> bool:
        """Put new pictures into the mixer, and at the end into its file; True if there were any, or all are done."""
        is_new = False
        while not self.is_finished and not self._made.empty():
            number, content = self._made.get()
            if number is None:
                self.is_finished, self.error = True, content
            else:
                row, is_new = replace(self._before[number][0], light=self.moved[number].record()), True
                self.mixer.replace(number, row, content)
        if self.error is not None:
            self._take_back()
        elif self.is_finished and self._path is not None:
            self._save()
        return is_new or self.is_finished

    def stop(self) -> None:
        """Make the thread end soon, and restore the lights in the mixer."""
        self.is_finished = True
        self._take_back()

    def _take_back(self) -> None:
        for number, (row, layer) in self._before.items():
            self.mixer.replace(number, row, layer)

    def _save(self) -> None:
        try:
            self.mixer.pictures.save(self._path)
            _mixer["stamp"] = str(self._path), self._path.stat().st_mtime_ns
        except OSError as error:
            self.error = error


def _reader(scene) -> Callable[[], tuple[RelightData, Occluders | None]]:
    """A function, to be called in a thread, that returns what is needed to shade moved lights of the picture."""
    if scene.name in _rendered:
        data = _rendered[scene.name][1]
        if data is None:
            raise SceneError("this final render has too many samples to keep them all: render again with fewer points")
        return lambda: (data, data.extraction.occluders)
    result = result_of(scene)
    path = (result.folder.parent / FILES[result.command]).with_suffix(RELIGHT_SUFFIX)

    def read():
        if _mixer["moved"] is None:
            data, occluders = RelightData.load(path), None
            if data.shadows is not None:
                occluders = Occluders.load(path.with_name(path.name.removesuffix(RELIGHT_SUFFIX) + OCCLUDERS_SUFFIX))
            _mixer["moved"] = data, occluders
        return _mixer["moved"]

    return read


def mixer_pairs(scene) -> list:
    """Each row of the mixer with its values in `scene` (an item of Scene.ltsh.mixed, or None)."""
    mixer, items = mixer_of(scene), {item.name: item for item in scene.ltsh.mixed}
    return [(row, items.get(row.name)) for row in (mixer.rows if mixer is not None else ())]


def mixed_pixels(scene) -> np.ndarray | None:
    """The picture (H, W, 4) as the mixer of `scene` sets the lights, row 0 at the bottom; None without a mixer."""
    mixer = mixer_of(scene)
    return None if mixer is None else mixer.mixed([_factor(scene, row, item) for row, item in mixer_pairs(scene)])


def mixed_texture(scene, result: Result, group: str) -> np.ndarray | None:
    """The baked texture `group` (H, W, 4) as the mixer shows it, row 0 on top; None where no mix is shown.

    Raises OSError, ValueError.
    """
    path = result.folder / mixer_file(group)
    if scene.ltsh.mode != "MIX" or not path.exists():
        return None
    mixer, items = Mixer(LightPictures.load(path)), {item.name: item for item in scene.ltsh.mixed}
    return mixer.mixed([_factor(scene, row, items.get(row.name)) for row in mixer.rows])[::-1]


def _factor(scene, row: MixerRow, item) -> np.ndarray:
    if item is None:
        return np.ones(3)
    if not is_on(scene, item):
        return np.zeros(3)
    return item.power * 2.0**item.exposure * tint_of(row, item)


def tint_of(row: MixerRow, item) -> np.ndarray:
    """Factors (3,) that give a row the color of the mixer."""
    # Blender stores colors in single precision.
    same = np.allclose(item.color, row.color, rtol=1e-6, atol=1e-6)
    return np.ones(3) if same else tint(np.array(row.color), item.color)


def is_on(scene, item) -> bool:
    """False for an item that is muted, or that is not solo while others are."""
    return not item.muted and (item.solo or not any(other.solo for other in scene.ltsh.mixed))


def is_neutral(row: MixerRow, item) -> bool:
    """True if power, exposure and color are as rendered."""
    return item.power == 1.0 and item.exposure == 0.0 and bool((tint_of(row, item) == 1.0).all())


def reset_mixer(scene) -> None:
    """Reset all lights to how they were rendered, and forget lights that are not in the picture."""
    scene.ltsh.mixed.clear()
    _take_rows(scene)


def _take_rows(scene) -> None:
    """Give each row of the mixer an item. Existing values stay, unless the light was changed in the scene since."""
    items, state["is_silent"] = scene.ltsh.mixed, True
    for row, item in mixer_pairs(scene):
        settings = next(iter(row.settings.values()), [0.0] * 5)
        if item is None:
            item = items.add()
            item.name = row.name
        elif np.allclose(item.settings, settings, rtol=1e-5):
            continue
        item.power, item.exposure, item.color, item.settings = 1.0, 0.0, row.color, settings
        item.muted = item.solo = item.applied = False
    state["is_silent"] = False


def set_factors(scene, factors: dict[str, np.ndarray]) -> None:
    """Give rows of the mixer, by name, `factors` (3,) of what was rendered; all others show what was rendered."""
    reset_mixer(scene)
    state["is_silent"] = True
    for row, item in mixer_pairs(scene):
        if row.name in factors:
            most = float(factors[row.name].max())
            item.power, item.color = most, np.array(row.color) * (factors[row.name] / most if most > 0.0 else 1.0)
    state["is_silent"] = False


def mix_label(scene) -> str:
    """The label below the mixed picture."""
    pairs = [(row, item) for row, item in mixer_pairs(scene) if item is not None]
    changed = sum(not is_on(scene, item) or not is_neutral(row, item) for row, item in pairs)
    return f"Mix: {changed} of {len(pairs)} changed" if pairs else "No lights were kept: shade again"
