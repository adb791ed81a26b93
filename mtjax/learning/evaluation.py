"""Evaluation plays whole trials under the mean action or drawn ones, on any tasks, with keys of its own.

Trials that draw their tasks play all draws of a task before one comes again, as benchmarks with listed goals ask.

Of trials of several episodes (``mtjax.learning.trials``), the episodes of one follow each other along the axis of
episodes.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents.swept import at_point
from mtjax.learning.rollout import EnvStep, Worlds, reset_ended, reset_envs, split_keys, step_envs, world_keys
from mtjax.learning.trials import Trials, of_episodes
from mtjax.names import replacing
from mtjax.parallel.axes import over_seeds
from mtjax.tasks import draw_at
from mtjax.types import SPLITS, Adapting, Agent, Array, Env, InputError, Key, Task, Transition

_ASKED = 100  # steps between two times of asking whether all episodes have ended
_PARTS = 100  # of an evaluation, at most, if the host plays it part by part
_EVER = "success_ever"  # the metric that success was 1 at any step of an episode


class Episodes(NamedTuple):
    """Says how many episodes of each task an evaluation plays, in trials of how many, and by which actions."""

    count: int  # a multiple of ``trial``
    trial: int = 1
    sampled: bool = False  # draw actions from the policy; else take its mean ones, or the likeliest choices


class Scores(NamedTuple):
    """Holds every episode of one evaluation."""

    returns: Any  # (S, T, episodes) undiscounted
    metrics: dict[str, Any]  # (S, T, episodes) each, such as success: values at the episode's last step, and _EVER


def of_tasks(scores: Scores, places: Sequence[int] | np.ndarray) -> Scores:
    """Return the scores of some tasks, by their places along T."""
    return jax.tree.map(lambda x: np.asarray(x)[:, places], scores)


class Evaluations(NamedTuple):
    """Holds every episode of every evaluation of a run."""

    steps: np.ndarray  # (V,) environment steps, summed over tasks, before each evaluation
    returns: dict[str, np.ndarray]  # split -> (S, V, T, episodes)
    values: dict[str, np.ndarray]  # split -> (T,) value of the varying parameter
    metrics: Mapping[str, dict[str, np.ndarray]] = MappingProxyType({})  # name -> split -> (S, V, T, episodes)
    seeds: np.ndarray | tuple[()] = ()  # (S,); unknown of runs of earlier versions
    trial: int = 1  # episodes of a trial


def no_evaluations(
    seeds: Sequence[int] | np.ndarray, values: Mapping[str, np.ndarray], episodes: int, trial: int = 1
) -> Evaluations:
    """Return the evaluations of a run that has not begun: of seeds (S,), and of tasks by their values (T,) by split."""
    seeds = np.asarray(seeds, np.int64)
    returns = {split: np.zeros((len(seeds), 0, len(x), episodes), np.float32) for split, x in values.items()}
    return Evaluations(np.zeros(0, np.int64), returns, dict(values), seeds=seeds, trial=trial)


def as_one_seed(evaluations: Evaluations) -> Evaluations:
    """Return the evaluations of a population as those of one seed: means over its members.

    Members are copies of each other, and no independent seeds. Those whose last returns are not finite are left out.
    """
    last = evaluations.returns["train"][:, -1:]
    known = np.isfinite(last).all(axis=(1, 2, 3))
    known |= not known.any()
    mean = lambda scores: {split: x[known].mean(axis=0, keepdims=True) for split, x in scores.items()}
    metrics = {name: mean(scores) for name, scores in evaluations.metrics.items()}
    return evaluations._replace(returns=mean(evaluations.returns), metrics=metrics, seeds=evaluations.seeds[:1])


def require_same_run(path: Path, found: Evaluations, expected: Evaluations) -> None:
    """Check that evaluations of a file are of the seeds, tasks and episodes of a run.

    Raises:
        InputError: they are not. The message says what differs.
    """
    (seeds, episodes), (own_seeds, own_episodes) = (each.returns["train"].shape[::3] for each in (found, expected))
    same = lambda x, y: x.shape == y.shape and np.allclose(x, y, rtol=1e-5)
    differences = {
        f"{seeds} seeds, not {own_seeds}": seeds != own_seeds,
        "other seeds": len(found.seeds) > 0 and not np.array_equal(found.seeds, expected.seeds),
        f"{episodes} episodes of a task, not {own_episodes}": episodes != own_episodes,
        f"trials of {found.trial} episodes, not of {expected.trial}": found.trial != expected.trial,
        **{f"other {split} tasks": not same(found.values[split], expected.values[split]) for split in SPLITS},
    }
    difference = next((text for text, differs in differences.items() if differs), "")
    if difference:
        raise InputError(f"{str(path)!r} is of another run than config.json beside it: it has {difference}")


def save_evaluations(path: Path, evaluations: Evaluations) -> None:
    """Write every episode: for each split returns and metrics (S, V, T, episodes) and values (T,).

    Beside them are ``steps`` (V,), ``seeds`` (S,) and ``trial`` (), the episodes of a trial.
    """
    values = {f"{split}_values": x for split, x in evaluations.values.items()}
    metrics = {f"{split}_{name}": x for name, splits in evaluations.metrics.items() for split, x in splits.items()}
    with replacing(path) as new, new.open("wb") as file:
        about = {"steps": evaluations.steps, "seeds": evaluations.seeds, "trial": np.int64(evaluations.trial)}
        np.savez(file, **about, **evaluations.returns, **values, **metrics)  # type: ignore


def load_evaluations(path: str | Path) -> Evaluations:
    """Read a file that ``save_evaluations`` wrote. The checksums inside the file tell whether it is damaged.

    Raises:
        InputError: the file cannot be read, or its arrays do not fit together.
    """
    path = Path(path)
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            named = {name.removeprefix("train_") for name in file if name.startswith("train_")} - {"values"}
            found = Evaluations(
                file["steps"],
                {split: file[split] for split in SPLITS},
                {split: file[f"{split}_values"] for split in SPLITS},
                {name: {split: file[f"{split}_{name}"] for split in SPLITS} for name in sorted(named)},
                file["seeds"] if "seeds" in file else (),
                int(file["trial"]) if "trial" in file else 1,
            )
    except FileNotFoundError:
        raise InputError(f"there is no file {str(path)!r}") from None
    except Exception as error:  # a damaged archive may raise anything
        raise InputError(
            f"cannot read evaluations from {str(path)!r}, which is damaged: {type(error).__name__}"
        ) from None
    _require_fit(path, found)
    return found


def _require_fit(path: Path, found: Evaluations) -> None:
    """Check that returns (S, V, T, episodes) of all splits have the steps (V,), values (T,), S and episodes."""
    arrays = [
        found.steps,
        *found.values.values(),
        *(x for splits in (found.returns, *found.metrics.values()) for x in splits.values()),
    ]
    numbers = all(np.issubdtype(x.dtype, np.number) for x in arrays)
    wanted = lambda split: (len(found.steps), *found.values[split].shape)
    fits = (
        numbers
        and found.trial > 0
        and found.returns["train"].shape[-1] % found.trial == 0
        and found.steps.ndim == 1
        and all(
            x.ndim == 4 and x.shape[1:3] == wanted(split) and x.shape[::3] == found.returns["train"].shape[::3]
            for splits in (found.returns, *found.metrics.values())
            for split, x in splits.items()
        )
    )
    if not fits:
        raise InputError(f"cannot read evaluations from {str(path)!r}: its arrays are not those of a run")


@partial(jax.jit, static_argnums=(0, 1, 2))
def evaluate(
    env: Env,
    agent: Agent,
    episodes: Episodes,
    state: Any,
    tasks: Task,
    seeds: Array,
    number: Array,
    places: Array | None = None,
) -> Scores:
    """Play whole trials under the mean action, or under drawn ones.

    An episode whose world is lost (``step_envs``) keeps what it had before.

    Args:
        state: agent states with leading S.
        tasks: (T, ...), training tasks or not.
        seeds: (S,) the runs' seeds.
        number: () number of the evaluation in the run; each has fresh keys, independent of training.
        places: (T,) of ``tasks`` among all tasks of ``env``, whose episodes they then play; None: they are all tasks.
    """
    keys, begun = begin(env, agent, episodes, state, tasks, seeds, number, places)
    step = partial(_step, env, agent, episodes, state, tasks, keys)
    return by_episode(_play(step, begun, _length(env, episodes), env.ends_early).scores)


class Playing(NamedTuple):
    """Holds trials that are being played."""

    worlds: Worlds
    scores: Scores  # (S, T, trials, episodes of a trial)
    alive: Array  # (S, T, trials) bool, whether they go on


@partial(jax.jit, static_argnums=(0, 1, 2))
def begin(
    env: Env,
    agent: Agent,
    episodes: Episodes,
    state: Any,
    tasks: Task,
    seeds: Array,
    number: Array,
    places: Array | None = None,
) -> tuple[Key, Playing]:
    """Begin the trials of ``evaluate``; return their keys (S, T, trials) and what ``play_on`` goes on with."""
    trials = of_episodes(episodes.trial)
    shape = (len(seeds), len(tasks.id), episodes.count // episodes.trial)  # of trials
    fresh = lambda seed: jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0x7E57), number)
    drawn = shape[1:] if places is None else (len(env.tasks("all").id), shape[2])
    keys = jax.vmap(lambda seed: jax.random.split(fresh(seed), drawn))(seeds)
    keys = keys if places is None else keys[:, places]
    worlds = reset_envs(env, agent, state, tasks, keys, trials, lambda _: draw_in_turn(tasks, keys))
    take = lambda worlds: step_envs(env, agent, state, tasks, worlds, None, trials=trials)[1]
    env_step = jax.eval_shape(take, worlds)
    metrics = {name: jnp.zeros((*shape, trials.episodes), x.dtype) for name, x in env_step.metrics.items()}
    metrics |= {_EVER: metrics["success"]} if "success" in metrics else {}
    nothing = Scores(jnp.zeros((*shape, trials.episodes)), metrics)
    return keys, Playing(worlds, nothing, jnp.ones(shape, bool))


@partial(jax.jit, static_argnums=(0, 1, 2))
def play_on(
    env: Env, agent: Agent, episodes: Episodes, state: Any, tasks: Task, keys: Key, playing: Playing, first: Array
) -> Playing:
    """Play a part of the steps of ``evaluate``, from the time ``first`` (), which is one of ``parts``."""
    step = partial(_step, env, agent, episodes, state, tasks, keys)
    return jax.lax.scan(step, playing, first + jnp.arange(parts(env, episodes).step))[0]


def parts(env: Env, episodes: Episodes) -> range:
    """Return the times at which the parts of an evaluation begin; its end is where the last trial ends."""
    length = _length(env, episodes)
    return range(0, length, -(-length // _PARTS))


def by_episode(scores: Scores) -> Scores:
    """Return the scores of trials, leaves (S, T, trials, episodes of a trial), by episode (S, T, episodes)."""
    return jax.tree.map(lambda x: x.reshape(*x.shape[:2], x.shape[2] * x.shape[3]), scores)


def _length(env: Env, episodes: Episodes) -> int:
    """Return the most steps of a trial."""
    return env.episode_length * episodes.trial


def _step(
    env: Env,
    agent: Agent,
    episodes: Episodes,
    state: Any,
    tasks: Task,
    keys: Key,
    playing: Playing,
    time: Array,
) -> tuple[Playing, None]:
    """Play the step of all trials at a time (), for a scan. It changes no scores of trials that have ended."""
    (before, scores, alive), trials = playing, of_episodes(episodes.trial)
    drawn = _drawing(keys, time) if episodes.sampled else None
    worlds, env_step = step_envs(env, agent, state, tasks, before, drawn, trials=trials)
    worlds = _go_on(env, agent, state, tasks, worlds, env_step, alive, partial(_at, keys, time), trials)
    now = alive[..., None] & _is_now(before, trials.episodes)
    # Rewards after an episode's end may not be finite.
    returns = scores.returns + jnp.where(now, env_step.transition.reward[..., None], 0.0)
    metrics = _latest(env_step.metrics, scores.metrics, now & ~env_step.lost[..., None])
    return Playing(worlds, Scores(returns, metrics), alive & ~env_step.transition.closed), None


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def adapted(
    env: Env, agent: Adapting, num_envs: int, updates: int, state: Any, tasks: Task, seeds: Array, number: Array
) -> tuple[Any, Task]:
    """Let agents adapt to tasks, by as long rollouts in fresh worlds as between their adaptations in training.

    Args:
        num_envs: environments of each task in a rollout.
        updates: how often they adapt, each time to a new rollout.
        state, tasks, seeds, number: as for ``evaluate``. Trials must not draw tasks.

    Returns:
        agent states for these tasks alone, and the tasks as these states know them, both to be evaluated.
    """
    state = jax.vmap(lambda learner: learner.of_tasks(tasks))(state)
    tasks = tasks._replace(id=jnp.arange(len(tasks.id), dtype=jnp.int32))
    shape = (len(seeds), len(tasks.id), num_envs)
    length = agent.experience.steps // (agent.experience.adaptations + 1)

    def step(given: tuple[Any, Worlds], keys: Key) -> tuple[tuple[Any, Worlds], Transition]:
        learners, worlds = given
        act_keys, reset_keys = split_keys(keys, 2)
        worlds, env_step = step_envs(env, agent, learners, tasks, worlds, world_keys(act_keys, shape))
        fresh = partial(world_keys, reset_keys, shape)
        worlds, _ = reset_ended(env, agent, learners, tasks, worlds, env_step.ends, fresh)
        return (learners, worlds), env_step.transition

    def update(learners: Any, keys: Key) -> tuple[Any, None]:
        reset_keys, *step_keys = split_keys(keys, length + 1)
        worlds = reset_envs(env, agent, learners, tasks, world_keys(reset_keys, shape))
        steps = jax.lax.scan(step, (learners, worlds), jnp.stack(step_keys))[1]
        adapt = lambda learner, steps: at_point(agent, learner).adapt(learner, steps, tasks)
        steps = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 2), steps)
        return over_seeds(adapt, 0, 0)(learners, steps), None

    fresh = lambda seed: jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0xADA9), number)
    keys = jax.vmap(lambda seed: jax.random.split(fresh(seed), updates), out_axes=1)(seeds)
    return jax.lax.scan(update, state, keys)[0], tasks


def _play(step: Callable[..., Any], begun: Any, length: int, ends_early: bool) -> Any:
    """Play ``length`` steps, or fewer if no trial is alive any more, which is asked after every ``_ASKED`` steps.

    Args:
        step: the function of a scan over times, whose carry ends with which trials are alive. It changes no scores of
            others, so that steps after the last one do no harm.
    """
    if not ends_early or length <= _ASKED:
        return jax.lax.scan(step, begun, jnp.arange(length))[0]
    goes_on = lambda carry: (carry[1] < length) & jnp.any(carry[0][-1])
    play = lambda carry: (jax.lax.scan(step, carry[0], carry[1] + jnp.arange(_ASKED))[0], carry[1] + _ASKED)
    return jax.lax.while_loop(goes_on, play, (begun, jnp.int32(0)))[0]


def _is_now(worlds: Worlds, episodes: int) -> Array:
    """Return which of a trial's episodes (S, T, E, episodes), or (episodes,), worlds are in."""
    return jnp.ones(1, bool) if worlds.episode is None else worlds.episode[..., None] == jnp.arange(episodes)


