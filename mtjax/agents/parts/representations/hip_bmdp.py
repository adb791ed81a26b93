"""HiP-BMDP learns a vector for each task, with distances that match how differently the tasks behave."""

import dataclasses
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params, join
from mtjax.agents.parts.knowing.embedding import unit
from mtjax.agents.parts.knowing.last_steps import TrajectoryEncoder
from mtjax.agents.parts.representations.base import Unseen
from mtjax.agents.parts.representations.deepmdp import DeepMDP, ModelTargets, Transitions
from mtjax.agents.parts.representations.encoded import Encoded, encode_tasks
from mtjax.types import Array, Key, Metrics

STAND_INS = {
    "nearest": Unseen(borrowed=("theta",)),
    "zero": Unseen(replaced="zeros for theta"),
    "mean": Unseen(replaced="the mean of the training tasks' thetas"),
    "inferred": Unseen(replaced="a theta inferred from its last steps"),
}


@dataclasses.dataclass(frozen=True)
class HiPBMDP(Encoded):
    """HiP-BMDP is DeepMDP with a learned vector for each task (Zhang, Sodhani, Khetarpal and Pineau 2021).

    Actor, critics and both models take task i's vector theta_i as an input. For each transition (s, a) of task i, and a
    task j that is drawn for every update, ``theta_coefficient`` times this loss is added, which makes distances between
    thetas those between the tasks' predictions:
        L_theta = (|theta_i - sg(theta_j)| - sg(W2(T(h, a, theta_i), T(h, a, theta_j))))^2,  h = phi(s)   (theta loss)
    where W2 is the 2-Wasserstein distance between two predictions,
        W2^2 = |mu_i - mu_j|^2 + |sigma_i - sigma_j|^2.
    L_theta trains theta_i alone; theta_j is trained by task j's loss. Losses of critics and models train thetas too,
    the actor's does not.

    ``unseen_theta`` chooses the theta of a task that was not trained on: by default the mean of the training tasks'.
    "nearest" looks at the task's true parameters, which the method assumes to be hidden. (MTRL distinguishes a mean
    over all tasks from one over training tasks; here only training tasks have a theta.) "inferred" is a trajectory
    encoder g of the last steps (``TrajectoryEncoder``), fitted to training tasks by
        L_g = mean |g(last steps) - sg(theta_i)|^2                                                     (guess loss)

    Features of ``conditioning`` are joined to theta.

    Differs from the paper: both predictions start from the same state and action, as in MTRL. Differs from MTRL:
    distances are computed for each sample, where MTRL takes one norm over a batch; theta is a table, without a network
    on top, which could add nothing for T tasks.
    """

    model_widths: tuple[int, ...] = (512,)
    """Widths of the hidden layers in transition and reward model."""
    transition: Transitions = "deterministic"
    """Predict the next latent state as a point or as a Gaussian."""
    model_coefficient: float = 1.0
    """Weight of transition and reward loss relative to the critics' loss."""
    theta_size: int = 16
    """Size of the vector theta of each task."""
    unit_theta: bool = False
    """Scale thetas to length 1."""
    theta_from: int = 8
    """Number of last steps from which the theta of an unseen task is inferred, with unseen_theta=inferred."""
    theta_coefficient: float = 0.01
    """Weight of the theta loss."""
    unseen_theta: Literal["nearest", "zero", "mean", "inferred"] = "mean"
    """Theta of an unseen task: the mean of all training tasks', zero, that of the nearest training task (by its true
    parameters), or inferred from the last steps."""

    slow: ClassVar[tuple[str, ...]] = (*DeepMDP.slow, "embedding")
    predicts: ClassVar[bool] = True
    embeds: ClassVar[bool] = True
    models: ClassVar[tuple[str, ...]] = (*DeepMDP.models, "guess")

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "model_widths")
        parts.require_positive(self, "model_coefficient")
        parts.require_not_negative(self, "theta_coefficient")
        parts.require_counts(self, "theta_size", "theta_from")

    @property
    def history(self) -> int:  # type: ignore[override]
        return self.theta_from if self.unseen_theta == "inferred" else 0

    dynamics, model_inputs = DeepMDP.dynamics, DeepMDP.model_inputs
    require, least_loss = DeepMDP.require, DeepMDP.least_loss  # type: ignore

    @property
    def modules(self) -> dict[str, nn.Module]:
        guess = {"guess": TrajectoryEncoder(self.theta_size)} if self.history else {}
        return super().modules | self.dynamics.modules | guess

    def init_vectors(self, num_tasks: int, key: Key) -> Params:
        return Params({}, {"embedding": jax.random.normal(key, (num_tasks, self.theta_size))})

    def task_features(self, params: Params, features: Array) -> Array:
        return join(features, task=self.theta(params))

    def theta(self, params: Params) -> Array:
        """Return a task's learned vector (Z,)."""
        theta = params.own["embedding"]
        return unit(theta) if self.unit_theta else theta

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

    @property
    def unseen(self) -> Unseen:  # type: ignore[override]
        return STAND_INS[self.unseen_theta]

    # Losses.

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[ModelTargets, Key]:
        key, turn_key = jax.random.split(key)
        model_targets, keys = self.dynamics.targets(encode_tasks(self, target_params, next_obs), key)
        thetas = params.own["embedding"]
        turn = jax.random.randint(turn_key, (), 1, max(len(thetas), 2))  # a single task is compared with itself
        return model_targets._replace(other_theta=jnp.roll(thetas, turn, axis=0)), keys

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        known = self.perceive(params, batch.features, batch.obs)
        models_loss, losses = self.dynamics.losses(params, *known, batch)
        loss += self.model_coefficient * models_loss
        theta_loss = jnp.mean(
            self.theta_loss(params, batch.features, batch.obs, batch.action, batch.model_targets.other_theta)
        )
        loss += self.theta_coefficient * theta_loss
        metrics = metrics | losses | {"theta_loss": theta_loss}
        if self.unseen_theta != "inferred":
            return loss, metrics
        error = self.apply(params, "guess", batch.obs) - jax.lax.stop_gradient(params.own["embedding"])
        guess_loss = jnp.mean(jnp.sum(jnp.square(error), axis=-1))
        return loss + guess_loss, metrics | {"guess_loss": guess_loss}

    def theta_loss(self, params: Params, features: Array, obs: Any, action: Array, other_theta: Array) -> Array:
        """Compute the theta loss (B,) of one task and another task's vector (Z,)."""
        fixed, other = jax.lax.stop_gradient((params, with_theta(params, other_theta)))
        predictions = [self.dynamics.predict(p, *self.perceive(p, features, obs), action) for p in (fixed, other)]
        ours, theirs = map(jnp.stack, predictions)  # (2, B, D), means and deviations
        moved = jnp.sqrt(jnp.sum(jnp.square(ours - theirs), axis=(0, -1)))
        return jnp.square(distance(self.theta(params), self.theta(other)) - moved)


def with_theta(params: Params, theta: Array) -> Params:
    """Return one task's parameters with another vector theta."""
    return params._replace(own={**params.own, "embedding": theta})


def distance(x: Array, y: Array) -> Array:
    """Return |x - y| of vectors (..., Z), with a gradient of 0 where they are equal."""
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(x - y), axis=-1), 1e-12))
