"""Rollouts of agents in environments, for training, evaluation and films."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents.swept import at_point, numbers_of
from mtjax.learning.trials import EACH_EPISODE, Ends, Trials
from mtjax.parallel import collectives
from mtjax.parallel.axes import over_learners, renew_worlds, where_worlds
from mtjax.tasks import contexts_vary, episode_task
from mtjax.types import Acted, Agent, Array, Env, Key, Lasting, Task, Transition

_LARGEST = 1e10
"""Largest number in an observation: MuJoCo's own bound of positions and velocities (``mjMAXVAL``)."""


class Worlds(NamedTuple):
    """Holds the state of every world; leaves (S, T, E, ...)."""

    state: Any  # of the environment
    task: Task | None  # the trials' own tasks where trials draw theirs
    obs: Any  # (S, T, E, O), or with the last pictures
    memory: Any  # what the agent remembers of the trial
    age: Array  # (S, T, E) int32, steps of the episode
    episode: Any = None  # (S, T, E) int32, episodes of the trial before this one; None where trials are single episodes


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


def reset_envs(
    env: Env,
    agent: Agent,
    learners: Any,
    tasks: Task,
    keys: Key,
    trials: Trials = EACH_EPISODE,
    drawn: Callable[[Task], Task] = lambda drawn: drawn,
) -> Worlds:
    """Begin a trial in every world, with keys (S, T, E), for agents with states ``learners`` (S, ...).

    Args:
        drawn: a function from tasks (S, T, E, ...) that are drawn at random to those of the trials.
    """
    begun, age = _begin(env, tasks, keys, drawn), jnp.zeros(keys.shape, jnp.int32)
    memory = begin_memory(agent, learners, tasks, age)
    return Worlds(*begun, memory, age, age if trials.episodes > 1 else None)


class _Begun(NamedTuple):
    """Holds what begins anew with an episode; leaves (S, T, E, ...)."""

    state: Any  # of the environment
    task: Task | None  # the trials' own tasks where trials draw theirs
    obs: Any


def _begin(
    env: Env,
    tasks: Task,
    keys: Key,
    drawn: Callable[[Task], Task] = lambda drawn: drawn,
    renewed: tuple[Array, Any] | None = None,
) -> _Begun:
    """Begin an episode in every world, with keys (S, T, E).

    Args:
        drawn: a function from drawn tasks (S, T, E, ...) to those of the episodes.
        renewed: in which worlds (S, T, E) alone episodes begin, and the states of all; only their observations count.
    """
    if tasks.draws is None:
        each = broadcast_tasks(tasks, keys.shape)
    else:
        task_keys, keys = jnp.moveaxis(jax.vmap(jax.vmap(jax.vmap(jax.random.split)))(keys), -1, 0)
        each = drawn(_draw_tasks(tasks, task_keys))
    given = each._replace(blocks=tasks.blocks)
    start = env.reset_worlds(given, keys) if renewed is None else env.renew_worlds(given, keys, *renewed)
    return _Begun(start.state, None if tasks.draws is None else each, frames.begin(start.obs, env.spec.frames))


def _draw_tasks(tasks: Task, keys: Key) -> Task:
    """Draw a task for every world, with keys (S, T, E)."""
    of_task = jax.vmap(episode_task, (None, 0))
    return jax.vmap(jax.vmap(of_task), (None, 0))(tasks, keys)


def begin_memory(agent: Agent, learners: Any, tasks: Task, age: Array) -> Any:
    """Return the memory with which agents begin a trial in every world, of ages (S, T, E)."""
    return over_learners(lambda learner, task, _: at_point(agent, learner).begin(learner, task))(learners, tasks, age)


def tasks_of_worlds(tasks: Task, worlds: Worlds) -> Task:
    """Return the task of every world (S, T, E, ...)."""
    return (
        broadcast_tasks(tasks, worlds.age.shape) if worlds.task is None else worlds.task._replace(blocks=tasks.blocks)
    )


