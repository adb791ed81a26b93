"""The learning loop is two pure functions: ``init`` makes a training state, and ``run_chunk`` advances it.

A chunk is one jitted, donated ``lax.scan`` of collect, add and learn, for all seeds at once. Agents are mapped over
seeds. The worlds of all seeds, tasks and environments are one flat batch: it traces and compiles faster than nested
maps, and decisions that all seeds share stay branches. Where devices share a seed's environments, E counts one device's
own. Random numbers are then drawn for all environments, and each device takes its own.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents.fit import reset_networks
from mtjax.agents.state import of_tasks, with_tasks
from mtjax.agents.swept import at_point, numbers_of, with_numbers
from mtjax.agents.task_changes import change, consolidate, consolidates
from mtjax.checks import check_fields, require_counts
from mtjax.learning import curricula
from mtjax.learning.rollout import (
    EnvStep,
    Worlds,
    bounded_worlds,
    followed,
    reset_ended,
    reset_envs,
    split_keys,
    step_envs,
    world_keys,
)
from mtjax.learning.trials import ResetFree, Trials, of_episodes
from mtjax.parallel import collectives
from mtjax.parallel.axes import over_seeds, when
from mtjax.types import Agent, Array, Env, InputError, Key, Metrics, Task, Transition, Weighted

PHASES = 10
"""Largest number of different first ages, as each causes a separate reset in every episode."""

_END = 0xE2D  # folded into the key where a task ends

_MOST_LOST = 1e-4
"""Largest share of a task's steps in a chunk at which worlds may be lost."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Holds the settings of the loop."""

    num_envs: int = 16
    """Number of environments per task."""
    chunk_steps: int = 1000
    """Steps of every environment between two lines of metrics; evaluation and checkpoints happen between chunks."""
    stagger: bool = True
    """Begin environments at different ages, so that their episodes end at different times; returns do not count first
    episodes, which are shorter."""
    curriculum: str = "all"
    """Which training tasks are played: all; random:T:STEPS, T of them, and others after so many steps of every
    environment; progress:T:STEPS or hardest:T:STEPS, those whose returns change most or are least;
    growing:T:STEPS:RETURN, a range from the middle that grows where its ends return so much; sequence:STEPS, one after
    another; or shuffled:STEPS, the same in random order. The agent knows all of them, and is evaluated on all. With
    --reset-free all are played, and what follows what in a world may be forward-backward, a goal and the way back in
    turns; or graph, the nearest goal, or from a goal any other one."""
    keep_replay: bool = False
    """Keep the replay where the curriculum changes tasks, and go on without random steps. Stored steps do not say of
    which task they are: only for agents that are blind to the task."""
    trials: int = 1
    """Episodes of a trial: for so many of them the task and the agent's memory stay, and the agent maximises their sum
    of rewards. 1 makes every episode a trial of its own."""
    reset_free: bool = False
    """Let training worlds go on where an episode's time is up, in the state in which they are, with another task if
    episodes draw theirs. Only for families that never terminate, and in which all draws are goals. Evaluations begin
    every episode anew."""

    def __post_init__(self):
        check_fields(self)
        require_counts(self, "num_envs", "chunk_steps", "trials")
        if self.reset_free and self.trials > 1:
            raise InputError(f"--reset-free has no episodes to repeat; use --trials=1, not {self.trials}")
        _ = self.trial, self.plays

    @property
    def plays(self) -> curricula.Curriculum:
        """Return which tasks are played."""
        return curricula.read(self.curriculum)

    @property
    def trial(self) -> Trials:
        """Return what a trial is."""
        return ResetFree(self.plays) if self.reset_free else of_episodes(self.trials)


