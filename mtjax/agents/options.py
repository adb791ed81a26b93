"""Options learn sub-policies that tasks share, when each ends, and which of them follows."""

import dataclasses
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import clipped_ratio, critics, parts
from mtjax.agents.base import Inputs, Memory, network_of
from mtjax.agents.beginning import Beginning
from mtjax.agents.fit import Fit
from mtjax.agents.hyperparameters import settings
from mtjax.agents.networks import Network
from mtjax.agents.on_policy import ActorAux, OnPolicy, limited, scale_head
from mtjax.agents.parts.policies.categorical import allowed
from mtjax.agents.sketches import Sketches, SubPolicies, lean_to_stop, with_lengths
from mtjax.agents.state import AgentState, Nets, over_tasks
from mtjax.experience.rollouts import played, windows
from mtjax.types import Acted, Array, Discrete, InputError, Key, Metrics, Spec, Task, Transition

NONE = -1
"""The number of the option that runs before the first one."""


class Running(NamedTuple):
    """Holds which option runs."""

    option: Array  # () int32
    lasts: Array  # () the probability with which it runs as long as it has


class Taken(NamedTuple):
    """Holds what is stored with an action when it is taken."""

    raw: Array  # the action as ``policy.log_prob`` takes it
    log_prob: Array  # () its log-probability under the sub-policy that took it
    before: Array  # () int32, the option that ran when the state was reached
    now: Running  # with the option that took the action
    chosen: Array  # () bool: this option was chosen here
    option_log_prob: Array  # () its log-probability under the policy over options


class Assessed(NamedTuple):
    """Holds what is stored with an action once the rollout is over."""

    taken: Taken
    advantage: Array  # () of the action in its option, normalised
    choice_advantage: Array  # () of the option, if it was chosen here
    end_loss: Array  # () what is lost where the option that ran before ends here
    value: Array  # () of the option before the update, in units of reward
    target: Array  # () what the critic's output for the option should be


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    taken: Taken  # leaves (B, ...)
    advantage: Array  # (B,) and so on, as ``Assessed`` has them
    choice_advantage: Array
    end_loss: Array
    value: Array
    target: Array
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all


class Values(NamedTuple):
    """Holds what is known of states (...) in units of reward."""

    options: Array  # (..., K) Q(s, o)
    state: Array  # (...) V(s)


def sub_policies(sketches: Sketches, spec: Spec) -> Beginning:
    """Return what options take of a run of sketches: the sub-policies of its symbols, for tasks without a sketch.

    Raises:
        InputError: it has no policies of symbols alone.
    """
    had, of_networks = settings(sketches), ("hidden", "actor_hidden", "actor_layer_norm", "encoder")
    for name, value in {"sharing": "symbols", "conditioning": "none"}.items():
        if had[name] != value:
            raise InputError(
                f"options begin from policies of symbols alone, and this run of sketches has {name}={had[name]}; take "
                f"one with {name}={value}"
            )
    asked = {name: had[name] for name in (*of_networks, *parts.setting_names(sketches.encoder))}
    asked |= {"endings": "stop", "num_options": spec.symbols, "normalize_observations": False}
    seen = jax.ShapeDtypeStruct((spec.obs_size - spec.symbols,), spec.obs.dtype)
    without = spec._replace(obs=seen, action=Discrete(spec.action_size - 1), symbols=0)
    return Beginning(("actor",), asked, without, "tasks of that world that follow no sketch, such as --env=craft")


