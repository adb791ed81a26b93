"""The learning loop as a pure function: ``init`` makes a training state, ``run_chunk`` advances it.

A chunk is one jitted, donated ``lax.scan`` of (collect on all tasks and environments, store, update), for all seeds at
once. Seeds are a ``vmap`` axis named "seeds", so that decisions which all seeds share stay branches.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax import replay as rings
from mtjax.replay import Replay
from mtjax.types import Agent, Array, Env, InputError, Key, Metrics, Spec, Step, Task, Transition


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
    chunk_steps: int = 1000
    """Steps of every environment between two lines of metrics; also the grain of evaluation and checkpoints."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            least = 0 if field.name == "updates_per_step" else 1
            if getattr(self, field.name) < least:
                flag = field.name.replace("_", "-")
                raise InputError(f"{flag} must be at least {least}, not {getattr(self, field.name)}")
        if self.replay_size < self.num_envs:
            raise InputError(f"replay-size ({self.replay_size}) must hold one step of num-envs ({self.num_envs})")

    @property
    def capacity(self) -> int:
        """Rows of each ring: the replay size, rounded down to a multiple of the environments."""
        return self.replay_size - self.replay_size % self.num_envs


class TrainState(NamedTuple):
    """All that is needed to go on bit for bit; with a leading ``S`` on every leaf."""

    agent: Any
    env: Any  # leaves (T, E, ...), the environments' states
    obs: Array  # (T, E, O)
    age: Array  # (T, E) int32, steps since the last reset
    total: Array  # (T, E) return of the episode so far
    replay: Replay
    iteration: Array  # () int32, steps taken by every environment
    key: Key


@partial(jax.jit, static_argnums=(0, 1, 2))
def init(env: Env, agent: Agent, settings: Settings, tasks: Task, seeds: Array) -> TrainState:
    """Return fresh training states for ``seeds`` (S,) on training ``tasks`` (T, ...)."""
    return jax.vmap(partial(_init_one, env, agent, settings, tasks))(seeds)


def _init_one(env: Env, agent: Agent, settings: Settings, tasks: Task, seed: Array) -> TrainState:
    key, agent_key, reset_key = jax.random.split(jax.random.key(seed), 3)
    num_tasks = len(tasks.id)
    start = _reset_all(env, settings, tasks, reset_key)
    clock = jnp.zeros((num_tasks, settings.num_envs), jnp.int32)
    rows = rings.init(_blank_transition(env.spec), num_tasks, settings.capacity)
    return TrainState(
        agent=agent.init(env.spec, tasks, agent_key),
        env=start.state,
        obs=start.obs,
        age=clock,
        total=jnp.zeros(clock.shape),
        replay=rows,
        iteration=jnp.int32(0),
        key=key,
    )


def _blank_transition(spec: Spec) -> Transition:
    obs, scalar = jnp.zeros(spec.obs_size), jnp.float32(0)
    return Transition(obs, jnp.zeros(spec.action_size), scalar, scalar, obs)


def over_envs(function):
    """Map a function of (task, per-environment arguments...) over tasks and over each task's environments."""

    def mapped(tasks: Task, *arguments):
        inner = jax.vmap(function, (None, *[0] * len(arguments)))
        return jax.vmap(inner)(tasks, *arguments)

    return mapped


def _reset_all(env: Env, settings: Settings, tasks: Task, key: Key) -> Step:
    keys = jax.random.split(key, (len(tasks.id), settings.num_envs))
    return over_envs(env.reset)(tasks, keys)


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=4)
def run_chunk(env: Env, agent: Agent, settings: Settings, tasks: Task, state: TrainState) -> tuple[TrainState, Metrics]:
    """Advance all seeds by ``settings.chunk_steps`` steps of every environment.

    Returns:
        the new state, and metrics: "return" and "episodes" (S, T) of episodes that ended; the agent's own, as means
        (S, T) or (S,); "bad_step" (S, T), the first step whose numbers were not finite, or -1.
    """
    return jax.vmap(partial(_run_one, env, agent, settings, tasks), axis_name="seeds")(state)


