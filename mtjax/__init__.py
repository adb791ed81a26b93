"""Multi-task reinforcement learning in JAX: tasks as data, physics and learning in one compiled loop."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "AGENTS": "mtjax.agents",
    "ENVS": "mtjax.envs",
    "InputError": "mtjax.types",
    "Result": "mtjax.training.run",
    "Settings": "mtjax.loop",
    "Step": "mtjax.types",
    "Task": "mtjax.types",
    "Transition": "mtjax.types",
    "agent": "mtjax.agents",
    "load": "mtjax.training.policy",
    "make": "mtjax.envs",
    "mixture": "mtjax.envs",
    "preset": "mtjax.config",
}
__all__ = [*_HOME, "train"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import mtjax`` takes no time."""
    if name in _HOME:
        found = getattr(import_module(_HOME[name]), name)
    elif name == "train":
        found = import_module("mtjax.train")  # a module that is called like the function
    else:
        raise AttributeError(f"module 'mtjax' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
