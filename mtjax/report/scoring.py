"""Evaluation of a trained run: ``mtjax.evaluate`` in Python, and the command, which also writes, plots and films."""

import contextlib
import dataclasses
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mtjax.agents.base import judged
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.checks import amount, path, require_episodes
from mtjax.compiling.programs import compile_lowered, enable_compile_cache, trace
from mtjax.envs import Family
from mtjax.envs.engines import host
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.envs.naming import ends
from mtjax.learning import evaluation, trials
from mtjax.learning.evaluation import Episodes, Scores, of_tasks
from mtjax.names import nearest_error, public
from mtjax.report import diagnostics, figures, films
from mtjax.report.tables import task_table
from mtjax.report.waiting import telling
from mtjax.saved import pretrained
from mtjax.saved.config_json import from_json
from mtjax.saved.export import export
from mtjax.saved.log import append_rows, number
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.saved.tables import pandas
from mtjax.types import SPLITS, InputError, Task

_EPISODES = 10  # of each task, if nothing else is asked for
_FIRST_NUMBER = 1_000_000  # beyond the numbers of a run's own evaluations, so that the episodes are new
GIVEN = {"train": "given"}  # the name of the split of tasks that are not the run's own


class Evaluation(NamedTuple):
    """Holds every episode of an evaluation. Tasks of ``vary`` or ``task_seed`` are the split "given"."""

    returns: dict[str, np.ndarray]  # split -> (S, T, episodes), undiscounted
    metrics: dict[str, dict[str, np.ndarray]]  # name -> split -> (S, T, episodes), such as success
    values: dict[str, np.ndarray]  # split -> (T,) value of the varying parameter
    seeds: tuple[int, ...]  # (S,)
    env: FamilyOrMixture  # whose tasks were played

    def __repr__(self) -> str:
        """Return a line: the mean return of every split."""
        count = lambda x: f"{x.shape[1]} task{'s' * (x.shape[1] != 1)}"
        means = [f"{split} {amount(x.mean())} ({count(x)})" for split, x in self.returns.items() if x.size]
        return f"Evaluation(return {', '.join(means)}; {len(self.seeds)} seed{'s' * (len(self.seeds) > 1)})"

    @public
    def frame(self) -> Any:
        """Return a pandas table with a row for each episode: seed, split, task and its parameters, return, metrics.

        Raises:
            InputError: pandas is missing.
        """
        rows = []
        for split, returns in self.returns.items():
            own = "train" if split in GIVEN.values() else split
            params, scores = self.env.params(own), {"return": returns} | {k: x[split] for k, x in self.metrics.items()}
            for s, t, e in np.ndindex(*returns.shape):
                row = {"seed": self.seeds[s], "split": split, "task": t, **{name: x[t] for name, x in params.items()}}
                rows.append(row | {"episode": e} | {name: float(x[s, t, e]) for name, x in scores.items()})
        return pandas().DataFrame(rows)


@public
def evaluate(
    run: Result | Policy | str | Path,
    *,
    vary: Mapping[str, Any] | None = None,
    split: str | None = None,
    episodes: int | None = None,
    sampled: bool = False,
    seed: int = 0,
    task_seed: int | None = None,
    point: int = 0,
    checkpoint: int = 0,
    quiet: bool = False,
) -> Evaluation:
    """Play episodes that no training has seen, as ``python -m mtjax.evaluate`` does, and return every return.

    Args:
        run: a result of ``mtjax.train``; a run's folder; the name of a policy that comes with the package, such as
            "finger-spin-vary-size/sac-conditioned"; or a policy of ``mtjax.load``, which plays alone. All others play
            with all their seeds.
        vary: other values of parameters than the run's, by name: ``{"size": "0.9:1.3:5"}`` or a list.
        split: the split to play: train, interpolation or extrapolation. None plays all.
        episodes: of each task and seed; None plays ten, or as many more as whole trials take.
        sampled: draw actions from the policy; else they are its mean ones, or the likeliest choices.
        seed: seed of the starting states.
        task_seed: seed of other goals than the run's, or other tasks, where they are drawn.
        point: number of the setting, if the run holds several settings of a sweep; of a population, of the member,
            which plays alone.
        checkpoint: iteration of the checkpoint, if ``run`` is a folder; 0 takes the newest.
        quiet: print nothing. Else what is played, how much of it is done and the time that is left are told, if it
            takes longer than two seconds.

    Raises:
        InputError: there is no such run, or an argument cannot be used.
    """
    require_episodes(episodes, seed, task_seed, checkpoint)
    if split is not None and split not in SPLITS:
        raise nearest_error("split", str(split), SPLITS)
    if split is not None and (vary or task_seed is not None):
        raise InputError("tasks of vary and task_seed belong to no split of the run; leave out split")
    if vary and task_seed is not None:
        raise InputError("task_seed draws other tasks; leave out vary")
    policy, tasks, named = with_tasks(_policy(run, point, checkpoint), vary or {}, task_seed)
    if split is not None and not len(policy.env.tasks(split).id):
        raise InputError(f"this run has no tasks of the split {split}")
    played = _played(policy, episodes, sampled)
    with telling(_playing(policy, played, split or "all"), quiet) as tell:
        scores = score(policy, played, seed, tasks, split or "all", tell)
    found = {named.get(name, name): (name, one) for name, one in scores.items() if one.returns.size}
    metrics = list(next(iter(scores.values())).metrics)
    return Evaluation(
        {split: np.asarray(one.returns) for split, (_, one) in found.items()},
        {name: {split: np.asarray(one.metrics[name]) for split, (_, one) in found.items()} for name in metrics},
        {split: policy.env.task_values(own) for split, (own, _) in found.items()},
        tuple(np.asarray(policy.seeds).tolist()),
        policy.env,
    )


