"""What tasks are called, of families and of mixtures alike: numbers, values, names and sentences.

All of it follows from the parts of an environment, which are its families. ``Family`` and ``Mixture`` have these
functions as methods and properties.
"""

import itertools
from typing import Any

import numpy as np

from mtjax.envs.parameters import Parameter
from mtjax.envs.task_table import Part, owner
from mtjax.types import SPLITS


def numbers(env: Any, split: str) -> np.ndarray:
    """Return the numbers (T,) of a split's tasks, which are counted through the splits."""
    first = sum(env.counts[before] for before in SPLITS[: SPLITS.index(split)])
    return np.arange(first, first + env.counts[split], dtype=np.int32)


def params(env: Any, split: str) -> dict[str, Any]:
    """Return the values (T,) of the parameters of a split's tasks; of a mixture their names as ``task_name``.

    A value is NaN where every episode draws its own.
    """
    found = env.tasks(split).params
    drawn = () if env.parts[0].name or split != "train" else env.variation.redrawn
    told = {name: np.full(np.shape(x), np.nan) if name in drawn else np.asarray(x) for name, x in found.items()}
    return told or {"task_name": env.labels(split)}


def task_values(env: Any, split: str) -> np.ndarray:
    """Return the values (T,) that tell the tasks of a split apart: the only varied parameter, or task numbers.

    No task is built for them.
    """
    found = _variation_of_one(env)
    return numbers(env, split) if found is None else found.rows[split][:, 0].astype(np.float32)


@property
def task_axis(env: Any) -> tuple[str, str]:
    """Return name and unit of ``task_values``."""
    found = _variation_of_one(env)
    return ("task", "number") if found is None else (found.varied[0], env.every_parameter[found.varied[0]].unit)


def labels(env: Any, split: str) -> list[str]:
    """Return a short name for every task of a split: its ``task_values``, in a mixture after its family's name."""
    found = [""] * env.counts[split]
    for part in env.parts:
        axis = part.family.task_axis[0]
        for place, value in zip(part.places[split], _labels_of(part.family, split), strict=True):
            found[place] = _in_mixture(part, f"{axis}={value}") if part.name else value
    return found


def describe(env: Any, row: int) -> str:
    """Return the task of a row as text: its varied parameters, such as "size=0.95", in a mixture after its family.

    A range stands where every episode of the task draws its own value.
    """
    part, own = owner(env, row)
    family = part.family
    params, found = family.table.tasks.params, family.variation
    drawn = found.redrawn if own < found.counts["train"] else ()
    ranges = {name: f"{low:.4g}:{high:.4g}" for name, low, high in found.ranges if name in drawn}
    tell = lambda name: ranges.get(name) or family.every_parameter[name].tell(float(params[name][own]), 4)
    told = ",".join(f"{name}={tell(name)}" for name in family.varied) or family.called(own)
    return _in_mixture(part, told) if part.name else told


def called(family: Any, row: int) -> str:
    """Return what a task is called that differs from others in no parameter: its number."""
    return f"task={row}"


@property
def sentences(env: Any) -> tuple[str, ...]:
    """Return what the tasks of all splits ask for, in the order of their numbers."""
    every = itertools.product(SPLITS, (part.family for part in env.parts))
    return tuple(family.sentence(row) for split, family in every for row in family.table.rows[split].tolist())


def sentence(env: Any, row: int) -> str:
    """Return what a task of a mixture asks for."""
    part, own = owner(env, row)
    return part.family.sentence(own)


def sentence_of(family: Any, row: int) -> str:
    """Return what a task of a family asks for, and the parameters that are given."""
    found = family.variation
    if not found.names:
        return family.instruction
    draws = found.draws if row < found.counts["train"] else None
    told = []
    for i, name in enumerate(found.names):
        parameter = family.every_parameter[name]
        ranged = draws is not None and np.ptp(draws[row, :, i]) > 0
        value = parameter.tell(float(found.values[name][row]), 3)
        number = f"from {found.low[i]:.3g} to {found.high[i]:.3g}" if ranged else value
        told.append(f"{name.replace('-', ' ')} {number}" + f" {parameter.unit}" * (parameter.unit != "1"))
    return f"{family.instruction.removesuffix('.')}, with {' and '.join(told)}."


@property
def varied(family: Any) -> tuple[str, ...]:
    """Return the parameters that differ between a family's training tasks or episodes."""
    return family.variation.varied


def ends(family: Any) -> str:
    """Return the parameters that vary in a family's training, with their least and greatest values."""
    drawn = dict.fromkeys(family.variation.redrawn, " drawn each episode")
    return ", ".join(f"{name} {low:g} to {high:g}{drawn.get(name, '')}" for name, low, high in family.variation.ranges)


@property
def summary(env: Any) -> str:
    """Return a line on the tasks of an environment."""
    count, families = env.train_count, [part.family for part in env.parts]
    tasks = f"{count} training task{'s' * (count > 1)}"
    if env.parts[0].name:
        kinds = ", ".join(part.name + _extent(part.family) for part in env.parts)
        tasks += f" of {len(families)} famil{'ies' if len(families) > 1 else 'y'}: {kinds};"
    else:
        tasks += f"{', ' * bool(ends(env))}{ends(env)},"
    splits = "/".join(dict.fromkeys(family.split for family in families))
    return f"{tasks} split {splits}, engine {env.engine_name}"


def _extent(family: Any) -> str:
    """Return how many tasks a family of a mixture trains on, and in what they or episodes differ; else nothing."""
    count, told = family.train_count, ends(family)
    return f" ({count}{': ' * bool(told)}{told})" if count > 1 or told else ""


def _variation_of_one(env: Any) -> Any:
    """Return the variation of a family whose tasks differ in one parameter; None of other environments."""
    found = None if env.parts[0].name else env.variation
    return found if found is not None and len(found.varied) == 1 else None


def _labels_of(family: Any, split: str) -> list[str]:
    """Return a short name for every task of a split of a family."""
    found = _variation_of_one(family)
    tell = Parameter("", 0.0).tell if found is None else family.every_parameter[found.varied[0]].tell
    return [tell(float(value), 4) for value in task_values(family, split)]


def _in_mixture(part: Part, told: str) -> str:
    """Return what a task of a family of a mixture is called. One that has a single task is called by its name."""
    return part.name if _has_one_task(part.family) else f"{part.name} {told}"


def _has_one_task(family: Any) -> bool:
    """Return whether a family's name says which of its tasks is meant. Goals that episodes draw are no tasks."""
    return not family.varied and sum(family.counts.values()) == 1