class TrainState(NamedTuple):
    """Holds everything that a run needs to continue bit for bit."""

    agent: Any  # leaves (S, ...)
    worlds: Worlds  # leaves (S, T, E, ...)
    total: Array  # (S, T, E) return of the episode so far
    counted: Array  # (S, T, E) bool: the episode began at age 0, so its return counts
    data: Any  # the experience's, leaves (S, ...)
    iteration: Array  # () int32, steps taken by every environment
    key: Key  # (S,)
    rows: Any = None  # (T,) int32 numbers of the tasks that worlds play; None: all that the agent knows
    origins: Array | None = None  # (S,) int32 of a population: the first member from which each descends
    heard: Any = None  # (N, 2) of a curriculum that heeds returns: what was heard of all tasks that are known
    begun: Array | None = None  # () int32 of a curriculum: the iteration at which experience last began

    @property
    def stored(self) -> Array:
        """Return how many steps () of every environment were taken since experience began."""
        return self.iteration if self.begun is None else self.iteration - self.begun


@partial(jax.jit, static_argnums=(0, 1, 2))
def init(
    env: Env, agent: Agent, settings: Settings, tasks: Task, seeds: Array, numbers: dict[str, Array] | None = None
) -> TrainState:
    """Return a fresh training state for ``seeds`` (S,) on training ``tasks`` (N, ...).

    ``mtjax.learning.combinations`` says which settings, agents and families go together, and is asked before.

    Args:
        numbers: values (S,), by name, of the agent's numbers that vary between seeds, in a sweep.
    """
    known, rows = tasks, None
    if settings.plays.steps:
        rows = settings.plays.rows(jnp.int32(0), len(known.id))
        tasks = rows_of(known, rows)
    num_tasks = len(tasks.id)
    shape = (len(seeds), num_tasks, settings.num_envs // collectives.count())
    key, agent_key, reset_key, data_key = split_keys(jax.vmap(jax.random.key)(seeds), 4)
    learners = jax.vmap(partial(_init_agent, env, agent, known))(agent_key, numbers or {})
    worlds = _first_worlds(env, agent, settings, learners, tasks, world_keys(reset_key, shape))
    blank = _blank(env, agent, learners, tasks, worlds, world_keys(key, shape))
    return TrainState(
        agent=learners,
        worlds=worlds,
        total=jnp.zeros(shape),
        counted=worlds.age == 0,
        data=agent.experience.init(blank, env.spec, num_tasks, settings.num_envs, data_key),
        iteration=jnp.int32(0),
        key=key,
        rows=rows,
        heard=settings.plays.heard(len(known.id)),
        begun=None if rows is None else jnp.int32(0),
    )


def _init_agent(env: Env, agent: Agent, tasks: Task, key: Key, numbers: dict[str, Array]) -> Any:
    """Return the initial state of an agent, which keeps those of its numbers that a sweep varies."""
    state = with_numbers(agent, numbers).init(env.spec, tasks, key)
    return state._replace(numbers=numbers) if numbers else state


def _first_worlds(env: Env, agent: Agent, settings: Settings, learners: Any, tasks: Task, keys: Key) -> Worlds:
    """Begin all worlds with keys (S, T, E), at different ages if ``settings.stagger`` says so."""
    worlds = reset_envs(env, agent, learners, tasks, keys, settings.trial)
    if not settings.stagger:
        return worlds
    episode = None if worlds.episode is None else _first_episodes(settings.trials, keys.shape)
    return worlds._replace(age=_first_ages(tasks, keys.shape), episode=episode)


def _first_ages(tasks: Task, shape: tuple[int, ...]) -> Array:
    """Return first ages (S, T, E), spread evenly over the tasks' horizons, with at most ``PHASES`` values."""
    count = shape[2] * collectives.count()
    phases = min(count, PHASES)
    phase = jnp.arange(count, dtype=jnp.int32) * phases // count
    ages = tasks.horizon[:, None] * phase // phases
    return jnp.broadcast_to(collectives.own(ages, axis=1), shape)


def _first_episodes(trials: int, shape: tuple[int, ...]) -> Array:
    """Return the first episodes (S, T, E) of trials, of which there are ``trials`` episodes each."""
    number = jnp.arange(shape[2] * collectives.count(), dtype=jnp.int32)
    return jnp.broadcast_to(collectives.own(number % trials, axis=0), shape)


def _blank(env: Env, agent: Agent, learners: Any, tasks: Task, worlds: Worlds, keys: Key) -> Transition:
    """Return a transition of zeros, without leading axes."""
    step = lambda learners, worlds, keys: step_envs(env, agent, learners, tasks, worlds, keys)[1].transition
    shapes = jax.eval_shape(step, learners, worlds, keys)
    return jax.tree.map(lambda x: jnp.zeros(x.shape[3:], x.dtype), shapes)


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=4)
def run_chunk(env: Env, agent: Agent, settings: Settings, tasks: Task, state: TrainState) -> tuple[TrainState, Metrics]:
    """Advance all seeds by ``settings.chunk_steps`` steps of every environment.

    Returns:
        the new state, and metrics by name:
            return: (S, T) the mean return of the episodes that ended.
            episodes: (S, T) the number of these.
            the environment's: (S, T) each, means over these episodes' last steps.
            the agent's: (S, T) or (S,) each, means over the updates.
            lost: (S, T) how often a world was lost (``step_envs``); its episode does not count.
            bad_step: (S, T) the first step with numbers that were not finite, or -1. An episode's first observation
                counts to the step before it, or to the first of the chunk. Lost worlds count as such numbers if they
                are more than one, and more than one in 10,000 steps of the task.
            bad_reward: (S, T) the first step with a reward that was not finite, or -1.
    """
    experience, known = agent.experience, tasks
    if settings.plays.steps:
        state = _take_turns(env, agent, settings, known, state)
        tasks = rows_of(known, state.rows)
    sound = jnp.all(bounded_worlds(state.worlds.obs), axis=2)

    def iterate(state: TrainState, _) -> tuple[TrainState, tuple[_Seen, Metrics, Array]]:
        key, act_key, reset_key, learn_key = split_keys(state.key, 4)
        state, steps, seen = _collect(env, agent, settings, tasks, state, act_key, reset_key)
        observe = lambda learner, steps: at_point(agent, learner).observe(learner, steps, tasks)
        learners, steps = over_seeds(partial(_assess, agent, tasks), 0, 0)(_of_played(state.agent, state.rows), steps)
        state = state._replace(data=experience.add(state.data, steps))
        learners, losses, learned = _learn(env, agent, tasks, learners, state, learn_key)
        learners = over_seeds(observe, 0, 0)(learners, steps)
        learners = _with_played(state.agent, learners, state.rows)
        data = state.data if experience.storage.kept else ()
        return state._replace(agent=learners, data=data, key=key), (seen, losses, learned)

    state, (seen, losses, learned) = jax.lax.scan(iterate, state, length=settings.chunk_steps // experience.steps)
    seen = seen._replace(numbers=seen.numbers.at[0, 0, ..., 2].max(jnp.float32(~sound)))
    metrics = _summarise(seen, losses, learned, settings.num_envs * settings.chunk_steps)
    if state.heard is not None:
        returns = collectives.of_all_seeds(metrics["return"])
        state = state._replace(heard=curricula.hear(state.heard, state.rows, returns))
    if settings.plays.steps:
        metrics = _of_known(metrics, state.rows, len(known.id))
    return state._replace(agent=collectives.agreed(state.agent)), metrics


# Some of the known tasks.


def rows_of(tasks: Task, rows: Any) -> Task:
    """Return the tasks (T, ...) with these numbers (T,), of a table (N, ...)."""
    taken = jax.tree.map(lambda x: x[rows], tasks)
    return taken if tasks.blocks is None else taken._replace(blocks=tasks.blocks.some(len(rows)))


def _take_turns(env: Env, agent: Agent, settings: Settings, known: Task, state: TrainState) -> TrainState:
    """Begin the tasks that the curriculum plays from here on. If they are others, worlds and experience begin anew."""
    chunk = state.iteration, settings.chunk_steps
    rows, shape = settings.plays.next_rows(*chunk, state.rows, state.heard, len(known.id)), state.total.shape

    def begin(state: TrainState) -> TrainState:
        tasks = rows_of(known, rows)
        key, reset_key, data_key, act_key = split_keys(state.key, 4)
        worlds = _first_worlds(env, agent, settings, state.agent, tasks, world_keys(reset_key, shape))
        blank = _blank(env, agent, state.agent, tasks, worlds, world_keys(act_key, shape))
        fresh = {"total": jnp.zeros(shape), "counted": worlds.age == 0}
        if not settings.keep_replay:
            data = agent.experience.init(blank, env.spec, shape[1], settings.num_envs, data_key)
            fresh |= {"data": data, "begun": state.iteration}
        fresh |= {"agent": _consolidate(env, agent, settings, known, state)}
        return state._replace(worlds=worlds, key=key, rows=rows, **fresh)

    return jax.lax.cond(jnp.any(rows != state.rows), begin, lambda state: state, state)


def _consolidate(env: Env, agent: Agent, settings: Settings, known: Task, state: TrainState) -> Any:
    """Return the agents (S, ...) as they end the task that was played, from whose steps they may learn once more."""
    if not consolidates(agent):
        return state.agent
    keys = jax.vmap(lambda key: jax.random.fold_in(key, _END))(state.key)
    fresh = lambda: jax.vmap(partial(_init_agent, env, agent, known))(keys, numbers_of(state.agent))
    if agent.continual.restarts:
        return fresh()
    tasks, experience, kept = rows_of(known, state.rows), agent.experience, agent.experience.storage.kept
    steps = state.data if kept else _last_rollout(env, agent, settings, tasks, state, keys)

    def of_seed(learner: Any, steps: Any, key: Key) -> Any:
        draw = lambda key, count: experience.draw(env.spec, agent, steps.ring if kept else steps, key, count)
        return consolidate(at_point(agent, learner), learner, draw, tasks, key)

    played = _of_played(state.agent, state.rows)
    played = over_seeds(of_seed, 0, experience.storage.axes if kept else 0, 0)(played, steps, keys)
    ended = _with_played(state.agent, played, state.rows)
    return over_seeds(partial(change, agent), 0, 0)(ended, fresh()) if agent.plasticity.changes else ended


def _last_rollout(env: Env, agent: Agent, settings: Settings, tasks: Task, state: TrainState, keys: Key) -> Any:
    """Return steps (S, T, H, E, ...) of the task that ends, for an agent without a replay that remembers some."""
    if not agent.continual.samples:
        return ()
    act_keys, reset_keys = split_keys(keys, 2)
    return _collect(env, agent, settings, tasks, state, act_keys, reset_keys)[1]


def _of_played(learners: Any, rows: Array | None) -> Any:
    """Return agents (S, ...) with their own parameters of the tasks that are played."""
    return learners if rows is None else over_seeds(of_tasks, 0, None)(learners, rows)


def _with_played(learners: Any, played: Any, rows: Array | None) -> Any:
    """Return agents (S, ...) with the parameters of the tasks that were played put back."""
    return played if rows is None else over_seeds(with_tasks, 0, 0, None)(learners, played, rows)


def _of_known(metrics: Metrics, rows: Any, known: int) -> Metrics:
    """Return metrics (S, T) of the tasks that were played as those of all known ones (S, N), of others as nothing."""
    nothing = {"episodes": 0, "lost": 0, "bad_step": -1, "bad_reward": -1}

    def spread(name: str, x: Array) -> Array:
        if x.ndim < 2:
            return x
        rest = jnp.full((len(x), known), nothing.get(name, jnp.nan), x.dtype)
        return rest.at[:, rows].set(x)

    return {name: spread(name, x) for name, x in metrics.items()}


def _collect(
    env, agent, settings: Settings, tasks, state: TrainState, keys: Key, reset_keys: Key
) -> tuple[TrainState, Transition, Any]:
    """Take as many steps as the agent's experience asks for. Agents that adapt do so between its rollouts.

    Returns:
        the new state; the steps, leaves (S, T, H, E, ...); and their statistics, leaves (H, S, ...).
    """
    count, adaptations = agent.experience.steps, agent.experience.adaptations
    if count == 1:
        state, (steps, seen) = _step(env, agent, settings, tasks, state, keys, reset_keys)
        return state, jax.tree.map(lambda x: x[:, :, None], steps), jax.tree.map(lambda x: x[None], seen)
    step = lambda state, keys: _step(env, agent, settings, tasks, state, *keys)
    apart = jnp.stack([jnp.stack(split_keys(each, count)) for each in (keys, reset_keys)], axis=1)  # (H, 2, S)
    if not adaptations:
        begun, (state, steps, seen) = state.worlds.memory, _played(*jax.lax.scan(step, state, apart))
        whole = count == agent.unroll and not agent.experience.storage.kept
        return state, _with_first(steps, begun) if whole else steps, seen

    def play(state: TrainState, given: tuple) -> tuple[TrainState, tuple[Transition, Any]]:
        """Take the steps of one rollout, and adapt to them if another follows."""
        last, keys = given
        state, steps, seen = _played(*jax.lax.scan(step, state, keys))
        adapt = lambda learner, steps: at_point(agent, learner).adapt(learner, steps, tasks)
        learners = jax.lax.cond(last, lambda: state.agent, lambda: over_seeds(adapt, 0, 0)(state.agent, steps))
        return state._replace(agent=learners), (steps, seen)

    apart = apart.reshape(adaptations + 1, -1, *apart.shape[1:])
    state, (steps, seen) = jax.lax.scan(play, state, (jnp.arange(adaptations + 1) == adaptations, apart))
    joined = lambda x: jnp.moveaxis(x, 0, 2).reshape(*x.shape[1:3], count, *x.shape[4:])
    return state, jax.tree.map(joined, steps), jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), seen)


