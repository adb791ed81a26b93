"""An own way to find out a hidden task: averages of what each action earned in the trial, and how often it was taken.

python -m mtjax.train --import=examples/own_inference.py --env=hidden-bandit --trials=10 --agent=ppo \
    --agent.conditioning=averages --agent.unroll=10
"""

import dataclasses

import jax.numpy as jnp

import mtjax
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing.recurrent import Remembering


@dataclasses.dataclass(frozen=True)
class Averages(Remembering):
    """Show networks what each of the actions (A,) earned on average, and the share of steps in which it was taken.

    The memory (2, A) is how often actions were taken, and what they earned in all. For arms that pay 1 or 0 these are
    all that can be known, so that nothing is learned here.
    """

    prior_steps: float = 2.0
    """Steps that every action counts as taken before the trial, which earned ``prior_reward`` each."""
    prior_reward: float = 0.5
    """What a step earns as far as is known before the trial."""

    def init(self, num_tasks, seen, action, own, key):
        """Return no parameters."""
        return Params({}, {})

    def begin(self, obs_size, action_size):
        """Return the memory with which a trial begins."""
        return jnp.zeros((2, action_size))

    def read(self, params, step):
        """Return what steps add to the memory (..., 2, A); actions are one-hot if they are discrete."""
        return jnp.stack([step.action, step.action * step.reward[..., None]], axis=-2)

    def advance(self, params, memory, read):
        """Return the memory after steps."""
        return memory + read

    def show(self, params, memory):
        """Return what networks see (..., 2 A) of a memory."""
        taken, earned = memory[..., 0, :], memory[..., 1, :]
        mean = (earned + self.prior_steps * self.prior_reward) / (taken + self.prior_steps)
        return jnp.concatenate([mean, taken / (1 + jnp.sum(taken, axis=-1, keepdims=True))], axis=-1)


mtjax.register("averages", Averages)
