"""Environments of gymnax: classic control, MinAtar, bsuite and others."""

import dataclasses
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.envs.adapters.family import Adapted, as_picture
from mtjax.names import nearest_error
from mtjax.types import Action, Array, Continuous, Discrete, InputError, Key, Task


@dataclasses.dataclass(frozen=True)
class Gymnax(Adapted):
    """gymnax: an environment of gymnax as it is, such as CartPole-v1 or Breakout-MinAtar.

    Observation (O,): the environment's own array, flattened. With ``pictures`` an array (H, W, C), such as MinAtar's of
        10 x 10 cells, is a picture instead, in which 1 is 255.
    Action: one of n numbers, or a vector (A,) in [-1, 1], scaled to the environment's Box.
    Reward, start and termination are the environment's own; at its time limit an episode is cut off.

    Parameters that can vary: all numbers of the environment's EnvParams, such as CartPole's length. What gymnax has as
        a number of its own does not follow from others: CartPole's polemass_length and total_mass stay where length and
        masspole vary, unless they vary too (--env.combine=paired). And reward-scale, a factor of the reward.
    """

    environment: str = "CartPole-v1"
    """gymnax's name of the environment."""
    pictures: bool = False
    """Observe a picture (H, W, C), for convolutions, in place of a vector. The environment's own array must be one, of
    numbers from 0 to 1, as in MinAtar's games."""

    cheap_starts: ClassVar[bool] = True
    suite: ClassVar[str] = "gymnax"
    package: ClassVar[str] = "gymnax"
    limit: ClassVar[str] = "max_steps_in_episode"
    install: ClassVar[str] = "pip install six seaborn && pip install --no-deps 'gymnax>=1.0'"

    def made(self) -> tuple[Any, Any]:
        module = self.module()
        if self.environment not in module.registered_envs:
            raise nearest_error("environment of gymnax", self.environment, module.registered_envs)
        with jax.ensure_compile_time_eval():
            found, params = module.make(self.environment)
        if not hasattr(found, "is_truncated"):
            raise InputError(f"gymnax tells terminated from cut off since version 1.0; {self.install}")
        if self.pictures:
            _require_picture(self.environment, found.observation_space(params))
        return found, params

    @property
    def pixels(self) -> int:
        """Return the width of pictures, or 0 where observations have none."""
        found, params = self.original
        return found.observation_space(params).shape[1] if self.pictures else 0

    @cached_property
    def action(self) -> Action:  # type: ignore[override]
        space = self._actions
        return Discrete(int(space.n)) if hasattr(space, "n") else Continuous(int(np.prod(space.shape)))

    @cached_property
    def _actions(self) -> Any:
        found, params = self.original
        with jax.ensure_compile_time_eval():
            return found.action_space(params)

    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        obs, world = self.original[0].reset_env(key, self.own_params(task))
        return world, self._seen(obs)

    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        found, own, space = self.original[0], self.own_params(task), self._actions
        if not self.discrete:
            middle, half = (jnp.asarray(space.high) + space.low) / 2, (jnp.asarray(space.high) - space.low) / 2
            action = middle + jnp.clip(action, -1, 1).reshape(space.shape) * half
        obs, new, reward, terminated, _ = found.step_env(jax.random.split(key)[0], world, action, own)
        return new, self._seen(obs), reward, terminated, found.is_truncated(new, own)

    def _seen(self, obs: Any) -> Any:
        return as_picture(obs) if self.pictures else obs


def _require_picture(name: str, space: Any) -> None:
    """Refuse an environment whose observations are no pictures.

    Raises:
        InputError: they are no array (H, W, C) of numbers from 0 to 1.
    """
    shape = getattr(space, "shape", None) or ()
    if len(shape) != 3 or np.min(space.low) < 0 or np.max(space.high) > 1:
        raise InputError(f"{name} observes no picture (H, W, C) of numbers from 0 to 1; leave out --env.pictures")
