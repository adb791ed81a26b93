"""Diagnostics of a trained agent: conflicts between its tasks' gradients, and the use of its networks' units.

They use the training tasks, the agent and the replay of a run's last checkpoint, and fixed random keys. Gradients are
those of the agent's own losses for each task alone, without the rule that combined them in training and without task
weights. Cosines are over shared parameters only, because tasks cannot conflict over parameters of their own.
"""

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
from mtjax.agents import SAC
from mtjax.agents.fit import Problem, above
from mtjax.agents.networks import Network, Params, ReLU
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.replayed import critic_data, prepare
from mtjax.agents.state import Nets, axes_of
from mtjax.experience.ring import Ring
from mtjax.report import figures
from mtjax.saved.policy import Policy
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
    """Diagnostics of the critics or of the actor, averaged over seeds (and critics)."""

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

    critic: Findings
    actor: Findings
    td_error: Any  # (T,) mean |Q - target|, in the units of the rewards that the critics learn from
    batch_size: int
    seeds: int


def diagnose(policy: Policy, replay: Ring, batch_size: int) -> Diagnostics:
    """Return the diagnostics of a policy, averaged over its seeds.

    Args:
        replay: rows (S, T, H, E, ...).
        batch_size: transitions of a task in each batch. The run's own size gives the gradient norms of training.

    Raises:
        InputError: the replay is empty, or the agent has no critics of actions.
    """
    if frames.shown(policy.env.spec.obs):
        raise InputError("diagnostics are of agents whose networks take vectors")
    if int(replay.size) < getattr(policy.agent.experience, "n_step", 1):
        raise InputError("the replay of this run is empty; train it for longer")
    tasks, agent = policy.env.tasks("train"), policy.agent
    if not isinstance(agent, SAC):
        raise InputError(f"diagnostics are of SAC and agents made from it, not of {type(agent).__name__}")
    if agent.unroll:
        raise InputError("diagnostics look at single transitions, and this agent learns from windows")
    found = []
    for s in range(len(policy.seeds)):
        state, rows = jax.tree.map(lambda x, s=s: x[s], (policy.states, replay.rows))
        gradient_key, sample_key = jax.random.split(jax.random.key(0))
        of_seed = replay._replace(rows=rows)
        gradients = _average_gradients(policy.env, agent, state, of_seed, tasks, gradient_key, batch_size)
        activity = _sample_activity(policy.env, agent, state, of_seed, tasks, sample_key)
        found.append(_summarise(agent, state, gradients, activity))
    critic, actor, td_error = jax.tree.map(lambda *x: np.mean(x, axis=0), *found)
    critic, actor = (x._replace(width=int(x.width)) for x in (critic, actor))
    return Diagnostics(critic, actor, td_error, batch_size, len(found))


def _summarise(agent: SAC, state: Any, gradients: Mapping, activity: Mapping) -> tuple[Findings, Findings, np.ndarray]:
    of = lambda name, network, params: Findings(
        **jax.device_get(gradients[name]), **utilisation(network, params, jax.device_get(activity[name]))
    )
    critic, actor = (of(x, getattr(agent, x), state.nets[x]) for x in ("critic", "actor"))
    return critic, actor, np.asarray(gradients["td_error"])


# Gradients.


@partial(jax.jit, static_argnums=(0, 1, 6))
def _average_gradients(env: Env, agent: SAC, state: Any, replay: Ring, tasks: Task, key: Key, batch_size: int) -> dict:
    def draw(key: Key) -> dict:
        batch_key, loss_key = jax.random.split(key)
        window = agent.experience.draw(env.spec, agent, replay, batch_key, batch_size)
        return compare_gradients(agent, state, window, tasks, loss_key)

    return jax.tree.map(lambda x: jnp.mean(x, axis=0), jax.lax.map(draw, jax.random.split(key, DRAWS)))