@partial(jax.jit, static_argnums=(0, 1, 2))
def rollout(
    env: Env, agent: Agent, settings: Settings, tasks: Task, learners: Any, keys: Key
) -> tuple[Any, Transition]:
    """Let agents (S, ...) play ``tasks`` (T, ...) in fresh worlds, with keys (S,), for as long as before they learn.

    Returns:
        the agents, which have assessed the steps, and these, leaves (S, T, H, E, ...).
    """
    begin_keys, act_keys, reset_keys = split_keys(keys, 3)
    shape = len(keys), len(tasks.id), settings.num_envs
    worlds = _first_worlds(env, agent, settings, learners, tasks, world_keys(begin_keys, shape))
    state = TrainState(learners, worlds, jnp.zeros(shape), worlds.age == 0, (), jnp.int32(0), keys)
    steps = _collect(env, agent, settings, tasks, state, act_keys, reset_keys)[1]
    return over_seeds(partial(_assess, agent, tasks), 0, 0)(learners, steps)


def _assess(agent: Agent, tasks: Task, learner: Any, steps: Transition) -> tuple[Any, Transition]:
    return at_point(agent, learner).assess(learner, steps, tasks)


def _with_first(steps: Transition, begun: Any) -> Transition:
    """Keep of what agents learn through, in windows of whole rollouts, that before the first step: (S, T, 1, E, ...).

    Otherwise a memory of many numbers would be stored at every step.
    """
    if begun.hidden is None:
        return steps
    hidden = jax.tree.map(lambda x: x[:, :, None], begun.hidden)
    return steps._replace(memory=steps.memory._replace(hidden=hidden))


