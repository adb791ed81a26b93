"""Environments of Craftax: survival, crafts and dungeons in open worlds."""

import dataclasses
from typing import Any, ClassVar

import jax

from mtjax.envs.adapters.family import Adapted, as_picture
from mtjax.names import nearest_error
from mtjax.types import Array, Discrete, InputError, Key, Task

_NEVER = 2**31 - 1
_PLACES = {  # those that begin no episode by themselves
    "Craftax-Symbolic-v1": ("craftax.envs.craftax_symbolic_env", "CraftaxSymbolicEnvNoAutoReset"),
    "Craftax-Pixels-v1": ("craftax.envs.craftax_pixels_env", "CraftaxPixelsEnvNoAutoReset"),
    "Craftax-Classic-Symbolic-v1": (
        "craftax_classic.envs.craftax_symbolic_env",
        "CraftaxClassicSymbolicEnvNoAutoReset",
    ),
    "Craftax-Classic-Pixels-v1": ("craftax_classic.envs.craftax_pixels_env", "CraftaxClassicPixelsEnvNoAutoReset"),
}


@dataclasses.dataclass(frozen=True)
class Craftax(Adapted):
    """Craftax: an environment of Craftax as it is, such as Craftax-Classic-Symbolic-v1 or Craftax-Symbolic-v1.

    Observation: the environment's own: a vector, (1345,) in the classic world and (8268,) in the full one; of Pixels a
        picture of bytes, (63, 63, 3) and (130, 110, 3).
    Action: one of 17 numbers in the classic world, one of 43 in the full one.
    Reward, start and termination are the environment's own: achievements count, and so does health. At its time limit
        an episode is cut off. A world takes 21 kB, of the full one 273 kB.

    Parameters that can vary: all numbers of the environment's EnvParams, such as the length of a day, and in the
        classic world the health of animals and the chances that they appear.
    """

    environment: str = "Craftax-Classic-Symbolic-v1"
    """Craftax's name of the environment."""

    suite: ClassVar[str] = "craftax"
    package: ClassVar[str] = "craftax"
    limit: ClassVar[str] = "max_timesteps"
    install: ClassVar[str] = "pip install craftax"
    reset_batches: ClassVar[int] = 64  # to draw a world takes as long as seventy steps of one

    def made(self) -> tuple[Any, Any]:
        _ = self.module()
        if self.environment not in _PLACES:
            raise nearest_error("environment of Craftax", self.environment, _PLACES)
        place, name = _PLACES[self.environment]
        with jax.ensure_compile_time_eval():  # its modules make arrays as they are imported
            found = getattr(self.module(place), name, None)
            if found is None:
                raise InputError(f"this version of Craftax has no {name}; pip install 'craftax>=1.5'")
            made = found()
        return made, made.default_params

    @property
    def action(self) -> Discrete:  # type: ignore[override]
        return Discrete(self.original[0].num_actions)

    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        obs, world = self.original[0].reset_env(key, self.own_params(task))
        return world, _seen(obs)

    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        found, own = self.original[0], self.own_params(task)
        obs, new, reward, over, _ = found.step_env(key, world, action, own)
        terminated = found.is_terminal(new, own.replace(**{self.limit: _NEVER}))
        return new, _seen(obs), reward, terminated, over & ~terminated


def _seen(obs: Array) -> Any:
    """Return a vector as it is, and a picture, whose numbers are from 0 to 1, as bytes."""
    return as_picture(obs) if obs.ndim == 3 else obs
