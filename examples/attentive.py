"""How many sub-networks twenty tasks need that state and task can mix: each walks a grid under actions of its own.

python examples/attentive.py [--seeds=3] [--out=attentive.png]

Attentive sharing (Bram et al. 2019) is the encoder ``attentive``. The first table is of two tasks in a corridor, whose
actions are swapped: whoever does not see the task reaches the right end in one of the two, whatever it does. The second
is of twenty tasks, five orders of the actions for each of four corners, and has the agent ``disjoint`` beside it, whose
tasks have networks of their own. The figure is of the weights in the last one: what each task uses in each cell.
"""

import argparse
import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mtjax
from mtjax.agents import for_action
from mtjax.agents.state import of_task
from mtjax.learning import loop
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.parallel import axes
from mtjax.report import figures, stats
from mtjax.types import Array, Discrete, Key, Spec, Step, Task

MOVES = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
ORDERS = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0), (2, 3, 1, 0))
"""The move of each action, by tasks: the first two are swapped."""


class Place(NamedTuple):
    """The state of a grid."""

    cell: Array  # (2,) int32, x and y


@dataclasses.dataclass(frozen=True)
class Grid:
    """Walk to the corner that the task asks for, by actions whose meaning differs between tasks.

    Observation (width height,): the cell, one-hot. Action: one of four moves, by the task's order. Reward: 1 in the
    task's corner. Start: any cell but the corners. Episode: 20 steps; it terminates in any corner.
    """

    ends_early: ClassVar[bool] = True
    reset_batches: ClassVar[int] = 16
    cheap_starts: ClassVar[bool] = False
    finite_horizon: ClassVar[bool] = False
    width: int = 7
    height: int = 7
    orders: tuple[tuple[int, ...], ...] = ORDERS
    all_corners: bool = True
    """Ask for each corner under every order; else for the last one alone."""
    episode_length: int = 20

    @property
    def corners(self) -> np.ndarray:
        """Return the corners (4, 2), or the ends (2, 2) of a corridor."""
        return np.unique([(x, y) for x in (0, self.width - 1) for y in (0, self.height - 1)], axis=0)

    @property
    def spec(self) -> Spec:
        """Return the sizes of observations, actions and contexts."""
        return Spec.vector(self.width * self.height, 4, len(self.tasks().id))._replace(action=Discrete(4))

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks, whose context is their number, one-hot."""
        corners = self.corners if self.all_corners else self.corners[-1:]
        pairs = [(order, corner) for order in self.orders for corner in corners]
        orders, goals = (np.array(each, np.int32) for each in zip(*pairs, strict=True))
        row = jnp.arange(len(pairs), dtype=jnp.int32)
        leaves: dict[str, Any] = {"id": row, "row": row, "context": jnp.eye(len(row)), "params": {}, "model": {}}
        goal = {"order": jnp.asarray(orders), "corner": jnp.asarray(goals)}
        return Task(**leaves, goal=goal, horizon=jnp.full_like(row, self.episode_length))

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode in any cell but the corners."""
        cells = np.array([(x, y) for x in range(self.width) for y in range(self.height)])
        inside = cells[~(cells[:, None] == self.corners).all(axis=-1).any(axis=1)]
        cell = jnp.asarray(inside, jnp.int32)[jax.random.randint(key, (), 0, len(inside))]
        return self._step(task, Place(cell), jnp.bool_(False))

    def step(self, task: Task, state: Place, action: Array) -> Step:
        """Move, and stay at the grid's edge."""
        moved = state.cell + jnp.asarray(MOVES, jnp.int32)[task.goal["order"][action]]
        cell = jnp.clip(moved, 0, jnp.array([self.width, self.height]) - 1)
        return self._step(task, Place(cell), jnp.any(jnp.all(cell == self.corners, axis=1)))

    def _step(self, task: Task, state: Place, terminated: Array) -> Step:
        reward = jnp.all(state.cell == task.goal["corner"]).astype(jnp.float32)
        obs = jax.nn.one_hot(state.cell[0] * self.height + state.cell[1], self.width * self.height)
        return Step(state, obs, reward * terminated, terminated)

    reset_worlds, step_worlds, renew_worlds = axes.reset_worlds, axes.step_worlds, axes.renew_worlds
    observe_worlds, where_worlds = axes.observe_worlds, staticmethod(axes.where_worlds)


