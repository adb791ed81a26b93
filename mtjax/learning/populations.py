"""A population: members learn side by side, and at some evaluations the worst give way to copies of better ones.

Members are the entries of S. Who becomes whose copy is a gather on that axis, so that nothing is compiled anew. What is
here runs on the host, on NumPy arrays; random numbers follow from a key, so that a resumed run repeats them.

Copies make members depend on each other. They are no sample of independent seeds: a whole population counts as one.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import ClassVar, NamedTuple

import jax
import numpy as np

from mtjax.types import InputError, Key

FACTORS = (0.8, 1.2)
"""By one of them, drawn at random, each number of a copy is multiplied."""
NO_INTERVAL = "members of a population are copies of each other: their mean has no interval"
"""Stands below a table of returns."""
_PART = 5  # the worst fifth copies the best fifth


@dataclasses.dataclass(frozen=True)
class PBT:
    """Population-based training (Jaderberg et al. 2017): copy the best networks, and perturb their numbers."""

    steps: int
    explores: ClassVar[bool] = True  # whether numbers of copies are perturbed

    def sources(self, fitness: np.ndarray, origins: np.ndarray, key: Key) -> np.ndarray:
        """Return whose copy every member becomes (S,), given fitness (S,) and the first ancestors (S,)."""
        return exploit(fitness, key)


@dataclasses.dataclass(frozen=True)
class Halving:
    """Successive halving (Jamieson and Talwalkar 2016): the better half of the first members stays."""

    steps: int
    explores: ClassVar[bool] = False

    def sources(self, fitness: np.ndarray, origins: np.ndarray, key: Key) -> np.ndarray:
        return halve(fitness, origins)


class Samples(NamedTuple):
    """Says what statistics tell apart: settings, and of each the seeds, which are independent of each other."""

    points: tuple[Mapping[str, float], ...]  # the swept numbers of each setting; one without any if none are swept
    seeds: tuple[int, ...]

    @staticmethod
    def of(points: Sequence[Mapping[str, float]], seeds: Sequence[int], population: str) -> "Samples":
        """Return those of a run. Members of a population copy each other, so all are one seed of one setting."""
        return Samples(({},), (seeds[0],)) if population else Samples(tuple(points) or ({},), tuple(seeds))


Rule = PBT | Halving
_RULES = {"pbt": PBT, "halving": Halving}


def read(text: str) -> Rule | None:
    """Return the rule that ``text`` names: "pbt:STEPS" or "halving:STEPS"; None for an empty text.

    Raises:
        InputError: it names none.
    """
    if not text:
        return None
    kind, _, steps = text.partition(":")
    if kind not in _RULES or not steps.isdecimal() or not int(steps):
        raise InputError(
            "population is pbt:STEPS or halving:STEPS, with environment steps of each member until the worst give way, "
            f"such as pbt:100000; not {text!r}"
        )
    return _RULES[kind](int(steps))


def fitness(returns: np.ndarray) -> np.ndarray:
    """Return the fitness (S,) of members: the mean of returns (S, T, episodes) of one evaluation on training tasks."""
    return returns.mean(axis=(1, 2), dtype=np.float64)


def best(returns: np.ndarray) -> int:
    """Return the number of the member with the highest fitness, given returns (S, T, episodes); one must be finite."""
    return int(np.nanargmax(fitness(returns)))


def exploit(fitness: np.ndarray, key: Key) -> np.ndarray:
    """Return whose copy every member becomes (S,): truncation selection (Jaderberg et al. 2017, section 4.1).

    Each of the worst fifth, and at least one, copies one of the best fifth, which is drawn at random. A member without
    a finite fitness is given up: it neither copies nor is copied.
    """
    order = _ranked(fitness)
    count, sources = min(max(len(fitness) // _PART, 1), len(order) // 2), np.arange(len(fitness))
    drawn = np.asarray(jax.random.randint(key, (count,), 0, max(count, 1)))
    sources[order[len(order) - count :]] = order[drawn]
    return sources


def halve(fitness: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Return whose copy every member becomes (S,): one round of successive halving.

    Members of one origin (S,), which is the first member that they descend from, count together by their mean fitness.
    The better half of the origins, rounded down, is kept. The places of the others take copies of the kept ones in
    turn, of the best member of each. The last origin stays. A member without a finite fitness is given up.
    """
    known, sources = np.isfinite(fitness), np.arange(len(fitness))
    alive = np.unique(origins[known])
    means = np.array([fitness[known & (origins == origin)].mean() for origin in alive])
    kept = alive[_ranked(means)][: max(len(alive) // 2, 1)]
    best = [next(k for k in _ranked(fitness) if origins[k] == origin) for origin in kept]
    freed = np.flatnonzero(known & ~np.isin(origins, kept))
    sources[freed] = np.resize(best, len(freed)) if len(best) else freed
    return sources


def _ranked(fitness: np.ndarray) -> np.ndarray:
    """Return the numbers of the members with a finite fitness, the best first; of equals the first one first."""
    known = np.flatnonzero(np.isfinite(fitness))
    return known[np.argsort(-fitness[known], kind="stable")]


def explore(
    numbers: Mapping[str, np.ndarray], copies: np.ndarray, shares: AbstractSet[str], key: Key
) -> dict[str, np.ndarray]:
    """Return numbers (S,) by name, those of copies (S,) each multiplied by a factor of ``FACTORS``.

    Of ``shares``, which are numbers that end at 1 such as discounts, what lacks to 1 is multiplied where that is less
    than the number itself: 0.99 becomes 0.992 or 0.988.
    """
    found = {}
    for i, name in enumerate(sorted(numbers)):
        x = numbers[name]
        drawn = np.asarray(jax.random.bernoulli(jax.random.fold_in(key, i), shape=x.shape))
        factor = np.where(drawn, *FACTORS).astype(x.dtype)
        near_one = (name in shares) & (x > 0.5)
        found[name] = np.where(copies, np.where(near_one, 1 - (1 - x) * factor, x * factor), x).astype(x.dtype)
    return {name: found[name] for name in numbers}
