"""Draw every domain and maze by MuJoCo's own renderer, the reference of ``test_painters.py``: MUJOCO_GL=osmesa or egl.

    python tests/draw_pictures.py [--check | --play]

With --check nothing is written: pictures must equal those that are there. With --play states of play are recorded anew.
"""

import sys
from functools import partial

import jax

try:
    import mujoco

    mujoco.Renderer  # noqa: B018
except Exception as error:  # every OpenGL backend without libraries fails with a type of its own
    raise SystemExit(f"cannot draw: {error}") from None

import numpy as np
from PIL import Image
from test_painters import DOMAINS, FURTHER, MAZES, PICTURES, SIZE, family, played, similarity, states_of, task_of

from mtjax.report import render
from mtjax.types import InputError


def draw(name: str) -> np.ndarray:
    """The two states of a domain or maze, drawn (2, H, W, 3) without shadows."""
    states = jax.tree.map(np.asarray, states_of(name))
    return render.film(family(name), int(task_of(name).row), states, SIZE, SIZE, shadows=False)


def record() -> None:
    """Write the states of play of all domains."""
    found = {}
    for name in DOMAINS + FURTHER:
        found[f"{name} qpos"], found[f"{name} extra"] = played(name)
    np.savez_compressed(PICTURES / "play.npz", **found)


def check(name: str, i: int, picture: np.ndarray) -> None:
    assert similarity(picture, np.asarray(Image.open(PICTURES / f"{name}-{i}.png"))) > 0.98, name


def keep(name: str, i: int, picture: np.ndarray) -> None:
    PICTURES.mkdir(exist_ok=True)
    Image.fromarray(picture).save(PICTURES / f"{name}-{i}.png", optimize=True)


if __name__ == "__main__":
    if "--play" in sys.argv:
        record()
    act = check if "--check" in sys.argv else keep
    try:
        drawn = {name: draw(name) for name in DOMAINS + FURTHER + MAZES}
    except InputError as error:
        sys.exit(str(error))
    for name, pictures in drawn.items():
        for i, picture in enumerate(pictures):
            partial(act, name, i)(picture)