CORRIDOR = Grid(height=1, orders=ORDERS[:2], all_corners=False)
SETTINGS = {
    **{"hidden": (32,), "actor_lr": 3e-3, "critic_lr": 3e-3, "gamma": 0.95, "unroll": 16, "minibatches": 4},
    **{"normalize_observations": False, "conditioning": "one-hot"},
}


def made(**settings: Any) -> Any:
    """Return PPO for such grids."""
    return for_action(mtjax.agent("ppo", **SETTINGS | settings), Discrete(4))


def shared(count: int) -> Any:
    """Return PPO whose actor and critic each have so many sub-networks, which tasks mix."""
    return made(encoder="attentive", num_subnetworks=count, attention_widths=(32,))


def learned(env: Grid, agent: Any, iterations: int, seeds: int = 1, num_envs: int = 16) -> tuple[Any, np.ndarray]:
    """Train, and return the agents' states (S, ...) and which share (S, T) of 50 episodes then ends in the corner."""
    settings, tasks, runs = (
        loop.Settings(num_envs=num_envs, chunk_steps=16 * iterations),
        env.tasks(),
        jnp.arange(seeds),
    )
    state, _ = loop.run_chunk(env, agent, settings, tasks, loop.init(env, agent, settings, tasks, runs))
    scores = evaluate(env, agent, Episodes(50), state.agent, tasks, runs, jnp.int32(0))
    return state.agent, np.asarray(scores.returns).mean(axis=2)


def weights_of(env: Grid, agent: Any, state: Any) -> np.ndarray:
    """Return the weights (T, width height, K) of the actor's sub-networks in every cell, of one seed's state."""
    tasks, cells = env.tasks(), jnp.eye(env.width * env.height)

    def of(number: Array, task: Task) -> Array:
        nets = of_task(state.nets, number)
        inputs = agent.view.actor_inputs(nets, agent.view.features(state, task), cells)
        body = nets["actor"].parts["body"]
        _, seen = agent.actor.body.apply(body, inputs[1], inputs[0], mutable="intermediates")
        return seen["intermediates"]["weights"][0]

    return np.asarray(jax.vmap(of)(tasks.id, tasks))


def draw(env: Grid, weights: np.ndarray, out: str) -> None:
    """Draw which sub-network has the most weight in each cell, a small map for every task; its shade is the weight."""
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    colours = np.array([to_rgb(figures.colour(k)) for k in range(weights.shape[-1])])
    names = [f"{x} {y}" for x in ("left", "right") for y in ("bottom", "top")]
    figure = Figure(figsize=(7, 5.2), dpi=80, layout="constrained")
    panels = figure.subplots(len(names), len(env.orders))
    for number, panel in enumerate(np.ravel(panels, order="F")):
        most = weights[number].argmax(axis=-1)
        share = weights[number].max(axis=-1, keepdims=True)
        shades = (1 - share + share * colours[most]).reshape(env.width, env.height, 3)
        panel.imshow(np.swapaxes(shades, 0, 1), origin="lower")
        panel.set_xticks([])
        panel.set_yticks([])
    for panel, order in zip(panels[0], env.orders, strict=True):
        panel.set_title("".join("→←↑↓"[move] for move in order), fontsize=10)
    for panel, name in zip(panels[:, 0], names, strict=True):
        panel.set_ylabel(name, fontsize=8)
    figure.savefig(out)


def tell(name: str, returns: np.ndarray) -> None:
    """Print the mean over tasks of returns (S, T), with its interval over seeds."""
    print(f"{name:28} {stats.seed_interval(returns.mean(axis=1)):.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", default="attentive.png")
    arguments = parser.parse_args()
    for count in (1, 2):
        tell(f"two tasks, K = {count}", learned(CORRIDOR, shared(count), 200, arguments.seeds)[1])
    env = Grid()
    tell("twenty tasks, disjoint", learned(env, made(heads="disjoint", conditioning="none"), 200, arguments.seeds)[1])
    for count in (1, 2, 5):
        agent = shared(count)
        states, returns = learned(env, agent, 200, arguments.seeds)
        tell(f"twenty tasks, K = {count}", returns)
    draw(env, weights_of(env, agent, jax.tree.map(lambda x: x[0], states)), arguments.out)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    main()
