"""Frames of a scene in motion (:py:mod:`mi_shlight.motion`), as pictures and as a video."""
from __future__ import annotations

import shutil
import subprocess
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .compare import colours
from .errors import StaleTransferWarning, check_integer, message
from .files import replacing
from .motion import load_motion
from .panel import srgb
from .rendering import check_view, render, sh_integrator
from .scene import keep_quiet, polygon_lights, shape_index

MAX_FRAMES = 100_000

VIDEO = "animation.mp4"

BAKE_CANDIDATES = 16
"""Number of frames among which the place to bake at is looked for."""

PLACES = ("to_world", "vertex_positions")
"""Parameters that put an object where it is: a transform, or the vertices of a mesh."""

SLACK = 1 + 1e-4
"""Rounding of vertices that are moved in single precision must not make a bake stale."""


def animate(scene, motion, frames: int, *, integrator=None, sensor=0, spp=0, seed=0, one_bake=True, progress=None):
    """Render the frames of a scene whose lights, or anything that `mi.traverse` exposes, move.

    All frames have the same seed: samples stay where they are on the film, so what does not move does not flicker. Everything
    is checked before this function returns. The scene is put back as it was after the last frame, or when the generator is closed.

    Parameters
    ----------
    scene : mitsuba.Scene
        Loaded with ``optimize=False`` while a JIT variant is active.
    motion : str, os.PathLike or dict
        A motion file or its content, see :py:mod:`mi_shlight.motion`.
    frames : int
        Number of frames, 1 to 100000.
    integrator : mitsuba.Integrator, optional
        The `shprt` to render with; by default the scene's own, or one with default parameters.
    sensor, spp, seed : int, optional
        As in :py:func:`mi_shlight.rendering.render`, for each frame.
    one_bake : bool, optional
        Shadowed transfer per vertex is valid while no light moves farther than ``light_margin``. True: take a copy of the integrator with
        as much margin as the motion needs, and bake at the frame from which the lights stray least, so that one bake serves all frames.
        A wide margin costs accuracy of shadows: visibility is then resolved in all of the lights' neighbourhood (in the scenes of this
        package mean errors grew from 3 % to 4 to 6 % for lights that cross the scene). False: keep the margin; the transfer is baked
        again for frames beyond it, with a warning beforehand.
    progress : callable, optional
        Called as ``progress(label, done, total)``; the label is ``bake`` or ``frames``.

    Returns
    -------
    generator of (int, numpy.ndarray)
        Number of the frame from 0, and its linear colours, shape (H, W, 3), float32.

    Raises
    ------
    FileNotFoundError, TypeError, ValueError
        The motion file is missing or wrong, or does not fit the scene; a number is out of range.
    """
    stage = Stage(scene, load_motion(motion), frames)
    check_view(scene, sensor, spp, seed)
    integrator = stage.integrator(sh_integrator(scene) if integrator is None else integrator, one_bake)
    return stage.render(integrator, sensor, spp, seed, progress)


