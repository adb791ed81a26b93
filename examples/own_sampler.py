"""A sampler of tasks of your own: tasks below a mark count more than those beyond it.

python -m mtjax.train --import=examples/own_sampler.py --agent.sampler=below-mark --agent.mark=800
"""

import dataclasses

import jax.numpy as jnp

import mtjax
from mtjax.agents.parts.samplers import Sampler


@dataclasses.dataclass(frozen=True)
class BelowMark(Sampler):
    """Weigh tasks by how far their return, a moving mean, is below a mark; those beyond it keep a tenth."""

    mark: float = 500.0
    """Return at which a task is learned."""
    mark_rate: float = 0.1
    """Share of a new episode in the moving mean."""

    def init(self, num_tasks):
        return jnp.zeros(num_tasks)

    def begin(self):
        """Return the memory with which an episode begins: its return so far."""
        return jnp.float32(0)

    def remember(self, episode, reward, gamma):
        return episode + reward

    def observe(self, memory, steps):
        """Follow the returns of trials that ended: where ``steps.closed`` (T, N), ``steps.memory`` is their return."""
        count = jnp.sum(steps.closed, axis=1)
        mean = jnp.sum(jnp.where(steps.closed, steps.memory, 0.0), axis=1) / jnp.maximum(count, 1)
        return jnp.where(count > 0, memory + self.mark_rate * (mean - memory), memory)

    def weights(self, memory, temperature):
        """What each task's losses count (T,), 1 on average."""
        missing = jnp.clip((self.mark - memory) / self.mark, 0.1, 1.0)
        return missing / jnp.mean(missing)


mtjax.register("below-mark", BelowMark)
