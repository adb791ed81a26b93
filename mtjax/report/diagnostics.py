"""Diagnostics of a trained agent: conflicts between its tasks' gradients, and the use of its networks' units.

They use the training tasks, the agent and the replay of a run's last checkpoint, or a rollout that an agent without one
plays then, and fixed random keys. Gradients are those of the agent's own losses for each task alone, without the rule
that combined them in training and without task weights. Cosines are over shared parameters only, because tasks cannot
conflict over parameters of their own.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state

from mtjax import frames
from mtjax.agents.fit import Problem
from mtjax.agents.networks import Network, Params, ReLU
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.state import Nets, axes_of
from mtjax.learning import loop
from mtjax.report import figures
from mtjax.saved.config_json import from_json
from mtjax.saved.policy import Policy, load_experience
from mtjax.types import Array, Env, InputError, Key, Task, Transition

DRAWS = 16
"""Number of batches over which gradients and their statistics are averaged."""
SAMPLE = 1024
"""Transitions of each task on which units and features are measured."""
DORMANT = 0.025
"""tau: a unit is dormant if its activity is at most this share of its layer's mean (Sokar et al. 2023)."""
HELD = 0.99
"""1 - delta: the share of the sum of singular values that an effective rank holds (Kumar et al. 2021)."""


class Findings(NamedTuple):
    """Diagnostics of the critics or of the actor, averaged over seeds (and critics).

    Those of units are None where networks are applied inside a map of the agent's own.
    """

    gram: Any  # (T, T) inner products of the tasks' gradients on shared parameters; None if there are none
    cosine: Any  # (T, T) their cosines, or None
    conflict: Any  # () share of pairs of tasks with a negative cosine, or None
    gradient_norm: Any  # (T,) lengths on shared parameters; where there are none, on the task's own
    dormant: Any  # () share of dormant units
    dormant_by_layer: dict[str, Any]  # the same for each layer of ReLUs
    rank: Any  # () effective rank of the hidden layer on which heads stand: singular values that hold 99% of the sum
    entropy_rank: Any  # () the same by Roy and Vetterli (2007): exp of the singular values' entropy
    width: int  # units in that layer


class Diagnostics(NamedTuple):
    """Diagnostics of an agent."""

    networks: dict[str, Findings]  # "critic", and "actor" unless the critic is the policy
    td_error: Any  # (T,) mean |Q - target|, in the units of the rewards that the critics learn from
    batch_size: int
    seeds: int


def with_experience(policy: Policy, directory: str | Path, point: int = 0) -> tuple[Policy, Any, int]:
    """Return what ``diagnose`` takes of a run: the policy, what it learns from, and its batches' size.

    An agent without a replay plays a rollout for that, and assesses it.

    Args:
        point: as ``seed`` of ``mtjax.load``.

    Raises:
        InputError: there are no diagnostics of such an agent, or no data.
    """
    _require_single_steps(policy)
    agent = policy.agent
    if agent.experience.storage.kept:
        return policy, *load_experience(directory, point)
    settings, tasks = from_json(Path(directory) / "config.json").training, policy.env.tasks("train")
    keys = jax.random.split(jax.random.key(0), len(policy.seeds))
    states, steps = loop.rollout(policy.env, agent, settings, tasks, policy.states, keys)
    size = settings.num_envs * agent.experience.steps // agent.experience.minibatches
    return dataclasses.replace(policy, states=states), steps, size


def _require_single_steps(policy: Policy) -> None:
    """Refuse agents that see pictures, or learn from more than single steps."""
    agent, name = policy.agent, type(policy.agent).__name__
    if frames.shown(policy.env.spec.obs):
        raise InputError("diagnostics are of agents whose networks take vectors")
    if agent.losses is None:
        raise InputError(f"diagnostics are of agents with losses of single steps, and those of {name} are not")
    if agent.unroll:
        raise InputError("diagnostics look at single transitions, and this agent learns from windows")


