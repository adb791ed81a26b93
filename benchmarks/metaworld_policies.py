"""The scripted policies of an installed Meta-World, without the rest of the package and what that needs."""

import importlib
import importlib.util
import sys
import types
import warnings
from typing import Any

import numpy as np


def load() -> dict[str, Any]:
    """Return the policies by the names of their tasks.

    The package's own ``__init__`` imports Gymnasium and its environments. Its policies need NumPy alone, so a bare
    module stands for the package.
    """
    found = importlib.util.find_spec("metaworld")
    if found is None or found.submodule_search_locations is None:
        raise SystemExit("Meta-World is not installed: pip install --no-deps metaworld==3.1.1")
    if "metaworld" not in sys.modules:
        bare = types.ModuleType("metaworld")
        bare.__path__, bare.__spec__ = list(found.submodule_search_locations), found
        sys.modules["metaworld"] = bare
    warnings.filterwarnings("ignore", message="Constant")  # at every step
    policies = importlib.import_module("metaworld.policies").ENV_POLICY_MAP
    return {name.removesuffix("-v3"): policy() for name, policy in policies.items()}


def actions(policy: Any, obs: np.ndarray) -> np.ndarray:
    """Return the actions (..., 4) of a policy for observations (..., 39)."""
    flat = np.asarray(obs, np.float64).reshape(-1, obs.shape[-1])
    taken = [policy.get_action(each.copy()) for each in flat]  # a policy may write into what it is shown
    return np.clip(taken, -1, 1).astype(np.float32).reshape(*obs.shape[:-1], 4)
