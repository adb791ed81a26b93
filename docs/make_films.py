"""Draw the pictures on the pages of families: three of its tasks, at their start or as a trained policy plays them.

    python docs/make_films.py [NAME | RUN ...]

A run's folder becomes the films of its families, and so does a family of which the package has a trained policy
(``benchmarks/families.py`` trains policies for films). So do those of a benchmark for which it has one: ``mt10``. Other
families that MuJoCo steps become stills, unless they have a film. Both are of the first, the middle and the last
training task. They go to docs/pictures/families. Meta-World's need its package.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import mtjax
from mtjax.envs import name_of
from mtjax.envs.mixtures import apart
from mtjax.envs.pixels import Drawable
from mtjax.learning.evaluation import record
from mtjax.report import render
from mtjax.saved import pretrained
from mtjax.saved.config_json import from_json
from mtjax.saved.policy import Policy

FOLDER = Path(__file__).parent / "pictures" / "families"
SIZE = (160, 120)
SKIPPED = 150  # steps of a long episode before a film of it, in which the body gets going
FRAMES, STRIDE, DURATION = 30, 2, 40  # of a film: frames, steps from one to the next, milliseconds of each, at least
ARM_STRIDE = 4  # of Meta-World's arm, whose films show how it starts and succeeds
QUALITY = 70  # a third of the bytes that a gif has


def draw(name: str) -> None:
    """Draw a run's family, or a family by its name, if it can be seen."""
    trained = [known for known in pretrained.names() if known.startswith(f"{name}/")]
    if Path(name).is_dir() or trained:
        for family, frames in play(mtjax.load(trained[0] if trained else name)):
            save(name_of(family), frames, max(DURATION, round(1000 * family.seconds_per_step / family.film_speed)))
    elif (FOLDER / f"{name}.webp").exists():
        return
    elif isinstance(env := mtjax.make(name), Drawable) and env.films:
        save(name, [start(env)], DURATION)


def save(name: str, frames: list[Image.Image], duration: int) -> None:
    """Write a film, each of whose frames is shown for so many milliseconds, or a still if it is one frame."""
    for old in FOLDER.glob(f"{name}.*"):
        old.unlink()
    if len(frames) == 1:
        frames[0].quantize(256).save(FOLDER / f"{name}.png", optimize=True)
        return
    rest = {"append_images": frames[1:], "save_all": True, "duration": duration, "loop": 0}
    frames[0].save(FOLDER / f"{name}.webp", quality=QUALITY, method=6, **rest)


def play(policy: Policy) -> Iterator[tuple[Any, list[Image.Image]]]:
    """Return every family of a trained policy, and the frames of its film: of tasks, or of a trial's episodes."""
    env: Any = policy.env
    sampled = from_json(Path(str(policy.directory)) / "config.json").plan.eval_sampled  # as the run was evaluated
    played = record(env, policy.agent, policy.state, env.tasks("train"), jnp.int32(0), policy.trial, sampled=sampled)
    for part, states in zip(env.parts, apart(played.kept), strict=True):
        family, places = part.family, part.places["train"]
        shown = few(len(places))
        rows = [env.own_row(int(played.rows[place])) for place in places[shown]]
        states = each(states, shown)
        if policy.trial > 1:
            rows = rows[:1] * policy.trial
            states = jax.tree.map(lambda x: x[0].reshape(policy.trial, -1, *x.shape[2:]), states)
        yield family, [Image.fromarray(frame) for frame in best_part(family, rows, states)]


def best_part(family: Any, rows: Sequence[int], states: Any) -> np.ndarray:
    """Return the frames (FRAMES, height, width, 3) in which a policy is at work, of states (T, H, ...)."""
    if name_of(family).startswith("metaworld-"):
        return frames_from(family, rows, states, 0, ARM_STRIDE)
    if family.episode_length <= FRAMES:
        return frames_from(family, rows, states, 0, 1)
    film = frames_from(family, rows, states, min(SKIPPED, family.episode_length // 10))
    moves = np.any(film[1:] != film[:-1], axis=(1, 2, 3))
    return film if np.mean(moves) >= 0.5 else frames_from(family, rows, states, 0)  # a goal that is reached already


def frames_from(family: Any, rows: Sequence[int], states: Any, first: int, stride: int = STRIDE) -> np.ndarray:
    """Return the frames (FRAMES, height, width, 3) of tasks beside each other, from a step of states (T, H, ...) on."""
    seen = jax.tree.map(lambda x: x[:, first : first + FRAMES * stride : stride], states)
    return np.concatenate([render.film(family, row, each(seen, i), *SIZE) for i, row in enumerate(rows)], axis=2)


def start(env: Any) -> Image.Image:
    """Return a picture of tasks at their start."""
    tasks = jax.tree.map(lambda x: x[few(len(x))], env.tasks("train"))
    states = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), len(tasks.row))).state
    states = jax.tree.map(lambda x: x[:, None], states)  # episodes of one step
    return Image.fromarray(frames_from(env, tasks.row.tolist(), states, 0)[0])


def few(count: int) -> np.ndarray:
    """Return the numbers of the first, the middle and the last task."""
    return np.unique([0, count // 2, count - 1])


def each(states: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: x[index], states)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or mtjax.ENVS:
        draw(name)
        print(name, flush=True)
