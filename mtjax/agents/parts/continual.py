"""Ways to remember tasks that were learned one after another, for the actor of an agent with a replay.

What a way keeps is the network "continual", which no fit names, so that no gradient step changes it. Once a task ends,
``consolidate`` renews it. Only what tasks share of the actor is held: output layers of a task's own no other task
changes, and critics forget, as their regularisation harms learning (Wolczyk et al. 2021).
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts import forgetting
from mtjax.agents.parts.forgetting import GROUP, Anchor, Outputs
from mtjax.agents.state import Nets
from mtjax.types import Array, Key

NET = "continual"
"""The network that holds what is kept."""
_NOBODY = -1  # the owner of no weight

Information = Callable[[Array], Array]


@dataclasses.dataclass(frozen=True)
class Nothing:
    """Keeps nothing of earlier tasks: fine-tuning. Every way is a class with these methods.

    Nets are those of one task in ``seen`` and ``penalty``, and of all played ones, which is one, in the others. Inputs
    are the actor network's, leaves (N, ...): features of the task and observations.
    """

    keeps: ClassVar[bool] = False
    freezes: ClassVar[bool] = False
    """Whether the actor of earlier tasks stays as it is to the bit."""
    samples: ClassVar[int] = 0
    """Number of stored steps that a consolidation sees."""
    retrains: ClassVar[int] = 0
    """Number of updates that follow a consolidation, on the same replay."""
    restarts: ClassVar[bool] = False
    """Whether the whole agent begins anew where a task ends."""
    reset_optimizer: bool = False
    """Begin optimisers anew where a task ends, as Continual World does."""

    def init(self, actor: Params, num_tasks: int, example: tuple, size: int) -> Nets:
        """Return what is kept before the first task, as a network by name.

        Args:
            example: one input of the actor, without N.
            size: number P of its outputs.
        """
        return {}

    def seen(self, nets: Nets) -> Nets:
        """Return networks with the actor as the task sees it."""
        return nets

    def penalty(self, nets: Nets, agent: Any, key: Key) -> Array | float:
        """Return what is added to the loss of ``agent.actor``, whose outputs ``agent.policy`` reads."""
        return 0.0

    def kept(self, before: Nets, after: Nets) -> Nets:
        """Return the networks after a gradient step, without changes of what must not change."""
        return after

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        """Return the networks with which a task ends.

        Args:
            outputs: the actor's outputs (P,) for its shared parameters and one of ``inputs``, leaves (samples, ...).
                Without samples all three are None.
            information: the Fisher information (P,) of the policy with such outputs.
        """
        return nets

    def retrained(self, nets: Nets) -> Nets:
        """Return the networks once the updates after a consolidation are over."""
        return nets


# What ways that hold parameters have in common. The importances F of all tasks so far add up, and to the actor's loss
# coefficient / 2 sum_i F_i (theta_i - theta*_i)^2 is added, where theta* are those that the last task left.


def _first_anchor(self: Nothing, actor: Params, num_tasks: int, example: tuple, size: int) -> Nets:
    zeros = jax.tree.map(jnp.zeros_like, actor.shared)
    return {NET: Params({"anchor": Anchor(jax.tree.map(jnp.copy, actor.shared), zeros)}, {})}


def _pulled_by(coefficient: Callable[[Any], float]) -> Callable[..., Array]:
    """Return the ``penalty`` of a way, by what is its coefficient."""
    return lambda self, nets, agent, key: forgetting.penalty(
        nets[NET].shared["anchor"], nets["actor"].shared, coefficient(self)
    )


def _hold(nets: Nets, importance: Any) -> Nets:
    held = forgetting.anchor(nets["actor"].shared, importance, nets[NET].shared["anchor"])
    return nets | {NET: Params({"anchor": held}, {})}


@dataclasses.dataclass(frozen=True)
class L2(Nothing):
    """Holds all parameters of the actor equally: F = 1."""

    keeps: ClassVar[bool] = True
    l2_coefficient: float = 2e5
    """Weight of the penalty: that of Continual World, where it is 1e5 without the half."""

    def __post_init__(self):
        parts.require_not_negative(self, "l2_coefficient")

    init, penalty = _first_anchor, _pulled_by(lambda self: self.l2_coefficient)

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        return _hold(nets, forgetting.l2(nets["actor"].shared))


@dataclasses.dataclass(frozen=True)
class EWC(Nothing):
    """Holds parameters by the Fisher information of the policy (Kirkpatrick et al. 2017); see ``forgetting.ewc``."""

    keeps: ClassVar[bool] = True
    ewc_coefficient: float = 2e4
    """Weight of the penalty: that of Continual World, where it is 1e4 without the half."""
    fisher_least: float = 1e-5
    """Least Fisher information of a parameter at any step; 1e-5 in Continual World."""
    fisher_samples: int = 2560
    """Stored steps over which the Fisher information is averaged, rounded down to a multiple of 32."""

    def __post_init__(self):
        parts.require_not_negative(self, "ewc_coefficient", "fisher_least")
        _require_group(self, "fisher_samples")

    init, penalty = _first_anchor, _pulled_by(lambda self: self.ewc_coefficient)

    @property
    def samples(self) -> int:  # type: ignore[override]
        return self.fisher_samples // GROUP * GROUP

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        params = nets["actor"].shared
        return _hold(nets, forgetting.ewc(outputs, information, params, inputs, self.fisher_least))


@dataclasses.dataclass(frozen=True)
class MAS(Nothing):
    """Holds parameters by how much they change the actor's outputs (Aljundi et al. 2018); see ``forgetting.mas``."""

    keeps: ClassVar[bool] = True
    mas_coefficient: float = 2e4
    """Weight of the penalty: that of Continual World, where it is 1e4 without the half."""
    mas_samples: int = 2560
    """Stored steps over which the importance is averaged, rounded down to a multiple of 32."""

    def __post_init__(self):
        parts.require_not_negative(self, "mas_coefficient")
        _require_group(self, "mas_samples")

    init, penalty = _first_anchor, _pulled_by(lambda self: self.mas_coefficient)

    @property
    def samples(self) -> int:  # type: ignore[override]
        return self.mas_samples // GROUP * GROUP

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        params = nets["actor"].shared
        return _hold(nets, forgetting.mas(outputs, params, inputs))