def diagnose(policy: Policy, data: Any, batch_size: int) -> Diagnostics:
    """Return the diagnostics of a policy, averaged over its seeds.

    Args:
        data: a replay with rows (S, T, H, E, ...), or a rollout with such leaves, as of ``with_experience``.
        batch_size: transitions of a task in each batch. The run's own size gives the gradient norms of training.

    Raises:
        InputError: there are no diagnostics of such an agent, or the replay is empty.
    """
    _require_single_steps(policy)
    tasks, agent = policy.env.tasks("train"), policy.agent
    kept = agent.experience.storage.kept
    if kept and int(data.size) < agent.experience.n_step:
        raise InputError("the replay of this run is empty; train it for longer")
    found = []
    for s in range(len(policy.seeds)):
        state, rows = jax.tree.map(lambda x, s=s: x[s], (policy.states, data.rows if kept else data))
        gradient_key, sample_key = jax.random.split(jax.random.key(0))
        of_seed = data._replace(rows=rows) if kept else rows
        gradients = _average_gradients(policy.env, agent, state, of_seed, tasks, gradient_key, batch_size)
        activity = _sample_activity(policy.env, agent, state, of_seed, tasks, sample_key)
        found.append(_summarise(agent, state, gradients, activity))
    networks, td_error = jax.tree.map(lambda *x: np.mean(x, axis=0), *found)
    order = [name for name in ("critic", "actor") if name in networks]  # as a map over a tree sorts them
    networks = {name: networks[name]._replace(width=int(networks[name].width)) for name in order}
    return Diagnostics(networks, td_error, batch_size, len(found))


def _summarise(agent: Any, state: Any, gradients: dict, activity: Mapping) -> tuple[dict[str, Findings], np.ndarray]:
    td_error, network = np.asarray(gradients.pop("td_error")), {"critic": agent.critic, "actor": agent.actor}
    units = {name: utilisation(network[name], state.nets[name], jax.device_get(activity[name])) for name in gradients}
    return {name: Findings(**jax.device_get(x), **units[name]) for name, x in gradients.items()}, td_error


# Gradients.


@partial(jax.jit, static_argnums=(0, 1, 6))
def _average_gradients(env: Env, agent: Any, state: Any, data: Any, tasks: Task, key: Key, batch_size: int) -> dict:
    def draw(key: Key) -> dict:
        batch_key, loss_key = jax.random.split(key)
        window = agent.experience.draw(env.spec, agent, data, batch_key, batch_size)
        return compare_gradients(agent, state, window, tasks, loss_key)

    return jax.tree.map(lambda x: jnp.mean(x, axis=0), jax.lax.map(draw, jax.random.split(key, DRAWS)))


def compare_gradients(agent: Any, state: Any, window: Transition, tasks: Task, key: Key) -> dict[str, Any]:
    """Differentiate the agent's losses on windows (T, B, L, ...) for each task alone.

    Returns:
        "critic" and "actor": gram, cosine, conflict and gradient_norm, as in ``Findings``; "td_error" (T,).
    """
    nets, by_fit, _ = agent.losses(state, window, tasks, key)
    found = {name: _compare(agent.fits[name].problem(loss, nets, data)) for name, (loss, data) in by_fit.items()}
    return {name: x for name, (x, _) in found.items()} | {"td_error": found["critic"][1]["td_error"]}


def _compare(problem: Problem) -> tuple[dict[str, Any], Any]:
    loss, params, data = problem
    one_task = lambda shared, own, data: loss(Params(shared, own), data)
    differentiate = jax.vmap(jax.grad(one_task, argnums=(0, 1), has_aux=True), (None, 0, 0))
    (shared, own), aux = differentiate(params.shared, params.own, data)
    share = bool(jax.tree.leaves(shared))
    gram = surgery.gram_matrix(shared if share else own)
    cosine, lengths = surgery.cosines(gram)
    found = {"gram": gram, "cosine": cosine, "conflict": surgery.conflicts(gram)["conflict"]}
    return {**(found if share else dict.fromkeys(found)), "gradient_norm": lengths}, aux


# Units.


class Activity(NamedTuple):
    """Outputs of a network's units. For a single transition there are no leading axes."""

    layers: dict[str, Any]  # (..., units) of each layer of ReLUs
    hidden: Any  # (..., width), the layer on which heads stand; None where it is inside a map


