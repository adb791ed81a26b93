"""MAML learns a policy that a gradient step or a few adapt to a task."""

import dataclasses
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import clipped_ratio, combinations, parts
from mtjax.agents.base import Inputs, Memory
from mtjax.agents.hyperparameters import FLAT, PARTS
from mtjax.agents.networks import Params
from mtjax.agents.on_policy import ActorAux, Batch, OnPolicy
from mtjax.agents.parts.adaptation import adapt, surrogate
from mtjax.agents.parts.knowing import Knowing
from mtjax.agents.state import AgentState, Nets, over_tasks
from mtjax.experience import AdaptingRollouts
from mtjax.experience.rollouts import windows
from mtjax.types import Acted, Array, InputError, Key, Metrics, Task, Transition


class Played(NamedTuple):
    """Holds what a task's actor learns from in rollouts, leaves (rollouts, N, ...)."""

    obs: Any
    raw: Array
    log_prob: Array
    advantage: Array

    @staticmethod
    def of(batch: Batch, count: int) -> "Played":
        """Split the steps (B, ...) of one task's batch into ``count`` rollouts."""
        found = Played(batch.obs, batch.raw, batch.log_prob, batch.advantage)
        return jax.tree.map(lambda x: x.reshape(count, -1, *x.shape[1:]), found)


@dataclasses.dataclass(frozen=True)
class MAML(OnPolicy):
    """MAML trains a policy for what it is after a few gradient steps on a task (Finn et al. 2017), by PPO's steps.

    In each iteration the policy theta plays a rollout D_i of every task i, takes a step that is the task's own, and
    plays again, so that with K inner steps there are K + 1 rollouts:
        theta_i = theta + inner_rate grad J_i(theta, D_i),  J_i(theta, D) = mean_D pi_theta(a|s) / pi_old(a|s) A
    pi_old took the steps of D: its ratio is 1 at first, and J_i has the slope and the curvature of the task's return
    on average over rollouts. The outer step minimises PPO's actor loss on the last rollout D'_i, averaged over tasks:
        L = mean_i L_pi(theta_i, D'_i)
    It differentiates theta_i too, and with it twice J_i; with ``first_order`` it takes theta_i - theta as a constant.
    Then all tasks begin at theta again. Each of the ``epochs`` repeats the inner steps from the new theta.

    The policy does not see its task: all that it knows of it is in theta_i. Evaluations of a run play theta, before any
    inner step. ``mtjax.learning.evaluation.adapted`` takes inner steps on tasks, of training or not, and returns the
    states of the agent with which to evaluate it on them.

    Advantages are generalised ones within each rollout, scaled in each task and rollout as PPO scales a rollout's. One
    critic learns from all rollouts; as it does not see the task, ``gae_lambda`` is 1 by default. The metrics
    ``reward_before`` and ``reward_after`` are the mean reward of a step in the first and in the last rollout.

    Tasks are those of the family's grid or sample, each with environments of its own; trials that draw their tasks have
    none to adapt to. All of a seed's environments are on one device.

    Differs from the paper: clipped steps by Adam replace trust regions, as in ProMP (Rothfuss et al. 2019), without its
    penalty on inner steps; the baseline is a network and not fitted linearly to each rollout; environments go on over
    rollouts, which need not hold whole episodes.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*OnPolicy.adjustable, "clip_range", "inner_rate", "first_order")
    hidden: tuple[int, ...] = (64, 64)
    actor_lr: float = 1e-3
    """Adam's learning rate for the actor."""
    gae_lambda: float = 1.0
    """Lambda of advantages: 0 relies on the critic alone, 1 on the rewards of the rollout."""
    entropy_cost: float = 0.0
    """Weight of the entropy in the actor loss (c), in standard deviations of advantages, or of reward without these."""
    clip_range: float = 0.2
    """Clip the ratio of policies to this distance from 1 (epsilon)."""
    advantage_normalization: clipped_ratio.Normalization = "task"
    """Scale advantages to mean 0 and standard deviation 1: never, over all tasks together, or in each task."""
    inner_rate: float = 0.1
    """Length of an inner step, in gradients of the gain."""
    first_order: bool = False
    """Take inner steps as constants in the outer one, so that nothing is differentiated twice."""
    experience: Annotated[AdaptingRollouts, FLAT] = dataclasses.field(default_factory=AdaptingRollouts)

    losses = None

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "clip_range", "inner_rate")
        if type(self.conditioning) is not Knowing:
            name = parts.name_of(PARTS["conditioning"], self.conditioning)
            raise InputError(f"maml finds out its task by adapting to it; use conditioning=none, not {name}")
        combinations.require_heads(self, "shared", "maml has one policy, which adapts to every task")
        if self.representation.learns or self.representation.history:
            raise InputError("maml adapts a policy of observations as they are; use representation=plain")

    # Networks.

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        return forget(super().init_networks(state, inputs, key))

    # Acting and adapting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action by the policy as far as it has adapted to the task."""
        return super().act(state.with_nets(actor=state.nets["adapted"]), memory, obs, task, key)

    def adapt(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        """Take an inner step for each task, given a rollout (T, H, E, ...) of its policy."""
        _, steps = self.assess(state, steps, tasks)
        _, batch = self.prepare(state, windows(steps, 0), tasks)
        of_task = lambda nets, batch: self.step_inside(nets, nets["adapted"], batch, Played.of(batch, 1))
        return state.with_nets(adapted=over_tasks(of_task, state.nets, batch))

    def step_inside(self, nets: Nets, actor: Params, batch: Batch, before: Played) -> Params:
        """Return one task's actor after inner steps on its rollouts (K, N, ...)."""

        def gain(actor: Params, played: Played) -> Array:
            found = nets | {"actor": actor}
            return surrogate(self.log_ratio(found, batch.features, played.obs, played, batch.mask), played.advantage)

        return adapt(gain, actor, before, self.inner_rate, self.first_order)

    # Learning.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add advantages and targets to rollouts (T, H, E, ...), and fit the critic's units to them."""
        return clipped_ratio.assess(self, state, steps, tasks, self.experience.apart)

    gain = clipped_ratio.gain

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        played = Played.of(batch, self.experience.inner_steps + 1)
        before, after = (jax.tree.map(lambda x, part=part: x[part], played) for part in (slice(-1), -1))
        adapted = self.step_inside(nets, nets["actor"], batch, before)
        return super().actor_loss(nets | {"actor": adapted}, batch._replace(**after._asdict()), key)

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take a gradient step of actor and critic on all rollouts, as windows (T, B, 1, ...); metrics are (T,)."""
        state, metrics = super().update(state, window, tasks, key, number)
        rewards = jnp.mean(window.reward.reshape(len(window.reward), self.experience.inner_steps + 1, -1), axis=-1)
        return state, metrics | {"reward_before": rewards[:, 0], "reward_after": rewards[:, -1]}

    def observe(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        """Count collected steps (T, H, E, ...), and let all tasks begin at the new policy."""
        return forget(super().observe(state, steps, tasks))


def forget(state: AgentState) -> AgentState:
    """Return a state whose policy has adapted to no task: each has a copy, leaves (T, ...), of what tasks share."""
    actor = state.nets["actor"]
    copies = jax.tree.map(lambda x: jnp.repeat(x[None], state.num_tasks, axis=0), actor.shared)
    return state.with_nets(adapted=Params({}, {**copies, **actor.own}))