@dataclasses.dataclass(frozen=True)
class Options(OnPolicy):
    """Options learn what the parts of tasks are: the option-critic (Bacon et al. 2017), by clipped steps.

    Tasks share K options. Option o plays its sub-policy pi_o(a|s), and in every next state ends with the probability
    beta_o(s). Where it ends, or an episode begins, the policy over options chooses with pi(o|s, i) for task i. Only
    that policy and the critic see the task. With the critic's Q(s, o, i), a cost c of ending an option (Harb et al.
    2018) and s', d and e as in PPO:
        V(s) = sum_o pi(o|s) Q(s, o)
        U(s', o) = (1 - beta_o(s')) Q(s', o) + beta_o(s') (V(s') - c)                (value upon arrival)
        delta_t = r_t + gamma d_t U(s'_t, o_t) - Q(s_t, o_t)
        A_t = delta_t + gamma lambda (1 - e_t) A_(t+1),    y_t = Q(s_t, o_t) + A_t
    and the three gradients of the return, with the option o that ran when s_t was reached:
        A_t grad log pi_(o_t)(a_t|s_t)                                               (intra-option)
        (y_t - V(s_t)) grad log pi(o_t|s_t), where o_t was chosen                    (of the policy over options)
        -(Q(s_t, o) - V(s_t) + c) grad beta_o(s_t)                                   (termination)
    The first two are clipped as PPO's. All three are divided by the standard deviation of A.

    With c = 0 nothing is lost by choosing anew in every step, and options may shrink to single actions.
    ``keep_options`` holds options as they are and learns to choose among them: to reuse on new tasks what a run has
    learned, give it with ``--from``.

    Without a key, so in evaluation, an option ends once it would have ended with a probability of one half.

    With ``endings=stop`` there are no terminations. A sub-policy has one output more, STOP, as those of ``sketches``
    have. Its outputs z_o(s) say both what it does and where it ends:
        beta_o(s) = softmax(z_o(s))_STOP,    pi_o(a|s) = softmax(z_o(s))_a / (1 - beta_o(s))
    Such options can begin from a run of ``sketches``, by ``--from``. Then option k is the sub-policy of symbol k, and a
    new task is learned without its sketch, with ``keep_options`` by choosing among the sub-policies alone (Andreas et
    al. 2017, adaptation). The policy over options and the critic begin anew.

    Differs from Bacon et al.: the policy over options is a softmax that learns, where there it is epsilon-greedy in Q;
    clipped steps over several epochs on advantages of whole rollouts replace single steps on one-step targets;
    networks share no layers. Tasks share options, where there one option-critic learns one task after another.
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        *OnPolicy.adjustable,
        *("clip_range", "deliberation_cost", "choice_entropy_cost", "keep_options"),
    )
    goes_on: ClassVar[bool] = True
    stand_in: ClassVar[str] = "each is played by the options that all tasks share"
    begins_from: ClassVar = MappingProxyType({Sketches: sub_policies})
    takes: ClassVar[str] = "observations of any tree of numbers and bools as one vector"
    hidden: tuple[int, ...] = (128,)
    actor_lr: float = 1e-3
    """Adam's learning rate for sub-policies, terminations and the policy over options."""
    clip_range: float = 0.2
    """Clip the ratios of policies to this distance from 1 (epsilon)."""
    advantage_normalization: clipped_ratio.Normalization = "task"
    """Scale advantages to mean 0 and standard deviation 1: never, over all tasks together, or in each task."""
    num_options: int = 8
    """Number of options (K)."""
    deliberation_cost: float = 0.01
    """What ending an option costs, in units of reward (c)."""
    endings: Literal["learned", "stop"] = "learned"
    """What ends an option: a termination of its own (learned), or a last output of its sub-policy (stop)."""
    choice_entropy_cost: float = 1e-2
    """Weight of the entropy of the policy over options in the actor loss, where it chooses."""
    end_bias: float = -2.0
    """Logit of an option's end at first. Below 0 options last longer."""
    keep_options: bool = False
    """Leave sub-policies and terminations as they are, and learn to choose among them."""

    losses = None

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "clip_range")
        parts.require_counts(self, "num_options")
        parts.require_not_negative(self, "deliberation_cost", "choice_entropy_cost")
        if self.representation.learns or self.representation.history or self.encoder.front() is not None:
            raise InputError("options share what they see; use representation=plain and another encoder")
        if self.encoder.needs_features:
            raise InputError("options do not see the task, by which this encoder works; use another encoder")

    # Networks.

    @property
    def actor(self) -> Network:
        """The sub-policies, and their terminations if they have any: a network for each option."""
        return super().actor.as_kind(SubPolicies, own=(), count=self.num_options)

    @property
    def critic_outputs(self) -> int:  # type: ignore[override]
        """The number of values of a state: one for each option."""
        return self.num_options

    @property
    def extra_outputs(self) -> int:  # type: ignore[override]
        """The number of outputs of sub-policies beside those for actions: STOP, if it ends them."""
        return int(self.endings == "stop")

    def init(self, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return the initial state. A curriculum by length gets to know the lengths of sketches, if tasks have any."""
        if self.endings == "stop" and not isinstance(spec.action, Discrete):
            raise InputError("endings=stop is one choice more beside discrete actions; use endings=learned")
        return with_lengths(self, super().init(spec, tasks, key), tasks)

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        due = with_due(inputs.actor[1], jnp.int32(0), self.num_options)
        of_options = inputs._replace(actor=(jnp.zeros(0), due))
        state = super().init_networks(state, of_options, key)
        end_key, choice_key = jax.random.split(jax.random.fold_in(key, 1))
        choice = chooser(self).init(choice_key, state.num_tasks, self.num_options, *inputs.actor)
        state = state.with_nets(over_options=scale_head(choice, jnp.zeros(self.num_options)))
        if self.endings == "stop":
            among = jnp.log(self.policy.outputs(len(inputs.action)))  # as likely as all actions together with bias 0
            return state.with_nets(actor=lean_to_stop(state.nets["actor"], among + self.end_bias))
        end = self.actor.init(end_key, state.num_tasks, 1, *of_options.actor)
        return state.with_nets(termination=scale_head(end, jnp.full(1, self.end_bias)))

    @property
    def fits(self) -> dict[str, Fit]:
        found = super().fits
        terminations = () if self.endings == "stop" else ("termination",)
        names = (*found["actor"].names, *terminations, "over_options")
        kept = {"actor", "termination"} if self.keep_options else set()
        learns = tuple(name for name in names if name not in kept)
        return found | {"actor": dataclasses.replace(found["actor"], names=learns)}

    # Acting.

    def begin(self, state: AgentState, task: Task) -> Memory:
        return super().begin(state, task)._replace(running=Running(jnp.int32(NONE), jnp.float32(1)))

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action for one observation (O,), and an option if none runs on; without a key, the likeliest."""
        nets, *view = self.view.acting(state, memory, obs, task)
        features, seen = self.view.actor_inputs(nets, *view)
        end_key, choice_key, action_key = (None,) * 3 if key is None else jax.random.split(key, 3)
        before, lasted = memory.running
        ends = ends_of(self, nets, seen, before, task.action_mask)
        lasts = lasted * (1 - ends)
        chosen = (before == NONE) | (lasts < 0.5 if end_key is None else jax.random.bernoulli(end_key, ends))
        logs = jax.nn.log_softmax(chooser(self).apply(nets["over_options"], features, seen))
        drawn = jnp.argmax(logs) if choice_key is None else jax.random.categorical(choice_key, logs)
        option = jnp.where(chosen, drawn, before).astype(jnp.int32)
        outputs = for_actions(self, nets, seen, option)
        action, raw, log_prob = self.policy.draw(outputs, task.action_mask, action_key)
        now = Running(option, jnp.where(chosen, 1.0, lasts))
        return Acted(action, Taken(raw, log_prob, before, now, chosen, at_option(logs, option)), outputs)

    def remember(self, state: AgentState, memory: Memory, transition: Transition, task: Task) -> Memory:
        taken = transition.extras
        if taken is None:  # a step from outside of a rollout, which was the likeliest
            taken = self.act(state, memory, transition.obs, task, None).extras
        return super().remember(state, memory, transition, task)._replace(running=taken.now)

    # Once for a rollout.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add advantages and targets to a rollout (T, H, E, ...), and fit the critic's units to it."""
        flat, features, obs, next_obs = self.view.steps(state, windows(steps, self.unroll), tasks)
        taken, of_tasks = flat.extras, partial(values_of, self, state)
        here, then = of_tasks(features, obs), of_tasks(features, next_obs)
        there = features, next_obs, taken.now.option, tasks.action_mask
        ends = over_tasks(partial(ending, self), state.nets, *there)
        upon = arrival(then, taken.now.option, ends, self.deliberation_cost)
        in_order = partial(played, shape=steps.reward.shape, length=self.unroll)
        of_chosen, reward = at_option(here.options, taken.now.option), critics.rewards(self, state, flat, tasks)
        known = of_chosen, upon, reward, here.state, at_option(here.options, taken.before)
        value, next_value, reward, of_state, of_before = map(in_order, known)
        advantage = clipped_ratio.gae(self, tasks, steps._replace(reward=reward), value, next_value)
        target = value + advantage
        state, units = critics.renew(self, state, target)
        mean, spread = clipped_ratio.moments(self.advantage_normalization, advantage)
        found = Assessed(
            taken=steps.extras,
            advantage=(advantage - mean) / spread,
            choice_advantage=(target - of_state) / spread,
            end_loss=(of_before - of_state + self.deliberation_cost) / spread,
            value=value,
            target=units.outputs(target),
        )
        return state, steps._replace(extras=found)

    # Losses of one task.

    def output(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the critic's outputs (B, K) for observations (B, ...)."""
        return self.critic.apply(nets["critic"], *self.view.critic_inputs(nets, features, obs))

    gain = clipped_ratio.gain

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:  # type: ignore[override]
        _, seen = self.view.actor_inputs(nets, batch.features, batch.obs)
        taken, option = batch.taken, batch.taken.now.option
        outputs = for_actions(self, nets, seen, option)
        log_ratio = limited(self.policy.log_prob(outputs, taken.raw, batch.mask) - taken.log_prob)
        gain, metrics = clipped_ratio.gain(self, log_ratio, batch)
        entropy = jnp.mean(self.policy.entropy(outputs, batch.mask, key))

        logs = jax.nn.log_softmax(option_logits(self, nets, batch.features, batch.obs))
        option_ratio = limited(at_option(logs, option) - taken.option_log_prob)
        choice, _ = clipped_ratio.gain(self, option_ratio, batch._replace(advantage=batch.choice_advantage))
        doubt = -jnp.sum(jnp.exp(logs) * logs, axis=-1)

        ends = ends_of(self, nets, seen, taken.before, batch.mask)
        runs = taken.before != NONE
        loss = (
            jnp.mean(runs * ends * batch.end_loss)
            - jnp.mean(gain)
            - jnp.mean(taken.chosen * (choice + self.choice_entropy_cost * doubt))
            - self.entropy_cost * entropy
        )
        kl = jnp.mean(jnp.exp(log_ratio) - 1 - log_ratio)
        told = {"actor_loss": loss, "entropy": entropy, "kl": kl, **metrics}
        told |= {"option_ends": jnp.sum(runs * ends) / jnp.maximum(jnp.sum(runs), 1)}
        return loss, ActorAux(told, kl)

    def critic_loss(self, nets: Nets, batch: Batch) -> tuple[Array, Metrics]:  # type: ignore[override]
        output = at_option(self.output(nets, batch.features, batch.obs), batch.taken.now.option)
        loss = self.fitting_loss(output, batch)  # type: ignore[arg-type]
        return self.view.join(loss, {"critic_loss": loss}, nets, batch)

    def prepare(self, state: AgentState, window: Transition, tasks: Task) -> tuple[AgentState, Batch]:  # type: ignore
        flat, features, obs, _ = self.view.steps(state, window, tasks)
        return state, Batch(obs=obs, features=features, mask=tasks.action_mask, **flat.extras._asdict())


def chooser(agent: Options) -> Network:
    """Return the network of the policy over options."""
    return network_of(agent, "actor")


def with_due(seen: Array, option: Array, count: int) -> Array:
    """Return inputs (..., O) with the option that is due (...), one-hot, at their end, as sub-policies take them."""
    return jnp.concatenate([seen, jax.nn.one_hot(option, count)], axis=-1)


def at_option(values: Array, option: Array) -> Array:
    """Return those of values (..., K) that are of options (...); 0 for no option."""
    return jnp.sum(values * jax.nn.one_hot(option, values.shape[-1]), axis=-1)


def arrival(values: Values, option: Array, ends: Array, cost: float | Array) -> Array:
    """Return the value (...) of coming to states with options (...), which end there with probabilities (...)."""
    return (1 - ends) * at_option(values.options, option) + ends * (values.state - cost)


def of_option(agent: Options, net: Any, seen: Array, option: Array) -> Array:
    """Return the outputs (..., P) of sub-policies or of terminations for inputs (..., O); 0 for no option."""
    return agent.actor.apply(net, jnp.zeros(0), with_due(seen, option, agent.num_options))


def for_actions(agent: Options, nets: Nets, seen: Array, option: Array) -> Array:
    """Return those outputs (..., P) of sub-policies for inputs (..., O) that the policy reads: all but STOP."""
    outputs = of_option(agent, nets["actor"], seen, option)
    return outputs[..., :-1] if agent.endings == "stop" else outputs


def ends_of(agent: Options, nets: Nets, seen: Array, option: Array, mask: Array | None) -> Array:
    """Return the probabilities (...) with which options (...) end for inputs (..., O); any number for no option."""
    if agent.endings == "learned":
        return jax.nn.sigmoid(of_option(agent, nets["termination"], seen, option)[..., 0])
    outputs = of_option(agent, nets["actor"], seen, option)
    return jax.nn.sigmoid(outputs[..., -1] - jax.nn.logsumexp(allowed(outputs[..., :-1], mask), axis=-1))


def values_of(agent: Options, state: AgentState, features: Array, obs: Any) -> Values:
    """Return the values of observations (T, B, ...) in units of reward."""
    q = critics.values(agent, state, features, obs)
    over = over_tasks(partial(option_logits, agent), state.nets, features, obs)
    return Values(q, jnp.sum(jax.nn.softmax(over) * q, axis=-1))


def option_logits(agent: Options, nets: Nets, features: Array, obs: Any) -> Array:
    """Return the logits (B, K) of the policy over options."""
    return chooser(agent).apply(nets["over_options"], *agent.view.actor_inputs(nets, features, obs))


def ending(agent: Options, nets: Nets, features: Array, obs: Any, option: Array, mask: Array | None = None) -> Array:
    """Return the probabilities (B,) with which options (B,) end; any number for no option."""
    _, seen = agent.view.actor_inputs(nets, features, obs)
    return ends_of(agent, nets, seen, option, mask)
