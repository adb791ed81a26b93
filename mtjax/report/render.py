"""Videos of a task, drawn without a display."""

import contextlib
import importlib
import math
import operator
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from PIL import Image

from mtjax.envs.painters.poses import Pose
from mtjax.envs.pixels import Drawable
from mtjax.envs.scenery import Mark, Visible
from mtjax.types import InputError

_GIF_FPS = 50  # browsers slow down frames that are shorter than 0.02 s
_FIX = (
    "cannot draw without a display with MUJOCO_GL={}; on Debian or Ubuntu run `apt install libegl1 libgl1-mesa-dri` "
    "for MUJOCO_GL=egl, or `apt install libosmesa6` for MUJOCO_GL=osmesa"
)


def choose_backend() -> str:
    """Select the OpenGL backend of ``MUJOCO_GL`` for MuJoCo, by default "egl" on Linux, and return its name.

    It may be called after MuJoCo was imported. If libraries are missing, the backend raises its own error.
    """
    if platform.system() == "Linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    # MuJoCo reads the variable only when it is imported, and its Renderer finds the context through this module.
    importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
    return os.environ.get("MUJOCO_GL", "")


def film(
    env: Drawable, task_row: int, states: Any, width: int = 320, height: int = 240, shadows: bool = True
) -> np.ndarray:
    """Draw the task in row ``task_row`` of ``env.table`` in each of the states, leaves (H, ...).

    Returns:
        Frames (H, height, width, 3) uint8.

    Raises:
        InputError: as for ``drawing``.
    """
    with drawing(env, task_row, states, width, height, shadows) as draw:
        frames = np.empty((len(jax.tree.leaves(states)[0]), height, width, 3), np.uint8)
        for i, frame in enumerate(frames):
            draw(i, frame)
    return frames


@contextlib.contextmanager
def drawing(
    env: Drawable, task_row: int, states: Any, width: int, height: int, shadows: bool = True
) -> Iterator[Callable[..., np.ndarray]]:
    """Give a function that draws the task in row ``task_row`` in state ``i`` of states, leaves (H, ...), into an array.

    The scene is that of observations from pixels, by default with shadows, and with goals that the agent does not see.
    Without an array the function makes a frame (height, width, 3) uint8. Only the thread that opens it may draw.

    Raises:
        InputError: there is no such row, or no OpenGL backend works. The message names what to install.
    """
    count = len(env.table.tasks.row)
    if not 0 <= task_row < count:
        raise InputError(f"there is no task {task_row}; this family has tasks 0 to {count - 1}")
    model = env.scene_model(task_row)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.light_castshadow &= shadows
    data, task = mujoco.MjData(model), jax.tree.map(lambda x: x[task_row], env.table.tasks)
    shown = jax.tree.map(np.asarray, jax.vmap(partial(env.visible, task))(states))
    camera = 0 if model.ncam else -1  # MuJoCo's own, which shows all of a model
    with _open_renderer(model, width, height) as renderer:

        def draw(i: int, out: np.ndarray | None = None) -> np.ndarray:
            visible = jax.tree.map(operator.itemgetter(i), shown)
            data.qpos[:] = visible.joints
            _arrange(model, visible)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            return renderer.render(out=out)

        yield draw


def write_video(path_stem: str | Path, frames: np.ndarray, fps: float) -> Path:
    """Write frames (H, height, width, 3) uint8 to ``path_stem`` plus .mp4, and return the path.

    Without mediapy or ffmpeg the file is a GIF.
    A GIF has at most 50 frames a second. Others are left out, so that its speed is right to 0.01 s a frame.

    Raises:
        InputError: the file exists already, or there are no frames.
    """
    mediapy = _mediapy_with_ffmpeg()
    path = Path(f"{path_stem}.{'mp4' if mediapy else 'gif'}")
    if path.exists():
        raise InputError(f"{path} exists already; give another name or remove it")
    if not len(frames):
        raise InputError("there are no frames to write")
    if mediapy:
        mediapy.write_video(path, frames, fps=fps)
    else:
        _write_gif(path, frames, fps)
    return path


def _arrange(model: mujoco.MjModel, visible: Visible) -> None:
    """Give a model all that a world shows, but for its joints."""
    for name, value in visible.fields.items():
        if hasattr(model, name):  # else a painter alone knows it
            getattr(model, name)[:] = value
    _place(model, visible.marks)
    _look(model, visible.eye)


def _place(model: mujoco.MjModel, marks: Mapping[str, Mark]) -> None:
    """Put the geoms whose places an episode decides, and their lights, where they are. The world's body has them."""
    for name, mark in marks.items():
        geom = model.geom(name).id
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # else its place is not read
        model.geom_pos[geom] = mark.position
        if mark.size is not None:
            model.geom_size[geom] = mark.size
        if mark.along is not None:
            mujoco.mju_quatZ2Vec(model.geom_quat[geom], np.float64(mark.along))
        lamp = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_LIGHT, name)
        if lamp >= 0:
            model.light_pos[lamp, :2] = mark.position[:2]


def _look(model: mujoco.MjModel, eye: Pose | None) -> None:
    """Put the first camera where an episode has decided. It belongs to the world's body."""
    if eye is not None:
        model.cam_pos[0] = eye.position
        mujoco.mju_mat2Quat(model.cam_quat[0], np.array(eye.axes, np.float64).T.ravel())


def _open_renderer(
    model: mujoco.MjModel, width: int, height: int
) -> "mujoco.Renderer":  # which MuJoCo lacks without OpenGL
    unset = {"MUJOCO_GL", "PYOPENGL_PLATFORM"}.difference(os.environ)
    try:
        choose_backend()
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # every backend fails with a type of its own
        message = _FIX.format(os.environ.get("MUJOCO_GL", "unset"))
        # A child process that inherited a backend without libraries would fail at `import mujoco`.
        for name in unset:
            os.environ.pop(name, None)
        raise InputError(message) from error


def _mediapy_with_ffmpeg():
    try:
        mediapy = importlib.import_module("mediapy")
    except ImportError:
        return None
    return mediapy if mediapy.video_is_available() else None


def _write_gif(path: Path, frames: np.ndarray, fps: float) -> None:
    stride = math.ceil(fps / _GIF_FPS)
    images = [Image.fromarray(frame) for frame in frames[::stride]]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 * stride / fps, loop=0)
