"""Runs on disk, read for tables and figures: what each agent scored on each family, with all of its seeds."""

import glob
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from mtjax.agents import name_of, settings
from mtjax.checks import path
from mtjax.config import RunConfig
from mtjax.envs import name_of as env_name_of
from mtjax.learning.evaluation import Evaluations, as_one_seed
from mtjax.learning.populations import Samples
from mtjax.names import InputError, nearest_error, notice, public
from mtjax.saved.config_json import from_json
from mtjax.saved.folder import evaluations_of
from mtjax.saved.tables import frame_of, members, pandas

_WORDS = {"success": "success at the end", "success_ever": "success at any step"}


class Found(NamedTuple):
    """A run that was read from its folder."""

    directory: Path
    config: RunConfig
    evaluations: Evaluations
    settings: dict[str, str]  # those that a sweep sets for the whole run, outside its points


class Learned(NamedTuple):
    """What one agent, with one setting, scored on one family."""

    env: str
    agent: str  # with the settings that tell it from others
    steps: np.ndarray  # (V,)
    returns: Mapping[str, np.ndarray]  # split -> (S, V, T, episodes)
    values: Mapping[str, np.ndarray]  # split -> (T,) of the varied parameter, or task numbers
    axis: tuple[str, str]  # name and unit of ``values``
    seeds: tuple[int, ...] = ()
    metrics: Mapping[str, Mapping[str, np.ndarray]] = MappingProxyType({})  # name -> as returns
    score: str = "return"  # what ``returns`` are, in words

    def final(self, split: str = "train") -> np.ndarray:
        """Return the last evaluation's mean returns (S, T)."""
        return self.returns[split][:, -1].mean(axis=-1)


def read(pattern: str | Path | Iterable[str | Path]) -> list[Found]:
    """Read the runs of folders or patterns, also those inside the folders of sweeps.

    Raises:
        InputError: there is no run with an evaluation, or a file of one cannot be read.
    """
    several = isinstance(pattern, Iterable) and not isinstance(pattern, str | Path) and getattr(pattern, "ndim", 1)
    given: list[Any] = list(pattern) if several else [pattern]  # type: ignore
    folders = [folder for each in given for folder in _folders(str(path(each, "runs")))]
    done = [folder for folder in dict.fromkeys(folders) if (folder / "evaluations.npz").exists()]
    if not done:
        above = next((each for each in map(str, given) if any(Path(each).glob("*/config.json"))), None)
        hint = "" if above is None else f"; its folders hold runs: {str(Path(glob.escape(above)) / '*')!r}"
        raise InputError(f"there is no run with an evaluation in {', '.join(map(str, given)) or 'an empty list'}{hint}")
    return [_read(folder, done) for folder in done]


def _folders(pattern: str) -> list[Path]:
    """Return the runs in a folder of this name, or else in those that a pattern matches."""
    places = [Path(pattern)] if Path(pattern).exists() else sorted(map(Path, glob.glob(pattern)))
    number = lambda run: int(re.sub(r"\D", "", run.name) or 0)
    inside = [[place, *sorted(place.glob("run-*"), key=number)] for place in places]
    return [folder for group in inside for folder in group if (folder / "config.json").is_file()]


def _read(directory: Path, beside: Sequence[Path]) -> Found:
    config = from_json(directory / "config.json", beside)
    named = (word.removeprefix("agent.").partition("=")[::2] for word in config.sweep)
    outside = {name: values for name, values in named if name.replace("-", "_") not in _swept(config)}
    return Found(directory, config, evaluations_of(config, directory), outside)


def _swept(config: RunConfig) -> set[str]:
    return {name for point in config.points for name in point}


def learned(runs: Any) -> list[Learned]:
    """Return what was learned in runs: seeds of equal settings together, others apart under names that differ.

    Args:
        runs: patterns or folders as for ``read``, a result of ``mtjax.train``, any of these by name in a mapping, or a
            list of ``Learned`` already.
    """
    if isinstance(runs, Mapping):
        return [_renamed(one, str(name)) for name, run in runs.items() for one in learned(run)]
    if hasattr(runs, "evaluations"):
        return _of_result(runs)
    if isinstance(runs, Sequence) and runs and all(isinstance(x, Learned) for x in runs):
        return list(runs)
    apart = [one for found in read(runs) for one in _points(found)]
    groups: dict[Any, list] = {}
    for key, config_settings, one in apart:
        groups.setdefault(repr(key), []).append((config_settings, one))
    joined = [(group[0][0], _join([one for _, one in group])) for group in groups.values()]
    return _named(joined)


def _renamed(one: Learned, name: str) -> Learned:
    """Return what an agent learned under another name; the settings that tell it from others stay."""
    _, comma, told = one.agent.partition(", ")
    return one._replace(agent=f"{name}{comma}{told}")


