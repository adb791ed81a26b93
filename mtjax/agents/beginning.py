"""What an agent takes of a run of another agent, to begin with on tasks of its own."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from mtjax.types import Spec


class Beginning(NamedTuple):
    """Holds what an agent takes of a run of another one. All else of its state is fresh."""

    nets: tuple[str, ...]  # names of networks; all tasks share them
    settings: Mapping[str, Any]  # of the agent, as these networks ask for
    spec: Spec  # of tasks as these networks see and play them
    tasks: str  # which tasks these are, in words


def beginning(agent: Any, other: Any, env: Any) -> Beginning | None:
    """Return what ``agent``, or a class of agents, takes of a run of ``other`` on ``env``; None if it takes nothing.

    Raises:
        InputError: it begins from agents of that class, but not from this one.
    """
    takes = next((take for kind, take in agent.begins_from.items() if isinstance(other, kind)), None)
    return None if takes is None else takes(other, env.spec)
