"""The command ``python -m mtjax.evaluate``: score, plot and film a trained run on every task of every split."""

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mtjax import shipped
from mtjax.config import from_json
from mtjax.envs import Family
from mtjax.evaluation import Scores, evaluate, of_tasks
from mtjax.report import diagnostics, figures, films
from mtjax.report.tables import task_table
from mtjax.training.export import export
from mtjax.training.log import append_rows, number
from mtjax.training.policy import Policy, load, load_experience
from mtjax.training.programs import compile_lowered, enable_compile_cache, trace
from mtjax.types import SPLITS, InputError, Task

_FIRST_NUMBER = 1_000_000  # beyond the numbers of a run's own evaluations, so that the episodes are new


def report(request: Any, vary: Mapping[str, str]) -> None:
    """Score a run, print the table, and write table, plot and film into a new folder inside the run's folder.

    Of a policy that comes with the package the table is printed. The rest is only written beside a film, into runs/.

    Args:
        request: the settings of ``mtjax.evaluate``.
        vary: values of parameters for tasks of its own, by name; without any, the run's tasks are scored.
    """
    enable_compile_cache()
    run = request.run
    first = _first_seed(run, request.point)
    policy = load(run, first, request.checkpoint)
    if request.video:
        films.require(policy.env)
    if request.export:
        print(f"exported to {export(policy, request.export)}", flush=True)
    found = diagnostics.diagnose(policy, *load_experience(run, first)) if request.diagnostics else None
    trained, named = policy.env, {"train": "given"} if vary or request.task_seed >= 0 else {}
    if vary:
        policy = dataclasses.replace(policy, env=on_values(trained, vary))
        print(f"trained on {trained.ends or 'one task'}; scored on {policy.env.ends or 'one task'}")  # type: ignore
    elif request.task_seed >= 0:
        policy = dataclasses.replace(policy, env=drawn_anew(trained, request.task_seed))
        print(f"tasks and goals are drawn by the seed {request.task_seed}")
    tasks = policy.env.tasks("all")
    tasks = as_unseen(tasks, trained) if named else tasks
    chosen = films.choose(policy.env, request.video_splits, request.video_tasks) if request.video else ()
    scores = score(policy, request.episodes, request.seed, tasks)
    print(task_table(policy, scores, named), flush=True)
    if policy.agent.unseen:
        print(f"unseen tasks: {policy.agent.unseen}")
    if shipped.is_shipped(shipped.folder(run)) and not chosen:
        return
    directory = _new_folder(_place(run))  # only now, as the run may be in a folder that others own
    _write(policy, {named.get(split, split): x for split, x in scores.items()}, directory, named)
    if found is not None:
        print(diagnostics.table(policy, found))
        diagnostics.write(policy, found, directory)
    if chosen:
        films.write(policy, tasks, chosen, request.video_seconds, request.seed, directory / "film", named)
    print(f"written to {directory}")


def on_values(env: Any, vary: Mapping[str, Any]) -> Any:
    """Return a family with other values of its parameters, all in its training split, with contexts scaled as before.

    Raises:
        InputError: it is a mixture, or has no such parameter or value.
    """
    if not isinstance(env, Family):
        raise InputError("other values are for runs of one family, and this run is of a mixture")
    own = {name: values for name, values in env.vary if name not in vary}
    made = dataclasses.replace(env, vary={**own, **vary}, combine="grid", split="none")
    return made.scaled_as(env)


def drawn_anew(env: Any, seed: int) -> Any:
    """Return a family, or a mixture, whose goals or tasks another seed draws, with contexts scaled as before."""
    if isinstance(env, Family):
        return dataclasses.replace(env, task_seed=seed).scaled_as(env)
    return dataclasses.replace(env, families=tuple(drawn_anew(family, seed) for family in env.families))


