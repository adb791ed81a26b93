"""Rollouts of agents in environments, for training, evaluation and films."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.maps import Flat, over_learners, where_worlds
from mtjax.parallel import collectives
from mtjax.tasks import contexts_vary, episode_task
from mtjax.types import Acted, Agent, Array, Env, Key, Task, Transition

_LARGEST = 1e10
"""Largest number in an observation: MuJoCo's own bound of positions and velocities (``mjMAXVAL``)."""

_SHARES = 16
"""The batches in which all worlds are reset, if episodes end early."""


class Worlds(NamedTuple):
    """Holds the state of every world; leaves (S, T, E, ...)."""

    state: Any  # of the environment
    task: Task | None  # the episodes' own tasks where episodes draw theirs
    obs: Any  # (S, T, E, O), or with the last pictures
    memory: Any  # what the agent remembers of the episode
    age: Array  # (S, T, E) int32, steps since the last reset


def split_keys(keys: Key, count: int) -> tuple[Key, ...]:
    """Split each seed's key (S,) into ``count`` keys (S,)."""
    return tuple(jax.vmap(lambda key: jax.random.split(key, count), out_axes=1)(keys))


def world_keys(keys: Key, shape: tuple[int, ...]) -> Key:
    """Split each seed's key (S,) into keys (S, T, E) of this device's worlds."""
    everywhere = (shape[1], shape[2] * collectives.count())
    return collectives.own(jax.vmap(lambda key: jax.random.split(key, everywhere))(keys), axis=2)


def broadcast_tasks(tasks: Task, shape: tuple[int, ...]) -> Task:
    """Broadcast tasks (T, ...) to all worlds of ``shape`` (S, T, E)."""
    single = tasks._replace(draws=None)
    return jax.tree.map(lambda x: jnp.broadcast_to(x[None, :, None], shape + x.shape[1:]), single)


def reset_envs(env: Env, agent: Agent, learners: Any, tasks: Task, keys: Key) -> Worlds:
    """Begin an episode in every world, with keys (S, T, E), for agents with states ``learners`` (S, ...)."""
    if tasks.draws is None:
        each = broadcast_tasks(tasks, keys.shape)
    else:
        task_keys, keys = jnp.moveaxis(jax.vmap(jax.vmap(jax.vmap(jax.random.split)))(keys), -1, 0)
        of_task = jax.vmap(episode_task, (None, 0))
        each = jax.vmap(jax.vmap(of_task), (None, 0))(tasks, task_keys)
    start = env.reset_worlds(each._replace(blocks=tasks.blocks), keys)
    age = jnp.zeros(keys.shape, jnp.int32)
    obs = frames.begin(start.obs, env.spec.frames)
    memory = begin_memory(agent, learners, tasks, age)
    return Worlds(start.state, None if tasks.draws is None else each, obs, memory, age)


def begin_memory(agent: Agent, learners: Any, tasks: Task, age: Array) -> Any:
    """Return the memory with which agents begin an episode in every world, of ages (S, T, E)."""
    return over_learners(lambda learner, task, _: agent.begin(learner, task))(learners, tasks, age)


def tasks_of_worlds(tasks: Task, worlds: Worlds) -> Task:
    """Return the task of every world (S, T, E, ...)."""
    return (
        broadcast_tasks(tasks, worlds.age.shape) if worlds.task is None else worlds.task._replace(blocks=tasks.blocks)
    )


def act(agent: Agent, learners: Any, tasks: Task, worlds: Worlds, keys: Key | None) -> Acted:
    """Let agents act in all worlds; without keys (S, T, E) they take their mean actions."""
    noise = () if keys is None else (keys,)
    if worlds.task is None:  # all worlds of a task have the same parameters
        one = lambda learner, task, memory, obs, *key: agent.act(learner, memory, obs, task, *(key or (None,)))
        return over_learners(one)(learners, tasks, worlds.memory, worlds.obs, *noise)
    one = lambda learner, _, task, memory, obs, *key: agent.act(learner, memory, obs, task, *(key or (None,)))
    each = tasks_of_worlds(tasks, worlds)
    return over_learners(one)(learners, tasks.id, each, worlds.memory, worlds.obs, *noise)


class EnvStep(NamedTuple):
    """Holds one step of every world; leaves (S, T, E, ...)."""

    transition: Transition
    metrics: dict[str, Array]  # of the environment
    lost: Array  # bool: the numbers of the world's observation are not finite, or beyond ``_LARGEST``


