"""``Plain`` is the interface of representations, and the one that does nothing."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax

from mtjax import frames
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing.last_steps import without_past
from mtjax.types import Array, InputError, Key, Metrics, Transition


class Unseen(NamedTuple):
    """Says what a task that was not trained on acts by."""

    borrowed: tuple[str, ...] = ()  # names of what it uses of its nearest training task
    replaced: str = ""  # what it has that no training task has; empty for nothing


@dataclasses.dataclass(frozen=True)
class Plain:
    """Passes observations on to the networks as they are.

    Every representation is a class with these methods. If it ``learns``, its parameters are a network of the agent's.
    The critics' loss trains them, together with losses of the representation's own, which ``join`` adds; the actor's
    loss does not. What the actor's loss trains is the module ``sight``, which lies in the actor. Parameters are those
    of one task unless stated otherwise.
    """

    learns: ClassVar[bool] = False  # whether it has parameters
    models: ClassVar[tuple[str, ...]] = ()  # names of parameters that no target is computed with
    own_target: ClassVar[tuple[str, ...]] = ()  # names of parameters that are their own targets
    rates: ClassVar[Mapping[str, float]] = {}  # steps of targets by name, where they are not the critics' ``tau``
    sees_pictures: ClassVar[bool] = False  # whether it encodes pictures
    predicts: ClassVar[bool] = False  # whether its models predict what a single step leads to
    embeds: ClassVar[bool] = False  # whether every task has a learned vector
    history: ClassVar[int] = 0  # how many last steps it needs beside each observation
    least_loss: ClassVar[float | Array] = 0.0  # lower bound of what its losses add to the critics' loss
    sight: ClassVar[nn.Module | None] = None  # of the actor's own: maps observations with pictures to vectors
    unseen: ClassVar[Unseen] = Unseen()

    def init(
        self, num_tasks: int, features: Array, obs: Any, seen: Any, action: Array, own: bool, key: Key
    ) -> tuple[Params, Key]:
        """Initialise for features (Z,), an observation (O,) and an action (A,) of these shapes.

        Args:
            seen: the observation, with the last steps if there is a ``history``.
            own: whether every task has networks of its own.

        Returns:
            the parameters, and a key for the networks on top of them.
        """
        return Params({}, {}), key

    def require(self, obs: Any) -> None:
        """Check that networks can take observations of these shapes.

        Raises:
            InputError: they cannot.
        """
        if frames.shown(obs) and not self.sees_pictures:
            other = "--agent.representation=encoded, and --agent.encoder-tau=1 --n-step=3 if it has a replay"
            raise InputError(f"networks take vectors; for pictures use --agent=drq or, with another agent, {other}")

    def acts_on(self, obs: Any) -> Any:
        """Return those entries of an observation, or of its shapes, that acting needs."""
        return obs

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """Return the critics' inputs: task features (Z,) or (B, Z), and what replaces observations (B, O)."""
        return features, obs

    def actor_inputs(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """Return the actor's inputs, as ``perceive`` does the critics'."""
        return self.perceive(params, features, obs)

    def augment(self, batch: Transition, key: Key) -> Transition:
        """Return a batch of transitions (T, B, ...) with observations changed at random, as losses should see them."""
        return batch

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[Any, Key]:
        """Return the targets of all tasks' models, leaves (T, ...), and a key (T,) for each task's critics.

        Args:
            params: those of all tasks.
            target_params: their target copy.
            next_obs: (T, B, O).
        """
        return None, jax.random.split(key, len(jax.tree.leaves(without_past(next_obs))[0]))

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        """Add the representation's losses to the critics' loss, and its metrics to theirs.

        Args:
            batch: has obs, action, reward, features, in ``model_targets`` a result of ``targets``, and in ``followed``
                (B,) whether these are of what followed; None if they always are.
        """
        return loss, metrics

    def stand_in(self, params: Params, trained: Params, known: Array, obs: Any) -> Params:
        """Return the parameters for acting in one task, at an observation (O,).

        Args:
            params: those of the task, or of the nearest training task.
            trained: those of all training tasks.
            known: () whether the task is a training task.
        """
        return params
