"""Hindsight replays steps of one task as steps of another.

Where tasks share their physics and differ in goals alone, the same steps are possible in every task, with other rewards
(Andrychowicz et al. 2017, "Hindsight experience replay"; across tasks Li et al. 2020, "Generalized hindsight"). A
family lists the parameters for which that holds in ``relabels``; its ``relabel(task, transition, key)`` recomputes
exactly the reward, and what observations show of the goal.

Which task a step is replayed for is either drawn uniformly, or found by inverse reinforcement learning (Eysenbach et
al. 2020, "HIPI"): the task for which an agent that acts well, but not always best, would have taken it (``posterior``).

Differs from Andrychowicz et al.: goals are those of the training tasks, or fresh draws where every episode draws its
own goal; never states that an episode reached. Differs from Li et al.: the task is not the one in which a whole
trajectory would have earned the most. Differs from Eysenbach et al.: every task has as many relabelled steps in a
batch, drawn from those of all tasks by their probabilities for it; Q-values are divided by the task's temperature.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.experience import ring as rings
from mtjax.experience.ring import Ring
from mtjax.tasks import episode_task
from mtjax.types import Array, Env, InputError, Key, Relabelling, Task, Transition


def require(env: Env) -> None:
    """Check that steps of a family can be replayed as another task's.

    Raises:
        InputError: they cannot; it says why.
    """
    if len(getattr(env, "parts", ())) > 1:
        raise InputError("hindsight replays steps of one task as another's, and a mixture's tasks share no physics")
    if isinstance(env, Relabelling) and (env.pixels or env.repeat > 1):
        raise InputError("hindsight computes rewards from one step's state: leave out --env.pixels and --env.repeat")
    if reason := _why_not(env):
        raise InputError(
            f"hindsight cannot replay steps as another task's in this family: {reason}; or use --hindsight=0"
        )


def _why_not(family: Any) -> str:
    """Return why steps of one task of a family cannot be another's; empty if they can."""
    goals = [name for name in family.relabels if name in family.parameters] if isinstance(family, Relabelling) else []
    if not goals:
        return "its rewards do not follow from a goal and from what is observed"
    if physical := [name for name in family.varied if name not in goals]:
        return f"{', '.join(physical)} changes what happens; vary nothing but {', '.join(goals)}"
    same = not family.varied and not family.fresh_goals
    return f"its tasks have the same goal; vary {', '.join(goals)}" if same else ""


Judge = Callable[[Transition], Array]
"""Returns the soft values (T, N) of steps (T, N, ...) that are labelled as of these tasks: Q over the temperature."""


def sample(
    env: Env,
    tasks: Task,
    share: float,
    ring: Ring,
    key: Key,
    shape: tuple[int, int, int],
    window: int = 0,
    judge: Judge | None = None,
) -> Transition:
    """Draw U batches of B transitions for each task, ``shape`` (T, U, B), and relabel the first round(share B).

    With a ``judge``, these come from the first ones of all tasks in the same batch, as ``relabel_inversely`` chooses.
    Else they are drawn uniformly.

    The relabelled transitions come uniformly from the rings of all other tasks. If episodes draw their goals, they also
    come from the task's own ring, as the new goal differs there too. With a ``window``, so many consecutive steps are
    drawn for each transition, and relabelled with the same goal.
    """
    source_key, row_key, task_key, goal_key = jax.random.split(key, 4)
    num_tasks, count = shape[0], max(round(share * shape[2]), 1)
    again, source = (*shape[:2], count), jnp.broadcast_to(jnp.arange(num_tasks)[:, None, None], shape)
    if judge is None:
        shift = jax.random.randint(source_key, again, 0 if fresh_goals(env, tasks) else 1, num_tasks)
        source = source.at[:, :, :count].add(shift) % num_tasks
    rows = rings.sample_from(ring, row_key, source, window)
    first = jax.tree.map(lambda x: x[:, :, :count], rows)
    if judge is None:
        keys = (jax.random.split(task_key, again), jax.random.split(goal_key, again))
        of_task = jax.vmap(jax.vmap(partial(relabel, env), (None, 0, 0, 0)), (None, 0, 0, 0))
        new = jax.vmap(of_task)(tasks, first, *keys)
    else:
        new = relabel_inversely(env, tasks, first, task_key, goal_key, source_key, judge)
    return jax.tree.map(lambda new, rows: jnp.concatenate([new, rows[:, :, count:]], axis=2), new, rows)