def act(agent: Agent, learners: Any, tasks: Task, worlds: Worlds, keys: Key | None) -> Acted:
    """Let agents act in all worlds; without keys (S, T, E) they take their mean actions."""
    noise, one = () if keys is None else (keys,), partial(_act, agent)
    if worlds.task is None:  # all worlds of a task have the same parameters
        return over_learners(one)(learners, tasks, worlds.memory, worlds.obs, *noise)
    of_world = lambda learner, _, *each: one(learner, *each)
    each = tasks_of_worlds(tasks, worlds)
    return over_learners(of_world)(learners, tasks.id, each, worlds.memory, worlds.obs, *noise)


def _act(agent: Agent, learner: Any, task: Task, memory: Any, obs: Any, key: Key | None = None) -> Acted:
    """Let an agent act in one world."""
    acted = at_point(agent, learner).act(learner, memory, obs, task, key)
    if not numbers_of(learner):
        return acted
    return acted._replace(action=jnp.nan_to_num(acted.action, posinf=0, neginf=0))  # a point may diverge alone


def _remember(agent: Agent, learner: Any, task: Task, memory: Any, transition: Transition) -> Any:
    return at_point(agent, learner).remember(learner, memory, transition, task)


class EnvStep(NamedTuple):
    """Holds one step of every world; leaves (S, T, E, ...)."""

    transition: Transition  # with the next observation from before any reset
    metrics: dict[str, Array]  # of the environment
    ends: Ends
    lost: Array  # bool: the numbers of the world's observation are not finite, or beyond ``_LARGEST``


def step_envs(
    env: Env,
    agent: Agent,
    learners: Any,
    tasks: Task,
    worlds: Worlds,
    keys: Key | None,
    explore: Callable[[Array], Array] = lambda action: action,
    trials: Trials = EACH_EPISODE,
) -> tuple[Worlds, EnvStep]:
    """Act in every world and step it; episodes that end are not reset.

    Physics sometimes blows up, as where a grip forces a body into another. Such a world is lost: its episode is cut off
    with a reward of 0, and its last observation stays.

    Args:
        keys: (S, T, E) for sampling actions; None takes the mean ones.
        explore: a function from the agent's actions (S, T, E, ...) to the actions that the worlds take.
    """
    each = tasks_of_worlds(tasks, worlds)
    acted = act(agent, learners, tasks, worlds, keys)
    action = env.spec.action.masked(explore(acted.action), each.action_mask)
    step = env.step_worlds(each, worlds.state, action)
    lost = ~bounded_worlds(step.obs)
    obs = where_worlds(lost, worlds.obs, frames.push(worlds.obs, step.obs))
    age = worlds.age + 1
    timeout = age >= each.horizon
    final = timeout if each.finite_horizon is None else timeout & each.finite_horizon
    finite = env.finite_horizon or each.finite_horizon is not None
    terminated = step.terminated | final if finite else step.terminated
    timeout = timeout if step.truncated is None else timeout | step.truncated
    ends = trials.ends(terminated & ~lost, timeout, lost, worlds.episode)
    transition = Transition(
        obs=worlds.obs,
        action=action,
        reward=jnp.where(lost, 0.0, step.reward),
        discount=1.0 - ends.terminal,
        next_obs=obs,
        ended=ends.episode,
        closed=ends.trial,
        cut=ends.cut,
        context=worlds.task.context if worlds.task is not None and contexts_vary(tasks) else None,
        extras=acted.extras,
        memory=worlds.memory,
    )
    memory = worlds.memory
    if jax.tree.leaves(memory):
        memory = over_learners(partial(_remember, agent))(learners, tasks, memory, transition)
    stepped = worlds._replace(state=step.state, obs=obs, memory=memory, age=age)
    return stepped, EnvStep(transition, step.metrics, ends, lost)


