"""The command ``python -m mtjax.evaluate``: score, plot and film a trained run on every task of every split."""

import contextlib
import operator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.config import from_json
from mtjax.envs import Domain
from mtjax.envs.family import Part
from mtjax.evaluation import Recording, evaluate, record
from mtjax.report import diagnostics, figures, render
from mtjax.report.tables import task_table
from mtjax.training.log import append_rows, number
from mtjax.training.policy import Policy, load, load_experience
from mtjax.training.programs import compile_lowered, enable_compile_cache, trace
from mtjax.types import SPLITS, InputError

_FIRST_NUMBER = 1_000_000  # beyond the numbers of a run's own evaluations, so that the episodes are new
_FILM_FPS, _FILM_SECONDS = 25, 10


def report(run: str, point: int, episodes: int, seed: int, video: bool, diagnose: bool) -> None:
    """Score a run, print the table, and write table, plot and films into a new folder inside the run's folder.

    Args:
        point: number of the setting, if the run holds several settings of a sweep.
        episodes: episodes of each task and seed.
        seed: seed of the starting states.
        video: film an episode of each task.
        diagnose: write the diagnostics of the agent, from the run's replay.
    """
    enable_compile_cache()
    first = _first_seed(run, point)
    policy = load(run, first)
    if video and not any(isinstance(part.family, Domain) for part in policy.env.parts):
        raise InputError("only MuJoCo families can be filmed; leave out --video")
    found = diagnostics.diagnose(policy, *load_experience(run, first)) if diagnose else None
    scores = score(policy, episodes, seed)
    directory = _new_folder(Path(run))
    print(task_table(policy, scores))
    if policy.agent.unseen:
        print(f"unseen tasks: {policy.agent.unseen}")
    _write(policy, scores, directory)
    if found is not None:
        print(diagnostics.table(policy, found))
        diagnostics.write(policy, found, directory)
    if video:
        _film(policy, directory, seed)
    print(f"written to {directory}")


def _first_seed(run: str, point: int) -> int:
    """Return the first entry of S that belongs to a setting."""
    config = from_json(Path(run) / "config.json")
    if not 0 <= point < max(len(config.points), 1):
        raise InputError(f"point must be from 0 to {max(len(config.points), 1) - 1}, not {point}")
    return point * config.plan.seeds


def score(policy: Policy, episodes: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the returns (S, T, episodes) of each split, in episodes that no training run has seen."""
    env = policy.env
    arguments = policy.states, env.tasks("all"), policy.seeds, jnp.int32(_FIRST_NUMBER + seed)
    scores = compile_lowered(trace(evaluate, env, policy.agent, episodes, *arguments).lower())(*arguments)
    returns = np.asarray(scores.returns)
    return {split: returns[:, np.asarray(env.tasks(split).id)] for split in SPLITS}


def _new_folder(run: Path) -> Path:
    for attempt in range(1, 10_000):
        with contextlib.suppress(FileExistsError):
            (run / f"evaluation-{attempt}").mkdir()
            return run / f"evaluation-{attempt}"
    raise InputError(f"{str(run)!r} is full of evaluations; move some away")


def _write(policy: Policy, episodes: dict[str, np.ndarray], directory: Path) -> None:
    env, (name, unit), many = policy.env, policy.env.task_axis, len(policy.env.parts) > 1
    labels = {split: env.labels(split) if many else map(number, env.task_values(split)) for split in episodes}
    labels = {split: list(found) for split, found in labels.items()}
    rows = [
        {"split": split, name: label, "seed": int(seed), "episode": e, "return": number(x)}
        for split, returns in episodes.items()
        for seed, of_seed in zip(policy.seeds, returns, strict=True)
        for label, of_task in zip(labels[split], of_seed, strict=True)
        for e, x in enumerate(of_task)
    ]
    append_rows(directory / "returns.csv", rows)
    file = directory / f"return_by_{name.replace('-', '_')}.png"
    if many:
        return figures.return_by_task(file, labels, episodes)
    figures.return_by_parameter(file, name, unit, {split: env.task_values(split) for split in episodes}, episodes)


def _film(policy: Policy, directory: Path, seed: int) -> None:
    """Film the start of one episode of every task of the MuJoCo families, in real time."""
    env = policy.env
    render.choose_backend()
    played = record(env, policy.agent, policy.state, env.tasks("all"), jnp.int32(seed))
    for part, states in zip(env.parts, env.apart(played.states), strict=True):
        if isinstance(part.family, Domain):
            _film_family(policy, part, played._replace(states=states), directory)
        else:
            print(f"{part.name} has no model to film")


def _film_family(policy: Policy, part: Part, played: Recording, directory: Path) -> None:
    """Film the tasks of one family from the states in ``played``."""
    family: Any = part.family
    stride = max(round(1 / (_FILM_FPS * family.seconds_per_step)), 1)
    fps, longest = 1 / (stride * family.seconds_per_step), round(_FILM_SECONDS / family.seconds_per_step)
    for split in SPLITS:
        for i in family.table.rows[split]:
            place = part.places["all"][i]
            row = int(played.rows[place])  # continuous ranges have a row for each episode
            shown = slice(0, min(longest, int(played.lengths[place])), stride)
            states = jax.tree.map(operator.itemgetter((i, shown)), played.states)
            frames = render.film(family, policy.env.own_row(row), states)
            named = f"{split}-{policy.env.describe(row)}".replace("=", "-").replace(" ", "-")
            path = render.write_video(directory / named, frames, fps)
            print(f"filmed {path.name}: return {float(played.returns[place]):.0f}", flush=True)
