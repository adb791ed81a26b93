"""A scaling of rewards of your own: every task in units of its largest reward so far.

python -m mtjax.train --import=examples/own_scaling.py --agent.scaling=largest
"""

import dataclasses

import jax.numpy as jnp

import mtjax
from mtjax.agents.parts.scaling import Scaling


@dataclasses.dataclass(frozen=True)
class Largest(Scaling):
    """Divide rewards by the largest size of a reward that the task has paid; logged returns stay raw."""

    least_unit: float = 1e-3
    """The unit before any reward is known."""

    def init(self, num_tasks):
        return jnp.zeros(num_tasks)

    def observe(self, memory, steps):
        """Follow the rewards (T, N) of collected steps."""
        return jnp.maximum(memory, jnp.max(jnp.abs(steps.reward), axis=1))

    def units(self, memory, gamma, bonus):
        """Each task's factor and offset (T,): critics count in factor * (return - offset)."""
        return 1 / jnp.maximum(memory, self.least_unit), jnp.zeros_like(memory)


mtjax.register("largest", Largest)
