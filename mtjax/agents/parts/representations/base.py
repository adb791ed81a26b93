"""What a representation is, and the plainest."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import jax

from mtjax.agents import parts
from mtjax.agents.parts.trajectory import Seen
from mtjax.networks import Params
from mtjax.types import Array, Key, Metrics


class Place(NamedTuple):
    """Where a representation stands: what its agent says of networks and tasks."""

    conditioning: str
    embedding_size: int  # of learned vectors of tasks, and of what is inferred
    unit_embedding: bool
    layer_norm: bool  # that of critics
    own: bool  # every task has networks of its own


class Basis(NamedTuple):
    """A representation as it begins, and what the networks above it see."""

    params: Params
    features: Array  # (Z,) zeros
    obs: Any  # zeros
    key: Key  # for the networks


@dataclasses.dataclass(frozen=True)
class Plain:
    """No representation: networks see observations as they are.

    Every representation is a class like this one. Its parameters lie beside the critics', under its ``names``, and are
    trained by the critics' loss, which its own losses ``join``; the actor sees what it makes of observations, and does
    not train it. Agents use the copy that knows its ``place``. Parameters are those of one task, if nothing else is
    said.
    """

    names: ClassVar[tuple[str, ...]] = ()  # that its parameters may have
    models: ClassVar[tuple[str, ...]] = ()  # those of them of which nobody needs a slow copy
    place: ClassVar[Place]

    def __post_init__(self):
        parts.require_choices(self)

    def at(self, place: Place) -> Self:
        """Return a copy that knows its place."""
        return parts.put(self, place=place)

    @property
    def learns(self) -> bool:
        """Whether it has parameters, among them whatever is learned of tasks in place of the networks above it."""
        return bool(self.names)

    @property
    def looks_back(self) -> bool:
        """Whether it needs the last steps, however the networks are told the task."""
        return False

    @property
    def rates(self) -> Mapping[str, float]:
        """The share of new parameters that their slow copy takes, by name, where it is not the critics'."""
        return {}

    def init(self, num_tasks: int, features: Array, obs: Any, action: Array, key: Key) -> Basis:
        """Initialise for inputs of the given shapes, (Z,), (O,) and (A,)."""
        return Basis(Params({}, {}), features, obs, key)

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """What is known of the task (Z,) or (B, Z), and what networks see in place of observations (B, O)."""
        return features, obs

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[Any, Key]:
        """What the models of all tasks fit, leaves (T, ...), and a key for each task's critics (T,).

        Args:
            params: those of all tasks; slow: their slow copy.
            next_obs: (T, B, O).
        """
        return None, jax.random.split(key, len(without_past(next_obs)))

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        """The critics' loss and metrics, joined by its own.

        Args:
            batch: has obs, action, reward, told, and in ``ahead`` what ``targets`` gave.
        """
        return loss, metrics

    @property
    def least_loss(self) -> float | Array:
        """The least that its own losses can add to the critics'."""
        return 0.0

    # Tasks that were not trained on.

    def stand_in(self, params: Params, trained: Params, known: Array, obs: Any) -> Params:
        """Parameters by which to act in one task, at an observation (O,).

        Args:
            params: those of the task, or of the training task that is nearest; trained: those of all training tasks.
            known: () whether the task is a training task.
        """
        return params

    def borrowed(self, found: list[str]) -> list[str]:
        """What such a task has of its nearest training task, where its agent finds so much."""
        return found

    @property
    def replaced(self) -> str:
        """What such a task has that no training task has; empty for nothing."""
        return ""


def without_past(obs: Any) -> Array:
    """The observation alone, where the past is seen too."""
    return obs.obs if isinstance(obs, Seen) else obs
