"""Policies without what only training needs: settings, and those arrays of an agent's state that acting reads."""

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents import settings
from mtjax.config import RunConfig
from mtjax.saved import pretrained
from mtjax.saved.config_json import from_json, read_record, to_flags
from mtjax.saved.operations import steps_of
from mtjax.saved.policy import Policy, load

_SETTINGS = "config.json"


def write(run: str | Path, directory: Path, number: int = 0) -> None:
    """Write the policy of one entry of S of a run into a folder. Paths of this machine are left out.

    Raises:
        InputError: the folder exists, or the run has no such entry.
    """
    policy = load(run, number)
    record = read_record(Path(run) / _SETTINGS)
    if record.get("points"):
        record |= _of_point(from_json(Path(run) / _SETTINGS), policy)
    record["plan"] |= {"seed": int(policy.seeds[policy.number]), "seeds": 1, "population": ""}
    record |= {"runs": RunConfig.runs, "start": "", "teacher": None}
    _shorten_imports(record)
    leaves = jax.tree.leaves(policy.state)
    arrays: Any = {str(i): np.asarray(leaves[i]) for i in read_by_acting(policy)}
    directory.mkdir(parents=True)
    np.savez_compressed(directory / pretrained.FILE, **arrays)
    (directory / _SETTINGS).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def _of_point(config: RunConfig, policy: Policy) -> dict[str, Any]:
    """Return those entries of a record that tell one point of a sweep, whose numbers the policy's agent has."""
    alone = dataclasses.replace(config, points=(), sweep=(), learner=policy.agent)
    command = shlex.join(["python", "-m", "mtjax.train", *to_flags(alone)])
    return {"points": [], "sweep": [], "learner": settings(policy.agent), "command": command}


def _shorten_imports(record: dict[str, Any]) -> None:
    """Name the user's own files without their folders."""
    files, command = record.get("imports") or [], str(record.get("command", ""))
    for file in files:
        command = command.replace(file, Path(file).name)
    record |= {"imports": [Path(file).name for file in files]} | ({"command": command} if command else {})


def read_by_acting(policy: Policy) -> list[int]:
    """Return the numbers of those leaves of an agent's state on which its actions depend, and what it remembers."""
    leaves, form = jax.tree.flatten(policy.state)
    task = jax.tree.map(lambda x: x[0], policy.env.tasks("train"))
    obs = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), policy.takes)

    def act(*leaves: Any) -> Any:
        """Return the second action of an episode, as the first one is chosen without anything to remember."""
        played = dataclasses.replace(policy, state=jax.tree.unflatten(form, leaves))
        act = lambda memory: played.agent.act(played.state, memory, obs, task, None).action
        memory = played.begin(task)
        return act(played.remember(memory, task, obs, act(memory), 0.0, obs))

    known = [x for x in leaves if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)]
    assert len(known) == len(leaves), "an agent's state holds a key of random numbers"
    return steps_of(jax.make_jaxpr(act)(*leaves))[0]["reads"]
