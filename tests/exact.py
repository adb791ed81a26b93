"""The most that can be earned in tasks that nothing shows, by dynamic programming over what can be known of them."""

from functools import cache

import numpy as np


def bandit(arms: int, pulls: int) -> float:
    """Return the expected total of the best strategy with Bernoulli arms, whose chances are uniform in [0, 1].

    After s rewards in n pulls an arm's chance is (s + 1) / (n + 2) (Laplace). Arms with the same past are exchangeable.
    """

    @cache
    def value(counts: tuple[tuple[int, int], ...], left: int) -> float:
        if not left:
            return 0.0
        return max(earned(counts, i, left) for i in range(arms) if i == 0 or counts[i] != counts[i - 1])

    def earned(counts: tuple[tuple[int, int], ...], i: int, left: int) -> float:
        wins, losses = counts[i]
        chance = (wins + 1) / (wins + losses + 2)
        after = lambda new: value(tuple(sorted([*counts[:i], new, *counts[i + 1 :]])), left - 1)
        return chance * (1 + after((wins + 1, losses))) + (1 - chance) * after((wins, losses + 1))

    return value(((0, 0),) * arms, pulls)


def two_arms(pulls: int) -> tuple[np.ndarray, float]:
    """Return the best arm after so many wins and losses of each of two, (H, H, H, H) int, and the expected total."""
    best, value = np.zeros((pulls,) * 4, int), {}
    for total in range(pulls, -1, -1):
        for a, b, c in np.ndindex(*(total + 1,) * 3):
            d = total - a - b - c
            if d < 0:
                continue
            chances = (a + 1) / (a + b + 2), (c + 1) / (c + d + 2)
            after = lambda *counts: value.get(counts, 0.0)
            won, lost = (after(a + 1, b, c, d), after(a, b, c + 1, d)), (after(a, b + 1, c, d), after(a, b, c, d + 1))
            each = [p * (1 + w) + (1 - p) * x for p, w, x in zip(chances, won, lost, strict=True)]
            if total < pulls:
                value[a, b, c, d] = max(each)
                best[a, b, c, d] = int(np.argmax(each))
    return best, value[0, 0, 0, 0]


def grid(size: int, steps: int, episodes: int) -> float:
    """Return the expected total of the best strategy in GridNavi's trials, by where the goal can still be."""
    cells = [(x, y) for x in range(size) for y in range(size)]
    goals = frozenset(cell for cell in cells if max(cell) > 1)
    moves = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    clip = lambda x: min(max(x, 0), size - 1)

    def known(cell: tuple[int, int], goal: tuple[int, int], left: int) -> float:
        """What is left of an episode earns if the goal is known."""
        away = abs(cell[0] - goal[0]) + abs(cell[1] - goal[1])
        first = max(away, 1)  # the step that is the first to be rewarded
        return left * -0.1 if first > left else (first - 1) * -0.1 + left - first + 1

    @cache
    def value(cell: tuple[int, int], maybe: frozenset, left: int, more: int) -> float:
        if not left:
            return value((0, 0), maybe, steps, more - 1) if more else 0.0
        return max(earned((clip(cell[0] + dx), clip(cell[1] + dy)), maybe, left - 1, more) for dx, dy in moves)

    def earned(cell: tuple[int, int], maybe: frozenset, left: int, more: int) -> float:
        if cell not in maybe:
            return -0.1 + value(cell, maybe, left, more)
        found = 1 + known(cell, cell, left) + more * known((0, 0), cell, steps)
        rest = maybe - {cell}
        return (found + len(rest) * (-0.1 + value(cell, rest, left, more) if rest else 0.0)) / len(maybe)

    return value((0, 0), goals, steps, episodes - 1)


def told_grid(size: int, steps: int) -> float:
    """Return what an episode of GridNavi earns on average whose goal is known."""
    away = [x + y for x in range(size) for y in range(size) if max(x, y) > 1]
    return float(np.mean([steps * -0.1 if d > steps else (d - 1) * -0.1 + steps - d + 1 for d in away]))


def bound_of_first(size: int, steps: int) -> float:
    """Return a bound of the first episode of GridNavi: from the second step on, each finds out about one more goal."""
    goals = size**2 - 4
    found = [(steps - d + 1) - 0.1 * (d - 1) for d in range(2, steps + 1)][:goals]
    return (sum(found) - 0.1 * steps * (goals - len(found))) / goals
