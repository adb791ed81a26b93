"""Which sub-policy acts in each step of an episode: strips below films, and a figure of all tasks."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mtjax.envs.craft.sketched import Sketched, due_in
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.evaluation import Recording, span_of

# Six colours of Okabe and Ito, which colour-blind readers can tell apart; then lighter and darker ones of these.
_PALETTE = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
_SHADES = ((1.0, 0), (0.45, 140), (0.5, 0))  # factor and summand of each of three rounds


class _Colour(NamedTuple):
    red: int
    green: int
    blue: int


_GREY = _Colour(96, 96, 96)  # where no sub-policy acts


class Timeline(NamedTuple):
    """Holds the sub-policies of one trial of K episodes of every task (T, ...)."""

    names: tuple[str, ...]
    acting: np.ndarray  # (T, H) int32 number of the sub-policy that acts in each step, -1 for none
    lengths: np.ndarray  # (T, K) int32 steps of each episode, which follow each other along H


def timeline_of(env: FamilyOrMixture, played: Recording, states: Mapping[str, Any]) -> Timeline | None:
    """Return the options that an agent has played, else the symbols of followed sketches; None if there are neither.

    Args:
        played: one trial of every task.
        states: those of its worlds by the name of their family, leaves (tasks of the family, H, ...).
    """
    lengths = np.asarray(played.lengths)
    if played.option is not None:
        count = int(np.max(played.option, initial=0)) + 1
        return Timeline(tuple(f"option {i}" for i in range(count)), np.asarray(played.option), lengths)
    names, acting = [], None
    for part in env.parts:
        family = part.family
        if not (isinstance(family, Sketched) and family.sketched):
            continue
        rows = [env.own_row(int(row)) for row in np.asarray(played.rows)[part.places["all"]]]
        due = due_in(family, rows, np.asarray(states[part.name].place))
        acting = np.full((len(lengths), due.shape[1]), -1, np.int32) if acting is None else acting
        acting[part.places["all"]] = np.where(due < 0, -1, due + len(names))
        names += family.symbols
    return None if acting is None else Timeline(tuple(names), acting, lengths)


def spans(acting: np.ndarray) -> list[tuple[int, int, int]]:
    """Return the first step, the length and the number of each stretch of equal numbers (H,)."""
    begins = [0, *(np.flatnonzero(np.diff(acting)) + 1).tolist(), len(acting)]
    return [(a, b - a, int(acting[a])) for a, b in itertools.pairwise(begins)]


def colours(count: int) -> list[_Colour]:
    """Return a colour of bytes for each of ``count`` names, which repeat after the 18th."""
    shade = lambda colour, factor, more: (round(factor * x + more) for x in colour)
    shades = [_Colour(*shade(colour, *each)) for each in _SHADES for colour in _PALETTE]
    return [shades[i % len(shades)] for i in range(count)]


def strips(timeline: Timeline, task: int, steps: Sequence[int], width: int, episode: int = 0) -> np.ndarray:
    """Return pictures (F, height, width, 3) of one episode: its stretches in colour, a mark and a name for each step.

    Args:
        steps: (F,) the step of the episode that each picture is of.
        episode: of the trial.
    """
    first, length = span_of(timeline.lengths[task], episode)
    acting = timeline.acting[task, first : first + length]
    line, palette = max(width // 14, 13), colours(len(timeline.names))
    font, scale = ImageFont.load_default(max(width // 22, 9)), width / len(acting)
    bar = Image.new("RGB", (width, 2 * line), "black")
    for first, length, number in spans(acting):
        box = (round(first * scale), 2, round((first + length) * scale) - 1, line - 3)
        ImageDraw.Draw(bar).rectangle(box, fill=_colour(palette, number))
    made = {}
    for step in dict.fromkeys(steps):
        picture, number = bar.copy(), int(acting[step])
        drawing, place = ImageDraw.Draw(picture), round((step + 0.5) * scale)
        drawing.rectangle((place - 1, 0, place + 1, line - 1), fill="white")
        told = timeline.names[number] if number >= 0 else ""
        drawing.rectangle((3, line + 2, line - 3, 2 * line - 5), fill=_colour(palette, number))
        drawing.text((line + 3, line), told, fill="white", font=font)
        made[step] = np.asarray(picture)
    return np.stack([made[step] for step in steps])


def _colour(palette: Sequence[_Colour], number: int) -> _Colour:
    return palette[number] if number >= 0 else _GREY


def draw(path: str | Path, timeline: Timeline, labels: Sequence[str]) -> None:
    """Draw a row for each task (T,), with a stretch in colour for each sub-policy over the steps of its trial."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    palette = [tuple(x / 255 for x in colour) for colour in colours(len(timeline.names))]
    figure = Figure(figsize=(9, 1.5 + 0.3 * len(labels)), layout="constrained")
    axes, grey = figure.subplots(), tuple(x / 255 for x in _GREY)
    used = set()
    for row, (acting, lengths) in enumerate(zip(timeline.acting, timeline.lengths, strict=True)):
        found = spans(acting[: np.sum(lengths)])
        used |= {number for _, _, number in found if number >= 0}
        shown = [palette[number] if number >= 0 else grey for _, _, number in found]
        axes.broken_barh([(first, count) for first, count, _ in found], (row - 0.4, 0.8), facecolors=shown)
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("steps")
    patches = [Patch(color=palette[i], label=timeline.names[i]) for i in sorted(used)]
    axes.legend(handles=patches, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=120)
