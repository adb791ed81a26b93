"""The learning loop as a pure function: ``init`` makes a training state, ``run_chunk`` advances it.

A chunk is one jitted, donated ``lax.scan`` of (collect on all tasks and environments, store, update), for all seeds at
once. Learners are mapped over seeds; worlds of all seeds, tasks and environments are one flat batch, which traces and
compiles faster than nested maps and keeps decisions that all seeds share as branches. Where devices share a seed's
environments, E is a device's own part of them, and random numbers are drawn for all before each takes its own.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.experience import hindsight
from mtjax.experience import replay as rings
from mtjax.experience.replay import Replay
from mtjax.parallel import collectives as shares
from mtjax.tasks import episode_task
from mtjax.types import Agent, Array, Env, InputError, Key, Metrics, Outcome, Spec, Step, Task, Transition


@dataclasses.dataclass(frozen=True)
class Settings:
    """How experience is collected and how much is learned from it."""

    num_envs: int = 16
    """Environments per task."""
    updates_per_step: int = 1
    """Gradient updates after each step of all environments."""
    batch_size: int = 64
    """Transitions per task in each update."""
    replay_size: int = 100_000
    """Transitions each task's replay holds."""
    warmup_steps: int = 100
    """Steps of every environment under random actions before learning starts."""
    warmup_hold: int = 10
    """Steps for which each of those random actions is held; actions that last find more than ones that jitter."""
    reset_every: int = 0
    """Steps of every environment after which networks and optimisers begin anew, replay kept; 0 never."""
    chunk_steps: int = 1000
    """Steps of every environment between two lines of metrics; also the grain of evaluation and checkpoints."""
    hindsight: float = 0.0
    """Share of each batch that is taken from other tasks and replayed with this task's goal; only for families whose
    tasks differ in their goals alone."""

    def __post_init__(self):
        if not 0 <= self.hindsight <= 1:
            raise InputError(f"hindsight is a share from 0 to 1, not {self.hindsight}")
        for field in dataclasses.fields(self):
            least = 0 if field.name in ("updates_per_step", "reset_every", "hindsight") else 1
            if getattr(self, field.name) < least:
                flag = field.name.replace("_", "-")
                raise InputError(f"{flag} must be at least {least}, not {getattr(self, field.name)}")
        if self.replay_size < self.num_envs:
            raise InputError(f"replay-size ({self.replay_size}) must hold one step of num-envs ({self.num_envs})")

    @property
    def num_slots(self) -> int:
        """Steps of every environment that each ring holds."""
        return self.replay_size // self.num_envs

    @property
    def capacity(self) -> int:
        """Transitions that each ring holds: the replay size, rounded down to a multiple of the environments."""
        return self.num_slots * self.num_envs


class TrainState(NamedTuple):
    """All that is needed to go on bit for bit."""

    agent: Any  # leaves (S, ...)
    env: Any  # leaves (S, T, E, ...), the environments' states
    task: Task | None  # leaves (S, T, E, ...), the episodes' own tasks where episodes draw theirs
    obs: Array  # (S, T, E, O)
    age: Array  # (S, T, E) int32, steps since the last reset
    total: Array  # (S, T, E) return of the episode so far
    discounted: Array  # (S, T, E) the same, each reward discounted once more at every later step
    replay: Replay  # rows (S, T, H, E, ...)
    iteration: Array  # () int32, steps taken by every environment
    key: Key  # (S,)
    warmup_key: Key  # (S,) fixed, so that an action drawn from it can be held


_REPLAY = Replay(rows=0, position=None, size=None)  # type: ignore  # its axes under a map over seeds


