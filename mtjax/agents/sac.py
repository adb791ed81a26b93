"""SAC trains soft actor-critic on many tasks at once; its variants override single methods."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mtjax.agents import parts
from mtjax.agents.base import BaseAgent, Memory
from mtjax.agents.choices import FLAT
from mtjax.agents.fit import Fit
from mtjax.agents.parts.representations import REPRESENTATIONS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.values import VALUES, Value
from mtjax.agents.state import AgentState, Nets, axes_of
from mtjax.experience import Replay, pictures
from mtjax.maps import when
from mtjax.networks import Network, Params
from mtjax.types import Acted, Array, InputError, Key, Metrics, Sometimes, Task, Transition


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    action: Array  # (B, A)
    reward: Array  # (B,) in the task's units
    discount: Array  # (B,) gamma, or 0 where the episode terminated
    next_obs: Any  # (B, O)
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    temperature: Array  # ()
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all
    model_targets: Any = None  # targets of the representation's models
    followed: Array | None = None  # (B,) bool: next_obs is what followed; None: it always is


class Sample(NamedTuple):
    """Holds actions that a policy has sampled."""

    action: Array  # (B, A)
    log_prob: Array  # (B,)
    cost: Array  # (B,) what the temperature weighs: log pi, in Distral less a share of log pi_0


class CriticAux(NamedTuple):
    """Holds what a critic loss finds beside the loss."""

    metrics: Metrics
    expected: Array  # (B,) the values that the critics are fitted to
    statistics: Any = {}  # new running statistics of the critics' bodies  # noqa: RUF012


class ActorAux(NamedTuple):
    """Holds what an actor loss finds beside the loss."""

    metrics: Metrics
    entropy: Array  # () of the policy
    statistics: Any = {}  # new running statistics of the actor's body  # noqa: RUF012


@dataclasses.dataclass(frozen=True)
class SAC(BaseAgent):
    """SAC trains one soft actor-critic on all tasks, by default blind to the task (Haarnoja et al. 2018; "MT-SAC").

    Per transition of task i, with temperature a_i, N critics Q_n and target critics Qbar_n:
        y = r + discount gamma (min_n Qbar_n(s', a') - a_i log pi(a'|s')),  a' ~ pi(s')     (critic target)
        L_Q = sum_n (Q_n(s, a) - y)^2                                                        (critic loss)
        L_pi = a_i log pi(a|s) - min_n Q_n(s, a),  a ~ pi(s)                                 (actor loss)
        L_a = a_i (-log pi(a|s) - H)                                                         (temperature loss)
    averaged over the batch of a task, then over tasks. ``discount`` is 0 only where an episode terminated, so that a
    time limit bootstraps. The actor loss and the target critics use the critic that this update has changed.

    Differs from the paper: critics have layer normalisation; by default the learning rate is 1e-3, the target entropy H
    is -A/2 and each task has its own temperature; a tanh brings log standard deviations into [-5, 2].
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        *BaseAgent.adjustable,
        *("temperature_lr", "temperature_momentum", "tau", "target_entropy"),
    )
    temperature_lr: float = 1e-3
    """Adam's learning rate of the temperatures."""
    temperature_momentum: float = 0.9
    """First decay rate of the temperatures' Adam; 0.5 in SAC-AE and BRC."""
    tau: float = 0.005
    """Step of the target critic towards the new critic at each update, as a share of the distance."""
    num_critics: int = 2
    """Number of critics."""
    critic_reduction: Literal["min", "mean"] = "min"
    """How the critics' values become one, for targets and for the actor: their minimum or their mean."""
    initial_temperature: float = 0.1
    """Temperature before training."""
    target_entropy: float = -0.5
    """Entropy to which the temperature is tuned, per action dimension."""
    shared_temperature: bool = False
    """Use one temperature for all tasks instead of one for each task."""
    unit_head: bool = False
    """Keep the weights of each output of actor and critics at length 1."""
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=Value)
    experience: Annotated[Replay, FLAT] = dataclasses.field(default_factory=Replay)

    def _check_numbers(self) -> None:
        if not 0 <= self.gamma <= 1 or not 0 < self.tau <= 1:
            raise InputError(f"gamma must be in [0, 1] and tau in (0, 1], not {self.gamma} and {self.tau}")
        super()._check_numbers()
        parts.require_positive(self, "temperature_lr", "num_critics", "initial_temperature")
        if not 0 <= self.temperature_momentum < 1:
            raise InputError(f"temperature-momentum must be in [0, 1), not {self.temperature_momentum}")

    def _check_combination(self) -> None:
        super()._check_combination()
        value, scaling = parts.name_of(VALUES, self.value), parts.name_of(SCALINGS, self.scaling)
        if scaling == "popart" and (self.heads == "shared" or value != "scalar"):
            raise InputError(
                "scaling=popart rescales a scalar head of every task's own; use value=scalar and heads=per-task or "
                f"disjoint, not {value} and {self.heads}"
            )
        if self.representation.predicts and self.experience.n_step > 1:
            name = parts.name_of(REPRESENTATIONS, self.representation)
            raise InputError(f"{name} learns models of single steps; use n-step=1, not {self.experience.n_step}")
        replay = self.experience
        if self.conditioning.recurs and (replay.n_step > 1 or replay.hindsight or replay.host_replay_size):
            raise InputError("conditioning=recurrent needs n-step=1, hindsight=0 and host-replay-size=0")
        if self.unroll > self.experience.warmup_steps + 1:
            raise InputError(
                f"recurrent-steps={self.unroll} needs as many steps before the first update: warmup-steps of at least "
                f"{self.unroll - 1}, not {self.experience.warmup_steps}"
            )
        if scaling == "popart" and self.unit_head:
            raise InputError("scaling=popart rescales heads, which unit-head keeps at length 1; use one of them")

    # Networks.

    def network(self, hidden: tuple[int, ...], layer_norm: bool) -> Network:
        return dataclasses.replace(super().network(hidden, layer_norm), unit_head=self.unit_head)

    def init_networks(self, num_tasks: int, actor_inputs: tuple, critic_inputs: tuple, action: Array, key: Key) -> Nets:
        actor_key, critic_key = jax.random.split(key)
        init_critic = lambda k: self.critic.init(k, num_tasks, self.value.outputs, *critic_inputs, action)
        keys = jax.random.split(critic_key, self.num_critics)
        log = jnp.log if isinstance(self.initial_temperature, Array) else np.log
        temperature = jnp.full(1 if self.shared_temperature else num_tasks, log(self.initial_temperature))
        temperature = {"log": temperature.astype(jnp.float32)}
        return {
            "actor": self.actor.init(actor_key, num_tasks, self.policy.outputs(len(action)), *actor_inputs),
            "critic": jax.vmap(init_critic, out_axes=Params(shared=0, own=1))(keys),  # type: ignore
            "temperature": Params(temperature, {}) if self.shared_temperature else Params({}, temperature),
        }

    def init_slow(self, nets: Nets) -> Nets:
        copied = nets["representation"].without(self.representation.without_target)
        followed = {"critic": nets["critic"], "knowing": nets["knowing"], "representation": copied}
        return jax.tree.map(jnp.copy, followed)

    @property
    def fits(self) -> dict[str, Fit]:
        rate = self.scheduled(self.temperature_lr, self.experience.policy_delay)
        return super().fits | {"temperature": Fit(("temperature",), optax.adam(rate, self.temperature_momentum))}

    # Acting.

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""
        outputs = self.behaviour(task.id < state.num_tasks, *self.acting_inputs(state, memory, obs, task))
        return Acted(self.policy.draw(outputs, task.action_mask, key).action)

    def behaviour(self, trained: Array, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the outputs (2A,) of the policy that acts; ``trained`` () says whether the task was trained on."""
        return self.policy_outputs(nets, features, obs)

    # Losses of one task.

    def policy_outputs(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the policy's outputs (..., 2A)."""
        return self.actor.apply(nets["actor"], *self.actor_inputs(nets, features, obs))

    def sample(self, nets: Nets, batch: Batch, obs: Any, key: Key) -> Sample:
        """Sample the policy's actions at observations (B, O) of a batch."""
        action, _, log_prob = self.policy.draw(self.policy_outputs(nets, batch.features, obs), batch.mask, key)
        return Sample(action, log_prob, log_prob)

    def q(self, nets: Nets, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's outputs (N, B, outputs)."""
        return self.of_critics(self.critic.apply, nets, features, obs, action)

    def values(self, nets: Nets, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's estimate of the value (N, B)."""
        return self.value.mean(self.q(nets, features, obs, action))

    def of_critics(self, apply: Callable, nets: Nets, features: Array, obs: Any, action: Array) -> Any:
        """Apply ``apply``, a function with the signature of ``Network.apply``, to every critic: (N, ...)."""
        features, inputs = self.critic_inputs(nets, features, obs)
        return jax.vmap(apply, (0, None, None, None))(nets["critic"], features, inputs, action)

    def critic_target(self, nets: Nets, slow: Nets, batch: Batch, key: Key) -> Any:
        """Compute the critic target y (B, ...), in the form that ``value.loss`` takes."""
        action, _, cost = self.sample(nets, batch, batch.next_obs, key)
        return self.bootstrap(self.q(slow, batch.features, batch.next_obs, action), batch, cost)

    def bootstrap(self, outputs: Array, batch: Batch, cost: Array) -> Any:
        """Compute the critic target from the target critics' ``outputs`` (N, B, outputs) at the next states."""
        bonus = -batch.temperature * cost
        return self.value.target(outputs, self.critic_reduction == "min", batch.reward, batch.discount, bonus)

    def critic_loss(self, nets: Nets, batch: Batch, target: Any) -> tuple[Array, CriticAux]:
        return self.fitting_loss(self.q(nets, batch.features, batch.obs, batch.action), target, nets, batch)

    def fitting_loss(self, outputs: Array, target: Any, nets: Nets, batch: Batch) -> tuple[Array, CriticAux]:
        """Compute the critic loss of ``outputs`` (N, B, outputs) for a result of ``bootstrap``."""
        loss = jnp.mean(jnp.sum(self.value.loss(outputs, target), axis=0))
        values, expected = self.value.mean(outputs), self.value.expected(target)
        td_error = jnp.mean(jnp.abs(values - expected))
        metrics = {"critic_loss": loss, "value": jnp.mean(values), "td_error": td_error}
        known = batch._replace(features=self.know(nets, batch.features, batch.obs)[0])
        loss, metrics = self.representation.join(loss, metrics, nets["representation"], known)
        return loss, CriticAux(metrics, expected)

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        return self.policy_loss(self.sample(nets, batch, batch.obs, key), nets, batch)

    def policy_loss(self, sample: Sample, nets: Nets, batch: Batch) -> tuple[Array, ActorAux]:
        """Compute the actor loss of actions sampled at a batch's observations."""
        action, log_prob, cost = sample
        values = self.values(nets, batch.features, batch.obs, action)
        value = minimum(values) if self.critic_reduction == "min" else jnp.mean(values, axis=0)
        loss, entropy = jnp.mean(batch.temperature * cost - value), -jnp.mean(log_prob)
        return loss, ActorAux({"actor_loss": loss, "entropy": entropy}, entropy)

    def temperature_loss(self, temperature: Params, entropy: Array, action_size: int | Array) -> Array:
        """Compute the loss of all tasks' temperatures, by the entropies (T,) of their policies."""
        return jnp.mean(jnp.exp(temperature.parts["log"]) * (entropy - self.target_entropy * action_size))

    # Update of all tasks.

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take one gradient step on windows (T, B, L, ...) of the training tasks; metrics are (T,).

        Args:
            number: () how many updates came before; actor and temperatures learn at every ``policy_delay``-th.
        """
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        batch = self.prepare(state, window, tasks, jax.random.fold_in(key, 1))
        before = state.nets["representation"]
        importance = self.sampler.weights(state.nets["sampler"].own, batch.temperature)

        data, loss = self.critic_data(state, batch, target_key), self.above_least(self.critic_loss)
        state, fitted = self.descend(state, "critic", loss, data, critic_order, importance)
        state = with_statistics(state, "critic", fitted.aux.statistics)

        seen = {"representation": self.representation.for_actor(state.nets["representation"], before)}
        improve = lambda state: self.improve(state, batch, seen, actor_key, actor_order, importance)
        delay = self.experience.policy_delay
        if delay == 1:
            state, actor_metrics = improve(state)
        else:
            turn = (number + 1) % delay == 0
            state, actor_metrics = when(turn, improve, state)
            actor_metrics = Sometimes.over(actor_metrics, turn)

        state = self.renew_scales(self.update_target(state), fitted.aux.expected)
        return state, fitted.aux.metrics | actor_metrics | {"temperature": batch.temperature} | fitted.metrics

    def improve(
        self, state: AgentState, batch: Batch, seen: Nets, key: Key, order: Key, importance: Array | None
    ) -> tuple[AgentState, Metrics]:
        """Take one gradient step of the actor, and one of the temperatures.

        Args:
            seen: the networks that the actor's loss sees in place of the state's.
        """
        data = (batch, jax.random.split(key, len(batch.temperature)))
        state, improved = self.descend(state, "actor", self.actor_loss, data, order, importance, seen)
        state = with_statistics(state, "actor", improved.aux.statistics)
        return self.tune_temperature(state, improved.aux.entropy, batch), improved.aux.metrics | improved.metrics

    def tune_temperature(self, state: AgentState, entropy: Array, batch: Batch) -> AgentState:
        """Take one gradient step of the temperatures, by the entropies (T,) of the tasks' policies."""
        memory, action_size = state.fits["temperature"], action_sizes(batch.action, batch.mask)
        slope = jax.grad(self.temperature_loss)(state.nets["temperature"], entropy, action_size)
        nets, optimizer = self.fits["temperature"].descend(memory, {"temperature": slope}, state.nets)
        fits = state.fits | {"temperature": memory._replace(optimizer=optimizer)}
        return state._replace(nets=state.nets | nets, fits=fits)

    def transitions(self, window: Transition, tasks: Task) -> Transition:
        """Return the transitions (T, N, ...) that windows (T, B, L, ...) are made to: all steps, or one n-step each."""
        if self.unroll:
            return jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), window._replace(memory=None))
        return self.experience.joined(window, jnp.broadcast_to(self.discounts(tasks), len(tasks.id)))

    def prepare(self, state: AgentState, window: Transition, tasks: Task, key: Key | None = None) -> Batch:
        """Return the batch (T, ...) for the losses, of windows (T, B, L, ...).

        Args:
            key: for changing observations at random; None leaves them as they are.
        """
        batch, inputs = self.transitions(window, tasks), state.nets["inputs"]
        batch = batch if key is None else self.representation.augment(batch, key)
        past, next_past = self.around(window, batch, batch if batch.extras is None else batch.extras)
        action_size = action_sizes(batch.action, tasks.action_mask)
        temperature = jnp.exp(state.nets["temperature"].parts["log"])
        bonus = temperature * abs(self.target_entropy) * action_size / 2
        gamma = self.discounts(tasks)
        return Batch(
            obs=self.see_batch(inputs, batch.obs, past),
            action=batch.action,
            reward=self.scaling.rewards(state.nets["scaling"].own, batch, gamma, bonus),
            discount=(gamma[:, None] if jnp.ndim(gamma) else gamma) * batch.discount,  # type: ignore
            next_obs=self.see_batch(inputs, batch.next_obs, next_past),
            features=self.features_of_batch(state, batch, tasks),
            temperature=jnp.broadcast_to(temperature, len(tasks.id)),
            mask=tasks.action_mask,
            followed=pictures.followed(batch),
        )

    def critic_data(self, state: AgentState, batch: Batch, key: Key) -> tuple[Batch, Any]:
        """Return the data of the critics' loss for all tasks (T, ...): the batch, and the targets."""
        slow = state.nets | state.slow
        slow |= {"representation": slow["representation"].filled(state.nets["representation"])}
        of_both = (state.nets["representation"], slow["representation"])
        model_targets, keys = self.representation.targets(*of_both, batch.next_obs, key)
        bootstrap = jax.vmap(self.critic_target, (axes_of(state.nets), axes_of(slow), 0, 0))
        return batch._replace(model_targets=model_targets), bootstrap(state.nets, slow, batch, keys)

    def update_target(self, state: AgentState) -> AgentState:
        """Move the target critics, and their representation, a step towards the new ones."""

        def follow(net: str, new: dict, old: dict) -> dict:
            rates = self.representation.rates if net == "representation" else {}
            return {k: optax.incremental_update(new[k], old[k], rates.get(k, self.tau)) for k in old}

        moved = lambda net, new, old: Params(follow(net, new.shared, old.shared), follow(net, new.own, old.own))
        return state._replace(slow={net: moved(net, state.nets[net], old) for net, old in state.slow.items()})

    def renew_scales(self, state: AgentState, target: Array) -> AgentState:
        """Update the scaling of rewards by the critics' targets (T, B), and rescale critics to the new units."""
        critics = (state.nets["critic"], state.slow["critic"])
        scaling, (critic, slow) = self.scaling.renew(state.nets["scaling"].own, target, critics)
        nets = state.nets | {"scaling": Params({}, scaling), "critic": critic}
        return state._replace(nets=nets, slow=state.slow | {"critic": slow})


def with_statistics(state: AgentState, name: str, statistics: Any) -> AgentState:
    """Return a state with the running statistics that a loss found for the bodies of a network, if any."""
    net = state.nets[name]
    return state._replace(nets=state.nets | {name: net._replace(own=net.own | statistics)})


def action_sizes(action: Array, mask: Array | None) -> int | Array:
    """Count the actions that each task has: A for actions (..., A) without a mask (T, A), else (T,)."""
    return action.shape[-1] if mask is None else jnp.sum(mask, axis=-1)


def minimum(values: Array) -> Array:
    """Return the minimum (B,) of values (N, B), with a gradient that is always finite.

    The gradient of ``jnp.min`` looks for values that equal the minimum. Where XLA computes the values twice and rounds
    them differently it finds none, and the gradient is 0 / 0.
    """
    lowest = jnp.arange(len(values))[:, None] == jnp.argmin(values, axis=0)
    return jnp.sum(jnp.where(lowest, values, 0), axis=0)