@partial(jax.jit, static_argnums=(0, 1))
def _sample_activity(env: Env, agent: Any, state: Any, data: Any, tasks: Task, key: Key) -> dict[str, Activity]:
    return activity(agent, state, agent.experience.draw(env.spec, agent, data, key, SAMPLE), tasks)


def activity(agent: Any, state: Any, window: Transition, tasks: Task) -> dict[str, Activity]:
    """Return the activity of "critic" and "actor" on windows (T, B, L, ...). A representation counts as the actor's.

    Returns:
        mean activity over the batch (T, N, units), and hidden layers (T, B, N, width); N is 1 for the actor, and for a
        critic that sees no actions.
    """
    nets, by_fit, batch = agent.losses(state, window, tasks, jax.random.key(0))
    given, shape = batch.features, (*jax.tree.leaves(batch.obs)[0].shape[:2], batch.features.shape[-1])
    features = jnp.broadcast_to(given if given.ndim == 3 else given[:, None], shape)
    actions, alone = (batch.action,) if agent.num_critics else (), partial(jax.tree.map, lambda x: x[None])

    def one(nets: Nets, features: Array, obs: Array, *action: Array) -> dict[str, Activity]:
        inputs = (*agent.view.critic_inputs(nets, features, obs), *action)
        critics = nets["critic"] if action else alone(nets["critic"])
        found = {"critic": jax.vmap(lambda net: watch(agent.critic.apply, net, *inputs))(critics)}
        return found | ({"actor": alone(watch(agent.policy_outputs, nets, features, obs))} if "actor" in by_fit else {})

    rows = features, batch.obs, *actions
    every = jax.vmap(jax.vmap(one, (None, *[0] * len(rows))), (axes_of(nets), *[0] * len(rows)))
    seen = every(nets, *rows)
    level = lambda x: jnp.mean(jnp.abs(x), axis=1).reshape(*x.shape[:1], x.shape[2], -1)
    return {name: Activity(jax.tree.map(level, x.layers), x.hidden) for name, x in seen.items()}


def watch(function: Callable, *arguments: Any) -> Activity:
    """Evaluate networks on a single transition, and record the outputs of every ReLU and of the last body.

    Layers are named by the path of modules to them. Those inside of a map of a network's own are not recorded, as their
    outputs are not known outside of it.
    """
    outermost, layers, outputs = [], {}, []
    outside = get_opaque_trace_state()

    def note(call: Callable, args: tuple, kwargs: dict, context: Any) -> Any:
        module = context.module
        first = not outermost
        if first:
            outermost.append(type(module).__name__)
        output = call(*args, **kwargs)
        if isinstance(module, ReLU) and get_opaque_trace_state() == outside:
            name = "/".join((*outermost, *module.path))
            layers[f"{name}:{len(layers)}" if name in layers else name] = output
        if first:
            outermost.clear()
        if first and get_opaque_trace_state() == outside:
            outputs.append(output)
        return output

    with nn.intercept_methods(note):
        function(*arguments)
    return Activity(layers, outputs[-1] if outputs else None)


def utilisation(network: Network, params: Params, seen: Activity) -> dict[str, Any]:
    """Return dormant units and effective ranks, as in ``Findings``, from the result of ``activity``."""
    if seen.hidden is None:
        return {"dormant": None, "dormant_by_layer": {}, "rank": None, "entropy_rank": None, "width": 0}
    disjoint, front = "body" in params.own, type(network.front).__name__
    by_layer, units = {}, {}
    for name, levels in seen.layers.items():
        levels = levels if disjoint or name.split("/")[0] == front else np.mean(levels, axis=0)
        by_layer[name], units[name] = dormant_share(levels), levels.shape[-1]
    total = sum(units.values())
    features = np.moveaxis(seen.hidden, 2, 0)  # (N, T, B, width)
    num_networks, num_tasks, _, width = features.shape
    num_networks *= num_tasks if disjoint else 1
    ranks = [effective_ranks(x) for x in features.reshape(num_networks, -1, width)]
    rank, entropy_rank = np.mean(ranks, axis=0)
    return {
        "dormant": sum(by_layer[name] * units[name] for name in units) / total if total else np.nan,
        "dormant_by_layer": by_layer,
        "rank": rank,
        "entropy_rank": entropy_rank,
        "width": width,
    }


