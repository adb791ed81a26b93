"""A figure of what an agent believes of a hidden task over the steps of a trial, beside what is true."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents.base import BaseAgent, judged
from mtjax.agents.parts.knowing.posterior import Posterior
from mtjax.agents.state import of_task
from mtjax.envs.engines import host
from mtjax.learning.evaluation import Recording, record
from mtjax.learning.rollout import Worlds
from mtjax.names import SPLITS, InputError, nearest_error, public
from mtjax.report import figures, read_runs
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.types import Task, Transition

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 5  # trials
_TRIES = 20  # trials of a task that are played at most, until so many different ones were drawn
_IN_A_LINE = 5  # panels of latents


class Believed(NamedTuple):
    """Holds what was believed before every step of trials that were played; after their ends it is NaN."""

    mean: np.ndarray  # (N, H, Z)
    deviation: np.ndarray  # (N, H, Z)
    foretold: dict[str, tuple[np.ndarray, np.ndarray]]  # (N, H) or (N, H, O) each: predicted of the step, and what came
    names: list[str]  # (N,) of the tasks that were true
    ends: np.ndarray  # (N, K) steps until the episodes ended


@public
def posterior(runs: Any, split: str = "train") -> "list[Axes]":
    """Draw what an agent with ``conditioning=posterior`` believes over the steps of a trial, a colour for each task.

    It plays a trial of some tasks under the mean action of the run's first seed. Each latent has a panel with the
    belief's mean before every step, and its standard deviation as a band. Where models predict steps (varibad, cadm),
    further panels have the reward that was predicted before each step as a line, with the one that came as points; and
    by how much the predicted change of state missed, as a share of the changes' size.

    Args:
        runs: one run: its folder, a result of ``mtjax.train``, or a policy.
        split: whose tasks are played.

    Raises:
        InputError: there are more runs, or the agent has no such belief.
    """
    if split not in SPLITS:
        raise nearest_error("split", split, SPLITS)
    policy = _policy(runs)
    way = policy.agent.conditioning.inference
    return _draw(believed(policy, split), f"{way} on {read_runs.env_name_of(policy.env)}, {split}")


def _policy(runs: Any) -> Policy:
    """Return the policy of the only run's first seed."""
    if isinstance(runs, Mapping) and len(runs) == 1:
        return _policy(next(iter(runs.values())))
    if isinstance(runs, Policy | Result):
        _require(runs.agent)
        return runs if isinstance(runs, Policy) else runs.policy()
    if isinstance(runs, Mapping) or len(found := read_runs.read(runs)) > 1:
        raise InputError("posterior is of one run, and these are several")
    _require(found[0].config.learner)
    return load(found[0].directory)


def _require(agent: BaseAgent) -> None:
    if not isinstance(agent.conditioning, Posterior):
        raise InputError("posterior is of agents that believe something of their task: --agent.conditioning=posterior")


def believed(policy: Policy, split: str = "train") -> Believed:
    """Play a trial of at most ``_SHOWN`` tasks of a split, and return what was believed in them.

    Where trials draw their tasks, more are played until so many are different.
    """
    env, tasks = policy.env, policy.env.tasks(split)
    if not len(tasks.id):
        raise InputError(f"this run has no tasks of the split {split}")
    play = partial(record, env, judged(policy.agent), policy.state, tasks, trial=policy.trial, keep=_keep)
    read = jax.jit(partial(_read, policy.agent))
    with host.explaining():
        played = [play(jnp.int32(0))]
        while tasks.draws is not None and len(played) < _TRIES and len(_rows(played)) < _SHOWN:
            played.append(play(jnp.int32(len(played))))
    found = [read(policy.state, tasks._replace(draws=None), one.kept) for one in played]
    played, (belief, foretold) = jax.tree.map(lambda *x: np.concatenate(x), *zip(played, found, strict=True))
    chosen = _spread(played.rows)
    lasting = np.arange(belief.mean.shape[1]) < played.lengths.sum(axis=1)[:, None]
    of = lambda x: np.where(lasting.reshape(*lasting.shape, *[1] * (x.ndim - 2)), x, np.nan)[chosen]
    names = [env.describe(int(row)) for row in played.rows[chosen]]
    told = {name: (of(predicted), of(came)) for name, (predicted, came) in foretold.items()}
    ends = np.cumsum(played.lengths[chosen], axis=1)
    return Believed(of(belief.mean), of(np.exp(belief.log_var / 2)), told, names, ends)


def _rows(played: Sequence[Recording]) -> np.ndarray:
    """Return the different tasks that were played."""
    return np.unique(np.concatenate([one.rows for one in played]))


def _keep(worlds: Worlds, transition: Transition) -> Transition:
    return transition._replace(extras=None)