@dataclasses.dataclass(frozen=True)
class PackNet(Nothing):
    """Gives every task weights of its own, which later tasks see but do not change (Mallya and Lazebnik 2018).

    A task learns with all free weights. Where it ends it keeps the largest 1 / k of each matrix, k tasks being left
    with this one, and learns on with these alone for ``retrain_updates``. Biases are the first task's. A task that
    comes again changes nothing that tasks share.
    """

    keeps: ClassVar[bool] = True
    freezes: ClassVar[bool] = True
    retrain_updates: int = 10_000
    """Updates after weights are set apart, on the task's replay; 100,000 in Continual World."""

    def __post_init__(self):
        parts.require_not_negative(self, "retrain_updates")

    @property
    def retrains(self) -> int:  # type: ignore[override]
        return self.retrain_updates

    def init(self, actor: Params, num_tasks: int, example: tuple, size: int) -> Nets:
        shared = {"owners": forgetting.unowned(actor.shared), "count": jnp.int32(0), "retraining": jnp.bool_(False)}
        return {NET: Params(shared, {"number": jnp.zeros(num_tasks, jnp.int32)})}

    def seen(self, nets: Nets) -> Nets:
        held, actor = nets[NET], nets["actor"]
        number = held.own["number"]
        packed = forgetting.seen_by(actor.shared, held.shared["owners"], number)
        shared = jax.tree.map(lambda packed, x: jnp.where(number > 0, packed, x), packed, actor.shared)
        return nets | {"actor": actor._replace(shared=shared)}

    def kept(self, before: Nets, after: Nets) -> Nets:
        held, old, new = before[NET], before["actor"].shared, after["actor"]
        number = held.own["number"][0]
        learner = jnp.where(number == 0, forgetting.FREE, jnp.where(held.shared["retraining"], number, _NOBODY))
        choose = lambda x, y, owner: jnp.where(owner == learner, y, x)
        shared = jax.tree.map(choose, old, new.shared, held.shared["owners"])
        return after | {"actor": new._replace(shared=shared)}

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        held, actor = nets[NET], nets["actor"]
        number, count, owners = held.own["number"], held.shared["count"], held.shared["owners"]
        first = number[0] == 0
        left = len(nets["tasks"].shared["known"]) - count
        pruned = forgetting.prune(actor.shared, owners, count + 1, 1 / jnp.maximum(left, 1))
        choose = lambda new, old: jnp.where(first, new, old)
        shared, owners = jax.tree.map(choose, pruned, (actor.shared, owners))
        kept = {"owners": owners, "count": count + first, "retraining": first}
        number = jnp.where(first, count + 1, number)
        return nets | {"actor": actor._replace(shared=shared), NET: Params(kept, {"number": number})}

    def retrained(self, nets: Nets) -> Nets:
        held = nets[NET]
        return nets | {NET: held._replace(shared=held.shared | {"retraining": jnp.bool_(False)})}