def compare_gradients(agent: SAC, state: Any, window: Transition, tasks: Task, key: Key) -> dict[str, Any]:
    """Differentiate the agent's losses on windows (T, B, L, ...) for each task alone.

    Returns:
        "critic" and "actor": gram, cosine, conflict and gradient_norm, as in ``Findings``; "td_error" (T,).
    """
    target_key, actor_key = jax.random.split(key)
    seen = prepare(agent, state, window, tasks)
    least, data = agent.least_loss + agent.representation.least_loss, critic_data(agent, state, seen, target_key)
    critic, aux = _compare(agent.fits["critic"].problem(above(least, agent.critic_loss), state.nets, data))
    data = (seen, jax.random.split(actor_key, state.num_tasks))
    actor, _ = _compare(agent.fits["actor"].problem(agent.actor_loss, state.nets, data))
    return {"critic": critic, "actor": actor, "td_error": aux.metrics["td_error"]}


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
    hidden: Any  # (..., width), the layer on which heads stand


@partial(jax.jit, static_argnums=(0, 1))
def _sample_activity(env: Env, agent: SAC, state: Any, replay: Ring, tasks: Task, key: Key) -> dict[str, Activity]:
    return activity(agent, state, agent.experience.draw(env.spec, agent, replay, key, SAMPLE), tasks)


def activity(agent: SAC, state: Any, window: Transition, tasks: Task) -> dict[str, Activity]:
    """Return the activity of "critic" and "actor" on windows (T, B, L, ...). A representation counts as the actor's.

    Returns:
        mean activity over the batch (T, N, units), and hidden layers (T, B, N, width); N is 1 for the actor.
    """
    seen_batch = prepare(agent, state, window, tasks)
    given, shape = seen_batch.features, (*seen_batch.reward.shape, seen_batch.features.shape[-1])
    features = jnp.broadcast_to(given if given.ndim == 3 else given[:, None], shape)

    def one(nets: Nets, features: Array, obs: Array, action: Array) -> dict[str, Activity]:
        known, inputs = agent.view.critic_inputs(nets, features, obs)
        judge = partial(watch, agent.critic.apply)
        judging = jax.vmap(judge, (0, None, None, None))(nets["critic"], known, inputs, action)
        acting = watch(agent.policy_outputs, nets, features, obs)
        return {"critic": judging, "actor": jax.tree.map(lambda x: x[None], acting)}

    every = jax.vmap(jax.vmap(one, (None, 0, 0, 0)), (axes_of(state.nets), 0, 0, 0))
    seen = every(state.nets, features, seen_batch.obs, seen_batch.action)
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
            outputs.append(output)
        return output

    with nn.intercept_methods(note):
        function(*arguments)
    return Activity(layers, outputs[-1])


def utilisation(network: Network, params: Params, seen: Activity) -> dict[str, Any]:
    """Return dormant units and effective ranks, as in ``Findings``, from the result of ``activity``."""
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
    for name, x in (("critic", found.critic), ("actor", found.actor)):
        cosine, conflict = "-", "-"
        if x.cosine is not None and len(x.cosine) > 1:
            cosine, conflict = f"{mean_cosine(x.cosine):.2f}", f"{x.conflict:.0%}"
        lines.append(f"{name:10} {cosine:>7} {conflict:>9} {x.dormant:>8.1%}   {x.rank:.0f} of {x.width}")
    for name, x in (("critic", found.critic), ("actor", found.actor)):
        if x.cosine is None:
            lines.append(f"tasks share no parameters of the {name}, over which they could conflict")
    labels = policy.env.labels("train")
    width = max(10, *map(len, labels))
    lines.append(f"{policy.env.task_axis[0]:>{width}} {'TD error':>9} {'critic gradient':>16} {'actor gradient':>15}")
    rows = zip(found.td_error, found.critic.gradient_norm, found.actor.gradient_norm, strict=True)
    for label, (error, critic, actor) in zip(labels, rows, strict=True):
        lines.append(f"{label:>{width}} {error:9.3g} {critic:16.3g} {actor:15.3g}")
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
    networks = {"critic": found.critic._asdict(), "actor": found.actor._asdict()}
    record = _plain({**record, **found._asdict(), **networks})
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
