"""The table of a mixture: those of its families, padded to one size of contexts and of actions."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mtjax import frames
from mtjax.envs.blocks import blocks_of
from mtjax.envs.choosing import Choosing
from mtjax.envs.family import Family
from mtjax.envs.task_table import Table
from mtjax.types import SPLITS, InputError, Spec, Task


def mixed_table(families: Sequence[Family], action_size: int) -> Table:
    """Return the families' tables one after another. Tasks are numbered in the order of the splits."""
    tables = [family.table for family in families]
    sizes = [len(table.tasks.id) for table in tables]
    first, count = np.cumsum([0, *sizes[:-1]]), sum(sizes)
    rows = {split: np.concatenate([i + t.rows[split] for i, t in zip(first, tables, strict=True)]) for split in SPLITS}
    listed = np.concatenate(list(rows.values()))
    numbers = np.zeros(count, np.int32)
    numbers[listed] = np.arange(len(listed))
    leaves: dict[str, Any] = {
        "id": numbers,
        "row": np.arange(count, dtype=np.int32),
        "context": mixed_contexts(families),
        "params": {},
        "model": {},
        "goal": {},
        "horizon": np.concatenate([table.tasks.horizon for table in tables]),
        "action_mask": _masks(families, action_size),
        "finite_horizon": _finite(families),
    }
    return Table(Task(**leaves), rows, _draws(tables, first, count), blocks_of([family.counts for family in families]))


def mixed_contexts(families: Sequence[Family]) -> np.ndarray:
    """Return the contexts (R, C) of all rows: the family as one-hot, then one slot per family."""
    contexts = [np.asarray(family.table.tasks.context) for family in families]
    if len(contexts) == 1:
        return contexts[0]
    slots = [context if np.any(context) else context[:, :0] for context in contexts]
    ends = len(slots) + np.cumsum([slot.shape[1] for slot in slots])
    rows = []
    for i, (slot, end) in enumerate(zip(slots, ends, strict=True)):
        row = np.zeros((len(slot), ends[-1]), np.float32)
        row[:, i] = 1
        row[:, end - slot.shape[1] : end] = slot
        rows.append(row)
    return np.concatenate(rows)


def _masks(families: Sequence[Family], size: int) -> np.ndarray | None:
    """Return which actions (R, A) each task has; None if all tasks have all actions."""
    masks = []
    for family in families:
        own = family.table.tasks.action_mask
        shape = (len(family.table.tasks.id), family.spec.action_size)
        masks.append(np.ones(shape, np.float32) if own is None else np.float32(own))
    whole = np.concatenate([np.pad(x, ((0, 0), (0, size - x.shape[1]))) for x in masks])
    return None if np.all(whole == 1) else whole


def _finite(families: Sequence[Family]) -> np.ndarray | None:
    """Return whose limits of time (R,) are part of the problem; None if those of all families are, or of none."""
    rows = [np.full(len(family.table.tasks.id), family.finite_horizon) for family in families]
    return None if len({family.finite_horizon for family in families}) == 1 else np.concatenate(rows)


def _draws(tables: Sequence[Table], first: np.ndarray, count: int) -> np.ndarray | None:
    """Return the rows (R, P) from which the episodes of each row draw. A family without draws has its own row."""
    drawn = [table.draws for table in tables]
    widths = {draws.shape[1] for draws in drawn if draws is not None}
    if not widths:
        return None
    if len(widths) > 1:
        raise InputError(f"families of a mixture must draw alike; give all the same num-draws, not {sorted(widths)}")
    rows = np.repeat(np.arange(count)[:, None], widths.pop(), axis=1)
    for begin, draws in zip(first, drawn, strict=True):
        if draws is not None:
            rows[begin : begin + len(draws)] = begin + draws
    return rows


def mixed_spec(families: dict[str, Family], sentences: tuple[str, ...]) -> Spec:
    """Return the sizes of observation, action and context, those of the widest family.

    Args:
        families: by their names in the mixture.

    Raises:
        InputError: the families are not seen alike, or do not act alike.
    """
    specs = {name: family.spec for name, family in families.items()}
    _require_one_look(specs)
    _require_one_kind(specs, any(isinstance(family, Choosing) for family in families.values()))
    found = list(specs.values())
    widest: Any = jax.ShapeDtypeStruct((max(map(frames.state_size, found)),), np.float32)
    obs = frames.with_state(lambda _: widest, frames.joined(found[0].obs))
    if frames.shown(obs):
        obs |= {frames.PICTURES: max((spec.obs[frames.PICTURES] for spec in found), key=lambda x: x.shape[-1])}
    return Spec(
        obs=obs,
        action=max((spec.action for spec in found), key=lambda action: action.size),
        context_size=mixed_contexts(list(families.values())).shape[1],
        mixed=len(families) > 1 and not _need_one_scale(list(families.values())),
        frames=found[0].frames,
        sentences=sentences,
    )


def _need_one_scale(families: Sequence[Family]) -> bool:
    """Return whether all tasks have one normaliser: all observe the same, and tasks of some family train none."""
    observed = {family.observes for family in families}
    return len(observed) == 1 and "" not in observed and any(not family.counts["train"] for family in families)


def _require_one_look(specs: dict[str, Spec]) -> None:
    """Refuse to mix families with and without pictures, or with pictures of several shapes."""
    (first, look), *rest = ((name, _look(spec)) for name, spec in specs.items())
    other = next((x for x in rest if x[1] != look), None)
    if other is not None:
        raise InputError(
            f"families of a mixture are seen alike: {first} shows {look} and {other[0]} {other[1]}; "
            "give all the same pixels, frames, grey and state"
        )


def _look(spec: Spec) -> str:
    """Return what an observation shows, as text; of single pictures without their channels, which may differ."""
    if not frames.shown(spec.obs):
        return "no pictures"
    beside = "" if frames.state(frames.joined(spec.obs)) is None else " beside a state"
    shape = spec.obs[frames.PICTURES].shape
    return f"{spec.frames} pictures {shape if spec.frames > 1 else shape[:2]}{beside}"


def _require_one_kind(specs: dict[str, Spec], scored: bool) -> None:
    """Refuse to mix families with continuous actions and with discrete ones."""
    (first, kind), *rest = ((name, spec.action.kind) for name, spec in specs.items())
    other = next((x for x in rest if x[1] != kind), None)
    if other is not None:
        told = f"{first} has {kind} actions and {other[0]} {other[1]} ones"
        fix = "; scores=True (--env.scores) makes discrete ones continuous" if scored else ""
        raise InputError(f"families of a mixture act alike, as one policy draws for all: {told}{fix}")
