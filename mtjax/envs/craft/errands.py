"""Errands in the craft world's grid, which sentences of a small grammar ask for."""

import dataclasses
from collections.abc import Mapping
from itertools import permutations, product
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from mtjax.envs.craft.grid import PLENTY, USE, WORKSHOPS, Grid, OnGrid
from mtjax.envs.craft.sketched import GOAL, Followed
from mtjax.envs.parameters import Parameter
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task

THINGS = {"iron": PLENTY[0], "grass": PLENTY[1], "wood": PLENTY[2]} | dict(
    zip(("anvil", "loom", "saw"), WORKSHOPS, strict=True)
)
FORMS = {
    "then": "{Verb} to the {first}, then to the {second}.",
    "before": "Before you {verb} to the {second}, {verb} to the {first}.",
}
VERBS = ("go", "walk", "run")
_NEW_VERB = "run"  # which no training sentence has
_NEW_PAIRS = frozenset(zip(THINGS, [*THINGS][1:] + [*THINGS][:1], strict=True))  # each thing once first, once second


class Errand(NamedTuple):
    """What an errand's name stands for."""

    first: str
    second: str
    form: str
    verb: str

    @property
    def sentence(self) -> str:
        """What the errand asks for."""
        return FORMS[self.form].format(Verb=self.verb.capitalize(), **self._asdict())


def _errands() -> dict[str, Errand]:
    """Return all errands by their names: of every order and form, but a new order never has the new verb."""
    every = (Errand(*pair, *way) for pair, way in product(permutations(THINGS, 2), product(FORMS, VERBS)))
    kept = (x for x in every if x.verb != _NEW_VERB or (x.first, x.second) not in _NEW_PAIRS)
    return {f"{x.first}-{x.second}-{x.form}-{x.verb}": x for x in kept}


ERRANDS = _errands()


class Visited(NamedTuple):
    """A grid in which walkers use things, and what the last step has earned."""

    grid: Grid
    earned: Array  # ()


@dataclasses.dataclass(frozen=True)
class Errands(OnGrid):
    """Errands: go to one thing and then to another, in the order that a sentence asks for.

    Observation (560,): which of 11 kinds of things each cell around the walker holds (5 x 5 x 11), and each block of
        5 x 5 cells in the 25 x 25 around it (5 x 5 x 11), both by x, y and kind; how often it has used each of six
        things; where it faces, as one-hot. With ``sketched`` then the symbol that is due, one-hot (566,).
    Action: 0 to 3 for down, up, left and right: turn there, and walk if that cell is empty; 4 uses what is ahead. With
        ``sketched`` 5 is STOP.
    Reward: with c, 1 if the step has used the thing whose turn it is, and else 0; with n, how many were used in their
        turn and no other; and with k of K symbols over,
            r = c / 2
            r = 1 if n = 2 and k >= K, else 0  (sketched)
    Start: in a random cell of a random layout, facing down.
    Episode: 100 steps. It terminates after both things, and without a reward after any other one. Metric ``success`` is
        1 after both things.

    The grid is that of the craft world: 6 x 6 cells inside its boundary, iron, grass and wood, and its workshops 0 to
        2, which sentences call anvil, loom and saw. Nothing is taken or made.

    A sentence is "Go to the FIRST, then to the SECOND." or "Before you go to the SECOND, go to the FIRST.", of any two
        things, and with "walk" or "run" in place of "go". Agents read it with ``conditioning=text``. With
        ``split=dense``, the default, new orders are interpolation tasks: six pairs of things that training has in the
        other order only. A new word makes the extrapolation tasks: no training sentence has "run".

    Parameters that can vary:
        goal: the errand, such as iron-wood-then-go or iron-wood-before-walk. Its sketch has a symbol for either thing.
            The context is the sketch, and then form and verb of the sentence, one-hot.
    """

    cells: int = 6
    """Cells along each side, inside the boundary."""
    copies: int = 1
    """Things of each kind of raw material: iron, grass and wood."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {GOAL: Parameter("1", 0.0, minimum=-1.0, maximum=len(ERRANDS) - 1.0, names=tuple(ERRANDS))}
    )
    sketches: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType(
        {name: (f"use-{errand.first}", f"use-{errand.second}") for name, errand in ERRANDS.items()}
    )
    symbols: ClassVar[tuple[str, ...]] = tuple(f"use-{thing}" for thing in THINGS)
    num_items: ClassVar[int] = len(THINGS)

    # Tasks.

    def split_of(self, name: str) -> str:
        errand = ERRANDS[name]
        if errand.verb == _NEW_VERB:
            return "extrapolation"
        return "interpolation" if (errand.first, errand.second) in _NEW_PAIRS else super().split_of(name)

    def told(self) -> np.ndarray:
        """Return the contexts (N, C) of all errands: sketch, form and verb, one-hot."""
        ways = [[x.form == form for form in FORMS] + [x.verb == verb for verb in VERBS] for x in ERRANDS.values()]
        return np.concatenate([super().told(), ways], axis=1)

    def sentence(self, row: int) -> str:
        """Return what a task asks for, such as "Go to the iron, then to the saw."."""
        return ERRANDS[self.name_of(row)].sentence

    # Steps.

    def begin(self, task: Task, key: Key) -> Any:
        return Visited(super().begin(task, key), jnp.float32(0))

    def move(self, task: Task, world: Any, chosen: Array) -> Any:
        moved = super().move(task, world.grid, chosen)
        used = (chosen == USE) & jnp.any(moved.held != world.grid.held)
        return Visited(moved, 0.5 * (used & ~self.fails(task, moved)))

    def use(self, held: Array, thing: Array) -> tuple[Array, Array]:
        kinds = jnp.array([*THINGS.values()])
        return held + (kinds == thing), jnp.bool_(False)

    def reached(self, task: Task, world: Visited) -> Array:
        return jnp.all(world.grid.held[task.goal["sketch"]] > 0) & ~self.fails(task, world.grid)

    def fails(self, task: Task, world: Grid) -> Array:
        """Return whether () something was used that the sentence did not ask for then."""
        right = jnp.sum(world.held[task.goal["sketch"]] > 0)
        return (jnp.sum(world.held) > right) | ((right == 1) & (world.held[task.goal["sketch"][0]] == 0))

    def terminates(self, task: Task, state: Followed) -> Array:
        """Return whether () both things, or a wrong one, were used, or with ``sketched`` the sketch is over."""
        return super().terminates(task, state) | self.fails(task, state.world.grid)

    def reward(self, task: Task, state: Followed, action: Array) -> Array:
        """Return 0.5 for each thing in its turn, or with ``sketched`` 1 at the end, ()."""
        return super().reward(task, state, action) if self.sketched else state.world.earned

    # What is seen.

    def view(self, task: Task, world: Any) -> Array:
        return super().view(task, world.grid)

    def marks(self, task: Task, state: Followed) -> dict[str, Mark]:
        """Return where the things and the walker are."""
        return super().marks(task, state._replace(world=state.world.grid))
