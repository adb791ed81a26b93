"""Environments of Craftax: survival, crafts and dungeons in open worlds."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.envs.adapters.family import Adapted
from mtjax.frames import PICTURES
from mtjax.names import nearest_error
from mtjax.types import Array, Discrete, InputError, Key, Task

_LIMIT = "max_timesteps"
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
    install: ClassVar[str] = "pip install craftax"

    @cached_property
    def original(self) -> tuple[Any, Any]:
        """Return Craftax's environment and its nominal parameters."""
        _ = self.module()
        if self.environment not in _PLACES:
            raise nearest_error("environment of Craftax", self.environment, _PLACES)
        place, name = _PLACES[self.environment]
        with jax.ensure_compile_time_eval():  # its modules make arrays as they are imported
            found = getattr(self.module(place), name, None)
            if found is None:
                raise InputError(f"this version of Craftax has no {name}; pip install 'craftax>=1.5'")
            made = found()
        params = made.default_params
        return made, params.replace(**{_LIMIT: self.time_limit or getattr(params, _LIMIT)})

    @property
    def defaults(self) -> Mapping[str, Any]:
        values = {field.name: getattr(self.original[1], field.name) for field in dataclasses.fields(self.original[1])}
        return {name: x for name, x in values.items() if isinstance(x, int | float) and name != _LIMIT}

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return getattr(self.original[1], _LIMIT)

    @property
    def action(self) -> Discrete:  # type: ignore[override]
        return Discrete(self.original[0].num_actions)

    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        found, nominal = self.original
        obs, world = found.reset_env(key, nominal.replace(**self.params_of(task)))
        return world, _seen(obs)

    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        found, nominal = self.original
        own = nominal.replace(**self.params_of(task))
        obs, new, reward, over, _ = found.step_env(key, world, action, own)
        terminated = found.is_terminal(new, own.replace(**{_LIMIT: _NEVER}))
        return new, _seen(obs), reward, terminated, over & ~terminated


def _seen(obs: Array) -> Any:
    """Return a vector as it is, and a picture, whose numbers are from 0 to 1, as bytes."""
    return {PICTURES: jnp.uint8(jnp.round(255 * obs))} if obs.ndim == 3 else obs