@partial(jax.jit, static_argnums=(0, 1, 2))
def init(
    env: Env, agent: Agent, settings: Settings, tasks: Task, seeds: Array, knobs: dict[str, Array] | None = None
) -> TrainState:
    """Return a fresh training state for ``seeds`` (S,) on training ``tasks`` (T, ...).

    Args:
        knobs: values (S,) of an agent's numbers that vary between seeds, if it is a ``Varied``.
    """
    if settings.hindsight:
        hindsight.require(env)
    num_tasks = len(tasks.id)
    shape = (len(seeds), num_tasks, settings.num_envs // shares.count())
    key, agent_key, reset_key, warmup_key = _split(jax.vmap(jax.random.key)(seeds), 4)
    worlds, start = begin(env, tasks, _world_keys(reset_key, shape))
    point = () if knobs is None else (knobs,)
    blank = lambda _: rings.init(_blank_transition(env.spec, tasks), num_tasks, settings.num_slots, shape[2])
    return TrainState(
        agent=jax.vmap(lambda key, *point: agent.init(env.spec, tasks, key, *point))(agent_key, *point),
        env=start.state,
        task=None if tasks.draws is None else worlds,
        obs=start.obs,
        age=jnp.zeros(shape, jnp.int32),
        total=jnp.zeros(shape),
        discounted=jnp.zeros(shape),
        replay=jax.vmap(blank, out_axes=_REPLAY)(seeds),
        iteration=jnp.int32(0),
        key=key,
        warmup_key=warmup_key,
    )


def _blank_transition(spec: Spec, tasks: Task) -> Transition:
    obs, scalar = jnp.zeros(spec.obs_size), jnp.float32(0)
    context = None if tasks.draws is None else jnp.zeros(spec.context_size)
    return Transition(obs, jnp.zeros(spec.action_size), scalar, scalar, obs, context)


def _split(keys: Key, count: int) -> tuple[Key, ...]:
    """Split each seed's key (S,) into ``count`` keys (S,)."""
    return tuple(jax.vmap(lambda key: jax.random.split(key, count), out_axes=1)(keys))


def _world_keys(keys: Key, shape: tuple[int, ...]) -> Key:
    """One key for every world (S, T, E) from one a seed (S,)."""
    everywhere = (shape[1], shape[2] * shares.count())
    return shares.own(jax.vmap(lambda key: jax.random.split(key, everywhere))(keys), axis=2)


def spread(tasks: Task, shape: tuple[int, ...]) -> Task:
    """Repeat tasks (T, ...) for all worlds of shape (S, T, E)."""
    single = tasks._replace(draws=None)
    return jax.tree.map(lambda x: jnp.broadcast_to(x[None, :, None], shape + x.shape[1:]), single)


def begin(env: Env, tasks: Task, keys: Key) -> tuple[Task, Step]:
    """Begin an episode in every world: its task and its first step, leaves (S, T, E, ...), from keys (S, T, E)."""
    if tasks.draws is None:
        worlds = spread(tasks, keys.shape)
    else:
        task_keys, keys = jnp.moveaxis(jax.vmap(jax.vmap(jax.vmap(jax.random.split)))(keys), -1, 0)
        of_task = jax.vmap(episode_task, (None, 0))
        worlds = jax.vmap(jax.vmap(of_task), (None, 0))(tasks, task_keys)
    return worlds, over_worlds(partial(_reset, env))(worlds, keys)


def play(env: Env, worlds: Task, state: Any, action: Array) -> Step:
    """Step every world, leaves (S, T, E, ...), by its action (S, T, E, A)."""
    return over_worlds(partial(_step, env))(worlds, state, action)


@partial(jax.jit, static_argnums=0)  # physics takes seconds to trace: once for all programs, whatever their batches
def _reset(env: Env, task: Task, key: Key) -> Step:
    return env.reset(task, key)


@partial(jax.jit, static_argnums=0)
def _step(env: Env, task: Task, state: Any, action: Array) -> Step:
    return env.step(task, state, action)


def actions(agent: Agent, state: Any, tasks: Task, worlds: Task, obs: Array, keys: Key | None) -> Array:
    """Actions (S, T, E, A) of agents for observations (S, T, E, O); no keys: the mean actions."""
    noise = () if keys is None else (keys,)
    if tasks.draws is None:  # all worlds of a task see the same of it
        act = lambda learner, task, obs, *key: agent.act(learner, obs, task, *(key or (None,)))
        return over_learners(act)(state, tasks, obs, *noise)
    act = lambda learner, _, task, obs, *key: agent.act(learner, obs, task, *(key or (None,)))
    return over_learners(act)(state, tasks.id, worlds, obs, *noise)


def over_seeds(function: Callable, *axes: Any) -> Callable:
    """``vmap`` over seeds. A single seed is not mapped: on a CPU, a batch of one is compiled to half the speed or less.

    Args:
        axes: for each argument, 0 (leaves have a leading S), None, or a tree of these.
    """

    def mapped(*arguments):
        if len(jax.tree.leaves(arguments[0])[0]) > 1:
            return jax.vmap(function, axes)(*arguments)
        drop = lambda tree: jax.tree.map(lambda x: x.reshape(x.shape[1:]), tree)
        choose = lambda axis, tree: tree if axis is None else drop(tree)
        is_axis = lambda x: x is None or isinstance(x, int)
        one = [jax.tree.map(choose, axis, tree, is_leaf=is_axis) for axis, tree in zip(axes, arguments, strict=True)]
        return jax.tree.map(lambda x: x[None], function(*one))

    return mapped


def over_worlds(function: Callable) -> Callable:
    """Map a function of single worlds over arguments with leaves (S, T, E, ...), as one flat batch."""

    def mapped(*arguments):
        shape = jax.tree.leaves(arguments)[0].shape[:3]
        flat = jax.tree.map(lambda x: x.reshape(math.prod(shape), *x.shape[3:]), arguments)
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), jax.vmap(function)(*flat))

    return mapped


