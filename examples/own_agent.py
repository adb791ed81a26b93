"""An agent of your own: SAC whose actor also imitates the best of a few sampled actions.

python -m mtjax.train --import=examples/own_agent.py --agent=best-of --agent.candidates=8
"""

import dataclasses

import jax
import jax.numpy as jnp

import mtjax
from mtjax.agents import SAC
from mtjax.agents.parts import require_counts, require_not_negative


@dataclasses.dataclass(frozen=True)
class BestOf(SAC):
    """SAC with L_pi + weight |mean action - a*|^2, a* the best of K sampled actions by the least critic.

    An agent's losses are of one task: it learns from a batch of every task at once, and has every conditioning,
    encoder, head, scaling, sampler and gradient rule without more code.
    """

    candidates: int = 4
    """Actions that are drawn at every observation (K)."""
    imitation: float = 0.1
    """Weight of the distance to the best of them."""

    def __post_init__(self):
        super().__post_init__()
        require_counts(self, "candidates")
        require_not_negative(self, "imitation")

    def actor_loss(self, nets, batch, key):
        loss, aux = super().actor_loss(nets, batch, key)
        outputs = self.policy_outputs(nets, batch.features, batch.obs)
        draw = lambda key: jax.lax.stop_gradient(self.policy.draw(outputs, batch.mask, key).action)
        drawn = jax.vmap(draw)(jax.random.split(key, self.candidates))  # (K, B, A)
        worth = jax.vmap(lambda a: jnp.min(self.values(nets, batch.features, batch.obs, a), axis=0))(drawn)  # (K, B)
        best = jnp.take_along_axis(drawn, jnp.argmax(worth, axis=0)[None, :, None], axis=0)[0]
        distance = jnp.mean(jnp.square(self.policy.draw(outputs, batch.mask, None).action - best))
        return loss + self.imitation * distance, aux._replace(metrics=aux.metrics | {"imitation": distance})


mtjax.register("best-of", BestOf, conditioning="parameters")
