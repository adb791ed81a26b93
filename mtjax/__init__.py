"""Multi-task reinforcement learning in JAX: tasks as data, physics and learning in one compiled loop."""

from importlib import import_module
from typing import Any

from mtjax.names import lazily

__version__ = "0.1.0"

_HOME = {
    "AGENTS": "mtjax.agents",
    "ENVS": "mtjax.envs",
    "InputError": "mtjax.names",
    "Result": "mtjax.training.result",
    "Settings": "mtjax.loop",
    "Step": "mtjax.types",
    "Task": "mtjax.types",
    "Transition": "mtjax.types",
    "agent": "mtjax.agents",
    "export": "mtjax.training.export",
    "load": "mtjax.training.policy",
    "make": "mtjax.envs",
    "mixture": "mtjax.envs",
    "preset": "mtjax.config:with_preset",
    "register": "mtjax.registry",
    "runs": "mtjax.report.frames",
    "stacked": "mtjax.envs",
}
_MODULES = ("report", "train")  # the module train has the name of the function, and can be called
__all__ = [*_HOME, *_MODULES]


_find = lazily(__name__, _HOME)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import mtjax`` takes no time."""
    return import_module(f"mtjax.{name}") if name in _MODULES else _find(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