def over_learners(function: Callable) -> Callable:
    """Map ``function(agent state, task, per-world arguments...)`` over seeds, tasks and environments."""

    def mapped(states: Any, tasks: Task, *arguments):
        world = [0] * len(arguments)
        of_task = jax.vmap(function, (None, None, *world))
        of_seed = jax.vmap(of_task, (None, 0, *world))
        return over_seeds(of_seed, 0, None, *world)(states, tasks, *arguments)

    return mapped


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=4)
def run_chunk(env: Env, agent: Agent, settings: Settings, tasks: Task, state: TrainState) -> tuple[TrainState, Metrics]:
    """Advance all seeds by ``settings.chunk_steps`` steps of every environment.

    Returns:
        the new state, and metrics: "return" and "episodes" (S, T) of episodes that ended; the agent's own, as means
        (S, T) or (S,); "bad_step" (S, T), the first step whose numbers were not finite, or -1.
    """

    def iterate(state: TrainState, _) -> tuple[TrainState, Metrics]:
        key, act_key, reset_key, learn_key, renew_key = _split(state.key, 5)
        warming = state.iteration < settings.warmup_steps
        state = state._replace(agent=_renew(env, agent, settings, tasks, state, renew_key))
        state, seen = _collect(env, agent, settings, tasks, state, warming, act_key, reset_key)
        learned, losses = _learn(env, agent, settings, tasks, state, warming, learn_key)
        state = state._replace(agent=learned, iteration=state.iteration + 1, key=key)
        return state, seen | {"losses": losses, "learning": 1.0 - warming}

    state, history = jax.lax.scan(iterate, state, length=settings.chunk_steps)
    return state._replace(agent=shares.agreed(state.agent)), _summarise(history)


def _renew(env, agent, settings: Settings, tasks: Task, state: TrainState, keys: Key) -> Any:
    """Let the networks begin anew where that is due, which is so for all seeds at once and thus stays a branch."""
    if not settings.reset_every:
        return state.agent
    due = (state.iteration > settings.warmup_steps) & (state.iteration % settings.reset_every == 0)
    one = lambda learner, key: agent.reset(learner, env.spec, tasks, key)
    renewed = lambda learners: over_seeds(one, 0, 0)(learners, keys)
    return jax.lax.cond(due, renewed, lambda learners: learners, state.agent)


def _collect(env, agent, settings, tasks, state: TrainState, warming, key: Key, reset_key: Key):
    """Step every environment once, store what happened, and begin new episodes where old ones ended."""
    shape = state.age.shape
    worlds = spread(tasks, shape) if state.task is None else state.task
    chosen = actions(agent, state.agent, tasks, worlds, state.obs, _world_keys(key, shape))
    action = jnp.where(warming, _held_actions(settings, state, chosen.shape), chosen)
    step = play(env, worlds, state.env, action)
    context = None if state.task is None else state.task.context
    transition = Transition(state.obs, action, step.reward, 1.0 - step.terminated, step.obs, context)

    age, total = state.age + 1, state.total + step.reward
    gamma = agent.discounts(state.agent) if hasattr(agent, "discounts") else agent.gamma
    discounted = gamma * state.discounted + step.reward
    ended = step.terminated | (age >= env.episode_length)

    def restart(_):
        task, fresh = begin(env, tasks, _world_keys(reset_key, shape))
        new = (fresh.state, fresh.obs, None if state.task is None else task)
        choose = lambda new, old: jnp.where(ended.reshape(shape + (1,) * (new.ndim - 3)), new, old)
        return jax.tree.map(choose, new, going_on)

    going_on = (step.state, step.obs, state.task)
    env_state, obs, task = jax.lax.cond(jnp.any(ended), restart, lambda _: going_on, None)
    finite = jnp.all(jnp.isfinite(step.obs), axis=(2, 3)) & jnp.all(jnp.isfinite(step.reward), axis=2)
    seen = {"finished": jnp.sum(ended, axis=2), "total": jnp.sum(ended * total, axis=2), "finite": finite}
    learner = state.agent
    if agent.watches:
        outcome = shares.whole(Outcome(step.reward, discounted, total, ended, step.terminated, age), axis=2)
        learner = over_seeds(agent.observe, 0, 0)(learner, outcome)
    state = state._replace(
        agent=learner,
        env=env_state,
        task=task,
        obs=obs,
        age=jnp.where(ended, 0, age),
        total=jnp.where(ended, 0.0, total),
        discounted=jnp.where(ended, 0.0, discounted),
        replay=jax.vmap(rings.add, (_REPLAY, 0), _REPLAY)(state.replay, transition),
    )
    return state, seen


