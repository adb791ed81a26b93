"""PPO trains by proximal policy optimisation on many tasks at once."""

import dataclasses
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.base import BaseAgent, Memory
from mtjax.agents.choices import FLAT
from mtjax.agents.fit import Fit
from mtjax.agents.parts import targets
from mtjax.agents.parts.samplers import SAMPLERS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.scaling.base import Moments
from mtjax.agents.parts.scaling.popart import rescale_heads
from mtjax.agents.state import AgentState, Nets, axes_of
from mtjax.experience import Rollouts
from mtjax.maps import in_parts
from mtjax.networks import (
    STD_RANGE,
    Network,
    Params,
    log_density,
    outputs_for,
    sample_raw,
    tanh_normal,
)
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Acted, Array, InputError, Key, Metrics, Task, Transition

LOG_RATIO_LIMIT = 20.0
"""Bound of |log ratio| of two policies, so that its exponential stays finite."""
MIN_STD = 1e-4
"""Lower bound of standard deviations of targets and advantages, which divide them."""
HEAD_SCALE = 0.01
"""Factor of the output layers' initial weights: all policies begin nearly equal, and values near zero."""


class Units(NamedTuple):
    """Holds the units of the critic: a value is mean + std times its output."""

    count: Array  # () number of rollouts so far
    moments: Moments  # of targets, (T,)

    @staticmethod
    def of(params: Params) -> "Units":
        """Return the units that a network of the agent's holds."""
        return Units(params.shared["count"], params.own)

    def params(self) -> Params:
        """Return the units as a network of the agent's."""
        return Params({"count": self.count}, self.moments)

    @property
    def std(self) -> Array:
        return jnp.maximum(jnp.sqrt(self.moments.variance), MIN_STD)

    def rewards(self, outputs: Array) -> Array:
        """Return the values in units of reward for which the critic's outputs (T, ...) stand."""
        mean, std = (jnp.expand_dims(x, range(1, outputs.ndim)) for x in (self.moments.mean, self.std))
        return mean + std * outputs

    def outputs(self, values: Array) -> Array:
        """Return the critic's outputs that stand for values (T, ...) in units of reward."""
        mean, std = (jnp.expand_dims(x, range(1, values.ndim)) for x in (self.moments.mean, self.std))
        return (values - mean) / std


class Taken(NamedTuple):
    """Holds what is stored with an action when it is taken."""

    raw: Array  # (A,) the action before the tanh
    log_prob: Array  # () its log-probability under the policy that took it


class Assessed(NamedTuple):
    """Holds what is stored with an action once the rollout is over."""

    raw: Array  # (A,)
    log_prob: Array  # ()
    advantage: Array  # (), normalised
    value: Array  # () of the state before the action
    output: Array  # () the critic's output before the update, in the new units
    target: Array  # () what the critic's output should be


class ActorAux(NamedTuple):
    """Holds what the actor loss finds beside the loss."""

    metrics: Metrics
    kl: Array  # () an estimate of KL(pi_old | pi)


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    raw: Array  # (B, A) actions before the tanh
    log_prob: Array  # (B,) their log-probabilities under the policy that took them
    advantage: Array  # (B,)
    output: Array  # (B,) the critic's outputs before the update
    target: Array  # (B,) what the critic's outputs should be
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all
    # For a representation that learns.
    action: Array | None = None  # (B, A)
    reward: Array | None = None  # (B,) in the task's units
    next_obs: Any = None  # (B, O)
    model_targets: Any = None  # targets of its models
    followed: None = None  # as a rollout keeps what followed every step