def _latest(new: dict[str, Array], old: dict[str, Array], now: Array) -> dict[str, Array]:
    """Return the metrics (S, T, E, episodes) of trials after a step with metrics (S, T, E), which count ``now``."""
    new = {name: x[..., None] for name, x in new.items()}
    if _EVER in old:
        new |= {_EVER: jnp.maximum(new["success"], old[_EVER])}
    return {name: jnp.where(now, x, old[name]) for name, x in new.items()}


def draw_in_turn(tasks: Task, keys: Key) -> Task:
    """Draw the tasks of trials (S, T, E, ...) with keys (S, T, E), none of a task twice before all were drawn."""
    count, trials = tasks.draws.id.shape[1], jnp.arange(keys.shape[2])
    shuffle = lambda key: jax.random.permutation(jax.random.fold_in(key, 0x60A1), count)[trials % count]
    order = jax.vmap(jax.vmap(shuffle))(keys[:, :, 0])
    return jax.vmap(jax.vmap(jax.vmap(draw_at, (None, 0))), (None, 0))(tasks, order)


def _at(keys: Key, time: Array) -> Key:
    """Return the keys (S, T, E) of the episodes that begin at a time ()."""
    return jax.vmap(jax.vmap(jax.vmap(jax.random.fold_in, (0, None)), (0, None)), (0, None))(keys, time)


