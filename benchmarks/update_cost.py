"""Measure the time of an update of every agent that learns from replay, compared with plain SAC.

    python benchmarks/update_cost.py [--agents NAME ...] [--tasks 10 50] [--seeds 1 10] [--pictures 64] [--json FILE]

One update: 10 tasks, 128 transitions a task, hidden layers of 3 x 400 in actor and critics, on the observations of the
finger (9 numbers, 2 actions); the same for all. Updates run in a scan, as they do in training. All agents of a setting
are compiled first and then timed in turn, round after round, so that what else the machine does falls on all of them:
times are medians over rounds, ratios medians of each round's ratio to ``sac``. With ``--pictures`` agents see stacks of
three square pictures of this side, and ratios are to ``drq``.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from report import markdown, publish, run_main

import mtjax
from mtjax import frames
from mtjax.experience.replay import Replay
from mtjax.parallel.axes import over_seeds
from mtjax.types import Spec, Task, Transition

SPEC = Spec.vector(obs_size=9, action_size=2, context_size=1)
AGENTS = [name for name in mtjax.AGENTS if isinstance(mtjax.agent(name).experience, Replay)]
_ON_CPU = jax.default_backend() == "cpu"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=AGENTS, choices=AGENTS)
    parser.add_argument("--tasks", type=int, nargs="+", default=[10])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--batch", type=int, default=128, help="transitions a task")
    parser.add_argument("--hidden", type=int, nargs="+", default=[400, 400, 400])
    parser.add_argument("--pictures", type=int, help="the side of pictures that agents see in place of numbers")
    parser.add_argument("--updates", type=int, default=3 if _ON_CPU else 100, help="in a timed call")
    parser.add_argument("--repeats", type=int, default=7, help="rounds")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rows = []
    for num_tasks in arguments.tasks:
        for num_seeds in arguments.seeds:
            rows += compare(arguments, num_tasks, num_seeds)
    print(table(rows), flush=True)
    publish(arguments, rows)


def compare(arguments: argparse.Namespace, num_tasks: int, num_seeds: int) -> list[dict]:
    """Time all agents in turn, and return their rows."""
    first = "drq" if arguments.pictures else "sac"
    names = [first, *(name for name in arguments.agents if name != first)]
    spec = seeing(arguments.pictures)
    contestants = [Contestant(name, arguments, num_tasks, num_seeds, spec) for name in names]
    for _ in range(arguments.repeats):
        for contestant in contestants:
            contestant.time()
    plain = contestants[0]
    return [contestant.row(plain) for contestant in contestants]


class Contestant:
    """One agent's compiled updates, and the seconds that an update took in each round."""

    def __init__(self, name: str, arguments: argparse.Namespace, num_tasks: int, num_seeds: int, spec: Spec = SPEC):
        self.name, self.updates, self.seconds = name, arguments.updates, []
        self.num_tasks, self.num_seeds = num_tasks, num_seeds
        agent = mtjax.agent(name, hidden=arguments.hidden)
        tasks, keys = tasks_of(num_tasks), jax.random.split(jax.random.key(0), num_seeds)
        window = random_window(spec, num_tasks, arguments.batch)
        self.state = jax.jit(jax.vmap(lambda key: agent.init(spec, tasks, key)))(keys)
        networks = [self.state.nets[net] for net in ("actor", "critic", "representation", "knowing")]
        self.num_parameters = size_of(networks) // num_seeds

        self.learn = updates(agent, tasks, window, arguments.updates)
        before = time.perf_counter()
        self.run = jax.jit(self.learn, donate_argnums=0).lower(self.state, keys).compile()
        self.compile_seconds, self.keys = time.perf_counter() - before, keys
        self.time(count=False)

    def time(self, count: bool = True) -> None:
        before = time.perf_counter()
        self.state = jax.block_until_ready(self.run(self.state, self.keys))
        if count:
            self.seconds.append((time.perf_counter() - before) / self.updates)

    def row(self, plain: "Contestant") -> dict:
        ratios = [own / other for own, other in zip(self.seconds, plain.seconds, strict=True)]
        return {
            "agent": self.name,
            "tasks": self.num_tasks,
            "seeds": self.num_seeds,
            "milliseconds": round(1e3 * statistics.median(self.seconds), 4),
            "fastest": round(1e3 * min(self.seconds), 4),
            "slowest": round(1e3 * max(self.seconds), 4),
            "over_sac": round(statistics.median(ratios), 3),
            "parameters": self.num_parameters,
            "compile_seconds": round(self.compile_seconds, 1),
        }


def updates(agent: Any, tasks: Task, window: Transition, count: int) -> Callable:
    """Return a function of states (S, ...) and keys (S,), which makes so many updates of every seed in a scan."""
    update = lambda state, key: agent.update(state, window, tasks, key, jnp.int32(0))
    return over_seeds(lambda state, key: jax.lax.scan(update, state, jax.random.split(key, count))[0], 0, 0)


def tasks_of(num_tasks: int) -> Task:
    row = jnp.arange(num_tasks, dtype=jnp.int32)
    horizon = jnp.full(num_tasks, 1000, jnp.int32)
    return Task(row, row, jnp.linspace(-1, 1, num_tasks)[:, None], {}, {}, {}, horizon)


def seeing(side: int | None) -> Spec:
    """Return the spec of agents that see numbers, or stacks of three pictures of this side."""
    if side is None:
        return SPEC
    return SPEC._replace(obs={frames.PICTURES: jax.ShapeDtypeStruct((side, side, 3), jnp.uint8)}, frames=3)


def random_window(spec: Spec, num_tasks: int, batch_size: int) -> Transition:
    """Draw windows (T, B, 1, ...) of one step."""
    random, lead = np.random.default_rng(0), (num_tasks, batch_size, 1)
    normal = lambda *shape: jnp.float32(random.normal(size=(*lead, *shape)))
    draw = lambda x: (
        jnp.uint8(random.integers(256, size=(*lead, *x.shape))) if x.dtype == jnp.uint8 else normal(*x.shape)
    )
    observe = lambda: jax.tree.map(draw, frames.seen(spec))
    obs, action, next_obs = observe(), jnp.tanh(normal(spec.action_size)), observe()
    return Transition(obs, action, normal(), jnp.ones(lead), next_obs)


def size_of(tree: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def table(rows: list[dict]) -> str:
    """Return the figures as a table, whose first row is of the agent that others are compared with."""
    head = ["agent", "tasks", "seeds", "ms an update", "range", f"over {rows[0]['agent']}", "parameters", "compiled in"]
    cells = lambda row: [
        *(str(row[name]) for name in ("agent", "tasks", "seeds")),
        f"{row['milliseconds']:.3g}",
        f"{row['fastest']:.3g} to {row['slowest']:.3g}",
        f"{row['over_sac']:.2f}",
        f"{row['parameters']:,}",
        f"{row['compile_seconds']:.1f} s",
    ]
    return markdown(head, [cells(row) for row in rows])


if __name__ == "__main__":
    run_main(main)