def _spread(rows: np.ndarray) -> np.ndarray:
    """Return the places of at most ``_SHOWN`` different tasks, evenly among all."""
    places = np.sort(np.unique(rows, return_index=True)[1])
    return places[np.unique(np.linspace(0, len(places) - 1, _SHOWN).round().astype(int))]


def _read(agent: BaseAgent, state: Any, tasks: Task, steps: Transition) -> tuple[Any, dict[str, Any]]:
    """Return the beliefs (T, H, Z) before steps (T, H, ...), and what they foretell of these, on what came."""
    way = agent.conditioning.way

    def one(task: Task, steps: Transition) -> tuple[Any, dict[str, Any]]:
        nets = of_task(state.nets, state.known(task))
        obs, next_obs = (agent.view.see(nets["inputs"], x) for x in (steps.obs, steps.next_obs))
        seen = steps._replace(obs=obs, action=agent.policy.encode(steps.action), next_obs=next_obs)
        belief = way.belief(nets["knowing"].parts, steps.memory.hidden)
        return belief, way.foretell(nets["knowing"].parts, seen, belief, jax.random.key(0))

    return jax.vmap(one)(tasks, steps)


def _draw(found: Believed, title: str) -> "list[Axes]":
    from matplotlib.figure import Figure

    latents, told = found.mean.shape[-1], _worth_telling(found.foretold)
    columns = min(latents, _IN_A_LINE)
    heights = [1.4] * math.ceil(latents / columns) + [2.0] * bool(told)
    figure = Figure(figsize=(1.6 + 1.5 * columns, 0.6 + sum(heights)), layout="constrained")
    outer, panels = figure.add_gridspec(len(heights), 1, height_ratios=heights), []
    lines = [outer[i].subgridspec(1, columns) for i in range(len(heights) - bool(told))]
    for z in range(latents):
        first = panels[0] if panels else None
        panels.append(figure.add_subplot(lines[z // columns][z % columns], sharex=first, sharey=first))
        _draw_latent(panels[z], found, z)
        panels[z].label_outer()
    below = outer[-1].subgridspec(1, max(len(told), 1))
    for i, (name, each) in enumerate(told.items()):
        panels.append(figure.add_subplot(below[i]))
        _draw_told(panels[-1], found, name, *each)
    for axes in panels[-max(len(told), 1) :]:
        axes.set_xlabel("step of the trial")
    figure.suptitle(title)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return panels


def _draw_latent(axes: "Axes", found: Believed, z: int) -> None:
    """Draw the belief in one latent."""
    _style(axes, found)
    steps = np.arange(found.mean.shape[1])
    for i, name in enumerate(found.names):
        mean, deviation = found.mean[i, :, z], found.deviation[i, :, z]
        axes.plot(steps, mean, color=figures.colour(i), linewidth=1.2, label=name)
        axes.fill_between(steps, mean - deviation, mean + deviation, color=figures.colour(i), alpha=0.15, linewidth=0)
    axes.set_title(f"latent {z + 1}", fontsize=9)


def _draw_told(axes: "Axes", found: Believed, name: str, predicted: np.ndarray, came: np.ndarray) -> None:
    """Draw predictions (N, H) and what came, or how far off those of vectors (N, H, O) are."""
    _style(axes, found)
    steps, vectors = np.arange(came.shape[1]), came.ndim == 3
    if vectors:
        size = np.sqrt(np.nanmean(np.sum(np.square(came), axis=-1)))
        predicted, came = np.linalg.norm(predicted - came, axis=-1) / size, np.full(came.shape[:2], np.nan)
        name = f"error of the predicted {name}"
    else:
        name = f"{name}: predicted (line), came (points)"
    for i in range(len(predicted)):
        axes.plot(steps, predicted[i], color=figures.colour(i), linewidth=1.2)
        axes.plot(steps, came[i], ".", color=figures.colour(i), markersize=4)
    if vectors:
        axes.set_ylim(bottom=0)
    axes.set_title(name, fontsize=9)


def _worth_telling(foretold: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the predictions of what was not always 0. Those of single numbers come first."""
    told = {name: each for name, each in foretold.items() if np.any(np.nan_to_num(each[1]))}
    return dict(sorted(told.items(), key=lambda item: item[1][1].ndim))


def _style(axes: "Axes", found: Believed) -> None:
    """Give axes of steps the look of all figures, and mark where the episodes of all trials end."""
    from matplotlib.ticker import MaxNLocator

    figures.style(axes)
    axes.set_ylabel("")
    axes.tick_params(labelsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    if np.all(found.ends == found.ends[0]):
        for end in found.ends[0, :-1]:
            axes.axvline(end - 0.5, color="0.6", linewidth=0.8)