def _played(state: TrainState, taken: tuple[Transition, Any]) -> tuple[TrainState, Transition, Any]:
    """Return a state, steps (S, T, H, E, ...) and their statistics (H, S, ...), given steps (H, S, T, E, ...)."""
    steps, seen = taken
    return state, jax.tree.map(lambda x: jnp.moveaxis(x, 0, 2), steps), seen


def _step(env, agent, settings: Settings, tasks, state: TrainState, keys: Key, reset_keys: Key):
    """Step every environment once, and begin new episodes where episodes ended."""
    trials, shape = settings.trial, state.total.shape
    explore = lambda action: agent.experience.explore(state.data, action, state.stored)
    act_keys = world_keys(keys, shape)
    worlds, env_step = step_envs(env, agent, state.agent, tasks, state.worlds, act_keys, explore, trials)
    transition, total = env_step.transition, state.total + env_step.transition.reward
    ended = transition.ended
    fresh_keys = partial(world_keys, reset_keys, shape)
    begun, sound = reset_ended(env, agent, state.agent, tasks, worlds, env_step.ends, fresh_keys, trials)
    seen = _reduce_step(env_step, sound, total, state.counted)
    state = state._replace(
        worlds=begun,
        total=jnp.where(ended, 0.0, total),
        counted=state.counted | ended,
        iteration=state.iteration + 1,
    )
    return state, (followed(transition, env_step.ends, begun), seen)