def as_unseen(tasks: Task, env: Any) -> Task:
    """Number tasks (T,) for an agent that learned in ``env``: a task that it learned by its number, others beyond all.

    The numbers between are those of the held-out tasks of ``env``, which have sentences of their own.
    """
    trained, count = env.tasks("train"), len(env.tasks("all").id)
    same = np.all(np.isclose(np.asarray(tasks.context)[:, None], np.asarray(trained.context), atol=1e-5), axis=-1)
    known = same.any(axis=1)
    return tasks._replace(
        id=jnp.asarray(np.where(known, same.argmax(axis=1), count + np.arange(len(known))), jnp.int32)
    )


def _first_seed(run: str, point: int) -> int:
    """Return the first entry of S that belongs to a setting."""
    config = from_json(shipped.folder(run) / "config.json")
    if not 0 <= point < max(len(config.points), 1):
        raise InputError(f"point must be from 0 to {max(len(config.points), 1) - 1}, not {point}")
    return point * config.plan.seeds


def score(policy: Policy, episodes: int, seed: int = 0, tasks: Task | None = None) -> dict[str, Scores]:
    """Return the scores (S, T, episodes) of each split, in episodes that no training run has seen.

    Args:
        tasks: all tasks of the policy's environment, if they are numbered anew.
    """
    env = policy.env
    tasks = env.tasks("all") if tasks is None else tasks
    arguments = policy.states, tasks, policy.seeds, jnp.int32(_FIRST_NUMBER + seed)
    found = compile_lowered(trace(evaluate, env, policy.agent, episodes, *arguments).lower(), "seldom")(*arguments)
    return {split: of_tasks(found, np.asarray(env.tasks(split).id)) for split in SPLITS}


def _place(run: str) -> Path:
    """Return where a run's evaluations are written. Those of a policy of the package are with the user's own runs."""
    if not shipped.is_shipped(shipped.folder(run)):
        return Path(run)
    place = Path("runs") / run.replace("/", "-")
    place.mkdir(parents=True, exist_ok=True)
    return place


def _new_folder(run: Path) -> Path:
    for attempt in range(1, 10_000):
        with contextlib.suppress(FileExistsError):
            (run / f"evaluation-{attempt}").mkdir()
            return run / f"evaluation-{attempt}"
    raise InputError(f"{str(run)!r} is full of evaluations; move some away")


def _write(policy: Policy, scores: dict[str, Scores], directory: Path, named: Mapping[str, str]) -> None:
    env, (name, unit), called = policy.env, policy.env.task_axis, lambda split: named.get(split, split)
    tasks = {called(split): _columns(env, split) for split in SPLITS}
    rows = [
        {"split": split, **task, "seed": int(seed), "episode": e, "return": number(found.returns[s, t, e])}
        | {metric: number(x[s, t, e]) for metric, x in found.metrics.items()}
        for split, found in scores.items()
        for s, seed in enumerate(policy.seeds)
        for t, task in enumerate(tasks[split])
        for e in range(found.returns.shape[2])
    ]
    append_rows(directory / "returns.csv", rows)
    file, returns = directory / f"return_by_{name.replace('-', '_')}.png", {x: of.returns for x, of in scores.items()}
    if len(env.parts) > 1:
        return figures.return_by_task(file, {called(split): env.labels(split) for split in SPLITS}, returns)
    values = {called(split): env.task_values(split) for split in SPLITS}
    figures.return_by_parameter(file, name, unit, values, returns)


def _columns(env: Any, split: str) -> list[dict[str, str]]:
    """Return what names each task of a split in a file: its value or number, and all values where several vary."""
    if len(env.parts) > 1:
        return [{env.task_axis[0]: label} for label in env.labels(split)]
    values = env.params(split) if len(env.varied) > 1 else {}
    found = [{env.task_axis[0]: number(x)} for x in env.task_values(split)]
    return [one | {name: number(x[t]) for name, x in values.items()} for t, one in enumerate(found)]