def dormant_share(levels: np.ndarray) -> float:
    """Return the share of units whose mean activity (..., units) is at most DORMANT times their layer's mean."""
    return float(np.mean(levels <= DORMANT * np.mean(levels, axis=-1, keepdims=True)))


def effective_ranks(features: np.ndarray) -> tuple[float, float]:
    """Return two effective ranks of features (rows, width), with singular values s_1 >= s_2 >= ... and p = s / sum s.

    Returns:
        the least k with p_1 + ... + p_k >= HELD ("srank", Kumar et al. 2021), and exp(-sum p log p) (Roy and Vetterli
        2007); 0 and 0 for features that are 0.
    """
    values = np.linalg.svd(np.asarray(features, np.float64), compute_uv=False)
    if not values[0] > 0:
        return 0.0, 0.0
    shares = values / np.sum(values)
    rank = 1 + np.sum(np.cumsum(shares) < HELD - 1e-9)
    present = shares[shares > 0]
    return float(rank), float(np.exp(-np.sum(present * np.log(present))))


# Reporting.


def table(policy: Policy, found: Diagnostics) -> str:
    """Return the diagnostics as text: one line per network, then one line per task."""
    lines = [
        f"training tasks, {DRAWS} batches of {found.batch_size} transitions of each:",
        f"{'network':10} {'cosine':>7} {'conflict':>9} {'dormant':>8}   effective rank",
    ]
    for name, x in found.networks.items():
        cosine, conflict, dormant, rank = "-", "-", "-", "-"
        if x.cosine is not None and len(x.cosine) > 1:
            cosine, conflict = f"{mean_cosine(x.cosine):.2f}", f"{x.conflict:.0%}"
        if x.rank is not None:
            dormant, rank = f"{x.dormant:.1%}", f"{x.rank:.0f} of {x.width}"
        lines.append(f"{name:10} {cosine:>7} {conflict:>9} {dormant:>8}   {rank}")
    for name, x in found.networks.items():
        if x.cosine is None:
            lines.append(f"tasks share no parameters of the {name}, over which they could conflict")
    labels = policy.env.labels("train")
    width = max(10, *map(len, labels))
    columns = {f"{name} gradient": x.gradient_norm for name, x in found.networks.items()}
    lines.append(" ".join([f"{policy.env.task_axis[0]:>{width}} {'TD error':>9}", *(f"{x:>16}" for x in columns)]))
    for label, error, *lengths in zip(labels, found.td_error, *columns.values(), strict=True):
        lines.append(" ".join([f"{label:>{width}} {error:9.3g}", *(f"{x:16.3g}" for x in lengths)]))
    return "\n".join(lines)


def mean_cosine(cosine: np.ndarray) -> float:
    """Return the mean cosine over pairs of different tasks; NaN for a single task."""
    pairs = cosine[~np.eye(len(cosine), dtype=bool)]
    return float(np.mean(pairs)) if pairs.size else np.nan


def write(policy: Policy, found: Diagnostics, directory: Path) -> None:
    """Write ``diagnostics.json`` and ``diagnostics.png`` into ``directory``."""
    name, unit = policy.env.task_axis
    values = policy.env.task_values("train")
    tasks = policy.env.labels("train")
    record = {"parameter": name, "unit": unit, "values": values, "tasks": tasks, "draws": DRAWS, "sample": SAMPLE}
    networks = {who: x._asdict() for who, x in found.networks.items()}
    of_run = {"td_error": found.td_error, "batch_size": found.batch_size, "seeds": found.seeds}
    record = _plain({**record, **networks, **of_run})
    (directory / "diagnostics.json").write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    cosines = {who: x["cosine"] for who, x in networks.items()}
    bars = {f"length of the {who}'s gradient": x["gradient_norm"] for who, x in networks.items()}
    bars["mean TD error"] = found.td_error
    figures.interference(directory / "diagnostics.png", name, unit, values, cosines, bars)


def _plain(x: Any) -> Any:
    """Convert to JSON's types: lists, numbers of seven digits, and null for NaN."""
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return _plain(x.tolist())
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, float):
        return float(f"{x:.7g}") if np.isfinite(x) else None
    return x
