"""PPO trains by proximal policy optimisation on many tasks at once."""

import dataclasses
from functools import partial
from typing import Annotated, ClassVar

import jax
import jax.numpy as jnp

from mtjax.agents import clipped_ratio, parts
from mtjax.agents.base import Inputs
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Params
from mtjax.agents.on_policy import Batch, OnPolicy
from mtjax.agents.parts.continual import Continual
from mtjax.agents.parts.plasticity import Plasticity
from mtjax.agents.state import AgentState
from mtjax.types import Array, Key, Task, Transition


@dataclasses.dataclass(frozen=True)
class PPO(OnPolicy):
    """PPO trains by multi-task proximal policy optimisation, with separate actor and critic (Schulman et al. 2017).

    The policy pi_old plays H steps of every environment. For each step of task i, with s' the next observation of its
    trial, d = 0 if nothing could follow it, and e = 1 if sums end with it, as by a time limit:
        delta_t = r_t + gamma_i d_t V(s'_t) - V(s_t)                                        (error of the critic)
        A_t = delta_t + gamma_i lambda (1 - e_t) A_(t+1),  A_H = 0                          (advantage)
        y_t = A_t + V(s_t)                                                                  (target)
    In each epoch the steps are shuffled and split into minibatches, with the same number of steps of every task. With
    ratio = pi(a|s) / pi_old(a|s):
        L_pi = -min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A) - c H(pi(s))          (actor loss)
        L_V = (V(s) - y)^2 / 2                                                              (critic loss)
    averaged over a task's minibatch, then over tasks. Advantages are scaled to mean 0 and standard deviation 1 in each
    task. The critic's output V' is in units of each task, V = m_i + s_i V', with moving estimates m_i and s_i of the
    mean and the standard deviation of the task's targets. These move before the critic learns, and targets are in the
    new units. With PopArt the heads are rescaled then, so that V does not change (van Hasselt et al. 2016, Hessel et
    al. 2019):
        kernel' = kernel s / s',  bias' = (s bias + m - m') / s'

    Of continuous actions the policy is a tanh-squashed Gaussian, whose entropy is estimated from one sample; of
    discrete ones a softmax over those that a task has, whose entropy is exact; of several at once a softmax for each.
    With a ``kl_limit``, the actor is not updated for the rest of an update once mean(ratio - 1 - log ratio), an
    estimate of KL(pi_old | pi), exceeds it on a minibatch. Then a schedule of the actor's learning rate waits too.

    From pictures, a rollout holds the stacks before and after each of its steps. For 64 pixels and 3 frames these are
    74 kB a step, so that ten tasks take 6 GB with H = 32 and E = 256. A run prints how much it is.

    A representation that learns (``representation``) is trained by L_V and its own losses on the same minibatches. Its
    target encoder is the encoder from before the update, as values are the critic's from before the update; so there is
    no ``encoder_tau`` here, and no ``shift`` of pictures.

    Observations are normalised by moments of the rollouts before this one, in acting and in learning, so that the ratio
    is 1 before the first step of an update. The rollout joins the moments after the update. A representation's steps
    change the policy too, and the ratio counts that.

    Differs from the paper: actor and critic share no parameters, so that the critic's loss needs no weight; advantages
    and values are normalised; time limits bootstrap; observations are normalised by moments of the rollouts. Differs
    from the authors' code (OpenAI Baselines), where Adam's epsilon is 1e-5, here 1e-8; where advantages are normalised
    in every minibatch, here once a rollout; where values are clipped, here only with ``value_clip``; and where networks
    begin orthogonal, the critic's head at full size. Here they begin by LeCun's initialisation, both heads at 0.01.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*OnPolicy.adjustable, "clip_range", "value_clip", "kl_limit")
    clip_range: float = 0.2
    """Clip the ratio of policies to this distance from 1 (epsilon)."""
    value_clip: float = 0.0
    """Clip the change of values in an update to this, in the critic's units (value-normalization); 0 does not clip."""
    kl_limit: float = 0.0
    """Stop updating the actor until the next rollout once KL(pi_old | pi) exceeds this; 0 never stops."""
    advantage_normalization: clipped_ratio.Normalization = "task"
    """Scale advantages to mean 0 and standard deviation 1: never, over all tasks together, or in each task."""
    continual: Annotated[Continual, FLAT] = dataclasses.field(default_factory=Continual)
    plasticity: Annotated[Plasticity, FLAT] = dataclasses.field(default_factory=Plasticity)

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "clip_range")
        parts.require_not_negative(self, "value_clip", "kl_limit")

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        state = super().init_networks(state, inputs, key)
        return state if parts.limit(self.kl_limit) is None else state.with_nets(limit=within(True))

    # Once for a rollout.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add advantages and targets to a rollout (T, H, E, ...), and fit the critic's units to it."""
        state, steps = clipped_ratio.assess(self, *super().assess(state, steps, tasks), tasks)
        return state.with_nets(limit=within(True)) if "limit" in state.nets else state, steps

    # Gradient steps.

    gain = clipped_ratio.gain

    def fitting_loss(self, output: Array, batch: Batch) -> Array:
        limit = parts.limit(self.value_clip)
        if limit is None:
            return super().fitting_loss(output, batch)
        assert batch.output is not None
        near = batch.output + jnp.clip(output - batch.output, -limit, limit)
        return jnp.mean(jnp.maximum(jnp.square(output - batch.target), jnp.square(near - batch.target))) / 2

    def accept(self, moved: AgentState, state: AgentState, kl: Array) -> AgentState:
        """Return the state that has moved, unless KL(pi_old | pi) has exceeded its limit in this rollout."""
        if "limit" not in state.nets:
            return moved
        near = state.nets["limit"].shared["within"] & (jnp.mean(kl) <= parts.limit(self.kl_limit))
        chosen = jax.tree.map(partial(jnp.where, near), moved, state)
        return chosen.with_nets(limit=within(near))


def within(near: bool | Array) -> Params:
    """Return whether the policy is within the limit of its divergence, as a network of the agent's."""
    return Params({"within": jnp.asarray(near)}, {})