def _learn(env, agent, tasks, learners: Any, state: TrainState, keys: Key) -> tuple[Any, Metrics, Array]:
    """Update the agents of all seeds once the first random steps are over, which is at the same step for all seeds.

    Args:
        learners: the agents, which have assessed the latest steps.
        state: the training state with these steps.

    Returns:
        their new states, the means of the updates' metrics, and () 1 if there were updates, else 0.
    """
    experience, data, iteration = agent.experience, state.data, state.iteration
    if not experience.warmup_steps:
        learners, metrics = _update(env, agent, tasks, learners, data, iteration, keys)
        return learners, metrics, jnp.float32(1)
    learning, metrics = state.stored - 1 >= experience.warmup_steps, {}
    learners = _reset_networks(env, agent, tasks, learners, iteration, keys)
    if experience.updates:
        update = lambda learners: _update(env, agent, tasks, learners, data, iteration, keys)
        learners, metrics = when(learning, update, learners)
    return learners, metrics, jnp.float32(learning)


@partial(jax.jit, static_argnums=(0, 1))  # so that it is traced once, though ``when`` needs its shapes too
def _update(env, agent, tasks, learners: Any, data: Any, iteration: Array, keys: Key) -> tuple[Any, Metrics]:
    """Make the updates that follow ``iteration`` () steps of every environment, one after another."""
    experience = agent.experience
    # Times of updates since the first warm-up; those are counted too that a later one, of other tasks, leaves out.
    earlier = iteration // experience.steps - experience.warmup_steps // experience.steps - 1
    numbers = earlier * experience.updates + jnp.arange(experience.updates)

    def learn_one(learner: Any, data: Any, key: Key) -> tuple[Any, Metrics]:
        batch_key, update_key = jax.random.split(key)
        batches = experience.batches(env, at_point(agent, learner), tasks, data, batch_key, learner)

        def update(learner: Any, given: tuple[Any, Key, Array]) -> tuple[Any, Metrics]:
            batch, key, number = given
            return at_point(agent, learner).update(learner, experience.window(data, batch), tasks, key, number)

        update_keys = jax.random.split(update_key, experience.updates)
        learner, metrics = jax.lax.scan(update, learner, (batches, update_keys, numbers))
        return learner, jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)

    return over_seeds(learn_one, 0, experience.storage.axes, 0)(learners, data, keys)


