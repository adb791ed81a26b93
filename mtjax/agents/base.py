"""``BaseAgent`` holds what all agents share: conditioning on the task, normalisation and the parts of an agent."""

import abc
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import tyro

from mtjax import frames
from mtjax.agents import normalize, parts
from mtjax.agents.choices import FLAT, PARTS, kinds_of
from mtjax.agents.fit import Fit, Fitted, learned
from mtjax.agents.parts.encoders import Encoder
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.parts.knowing import Knowing, last_steps
from mtjax.agents.parts.knowing.last_steps import Past, Seen, without_past
from mtjax.agents.parts.knowing.recurrent import Following, Hidden, track
from mtjax.agents.parts.policies import Gaussian, Policy, policy_for
from mtjax.agents.parts.representations import REPRESENTATIONS, Representation
from mtjax.agents.parts.samplers import Sampler
from mtjax.agents.parts.scaling import SCALINGS, Scaling
from mtjax.agents.state import AgentState, Nets, of_task
from mtjax.checks import require_values
from mtjax.experience import Replay
from mtjax.networks import OVER_TASKS, Network, Params
from mtjax.parallel import collectives
from mtjax.parallel.collectives import mean_and_variance
from mtjax.tasks import SAME_CONTEXT
from mtjax.types import (
    Acted,
    Array,
    Continuous,
    Discrete,
    Env,
    InputError,
    Key,
    Metrics,
    Spec,
    Task,
    Transition,
)

Heads = Literal["shared", "per-task", "disjoint"]
Tune = Literal["all", "heads", "embedding"]


class Memory(NamedTuple):
    """Holds what an agent remembers of an episode."""

    past: Past | None  # the last steps, if the agent infers the task from them
    hidden: Any = None  # the hidden state of a recurrent way to know the task
    scaling: Any = None  # of the scaling of rewards
    sampler: Any = None  # of the sampler of tasks