def _run_one(env: Env, agent: Agent, settings: Settings, tasks: Task, state: TrainState) -> tuple[TrainState, Metrics]:
    def iterate(state: TrainState, _) -> tuple[TrainState, Metrics]:
        key, collect_key, reset_key, learn_key = jax.random.split(state.key, 4)
        warming = state.iteration < settings.warmup_steps
        state, seen = _collect(env, agent, settings, tasks, state, warming, collect_key, reset_key)
        learned, losses = _learn(agent, settings, tasks, state, warming, learn_key)
        state = state._replace(agent=learned, iteration=state.iteration + 1, key=key)
        return state, seen | {"losses": losses, "learning": 1.0 - warming}

    state, history = jax.lax.scan(iterate, state, length=settings.chunk_steps)
    return state, _summarise(history)


def _everywhere(flag: Array) -> Array:
    """Whether a flag is set in any seed, as one value that does not depend on the seed."""
    return jax.lax.pmax(jnp.any(flag).astype(jnp.int32), "seeds") > 0


def _collect(env, agent, settings, tasks, state: TrainState, warming, key: Key, reset_key: Key):
    """Step every environment once, store what happened, and begin new episodes where old ones ended."""
    noise_key, random_key = jax.random.split(key)
    shape = state.age.shape
    act = lambda task, obs, key: agent.act(state.agent, obs, task, key)
    chosen = over_envs(act)(tasks, state.obs, jax.random.split(noise_key, shape))
    action = jnp.where(warming, jax.random.uniform(random_key, chosen.shape, minval=-1.0), chosen)
    step = over_envs(env.step)(tasks, state.env, action)
    discount = 1.0 - step.terminated
    transition = Transition(state.obs, action, step.reward, discount, step.obs)

    age, total = state.age + 1, state.total + step.reward
    ended = step.terminated | (age >= env.episode_length)

    def restart(_):
        fresh = _reset_all(env, settings, tasks, reset_key)
        choose = lambda new, old: jnp.where(ended.reshape(shape + (1,) * (new.ndim - 2)), new, old)
        return jax.tree.map(choose, (fresh.state, fresh.obs), (step.state, step.obs))

    env_state, obs = jax.lax.cond(_everywhere(ended), restart, lambda _: (step.state, step.obs), None)
    finite = jnp.all(jnp.isfinite(step.obs), axis=(1, 2)) & jnp.all(jnp.isfinite(step.reward), axis=1)
    seen = {"finished": jnp.sum(ended, axis=1), "total": jnp.sum(ended * total, axis=1), "finite": finite}
    state = state._replace(
        env=env_state,
        obs=obs,
        age=jnp.where(ended, 0, age),
        total=jnp.where(ended, 0.0, total),
        replay=rings.add(state.replay, transition),
    )
    return state, seen


def _learn(agent, settings: Settings, tasks: Task, state: TrainState, warming: Array, key: Key) -> tuple[Any, Metrics]:
    """Update the agent on fresh batches; all of a step's batches are drawn together, as one gather is cheaper."""
    num_updates, batch_size = settings.updates_per_step, settings.batch_size
    batch_key, update_key = jax.random.split(key)

    def learn(learner):
        rows = rings.sample(state.replay, batch_key, num_updates * batch_size)
        split = lambda x: jnp.moveaxis(x.reshape(x.shape[0], num_updates, batch_size, *x.shape[2:]), 1, 0)
        batches = jax.tree.map(split, rows)  # (U, T, B, ...)
        update = lambda learner, x: agent.update(learner, x[0], tasks, x[1])
        learner, metrics = jax.lax.scan(update, learner, (batches, jax.random.split(update_key, num_updates)))
        return learner, jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)

    if not num_updates:
        return state.agent, {}
    shapes = jax.eval_shape(learn, state.agent)[1]
    rest = lambda learner: (learner, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))
    return jax.lax.cond(_everywhere(warming), rest, learn, state.agent)


def _summarise(history: dict) -> Metrics:
    """Reduce what was seen at each of H steps to one line of metrics."""
    learning = history["learning"]
    mean = lambda x: jnp.sum(x, axis=0) / jnp.maximum(jnp.sum(learning), 1)
    losses = jax.tree.map(mean, history["losses"])
    episodes = jnp.sum(history["finished"], axis=0)
    bad = ~history["finite"]
    for loss in history["losses"].values():
        bad |= ~jnp.isfinite(loss).reshape(len(loss), -1)
    return losses | {
        "episodes": episodes,
        "return": jnp.sum(history["total"], axis=0) / episodes,
        "bad_step": jnp.where(jnp.any(bad, axis=0), jnp.argmax(bad, axis=0), -1),
    }