class Stage:
    """A scene that can be put into any frame of a motion, and back.

    Raises ValueError or TypeError if the motion does not fit the scene.
    """

    def __init__(self, scene, motion, frames: int):
        self.scene = scene
        self.count = check_integer("animate", "frames", frames, 1, MAX_FRAMES)
        self._parameters = mi.traverse(scene)
        self._times = motion.times(self.count)
        self._initial, self._homes = {}, {}
        self._matrices = {}
        """Object -> its world transformation in each frame, (N, 4, 4), to be applied to where it is in the scene file."""
        self._values = {}
        """Parameter -> its value in each frame, (N, ...)."""
        self._bake_frame, self._changed = 0, set()
        keys = list(self._parameters.keys())
        self._places = {}
        for key in keys:
            owner, _, leaf = key.rpartition(".")
            if leaf in PLACES and owner:
                self._places[owner] = key
        for entry in motion.entries:
            (self._add_move if entry.kind == "move" else self._add_set)(entry, keys)
        self._shown = self._unmoved()

    def _unmoved(self) -> dict:
        """What is shown before any frame: object -> matrix, parameter -> value."""
        return {**dict.fromkeys(self._matrices, np.eye(4)), **{key: np.array(self._initial[key], dtype=float) for key in self._values}}

    def _add_move(self, entry, keys) -> None:
        for match, name in enumerate(entry.names(list(self._places))):
            if name not in self._homes:
                self._homes[name] = self._home(name)
            before = self._matrices.get(name, np.eye(4))
            centre = before[..., :3, :3] @ self._centre(name) + before[..., :3, 3]
            self._matrices[name] = entry.matrices(self._times, match, centre) @ before

    def _add_set(self, entry, keys) -> None:
        for match, key in enumerate(entry.names(keys)):
            here, initial = f"{entry.place}.set", self._remembered(key)
            if key.rpartition(".")[2] in PLACES:
                raise ValueError(message("animate", here, "name other parameters than places", key,
                                         f"Use \"move\": \"{key.rpartition('.')[0]}\"."))
            if self._parameters.flags(key) & mi.ParamFlags.ReadOnly:
                raise ValueError(message("animate", here, "name parameters that may be written", key))
            if not (isinstance(initial, float) or (dr.is_array_v(initial) and dr.is_float_v(initial) and not dr.is_matrix_v(initial))):
                raise TypeError(message("animate", here, "name parameters that are numbers, colours or vectors", key,
                                        f"It is of type {type(initial).__name__}."))
            if key in self._values:
                raise ValueError(message("animate", here, "name each parameter once in the file", key, "An earlier motion sets it."))
            ((quantity, values),) = entry.at(self._times, match).items()
            own = np.array(initial, dtype=float)
            if values.shape[1] not in (1, own.size):
                raise ValueError(message("animate", f"{entry.place}.keyframes", f"hold 1 or {own.size} numbers for '{key}'",
                                         values.shape[1]))
            values = values.reshape((-1, *own.shape)) if values.shape[1] == own.size else values.reshape((-1,) + (1,) * own.ndim)
            self._values[key] = values * own if quantity == "factor" else values + np.zeros_like(own)

    def _remembered(self, key):
        """A parameter as it is in the scene, before anything moves."""
        if key not in self._initial:
            value = self._parameters[key]
            self._initial[key] = type(value)(value)   # Mitsuba writes new values into the object that it hands out
        return self._initial[key]

    def _home(self, name) -> np.ndarray:
        """Where an object is before anything moves: its transform (4, 4), or its vertices (V, 3)."""
        value = dr.detach(self._remembered(self._places[name]))
        return np.array(value.matrix if self._turns(name) else value, dtype=float).reshape((4, 4) if self._turns(name) else (-1, 3))

    def _turns(self, name) -> bool:
        """True for objects that a transform places, False for meshes of vertices."""
        return self._places[name].endswith(".to_world")

    def _centre(self, name) -> np.ndarray:
        home = self._homes[name]
        if self._turns(name):
            return home[:3, 3]
        return (home.min(axis=0) + home.max(axis=0)) / 2 if len(home) else np.zeros(3)

    def _shape(self, name):
        """The shape that is called `name`, or None if that is a sensor or something else."""
        node = self._parameters.properties[self._places[name]][2]
        return node if isinstance(node, mi.Shape) else None

    # ---- one bake for all frames

    def integrator(self, integrator, one_bake: bool = True):
        """`integrator`, or a copy whose ``light_margin`` lets one bake serve all frames; a warning where the transfer is baked again."""
        settings = integrator.parameters()
        if settings["transfer"] != "shadowed" or settings["transfer_domain"] != "vertex":
            return integrator
        instead = "Or choose transfer_domain='pixel', which bakes nothing."
        casting = [name for name in self._matrices if (shape := self._shape(name)) is not None and not shape.is_emitter()]
        if casting:
            if settings["transfer_file"]:
                raise ValueError(message("animate", "transfer_file", f"be empty if shapes that cast shadows move, as '{casting[0]}' does",
                                         settings["transfer_file"], f"Leave it out to bake again for each frame. {instead}"))
            warnings.warn(f"animate(): '{casting[0]}' moves and casts shadows, so the transfer is baked again for each frame. "
                          f"{instead}", StaleTransferWarning, stacklevel=3)
            return integrator
        paths, margin = self._light_paths(), settings["light_margin"]
        if settings["transfer_file"]:
            transfer = integrator.prepare_scene(self.scene)
            margin = transfer.light_margin
            (reach,) = _reach(paths, [outline[None] for outline in transfer.outlines])
        else:
            candidates = np.unique(np.linspace(0, self.count - 1, BAKE_CANDIDATES).astype(int))
            reaches = _reach(paths, [path if len(path) == 1 else path[candidates] for path in paths])
            best = int(np.argmin(reaches))
            self._bake_frame, reach = int(candidates[best]), float(reaches[best])
            if one_bake and reach > margin:
                return mi.load_dict({"type": "shprt", **settings, "light_margin": reach * SLACK})
        if reach > margin:
            text = (f"animate(): lights move by up to {reach:.4g}, more than light_margin = {margin:g}, so the transfer is baked again "
                    f"for frames beyond it. Bake with a light_margin of {1.01 * reach:.3g} to use one bake for all. {instead}")
            if settings["strict"]:
                raise ValueError(f"{text} (An error because 'strict' is true.)")
            warnings.warn(text, StaleTransferWarning, stacklevel=3)
        return integrator

    def _light_paths(self) -> list:
        """Where the outline of each polygonal light is in each frame: (N, E, 2, 3), or (1, E, 2, 3) if it stays."""
        matrices = {shape_index(shape): m for name, m in self._matrices.items() if (shape := self._shape(name)) is not None}
        paths = []
        for light in polygon_lights(self.scene, keep_quiet):
            m = matrices.get(shape_index(light.shape), np.eye(4)[None])
            paths.append(np.einsum("nij,ekj->neki", m[:, :3, :3], light.outline) + m[:, None, None, :3, 3])
        return paths

    # ---- frames

    def show(self, frame: int) -> None:
        """Put the scene into frame number `frame`; only what differs from the frame shown last is touched."""
        for name, values in {**self._matrices, **self._values}.items():
            if not np.array_equal(self._shown[name], values[frame]):
                self._shown[name] = values[frame]
                if name in self._values:
                    self._write(name, _like(self._initial[name], values[frame]))
                else:
                    self._place(name, values[frame])
        self._parameters.update()

    def restore(self) -> None:
        """Put the scene back as it was."""
        for key in self._changed:
            self._parameters[key] = type(self._initial[key])(self._initial[key])
        self._parameters.update()
        self._changed, self._shown = set(), self._unmoved()

    def _write(self, key, value) -> None:
        self._parameters[key] = value
        self._changed.add(key)

    def _place(self, name, matrix) -> None:
        key, home, linear = self._places[name], self._homes[name], matrix[:3, :3]
        if self._turns(name):
            # In doubles Mitsuba would convert them, and update all objects in one kernel that takes minutes to compile.
            self._write(key, type(self._initial[key])((matrix @ home).astype(np.float32)))
            return
        self._write(key, _buffer(home @ linear.T + matrix[:3, 3]))
        normals = f"{name}.vertex_normals"
        if normals in self._parameters and len(self._remembered(normals)):     # Mitsuba would compute new ones from the faces
            turned = np.array(self._initial[normals], dtype=float).reshape(-1, 3) @ np.linalg.inv(linear)
            self._write(normals, _buffer(turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)))

    def render(self, integrator, sensor=0, spp=0, seed=0, progress=None):
        """Generator of :py:func:`animate`."""
        report = progress or (lambda label, done, total: None)
        try:
            self.show(self._bake_frame)
            integrator.prepare_scene(self.scene, (lambda done, total: progress("bake", done, total)) if progress else False)
            report("frames", 0, self.count)
            for frame in range(self.count):
                self.show(frame)
                with warnings.catch_warnings():       # said beforehand, once
                    warnings.simplefilter("ignore", StaleTransferWarning)
                    image = colours(*render(self.scene, integrator, sensor=sensor, spp=spp, seed=seed))
                report("frames", frame + 1, self.count)
                yield frame, image
        finally:
            self.restore()