@dataclasses.dataclass(frozen=True)
class BaseAgent(abc.ABC):
    """Provides the settings and methods of every agent; a subclass adds networks, losses and updates.

    The networks of every agent, by name:
        actor, critic: what learns, beside the nets of a subclass.
        representation: of observations. The critics' loss trains it.
        knowing: of the task, which the critics' loss trains too.
        tasks: what is known of the training tasks: their contexts (T, C), and given vectors (T, V), if any.
        inputs: the moments of observations; in a mixture one for each task, leaves (T, O).
        scaling, sampler: the memories of the scaling of rewards and of the sampler of tasks.
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        "actor_lr",
        "critic_lr",
        "lr_schedule",
        "lr_final",
        "lr_warmup",
        "lr_updates",
        "weight_decay",
        "max_gradient_norm",
        "gamma",
        "vectors",
        "tune",
        "context_limit",
    )
    """Settings that fine-tuning may change: they say how an agent learns, not what its networks are."""
    devices_differ: ClassVar[bool] = False
    """Whether devices that share a seed learn from other data each; with a replay all learn from the same."""
    common_presets: ClassVar[bool] = True
    """Whether the tables of presets that name no agent hold for it. They are tuned for learning from replay."""
    policies: ClassVar[tuple[type[Policy], ...]] = (Gaussian,)
    """The kinds of policies with which the agent can learn."""
    fits_statistics: ClassVar[bool] = False
    """Whether learning keeps the running statistics of bodies with batch normalisation."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers in actor and critics."""
    actor_hidden: tuple[int, ...] = ()
    """Widths of the actor's hidden layers; without any they are those of hidden."""
    critic_hidden: tuple[int, ...] = ()
    """Widths of the critics' hidden layers; without any they are those of hidden."""
    actor_lr: float = 1e-3
    """Adam's learning rate for the actor."""
    critic_lr: float = 1e-3
    """Adam's learning rate for the critics."""
    lr_schedule: descent.Shape = "constant"
    """Keep all learning rates (constant), or let them fall over the run along a line or half a cosine. A run that is
    resumed with more --steps goes on along the schedule of a run of that length, so that rates rise at once."""
    lr_final: float = 0.0
    """Share of the learning rates that a schedule leaves at the end."""
    lr_warmup: int = 0
    """Updates of the critics over which the learning rates rise from 0, at first and after a reset."""
    lr_updates: int = 0
    """Updates of the critics after which the learning rates stay at their last values; 0 means the end of the run."""
    weight_decay: float = 0.0
    """Decoupled weight decay of actor and critics (AdamW)."""
    gamma: float = 0.99
    """Discount of rewards per step."""
    discounting: Literal["gamma", "horizon"] = "gamma"
    """Discount every task by gamma, or each by its own horizon h: 1 - 5 / h, kept in [0.95, 0.995]."""
    normalize_observations: bool = False
    """Scale observations to mean 0 and variance 1, by moments of training data alone, and clip them to +-10."""
    max_gradient_norm: float = 0.0
    """Clip the global norms of actor and critic gradients to this; 0 does not clip."""
    critic_layer_norm: bool = True
    """Use layer normalisation in the critics."""
    actor_layer_norm: bool = False
    """Use layer normalisation in the actor."""
    heads: Heads = "shared"
    """What each task has for itself: nothing (shared), output layers (per-task) or whole networks (disjoint)."""
    gradient_scope: Literal["shared", "per-layer"] = "shared"
    """Weigh the tasks' gradients once for all shared parameters, or separately in each layer."""
    tune: Annotated[Tune, tyro.conf.arg(name="tune", prefix_name=False)] = "all"
    """Which parameters of actor and critics learn: all, heads (output layers) or embedding (learned task embeddings).
    The others keep their values from the run that --from names."""
    conditioning: Annotated[Knowing, FLAT] = dataclasses.field(default_factory=Knowing)
    representation: Annotated[Representation, FLAT] = dataclasses.field(default_factory=Representation)
    encoder: Annotated[Encoder, FLAT] = dataclasses.field(default_factory=Encoder)
    gradients: Annotated[surgery.Rule, FLAT] = dataclasses.field(default_factory=surgery.Rule)
    scaling: Annotated[Scaling, FLAT] = dataclasses.field(default_factory=Scaling)
    sampler: Annotated[Sampler, FLAT] = dataclasses.field(default_factory=Sampler)
    experience: Annotated[Any, FLAT] = dataclasses.field(default_factory=Replay)
    policy: Annotated[Policy, tyro.conf.Suppress] = dataclasses.field(
        default=Gaussian(), repr=False, metadata=parts.NO_SETTING
    )
    """How the actor's outputs become actions. It follows from the environment."""

    def __post_init__(self):
        for kind in kinds_of(self):
            object.__setattr__(self, kind, parts.choose(kind, PARTS[kind], getattr(self, kind)))
        parts.require_choices(self)
        for holder in (self, *(getattr(self, kind) for kind in kinds_of(self))):
            require_values(holder)
        self._check_numbers()
        self._check_combination()

    @abc.abstractmethod
    def init_networks(self, num_tasks: int, actor_inputs: tuple, critic_inputs: tuple, action: Array, key: Key) -> Nets:
        """Initialise actor, critics, and what else the agent has.

        Args:
            actor_inputs, critic_inputs: features (Z,) and an observation (O,) of these shapes.
            action: (A,).
        """

    @abc.abstractmethod
    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""

    @abc.abstractmethod
    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take one gradient step on windows (T, B, L, ...) of the training tasks; metrics are (T,).

        Args:
            number: () how many updates came before.
        """

    # Settings that cannot be used.

    def _check_numbers(self) -> None:
        parts.require_positive(self, "actor_lr", "critic_lr")
        if not self.max_gradient_norm >= 0:
            raise InputError(f"max-gradient-norm must be at least 0 (0 does not clip), not {self.max_gradient_norm}")
        parts.require_not_negative(self, "weight_decay", "lr_warmup", "lr_updates")
        parts.require_layers(self, "hidden")
        parts.require_widths(self, "actor_hidden", "critic_hidden")
        parts.require_shares(self, "gamma", "lr_final")

    def _check_combination(self) -> None:
        """Refuse parts that do not go together."""
        encoder, rule = (parts.name_of(PARTS[kind], getattr(self, kind)) for kind in ("encoder", "gradients"))
        reason = self.conditioning.refuses()
        if reason:
            raise InputError(reason)
        if self.tune == "embedding" and not (self.conditioning.embeds or self.representation.embeds):
            given = parts.name_of(PARTS["conditioning"], self.conditioning)
            raise InputError(f"tune=embedding needs conditioning=embedding, not {given}")
        reason = self.encoder.refuses(self.conditioning, self.representation.embeds)
        if reason:
            raise InputError(f"{encoder} {reason}")
        if self.encoder.has_statistics and not self.fits_statistics:
            raise InputError(
                f"{encoder} needs an agent that keeps running statistics, such as xqc; use another encoder"
            )
        if self.representation.sees_pictures and self.encoder.front() is not None:
            name = parts.name_of(REPRESENTATIONS, self.representation)
            raise InputError(
                f"{encoder} maps observations, and with representation={name} networks see a latent state; "
                "choose another encoder"
            )
        for hidden in (self.actor_widths, self.critic_widths):
            self.encoder.body(hidden, layer_norm=False)  # which refuses widths that it cannot take
        if self.heads == "disjoint" and rule != "mean":
            raise InputError(f"heads=disjoint leaves no parameters that tasks share for gradients={rule}; use mean")
        if self.gradient_scope == "per-layer" and self.gradients.needs != "gradients":
            raise InputError(f"gradient-scope=per-layer needs gradients of every task, which {rule} does not use")
        if parts.name_of(SCALINGS, self.scaling) == "return" and self.gamma == 1:
            raise InputError("scaling=return needs discounted returns, which have bounds; use gamma below 1")
        if self.scaling.follows_resets and not self.experience.reset_every:
            name = parts.name_of(SCALINGS, self.scaling)
            raise InputError(
                f"scaling={name} renews its factors where networks are reset, and here none are; use scaling=reward, "
                "or give reset-every to an agent that has a replay"
            )
        lengths = self.conditioning.history, self.representation.history
        if all(lengths) and len(set(lengths)) > 1:
            raise InputError(
                f"inferred-from={lengths[0]} and theta-from={lengths[1]} are numbers of the same last steps; give both "
                "one value"
            )
        if self.conditioning.recurs and self.representation.history:
            raise InputError("conditioning=recurrent and theta-from are two memories of an episode; use one of them")
        if self.lr_schedule == "constant" and (self.lr_final or self.lr_updates):
            given = f"lr-final={self.lr_final}" if self.lr_final else f"lr-updates={self.lr_updates}"
            raise InputError(
                f"{given} is where a schedule ends, and lr-schedule=constant is none; use linear or cosine"
            )
        if self.lr_schedule != "constant" and self.experience.reset_every:
            raise InputError(
                f"reset-every begins the optimisers anew, and lr-schedule={self.lr_schedule} with them; use constant"
            )

    def require_sight(self, spec: Spec) -> None:
        """Check that networks and representation can take a family's observations.

        Raises:
            InputError: they cannot, or tasks would have to be inferred from pictures.
        """
        frames.require_known(spec.obs)
        self.representation.require(spec.obs)
        if frames.shown(spec.obs) and self.history_length:
            raise InputError("tasks cannot be inferred from pictures; choose another conditioning")
        if frames.shown(spec.obs) and self.conditioning.recurs:
            raise InputError("conditioning=recurrent reads vectors, not pictures; choose another conditioning")

    def for_action(self, action: Continuous | Discrete) -> Self:
        """Return the agent with the policy for such actions, which are those of its environment."""
        return dataclasses.replace(self, policy=policy_for(action))

    def require_policy(self, spec: Spec) -> None:
        """Check that the agent was made for a family's actions, and can learn to draw them.

        Raises:
            InputError: it was not, or cannot.
        """
        policy, kind, name = policy_for(spec.action), spec.action.kind, type(self).__name__
        if not isinstance(policy, self.policies):
            raise InputError(f"{name} draws no {kind} actions")
        if self.policy != policy:
            raise InputError(f"{name} was not made for these {kind} actions: agent.for_action(env.spec.action) is")

    # Networks.

    def network(self, hidden: tuple[int, ...], layer_norm: bool) -> Network:
        """Return a network of the body and heads that the settings ask for."""
        own = {"shared": (), "per-task": ("head",), "disjoint": ("sight", "body", "head")}[self.heads]
        front = None if self.representation.learns else self.encoder.front()
        return Network(self.encoder.body(hidden, layer_norm), own, front)

    @property
    def actor_widths(self) -> tuple[int, ...]:
        """Widths of the hidden layers in the actor."""
        return self.actor_hidden or self.hidden

    @property
    def critic_widths(self) -> tuple[int, ...]:
        """Widths of the hidden layers in the critics."""
        return self.critic_hidden or self.hidden

    @property
    def actor(self) -> Network:
        network = self.network(self.actor_widths, self.actor_layer_norm)
        return dataclasses.replace(network, sight=self.representation.sight)

    @property
    def critic(self) -> Network:
        return self.network(self.critic_widths, self.critic_layer_norm)

    @property
    def knows_apart(self) -> bool:
        """Whether every task has networks of its own by which it is known."""
        return self.heads == "disjoint"

    def know(self, nets: Nets, given: Array, seen: Any) -> tuple[Array, Any]:
        """Return the features (Z,) or (..., Z) of one task, and observations (..., O) without the last steps.

        Args:
            given: features that need no learned parameters, (Z,) or (..., Z).
            seen: observations as networks take them, with the last steps if features are made of these.
        """
        return self.conditioning.features(nets["knowing"].parts, given, seen), without_past(seen)

    def actor_inputs(self, nets: Nets, given: Array, seen: Any) -> tuple[Array, Any]:
        """Return features (Z,) and inputs (..., O) of one task's actor, from what ``know`` takes."""
        return self.representation.actor_inputs(nets["representation"], *self.know(nets, given, seen))

    def critic_inputs(self, nets: Nets, given: Array, seen: Any) -> tuple[Array, Any]:
        """Return features (Z,) and inputs (..., O) of one task's critics, from what ``know`` takes."""
        return self.representation.perceive(nets["representation"], *self.know(nets, given, seen))

    @property
    def fits(self) -> dict[str, Fit]:
        """The gradient steps of the agent, by name: which networks learn together, and how."""
        adam = partial(descent.adam, weight_decay=self.weight_decay, max_norm=self.max_gradient_norm, tune=self.tune)
        actor = adam(self.scheduled(self.actor_lr, self.experience.policy_delay))
        critic = adam(self.scheduled(self.critic_lr))
        fit = partial(Fit, per_layer=self.gradient_scope == "per-layer", over_devices=self.devices_differ)
        return {
            "critic": fit(("critic", "representation", "knowing"), critic, self.gradients),
            "actor": fit(("actor",), actor, self.gradients.for_actor),
        }

    def scheduled(self, rate: Any, delay: int = 1) -> Any:
        """Return a learning rate, or its schedule, for parameters that learn at every ``delay``-th update."""
        if self.lr_schedule == "constant" and not self.lr_warmup:
            return rate
        updates = self.lr_warmup / delay, self.lr_updates / delay
        return descent.schedule(rate, self.lr_schedule, self.lr_final, *updates)

    def planned(self, steps: int) -> Self:
        """Return the agent with its schedule spread over a run of so many steps of every environment.

        Raises:
            InputError: the run ends before the schedule's warm-up does.
        """
        if self.lr_schedule == "constant":
            return self
        updates = self.lr_updates or self.updates_in(steps)
        if updates <= self.lr_warmup:
            left = f"none of the run's {updates} updates to lr-schedule={self.lr_schedule}"
            raise InputError(f"lr-warmup={self.lr_warmup} leaves {left}")
        return dataclasses.replace(self, lr_updates=updates)

    def updates_in(self, steps: int) -> int:
        """Count the critics' updates in a run of so many steps of every environment."""
        return self.experience.updates_in(steps)

    def init(self, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return the initial state for the training ``tasks`` (T, ...)."""
        self.require_sight(spec)
        self.require_policy(spec)
        num_tasks, vectors = len(tasks.id), self.conditioning.table(spec, len(tasks.id))
        inputs, action = self.init_inputs(spec, num_tasks), spec.action.encode(spec.action.blank())
        seen, first = self.example(spec, inputs), jax.tree.map(lambda x: x[0], tasks._replace(blocks=None))
        given = self.conditioning.given(jnp.int32(0), first, num_tasks, vectors)
        knowing = self.conditioning.init(num_tasks, seen, action, self.knows_apart, jax.random.fold_in(key, 1))
        nets = {
            "tasks": Params({} if vectors is None else {"vectors": vectors}, {"context": tasks.context}),
            "inputs": inputs,
            "knowing": knowing,
            "scaling": Params({}, self.scaling.init(num_tasks)),
            "sampler": Params({}, self.sampler.init(num_tasks)),
        }
        known = self.know({"knowing": knowing.of_first()}, given, seen)
        own = self.heads == "disjoint"
        nets["representation"], key = self.representation.init(num_tasks, *known, seen, action, own, key)
        one = {name: net.of_first() for name, net in nets.items()}
        shapes = self.actor_inputs(one, given, seen), self.critic_inputs(one, given, seen)
        nets |= self.init_networks(num_tasks, *shapes, action, key)
        fits = {name: fit.init(nets, num_tasks) for name, fit in self.fits.items()}
        return AgentState(nets, self.init_slow(nets), fits)

    def init_slow(self, nets: Nets) -> Nets:
        """Return the slow copies of networks; none by default."""
        return {}

    def reset_networks(self, state: AgentState, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return a state in which all that some fit trains begins anew; what is counted is kept."""
        fresh = self.init(spec, tasks, key)
        nets = {name: fresh.nets[name] for name in learned(self.fits.values())}
        nets |= {"scaling": Params({}, self.scaling.reset(state.nets["scaling"].own))}
        return fresh._replace(nets=state.nets | nets)

    # Inputs of the networks: observations, and features of the task.

    @property
    def history_length(self) -> int:
        """Number of past steps that the networks take beside each observation."""
        return self.conditioning.history or self.representation.history

    def init_inputs(self, spec: Spec, num_tasks: int) -> Params:
        """Return moments of no observations; in a mixture each task has its own, leaves (T, O)."""
        moments = normalize.init(max(frames.state_size(spec), 1))  # checkpoints hold no empty arrays
        if not spec.mixed:
            return Params({"moments": moments}, {})
        return Params({}, {"moments": jax.tree.map(lambda x: jnp.stack([x] * num_tasks), moments)})

    def fit_inputs(self, inputs: Params, obs: Any) -> Params:
        """Add the vectors (T, ..., O) in observations to the moments, with those on other devices."""
        found = frames.state(obs)
        if not self.normalize_observations or found is None:
            return inputs
        moments, mixed = inputs.parts["moments"], bool(inputs.own)
        found = found.reshape(len(found), -1, found.shape[-1])
        count = (found.shape[1] if mixed else found.shape[0] * found.shape[1]) * collectives.count()
        mean, variance = (x.reshape(moments.mean.shape) for x in mean_and_variance(found, 1 if mixed else (0, 1)))
        one = normalize.Moments(jnp.full_like(moments.count, count), mean, count * variance)
        if mixed:
            return Params({}, {"moments": jax.vmap(normalize.merge)(moments, one)})
        return Params({"moments": normalize.merge(moments, one)}, {})

    def see(self, inputs: Params, obs: Array, past: Any = None) -> Any:
        """Return observations (..., O) of one task as networks take them: normalised, and with the past if given."""
        scale = partial(normalize.apply, inputs.parts["moments"]) if self.normalize_observations else lambda x: x
        scaled = lambda obs: frames.with_state(scale, obs)
        if past is None:
            return scaled(obs)
        if "obs" in past._fields:
            past = past._replace(obs=scaled(past.obs), action=self.policy.encode(past.action))
        return Seen(scaled(obs), past)

    def see_batch(self, inputs: Params, obs: Array, past: Any = None) -> Any:
        """Return observations (T, B, O) of all training tasks as networks take them."""
        return jax.vmap(self.see, (OVER_TASKS, 0, 0))(inputs, obs, past) if inputs.own else self.see(inputs, obs, past)

    def example(self, spec: Spec, inputs: Params) -> Any:
        """Return an input of networks that is all zero."""
        past = Hidden(self.conditioning.begin()) if self.conditioning.recurs else None
        if self.history_length:
            past = last_steps.begin(self.history_length, spec.obs_size, spec.action.blank())
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), frames.seen(spec))
        return self.see(inputs.of_first(), zeros, past)

    def known_task(self, state: AgentState, task: Task) -> Array:
        """Return the number () int32 of ``task`` if it is a training task, else of the nearest training task.

        Of training tasks that are equally near, up to rounding, it is the lowest number.
        """
        contexts = state.nets["tasks"].own["context"]
        distance = jnp.sqrt(jnp.sum(jnp.square(contexts - task.context), axis=-1))
        if task.blocks is not None:  # only a task of the same family can be nearest
            distance = jnp.where(task.blocks.related(contexts, task.context), distance, jnp.inf)
        nearest = jnp.argmax(distance <= jnp.min(distance) + 2 * SAME_CONTEXT).astype(jnp.int32)
        return jnp.where(task.id < len(contexts), task.id, nearest)

    def nearest_tasks(self, state: AgentState, tasks: Task) -> Array:
        """Return the training tasks (T,) nearest to ``tasks`` (T, ...), for training tasks too by their contexts."""
        unseen = tasks._replace(id=jnp.full_like(tasks.id, state.num_tasks))
        return jax.vmap(partial(self.known_task, state))(unseen)

    def features(self, state: AgentState, task: Task) -> Array:
        """Return those features (Z,) of one task that need no learned parameters."""
        vectors = state.nets["tasks"].shared.get("vectors")
        return self.conditioning.given(self.known_task(state, task), task, state.num_tasks, vectors)

    def features_of_batch(self, state: AgentState, batch: Transition, tasks: Task) -> Array:
        """Return these features of a batch's tasks: (T, Z), or (T, B, Z) where each episode has its own."""
        if batch.context is not None and self.conditioning.by_parameters:
            of_episode = lambda task, context: self.features(state, task._replace(context=context))
            return jax.vmap(jax.vmap(of_episode, (None, 0)))(tasks, batch.context)
        return jax.vmap(partial(self.features, state))(tasks)

    def acting_inputs(self, state: AgentState, memory: Memory, obs: Any, task: Task) -> tuple[Nets, Array, Any]:
        """Return what one task needs to act: its networks, its features (Z,) and the observation (O,) as input."""
        nets = of_task(state.nets, self.known_task(state, task))
        past = memory.past if memory.hidden is None else Hidden(memory.hidden)
        inputs, of_all = self.see(nets["inputs"], obs, past), state.nets["representation"]
        trained = task.id < state.num_tasks
        own = self.representation.stand_in(nets["representation"], of_all, trained, inputs)
        return nets | {"representation": own}, self.features(state, task), inputs

    def discounts(self, tasks: Task) -> float | Array:
        """Return the discount of each task (T,), or one for all."""
        if self.discounting == "gamma":
            return self.gamma
        return jnp.clip(1 - 5 / tasks.horizon, 0.95, 0.995)

    @property
    def borrowed(self) -> list[str]:
        """Names of what a task that was not trained on uses of its nearest training task."""
        found = {"shared": [], "per-task": ["head"], "disjoint": ["networks"]}[self.heads]
        found += ["input layer"] * (self.encoder.front() is not None) + ["statistics"] * self.encoder.has_statistics
        return [*found, *self.conditioning.borrowed, *self.representation.borrowed]

    @property
    def unseen(self) -> str:
        """A sentence on what stands in for unseen tasks; empty if nothing has to."""
        borrowed, replaced = " and ".join(self.borrowed), self.representation.replaced
        texts = (f"each uses the {borrowed} of the nearest training task", f"each has {replaced}")
        return ", and ".join(text for text, present in zip(texts, (borrowed, replaced), strict=True) if present)

    # Memory of an episode, and statistics of all episodes.

    def begin(self, state: AgentState, task: Task) -> Memory:
        """Return the memory with which an episode begins."""
        past = None
        if self.history_length:
            moments = state.nets["inputs"].parts["moments"]
            past = last_steps.begin(self.history_length, moments.mean.shape[-1], self.blank_action(state))
        return Memory(past, self.conditioning.begin(), self.scaling.begin(), self.sampler.begin())

    def blank_action(self, state: AgentState) -> Array:
        """Return an action that is all zero; the size of the actor's head tells its size."""
        return self.policy.blank(state.nets["actor"].parts["head"]["bias"].shape[-1])

    def remember(self, state: AgentState, memory: Memory, transition: Transition, task: Task) -> Memory:
        """Return the memory after a step."""
        past, hidden = memory.past, memory.hidden
        if past is not None:
            past = last_steps.append(past, transition.obs, transition.action, transition.reward)
        if hidden is not None:
            nets = of_task(state.nets, self.known_task(state, task))
            action = self.policy.encode(transition.action)
            seen = transition._replace(obs=self.see(nets["inputs"], transition.obs), action=action)
            hidden = self.conditioning.remember(nets["knowing"].parts, hidden, seen)
        reward, gamma = transition.reward, self.discounts(task)
        counts = (part.remember(memory_of, reward, gamma) for part, memory_of in self._watchers(memory))
        return Memory(past, hidden, *counts)

    def _watchers(self, memory: Memory) -> tuple[tuple[parts.Watcher, Any], ...]:
        return (self.scaling, memory.scaling), (self.sampler, memory.sampler)

    def relabel(self, env: Env, task: Task, transition: Transition, key: Key) -> Transition:
        """Return a transition of another task as it would have been in ``task``; its past steps change too."""
        one = lambda transition: env.relabel(task, transition, key)  # type: ignore
        past = getattr(transition.memory, "past", None)
        return one(transition) if past is None else last_steps.relabel(one, transition)

    def inputs(self, state: AgentState, window: Transition, tasks: Task) -> tuple[Transition, Array, Any, Any]:
        """Return the steps (T, B L, ...) of windows (T, B, L, ...), with features, observations and next ones."""
        flat = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), window)
        see, (past, next_past) = partial(self.see_batch, state.nets["inputs"]), self.around(window, flat, flat)
        return flat, self.features_of_batch(state, flat, tasks), see(flat.obs, past), see(flat.next_obs, next_past)

    # Learning.

    @property
    def unroll(self) -> int:
        """Steps L of the windows through which a memory learns; 0 if none does."""
        return self.conditioning.recurrent_steps if self.conditioning.recurs else 0  # type: ignore

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Compute what has to be known of collected steps (T, H, E, ...) before the agent learns from them: nothing."""
        return state, steps

    def observe(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        """Count collected steps (T, H, E, ...), after learning: moments of observations, scaling and sampler."""
        gamma = jnp.broadcast_to(self.discounts(tasks), len(tasks.id))[:, None]
        told = Transition(None, None, steps.reward, steps.discount, None, None, steps.closed, memory=steps.memory)  # type: ignore
        told = told._replace(memory=steps.memory._replace(past=None, hidden=None))
        told = jax.tree.map(lambda x: x.reshape(len(x), -1), collectives.whole(told, axis=2))
        new = {"inputs": self.fit_inputs(state.nets["inputs"], steps.obs)}
        for name, (part, before) in zip(("scaling", "sampler"), self._watchers(told.memory), strict=True):
            after = told._replace(memory=part.remember(before, told.reward, gamma))
            new[name] = Params({}, part.observe(state.nets[name].own, after))
        return state._replace(nets=state.nets | new)

    def around(self, window: Transition, first: Transition, last: Transition) -> tuple[Any, Any]:
        """Return what networks take of the steps before observations, and before the next ones; None for nothing.

        Args:
            window: (T, B, L, ...).
            first, last: the first and the last steps (T, N, ...) of the transitions that are made of it.
        """
        if self.conditioning.recurs:
            before = jax.vmap(track)(window, window.obs)
            return before, Following(*before)
        if not self.history_length:
            return None, None
        return first.memory.past, last_steps.append(last.memory.past, last.obs, last.action, last.reward)

    @property
    def least_loss(self) -> float | Array:
        """Lower bound of a task's critic loss: 0 for the critics, plus that of the representation."""
        return self.representation.least_loss

    def above_least(self, critic_loss: Callable) -> Callable:
        """Subtract the lower bound from a critic loss of one task, for rules of surgery that compare losses."""

        def loss(nets: Nets, *data: Any) -> tuple[Array, Any]:
            value, aux = critic_loss(nets, *data)
            return value - self.least_loss, aux

        return loss

    def descend(
        self,
        state: AgentState,
        name: str,
        loss: Callable,
        data: tuple,
        key: Key,
        importance: Array | None = None,
        seen: Nets | None = None,
    ) -> tuple[AgentState, Fitted]:
        """Take the gradient step called ``name`` for a loss of one task on data (T, ...).

        Args:
            seen: networks that the loss sees in place of the state's.
        """
        found = self.fits[name].step(state.fits[name], loss, state.nets | (seen or {}), data, key, importance)
        found = found._replace(metrics={f"{name}_{key}": value for key, value in found.metrics.items()})
        fits = state.fits | {name: found.state}
        return state._replace(nets=state.nets | found.nets, fits=fits), found