def step_envs(
    env: Env,
    agent: Agent,
    learners: Any,
    tasks: Task,
    worlds: Worlds,
    keys: Key | None,
    explore: Callable[[Array], Array] = lambda action: action,
) -> tuple[Worlds, EnvStep]:
    """Act in every world and step it; episodes that end are not reset.

    Physics sometimes blows up, as where a grip forces a body into another. Such a world is lost: its episode is cut off
    with a reward of 0, and its last observation stays.

    Args:
        keys: (S, T, E) for sampling actions; None takes the mean ones.
        explore: a function from the agent's actions (S, T, E, A) to the actions that the worlds take.
    """
    each = tasks_of_worlds(tasks, worlds)
    acted = act(agent, learners, tasks, worlds, keys)
    action = explore(acted.action)
    action = action if each.action_mask is None else action * each.action_mask
    step = env.step_worlds(each, worlds.state, action)
    lost = ~bounded_worlds(step.obs)
    obs = where_worlds(lost, worlds.obs, frames.push(worlds.obs, step.obs))
    terminated, age = step.terminated & ~lost, worlds.age + 1
    transition = Transition(
        obs=worlds.obs,
        action=action,
        reward=jnp.where(lost, 0.0, step.reward),
        discount=1.0 - terminated,
        next_obs=obs,
        ended=terminated | lost | (age >= each.horizon),
        context=worlds.task.context if contexts_vary(tasks) else None,  # type: ignore
        extras=acted.extras,
        memory=worlds.memory,
    )
    memory = worlds.memory
    if jax.tree.leaves(memory):
        note = lambda learner, task, memory, transition: agent.remember(learner, memory, transition, task)
        memory = over_learners(note)(learners, tasks, memory, transition)
    return Worlds(step.state, worlds.task, obs, memory, age), EnvStep(transition, step.metrics, lost)


def bounded_worlds(obs: Any) -> Array:
    """Return which worlds (S, T, E) have observations, leaves (S, T, E, ...), of finite numbers within the bound."""
    floats = [x for x in jax.tree.leaves(obs) if jnp.issubdtype(x.dtype, jnp.floating)]
    within = [jnp.all(jnp.abs(x) <= _LARGEST, axis=tuple(range(3, x.ndim))) for x in floats]
    return jnp.all(jnp.stack(within), axis=0) if within else jnp.ones(jax.tree.leaves(obs)[0].shape[:3], bool)


def reset_ended(env: Env, agent: Agent, learners: Any, tasks: Task, worlds: Worlds, ended: Array, keys: Key) -> Worlds:
    """Begin new episodes, with keys (S,), where ``ended`` (S, T, E); a branch skips this if no episode has ended.

    Every episode starts in a state of its own, drawn with its world's own key. If episodes end early, at any step, only
    ended worlds are reset: some at a time, as often as it takes. If all end by their time limits, many do at once, and
    all worlds are reset. Both give the same states.
    """

    def restart(worlds: Worlds) -> Worlds:
        fresh = reset_envs(env, agent, learners, tasks, world_keys(keys, ended.shape))
        rest = where_worlds(ended, fresh._replace(state=()), worlds._replace(state=()))
        return rest._replace(state=env.where_worlds(ended, fresh.state, worlds.state))

    def restart_some(worlds: Worlds) -> Worlds:
        age = jnp.where(ended, 0, worlds.age)
        memory = where_worlds(ended, begin_memory(agent, learners, tasks, age), worlds.memory)
        begun = _reset_some(env, tasks, worlds, ended, world_keys(keys, ended.shape))
        return begun._replace(memory=memory, age=age)

    some = isinstance(env, Flat) and env.ends_early and tasks.blocks is None
    return jax.lax.cond(jnp.any(ended), restart_some if some else restart, lambda worlds: worlds, worlds)


def _reset_some(env: Env, tasks: Task, worlds: Worlds, ended: Array, keys: Key) -> Worlds:
    """Return the worlds with new states, tasks and observations where ``ended`` (S, T, E), from keys (S, T, E).

    Worlds are reset in batches of at most one in ``_SHARES`` of all.
    """
    _, num_tasks, num_envs = ended.shape
    count, size = ended.size, -(-ended.size // _SHARES)
    flat_keys = keys.reshape(count)

    def reset(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        left, old = carry
        chosen = jnp.nonzero(left, size=size, fill_value=count)[0]  # what is beyond the last world is dropped again
        own, own_keys = chosen // num_envs % num_tasks, flat_keys[jnp.minimum(chosen, count - 1)]
        each = jax.tree.map(lambda x: x[own], tasks._replace(draws=None))
        if tasks.draws is not None:
            task_keys, own_keys = jax.vmap(jax.random.split, out_axes=1)(own_keys)
            each = jax.vmap(lambda i, key: episode_task(jax.tree.map(lambda x: x[i], tasks), key))(own, task_keys)
        start = env.reset_worlds(*jax.tree.map(lambda x: x[None, None], (each, own_keys)))
        state, obs = jax.tree.map(lambda x: x[0, 0], (start.state, frames.begin(start.obs, env.spec.frames)))
        put = lambda x, y: x.at[chosen].set(y, mode="drop")
        new = state, None if tasks.draws is None else each, obs
        return left.at[chosen].set(False, mode="drop"), jax.tree.map(put, old, new)

    old = worlds.state, worlds.task, worlds.obs
    flat = jax.tree.map(lambda x: x.reshape(count, *x.shape[3:]), old)
    _, new = jax.lax.while_loop(lambda carry: jnp.any(carry[0]), reset, (ended.reshape(count), flat))
    state, task, obs = jax.tree.map(lambda x: x.reshape(*ended.shape, *x.shape[1:]), new)
    return worlds._replace(state=state, task=task, obs=obs)
