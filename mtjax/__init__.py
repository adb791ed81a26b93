"""Multi-task reinforcement learning in JAX: tasks as data, physics and learning in one compiled loop."""

from mtjax.agents import AGENTS, agent
from mtjax.cli import with_preset as preset
from mtjax.envs import ENVS, make
from mtjax.loop import Settings
from mtjax.policy import load
from mtjax.run import Result, train
from mtjax.types import InputError, Step, Task, Transition

__all__ = [
    "AGENTS",
    "ENVS",
    "InputError",
    "Result",
    "Settings",
    "Step",
    "Task",
    "Transition",
    "agent",
    "load",
    "make",
    "preset",
    "train",
]
__version__ = "0.1.0"
