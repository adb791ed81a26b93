"""Policies without what only training needs: settings, and those arrays of an agent's state that acting reads."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.config import RunConfig
from mtjax.names import InputError
from mtjax.saved import pretrained
from mtjax.saved.config_json import read_record
from mtjax.saved.operations import steps_of
from mtjax.saved.policy import Policy, load

_SETTINGS = "config.json"


def write(run: str | Path, directory: Path) -> None:
    """Write the policy of a run's first seed into a folder.

    Raises:
        InputError: the folder exists, or the run holds several settings of a sweep.
    """
    policy = load(run)
    record = read_record(Path(run) / _SETTINGS)
    if record.get("points"):
        raise InputError(f"{str(run)!r} holds several settings of a sweep; ship a run of one")
    record["plan"]["seeds"], record["runs"] = 1, RunConfig.runs
    leaves = jax.tree.leaves(policy.state)
    arrays: Any = {str(i): np.asarray(leaves[i]) for i in read_by_acting(policy)}
    directory.mkdir(parents=True)
    np.savez_compressed(directory / pretrained.FILE, **arrays)
    (directory / _SETTINGS).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def read_by_acting(policy: Policy) -> list[int]:
    """Return the numbers of those leaves of an agent's state on which its action depends."""
    leaves, form = jax.tree.flatten(policy.state)
    task = jax.tree.map(lambda x: x[0], policy.env.tasks("train"))
    obs = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), policy.takes)

    def act(*leaves: Any) -> Any:
        state = jax.tree.unflatten(form, leaves)
        return policy.agent.act(state, policy.agent.begin(state, task), obs, task, None).action

    known = [x for x in leaves if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)]
    assert len(known) == len(leaves), "an agent's state holds a key of random numbers"
    return steps_of(jax.make_jaxpr(act)(*leaves))[0]["reads"]