def bounded_worlds(obs: Any) -> Array:
    """Return which worlds (S, T, E) have observations, leaves (S, T, E, ...), of finite numbers within the bound."""
    floats = [x for x in jax.tree.leaves(obs) if jnp.issubdtype(x.dtype, jnp.floating)]
    # A CPU sums floats far faster than it finds whether all of many are true; its maximum may leave out a NaN.
    beyond = lambda x: jnp.sum(~(jnp.abs(x) <= _LARGEST), axis=tuple(range(3, x.ndim)), dtype=jnp.float32)
    within = [beyond(x) == 0 for x in floats]
    return jnp.all(jnp.stack(within), axis=0) if within else jnp.ones(jax.tree.leaves(obs)[0].shape[:3], bool)


def reset_ended(
    env: Env,
    agent: Agent,
    learners: Any,
    tasks: Task,
    worlds: Worlds,
    ends: Ends,
    keys: Callable[[], Key],
    trials: Trials = EACH_EPISODE,
) -> tuple[Worlds, Array]:
    """Begin new episodes, and new trials, where they have ended; a branch skips this if no episode has.

    Every episode starts in a state of its own, drawn with its world's own key. If episodes end early, at any step, only
    ended worlds are reset: some at a time, as often as it takes. If all end by their time limits, many do at once, and
    all worlds are reset. A GPU, whose host decides about every branch, resets all at every step if starts are cheap.
    All ways give the same states.

    Args:
        ends: what has ended with the step before, leaves (S, T, E).
        keys: a function that returns keys (S, T, E); only a reset calls it.

    Returns:
        the worlds, and (S, T, E) bool, which is false where an episode begins with numbers out of bounds.
    """
    own = type(env).renew_worlds is not renew_worlds  # as it steps all of its worlds at once
    few = not own and env.ends_early and env.episode_length > 1
    some = partial(_reset_some if few else _reset_all, env)
    if trials.keeps_state:
        some = partial(_change_tasks, cast(Lasting, env))

    def renew(begin: Callable[..., tuple[_Begun, Array]], worlds: Worlds) -> tuple[Worlds, Array]:
        begun, sound = begin(tasks, worlds, ends, keys(), trials)
        age = jnp.where(ends.episode, 0, worlds.age)
        memory = where_worlds(ends.trial, begin_memory(agent, learners, tasks, age), worlds.memory)
        episode = None if worlds.episode is None else jnp.where(ends.trial, 0, worlds.episode + ends.episode)
        return Worlds(*begun, memory, age, episode), sound

    def branch(worlds: Worlds) -> tuple[Worlds, Array]:
        none = lambda worlds: (worlds, jnp.ones(worlds.age.shape, bool))
        return jax.lax.cond(jnp.any(ends.episode), partial(renew, some), none, worlds)

    if trials.keeps_state or not (few and env.cheap_starts):
        return branch(worlds)
    return jax.lax.platform_dependent(worlds, cuda=partial(renew, partial(_reset_all, env)), default=branch)


def followed(transition: Transition, ends: Ends, worlds: Worlds) -> Transition:
    """Return steps with what follows them in their trials, given the worlds after ``reset_ended``.

    Inside a trial that is the first observation of the next episode. Where sums end it stays the one before any reset.
    """
    if worlds.episode is None:
        return transition
    inside = ends.episode & ~ends.cut
    return transition._replace(next_obs=where_worlds(inside, worlds.obs, transition.next_obs))


# There are three ways to begin anew. Each returns all worlds, and leaves those that have not ended as they were. Each
# also returns (S, T, E) bool, false where a first observation is out of bounds.


def _reset_all(env: Env, tasks: Task, worlds: Worlds, ends: Ends, keys: Key, trials: Trials) -> tuple[_Begun, Array]:
    """Reset all worlds with keys (S, T, E), and take those that have ended."""
    lasting = lambda drawn: where_worlds(ends.trial, drawn, worlds.task)
    drawn = lasting if trials.episodes > 1 else lambda drawn: drawn
    start = _begin(env, tasks, keys, drawn, (ends.world, worlds.state))
    begun = _Begun(start.state, *where_worlds(ends.episode, (start.task, start.obs), (worlds.task, worlds.obs)))
    return begun, ~ends.episode | bounded_worlds(start.obs)


