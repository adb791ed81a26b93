"""Layouts of mazes, made on the host from a number.

Cells are squares of 1 m. Cell (i, j) is at i <= x < i + 1 and j <= y < j + 1. A maze is a tree: from each cell one way
leads to any other.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_PARTS = 10**6  # numbers of layouts are told apart to a millionth
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))


class Layout(NamedTuple):
    """A maze of N x N cells, with balls in the middle of some."""

    walls: np.ndarray  # (2, N + 1, N) bool: [0, i, j] is on the line x = i, [1, j, i] on y = j, both beside cell (i, j)
    balls: np.ndarray  # (balls, 2) [m] places


class Ways(NamedTuple):
    """The shortest way to a place from every cell."""

    ahead: np.ndarray  # (N, N, 2) [m] the middle of the next cell; at the end, of the cell itself
    rest: np.ndarray  # (N, N) [m] the way from there


def make_layout(number: float, cells: int, balls: int) -> Layout:
    """Return the maze of a number: the same one always, another for every number."""
    bits = np.random.PCG64([int(number < 0), abs(round(float(number) * _PARTS))])
    draw = lambda count: int(bits.random_raw() % count)  # NumPy promises these bits for good, and no more than these
    walls, left = _carve(cells, draw), list(np.ndindex(cells, cells))
    return Layout(walls, np.array([left.pop(draw(len(left))) for _ in range(balls)]) + 0.5)


def _carve(cells: int, draw: Callable[[int], int]) -> np.ndarray:
    """Return the walls of a maze made by a depth-first search, which favours long corridors."""
    walls = np.ones((2, cells + 1, cells), bool)
    way = [(draw(cells), draw(cells))]
    visited = set(way)
    while way:
        beside = [cell for cell in _beside(way[-1], cells) if cell not in visited]
        if not beside:
            way.pop()
            continue
        chosen = beside[draw(len(beside))]
        walls[_wall(way[-1], chosen)] = False
        visited.add(chosen)
        way.append(chosen)
    return walls


def find_ways(walls: np.ndarray, place: np.ndarray) -> Ways:
    """Return the shortest way to the cell of ``place`` (2,) from every cell.

    Raises:
        ValueError: no way leads there from some cell.
    """
    cells = walls.shape[2]
    goal = tuple(np.floor(place).astype(int).tolist())
    ahead, rest = np.zeros((cells, cells, 2), np.float32), np.full((cells, cells), np.nan, np.float32)
    ahead[goal], rest[goal] = np.add(goal, 0.5), 0.0
    found = [goal]
    for cell in found:  # which grows meanwhile
        for other in _beside(cell, cells):
            if np.isnan(rest[other]) and not walls[_wall(cell, other)]:
                ahead[other], rest[other] = np.add(cell, 0.5), rest[cell] + (cell != goal)
                found.append(other)
    if len(found) < cells * cells:
        raise ValueError("no way leads to the goal from some cells")
    return Ways(ahead, rest)


def _beside(cell: tuple[int, int], cells: int) -> list[tuple[int, int]]:
    """Return the cells that share a side with a cell."""
    found = [(cell[0] + x, cell[1] + y) for x, y in _SIDES]
    return [(i, j) for i, j in found if 0 <= i < cells and 0 <= j < cells]


def _wall(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int, int]:
    """Return the index of the wall between two cells that share a side."""
    axis = 0 if one[0] != other[0] else 1
    return axis, max(one[axis], other[axis]), one[1 - axis]
