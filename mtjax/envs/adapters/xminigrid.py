"""Environments of XLand-MiniGrid: grids of rooms with rules that differ between tasks."""

import dataclasses
import importlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.envs.adapters.family import Adapted
from mtjax.names import nearest_error
from mtjax.types import Array, Discrete, InputError, Key, Task

_RULESET = ("goal", "rules", "init_tiles")


@dataclasses.dataclass(frozen=True)
class XMiniGrid(Adapted):
    """XLand-MiniGrid: an environment of XLand-MiniGrid as it is, such as XLand-MiniGrid-R1-9x9 or MiniGrid-DoorKey-8x8.

    Observation (O,): the tiles in view, each as one-hot of its kind and of its colour, flattened.
    Action: one of 6 numbers: forward, turn right, turn left, pick up, put down, toggle.
    Reward, start and termination are the environment's own; at its time limit an episode is cut off. The reward falls
        with the steps, by that limit.

    Parameters that can vary, in environments of XLand:
        ruleset: the number of a ruleset in the file of ``rulesets``. It says what the goal is, by which rules objects
            change, and which lie there. Held-out tasks need whole numbers between and beyond: 0:18:10, or split none.
    """

    environment: str = "XLand-MiniGrid-R1-9x9"
    """XLand-MiniGrid's name of the environment."""
    rulesets: str = ""
    """Rulesets of an environment of XLand: a file, or a name such as trivial-21k, which XLand-MiniGrid downloads."""

    suite: ClassVar[str] = "xminigrid"
    package: ClassVar[str] = "xminigrid"
    limit: ClassVar[str] = "max_steps"
    install: ClassVar[str] = "pip install --no-deps xminigrid"

    def made(self) -> tuple[Any, Any]:
        module = self.module()
        if self.environment not in module.registered_environments():
            known = module.registered_environments()
            raise nearest_error("environment of XLand-MiniGrid", self.environment, known)
        with jax.ensure_compile_time_eval():
            found, params = module.make(self.environment)
        if hasattr(params, "ruleset") and not self.rulesets:
            raise InputError(f"{self.environment} needs rulesets: --env.rulesets=FILE, or a name such as trivial-21k")
        if self.rulesets and not hasattr(params, "ruleset"):
            raise InputError(f"{self.environment} has no rulesets; leave them out")
        return found, params

    @property
    def defaults(self) -> Mapping[str, Any]:
        return {"ruleset": 0} if hasattr(self.original[1], "ruleset") else {}

    @cached_property
    def action(self) -> Discrete:  # type: ignore[override]
        return Discrete(self.original[0].num_actions(self.original[1]))

    @cached_property
    def benchmark(self) -> Any:
        """Return the rulesets of the file."""
        module = self.module()
        if Path(self.rulesets).is_file():
            return importlib.import_module("xminigrid.benchmarks").load_benchmark_from_path(self.rulesets)
        if self.rulesets not in module.registered_benchmarks():
            raise nearest_error("rulesets", self.rulesets, module.registered_benchmarks())
        return module.load_benchmark(self.rulesets)

    def build(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the leaves of the table, with the ruleset of every row."""
        if not self.defaults:
            return {"model": {}, "goal": {}}
        found, count = self.variation, self.benchmark.num_rulesets()
        given = found.values.get("ruleset", np.zeros(found.count))
        wrong = next((x for x in given if not 0 <= x < count or (found.draws is None and x % 1)), None)
        if wrong is not None:
            raise InputError(
                f"a ruleset is a whole number from 0 to {count - 1}, not {wrong:g}; --split=none holds no values out, "
                "and every second one, such as 0:18:10, leaves room for held-out ones"
            )
        numbers = np.floor(given).astype(int)
        held = (self.benchmark.goals, self.benchmark.rules, self.benchmark.init_tiles)
        return {"model": {}, "goal": {name: np.asarray(x)[numbers] for name, x in zip(_RULESET, held, strict=True)}}

    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        found = self.original[0]
        timestep = found.reset(self.own_params(task), key)
        return timestep, self._seen(timestep.observation)

    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        new = self.original[0].step(self.own_params(task), world, action)
        terminated = new.discount == 0
        return new, self._seen(new.observation), new.reward, terminated, new.last() & ~terminated

    def own_params(self, task: Task) -> Any:
        params = self.original[1]
        return params.replace(ruleset=params.ruleset.replace(**task.goal)) if self.defaults else params

    def _seen(self, obs: Array) -> Array:
        """Return tiles (H, W, 2) as one-hot of their kinds and colours."""
        constants = importlib.import_module("xminigrid.core.constants")
        kinds, colours = constants.NUM_TILES, constants.NUM_COLORS
        parts = jax.nn.one_hot(obs[..., 0], kinds), jax.nn.one_hot(obs[..., 1], colours)
        return jnp.concatenate(parts, axis=-1)