def _reset_networks(env, agent, tasks, learners: Any, iteration: Array, keys: Key) -> Any:
    """Begin networks anew if the experience's ``reset_every`` says so after ``iteration`` () steps."""
    experience = agent.experience
    if not experience.reset_every:
        return learners
    before = iteration - 1
    passed = before // experience.reset_every > jnp.maximum(before - experience.steps, 0) // experience.reset_every
    due = (before > experience.warmup_steps) & passed

    def one(state: Any, key: Key) -> Any:
        return reset_networks(at_point(agent, state), state, env.spec, tasks, jax.random.fold_in(key, 1))

    return jax.lax.cond(due, lambda states: over_seeds(one, 0, 0)(states, keys), lambda states: states, learners)


class _Seen(NamedTuple):
    """Holds the statistics of a step for metrics, in one array, as a GPU stores each array by a kernel of its own.

    It holds the number of episodes that ended and count, the number of lost worlds, 1 where numbers are bad, 1 where
    rewards are, and the sums of these episodes' returns, and of each metric of the environment at their last steps.
    """

    numbers: Array  # (S, T, 5 + M)
    metrics: dict[str, None]  # the names of the M


def _reduce_step(env_step: EnvStep, sound: Array, total: Array, counted: Array) -> _Seen:
    """Reduce a step to the statistics for metrics.

    Args:
        sound: (S, T, E) where no episode began with numbers out of bounds; others of that kind are lost.
    """
    transition = env_step.transition
    finished = transition.ended & counted & ~env_step.lost
    over_envs = lambda x: jnp.sum(jnp.where(finished, x, 0.0), axis=2)  # what is not finished may not be finite
    finite = jnp.isfinite(transition.reward)
    bad, unrewarded = (jnp.any(~x, axis=2) for x in (sound & finite, finite))
    counts = (jnp.sum(finished, axis=2), jnp.sum(env_step.lost, axis=2), bad, unrewarded)
    names = sorted(env_step.metrics)
    numbers = (*counts, over_envs(total), *(over_envs(env_step.metrics[name]) for name in names))
    return _Seen(jnp.stack([jnp.float32(x) for x in numbers], axis=-1), dict.fromkeys(names))


