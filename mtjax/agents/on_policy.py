"""``OnPolicy`` holds what agents share that learn from rollouts: a policy, a critic of states, and its units."""

import abc
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import combinations, critics, parts, unit_resets
from mtjax.agents.base import BaseAgent, Inputs, Memory
from mtjax.agents.fit import Fit, Losses, above_least, descend
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Network, Params
from mtjax.agents.parts.policies import Categorical, Gaussian, MultiCategorical, Policy, Taken
from mtjax.agents.parts.policies.gaussian import STD_RANGE
from mtjax.agents.state import AgentState, Nets
from mtjax.experience import Rollouts
from mtjax.types import Acted, Array, InputError, Key, Metrics, Task, Transition

LOG_RATIO_LIMIT = 20.0
"""Bound of |log ratio| of two policies, so that its exponential stays finite."""
CRITICS_WEIGHT = 0.5
"""Weight of the critic's loss beside the actor's, for what both teach."""
HEAD_SCALE = 0.01
"""Factor of the output layers' initial weights: all policies begin nearly equal, and values near zero."""


class ActorAux(NamedTuple):
    """Holds what the actor loss finds beside the loss."""

    metrics: Metrics
    kl: Array  # () an estimate of KL(pi_old | pi)


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    raw: Array  # (B, ...) actions as ``policy.log_prob`` takes them
    log_prob: Array  # (B,) their log-probabilities under the policy that took them
    advantage: Array  # (B,)
    value: Array  # (B,) before the update, in units of reward
    target: Array  # (B,) what the critic's outputs should be
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all
    output: Array | None = None  # (B,) the critic's outputs before the update, if it stays near these
    # For a representation that learns.
    action: Array | None = None  # (B, A)
    reward: Array | None = None  # (B,) in the task's units
    next_obs: Any = None  # (B, O)
    model_targets: Any = None  # targets of its models
    followed: None = None  # as a rollout keeps what followed every step


def losses_of(agent: "OnPolicy", state: AgentState, window: Transition, tasks: Task, key: Key) -> Losses:
    """Return the losses of actor and critic on windows (T, B, L, ...) of a rollout that the agent has assessed."""
    state, batch = agent.prepare(state, window, tasks)
    error = jnp.mean(jnp.abs(critics.Units.of(state).rewards(batch.target) - batch.value), axis=1)

    def critic_loss(nets: Nets, batch: Batch, error: Array) -> tuple[Array, Metrics]:
        return agent.critic_loss(nets, batch)[0], {"td_error": error}

    batch = with_models(agent, state, batch, key)
    actor = partial(actor_step_loss, agent), (batch, jax.random.split(key, state.num_tasks))
    return Losses(state.nets, {"critic": (above_least(agent, critic_loss), (batch, error)), "actor": actor}, batch)


