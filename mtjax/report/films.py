"""Films of several tasks side by side, with split, parameters and return written on each."""

import contextlib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mtjax.agents.base import judged
from mtjax.checks import amount
from mtjax.envs.engines import host
from mtjax.envs.mixtures import FamilyOrMixture, apart
from mtjax.envs.pixels import Drawable
from mtjax.envs.task_table import Part
from mtjax.learning.evaluation import Recording, record, span_of
from mtjax.names import InputError
from mtjax.report import render, timeline
from mtjax.report.timeline import Timeline
from mtjax.report.waiting import telling
from mtjax.saved.policy import Policy
from mtjax.types import SPLITS, Task

_FPS = 25
_WIDTHS = ((4, 320), (9, 240))  # of a tile, for up to so many tasks; beyond, the narrowest
_LIVE_WIDTHS = ((1, 480), *_WIDTHS)
_NARROWEST = 160
_EPISODES = 4  # of a trial that are filmed, at most
_WORDS = re.compile("[^ ,]+[ ,]*")  # after which a caption may go on in the next line


class Chosen(NamedTuple):
    """A task to film, or an episode of a trial of it."""

    part: Part
    split: str
    place: int  # among all tasks of the environment
    own: int  # among all tasks of its family
    episode: int = 0  # of the trial


def require(env: FamilyOrMixture) -> None:
    """Raise InputError unless a family can be filmed."""
    if not any(part.family.films for part in env.parts):
        raise InputError(
            "only families whose worlds can be drawn can be filmed; leave out --video, or give your own environment of "
            "Gymnasium a render method, and rgb_array among its metadata['render_modes']"
        )


