"""Checkpoints of the whole training state, by orbax: what a run needs to go on bit for bit."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax

from mtjax.loop import TrainState
from mtjax.types import InputError

_KEPT = 2


def save(directory: Path, state: TrainState) -> None:
    """Write the state under its iteration; the last two checkpoints are kept."""
    from orbax.checkpoint import v1 as ocp

    iteration = int(state.iteration)
    with ocp.training.Checkpointer(
        str(directory.absolute()),
        save_decision_policy=ocp.training.save_decision_policies.FixedIntervalPolicy(1),  # type: ignore
        preservation_policy=ocp.training.preservation_policies.LatestN(_KEPT),  # type: ignore
    ) as checkpointer:
        known = checkpointer.latest
        if known is None or known.step != iteration:
            checkpointer.save_checkpointables(iteration, {"agent": state.agent, "loop": state._replace(agent=None)})


def load(directory: Path, like: TrainState) -> TrainState:
    """Read the newest checkpoint into the structure of ``like`` (shapes alone suffice)."""
    found = _load(directory, {"agent": like.agent, "loop": like._replace(agent=None)})
    return found["loop"]._replace(agent=found["agent"])


def load_agent(directory: Path, like: TrainState) -> Any:
    """Read only the agent's state, which is all that acting needs."""
    return _load(directory, {"agent": like.agent})["agent"]


def _load(directory: Path, like: dict[str, Any]) -> dict[str, Any]:
    from orbax.checkpoint import v1 as ocp

    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), like)
    if not directory.is_dir():
        raise InputError(f"{str(directory)!r} holds no checkpoint; the run stopped before its first one")
    try:
        with ocp.training.Checkpointer(str(directory.absolute())) as checkpointer:
            newest = checkpointer.latest
            if newest is None:
                raise InputError(f"{str(directory)!r} holds no checkpoint; the run stopped before its first one")
            return checkpointer.load_checkpointables(newest.step, like)
    except (ValueError, KeyError, OSError, json.JSONDecodeError) as error:
        if isinstance(error, InputError):
            raise
        reason = str(error).strip().splitlines()[0][:150]
        raise InputError(f"the checkpoint in {str(directory)!r} cannot be read: {reason}") from None


def size_of(state: Any) -> int:
    """Bytes that a state (or its shapes) takes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))


def require_space(directory: Path, state: Any) -> None:
    """Check that the disk can hold the checkpoints of a run.

    Raises:
        InputError: it cannot.
    """
    needed, free = (_KEPT + 1) * size_of(state), shutil.disk_usage(directory).free
    if needed > free:
        raise InputError(
            f"checkpoints need {needed / 1e6:.0f} MB and {str(directory)!r} has {free / 1e6:.0f} MB free; "
            "lower --replay-size or choose another place with --runs"
        )