@dataclasses.dataclass(frozen=True)
class PPO(BaseAgent):
    """PPO trains by multi-task proximal policy optimisation, with separate actor and critic (Schulman et al. 2017).

    The policy pi_old plays H steps of every environment. For each step of task i, with s' the true next observation,
    d = 0 if the episode terminated, and e = 1 if it ended, by a time limit too:
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

    The policy is a tanh-squashed Gaussian; its entropy is estimated from one sample. With a ``kl_limit``, the actor is
    not updated for the rest of an update once mean(ratio - 1 - log ratio), an estimate of KL(pi_old | pi), exceeds it
    on a minibatch. Then a schedule of the actor's learning rate waits too.

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

    adjustable: ClassVar[tuple[str, ...]] = (
        *BaseAgent.adjustable,
        *("gae_lambda", "epochs", "minibatches", "clip_range", "value_clip", "entropy_cost", "kl_limit", "value_rate"),
    )
    common_presets: ClassVar[bool] = False
    devices_differ: ClassVar[bool] = True
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
    """Lambda of generalised advantages: 0 relies on the critic alone, 1 on the rewards of the rollout."""
    clip_range: float = 0.2
    """Clip the ratio of policies to this distance from 1 (epsilon)."""
    value_clip: float = 0.0
    """Clip the change of values in an update to this, in standard deviations of the targets; 0 does not clip."""
    entropy_cost: float = 1e-2
    """Weight of the entropy in the actor loss (c), in standard deviations of the advantage."""
    kl_limit: float = 0.0
    """Stop updating the actor until the next rollout once KL(pi_old | pi) exceeds this; 0 never stops."""
    initial_std: float = 0.7
    """Standard deviation of the initial policy's actions, before the tanh."""
    reward_scale: float = 1.0
    """Multiply all rewards by this."""
    advantage_normalization: Literal["none", "all", "task"] = "task"
    """Scale advantages to mean 0 and standard deviation 1: never, over all tasks together, or in each task."""
    value_normalization: Literal["none", "running", "popart"] = "running"
    """Units of the critic: none, or standard deviations of each task's targets from their mean (running). With popart
    it also has a head for every task, which is rescaled when these estimates move."""
    value_rate: float = 0.1
    """Weight of a new rollout in the moving estimates of targets' mean and variance."""
    experience: Annotated[Rollouts, FLAT] = dataclasses.field(default_factory=Rollouts)

    def _check_numbers(self) -> None:
        super()._check_numbers()
        parts.require_shares(self, "gae_lambda")
        parts.require_positive(self, "clip_range", "reward_scale")
        parts.require_not_negative(self, "value_clip", "entropy_cost", "kl_limit")
        parts.require_rates(self, "value_rate")
        low, high = STD_RANGE
        if not low < self.initial_std < high:
            raise InputError(f"initial-std must be between {low:.2g} and {high:.2g}, not {self.initial_std}")

    def _check_combination(self) -> None:
        super()._check_combination()
        if parts.name_of(SCALINGS, self.scaling) == "popart":
            raise InputError("scaling=popart is for critics of actions; use value-normalization=popart")
        if parts.name_of(SAMPLERS, self.sampler) == "temperature":
            raise InputError("sampler=temperature needs an agent with temperatures; use another sampler")
        given, usual = (parts.settings(x) for x in (self.representation, type(self.representation)()))
        for name in ("encoder_tau", "shift"):
            if given.get(name) != usual.get(name):
                flag = name.replace("_", "-")
                raise InputError(f"{flag}={given[name]} is of updates from a replay, and ppo has none; leave it out")

    @property
    def unroll(self) -> int:
        return self.experience.unroll if self.conditioning.recurs else 0

    # Networks.

    @property
    def critic(self) -> Network:
        network = super().critic
        if self.value_normalization != "popart" or "head" in network.own:
            return network
        return dataclasses.replace(network, own=(*network.own, "head"))

    def init_networks(self, num_tasks: int, actor_inputs: tuple, critic_inputs: tuple, action: Array, key: Key) -> Nets:
        actor_key, critic_key = jax.random.split(key)
        first = jnp.repeat(jnp.array([0.0, outputs_for(self.initial_std)]), len(action))
        return {
            "actor": scale_head(self.actor.init(actor_key, num_tasks, 2 * len(action), *actor_inputs), first),
            "critic": scale_head(self.critic.init(critic_key, num_tasks, 1, *critic_inputs), jnp.zeros(1)),
            "units": Units(jnp.float32(0), Moments.begin(num_tasks)).params(),
            **({"limit": within(True)} if self.limits_kl else {}),
        }

    def init_slow(self, nets: Nets) -> Nets:
        return {"representation": jax.tree.map(jnp.copy, nets["representation"])} if self.representation.learns else {}

    @property
    def fits(self) -> dict[str, Fit]:
        found = super().fits
        return found | {"actor": dataclasses.replace(found["actor"], names=("actor", "knowing"))}

    # Acting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""
        outputs = self.policy(*self.acting_inputs(state, memory, obs, task))
        if key is None:
            return Acted(tanh_normal(outputs, None, task.action_mask)[0])
        raw, log_prob = sample_raw(outputs, key, task.action_mask)
        action = jnp.tanh(raw)
        action = action if task.action_mask is None else action * task.action_mask
        return Acted(action, Taken(raw, log_prob))

    # Losses of one task.

    def policy(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the policy's outputs (..., 2A)."""
        return self.actor.apply(nets["actor"], *self.actor_inputs(nets, features, obs))

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        outputs = self.policy(nets, batch.features, batch.obs)
        log_ratio = log_density(outputs, batch.raw, batch.mask) - batch.log_prob
        log_ratio = jnp.clip(log_ratio, -LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - self.clip_range, 1 + self.clip_range)
        gain = jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
        entropy = -jnp.mean(sample_raw(outputs, key, batch.mask)[1])
        loss = -gain - self.entropy_cost * entropy
        kl, beyond = jnp.mean(ratio - 1 - log_ratio), jnp.mean(ratio != clipped)
        return loss, ActorAux({"actor_loss": loss, "entropy": entropy, "kl": kl, "clip_fraction": beyond}, kl)

    def critic_loss(self, nets: Nets, batch: Batch) -> tuple[Array, Metrics]:
        output = self.output(nets, batch.features, batch.obs)
        error = jnp.square(output - batch.target)
        if not parts.is_zero(self.value_clip):
            clipped = batch.output + jnp.clip(output - batch.output, -self.value_clip, self.value_clip)
            error = jnp.maximum(error, jnp.square(clipped - batch.target))
        loss = jnp.mean(error) / 2
        known = batch._replace(features=self.know(nets, batch.features, batch.obs)[0])
        return self.representation.join(loss, {"critic_loss": loss}, nets["representation"], known)

    def output(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the critic's outputs (B,) for observations (B, ...)."""
        features, inputs = self.critic_inputs(nets, features, obs)
        return self.critic.apply(nets["critic"], features, inputs)[..., 0]

    # Update of all tasks.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add advantages and targets to a rollout (T, H, E, ...), and fit the critic's units to it."""
        windows = self.experience.windows(steps, self.unroll)
        flat, features, obs, next_obs = self.inputs(state, windows, tasks)
        old, output = Units.of(state.nets["units"]), self.outputs(state, features, obs)
        value, next_value = old.rewards(output), self.values(state, features, next_obs)
        played = lambda x: self.experience.played(x, steps.reward.shape, self.unroll)
        value, next_value, output = map(played, (value, next_value, output))
        reward = played(self.rewards(state, flat, tasks))
        advantage = self.advantages(steps._replace(reward=reward), tasks, value, next_value)
        target = value + advantage
        of_task = target.reshape(len(target), -1)
        scaling, _ = self.scaling.renew(state.nets["scaling"].own, of_task, ())
        state = self.renew(state._replace(nets=state.nets | {"scaling": Params({}, scaling)}), of_task)
        units = Units.of(state.nets["units"])
        factor, offset = (x[:, None, None] for x in self.follows(old, units))
        extras = Assessed(
            raw=steps.extras.raw,
            log_prob=steps.extras.log_prob,
            advantage=self.normalize_advantages(advantage),
            value=value,
            output=factor * output + offset,
            target=units.outputs(target),
        )
        if self.representation.learns:
            state = state._replace(slow={"representation": state.nets["representation"]})
        if self.limits_kl:
            state = state._replace(nets=state.nets | {"limit": within(True)})
        return state, steps._replace(extras=extras)

    def inputs(self, state: AgentState, window: Transition, tasks: Task) -> tuple[Transition, Array, Any, Any]:
        """Return the steps (T, B L, ...) of windows (T, B, L, ...), with features, observations and next ones."""
        flat = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), window)
        see, (past, next_past) = partial(self.see_batch, state.nets["inputs"]), self.around(window, flat, flat)
        return flat, self.features_of_batch(state, flat, tasks), see(flat.obs, past), see(flat.next_obs, next_past)

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take a gradient step of actor and critic on windows (T, B, L, ...) of a rollout; metrics are (T,)."""
        sample_key, actor_order, critic_order = jax.random.split(key, 3)
        batch = self.prepare(state, window, tasks)
        importance = self.sampler.weights(state.nets["sampler"].own, jnp.ones(state.num_tasks))
        # The actor is first, as pi_old was on what the critic's step moves too: the representation, and what is known.
        data = (batch, jax.random.split(sample_key, state.num_tasks))
        moved, actor = self.descend(state, "actor", self.actor_loss, data, actor_order, importance)
        state = self.unless_far(moved, state, actor.aux.kl)
        if self.representation.learns:
            both, models_key = (state.nets["representation"], state.slow["representation"]), jax.random.fold_in(key, 3)
            found, _ = self.representation.targets(*both, batch.next_obs, models_key)
            batch = batch._replace(model_targets=found)
        loss = self.above_least(self.critic_loss)
        state, critic = self.descend(state, "critic", loss, (batch,), critic_order, importance)
        told = self.explained(state, window.extras)
        return state, critic.aux | critic.metrics | actor.aux.metrics | actor.metrics | told

    def unless_far(self, moved: AgentState, state: AgentState, kl: Array) -> AgentState:
        """Return the state that has moved, unless KL(pi_old | pi) (T,) has exceeded ``kl_limit`` in this rollout."""
        if not self.limits_kl:
            return moved
        limit = parts.or_infinite(self.kl_limit)
        near = state.nets["limit"].shared["within"] & (jnp.mean(kl) <= limit)
        chosen = jax.tree.map(partial(jnp.where, near), moved, state)
        return chosen._replace(nets=chosen.nets | {"limit": within(near)})

    @property
    def limits_kl(self) -> bool:
        """Whether there may be a limit of KL(pi_old | pi)."""
        return not parts.is_zero(self.kl_limit)

    def explained(self, state: AgentState, assessed: "Assessed") -> Metrics:
        """Return the mean value (T,) of steps, and which share of the variance of targets values explained."""
        flat = lambda x: x.reshape(len(x), -1)
        value, target = flat(assessed.value), Units.of(state.nets["units"]).rewards(flat(assessed.target))
        residual, whole = (mean_and_variance(x, 1)[1][:, 0] for x in (target - value, target))
        explained = 1 - residual / jnp.maximum(whole, MIN_STD**2)
        return {"value": mean_and_variance(value, 1)[0][:, 0], "explained_variance": explained}

    def prepare(self, state: AgentState, window: Transition, tasks: Task) -> Batch:
        """Return the batch (T, ...) for the losses, of windows (T, B, L, ...) of an assessed rollout."""
        flat, features, obs, next_obs = self.inputs(state, window, tasks)
        models = {}
        if self.representation.learns:
            models = {"action": flat.action, "reward": self.rewards(state, flat, tasks), "next_obs": next_obs}
        found: Assessed = flat.extras
        kept = {"raw": found.raw, "log_prob": found.log_prob, "advantage": found.advantage}
        kept |= {"output": found.output, "target": found.target}
        return Batch(obs=obs, features=features, mask=tasks.action_mask, **kept, **models)

    def rewards(self, state: AgentState, flat: Transition, tasks: Task) -> Array:
        """Return the rewards (T, H E) of steps in the task's units."""
        gamma = jnp.broadcast_to(self.discounts(tasks), len(tasks.id))
        return self.reward_scale * self.scaling.rewards(state.nets["scaling"].own, flat, gamma, jnp.zeros(len(gamma)))

    def advantages(self, steps: Transition, tasks: Task, value: Array, next_value: Array) -> Array:
        """Compute the advantages (T, H, E) of a rollout."""
        gamma = jnp.broadcast_to(self.discounts(tasks), len(tasks.id))
        return jax.vmap(partial(targets.gae, lambda_=self.gae_lambda))(steps, value, next_value, gamma)

    def values(self, state: AgentState, features: Array, obs: Any) -> Array:
        """Return the critic's values (T, B) of observations (T, B, ...), in units of reward."""
        return Units.of(state.nets["units"]).rewards(self.outputs(state, features, obs))

    def outputs(self, state: AgentState, features: Array, obs: Any) -> Array:
        """Return the critic's outputs (T, B) for observations (T, B, ...)."""
        of_tasks = partial(jax.vmap(self.output, (axes_of(state.nets), 0, 0)), state.nets)
        if frames.shown(obs):  # all at once they would fill the memory
            return in_parts(of_tasks, features, obs, self.experience.minibatches)
        return of_tasks(features, obs)

    def normalize_advantages(self, advantage: Array) -> Array:
        """Scale advantages (T, H, E) to mean 0 and standard deviation 1, as the settings say."""
        if self.advantage_normalization == "none":
            return advantage
        mean, variance = mean_and_variance(advantage, (1, 2) if self.advantage_normalization == "task" else (0, 1, 2))
        return (advantage - mean) / jnp.maximum(jnp.sqrt(variance), MIN_STD)

    def renew(self, state: AgentState, target: Array) -> AgentState:
        """Update the critic's units by targets (T, B), and with PopArt rescale its heads to them."""
        if self.value_normalization == "none":
            return state
        old = Units.of(state.nets["units"])
        rate = jnp.maximum(self.value_rate, 1 / (old.count + 1))  # the first rollouts have equal weights
        mean, variance = (x[:, 0] for x in mean_and_variance(target, 1))
        new = Units(old.count + 1, old.moments.moved(rate, mean - old.moments.mean, variance))
        nets = state.nets | {"units": new.params()}
        if self.value_normalization == "popart":
            nets |= {"critic": rescale_heads(state.nets["critic"], *self.follows(old, new))}
        return state._replace(nets=nets)

    def follows(self, old: Units, new: Units) -> tuple[Array, Array]:
        """Return by which factor and offset (T,) the critic's outputs change when its units do.

        With PopArt they change so that values do not, but for the first units, which change nothing.
        """
        known = (old.count > 0) & (self.value_normalization == "popart")
        return jnp.where(known, old.std / new.std, 1.0), jnp.where(
            known, (old.moments.mean - new.moments.mean) / new.std, 0.0
        )


def within(near: bool | Array) -> Params:
    """Return whether the policy is within the limit of its divergence, as a network of the agent's."""
    return Params({"within": jnp.asarray(near)}, {})


def scale_head(params: Params, bias: Array) -> Params:
    """Shrink the weights of a network's head by ``HEAD_SCALE``, and add ``bias`` to its bias."""

    def scaled(part: dict) -> dict:
        if "head" not in part:
            return part
        head = part["head"]
        return {**part, "head": {"kernel": HEAD_SCALE * head["kernel"], "bias": head["bias"] + bias}}

    return Params(scaled(params.shared), scaled(params.own))
