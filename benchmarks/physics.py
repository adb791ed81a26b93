"""Programs of physics without learning, for benchmarks: with resets and without."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.learning.loop import PHASES
from mtjax.learning.rollout import reset_ended, reset_envs, split_keys, step_envs, world_keys
from mtjax.types import Acted


@dataclasses.dataclass(frozen=True)
class Random:
    """An agent that takes uniform actions, so that worlds step and begin anew as in training."""

    action_size: int

    def begin(self, state: Any, task: Any) -> Any:
        return ()

    def act(self, state: Any, memory: Any, obs: Any, task: Any, key: Any) -> Acted:
        return Acted(jax.random.uniform(key, (self.action_size,), minval=-1.0))


def physics(env: Any, worlds_per_task: int, steps: int, resets: bool) -> Any:
    """Return a function that takes some steps of all worlds under random actions, in one compiled scan.

    Args:
        resets: whether episodes end and begin anew as in training, where a tenth of the worlds does so at a time.
    """
    agent: Any = Random(env.spec.action_size)
    tasks, learners = env.tasks(), jnp.zeros(1)
    shape = (1, len(tasks.id), worlds_per_task)

    def begin(tasks: Any) -> Any:
        worlds = reset_envs(env, agent, learners, tasks, world_keys(jax.random.split(jax.random.key(0), 1), shape))
        phase = jnp.arange(worlds_per_task) * PHASES // worlds_per_task
        age = jnp.int32(tasks.horizon[:, None] * phase // PHASES)
        return worlds._replace(age=jnp.broadcast_to(age, shape)), jax.random.split(jax.random.key(1), 1)

    def step(carry: Any, _: Any) -> tuple[Any, Any]:
        worlds, keys = carry
        keys, act_keys, reset_keys = split_keys(keys, 3)
        worlds, env_step = step_envs(env, agent, learners, tasks, worlds, world_keys(act_keys, shape))
        if resets:
            fresh_keys = partial(world_keys, reset_keys, shape)
            worlds, _ = reset_ended(env, agent, learners, tasks, worlds, env_step.ends, fresh_keys)
        seen = jnp.sum(env_step.transition.reward) + jnp.sum(env_step.transition.next_obs)
        return (worlds, keys), seen

    held = [jax.tree.map(jnp.copy, jax.jit(begin)(tasks))]  # some of its arrays are one, which cannot be donated twice
    lowered = jax.jit(lambda carry: jax.lax.scan(step, carry, length=steps), donate_argnums=0).lower(held[0])
    env.calls.load_kernels()
    program = lowered.compile()

    def run() -> Any:
        held[0], seen = program(held[0])
        return seen

    return run
