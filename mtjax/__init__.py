"""Multi-task reinforcement learning in JAX: tasks as data, physics and learning in one compiled loop."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mtjax.names import lazily

if TYPE_CHECKING:  # for editors, which do not run __getattr__
    from mtjax import report as report
    from mtjax.agents import AGENTS as AGENTS
    from mtjax.agents import agent as agent
    from mtjax.command.api import train as train
    from mtjax.command.register import register as register
    from mtjax.config import with_preset as preset  # noqa: F401
    from mtjax.envs import ENVS as ENVS
    from mtjax.envs import make as make
    from mtjax.envs import mixture as mixture
    from mtjax.envs import stacked as stacked
    from mtjax.envs.hosted.gymnasium import hosted as hosted
    from mtjax.learning.loop import Settings as Settings
    from mtjax.names import InputError as InputError
    from mtjax.report.drawing import plot as plot
    from mtjax.report.read_runs import runs as runs
    from mtjax.report.scoring import evaluate as evaluate
    from mtjax.saved import standalone as standalone
    from mtjax.saved.export import export as export
    from mtjax.saved.hub import pull as pull
    from mtjax.saved.hub import push as push
    from mtjax.saved.policy import load as load
    from mtjax.saved.result import Result as Result
    from mtjax.types import Step as Step
    from mtjax.types import Task as Task
    from mtjax.types import Transition as Transition

__version__ = "0.2.0"

_HOME = {
    "AGENTS": "mtjax.agents",
    "ENVS": "mtjax.envs",
    "InputError": "mtjax.names",
    "Result": "mtjax.saved.result",
    "Settings": "mtjax.learning.loop",
    "Step": "mtjax.types",
    "Task": "mtjax.types",
    "Transition": "mtjax.types",
    "agent": "mtjax.agents",
    "evaluate": "mtjax.report.scoring",
    "export": "mtjax.saved.export",
    "hosted": "mtjax.envs.hosted.gymnasium",
    "load": "mtjax.saved.policy",
    "make": "mtjax.envs",
    "mixture": "mtjax.envs",
    "plot": "mtjax.report.drawing",
    "preset": "mtjax.config:with_preset",
    "pull": "mtjax.saved.hub",
    "push": "mtjax.saved.hub",
    "register": "mtjax.command.register",
    "runs": "mtjax.report.read_runs",
    "stacked": "mtjax.envs",
    "train": "mtjax.command.api",
}
_MODULES = {"report": "mtjax.report", "standalone": "mtjax.saved.standalone"}
__all__ = [*_HOME, *_MODULES]
_find, __dir__ = lazily(__name__, _HOME)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import mtjax`` takes no time."""
    return import_module(_MODULES[name]) if name in _MODULES else _find(name)
