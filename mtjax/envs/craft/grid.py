"""A walled grid of things: workshops, and raw materials to take. One cell holds one thing."""

import dataclasses
import operator
from collections.abc import Mapping
from functools import partial, reduce
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.craft.sketched import Followed, Sketched
from mtjax.envs.family import draw_until
from mtjax.envs.looks import Look, from_above
from mtjax.envs.pixels import Mark
from mtjax.types import Array, InputError, Key, Task

KINDS = (
    *("empty", "boundary", "water", "stone", "workshop 0", "workshop 1", "workshop 2"),
    *("iron", "grass", "wood", "gold", "gem"),
)
EMPTY, BOUNDARY, WATER, STONE, WORKSHOP, *_ = range(len(KINDS))
IRON, GRASS, WOOD, GOLD, GEM = RAW = tuple(KINDS.index(name) for name in ("iron", "grass", "wood", "gold", "gem"))
PLENTY = (IRON, GRASS, WOOD)  # of which a grid has several
WORKSHOPS = (WORKSHOP, WORKSHOP + 1, WORKSHOP + 2)
MOVES = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])  # down, up, left and right
USE = len(MOVES)
DOWN = 0
_NEAR, _BLOCK = 2, 5  # cells to each side of the near view; cells along each side of a block of the far one
_PAINTS = {
    "water": (0.2, 0.45, 0.85, 1.0),
    "stone": (0.5, 0.5, 0.5, 1.0),
    "workshop 0": (0.75, 0.2, 0.2, 1.0),
    "workshop 1": (0.6, 0.25, 0.65, 1.0),
    "workshop 2": (0.9, 0.5, 0.1, 1.0),
    "iron": (0.2, 0.2, 0.25, 1.0),
    "grass": (0.35, 0.75, 0.25, 1.0),
    "wood": (0.5, 0.3, 0.12, 1.0),
    "gold": (0.95, 0.8, 0.1, 1.0),
    "gem": (0.5, 0.95, 0.95, 1.0),
}
_WALL, _SKIN, _NOSE = (0.35, 0.3, 0.27, 1.0), (0.95, 0.95, 0.95, 1.0), (0.1, 0.1, 0.1, 1.0)
_BITS = 32  # of a number that holds a column of cells
_LEAST, _MOST = 4, _BITS - 2  # cells
_AT_ONCE = 8  # layouts that are drawn in a round; the first sound one is taken
_UNDER = -5.0  # [m] height of what is not there


class Grid(NamedTuple):
    """A grid of N + 2 cells along each side with its boundary, and who walks in it."""

    things: Array  # (N + 2, N + 2) int32, kinds by x and y
    place: Array  # (2,) int32, x and y
    facing: Array  # () int32, a move
    held: Array  # (I,) int32, counts of items