def _policy(run: Any, point: int, checkpoint: int) -> Policy:
    """Return the policy of a run's first seed, with the states of all its seeds; a policy stays one of one seed."""
    if not isinstance(run, Result | Policy):
        folder = path(run, "run")
        return load(folder, first_seed(str(folder), point), checkpoint)
    if checkpoint:
        raise InputError("checkpoint is of a run's folder; give that, or mtjax.load(folder, checkpoint=...)")
    if not isinstance(run.env, FamilyOrMixture):
        raise InputError(f"evaluate plays families of tasks, not a {type(run.env).__name__}")
    if isinstance(run, Policy):
        return run.alone()
    return run.policy(_entry(point, len(run.points), len(run.seeds), run.population))


def with_tasks(
    policy: Policy, vary: Mapping[str, Any], task_seed: int | None
) -> tuple[Policy, Task | None, dict[str, str]]:
    """Return a policy with the tasks to play, those tasks if they are not the run's, and their split's other name."""
    trained, env = policy.env, other_tasks(policy.env, vary, task_seed)
    if env is trained:
        return policy, None, {}
    return dataclasses.replace(policy, env=env), as_unseen(env.tasks("all"), trained), GIVEN


def other_tasks(env: FamilyOrMixture, vary: Mapping[str, Any], task_seed: int | None) -> FamilyOrMixture:
    """Return an environment with tasks of its own, as ``on_values`` or ``drawn_anew``; itself if none are asked for."""
    if vary:
        return on_values(env, vary)
    return env if task_seed is None else drawn_anew(env, task_seed)


def report(request: Any, vary: Mapping[str, str]) -> None:
    """Score a run, print the table, and write table, plot and film into a new folder inside the run's folder.

    Of a policy that comes with the package the table is printed. The rest is only written beside a film, into runs/.

    Args:
        request: the settings of ``mtjax.evaluate``.
        vary: values of parameters for tasks of its own, by name; without any, the run's tasks are scored.
    """
    enable_compile_cache()
    run = request.run
    first = first_seed(run, request.point)
    policy = load(run, first, request.checkpoint)
    played = _played(policy, request.asked, request.sampled)
    if request.video:
        films.require(policy.env)
    if request.export:
        print(f"exported to {export(policy, request.export)}", flush=True)
    found = None
    if request.diagnostics:
        with telling("measuring gradients and units"):
            found = diagnostics.diagnose(*diagnostics.with_experience(policy, run, first))
    trained = policy.env
    policy, tasks, named = with_tasks(policy, vary, request.drawn)
    if vary:
        print(f"trained on {ends(trained) or 'one task'}; scored on {ends(policy.env) or 'one task'}")  # type: ignore
    elif named:
        print(f"tasks and goals are drawn by the seed {request.task_seed}")
    tasks = policy.env.tasks("all") if tasks is None else tasks
    chosen = films.choose(policy.env, request.video_splits, request.video_tasks) if request.video else ()
    with telling(_playing(policy, played), at_once=True) as tell:
        scores = score(policy, played, request.seed, tasks, tell=tell)
    print(task_table(policy, scores, named), flush=True)
    if told := describe_unseen(policy.agent):
        print(f"unseen tasks: {told}")
    if population := from_json(pretrained.folder(run) / "config.json").plan.population:
        print(f"number {request.point} of a population ({population}), of whose members there are no intervals")
    if pretrained.is_pretrained(pretrained.folder(run)) and not chosen:
        if any(part.family.films for part in policy.env.parts):
            print(f"look at it: python -m mtjax.evaluate {shlex.join([f'--run={run}', '--video'])}")
        return
    directory = _new_folder(_place(run))  # only now, as the run may be in a folder that others own
    _write(policy, {named.get(split, split): x for split, x in scores.items()}, directory, named)
    if found is not None:
        print(diagnostics.table(policy, found))
        diagnostics.write(policy, found, directory)
    if chosen:
        place = directory / "film"
        films.write(policy, tasks, chosen, request.video_seconds, request.seed, place, named, request.sampled)
    print(f"written to {directory}")


