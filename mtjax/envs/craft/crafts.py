"""The craft world of Andreas et al. (2017): take raw materials to workshops, and make tools of them."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.envs.craft.grid import GEM, GOLD, KINDS, RAW, STONE, WATER, WORKSHOPS, Grid, OnGrid
from mtjax.envs.craft.sketched import GOAL
from mtjax.envs.parameters import Parameter
from mtjax.types import Array, Task


class Recipe(NamedTuple):
    """What a workshop makes of what."""

    product: str
    workshop: int
    inputs: tuple[str, ...]  # one of each, which are used up


RECIPES = (  # of a workshop in the order in which it makes them
    Recipe("plank", 0, ("wood",)),
    Recipe("axe", 0, ("stick", "iron")),
    Recipe("rope", 0, ("grass",)),
    Recipe("stick", 1, ("wood",)),
    Recipe("bed", 1, ("plank", "grass")),
    Recipe("shears", 1, ("stick", "iron")),
    Recipe("cloth", 2, ("grass",)),
    Recipe("bridge", 2, ("wood", "iron")),
    Recipe("ladder", 2, ("plank", "stick")),
)
ITEMS = (*(KINDS[kind] for kind in RAW), *(recipe.product for recipe in RECIPES))
_BRIDGE, _AXE = ITEMS.index("bridge"), ITEMS.index("axe")
_SKETCHES = {
    "plank": ("get-wood", "make-at-0"),
    "stick": ("get-wood", "make-at-1"),
    "cloth": ("get-grass", "make-at-2"),
    "rope": ("get-grass", "make-at-0"),
    "bridge": ("get-iron", "get-wood", "make-at-2"),
    "bed": ("get-wood", "make-at-0", "get-grass", "make-at-1"),
    "axe": ("get-wood", "make-at-1", "get-iron", "make-at-0"),
    "shears": ("get-wood", "make-at-1", "get-iron", "make-at-1"),
    "gold": ("get-iron", "get-wood", "make-at-2", "get-gold"),
    "gem": ("get-wood", "make-at-1", "get-iron", "make-at-0", "get-gem"),
}


def _counts(names: tuple[str, ...]) -> np.ndarray:
    return np.array([item in names for item in ITEMS], np.int32)


def _of_workshops(row) -> np.ndarray:
    """Return rows of the recipes of each workshop (3, 3, ...)."""
    return np.stack([[row(r) for r in RECIPES if r.workshop == i] for i in range(len(WORKSHOPS))])


_NEEDS = _of_workshops(lambda recipe: _counts(recipe.inputs))
_GAINS = _of_workshops(lambda recipe: _counts((recipe.product,)))


@dataclasses.dataclass(frozen=True)
class CraftWorld(OnGrid):
    """Craft world: gather raw materials, and make in workshops what the task asks for (Andreas et al. 2017).

    Observation (568,): which of 11 kinds of things each cell around the walker holds (5 x 5 x 11), and each block of
        5 x 5 cells in the 25 x 25 around it (5 x 5 x 11), both by x, y and kind; how many of 14 items it has; where it
        faces, as one-hot. With ``sketched`` then the symbol that is due, one-hot (576,).
    Action: 0 to 3 for down, up, left and right: turn there, and walk if that cell is empty; 4 uses what is ahead. With
        ``sketched`` 5 is STOP.
    Reward: with the number n of what the task asks for that the walker has, and k of K symbols over,
            r = 1 if n > 0, else 0
            r = 1 if n > 0 and k >= K, else 0  (sketched)
    Start: in a random cell of a random layout, with nothing, facing down.
    Episode: 100 steps. It terminates with the reward, or with ``sketched`` after the last symbol. Metric ``success`` is
        1 with the reward.

    The grid has 8 x 8 cells inside its boundary, with 4 of each of iron, grass and wood, and 3 workshops. Using raw
        material takes it. Using a workshop makes every product whose inputs are there, in this order, and uses these
        up. At 0: plank (wood), axe (stick, iron), rope (grass). At 1: stick (wood), bed (plank, grass), shears (stick,
        iron). At 2: cloth (grass), bridge (wood, iron), ladder (plank, stick). In tasks for gold one lies at the lower
        boundary in a ring of water; a bridge clears one cell of water and is used up. In tasks for a gem it lies in a
        ring of stone; an axe clears stone, and is kept. Nobody walks on things.

    Parameters that can vary:
        goal: plank, stick, cloth, rope, bridge, bed, axe, shears, gold or gem. Each has a sketch of 2 to 5 of the
            symbols get-wood, get-grass, get-iron, get-gold, get-gem, make-at-0, make-at-1 and make-at-2. The context is
            the sketch. ``split=dense`` holds out bed and axe, as in the paper: new orders of known symbols.

    Differs from the authors' code in: layouts where something cannot be reached are drawn again; entries of
    observations that are always 0 are left out; every episode is of one of ten tasks from the start, and without
    ``sketched`` an agent needs no STOP; a symbol that takes too long is over after its last action, not in place of it.
    """

    held_out: tuple[str, ...] = ("bed", "axe")
    """Names of the tasks that split=dense holds out, as its interpolation tasks."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {GOAL: Parameter("1", 0.0, minimum=-1.0, maximum=len(_SKETCHES) - 1.0, names=tuple(_SKETCHES))}
    )
    sketches: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType(_SKETCHES)
    symbols: ClassVar[tuple[str, ...]] = (
        *("get-wood", "get-grass", "get-iron", "get-gold", "get-gem"),
        *("make-at-0", "make-at-1", "make-at-2"),
    )
    num_items: ClassVar[int] = len(ITEMS)
    asks: ClassVar[str] = "Make in workshops what the task asks for."

    def facts(self) -> dict[str, np.ndarray]:
        """Return the item that each task asks for, and its treasure with the ring around it."""
        treasures = {"gold": (GOLD, WATER), "gem": (GEM, STONE)}
        return {
            "item": np.array([ITEMS.index(name) for name in self.sketches], np.int32),
            "treasure": np.array([treasures.get(name, (0, 0)) for name in self.sketches], np.int32),
        }

    def sentence(self, row: int) -> str:
        """Return what a task asks for, such as "Make a plank."."""
        name = self.name_of(row)
        if name in ("gold", "gem"):
            return "Get gold." if name == "gold" else "Get a gem."
        article = {"cloth": "", "shears": "", "axe": "an "}.get(name, "a ")
        return f"Make {article}{name}."

    def treasure(self, task: Task) -> Array:
        return task.goal["treasure"]

    def counts_of_things(self) -> dict[int, int]:
        return super().counts_of_things() | {GOLD: 1, GEM: 1, WATER: 5, STONE: 5}

    def reached(self, task: Task, world: Grid) -> Array:
        return world.held[task.goal["item"]] > 0

    def use(self, held: Array, thing: Array) -> tuple[Array, Array]:
        taken, takes = super().use(held, thing)
        bridges, cuts = (thing == WATER) & (held[_BRIDGE] > 0), (thing == STONE) & (held[_AXE] > 0)
        taken -= bridges * jax.nn.one_hot(_BRIDGE, len(ITEMS), dtype=jnp.int32)
        return make(taken, thing - WORKSHOPS[0]), takes | bridges | cuts


def make(held: Array, workshop: Array) -> Array:
    """Return the items (I,) after each recipe of a workshop, in their order, is made if its inputs are there.

    Args:
        workshop: () int32; nothing is made unless it is 0, 1 or 2.
    """
    at = (workshop >= 0) & (workshop < len(WORKSHOPS))
    number = jnp.clip(workshop, 0, len(WORKSHOPS) - 1)
    needs, gains = jnp.asarray(_NEEDS)[number], jnp.asarray(_GAINS)[number]
    for i in range(needs.shape[0]):
        held = held + (at & jnp.all(held >= needs[i])) * (gains[i] - needs[i])
    return held
