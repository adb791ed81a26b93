"""Films of several tasks side by side, with split, parameters and return written on each."""

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mtjax.checks import amount
from mtjax.envs.engines import host
from mtjax.envs.mixtures import Tabled, apart
from mtjax.envs.pixels import Pictured
from mtjax.envs.task_table import Part
from mtjax.learning.evaluation import Recording, record
from mtjax.names import InputError
from mtjax.report import render
from mtjax.saved.policy import Policy
from mtjax.types import SPLITS, Task

_FPS = 25
_WIDTHS = ((4, 320), (9, 240))  # of a tile, for up to so many tasks; beyond, the narrowest
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


def require(env: Tabled) -> None:
    """Raise InputError unless a family can be filmed."""
    if not any(part.family.films for part in env.parts):
        raise InputError("only families that show pictures can be filmed; leave out --video")


def choose(env: Tabled, splits: Sequence[str], tasks: Sequence[int]) -> list[Chosen]:
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


def write(
    policy: Policy,
    tasks: Task,
    chosen: Sequence[Chosen],
    seconds: float,
    seed: int,
    stem: Path,
    named: Mapping[str, str],
) -> Path:
    """Film one trial of each chosen task, and write them as one grid. Progress is printed.

    A trial of several episodes has a line of the grid, its episodes side by side: the first ones, and the last.

    Args:
        tasks: all tasks of the environment.
        seconds: how long the film lasts; an episode that ends before stands still.
        named: other names of splits.
    """
    env = policy.env
    render.choose_backend()
    with contextlib.ExitStack() as filmed, host.explaining():
        for part in env.parts:
            filmed.enter_context(part.family.filmed())
        played = record(env, policy.agent, policy.state, tasks, jnp.int32(seed), policy.trial)
        played = jax.block_until_ready(played)
    by_name = {part.name: states for part, states in zip(env.parts, apart(played.kept), strict=True)}
    shown = _episodes(policy.trial)
    chosen = [one._replace(episode=episode) for one in chosen for episode in shown]
    width = next((width for most, width in _WIDTHS if len(chosen) <= most), _NARROWEST)
    count, tiles = max(round(seconds * _FPS), 1), []
    for i, one in enumerate(chosen):
        print(f"filming {i + 1} of {len(chosen)}: {', '.join(_caption(env, one, played, named))}", flush=True)
        tiles.append(_tile(env, one, played, by_name[one.part.name], count, width))
    captions = [_caption(env, one, played, named) for one in chosen]
    columns = len(shown) if policy.trial > 1 else 0
    path = render.write_video(stem, grid(captioned(tiles, captions), columns), _FPS)
    print(f"filmed {path.name}: {len(chosen) // len(shown)} tasks{f' by {columns} episodes' * bool(columns)}")
    return path


def _episodes(trial: int) -> list[int]:
    """Return which episodes of a trial are filmed: all if they are few, else the first ones and the last."""
    return [*range(min(trial, _EPISODES - 1)), *([trial - 1] if trial >= _EPISODES else [])]


def _caption(env: Tabled, one: Chosen, played: Recording, named: Mapping[str, str]) -> tuple[str, str]:
    """Return the lines on a task: its split and return, and its parameters."""
    row = int(played.rows[one.place])  # continuous ranges have a row for each episode
    split, (trial, returns) = named.get(one.split, one.split), (played.returns.shape[1], played.returns[one.place])
    episode = f", episode {one.episode + 1} of {trial}" * (trial > 1)
    return f"{split}{episode}, return {amount(float(returns[one.episode]))}", env.describe(row)


def _tile(env: Tabled, one: Chosen, played: Recording, states: Any, count: int, width: int) -> np.ndarray:
    """Return the frames (F, height, width, 3) of one episode, at most ``count``."""
    family: Any = one.part.family
    row = env.own_row(int(played.rows[one.place]))
    lengths = played.lengths[one.place]
    first, length = int(np.sum(lengths[: one.episode])), int(lengths[one.episode])
    times = np.arange(count) / _FPS * family.film_speed / family.seconds_per_step
    steps = np.unique(np.minimum(times.astype(int), length - 1))
    shown = jax.tree.map(lambda x: x[one.own][first + steps], states)  # also of keys, which NumPy has not
    size = width, width * 3 // 4
    drawn = render.film(family, row, shown, *size) if isinstance(family, Pictured) else family.pictures(shown, *size)
    frames = drawn[np.searchsorted(steps, np.minimum(times.astype(int), length - 1))]
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