def _summarise(seen: _Seen, losses: Any, learned: Array, count: int) -> Metrics:
    """Reduce the statistics of all steps, leaves (iterations, steps, S, ...), to one line of metrics.

    Args:
        losses: the means of each iteration's updates, leaves (iterations, S, ...).
        learned: (iterations,) whether there were updates.
        count: the steps of a task in the chunk.
    """
    mean = lambda x: jnp.sum(x, axis=0) / jnp.maximum(jnp.sum(learned), 1)
    over_steps = lambda x: jnp.sum(x, axis=(0, 1))
    counts, sums = jnp.int32(seen.numbers[..., :4]), over_steps(seen.numbers[..., 4:])
    (finished, lost, bad, unrewarded), (total, *metrics) = (
        jnp.moveaxis(x, -1, 0) for x in collectives.total((counts, sums))
    )
    episodes = over_steps(finished)
    often = over_steps(lost) > max(_MOST_LOST * count, 1)  # a short chunk may lose a world too
    bad = (bad > 0) | (often & (lost > 0))
    # A bad step of one task spoils the losses of all that share its networks; then only that task is reported.
    blameless = ~jnp.any(bad, axis=3, keepdims=True)
    for loss in jax.tree.leaves(losses):
        bad |= blameless & ~jnp.isfinite(loss).reshape(len(loss), 1, loss.shape[1], -1)
    means = jax.tree.map(mean, losses)
    return {name: x.mean if isinstance(x, Weighted) else x for name, x in means.items()} | {
        "episodes": episodes,
        "return": total / episodes,
        **{name: x / episodes for name, x in zip(seen.metrics, metrics, strict=True)},
        "lost": over_steps(lost),
        "bad_step": _first(bad),
        "bad_reward": _first(unrewarded > 0),
    }


def _first(bad: Array) -> Array:
    """Return the first step (S, T) at which ``bad`` (iterations, steps, S, T) is true, or -1."""
    of_steps = bad.reshape(-1, *bad.shape[2:])
    return jnp.where(jnp.any(of_steps, axis=0), jnp.argmax(of_steps, axis=0), -1)
