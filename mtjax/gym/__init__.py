"""Families as Gymnasium environments with MTEnv's interface: one world, or a vector of many.

``import mtjax.gym`` registers every family with Gymnasium as ``mtjax/NAME``. The methods for tasks belong to
``mtjax.gym.make("NAME")``, or to ``gymnasium.make("mtjax/NAME").unwrapped``.
"""

from mtjax.envs import ENVS
from mtjax.types import InputError

try:
    import gymnasium
except ImportError as error:
    raise InputError("mtjax.gym needs Gymnasium: pip install 'mtjax[gym]'") from error

from mtjax.gym.env import MTENV_IDS, FamilyEnv, make
from mtjax.gym.vector import FamilyVectorEnv, make_vec
from mtjax.gym.wrappers import EnvToMTEnv, NTasks, NTasksId, SampleRandomTask

__all__ = [
    "MTENV_IDS",
    "EnvToMTEnv",
    "FamilyEnv",
    "FamilyVectorEnv",
    "NTasks",
    "NTasksId",
    "SampleRandomTask",
    "make",
    "make_vec",
]

for _name in ENVS:
    gymnasium.register(
        id=f"mtjax/{_name}",
        entry_point="mtjax.gym:make",
        vector_entry_point="mtjax.gym:make_vec",
        kwargs={"name": _name},
    )
