"""Hindsight replays steps of one task as steps of another.

Where tasks share their physics and differ in goals alone, the same steps are possible in every task, with other rewards
(Andrychowicz et al. 2017, "Hindsight experience replay"; across tasks Li et al. 2020, "Generalized hindsight"). A
family lists the parameters for which that holds in ``relabels``; its ``relabel(task, transition, key)`` recomputes
exactly the reward, and what observations show of the goal.

Differs from Andrychowicz et al.: goals are those of the training tasks, or fresh draws where every episode draws its
own goal; never states that an episode reached. Differs from Li et al.: the other task is drawn uniformly, and is not
the one in which the steps would have earned the most.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.experience import ring as rings
from mtjax.experience.ring import Ring
from mtjax.tasks import episode_task
from mtjax.types import Array, Env, InputError, Key, Task, Transition


def require(env: Env) -> None:
    """Check that steps of a family can be replayed as another task's.

    Raises:
        InputError: they cannot; it says why.
    """
    family: Any = env
    if env.spec.mixed:
        raise InputError("hindsight replays steps of one task as another's, and a mixture's tasks share no physics")
    if getattr(family, "pixels", 0) or getattr(family, "repeat", 1) > 1:
        raise InputError("hindsight computes rewards from one step's state: leave out --env.pixels and --env.repeat")
    goals = [name for name in getattr(family, "relabels", ()) if name in family.parameters]
    varied = getattr(family, "varied", ())
    physical = [name for name in varied if name not in goals]
    if not goals:
        reason = "its rewards do not follow from a goal and from what is observed"
    elif physical:
        reason = f"{', '.join(physical)} changes what happens; vary nothing but {', '.join(goals)}"
    elif not varied and not family.fresh_goals:
        reason = f"its tasks have the same goal; vary {', '.join(goals)}"
    else:
        return
    raise InputError(f"hindsight cannot replay steps as another task's in this family: {reason}; or use --hindsight=0")


def sample(
    env: Env, tasks: Task, share: float, ring: Ring, key: Key, shape: tuple[int, int, int], window: int = 0
) -> Transition:
    """Draw U batches of B transitions for each task, ``shape`` (T, U, B), and relabel the first round(share B).

    The relabelled transitions come uniformly from the rings of all other tasks. If episodes draw their goals, they also
    come from the task's own ring, as the new goal differs there too. With a ``window``, so many consecutive steps are
    drawn for each transition, and relabelled with the same goal.
    """
    source_key, row_key, task_key, goal_key = jax.random.split(key, 4)
    num_tasks, count = shape[0], max(round(share * shape[2]), 1)
    again = (*shape[:2], count)
    shift = jax.random.randint(source_key, again, 0 if fresh_goals(env, tasks) else 1, num_tasks)
    own = jnp.broadcast_to(jnp.arange(num_tasks)[:, None, None], shape)
    rows = rings.sample_from(ring, row_key, own.at[:, :, :count].add(shift) % num_tasks, window)
    keys = (jax.random.split(task_key, again), jax.random.split(goal_key, again))
    of_task = jax.vmap(jax.vmap(partial(relabel, env), (None, 0, 0, 0)), (None, 0, 0, 0))
    new = jax.vmap(of_task)(tasks, jax.tree.map(lambda x: x[:, :, :count], rows), *keys)
    return jax.tree.map(lambda new, rows: jnp.concatenate([new, rows[:, :, count:]], axis=2), new, rows)


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
