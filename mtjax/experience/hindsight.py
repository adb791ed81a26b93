"""Hindsight: steps of one task replayed as they would have been in another.

Where tasks share their physics and differ in a goal alone, what happened in one could have happened in any other, for
another reward (Andrychowicz et al. 2017, "Hindsight experience replay"; across tasks Li et al. 2020, "Generalized
hindsight"). A family says for which of its parameters that holds, ``relabels``, and recomputes the reward, and what
observations show of the goal, exactly: ``relabel(task, transition, key)``.

Differs from Andrychowicz et al.: goals are those of the training tasks, and where every episode draws its own goal
those of fresh draws; never what an episode happened to reach. Differs from Li et al.: the other task is any, with the
same chance, not the one in which the steps would have earned the most.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.experience import ring as rings
from mtjax.experience.ring import Ring
from mtjax.tasks import episode_task
from mtjax.types import Env, InputError, Key, Task, Transition


def require(env: Env) -> None:
    """Refuse a family whose steps cannot be replayed as another task's.

    Raises:
        InputError: with the reason.
    """
    family: Any = env
    if env.spec.mixed:
        raise InputError("hindsight replays steps of one task as another's, and a mixture's tasks share no physics")
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
    env: Env, agent: Any, tasks: Task, share: float, ring: Ring, key: Key, shape: tuple[int, int, int]
) -> Transition:
    """Draw U batches of B transitions a task, ``shape`` (T, U, B), of which the first round(share B) are relabelled.

    These come from the rings of all other tasks, with the same chance; also from the task's own if its episodes draw
    their goals, as then the goal is another all the same.
    """
    source_key, row_key, task_key, goal_key = jax.random.split(key, 4)
    num_tasks, count = shape[0], max(round(share * shape[2]), 1)
    again = (*shape[:2], count)
    shift = jax.random.randint(source_key, again, 0 if fresh_goals(env, tasks) else 1, num_tasks)
    own = jnp.broadcast_to(jnp.arange(num_tasks)[:, None, None], shape)
    rows = rings.sample_from(ring, row_key, own.at[:, :, :count].add(shift) % num_tasks)
    keys = (jax.random.split(task_key, again), jax.random.split(goal_key, again))
    of_task = jax.vmap(jax.vmap(partial(relabel, env, agent), (None, 0, 0, 0)), (None, 0, 0, 0))
    new = jax.vmap(of_task)(tasks, jax.tree.map(lambda x: x[:, :, :count], rows), *keys)
    return jax.tree.map(lambda new, rows: jnp.concatenate([new, rows[:, :, count:]], axis=2), new, rows)


def relabel(env: Env, agent: Any, task: Task, transition: Transition, task_key: Key, goal_key: Key) -> Transition:
    """One transition as a step of ``task``, or where episodes draw their tasks of one that it draws."""
    world = episode_task(task, task_key)
    new = agent.relabel(env, world, transition, goal_key)
    return new if transition.context is None else new._replace(context=world.context)


def fresh_goals(env: Any, tasks: Task) -> bool:
    """Whether two episodes of one task have different goals."""
    return tasks.draws is not None or env.fresh_goals
