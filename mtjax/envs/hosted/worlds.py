"""Sets of worlds that live on the host. Programs begin and step them by calls, and hold nothing but a set's number.

Such worlds are not values: a world can be stepped from its last state alone, and no state can be kept. So every call
moves a set's clock, and a call from another time is refused. Of a family two sets are kept, those that were called
last: the worlds that train, and those that are evaluated. The worlds of a set that is dropped serve the next one.

A set that this process does not know, such as that of a run that is resumed, is gone. The step that asks for it cuts
off the episodes of its worlds, and a new set begins.
"""

import contextlib
import itertools
import os
import threading
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from mtjax.envs.engines import host
from mtjax.envs.hosted.spaces import WrongShape

_MOST_SETS = 2
_numbers = itertools.count(int.from_bytes(os.urandom(4)) % 2**30 + 1)  # no other process has the same

TERMINATED, TRUNCATED, GONE = 1, 2, 4
"""What a step tells of a world, added together."""


class Outcome(NamedTuple):
    """What a step has led to in k worlds."""

    obs: np.ndarray  # (k, ...)
    reward: np.ndarray  # (k,)
    terminated: np.ndarray  # (k,) bool
    truncated: np.ndarray  # (k,) bool


class Pool(Protocol):
    """Some worlds of an environment, by their places. A world whose episode has ended is not stepped before it begins.

    ``rows`` are those of the family's table.
    """

    def begin(self, places: np.ndarray, rows: np.ndarray, seeds: np.ndarray) -> np.ndarray: ...  # observations (k, ...)
    def step(self, places: np.ndarray, actions: np.ndarray) -> Outcome: ...
    def picture(self, place: int) -> bytes: ...  # of a world, as PNG
    def release(self) -> None: ...


class _Set:
    """Worlds that a program has begun together."""

    def __init__(self, pool: Pool, obs: np.ndarray, filmed: bool):
        self.pool, self.obs, self.number, self.clock = pool, obs, next(_numbers), 0
        self.flags = np.zeros(len(obs), np.int32)
        self.pictures: dict[tuple[int, int], bytes] | None = {} if filmed else None  # by clock and place

    def begin(self, places: np.ndarray, rows: np.ndarray, seeds: np.ndarray) -> None:
        """Begin episodes in some worlds; in none where only other families of a mixture begin some."""
        if len(places):
            self.obs[places] = self.pool.begin(places, rows, seeds)
        self.flags[places] = 0
        self._tick(places)

    def step(self, actions: np.ndarray, reward: np.ndarray) -> None:
        """Step all worlds whose episodes have not ended, and fill in the rewards; the others stand still."""
        places = np.flatnonzero(self.flags == 0)
        reward[:] = 0
        if len(places):
            new = self.pool.step(places, actions[places])
            self.obs[places], reward[places] = new.obs, new.reward
            self.flags[places] = TERMINATED * np.asarray(new.terminated) + TRUNCATED * np.asarray(new.truncated)
        self._tick(places)

    def _tick(self, places: np.ndarray) -> None:
        self.clock += 1
        if self.pictures is not None:
            self.pictures |= {(self.clock, int(place)): self.pool.picture(place) for place in places}


class Worlds:
    """All worlds of a family in this process."""

    def __init__(self, name: str, make: Callable[[int, bool], Pool]):
        self.name, self.make, self.filming = name, make, False
        self.sets: dict[int, _Set] = {}  # by number, the one that was called last at the end
        self.lock = threading.RLock()
        self.acts: dict[str, Callable[..., None]] = {"begin": self.begin, "step": self.step}

    def begin(self, numbers, clocks, asked, rows, seeds, *filled: np.ndarray) -> None:
        """Begin episodes in the worlds that are asked for, in a new set if there is none of this number.

        Args:
            numbers: (n,) that of the set; 0 for a new one.
            asked: (n,) whether an episode begins there.
            rows: (n,) of the family's table.
            seeds: (n,) of the episodes.
            filled: (n,) number and clock; observations (n, ...).
        """
        with self.lock, blaming(self.name):
            known = self._find(numbers[0], clocks[0])
            if known is None and not asked.all():
                raise host.Failure(f"{self.name}: the worlds of another process cannot go on")
            known = self._new(filled[-1]) if known is None else known
            places = np.flatnonzero(asked)
            known.begin(places, rows[places], seeds[places])
            _fill(filled, known.number, known.clock, known.obs)

    def step(self, numbers, clocks, actions, *filled: np.ndarray) -> None:
        """Step all worlds of a set.

        Args:
            actions: (n, ...)
            filled: (n,) clock, reward and flags; observations (n, ...).
        """
        clock, reward, flags, obs = filled
        with self.lock, blaming(self.name):
            known = self._find(numbers[0], clocks[0])
            if known is None:
                return _fill(filled, clocks, 0, GONE, 0)
            known.step(actions, reward)
            _fill((clock, flags, obs), known.clock, known.flags, known.obs)

    def pictures(self, number: int, clocks: np.ndarray, place: int) -> list[bytes]:
        """Return the pictures of a world of a filmed set, as PNG, at some times of its clock."""
        found = self.sets[number].pictures
        assert found is not None
        return [found[int(clock), place] for clock in clocks]

    @contextlib.contextmanager
    def filmed(self) -> Iterator[None]:
        """Keep pictures of all worlds that begin meanwhile."""
        self.filming = True
        try:
            yield
        finally:
            self.filming = False

    def _find(self, number: int, clock: int) -> _Set | None:
        known = self.sets.pop(int(number), None)
        if known is None:
            return None
        self.sets[known.number] = known  # as the latest
        if known.clock != clock:
            raise host.Failure(f"{self.name} is stepped outside of JAX, from its last state alone, and this is another")
        return known

    def _new(self, like: np.ndarray) -> _Set:
        while len(self.sets) >= _MOST_SETS:
            self.sets.pop(next(iter(self.sets))).pool.release()
        new = _Set(self.make(len(like), self.filming), np.zeros_like(like), self.filming)
        self.sets[new.number] = new
        return new


def _fill(filled: Any, *values: Any) -> None:
    for array, value in zip(filled, values, strict=True):
        array[:] = value


@contextlib.contextmanager
def blaming(name: str) -> Iterator[None]:
    """Name the environment in what its code raises, and the place there; what only this package found has no place.

    Raises:
        Failure: anything was raised.
    """
    try:
        yield
    except host.Failure:
        raise
    except Exception as error:
        line = next(iter(str(error).strip().splitlines()), "")
        if isinstance(error, WrongShape):
            raise host.Failure(f"{name} {line}") from error
        last = traceback.extract_tb(error.__traceback__)[-1]
        told = f"{type(error).__name__}: {line}" if line else type(error).__name__
        raise host.Failure(f"{name} raised {told} ({last.filename}, line {last.lineno})") from error