def _reach(paths: list, places: list) -> np.ndarray:
    """For each of M places of the lights, the largest distance of a vertex to it in any frame: (M,).

    `paths`: per light (N or 1, E, 2, 3); `places`: per light (M or 1, E, 2, 3).
    """
    reach = np.zeros(1)
    for path, place in zip(paths, places):
        apart = np.array([np.linalg.norm(path - p, axis=-1).max() for p in place])
        reach = np.maximum(reach, apart)
    return reach


def _like(initial, value: np.ndarray):
    """`value` in the type of a parameter."""
    if isinstance(initial, float):
        return float(value)
    if dr.is_tensor_v(initial):
        return type(initial)(value.astype(np.float32))
    if dr.depth_v(initial) == 1 and dr.is_dynamic_v(initial):
        return _buffer(value)
    if dr.is_dynamic_v(initial):
        return type(initial)(*(_buffer(component) for component in value))
    return type(initial)(*value.tolist())


def _buffer(values: np.ndarray):
    """A Dr.Jit copy: from a list, as numpy's memory would be aliased, whose alignment changes and doubles the compiled kernels."""
    return mi.Float(values.ravel().tolist())


# ---- files


def write_frame(path, image, exposure: float = 1.0) -> None:
    """Write linear colours (H, W, 3) as an 8-bit sRGB PNG, multiplied by `exposure` before; the file appears complete or not at all."""
    picture = mi.Bitmap(np.round(255 * srgb(image * exposure)).astype(np.uint8))      # Bitmap.convert would round down
    with replacing(path) as temporary:
        picture.write(str(temporary))


def video_command(pattern: str, output: str, count: int, fps: float) -> list:
    """Arguments of ffmpeg that make an H.264 video of `count` pictures; sizes are padded to even ones, as its colours need."""
    return ["ffmpeg", "-y", "-loglevel", "error", "-framerate", f"{fps:g}", "-i", pattern, "-frames:v", str(count), "-vf",
            "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart", output]


def write_video(folder, pattern: str, count: int, fps: float) -> Path | None:
    """Make a video of the frames in a folder by ffmpeg.

    Parameters
    ----------
    folder : Path
        Where the frames are and the video will be.
    pattern : str
        Name of the frames as printf writes it, ``frame_%04d.png``.
    count : int
        Number of frames, from 0.
    fps : float
        Frames per second.

    Returns
    -------
    Path or None
        The video; None where there is no ffmpeg.

    Raises
    ------
    RuntimeError
        ffmpeg failed; its last line is given.
    """
    if shutil.which("ffmpeg") is None:
        return None
    folder = Path(folder).resolve()
    with replacing(folder / VIDEO) as temporary:
        # Run in the folder, as a percent sign in its own name would be taken for a number.
        done = subprocess.run(video_command(pattern, temporary.name, count, fps), cwd=folder, capture_output=True, text=True,
                              stdin=subprocess.DEVNULL)
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            raise RuntimeError(f"ffmpeg could not make '{folder / VIDEO}': {lines[-1]}. The frames are complete; make the video of them "
                               "with another ffmpeg or another program.")
    return folder / VIDEO