def on_values(env: FamilyOrMixture, vary: Mapping[str, Any]) -> Family:
    """Return a family with other values of its parameters, all in its training split, with contexts scaled as before.

    Raises:
        InputError: it is a mixture, or has no such parameter or value.
    """
    if not isinstance(env, Family):
        raise InputError("other values are for runs of one family, and this run is of a mixture")
    own = {name: values for name, values in env.vary if name not in vary}
    made = dataclasses.replace(env, vary={**own, **vary}, combine="grid", split="none")
    return made.scaled_as(env)


def drawn_anew(env: FamilyOrMixture, seed: int) -> FamilyOrMixture:
    """Return a family, or a mixture, whose goals or tasks another seed draws, with contexts scaled as before."""
    if isinstance(env, Family):
        return dataclasses.replace(env, task_seed=seed).scaled_as(env)
    return dataclasses.replace(env, families=tuple(drawn_anew(family, seed) for family in env.families))


def as_unseen(tasks: Task, env: FamilyOrMixture) -> Task:
    """Number tasks (T,) for an agent that learned in ``env``: a task that it learned by its number, others beyond all.

    The numbers between are those of the held-out tasks of ``env``, which have sentences of their own.
    """
    trained, count = env.tasks("train"), len(env.tasks("all").id)
    same = np.all(np.isclose(np.asarray(tasks.context)[:, None], np.asarray(trained.context), atol=1e-5), axis=-1)
    known = same.any(axis=1)
    return tasks._replace(
        id=jnp.asarray(np.where(known, same.argmax(axis=1), count + np.arange(len(known))), jnp.int32)
    )


def first_seed(run: str, point: int) -> int:
    """Return the first entry of S that belongs to a setting, or the member of a population."""
    config = from_json(pretrained.folder(run) / "config.json")
    return _entry(point, len(config.points), config.plan.seeds, config.plan.population)


def _entry(point: Any, points: int, seeds: int, population: str) -> int:
    """Return the entry of S at which a setting begins, of so many with so many seeds each, or that of a member."""
    count, each = (max(points, 1) * seeds, 1) if population else (max(points, 1), seeds)
    if not isinstance(point, int | np.integer) or not 0 <= point < count:
        raise InputError(f"point must be from 0 to {count - 1}, not {point}")
    return int(point) * each


def _played(policy: Policy, episodes: int | None, sampled: bool) -> Episodes:
    """Return how many episodes of each task are played, and how.

    Raises:
        InputError: they are no whole number of trials.
    """
    count = trials.at_least(_EPISODES, policy.trial) if episodes is None else episodes
    trials.require_whole(count, policy.trial)
    return Episodes(count, policy.trial, sampled)


def _playing(policy: Policy, episodes: Episodes, split: str = "all") -> str:
    """Return the words that say how many episodes of a split are played."""
    return f"playing {episodes.count * len(policy.env.tasks(split).id) * len(policy.seeds):,} episodes"


def score(
    policy: Policy,
    episodes: Episodes,
    seed: int = 0,
    tasks: Task | None = None,
    split: str = "all",
    tell: Callable[[float], None] = lambda share: None,
) -> dict[str, Scores]:
    """Return the scores (S, T, episodes) of each split, in whole trials of episodes that no training run has seen.

    Args:
        tasks: all tasks of the policy's environment, if they are numbered anew.
        split: the split to play alone, in the same episodes; or "all".
        tell: a function to call with the share of the steps that is done, before each part of them.

    Raises:
        InputError: an environment outside of JAX has raised an error.
    """
    env: Any = policy.env
    rows = {name: np.asarray(env.tasks(name).id) for name in (SPLITS if split == "all" else [split])}
    arguments = policy.states, env.tasks(split) if tasks is None else tasks, policy.seeds
    arguments += (jnp.int32(_FIRST_NUMBER + seed), *([] if split == "all" else [jnp.asarray(rows[split])]))
    fixed, learned = (env, judged(policy.agent), episodes), arguments[:2]
    program = trace(evaluation.begin, *fixed, *arguments)
    following = trace(evaluation.play_on, *fixed, *learned, *program.out_info, jnp.int32(0))
    begin, play_on = (compile_lowered(traced.lower(), "seldom") for traced in (program, following))
    with host.explaining():
        keys, playing = begin(*arguments)
        times = evaluation.parts(env, episodes)
        for first in times:
            tell(first / times.stop)
            playing = play_on(*learned, keys, playing, jnp.int32(first))
            if not np.any(playing.alive):
                break
        tell(1.0)
    found = evaluation.by_episode(playing.scores)
    return {split: found} if split in rows else {name: of_tasks(found, places) for name, places in rows.items()}


def _place(run: str) -> Path:
    """Return where a run's evaluations are written. Those of a policy of the package are with the user's own runs."""
    if not pretrained.is_pretrained(pretrained.folder(run)):
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