def _drawing(keys: Key, time: Array) -> Key:
    """Return the keys (S, T, E) that draw the actions of a step at a time (): none of them begins an episode."""
    return _at(keys, -1 - time)


def _go_on(
    env: Env,
    agent: Agent,
    learners: Any,
    tasks: Task,
    worlds: Worlds,
    env_step: EnvStep,
    alive: Array,
    keys: Callable[[], Key],
    trials: Trials,
) -> Worlds:
    """Begin the next episodes of trials (S, T, E) that are alive, in worlds that were stepped."""
    if trials.episodes == 1:
        return worlds
    ends = jax.tree.map(lambda x: x & alive, env_step.ends)
    return reset_ended(env, agent, learners, tasks, worlds, ends, keys, trials)[0]


class Recording(NamedTuple):
    """Holds one trial of K episodes of every task."""

    returns: Array  # (T, K)
    rows: Array  # (T,) of the tasks that were played; where ranges are continuous, of the trials' draws
    lengths: Array  # (T, K) int32 steps of each episode, which follow each other along H
    kept: Any  # of each step, leaves (T, H, ...)
    option: Array | None = None  # (T, H) int32 number of the option that acted in each step, if the agent has options


def span_of(lengths: Any, episode: int) -> tuple[int, int]:
    """Return the first step of one of a trial's episodes, and how many it has, given the lengths (K,) of all."""
    return int(np.sum(lengths[:episode])), int(lengths[episode])


