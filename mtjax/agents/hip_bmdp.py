"""HiP-BMDP: a DeepMDP in which tasks have vectors of hidden parameters, as far apart as what happens in them."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.deepmdp import DeepMDP
from mtjax.agents.sac import Batch, SACState
from mtjax.networks import Params
from mtjax.types import Array, Key, Metrics, Task

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
    trajectory encoder g of the last steps (``agents/trajectory.py``), fitted to training tasks by
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

    def __post_init__(self):
        super().__post_init__()
        parts.require_not_negative(self, "theta_coefficient")

    @property
    def has_theta(self) -> bool:
        return True

    @property
    def history(self) -> int:
        return self.inferred_from if self.unseen_theta == "inferred" else super().history

    @property
    def modules(self) -> dict[str, nn.Module]:
        guess = {"guess": self.trajectory} if self.unseen_theta == "inferred" else {}
        return super().modules | guess

    # Unseen tasks.

    @property
    def borrowed(self) -> list[str]:
        rest = [part for part in super().borrowed if part != "embedding"]
        return rest + ["theta"] * (self.unseen_theta == "nearest")

    @property
    def unseen(self) -> str:
        own = f"each has {STAND_INS[self.unseen_theta]}" if STAND_INS[self.unseen_theta] else ""
        return ", and ".join(filter(None, [super().unseen, own]))

    def parameters(self, state: SACState, task: Task) -> tuple[Params, Params]:
        actor, critic = super().parameters(state, task)
        thetas = state.critic.own["embedding"]
        stand_in = {"zero": jnp.zeros_like(thetas[0]), "mean": jnp.mean(thetas, axis=0)}.get(self.unseen_theta)
        if stand_in is None:
            return actor, critic
        return actor, with_theta(critic, jnp.where(task.id < len(thetas), critic.own["embedding"], stand_in))

    def behaviour(self, trained: Array, actor: Params, critic: Params, features: Array, obs: Any) -> Array:
        if self.unseen_theta == "inferred":
            theta = jnp.where(trained, critic.own["embedding"], self.apply(critic, "guess", obs))
            critic = with_theta(critic, theta)
        return super().behaviour(trained, actor, critic, features, obs)

    # Losses.

    def critic_problem(self, state: SACState, batch: Batch, key: Key) -> tuple[Callable, Any]:
        key, turn_key = jax.random.split(key)
        loss, (batch, targets) = super().critic_problem(state, batch, key)
        thetas = state.critic.own["embedding"]
        turn = jax.random.randint(turn_key, (), 1, max(len(thetas), 2))  # a task that is alone is its own rival
        return loss, (batch, targets._replace(rival=jnp.roll(thetas, turn, axis=0)))

    def critic_loss(self, critic: Params, data) -> tuple[Array, Metrics]:
        loss, metrics = super().critic_loss(critic, data)
        batch, targets = data
        theta_loss = jnp.mean(self.theta_loss(critic, batch.told, batch.obs, batch.action, targets.rival))
        metrics |= {"theta_loss": theta_loss}
        loss += self.theta_coefficient * theta_loss
        if self.unseen_theta != "inferred":
            return loss, metrics
        error = self.apply(critic, "guess", batch.obs) - jax.lax.stop_gradient(critic.own["embedding"])
        guess_loss = jnp.mean(jnp.sum(jnp.square(error), axis=-1))
        return loss + guess_loss, metrics | {"guess_loss": guess_loss}

    def theta_loss(self, critic: Params, features: Array, obs: Any, action: Array, rival: Array) -> Array:
        """The theta loss (B,) of one task against another task's vector (Z,)."""
        still, other = jax.lax.stop_gradient((critic, with_theta(critic, rival)))
        foretold = [self.foretell(p, *self.perceive(p, features, obs), action) for p in (still, other)]
        ours, theirs = map(jnp.stack, foretold)  # (2, B, D), means and deviations
        moved = jnp.sqrt(jnp.sum(jnp.square(ours - theirs), axis=(0, -1)))
        return jnp.square(distance(self.theta(critic), self.theta(other)) - moved)


def with_theta(critic: Params, theta: Array) -> Params:
    """One task's critics with another vector."""
    return critic._replace(own={**critic.own, "embedding": theta})


def distance(x: Array, y: Array) -> Array:
    """|x - y| of vectors (..., Z), with a slope of 0 where they are the same."""
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(x - y), axis=-1), 1e-12))
