"""Sketches learn a sub-policy for every symbol of which tasks' sketches are made."""

import dataclasses
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
import tyro

from mtjax.agents import clipped_ratio, combinations, parts
from mtjax.agents.base import Heads, Inputs
from mtjax.agents.networks import Network, Params
from mtjax.agents.on_policy import OnPolicy, with_head
from mtjax.agents.parts.policies import Categorical, Policy
from mtjax.agents.parts.samplers import ByLength
from mtjax.agents.state import AgentState
from mtjax.types import Array, InputError, Key, Spec, Task, Transition


@dataclasses.dataclass(frozen=True)
class SubPolicies(Network):
    """Holds a network for every symbol, which all tasks share. The last entries of observations choose one, one-hot."""

    count: int = 0  # S, of symbols

    def init(self, key: Key, num_tasks: int, out: int, features: Array, *inputs: Array) -> Params:
        """Initialise the sub-policies, leaves (S, ...)."""
        return Params(self._each.init(key, self.count, out, features, inputs[0][..., : -self.count]).own, {})

    def apply(self, params: Params, features: Array, *inputs: Array) -> Array:
        """Map inputs (..., O) to the outputs (..., out) of the sub-policies that are due; 0 where none is."""
        count = params.shared["head"]["bias"].shape[0]
        seen, due = inputs[0][..., :-count], jnp.moveaxis(inputs[0][..., -count:], -1, 0)
        of_symbol = lambda own: self._each.apply(Params({}, own), features, seen)
        return jnp.sum(jax.vmap(of_symbol)(params.shared) * due[..., None], axis=0)

    @property
    def _each(self) -> Network:
        return self.as_kind(Network, own=("sight", "body", "head"))


@dataclasses.dataclass(frozen=True)
class Sketches(OnPolicy):
    """Sketches learn modular policies from policy sketches (Andreas et al. 2017), by proximal policy optimisation.

    A task's sketch is a sequence of symbols b_1 ... b_K, and its policy plays their sub-policies one after another:
        pi(a|s) = pi_b(a|s), with the symbol b that is due
    A sub-policy has one action more than the world, STOP, after which the next symbol is due. Tasks share the
    sub-policies of the symbols that they have in common, and each task has a critic of its own. So the gradient of a
    step, A grad log pi_b(a|s) with the advantage A by the task's critic, moves the sub-policy of its symbol and no
    other. The environment follows the sketch, as craft-sketched and light-world-sketched do: its observations end with
    the symbol that is due. No sub-policy sees it, nor the task.

    The curriculum is the sampler by-length. It begins with the shortest sketches, and goes on to longer ones once the
    mean return of every task is above ``mastered``. Others have no weight until then.

    A task that was not trained on is played by the sub-policies of its sketch, without further learning.

    Ablations: ``sharing=tasks`` gives every task a policy of its own (the paper's independent), and ``sharing=all`` all
    tasks one policy (joint); with conditioning=one-hot or parameters it sees its task. Both see the symbol that is due.
    ``sampler=uniform`` has no curriculum.

    Differs from the paper: PPO's clipped steps on advantages by its critic replace one step of an actor-critic on whole
    returns; critics are networks that see the symbol too, and not linear; all tasks play throughout, and the
    curriculum weighs their losses; Adam replaces RMSProp; the entropy's weight is 0.01 in standard deviations of the
    advantage. As there, sub-policies have a hidden layer of 128 units, the discount is 0.9, and STOP begins with a bias
    of -3.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*OnPolicy.adjustable, "clip_range")
    policies: ClassVar[tuple[type[Policy], ...]] = (Categorical,)
    follows_sketches: ClassVar[bool] = True
    one_knowledge: ClassVar[bool] = True  # which sub-policies share
    hidden: tuple[int, ...] = (128,)
    actor_lr: float = 1e-3
    """Adam's learning rate for the actor."""
    gamma: float = 0.9
    """Discount of rewards per step."""
    normalize_observations: bool = False
    heads: Heads = "disjoint"
    """What each task has for itself of its critic: whole networks (disjoint)."""
    clip_range: float = 0.2
    """Clip the ratio of policies to this distance from 1 (epsilon)."""
    advantage_normalization: clipped_ratio.Normalization = "task"
    """Scale advantages to mean 0 and standard deviation 1: never, over all tasks together, or in each task."""
    sharing: Literal["symbols", "tasks", "all"] = "symbols"
    """What has a policy of its own: every symbol (symbols), every task (tasks), or nothing (all)."""
    stop_bias: float = -3.0
    """Bias of the logit of STOP at first. Below 0 a sub-policy lasts longer."""
    takes: ClassVar[str] = "observations of any tree of numbers and bools as one vector that ends with the symbol"
    symbols: Annotated[int, tyro.conf.Suppress] = dataclasses.field(default=0, repr=False, metadata=parts.NO_SETTING)
    """Number of symbols while networks are made. It follows from the environment."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "clip_range")
        combinations.require_heads(self, "disjoint", "in sketches every task has a critic of its own")
        if self.normalize_observations:
            raise InputError("sketches reads symbols off observations as they are; use normalize-observations=False")
        if self.representation.learns or self.representation.history or self.encoder.front() is not None:
            raise InputError("sketches reads symbols off observations; use representation=plain and another encoder")

    # Networks.

    @property
    def stand_in(self) -> str:  # type: ignore[override]
        return "each is played by the policies of its sketch's symbols" * (self.sharing == "symbols")

    @property
    def actor(self) -> Network:
        network = super().actor
        if self.sharing == "tasks":
            return network
        if self.sharing == "symbols":
            return network.as_kind(SubPolicies, own=(), count=self.symbols)
        return dataclasses.replace(network, own=())

    def init(self, spec: Spec, tasks: Task, key: Key) -> AgentState:
        """Return the initial state. The curriculum gets to know the lengths of sketches."""
        combinations.require_sight(self, spec)
        return with_lengths(self, super(Sketches, parts.put(self, symbols=spec.symbols)).init(spec, tasks, key), tasks)

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        state = super().init_networks(state, inputs, key)
        return state.with_nets(actor=lean_to_stop(state.nets["actor"], self.stop_bias))

    # Learning, as PPO does.

    gain = clipped_ratio.gain

    def assess(self, state: AgentState, steps: Transition, tasks: Task) -> tuple[AgentState, Transition]:
        """Add advantages and targets to a rollout (T, H, E, ...), and fit the critic's units to it."""
        return clipped_ratio.assess(self, state, steps, tasks)


def lean_to_stop(actor: Params, bias: float | Array) -> Params:
    """Return sub-policies with a bias added to the logit of STOP, which is their last output."""
    return with_head(actor, lambda head: head | {"bias": head["bias"].at[..., -1].add(bias)})


def with_lengths(agent: OnPolicy, state: AgentState, tasks: Task) -> AgentState:
    """Return a state whose curriculum knows the lengths of sketches, if tasks have any and the sampler is by-length."""
    if not isinstance(agent.sampler, ByLength) or "length" not in tasks.goal:
        return state
    lengths = tasks.goal["length"].astype(jnp.int32)
    return state.with_nets(sampler=Params({}, state.nets["sampler"].own._replace(length=lengths)))