@dataclasses.dataclass(frozen=True)
class Clone(Nothing):
    """Clones the actor's outputs of earlier tasks on stored steps (Wolczyk et al. 2022, "ClonEx" without exploration).

    Where a task ends, steps of its replay and the outputs y of the actor there are stored, with the output layer that
    it has for itself, if any. To the actor's loss is added
        coefficient mean KL(pi(y) | pi(y')),  y' = outputs now
    over a batch of stored steps of other tasks. Each of these tasks is as likely. Only what tasks share learns by it.
    """

    keeps: ClassVar[bool] = True
    clone_coefficient: float = 1.0
    """Weight of the divergence from earlier policies, which is in nats and so has no units of reward."""
    clone_samples: int = 10_000
    """Stored steps of each task; 10,000 in the paper."""
    clone_batch: int = 128
    """Stored steps in each update."""

    def __post_init__(self):
        parts.require_not_negative(self, "clone_coefficient")
        parts.require_counts(self, "clone_samples", "clone_batch")

    @property
    def samples(self) -> int:  # type: ignore[override]
        return self.clone_samples

    def init(self, actor: Params, num_tasks: int, example: tuple, size: int) -> Nets:
        blank = lambda x: jnp.zeros((num_tasks, self.clone_samples, *jnp.shape(x)), jnp.result_type(x))
        stored = {"inputs": jax.tree.map(blank, example), "outputs": blank(jnp.zeros(size))}
        stored |= {"own": jax.tree.map(jnp.zeros_like, actor.own), "known": jnp.zeros(num_tasks, bool)}
        return {NET: Params(stored, {"number": jnp.arange(num_tasks)})}

    def penalty(self, nets: Nets, agent: Any, key: Key) -> Array:
        stored, number = nets[NET].shared, nets[NET].own["number"]
        task_key, step_key = jax.random.split(key)
        others = stored["known"] & (jnp.arange(len(stored["known"])) != number)
        task = jax.random.categorical(task_key, jnp.where(others, 0.0, -jnp.inf), shape=(self.clone_batch,))
        step = jax.random.randint(step_key, (self.clone_batch,), 0, self.clone_samples)

        def divergence(task: Array, step: Array) -> Array:
            inputs, outputs = jax.tree.map(lambda x: x[task, step], (stored["inputs"], stored["outputs"]))
            actor = nets["actor"]._replace(own=jax.tree.map(lambda x: x[task], stored["own"]))
            return agent.policy.divergence(outputs, agent.actor.apply(actor, *inputs))

        found = jnp.mean(jax.vmap(divergence)(jnp.where(jnp.any(others), task, 0), step))
        return self.clone_coefficient * jnp.where(jnp.any(others), found, 0.0)

    def consolidate(self, nets: Nets, outputs: Outputs, information: Information, inputs: Any) -> Nets:
        actor, held = nets["actor"], nets[NET]
        number = held.own["number"][0]
        own = jax.tree.map(lambda x: x[0], actor.own)
        new = {"inputs": inputs, "outputs": jax.vmap(partial(outputs, actor.shared))(inputs), "own": own, "known": True}
        stored = jax.tree.map(lambda old, x: old.at[number].set(x), held.shared, new)
        return nets | {NET: held._replace(shared=stored)}


@dataclasses.dataclass(frozen=True)
class Scratch(Nothing):
    """Begins the whole agent anew where a task ends: each task is learned alone, by which transfer is measured."""

    restarts: ClassVar[bool] = True


def _require_group(holder: Any, name: str) -> None:
    if getattr(holder, name) < GROUP:
        flag = name.replace("_", "-")
        raise parts.InputError(f"{flag} must be at least {GROUP}, not {getattr(holder, name)}")


Continual = Nothing
CONTINUAL: dict[str, type[Continual]] = {
    "none": Nothing,
    "l2": L2,
    "ewc": EWC,
    "mas": MAS,
    "packnet": PackNet,
    "clone": Clone,
    "scratch": Scratch,
}
