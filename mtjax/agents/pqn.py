"""PQN learns the values of discrete actions from rollouts, without replay and slow copies."""

import dataclasses
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import combinations, critics, parts
from mtjax.agents.base import BaseAgent, HeadsOfOne, Inputs, Memory
from mtjax.agents.fit import Fit, Losses, descend
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Network, Params
from mtjax.agents.parts import targets
from mtjax.agents.parts.policies import Categorical, Policy
from mtjax.agents.parts.policies.categorical import allowed
from mtjax.agents.parts.representations import Asymmetric
from mtjax.agents.parts.samplers import Uniform
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState, Nets
from mtjax.experience import Rollouts
from mtjax.experience.rollouts import played, windows
from mtjax.types import Acted, Array, InputError, Key, Metrics, Task, Transition


class Batch(NamedTuple):
    """Holds the data for the loss of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    action: Array  # (B,) int32
    target: Array  # (B,)
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters


@dataclasses.dataclass(frozen=True)
class PQN(BaseAgent):
    """PQN is Q-learning from many parallel environments (Gallici et al. 2025, "Simplifying deep temporal difference").

    After H steps of every environment, backwards from the last one:
        G_t = r_t + gamma d_t ((1 - lambda) max_a Q(s'_t, a) + lambda G_(t+1))                (target)
        L_Q = (Q(s, a) - G)^2 / 2                                                             (loss)
    averaged over a task's minibatch, then over tasks. A time limit ends the sum too. With a ``scaling`` r and Q are in
    units of the task's own, so that tasks with large rewards do not outweigh others.
    Targets are the critic's from before the update. Layer normalisation keeps it stable, with neither a replay nor a
    slow copy of the critic. Actions are the best ones, or with the probability epsilon uniform ones, among those that
    the task has. Epsilon falls along a line from 1 to ``epsilon`` over the first ``epsilon_rollouts`` rollouts.

    With exploration G is biased, as it follows actions that the greedy policy would not take (Peng and Williams 1996).
    ``cut_exploration`` cuts the sum before such an action, without bias (Watkins 1989).

    Of pictures, ``representation=encoded`` gives Q an encoder that the same loss trains. The authors' network for
    MinAtar's games has ``vision=grid``, no ``latent_widths`` and ``hidden`` of 128: a convolution and a layer, each
    with layer normalisation and ReLU. Presets choose it where these games are seen (``--env.pictures``).

    Differs from the authors' code: Adam replaces RAdam, at a constant rate by default. Weights begin by LeCun's
    initialisation, there by He's. Cells of MinAtar's games are 0 or 1, there 0 or 1/255.
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        *(name for name in BaseAgent.adjustable if name != "actor_lr"),
        *("q_lambda", "epochs", "minibatches", "epsilon", "epsilon_rollouts"),
    )
    common_presets: ClassVar[bool] = False
    policies: ClassVar[tuple[type[Policy], ...]] = (Categorical,)
    devices_differ: ClassVar[bool] = True
    actor_lr: ClassVar[float] = BaseAgent.actor_lr  # no setting, as the next three: there is no actor
    actor_hidden: ClassVar[tuple[int, ...]] = ()
    actor_heads: ClassVar[HeadsOfOne] = "as-heads"
    actor_layer_norm: ClassVar[bool] = False
    critic_lr: float = 5e-4
    """Adam's learning rate for the critic."""
    max_gradient_norm: float = 10.0
    """Clip the global norm of the critic's gradient to this; 0 does not clip."""
    q_lambda: float = 0.65
    """Lambda of returns: 0 relies on the critic alone, 1 on the rewards of the rollout."""
    cut_exploration: bool = False
    """Cut returns before actions that were not the best ones."""
    epsilon: float = 0.05
    """Probability of a uniform action in the end."""
    epsilon_rollouts: int = 100
    """Rollouts over which this probability falls from 1."""
    experience: Annotated[Rollouts, FLAT] = dataclasses.field(
        default_factory=lambda: Rollouts(unroll=32, epochs=2, minibatches=32)
    )

    def __post_init__(self):
        super().__post_init__()
        parts.require_shares(self, "q_lambda", "epsilon")
        parts.require_counts(self, "epsilon_rollouts")
        if self.representation.models or isinstance(self.representation, Asymmetric):
            raise InputError("pqn learns from the loss of its values alone; use representation=plain or encoded")
        combinations.refuse_of_replay(self)
        if self.scaling.rescales or type(self.sampler) is not Uniform:
            raise InputError("pqn keeps its heads, and learns all tasks alike: no scaling=popart, and sampler=uniform")

    # Networks.

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        critic = self.critic.init(key, state.num_tasks, len(inputs.action), *inputs.critic)
        return state.with_nets(critic=critic, exploration=Params({"rollouts": jnp.int32(0)}, {}))

    @property
    def actor(self) -> Network:
        """The network that acts, which is the critic."""
        return self.critic

    @property
    def fits(self) -> dict[str, Fit]:
        return {"critic": super().fits["critic"]}

    def q(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the values (..., A) of all actions."""
        return self.critic.apply(nets["critic"], *self.view.critic_inputs(nets, features, obs))

    # Acting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose the best action () for one observation (O,) of one task, or with a key sometimes any action."""
        values = self.q(*self.view.acting(state, memory, obs, task))
        best = self.policy.draw(values, task.action_mask, None).action
        if key is None:
            return Acted(best, outputs=values)
        any_key, turn_key = jax.random.split(key)
        one = self.policy.draw(jnp.zeros_like(values), task.action_mask, any_key).action
        return Acted(jnp.where(jax.random.uniform(turn_key) < self.exploration(state), one, best), outputs=values)

    def exploration(self, state: AgentState) -> Array:
        """Return the probability () of a uniform action."""
        passed = state.nets["exploration"].shared["rollouts"] / self.epsilon_rollouts
        return jnp.maximum(self.epsilon, 1 - (1 - self.epsilon) * passed)

    # Learning.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add the targets to a rollout (T, H, E, ...)."""
        flat, features, obs, next_obs = self.view.steps(state, windows(steps, self.unroll), tasks)
        values, following = (self.values(state, features, x, tasks) for x in (obs, next_obs))
        greedy = jnp.argmax(values, axis=-1) == flat.action
        gamma = discounts_of_all(self, tasks)
        reward = self.scaling.rewards(state.nets["scaling"].own, flat, gamma, jnp.zeros(len(gamma)))
        in_order = partial(played, shape=steps.reward.shape, length=self.unroll)
        cut, following, reward = steps.cut, in_order(jnp.max(following, axis=-1)), in_order(reward)
        if self.cut_exploration:
            cut |= jnp.roll(~in_order(greedy), -1, axis=1)
        returns = jax.vmap(partial(targets.lambda_returns, lambda_=self.q_lambda))
        return state, steps._replace(extras=returns(steps._replace(cut=cut, reward=reward), following, gamma))

    def values(self, state: AgentState, features: Array, obs: Any, tasks: Task) -> Array:
        """Return the values (T, B, A) of all actions; those that a task does not have are worth nothing at all."""
        found = critics.over_rollout(self.q, self, state, features, obs)
        return allowed(found, None if tasks.action_mask is None else tasks.action_mask[:, None])

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take a gradient step on windows (T, B, L, ...) of a rollout; metrics are (T,)."""
        batch = self.view.keyed(self.batch(state, window, tasks), jax.random.fold_in(key, 1))
        state, fitted = descend(self.fits, "critic", state, self.loss, (batch,), key)
        epsilon = {"epsilon": jnp.broadcast_to(self.exploration(state), len(tasks.id))}
        return state, fitted.aux | fitted.metrics | epsilon

    def batch(self, state: AgentState, window: Transition, tasks: Task) -> Batch:
        """Return the batch (T, ...) for the loss, of windows (T, B, L, ...) with their targets."""
        flat, features, obs, _ = self.view.steps(state, window, tasks)
        return Batch(obs, flat.action, flat.extras, features)

    def losses(self, state: AgentState, window: Transition, tasks: Task, key: Key) -> Losses:
        batch = self.batch(state, window, tasks)
        return Losses(state.nets, {"critic": (self.loss, (batch,))}, batch)

    def loss(self, nets: Nets, batch: Batch) -> tuple[Array, Metrics]:
        values = self.q(nets, batch.features, batch.obs)
        value = jnp.take_along_axis(values, batch.action[:, None], axis=-1)[:, 0]
        loss = jnp.mean(jnp.square(value - batch.target)) / 2
        metrics = {"critic_loss": loss, "value": jnp.mean(value), "td_error": jnp.mean(jnp.abs(value - batch.target))}
        return self.view.join(loss, metrics, nets, batch)

    def observe(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        state = super().observe(state, steps, tasks)
        rollouts = state.nets["exploration"].shared["rollouts"] + 1
        return state.with_nets(exploration=Params({"rollouts": rollouts}, {}))