@dataclasses.dataclass(frozen=True)
class OnGrid(Sketched):
    """A family whose worlds are grids of things. Episodes draw the grid.

    Layouts are drawn again until the walker can come to the side of every thing without taking another. For treasure
    that is the side of its ring where one cell of it is between.
    """

    cells: int = 8
    """Cells along each side, inside the boundary."""
    copies: int = 4
    """Things of each kind of raw material: iron, grass and wood."""

    num_moves: ClassVar[int] = len(MOVES) + 1
    num_items: ClassVar[int] = len(RAW)
    episode_steps: ClassVar[int] = 100

    def __post_init__(self):
        if not isinstance(self.cells, int) or not _LEAST <= self.cells <= _MOST:
            raise InputError(f"cells must be a whole number from {_LEAST} to {_MOST}, not {self.cells}")
        if not 1 <= self.copies <= self.most_copies:
            most = f"{self.most_copies} with cells={self.cells}, so that a third of the cells is free"
            raise InputError(f"copies must be at least 1 and at most {most}, not {self.copies}")
        super().__post_init__()

    @property
    def most_copies(self) -> int:
        """Return the most things of a kind that leave a third of the cells free, beside a treasure with its ring."""
        return max((2 * (self.cells**2 - 9) // 3 - len(WORKSHOPS)) // len(PLENTY), 1)

    # Layouts.

    def begin(self, task: Task, key: Key) -> Grid:
        # Many worlds are drawn until the last of them is sound, and an accelerator waits for the host after each round.
        def draw(key: Key) -> tuple[Grid, Array]:
            each = jax.vmap(partial(self.lay_out, self.treasure(task)))(jax.random.split(key, _AT_ONCE))
            sound = jax.vmap(reachable)(each)
            first = jnp.argmax(sound)
            return jax.tree.map(lambda x: x[first], each), sound[first]

        return draw_until(lambda drawn: drawn[1], draw, key)[0]

    def treasure(self, task: Task) -> Array:
        """Return the kinds () of a treasure and of the ring around it; 0 for none."""
        return jnp.zeros(2, jnp.int32)

    def lay_out(self, treasure: Array, key: Key) -> Grid:
        """Draw a grid: a treasure (2,) beside the lower boundary, all other things and the walker anywhere."""
        place_key, order_key = jax.random.split(key)
        x, y = np.meshgrid(np.arange(self.cells), np.arange(self.cells), indexing="ij")
        middle = jax.random.randint(place_key, (), 0, self.cells)
        ring, inmost = (jnp.abs(x - middle) <= 1) & (y <= 1), (x == middle) & (y == 0)
        things = jnp.where(inmost, treasure[0], jnp.where(ring, treasure[1], EMPTY)).astype(jnp.int32)
        lots = jax.random.uniform(order_key, things.shape) - (things != EMPTY)
        each = np.array([*np.repeat(PLENTY, self.copies), *WORKSHOPS], np.int32)
        # The barrier keeps XLA from sorting all lots, which takes a CPU three times as long.
        order = jax.lax.optimization_barrier(jax.lax.top_k(lots.ravel(), len(each) + 1)[1])
        things = things.ravel().at[order[:-1]].set(each).reshape(x.shape)
        place = 1 + jnp.stack(jnp.divmod(order[-1], self.cells))
        walled = jnp.pad(things, 1, constant_values=BOUNDARY)
        return Grid(walled, place, jnp.int32(DOWN), jnp.zeros(self.num_items, jnp.int32))

    # Steps.

    def move(self, task: Task, world: Grid, chosen: Array) -> Grid:
        walks = chosen < USE
        facing = jnp.where(walks, chosen, world.facing)
        ahead = world.place + jnp.asarray(MOVES, jnp.int32)[facing]
        thing = world.things[ahead[0], ahead[1]]
        place = jnp.where(walks & (thing == EMPTY), ahead, world.place)
        held, clears = self.use(world.held, thing)
        used = chosen == USE
        things = world.things.at[ahead[0], ahead[1]].set(jnp.where(used & clears, EMPTY, thing))
        return Grid(things, place, facing, jnp.where(used, held, world.held))

    def use(self, held: Array, thing: Array) -> tuple[Array, Array]:
        """Return the items (I,) after the thing ahead is used, and whether () that clears its cell: raw ones are taken.

        Args:
            thing: () int32, its kind.
        """
        takes = thing >= IRON
        return held + takes * jax.nn.one_hot(thing - IRON, self.num_items, dtype=jnp.int32), takes

    # What is seen.

    def view(self, task: Task, world: Grid) -> Array:
        near, far = surroundings(world)
        facing = jax.nn.one_hot(world.facing, len(MOVES))
        return jnp.concatenate([near.ravel(), far.ravel(), world.held.astype(jnp.float32), facing])

    @property
    def look(self) -> Look:  # type: ignore[override]
        """Return the view from above."""
        return from_above((self.cells + 1) / 2, self.cells + 2)

    def counts_of_things(self) -> dict[int, int]:
        """Return how many things of each kind a grid has at most."""
        return {**dict.fromkeys(WORKSHOPS, 1), **dict.fromkeys(PLENTY, self.copies)}

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return floor, boundary, every thing that there may be, and the walker. Cell (x, y) is about that point."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        add, end, middle = spec.worldbody.add_geom, self.cells + 1, (self.cells + 1) / 2
        add(name="floor", type=geom.mjGEOM_PLANE, pos=[middle, middle, 0], size=[end / 2 + 0.5, end / 2 + 0.5, 0.1])
        for i, (x, y) in enumerate(((0, middle), (end, middle), (middle, 0), (middle, end))):
            size = [0.5, middle + 0.5, 0.5] if y == middle else [middle + 0.5, 0.5, 0.5]
            add(name=f"wall {i}", type=geom.mjGEOM_BOX, pos=[x, y, 0.0], size=size, rgba=_WALL)
        for kind, count in self.counts_of_things().items():
            size = [0.48, 0.48, 0.2] if kind < IRON else [0.3, 0.3, 0.2]
            for i in range(count):
                name, rgba = f"{KINDS[kind]} {i}", _PAINTS[KINDS[kind]]
                add(name=name, type=geom.mjGEOM_BOX, pos=[0, 0, _UNDER], size=size, rgba=rgba)
        add(name="walker", type=geom.mjGEOM_CYLINDER, size=[0.35, 0.3, 0], rgba=_SKIN)
        add(name="nose", type=geom.mjGEOM_SPHERE, size=[0.15, 0, 0], rgba=_NOSE)
        return spec

    def marks(self, task: Task, state: Followed) -> dict[str, Mark]:
        """Return where the things and the walker are. Things that are not there are under the floor."""
        world: Grid = state.world
        nose = world.place + 0.3 * jnp.asarray(MOVES)[world.facing]
        marks = {"walker": Mark(jnp.append(world.place, 0.3)), "nose": Mark(jnp.append(nose, 0.6))}
        for kind, count in self.counts_of_things().items():
            x, y = jnp.nonzero(world.things == kind, size=count, fill_value=-1)
            places = jnp.stack([x, y, jnp.where(x < 0, _UNDER, 0.2)], axis=1)
            marks |= {f"{KINDS[kind]} {i}": Mark(places[i]) for i in range(count)}
        return marks


def surroundings(world: Grid) -> tuple[Array, Array]:
    """Return which kinds (5, 5, K) the cells around the walker hold, and the blocks (5, 5, K) of 5 x 5 cells around it.

    What is off the grid holds nothing. Kinds are all but "empty".
    """
    wide = 2 * _NEAR + 1
    reach = _BLOCK * wide // 2
    sets = jnp.where(world.things == EMPTY, 0, 1 << jnp.maximum(world.things - 1, 0))  # of kinds, a bit for each
    around = jax.lax.dynamic_slice(jnp.pad(sets, reach), world.place, 2 * [_BLOCK * wide])
    near = around[reach - _NEAR : reach + _NEAR + 1, reach - _NEAR : reach + _NEAR + 1]
    blocks = jnp.moveaxis(around.reshape(wide, _BLOCK, wide, _BLOCK), (1, 3), (0, 1))
    far = reduce(operator.or_, blocks.reshape(-1, wide, wide))
    members = lambda sets: (sets[..., None] >> np.arange(len(KINDS) - 1) & 1).astype(jnp.float32)
    return members(near), members(far)


def reachable(world: Grid) -> Array:
    """Return whether () the walker can come to the side of all raw material, workshops and treasure, as they lie."""
    things, (x, y) = world.things, world.place
    free = columns(things == EMPTY)
    start = jnp.zeros_like(free).at[x].set(1 << y.astype(jnp.uint32))
    grow = lambda seen: fill(seen | beside(seen) & free, free)
    changes = lambda cells: jnp.any(cells[0] != cells[1])
    _, seen = jax.lax.while_loop(changes, lambda cells: (cells[1], grow(cells[1])), (jnp.zeros_like(start), start))
    at_hand = spread(seen)
    treasure, ring = columns(things >= GOLD), columns((things == WATER) | (things == STONE))
    crossed = ~jnp.any(treasure) | jnp.any(at_hand & ring & spread(treasure))
    wanted = columns((things >= WORKSHOP) & (things < GOLD))
    return ~jnp.any(wanted & ~at_hand) & crossed


# Sets of cells are (N,) uint32: a number for each x, with a bit for each y. None has cells of the outermost ones.


def columns(cells: Array) -> Array:
    """Return the set of the cells (N, N) bool."""
    return jnp.sum(cells.astype(jnp.uint32) << np.arange(cells.shape[1], dtype=np.uint32), axis=1, dtype=jnp.uint32)


def beside(cells: Array) -> Array:
    """Return the cells to the left and to the right of these."""
    padded = jnp.pad(cells, 1)
    return padded[2:] | padded[:-2]


def spread(cells: Array) -> Array:
    """Return these cells, and those that share a side with one of them."""
    return cells | cells << 1 | cells >> 1 | beside(cells)


def fill(cells: Array, free: Array) -> Array:
    """Return these free cells, and the free ones that lie below and above without another between."""
    below = above = cells
    open_below = open_above = free
    for i in range(_BITS.bit_length() - 1):
        below, open_below = below | open_below & below >> (1 << i), open_below & open_below >> (1 << i)
        above, open_above = above | open_above & above << (1 << i), open_above & open_above << (1 << i)
    return below | above