def actor_step_loss(agent: "OnPolicy", nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
    """Return the loss of one task in the actor's step, where ``knowing`` may learn from the critic's loss too."""
    loss, aux = agent.actor_loss(nets, batch, key)
    if not (agent.conditioning.by_actor and nets["knowing"].parts):
        return loss, aux
    return loss + CRITICS_WEIGHT * agent.critic_loss(nets, batch)[0], aux


def with_models(agent: "OnPolicy", state: AgentState, batch: Batch, key: Key) -> Batch:
    """Return a batch (T, B, ...) with targets of the representation's models, if it learns."""
    if not agent.representation.learns:
        return batch
    both, models_key = (state.nets["representation"], state.slow["representation"]), jax.random.fold_in(key, 3)
    return batch._replace(model_targets=agent.representation.targets(*both, batch.next_obs, models_key)[0])


@dataclasses.dataclass(frozen=True)
class OnPolicy(BaseAgent):
    """Provides the settings and methods of agents that learn from rollouts; a subclass adds advantages and losses."""

    adjustable: ClassVar[tuple[str, ...]] = (
        *BaseAgent.adjustable,
        *("gae_lambda", "epochs", "minibatches", "entropy_cost", "value_rate"),
    )
    common_presets: ClassVar[bool] = False
    policies: ClassVar[tuple[type[Policy], ...]] = (Gaussian, Categorical, MultiCategorical)
    devices_differ: ClassVar[bool] = True
    critic_outputs: ClassVar[int] = 1
    """The number of values that the critic gives a state."""
    extra_outputs: ClassVar[int] = 0
    """The number of outputs that the actor has after those of its policy."""
    actor_lr: float = 3e-4
    """Adam's learning rate for the actor."""
    critic_lr: float = 1e-3
    """Adam's learning rate for the critic."""
    normalize_observations: bool = True
    """Scale observations to mean 0 and variance 1, by moments of training data alone, and clip them to +-10."""
    max_gradient_norm: float = 1.0
    """Clip the global norms of actor and critic gradients to this; 0 does not clip."""
    critic_layer_norm: bool = False
    """Use layer normalisation in the critic."""
    gae_lambda: float = 0.95
    """Lambda of advantages: 0 relies on the critic alone, 1 on the rewards of the rollout."""
    entropy_cost: float = 1e-2
    """Weight of the entropy in the actor loss (c), in the unit of advantages there: their standard deviation, in impala
    that of targets, and reward where nothing normalises them."""
    initial_std: float = 0.7
    """Standard deviation of the initial policy's actions, before the tanh. A policy of discrete ones begins with all as
    likely."""
    reward_scale: float = 1.0
    """Multiply all rewards by this."""
    reward_clip: float = 0.0
    """Clip rewards to +-this before they are scaled and learned from; 0 does not. Returns that are told are whole."""
    value_normalization: Literal["none", "running", "popart"] = "running"
    """Units of the critic: none, or standard deviations of each task's targets from their mean (running). With popart
    it also has a head for every task, which is rescaled when these estimates move."""
    value_rate: float = 0.1
    """Weight of a new rollout in the moving estimates of targets' mean and variance."""
    experience: Annotated[Rollouts, FLAT] = dataclasses.field(default_factory=Rollouts)

    @abc.abstractmethod
    def gain(self, log_ratio: Array, batch: Batch) -> tuple[Array, Metrics]:
        """Return the gain of each step (B,) that the actor maximises beside the entropy.

        Args:
            log_ratio: (B,) of the action's probability under the present policy to that under the one that took it.
        """

    def __post_init__(self):
        super().__post_init__()
        parts.require_shares(self, "gae_lambda")
        parts.require_positive(self, "reward_scale")
        parts.require_not_negative(self, "entropy_cost", "reward_clip")
        parts.require_rates(self, "value_rate")
        low, high = STD_RANGE
        if not low < self.initial_std < high:
            raise InputError(f"initial-std must be between {low:.2g} and {high:.2g}, not {self.initial_std}")
        if self.scaling.rescales:
            raise InputError("scaling=popart is for critics of actions; use value-normalization=popart")
        if self.sampler.by_temperature:
            raise InputError("sampler=temperature needs an agent with temperatures; use another sampler")
        combinations.refuse_of_replay(self)

    losses = losses_of

    # Networks.

    @property
    def critic(self) -> Network:
        network = super().critic
        if self.value_normalization != "popart" or "head" in network.own:
            return network
        return dataclasses.replace(network, own=(*network.own, "head"))

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        (actor_key, critic_key), num_tasks, size = jax.random.split(key), state.num_tasks, len(inputs.action)
        count, extra = self.policy.outputs(size) + self.extra_outputs, jnp.zeros(self.extra_outputs)
        first = jnp.append(self.policy.first(size, self.initial_std), extra)
        actor = scale_head(self.actor.init(actor_key, num_tasks, count, *inputs.actor), first)
        values = self.critic_outputs
        critic = scale_head(self.critic.init(critic_key, num_tasks, values, *inputs.critic), jnp.zeros(values))
        kept = self.continual.init(actor, num_tasks, inputs.actor, count)
        kept = kept | unit_resets.begin(self, {"actor": actor, "critic": critic})
        state = state.with_nets(**kept, actor=actor, critic=critic, units=critics.Units.begin(num_tasks).params())
        if not self.conditioning.by_actor:
            state = state.with_nets(belief=jax.tree.map(jnp.copy, state.nets["knowing"]))
        slow = {"representation": state.nets["representation"]} if self.representation.learns else {}
        return state._replace(slow=jax.tree.map(jnp.copy, slow))

    @property
    def fits(self) -> dict[str, Fit]:
        found = super().fits
        if not self.conditioning.by_actor:
            return found
        # A step of the critic's optimiser on what the policy sees would move it as far as its own step does.
        names = {"actor": ("actor", "knowing"), "critic": ("critic", "representation")}
        return {name: dataclasses.replace(fit, names=names[name]) for name, fit in found.items()}

    # Acting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action for one observation (O,) of one task; without a key, the policy's mode."""
        outputs = self.policy_outputs(*self.view.acting(state, memory, obs, task))
        action, raw, log_prob = self.policy.draw(outputs, task.action_mask, key)
        return Acted(action, None if key is None else Taken(raw, log_prob), outputs)

    # Losses of one task.

    def log_ratio(self, nets: Nets, features: Array, obs: Any, taken: Any, mask: Array | None) -> Array:
        """Return how much likelier (B,) the actions that were ``taken`` are now, in logarithms."""
        log_prob = self.policy.log_prob(self.policy_outputs(nets, features, obs), taken.raw, mask)
        return limited(log_prob - taken.log_prob)

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        outputs = self.policy_outputs(nets, batch.features, batch.obs)
        log_ratio = limited(self.policy.log_prob(outputs, batch.raw, batch.mask) - batch.log_prob)
        gain, metrics = self.gain(log_ratio, batch)
        entropy = jnp.mean(self.policy.entropy(outputs, batch.mask, key))
        loss = -jnp.mean(gain) - self.entropy_cost * entropy
        kl = jnp.mean(jnp.exp(log_ratio) - 1 - log_ratio)
        held = self.continual.penalty(nets, self, jax.random.fold_in(key, 1))
        return loss + held, ActorAux({"actor_loss": loss, "entropy": entropy, "kl": kl, **metrics}, kl)

    def critic_loss(self, nets: Nets, batch: Batch) -> tuple[Array, Metrics]:
        loss = self.fitting_loss(self.output(nets, batch.features, batch.obs), batch)
        return self.view.join(loss, {"critic_loss": loss}, nets, batch)

    def fitting_loss(self, output: Array, batch: Batch) -> Array:
        """Return the loss () of the critic's outputs (B,)."""
        return jnp.mean(jnp.square(output - batch.target)) / 2

    def output(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the critic's outputs (B,) for observations (B, ...)."""
        features, inputs = self.view.critic_inputs(nets, features, obs)
        return self.critic.apply(nets["critic"], features, inputs)[..., 0]

    # Update of all tasks.

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take a gradient step of actor and critic on windows (T, B, L, ...) of a rollout; metrics are (T,)."""
        sample_key, actor_order, critic_order = jax.random.split(key, 3)
        state, batch = self.prepare(state, window, tasks)
        importance = self.sampler.weights(state.nets["sampler"].own, jnp.ones(len(tasks.id)))
        batch = self.view.keyed(with_models(self, state, batch, key), jax.random.fold_in(key, 4))
        # The actor is first, as pi_old was on what the critic's step moves too: the representation, and what is known.
        data, loss = (batch, jax.random.split(sample_key, len(tasks.id))), partial(actor_step_loss, self)
        moved, actor = descend(self.fits, "actor", state, loss, data, actor_order, importance)
        state = self.accept(moved, state, actor.aux.kl)
        loss = above_least(self, self.critic_loss)
        state, critic = descend(self.fits, "critic", state, loss, (batch,), critic_order, importance)
        state = unit_resets.renew(self, state, batch, jax.random.fold_in(key, 5), number)
        metrics = critic.aux | critic.metrics | actor.aux.metrics | actor.metrics
        return state, metrics | critics.explained(state, batch)

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Keep the representation from before the updates, as a target of its models."""
        if self.representation.learns:
            state = state._replace(slow=state.slow | {"representation": state.nets["representation"]})
        return state, steps

    def prepare(self, state: AgentState, window: Transition, tasks: Task) -> tuple[AgentState, Batch]:
        """Return the batch (T, ...) for the losses, of windows (T, B, L, ...), and the state with its units.

        By default ``assess`` has stored with the steps what the losses need beside what networks see.
        """
        flat, features, obs, next_obs = self.view.steps(state, window, tasks)
        models = critics.models(self, state, flat, tasks, next_obs)
        return state, Batch(obs=obs, features=features, mask=tasks.action_mask, **flat.extras._asdict(), **models)

    def accept(self, moved: AgentState, state: AgentState, kl: Array) -> AgentState:
        """Return the state after an actor's step, which moved it, given KL(pi_old | pi) (T,) before the step."""
        return moved


def limited(log_ratio: Array) -> Array:
    """Return logarithms of ratios within bounds, so that their exponentials stay finite."""
    return jnp.clip(log_ratio, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)


def scale_head(params: Params, bias: Array) -> Params:
    """Shrink the weights of a network's head by ``HEAD_SCALE``, and add ``bias`` to its bias."""
    return with_head(params, lambda head: {"kernel": HEAD_SCALE * head["kernel"], "bias": head["bias"] + bias})


def with_head(params: Params, change: Callable[[dict[str, Array]], dict[str, Array]]) -> Params:
    """Return a network with a changed head, which tasks share or each has of its own."""
    return Params(*(part | {"head": change(part["head"])} if "head" in part else part for part in params))
