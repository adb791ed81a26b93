"""EnvPool's environments as families: Atari, Procgen, ViZDoom and many others, stepped by its threads on the host."""

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from mtjax.envs.hosted.family import Hosted, parameters_of, read_arguments
from mtjax.envs.hosted.worlds import Outcome
from mtjax.envs.parameters import Parameter
from mtjax.names import nearest_error
from mtjax.types import InputError

_OF_POOLS = (  # what EnvPool's settings say of a pool and not of an environment, or what the family sets
    *("num_envs", "batch_size", "num_threads", "max_num_players", "thread_affinity_offset", "base_path", "seed"),
    *("env_seed", "gym_reset_return_info", "max_episode_steps", "reward_threshold", "task", "stack_num"),
)
_idle: dict[tuple[str, int, int], list[Any]] = {}  # pools in no set, by family, row and number of worlds


@dataclasses.dataclass(frozen=True)
class EnvPool(Hosted):
    """EnvPool: an environment of EnvPool as it is, stepped by EnvPool's threads on the host.

    Observation: the environment's own, as in Gymnasium: a vector (O,), a picture (H, W, C) of bytes, or a tree of
        arrays. Of Atari it is the newest picture; agents see the last ``frames``.
    Action: one of n numbers, several such, or a vector (A,) in [-1, 1], scaled to the environment's Box.
    Reward, start and termination are the environment's own. EnvPool's automatic resets are never reached: worlds begin
        where an episode has ended. The seeds of pools are drawn from the run's seed, those of later episodes are
        EnvPool's.

    Parameters that can vary: all settings of EnvPool's for the environment that are numbers, such as Atari's mode and
        difficulty. Each task has a pool of its own, so that no episode draws its own value.
    """

    environment: str = "Pong-v5"
    """EnvPool's name of the environment."""

    engine_name: ClassVar[str] = "envpool"

    def __post_init__(self):
        super().__post_init__()
        if self.variation.draws is not None:
            raise InputError("a pool has one value of each setting for all episodes: give lists or lo:hi:n, not lo:hi")

    @cached_property
    def original(self) -> Any:
        """Return EnvPool's description of the environment."""
        module = envpool_module()
        known = module.list_all_envs()
        if self.environment not in known:
            raise nearest_error("environment of EnvPool", self.environment, known)
        try:
            found = module.make_spec(self.environment)
            alone = {"stack_num": 1} if hasattr(found.config, "stack_num") else {}
            return module.make_spec(self.environment, **{**alone, **read_arguments(self.arguments)})
        except Exception as error:  # of any kind, as its parts differ
            line = next(iter(str(error).strip().splitlines()), "")
            raise InputError(f"{self.environment} cannot be made: {type(error).__name__}: {line}") from error

    @cached_property
    def defaults(self) -> Mapping[str, Any]:
        settings = self.original.config._asdict()
        return {name: x for name, x in settings.items() if isinstance(x, int | float) and name not in _OF_POOLS}

    @cached_property
    def every_parameter(self) -> Mapping[str, Parameter]:  # type: ignore[override]
        """Return EnvPool's settings of the environment that are numbers."""
        return parameters_of(self.defaults)

    @property
    def spaces(self) -> tuple[Any, Any]:
        with _quietly():
            return self.original.gymnasium_observation_space, self.original.gymnasium_action_space

    @property
    def own_limit(self) -> int | None:
        return self.original.config.max_episode_steps

    def make(self, row: int, count: int, seed: int) -> Any:
        """Return a pool of ``count`` worlds with the settings of a row of the table."""
        kept = _idle.get((self.simulator.digest, row, count))
        if kept:
            return kept.pop()
        alone = {"stack_num": 1} if hasattr(self.original.config, "stack_num") else {}
        given = {**alone, **self.arguments_of(row), "max_episode_steps": self.episode_length}
        with _quietly():
            return envpool_module().make(self.environment, env_type="gymnasium", num_envs=count, seed=seed, **given)

    def keep(self, row: int, count: int, pool: Any) -> None:
        """Keep a pool that is in no set any more for the next one."""
        _idle.setdefault((self.simulator.digest, row, count), []).append(pool)

    def pool(self, count: int, filmed: bool) -> "Pools":
        """Return as many worlds, a pool for each task."""
        return Pools(self, count)


class Pools:
    """Worlds in pools, one for each row of the table."""

    def __init__(self, family: EnvPool, count: int):
        self.family, self.rows = family, np.full(count, -1)
        self.made: dict[int, Any] = {}  # by row
        self.number = np.zeros(count, np.int32)  # of each world in its pool

    def begin(self, places: np.ndarray, rows: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Begin an episode in worlds (k,); all of them begin first."""
        if not self.made:
            self._make(rows, seeds)
        reader = self.family.reader
        found = np.empty((len(places), *reader.shape), reader.dtype)
        for row in np.unique(rows):
            here = np.flatnonzero(rows == row)
            obs, info = self.made[int(row)].reset(self.number[places[here]])
            found[self._order(here, places, info)] = reader.read_all(obs)
        return found

    def _make(self, rows: np.ndarray, seeds: np.ndarray) -> None:
        self.rows = rows.copy()
        for row in np.unique(rows).tolist():
            here = np.flatnonzero(rows == row)
            self.number[here] = np.arange(len(here))
            self.made[row] = self.family.make(row, len(here), int(seeds[here[0]]))

    def step(self, places: np.ndarray, actions: np.ndarray) -> Outcome:
        """Step worlds (k,); all pools at once."""
        count, reader = len(places), self.family.reader
        obs, reward = np.empty((count, *reader.shape), reader.dtype), np.empty(count, np.float32)
        ends = np.empty((2, count), bool)
        groups = {row: np.flatnonzero(self.rows[places] == row) for row in np.unique(self.rows[places]).tolist()}
        for row, here in groups.items():
            self.made[row].send(self.family.actor.read_all(actions[here]), self.number[places[here]])
        for row, here in groups.items():
            seen, earned, terminated, truncated, info = self.made[row].recv()
            order = self._order(here, places, info)
            obs[order], reward[order] = reader.read_all(seen), earned
            ends[:, order] = terminated, truncated
        return Outcome(obs, reward, ends[0], ends[1] & ~ends[0])

    def _order(self, here: np.ndarray, places: np.ndarray, info: Any) -> np.ndarray:
        """Return which of ``here`` a pool tells of, as it tells of its worlds in any order."""
        return here[np.searchsorted(self.number[places[here]], info["env_id"])]

    def picture(self, place: int) -> bytes:
        """Raise an error, as EnvPool's worlds are not filmed."""
        raise NotImplementedError

    def release(self) -> None:
        """Keep the pools for the next set."""
        for row, pool in self.made.items():
            self.family.keep(row, int(np.sum(self.rows == row)), pool)
        self.made = {}


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Suppress Gymnasium's remark that EnvPool's bounds of spaces are of float64, which says nothing to the user."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*precision lowered by casting")
        yield


def envpool_module() -> Any:
    """Import EnvPool.

    Raises:
        InputError: it is not installed.
    """
    try:
        import envpool
    except (ImportError, OSError) as error:
        raise InputError(f"EnvPool cannot be imported ({error}); pip install envpool") from None
    return envpool