def _held_actions(settings: Settings, state: TrainState, shape: tuple[int, ...]) -> Array:
    """Uniform actions of ``shape`` (S, T, E, A) that change every ``warmup_hold`` steps."""
    everywhere = (shape[1], shape[2] * shares.count(), shape[3])
    draw = lambda key: jax.random.fold_in(key, state.iteration // settings.warmup_hold)
    drawn = jax.vmap(lambda key: jax.random.uniform(draw(key), everywhere, minval=-1.0))(state.warmup_key)
    return shares.own(drawn, axis=2)


def _learn(env, agent, settings: Settings, tasks, state: TrainState, warming: Array, keys: Key) -> tuple[Any, Metrics]:
    """Update the agents on fresh batches; all of a step's batches are drawn together, as one gather is cheaper."""
    if not settings.updates_per_step:
        return state.agent, {}

    learn = lambda learners: _learn_all(env, agent, settings, tasks, learners, state.replay, keys)
    shapes = jax.eval_shape(learn, state.agent)[1]
    rest = lambda learners: (learners, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))
    return jax.lax.cond(warming, rest, learn, state.agent)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _learn_all(env, agent, settings: Settings, tasks, learners, replay: Replay, keys: Key) -> tuple[Any, Metrics]:
    def learn_one(learner, replay: Replay, key: Key) -> tuple[Any, Metrics]:
        batch_key, update_key = jax.random.split(key)
        batches = draw(env, settings, tasks, replay, batch_key)
        keys = jax.random.split(update_key, settings.updates_per_step)
        update = lambda learner, x: agent.update(learner, x[0], tasks, x[1])
        learner, metrics = jax.lax.scan(update, learner, (batches, keys))
        return learner, jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)

    return over_seeds(learn_one, 0, _REPLAY, 0)(learners, replay, keys)


def draw(env: Env, settings: Settings, tasks: Task, replay: Replay, key: Key) -> Transition:
    """Draw the batches (U, T, B, ...) of one step's updates of one agent."""
    shape = (len(tasks.id), settings.updates_per_step, settings.batch_size)
    if settings.hindsight:
        rows = hindsight.sample(env, tasks, settings.hindsight, replay, key, shape)
    else:
        rows = rings.sample(replay, key, math.prod(shape[1:]))
        rows = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), rows)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), rows)


def _summarise(history: dict) -> Metrics:
    """Reduce what was seen at each of H steps (H, S, ...) to one line of metrics."""
    learning = history["learning"]
    mean = lambda x: jnp.sum(x, axis=0) / jnp.maximum(jnp.sum(learning), 1)
    losses = jax.tree.map(mean, history["losses"])
    finished, total = (jnp.sum(history[name], axis=0) for name in ("finished", "total"))
    episodes, total, bad = shares.total((finished, total, jnp.int32(~history["finite"])))
    bad = bad > 0
    # One task's experience spoils the losses of all who share its networks; then it alone is to blame.
    blameless = ~jnp.any(bad, axis=2, keepdims=True)
    for loss in history["losses"].values():
        bad |= blameless & ~jnp.isfinite(loss).reshape(*loss.shape[:2], -1)
    return losses | {
        "episodes": episodes,
        "return": total / episodes,
        "bad_step": jnp.where(jnp.any(bad, axis=0), jnp.argmax(bad, axis=0), -1),
    }
