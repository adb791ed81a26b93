"""A rule of gradient surgery of your own: tasks that agree with the others count more.

python -m mtjax.train --import=examples/own_gradient_rule.py --agent.gradients=consensus --agent.sharpness=2
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

import mtjax
from mtjax.agents.parts.gradients.surgery import Rule


@dataclasses.dataclass(frozen=True)
class Consensus(Rule):
    """Weights softmax(sharpness * c_i), with c_i the mean cosine of task i's gradient and the other tasks'.

    A rule sees the inner products ``gram`` (T, T) of the tasks' gradients over shared parameters, and gives weights
    (T,) of their sum, 1 / T each in the plain mean. What it returns beside them it is given at the next update.
    """

    needs: ClassVar[str] = "gradients"
    sharpness: float = 1.0
    """How much agreement counts; 0 is the plain mean."""

    def weigh(self, memory, gram, losses, key):
        norms = jnp.sqrt(jnp.diagonal(gram)) + 1e-12
        cosines = gram / (norms[:, None] * norms)
        others = (jnp.sum(cosines, axis=1) - jnp.diagonal(cosines)) / max(len(gram) - 1, 1)
        return jax.nn.softmax(self.sharpness * others), memory


mtjax.register("consensus", Consensus)