def choose(env: FamilyOrMixture, splits: Sequence[str], tasks: Sequence[int]) -> list[Chosen]:
    """Return the tasks to film: of each split and family those numbers, or the first, the middle and the last.

    Raises:
        InputError: no family has such a task.
    """
    found, most = [], 0
    for part in (part for part in env.parts if part.family.films):
        for split in splits or SPLITS:
            rows = part.family.table.rows[split]
            most = max(most, len(rows))
            spread = dict.fromkeys((0, len(rows) // 2, len(rows) - 1)) if len(rows) else ()
            numbers = [t for t in dict.fromkeys(tasks) if 0 <= t < len(rows)] if tasks else spread
            found += [Chosen(part, split, int(part.places["all"][rows[t]]), int(rows[t])) for t in numbers]
    wrong = next((t for t in tasks if not 0 <= t < most), None)
    if wrong is not None:
        raise InputError(f"there is no task {wrong} to film; there are tasks 0 to {most - 1}")
    if not found:
        raise InputError(f"there are no tasks to film in {', '.join(splits)}")
    return found


def choose_one(env: FamilyOrMixture, split: str, number: int) -> Chosen:
    """Return the task with a number in a split, for a film.

    Raises:
        InputError: there is no such task, or its worlds cannot be drawn.
    """
    for part in env.parts:
        for i in np.flatnonzero(part.places.get(split, np.zeros(0)) == number):
            if not part.family.films:
                raise InputError(f"worlds of {part.name or 'this family'} cannot be drawn")
            own = int(part.family.table.rows[split][i])
            return Chosen(part, split, int(part.places["all"][own]), own)
    raise InputError(f"there is no task {number} of {split}")


def write(
    policy: Policy,
    tasks: Task,
    chosen: Sequence[Chosen],
    seconds: float,
    seed: int,
    stem: Path,
    named: Mapping[str, str],
    sampled: bool = False,
) -> Path:
    """Film one trial of each chosen task, and write them as one grid. Progress is printed.

    A trial of several episodes has a line of the grid, its episodes side by side: the first ones, and the last.

    If sub-policies act, a strip below each picture says which does, and timeline.png shows the trials of all tasks.

    Args:
        tasks: all tasks of the environment.
        seconds: how long the film lasts; an episode that ends before stands still.
        named: other names of splits.
        sampled: draw actions from the policy.
    """
    env = policy.env
    with telling(f"playing {len(tasks.id)} tasks for the film"):
        played, by_name = play(policy, tasks, seed, sampled)
    acting, (chosen, columns) = timeline.timeline_of(env, played, by_name), _episodes(chosen, played)
    width = _width(len(chosen), _WIDTHS)
    count, tiles = max(round(seconds * _FPS), 1), []
    captions = [_caption(env, one, played, named) for one in chosen]
    for i, (one, caption) in enumerate(zip(chosen, captions, strict=True)):
        with telling(f"filming {i + 1} of {len(chosen)}: {', '.join(caption)}", at_once=True):
            tiles.append(_tile(env, one, played, by_name[one.part.name], count, width, acting))
    with telling(f"writing the film of {count} pictures", at_once=True):
        path = render.write_video(stem, grid(captioned(tiles, captions), columns), _FPS)
    print(f"filmed {path.name}: {len(chosen) // max(columns, 1)} tasks{f' by {columns} episodes' * bool(columns)}")
    if acting is not None:
        labels = [label for split in SPLITS for label in env.labels(split)]
        timeline.draw(stem.with_name("timeline.png"), acting, labels)
    return path


def play(policy: Policy, tasks: Task, seed: int, sampled: bool = False) -> tuple[Recording, dict[str, Any]]:
    """Play one trial of each task, and return it, and the states of each family by its name."""
    env = policy.env
    render.choose_backend()
    with contextlib.ExitStack() as filmed, host.explaining():
        for part in env.parts:
            filmed.enter_context(part.family.filmed())
        given = env, judged(policy.agent), policy.state, tasks, jnp.int32(seed), policy.trial
        played = record(*given, sampled=sampled)
        played = jax.block_until_ready(played)
    return played, {part.name: states for part, states in zip(env.parts, apart(played.kept), strict=True)}


@contextlib.contextmanager
def moving(
    env: FamilyOrMixture,
    chosen: Sequence[Chosen],
    played: Recording,
    by_name: Mapping[str, Any],
    named: Mapping[str, str],
    shadows: bool = True,
) -> Iterator[tuple[float, Callable[[float], np.ndarray]]]:
    """Give the seconds until the last of the chosen tasks' episodes ends, and a function that draws all at a time [s].

    The episodes of a trial move side by side.

    It draws one frame (height, width, 3), with captions. Only the thread that opens it may draw.

    Args:
        shadows: whether worlds of MuJoCo have them, which without a GPU are most of the work.
    """
    chosen, columns = _episodes(chosen, played)
    width = _width(len(chosen), _LIVE_WIDTHS)
    captions = [_caption(env, one, played, named) for one in chosen]
    with contextlib.ExitStack() as opened:
        open_tile = lambda one: _drawing(env, one, played, by_name[one.part.name], width, shadows)
        tiles = [opened.enter_context(open_tile(one)) for one in chosen]
        draw = lambda time: grid(captioned([tile(time)[None] for tile in tiles], captions), columns)[0]
        yield max(span_of(played.lengths[one.place], one.episode)[1] / _steps_per_second(one) for one in chosen), draw


@contextlib.contextmanager
def _drawing(
    env: FamilyOrMixture, one: Chosen, played: Recording, states: Any, width: int, shadows: bool
) -> Iterator[Callable[[float], np.ndarray]]:
    """Give a function that draws one task at a time [s]; the last frame stays after the episode's end."""
    family: Any = one.part.family
    row, (first, length) = env.own_row(int(played.rows[one.place])), span_of(played.lengths[one.place], one.episode)
    shown, size = jax.tree.map(lambda x: x[one.own][first : first + length], states), (width, width * 3 // 4)
    kept = lambda i: family.pictures(jax.tree.map(lambda x: x[i : i + 1], shown), *size)[0]
    opened = render.drawing(family, row, shown, *size, shadows) if isinstance(family, Drawable) else nullcontext(kept)
    with opened as draw:
        of_step = lru_cache(1)(draw)
        yield lambda time: of_step(min(int(time * _steps_per_second(one)), length - 1))


def _steps_per_second(one: Chosen) -> float:
    """Return how many steps of a world a second of a film shows."""
    return one.part.family.film_speed / one.part.family.seconds_per_step


def _width(count: int, widths: Sequence[tuple[int, int]]) -> int:
    """Return the width of each of ``count`` tiles."""
    return next((width for most, width in widths if count <= most), _NARROWEST)


def _episodes(chosen: Sequence[Chosen], played: Recording) -> tuple[list[Chosen], int]:
    """Return which episodes of trials are shown, and how many in a line, 0 for as it fits.

    They are all if they are few, else the first ones and the last.
    """
    trial = played.returns.shape[1]
    shown = [*range(min(trial, _EPISODES - 1)), *([trial - 1] if trial >= _EPISODES else [])]
    return [one._replace(episode=episode) for one in chosen for episode in shown], len(shown) * (trial > 1)


def _caption(env: FamilyOrMixture, one: Chosen, played: Recording, named: Mapping[str, str]) -> tuple[str, str]:
    """Return the lines on a task: its split and return, and its parameters."""
    row = int(played.rows[one.place])  # continuous ranges have a row for each episode
    split, (trial, returns) = named.get(one.split, one.split), (played.returns.shape[1], played.returns[one.place])
    episode = f", episode {one.episode + 1} of {trial}" * (trial > 1)
    return f"{split}{episode}, return {amount(float(returns[one.episode]))}", env.describe(row)


def _tile(
    env: FamilyOrMixture,
    one: Chosen,
    played: Recording,
    states: Any,
    count: int,
    width: int,
    acting: Timeline | None = None,
) -> np.ndarray:
    """Return the frames (F, height, width, 3) of an episode, at most ``count``, with its strip of sub-policies."""
    family: Any = one.part.family
    row, (first, length) = env.own_row(int(played.rows[one.place])), span_of(played.lengths[one.place], one.episode)
    times = np.arange(count) / _FPS * _steps_per_second(one)
    step_of = np.minimum(times.astype(int), length - 1)
    steps = np.unique(step_of)
    shown = jax.tree.map(lambda x: x[one.own][first + steps], states)  # also of keys, which NumPy has not
    size = width, width * 3 // 4
    drawn = render.film(family, row, shown, *size) if isinstance(family, Drawable) else family.pictures(shown, *size)
    frames = drawn[np.searchsorted(steps, step_of)]
    if acting is not None:
        below = timeline.strips(acting, one.place, step_of.tolist(), frames.shape[2], one.episode)
        frames = np.concatenate([frames, below], axis=1)
    return frames[: max(int(np.sum(times < length)), 1)]


def captioned(tiles: Sequence[np.ndarray], captions: Sequence[Sequence[str]]) -> list[np.ndarray]:
    """Return tiles (F, height, width, 3) with their captions above, so that nothing of a picture is covered.

    A caption's line takes as many lines as it needs; all tiles become equally high.
    """
    width = tiles[0].shape[2]
    font, height = ImageFont.load_default(max(width // 22, 9)), max(width // 14, 13)
    texts = [[part for line in caption for part in _wrapped(line, width - 6, font)] for caption in captions]
    most, made = max(map(len, texts)), []
    for tile, lines in zip(tiles, texts, strict=True):
        strip = Image.new("RGB", (width, height * most), "black")
        for i, line in enumerate(lines):
            ImageDraw.Draw(strip).text((3, 1 + height * i), line, fill="white", font=font)
        above = np.broadcast_to(np.asarray(strip), (len(tile), *np.asarray(strip).shape))
        made.append(np.concatenate([above, tile], axis=1))
    return made


def _wrapped(text: str, width: float, font: Any) -> list[str]:
    """Return the lines of a text that is no wider than ``width`` pixels, where a word's width allows."""
    lines = [""]
    for word in _WORDS.findall(text):
        if lines[-1] and font.getlength(lines[-1] + word.rstrip()) > width:
            lines.append("")
        lines[-1] += word
    return lines


def grid(tiles: Sequence[np.ndarray], columns: int = 0) -> np.ndarray:
    """Return tiles (F, height, width, 3) side by side; a shorter one stands still at its end.

    Args:
        columns: tiles in a line; 0 makes the grid as square as can be.
    """
    longest = max(map(len, tiles))
    columns = columns or math.ceil(math.sqrt(len(tiles)))
    lines = math.ceil(len(tiles) / columns)
    height, width = tiles[0].shape[1:3]
    whole = np.zeros((longest, lines * height, columns * width, 3), np.uint8)
    for i, tile in enumerate(tiles):
        line, column = divmod(i, columns)
        rest = np.minimum(np.arange(longest), len(tile) - 1)
        whole[:, line * height : (line + 1) * height, column * width : (column + 1) * width] = tile[rest]
    return whole
