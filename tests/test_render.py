import os
import sys
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
from PIL import Image

from mtjax.envs.dm_control.finger import FingerSpin, FingerTurn
from mtjax.envs.engines.base import World
from mtjax.report import render
from mtjax.types import InputError

FINGER = FingerSpin(vary={"size": [0.8, 1.4]})
STATES = World(np.array([[0.0, 0.0, 0.0], [1.5, 0.5, 1.0]]), *[np.zeros((2, 3))] * 3)


def moving_square(count):
    frames = np.zeros((count, 16, 16, 3), np.uint8)
    for index in range(count):
        frames[index, :4, index % 12 : index % 12 + 4] = 255
    return frames


def warm_pixels(frame):
    """Only finger and spinner are brown; sky, floor and hinges are blue."""
    return np.sum(frame[..., 0].astype(int) > frame[..., 2])


def test_film_shows_the_task_or_names_what_to_install():
    try:
        small, large = (render.film(FINGER, row, STATES, width=160, height=120) for row in (0, 1))
    except InputError as error:
        assert "apt install libegl1 libgl1-mesa-dri" in str(error) and "\n" not in str(error)
        return
    assert small.shape == large.shape == (2, 120, 160, 3) and small.dtype == np.uint8
    assert small.std() > 10
    assert np.mean(np.any(small[0] != small[1], axis=-1)) > 0.01
    for pose in range(2):
        assert warm_pixels(large[pose]) > 1.2 * warm_pixels(small[pose]) > 100


def test_missing_driver_names_the_fix_and_leaves_the_environment_alone(monkeypatch):
    def fail(*_):
        raise ImportError("Cannot initialize a EGL device display.")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(InputError, match=r"MUJOCO_GL=.*apt install libegl1 libgl1-mesa-dri.*apt install libosmesa6"):
        render.film(FINGER, 0, STATES)
    assert "MUJOCO_GL" not in os.environ


def test_backend_that_the_user_chose_is_kept(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert render.choose_backend() == "disable"
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(InputError, match="MUJOCO_GL=nonsense"):
        render.film(FINGER, 0, STATES)


def test_the_camera_does_not_depend_on_the_row():
    models = [FINGER.scene_model(row) for row in range(2)]
    np.testing.assert_array_equal(models[0].cam_pos, models[1].cam_pos)
    assert [model.nlight for model in models] == [1, 1]


def test_film_puts_targets_where_the_episode_has_them():
    family = FingerTurn()
    model, place = family.scene_model(0), np.array([0.1, -0.05], np.float32)
    task = jax.tree.map(lambda x: x[0], family.table.tasks)
    render._place(model, family.marks(task, STATES._replace(extra=place)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hinge = np.array(model.body("spinner").pos)
    np.testing.assert_allclose(data.geom("target").xpos, np.add(hinge, [0.1, 0, -0.05]), atol=1e-6)


@pytest.mark.parametrize("row", [-1, 99])
def test_unknown_row_is_an_input_error(row):
    with pytest.raises(InputError, match=f"no task {row}"):
        render.film(FINGER, row, STATES)


@pytest.mark.parametrize("missing", ["ffmpeg", "mediapy"])
def test_gif_where_ffmpeg_or_mediapy_is_missing(missing, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    if missing == "mediapy":
        monkeypatch.setitem(sys.modules, "mediapy", None)
    path = render.write_video(tmp_path / "size-1.4", moving_square(6), fps=25)
    assert path == tmp_path / "size-1.4.gif"
    with Image.open(path) as image:
        assert (image.format, image.size, image.n_frames, image.info["duration"]) == ("GIF", (16, 16), 6, 40)


def test_gif_of_many_frames_a_second_keeps_its_speed(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    path = render.write_video(tmp_path / "video", moving_square(10), fps=100)
    with Image.open(path) as image:
        assert (image.n_frames, image.info["duration"]) == (5, 20)


def test_mp4_where_ffmpeg_is_present(monkeypatch, tmp_path):
    calls = []
    stub = SimpleNamespace(
        video_is_available=lambda: True, write_video=lambda path, frames, fps: calls.append((path, len(frames), fps))
    )
    monkeypatch.setitem(sys.modules, "mediapy", stub)
    assert render.write_video(tmp_path / "size-1.4", moving_square(6), fps=50) == tmp_path / "size-1.4.mp4"
    assert calls == [(tmp_path / "size-1.4.mp4", 6, 50)]


def test_never_overwrites(tmp_path):
    path = render.write_video(tmp_path / "video", moving_square(3), fps=50)
    content = path.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        render.write_video(tmp_path / "video", moving_square(6), fps=50)
    assert path.read_bytes() == content


def test_no_frames_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no frames"):
        render.write_video(tmp_path / "video", moving_square(0), fps=50)