def _of_result(result: Any) -> list[Learned]:
    """Return what was learned at every point of a result of ``mtjax.train``."""
    found, env, agent = result.evaluations, result.env, name_of(result.agent)
    points, seeds = Samples.of(result.points, result.seeds, result.population)
    if rule := result.population:
        found, agent = _of_population(found, rule), f"{agent}, {rule}"
    made, count = [], len(seeds)
    for p, point in enumerate(points):
        name = ", ".join([agent, *(f"{k.replace('_', '-')} {_short(x)}" for k, x in point.items())])
        of_point = _rows(found, slice(p * count, (p + 1) * count))
        made.append(
            Learned(
                env_name_of(env),
                name,
                found.steps,
                of_point.returns,
                found.values,
                env.task_axis,
                seeds,
                of_point.metrics,
            )
        )
    return made


def _points(found: Found) -> Iterable[tuple[Any, dict[str, Any], Learned]]:
    """Yield every point of a run: what must be equal for its seeds to be joined, its settings, and what it learned."""
    config, evaluations, name = found.config, found.evaluations, found.config.agent
    (points, seeds), family = config.samples, config.family
    common = {**settings(config.learner), **vars(config.training)}
    if rule := config.plan.population:
        evaluations, name = _of_population(evaluations, rule), f"{name}, {rule}"
        common |= {"members": config.members, "sweep": " ".join(config.sweep)}
    count = len(seeds)
    for p, point in enumerate(points):
        mine = _rows(evaluations, slice(p * count, (p + 1) * count))
        own = {**common, **point}
        one = Learned(
            config.env,
            name,
            evaluations.steps,
            mine.returns,
            evaluations.values,
            family.task_axis,
            seeds,
            mine.metrics,
        )
        plan = config.plan
        shape = (evaluations.steps.tolist(), plan.eval_episodes, plan.eval_sampled, config.start)
        yield (config.env, name, family, sorted(own.items(), key=str), shape), own, one


def _of_population(evaluations: Evaluations, rule: str) -> Evaluations:
    """Return the means over a population's members, as those of one seed, and say that they have no intervals."""
    members = len(evaluations.returns["train"])
    notice(f"{rule}: {members} members of a population copy each other, count as one seed, and have no intervals")
    return as_one_seed(evaluations)


def _join(parts: list[Learned]) -> Learned:
    """Return the seeds of several runs together; a seed that was run twice counts once."""
    seeds: dict[int, tuple[Learned, int]] = {}
    for part in parts:
        for i, seed in enumerate(part.seeds):
            seeds.setdefault(seed, (part, i))
    stack = lambda of: {split: np.stack([of(part)[split][i] for part, i in seeds.values()]) for split in of(parts[0])}
    known = [name for name in parts[0].metrics if all(name in part.metrics for part in parts)]
    metrics = {name: stack(lambda part, name=name: part.metrics[name]) for name in known}
    return parts[0]._replace(returns=stack(lambda part: part.returns), seeds=tuple(seeds), metrics=metrics)


def _rows(evaluations: Evaluations, seeds: slice) -> Evaluations:
    """Return the evaluations of some entries of S."""
    of = lambda scores: {split: x[seeds] for split, x in scores.items()}
    metrics = {name: of(scores) for name, scores in evaluations.metrics.items()}
    return evaluations._replace(returns=of(evaluations.returns), metrics=metrics, seeds=evaluations.seeds[seeds])


def of_metric(runs: Any, metric: str) -> list[Learned]:
    """Return what was learned in runs, with a metric in the place of returns, such as "success" or "success_ever".

    Raises:
        InputError: a run does not have the metric, or some of its tasks do not.
    """
    found = []
    for one in learned(runs):
        if metric not in one.metrics:
            raise nearest_error(f"metric of {one.env}", metric, ("return", *one.metrics))
        scores = one.metrics[metric]
        if not all(np.isfinite(x).all() for x in scores.values()):
            raise InputError(f"not all tasks of {one.env} tell {metric}")
        found.append(one._replace(returns=scores, score=_WORDS.get(metric, metric)))
    return found


def _named(found: list[tuple[dict[str, Any], Learned]]) -> list[Learned]:
    """Add to agents of one name on one family the settings in which they differ."""
    made = []
    for own, one in found:
        others = [s for s, other in found if (other.env, other.agent) == (one.env, one.agent)]
        differ = [name for name in own if any(s.get(name) != own[name] for s in others)]
        told = ", ".join(f"{name.replace('_', '-')} {_short(own[name])}" for name in differ[:3])
        made.append(one._replace(agent=f"{one.agent}{', ' * bool(told)}{told}"))
    return made


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@public
def runs(pattern: str | Path | Iterable[str | Path] = "runs/*") -> Any:
    """Return all evaluations of runs as one table, with the columns run, env, agent and swept settings first.

    Args:
        pattern: a folder, a pattern such as "runs/*", or several of them. Runs of sweeps are found inside.

    Raises:
        InputError: there is no such run, or pandas is missing.
    """
    made = []
    for found in read(pattern):
        config = found.config
        fixed = {"run": str(found.directory), "env": config.env, "agent": config.agent, **found.settings}
        axis = config.plan.all_seeds, config.points
        axis = members([*axis[0]] * max(len(axis[1]), 1)) if config.plan.population else axis
        made.append(frame_of(config.family, found.evaluations, *axis, **fixed))
    return pandas().concat(made, ignore_index=True)
