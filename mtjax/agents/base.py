"""``BaseAgent`` holds what all agents share: their settings and parts, and what they remember and count."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import tyro

from mtjax.agents import combinations, parts
from mtjax.agents.beginning import Beginning
from mtjax.agents.fit import Fit, Losses
from mtjax.agents.hyperparameters import FLAT, parts_of
from mtjax.agents.networks import Network, Params
from mtjax.agents.parts.continual import Continual
from mtjax.agents.parts.encoders import Encoder
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.parts.knowing import Knowing, last_steps
from mtjax.agents.parts.knowing.last_steps import Past
from mtjax.agents.parts.plasticity import Plasticity
from mtjax.agents.parts.policies import Gaussian, Policy
from mtjax.agents.parts.representations import Representation
from mtjax.agents.parts.samplers import Sampler
from mtjax.agents.parts.scaling import Scaling
from mtjax.agents.parts.targets import Target
from mtjax.agents.parts.watching import Watcher
from mtjax.agents.rates import discounts, discounts_of_all, scheduled
from mtjax.agents.state import AgentState, Nets, of_task
from mtjax.agents.view import View, init_inputs, join_arrays
from mtjax.checks import require_choices, require_values
from mtjax.experience import Replay
from mtjax.parallel import collectives
from mtjax.types import Acted, Array, Key, Metrics, Spec, Task, Transition

Heads = Literal["shared", "per-task", "disjoint"]
HeadsOfOne = Literal["as-heads", "shared", "per-task", "disjoint"]
Tune = Literal["all", "heads", "embedding"]


class Inputs(NamedTuple):
    """Holds what networks take, of one task and all zero."""

    actor: tuple  # features (Z,) and an observation (O,)
    critic: tuple
    action: Array  # (A,)


class Memory(NamedTuple):
    """Holds what an agent remembers of an episode."""

    past: Past | None  # the last steps, if the agent infers the task from them
    hidden: Any = None  # the hidden state of a recurrent way to know the task
    scaling: Any = None  # of the scaling of rewards
    sampler: Any = None  # of the sampler of tasks
    running: Any = None  # of the option that runs, if the agent has options
    teacher: Any = None  # what the agent's teacher remembers, if it has one


WATCHERS = ("scaling", "sampler")
"""The parts that remember an episode and count steps, by name."""


@dataclasses.dataclass(frozen=True)
class BaseAgent(abc.ABC):
    """Provides the settings and methods of every agent; a subclass adds networks, losses and updates.

    The networks of every agent, by name:
        actor, critic: what learns, beside the nets of a subclass.
        representation: of observations. The critics' loss trains it.
        knowing: of the task. The critics' loss trains it; where an actor learns from rollouts, both losses do, in its
            step.
        belief: ``knowing`` as such an actor sees it, if other losses train it: that from before the updates of a
            rollout, so that the policy moves by its own loss alone.
        tasks: what is known of the training tasks: their contexts (N, C), and given vectors (N, V), if any.
        inputs: the moments of observations; in a mixture one for each task, leaves (T, O). If observations are no
            vectors, there is also their layout, which joins their arrays.
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
    takes: ClassVar[str] = (
        "observations of any tree of numbers and bools as one vector, and beside it 'pixels', (H, W, C) uint8"
    )
    """What the agent takes, in a line."""
    policies: ClassVar[tuple[type[Policy], ...]] = (Gaussian,)
    """The kinds of policies with which the agent can learn."""
    fits_statistics: ClassVar[bool] = False
    """Whether learning keeps the running statistics of bodies with batch normalisation."""
    follows_sketches: ClassVar[bool] = False
    """Whether it plays only families that follow a sketch."""
    stand_in: ClassVar[str] = ""
    """What plays tasks that were not trained on, if not the nearest task's networks."""
    goes_on: ClassVar[bool] = False
    """Whether it goes on with what it chose in earlier steps of the episode, which its memory holds."""
    one_knowledge: ClassVar[bool] = False
    """Whether tasks share what knows them even where each has networks of its own."""
    target: ClassVar[Target] = Target()
    """What the critics are fitted to, in agents with a replay."""
    continual: ClassVar[Continual] = Continual()
    """How the actor remembers tasks that it learned one after another."""
    plasticity: ClassVar[Plasticity] = Plasticity()
    """What keeps the networks able to learn."""
    in_training: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Fields that say who acts in training, with the values by which the learned policy acts alone."""
    taught: ClassVar[bool] = False
    """Whether it learns from the policies of other runs, which --from names, instead of going on with theirs."""
    begins_from: ClassVar[Mapping[type, Callable[[Any, Spec], Beginning]]] = MappingProxyType({})
    """The other classes of agents from whose runs it can begin, each with what it takes of one, given its spec."""
    distils: ClassVar[bool] = False
    """Whether another policy than each task's own learns beside it."""
    num_critics: ClassVar[int] = 0
    """Number of critics that see actions; 0 if the agent has one, which sees none."""
    losses: ClassVar[Callable[..., Losses] | None] = None
    """Returns the losses on windows (T, B, L, ...) of a state, for ``tasks`` and a key; None if they do not tell how it
    learns, so that diagnostics refuse it."""
    unit_head: ClassVar[bool] = False
    """Whether the weights of each output of actor and critics keep length 1."""
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
    actor_heads: HeadsOfOne = "as-heads"
    """What each task has for itself of the actor, if that is not what ``heads`` says (as-heads)."""
    critic_heads: HeadsOfOne = "as-heads"
    """What each task has for itself of the critics, if that is not what ``heads`` says (as-heads). An actor of each
    task's own beside critics that all share is Yang et al. (2017)."""
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
        """Choose parts by their names, and check that they and the settings can be used together.

        Raises:
            InputError: they cannot.
        """
        chosen = parts_of(self)
        for kind, part in chosen.items():
            object.__setattr__(self, kind, part)
        for holder in (self, *chosen.values()):
            require_choices(holder)
            require_values(holder)
        combinations.check(self)

    # Networks, and how they learn.

    @property
    def view(self) -> View:
        """What the networks see."""
        return View(self.normalize_observations, self.conditioning, self.representation, self.policy)

    @property
    def actor(self) -> Network:
        """The network of the policy."""
        return dataclasses.replace(network_of(self, "actor"), sight=self.representation.sight)

    @property
    def critic(self) -> Network:
        """The network of a critic."""
        return network_of(self, "critic")

    @abc.abstractmethod
    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        """Add to a state actor, critics, what else the agent has, and the slow copies of networks."""

    @property
    def fits(self) -> dict[str, Fit]:
        """The gradient steps of the agent, by name: which networks learn together, and how."""
        adam = partial(descent.adam, weight_decay=self.weight_decay, max_norm=self.max_gradient_norm, tune=self.tune)
        actor = adam(scheduled(self, self.actor_lr, self.experience.policy_delay))
        critic = adam(scheduled(self, self.critic_lr))
        fit = partial(Fit, per_layer=self.gradient_scope == "per-layer", over_devices=self.devices_differ)
        return {
            "critic": fit(("critic", "representation", "knowing"), critic, self.gradients),
            "actor": fit(("actor",), actor, self.gradients.for_actor),
        }

    @property
    def unroll(self) -> int:
        """Steps of the windows that memory or targets need, with burn-in, of a rollout all; 0 if single steps do."""
        way: Any = self.conditioning
        if not way.recurs:
            return self.target.window
        return way.burn_in + way.recurrent_steps if self.experience.storage.kept else self.experience.steps

    def init(self, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return the initial state for the training ``tasks`` (T, ...)."""
        combinations.require_sight(self, spec)
        combinations.require_policy(self, spec)
        view, num_tasks, own = self.view, len(tasks.id), combinations.disjoint(self)
        self.encoder.require(num_tasks)
        inputs, action = init_inputs(spec, num_tasks), spec.action.encode(spec.action.blank())
        vectors, seen = self.conditioning.table(spec, num_tasks), view.example(spec, inputs)
        first = jax.tree.map(lambda x: x[0], tasks._replace(blocks=None))
        vector = self.conditioning.task_vector(jnp.int32(0), first, num_tasks, vectors)
        known_apart, knowing_key = own and not self.one_knowledge, jax.random.fold_in(key, 1)
        knowing = self.conditioning.init(num_tasks, seen, action, known_apart, knowing_key)
        nets = {
            "tasks": Params({"known": tasks.context} | ({} if vectors is None else {"given": vectors}), {}),
            "inputs": inputs,
            "knowing": knowing,
            "scaling": Params({}, self.scaling.init(num_tasks)),
            "sampler": Params({}, self.sampler.init(num_tasks)),
        }
        known = view.know({"knowing": knowing.of_first()}, vector, seen)
        nets["representation"], key = self.representation.init(num_tasks, *known, seen, action, own, key)
        one = {name: net.of_first() for name, net in nets.items()}
        inputs = Inputs(view.actor_inputs(one, vector, seen), view.critic_inputs(one, vector, seen), action)
        state = self.init_networks(AgentState(nets, {}, {}), inputs, key)
        return state._replace(fits={name: fit.init(state.nets, num_tasks) for name, fit in self.fits.items()})

    # Acting.

    @abc.abstractmethod
    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""

    def policy_outputs(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the outputs (..., P) of one task's actor, as ``policy`` reads them."""
        nets = self.continual.seen(nets)
        return self.actor.apply(nets["actor"], *self.view.actor_inputs(nets, features, obs))

    def begin(self, state: AgentState, task: Task) -> Memory:
        """Return the memory with which an episode begins."""
        history, action = self.view.history, self.policy.blank(state.nets)
        obs_size = state.nets["inputs"].parts["moments"].mean.shape[-1]
        past = last_steps.begin(history, obs_size, action) if history else None
        hidden = self.conditioning.begin(obs_size, self.policy.encode(action).shape[-1])
        return Memory(past, hidden, self.scaling.begin(), self.sampler.begin())

    def remember(self, state: AgentState, memory: Memory, transition: Transition, task: Task) -> Memory:
        """Return the memory after a step."""
        past, hidden = memory.past, memory.hidden
        if past is not None:
            obs = join_arrays(state.nets["inputs"], transition.obs)
            past = last_steps.append(past, obs, transition.action, transition.reward)
        if hidden is not None:
            nets = of_task(state.nets, state.known(task))
            action = self.policy.encode(transition.action)
            obs, next_obs = (self.view.see(nets["inputs"], x) for x in (transition.obs, transition.next_obs))
            seen = transition._replace(obs=obs, action=action, next_obs=next_obs)
            hidden = self.conditioning.remember(nets["knowing"].parts, hidden, seen)
        reward, gamma = transition.reward, discounts(self, task)
        counts = (getattr(self, name).remember(getattr(memory, name), reward, gamma) for name in WATCHERS)
        return Memory(past, hidden, *counts)

    # Learning.

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Compute what has to be known of collected steps (T, H, E, ...) before the agent learns from them: nothing."""
        return state, steps

    @abc.abstractmethod
    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take one gradient step on windows (T, B, L, ...) of the training tasks; metrics are (T,).

        Args:
            number: () of the update, from the end of the first warm-up on; those that a later one leaves out count too.
        """

    def observe(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        """Count collected steps (T, H, E, ...), after learning: moments of observations, scaling and sampler."""
        gamma = discounts_of_all(self, tasks)[:, None]
        memory = steps.memory._replace(past=None, hidden=None, teacher=None)
        told = steps._replace(obs=None, action=None, next_obs=None, context=None, extras=None, memory=memory)
        told = jax.tree.map(lambda x: x.reshape(len(x), -1), collectives.whole(told, axis=2))
        new = {"inputs": self.view.count(state.nets["inputs"], steps.obs)}
        if "belief" in state.nets:
            new["belief"] = state.nets["knowing"]
        for name in WATCHERS:
            part: Watcher = getattr(self, name)
            after = told._replace(memory=part.remember(getattr(told.memory, name), told.reward, gamma))
            new[name] = Params({}, part.observe(state.nets[name].own, after))
        return state.with_nets(**new)


def network_of(agent: BaseAgent, name: Literal["actor", "critic"]) -> Network:
    """Return a network of the body and heads that an agent's settings ask for in its actor or its critics."""
    hidden, layer_norm = getattr(agent, f"{name}_hidden") or agent.hidden, getattr(agent, f"{name}_layer_norm")
    own = {"shared": (), "per-task": ("head",), "disjoint": ("sight", "body", "head")}[combinations.heads(agent, name)]
    front = None if agent.representation.learns else agent.encoder.front()
    return Network(agent.encoder.body(hidden, layer_norm), own, front, agent.unit_head)


def judged(agent: Any) -> Any:
    """Return the agent that evaluations, films and policies play: what it has learned acts, and nothing else."""
    return dataclasses.replace(agent, **agent.in_training) if agent.in_training else agent
