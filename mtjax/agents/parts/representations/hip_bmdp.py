"""HiP-BMDP: a DeepMDP in which tasks have vectors of hidden parameters, as far apart as what happens in them."""

import dataclasses
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.representations.deepmdp import DeepMDP, ModelTargets
from mtjax.networks import Params
from mtjax.types import Array, Key, Metrics

STAND_INS = {
    "nearest": "",
    "zero": "zeros for theta",
    "mean": "the mean of the training tasks' thetas",
    "inferred": "a theta inferred from its last steps",
}


@dataclasses.dataclass(frozen=True)
class HiPBMDP(DeepMDP):
    """Hidden-parameter block MDP (Zhang, Sodhani, Khetarpal and Pineau 2021).

    A DeepMDP in which every task has a learned vector theta_i, which actor, critics and both models see. So that
    thetas are as far apart as what happens in their tasks, for each transition (s, a) of task i, and another task j
    that is drawn for every update, its loss is joined by ``theta_coefficient`` times
        L_theta = (|theta_i - sg(theta_j)| - sg(W2(T(h, a, theta_i), T(h, a, theta_j))))^2,  h = phi(s)   (theta loss)
    where W2 is the 2-Wasserstein distance between two predictions,
        W2^2 = |mu_i - mu_j|^2 + |sigma_i - sigma_j|^2.
    L_theta moves theta_i alone; theta_j has its turn as the theta of task j. Critics' and models' losses train thetas
    too, the actor's does not.

    ``unseen_theta`` says what stands for the theta of a task that was not trained on. (MTRL has a mean over all tasks
    and one over training tasks; here only training tasks have a theta, and the two are one.) "inferred" is a
    trajectory encoder g of the last steps (``parts/trajectory.py``), fitted to training tasks by
        L_g = mean |g(last steps) - sg(theta_i)|^2                                                     (guess loss)

    Whatever else ``conditioning`` tells stands beside theta, and conditioning=embedding is theta itself.

    Differs from the paper: both predictions start from the same state and action, as in MTRL. Differs from MTRL, which
    takes one norm over a batch: distances are a sample's; and theta is a table, without a network on top, which could
    say nothing more of T tasks.
    """

    theta_coefficient: float = 0.01
    """Weight of the theta loss."""
    unseen_theta: Literal["nearest", "zero", "mean", "inferred"] = "nearest"
    """The theta of an unseen task: that of the nearest training task, zero, the mean of all training tasks', or
    inferred from the last steps."""

    names: ClassVar[tuple[str, ...]] = (*DeepMDP.names, "guess")
    models: ClassVar[tuple[str, ...]] = (*DeepMDP.models, "guess")

    def __post_init__(self):
        super().__post_init__()
        parts.require_not_negative(self, "theta_coefficient")

    @property
    def has_theta(self) -> bool:
        return True

    @property
    def looks_back(self) -> bool:
        return self.unseen_theta == "inferred"

    @property
    def modules(self) -> dict[str, nn.Module]:
        return super().modules | ({"guess": self.trajectory} if self.looks_back else {})

    # Tasks that were not trained on.

    def stand_in(self, params: Params, trained: Params, known: Array, obs: Any) -> Params:
        thetas = trained.own["embedding"]
        match self.unseen_theta:
            case "zero":
                theta = jnp.zeros_like(thetas[0])
            case "mean":
                theta = jnp.mean(thetas, axis=0)
            case "inferred":
                theta = self.apply(params, "guess", obs)
            case _:
                return params
        return with_theta(params, jnp.where(known, params.own["embedding"], theta))

    def borrowed(self, found: list[str]) -> list[str]:
        return [part for part in found if part != "embedding"] + ["theta"] * (self.unseen_theta == "nearest")

    @property
    def replaced(self) -> str:
        return STAND_INS[self.unseen_theta]

    # Losses.

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[ModelTargets, Key]:
        key, turn_key = jax.random.split(key)
        model_targets, keys = super().targets(params, target_params, next_obs, key)
        thetas = params.own["embedding"]
        turn = jax.random.randint(turn_key, (), 1, max(len(thetas), 2))  # a task that is alone is its own rival
        return model_targets._replace(other_theta=jnp.roll(thetas, turn, axis=0)), keys

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        loss, metrics = super().join(loss, metrics, params, batch)
        theta_loss = jnp.mean(
            self.theta_loss(params, batch.features, batch.obs, batch.action, batch.model_targets.other_theta)
        )
        metrics |= {"theta_loss": theta_loss}
        loss += self.theta_coefficient * theta_loss
        if self.unseen_theta != "inferred":
            return loss, metrics
        error = self.apply(params, "guess", batch.obs) - jax.lax.stop_gradient(params.own["embedding"])
        guess_loss = jnp.mean(jnp.sum(jnp.square(error), axis=-1))
        return loss + guess_loss, metrics | {"guess_loss": guess_loss}

    def theta_loss(self, params: Params, features: Array, obs: Any, action: Array, other_theta: Array) -> Array:
        """The theta loss (B,) of one task against another task's vector (Z,)."""
        still, other = jax.lax.stop_gradient((params, with_theta(params, other_theta)))
        predictions = [self.predict(p, *self.perceive(p, features, obs), action) for p in (still, other)]
        ours, theirs = map(jnp.stack, predictions)  # (2, B, D), means and deviations
        moved = jnp.sqrt(jnp.sum(jnp.square(ours - theirs), axis=(0, -1)))
        return jnp.square(distance(self.theta(params), self.theta(other)) - moved)


def with_theta(params: Params, theta: Array) -> Params:
    """One task's parameters with another vector."""
    return params._replace(own={**params.own, "embedding": theta})


def distance(x: Array, y: Array) -> Array:
    """|x - y| of vectors (..., Z), with a slope of 0 where they are the same."""
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(x - y), axis=-1), 1e-12))