def keep_states(worlds: Worlds, transition: Transition) -> Any:
    """Keep the states of the environment after each step."""
    return worlds.state


@partial(jax.jit, static_argnames=("env", "agent", "trial", "keep", "sampled"))
def record(
    env: Env,
    agent: Agent,
    state: Any,
    tasks: Task,
    seed: Array,
    trial: int = 1,
    keep: Callable[[Worlds, Transition], Any] = keep_states,
    sampled: bool = False,
) -> Recording:
    """Play one trial of each task under the mean action, or under drawn ones.

    Args:
        state: of the agent, without a leading axis.
        trial: episodes of a trial.
        keep: what to hold of every step, given the worlds after it, before any reset.
        sampled: draw actions from the policy.
    """
    trials, learners = of_episodes(trial), jax.tree.map(lambda x: x[None], state)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 0xF11), (1, len(tasks.id), 1))

    def step(carry: tuple[Worlds, Array], time: Array):
        before, alive = carry
        drawn = _drawing(keys, time) if sampled else None
        worlds, env_step = step_envs(env, agent, learners, tasks, before, drawn, trials=trials)
        now, transition = alive[..., None] & _is_now(before, trial), env_step.transition
        begun = _go_on(env, agent, learners, tasks, worlds, env_step, alive, partial(_at, keys, time), trials)
        rewards = jnp.where(now, transition.reward[..., None], 0.0)
        option = worlds.memory.running.option if agent.goes_on else None
        return (begun, alive & ~transition.closed), (rewards, now, keep(worlds, transition), option)

    worlds = reset_envs(env, agent, learners, tasks, keys, trials)
    rows = tasks.row if worlds.task is None else worlds.task.row[0, :, 0]
    times = jnp.arange(env.episode_length * trial)
    _, played = jax.lax.scan(step, (worlds, jnp.ones(keys.shape, bool)), times)  # leaves (H, 1, T, 1, ...)
    rewards, now, kept, option = jax.tree.map(lambda x: jnp.moveaxis(x[:, 0, :, 0], 0, 1), played)
    return Recording(jnp.sum(rewards, axis=1), rows, jnp.sum(now, axis=1), kept, option)