def relabel_inversely(
    env: Env, tasks: Task, rows: Transition, task_key: Key, goal_key: Key, draw_key: Key, judge: Judge
) -> Transition:
    """Draw as many steps, or windows, for each task as rows (T, U, C, ...) have, from those of all tasks in a batch.

    A step is drawn for a task with its probability of being of that task, and relabelled. Windows are judged by their
    first steps.
    """
    num_tasks, updates, count = rows.reward.shape[:3]
    pool = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0).reshape(updates, num_tasks * count, *x.shape[3:]), rows)
    shape = (num_tasks, updates, num_tasks * count)
    of_batch = jax.vmap(jax.vmap(partial(relabel, env), (None, 0, 0, 0)), (None, 0, 0, 0))
    keys = (jax.random.split(task_key, shape), jax.random.split(goal_key, shape))
    labelled = jax.vmap(of_batch, (0, None, 0, 0))(tasks, pool, *keys)  # (T, U, T C, ...)
    first = labelled if rows.reward.ndim == 3 else jax.tree.map(lambda x: x[:, :, :, 0], labelled)
    scores = judge(jax.tree.map(lambda x: x.reshape(num_tasks, -1, *x.shape[3:]), first)).reshape(shape)
    logs = posterior(jnp.moveaxis(scores, 1, 0))  # (U, T, T C)
    drawn = jax.random.categorical(draw_key, logs, shape=(count, updates, num_tasks))  # of (C, U, T)
    take = jax.vmap(jax.vmap(lambda rows, drawn: jax.tree.map(lambda x: x[drawn], rows)))
    return take(labelled, jnp.moveaxis(drawn, (0, 1, 2), (2, 1, 0)))


def posterior(scores: Array) -> Array:
    """Return the log-probabilities (..., T, N) that steps are of each task, given their soft values (..., T, N).

    With all tasks as likely, and partition functions Z of each task by the mean over the steps (Eysenbach et al. 2020,
    equation 9):
        q(i|s, a) ~ exp(Q_i(s, a) - log Z_i),    log Z_i = log mean_(s, a) exp Q_i(s, a)
    So a constant that one task earns in every step changes nothing.
    """
    centred = scores - jax.nn.logsumexp(scores, axis=-1, keepdims=True)
    return jax.nn.log_softmax(centred, axis=-2)


def relabel(env: Env, task: Task, transition: Transition, task_key: Key, goal_key: Key) -> Transition:
    """Relabel a step, or a window (n, ...), as of ``task``, or of a fresh draw where episodes draw their tasks."""
    world = episode_task(task, task_key)

    def one(step: Transition) -> Transition:
        new = with_past(lambda step: env.relabel(world, step, goal_key), step)  # type: ignore
        return new if step.context is None else new._replace(context=world.context)

    return jax.vmap(one)(transition) if jnp.ndim(transition.reward) else one(transition)


def with_past(one: Callable[[Transition], Transition], transition: Transition) -> Transition:
    """Relabel a transition by ``one``, which relabels single steps, and the last steps that are remembered with it."""
    past = getattr(transition.memory, "past", None)
    if past is None:
        return one(transition)
    following = jnp.concatenate([past.obs[1:], transition.obs[None]])

    def step(obs: Array, action: Array, reward: Array, next_obs: Array) -> Transition:
        return one(transition._replace(obs=obs, action=action, reward=reward, next_obs=next_obs, memory=None))

    then, known = jax.vmap(step)(past.obs, past.action, past.reward, following), past.known > 0
    obs, reward = jnp.where(known[:, None], then.obs, past.obs), jnp.where(known, then.reward, past.reward)
    return one(transition)._replace(memory=transition.memory._replace(past=past._replace(obs=obs, reward=reward)))


def fresh_goals(env: Any, tasks: Task) -> bool:
    """Return whether two episodes of one task have different goals."""
    return tasks.draws is not None or env.fresh_goals