def _change_tasks(
    env: Lasting, tasks: Task, worlds: Worlds, ends: Ends, keys: Key, trials: Trials
) -> tuple[_Begun, Array]:
    """Choose tasks with keys (S, T, E) where trials have ended, whose worlds go on as they are; reset lost ones."""
    lost, own = ends.world, _Begun(worlds.state, worlds.task, worlds.obs)
    again = lambda: _reset_all(env, tasks, worlds, Ends(lost, lost, lost, lost, lost), keys, trials)
    begun, sound = jax.lax.cond(jnp.any(lost), again, lambda: (own, jnp.ones(lost.shape, bool)))
    if tasks.draws is None:
        return begun, sound
    of_task = jax.vmap(partial(trials.plays.follow, env), (None, 0, 0, 0))  # type: ignore
    follow = jax.vmap(jax.vmap(of_task), (None, 0, 0, 0))
    following = follow(tasks, worlds.task, begun.state, keys)  # type: ignore
    goes_on = ends.trial & ~lost
    seen = frames.begin(env.observe_worlds(following, begun.state), env.spec.frames)
    begun = _Begun(begun.state, *where_worlds(goes_on, (following, seen), (begun.task, begun.obs)))
    return begun, sound & (~goes_on | bounded_worlds(seen))


def _reset_some(env: Env, tasks: Task, worlds: Worlds, ends: Ends, keys: Key, trials: Trials) -> tuple[_Begun, Array]:
    """Reset worlds that have ended with keys (S, T, E). A batch holds one in ``env.reset_batches`` of all worlds."""
    ended = ends.episode
    _, num_tasks, num_envs = ended.shape
    count, size = ended.size, -(-ended.size // env.reset_batches)
    flat_keys, closed = keys.reshape(count), ends.trial.reshape(count)

    def tasks_of(chosen: Array, old: Task | None, keys: Key) -> tuple[Task, Key]:
        """Return the tasks of the chosen worlds, and keys for their states."""
        own, keys = chosen // num_envs % num_tasks, keys[jnp.minimum(chosen, count - 1)]
        if tasks.draws is None:
            return jax.tree.map(lambda x: x[own], tasks), keys
        task_keys, keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        drawn = jax.vmap(lambda i, key: episode_task(jax.tree.map(lambda x: x[i], tasks), key))(own, task_keys)
        if trials.episodes == 1:
            return drawn, keys
        choose = lambda new, old: jnp.where(closed[chosen].reshape(-1, *[1] * (new.ndim - 1)), new, old[chosen])
        return jax.tree.map(choose, drawn, old), keys

    def reset(carry: tuple[Array, tuple[_Begun, Array]]) -> tuple[Array, tuple[_Begun, Array]]:
        left, (old, sound) = carry
        chosen = jnp.nonzero(left, size=size, fill_value=count)[0]  # what is beyond the last world is dropped again
        each, own_keys = tasks_of(chosen, old.task, flat_keys)
        start = env.reset_worlds(*jax.tree.map(lambda x: x[None, None], (each, own_keys)))
        state, obs = jax.tree.map(lambda x: x[0, 0], (start.state, frames.begin(start.obs, env.spec.frames)))
        put = lambda x, y: x.at[chosen].set(y, mode="drop")
        new = _Begun(state, None if tasks.draws is None else each, obs)
        anew = jax.tree.map(put, (old, sound), (new, bounded_worlds(start.obs)[0, 0]))
        return left.at[chosen].set(False, mode="drop"), anew

    old = _Begun(worlds.state, worlds.task, worlds.obs)
    flat = jax.tree.map(lambda x: x.reshape(count, *x.shape[3:]), old)
    first = ended.reshape(count), (flat, jnp.ones(count, bool))
    _, new = jax.lax.while_loop(lambda carry: jnp.any(carry[0]), reset, first)
    return jax.tree.map(lambda x: x.reshape(*ended.shape, *x.shape[1:]), new)
