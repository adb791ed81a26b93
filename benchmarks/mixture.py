"""Measure returns and the cost of a step on ten tasks of dm_control with ten models in one program.

    python benchmarks/mixture.py [--agents NAME ...] [--alone NAME ...] [--steps N] [--minutes 8] [--out DIR]

Parts are the agents on the mixture, each task alone (by sac-conditioned, which is then plain SAC, with the same
preset, steps, environments and updates per task) and the cost of a step. Each part writes a file into DIR, and finished
parts are not run again. After ``--minutes`` no further part begins; the same command continues with the rest. Several
processes may run other parts in the same DIR, if times do not matter. All results in DIR together give ``returns.csv``,
``table.md`` and ``mixture.json``.

A return is the mean of the last evaluation under the mean action, over episodes and seeds. ``disjoint`` is one SAC for
every task inside the mixture: beside "alone" it shows that padding and masks lose nothing. The cost is the median time
of a step of every world, without resets, by random actions; a family alone has as many worlds as in the mixture.
"""

import argparse
import csv
import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from parts import whole
from report import markdown, record, run_main, settings_of

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.envs.mixtures import States
from mtjax.learning.rollout import broadcast_tasks

TASKS = (
    "cartpole-swingup",
    "pendulum-swingup",
    "acrobot-swingup",
    "reacher-easy",
    "finger-spin",
    "ball-in-cup-catch",
    "point-mass-easy",
    "hopper-stand",
    "walker-walk",
    "cheetah-run",
)
AGENTS = ("sac-conditioned", "care", "multi-head", "pcgrad", "brc", "disjoint")
_ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS, metavar="NAME")
    parser.add_argument("--agents", nargs="*", default=AGENTS, choices=list(mtjax.AGENTS), metavar="NAME")
    parser.add_argument("--alone", nargs="*", metavar="NAME", help="tasks to learn alone; by default all")
    parser.add_argument("--steps", type=whole, default=1_000_000, help="environment steps of each task")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--num-envs", type=int, default=512, help="environments of each task")
    parser.add_argument("--updates-per-step", type=int, default=16)
    parser.add_argument("--episodes", type=int, default=10, help="of each task in an evaluation")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="such as replay_size=100000")
    parser.add_argument("--timed-steps", type=int, default=100, help="steps in a timed call; 0 leaves the cost out")
    parser.add_argument("--minutes", type=float, default=8.0, help="after which no further part begins")
    parser.add_argument("--out", type=Path, default=Path("runs") / "mixture")
    arguments = parser.parse_args()
    enable_compile_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    left = []
    for name, run in parts(arguments):
        file = arguments.out / f"{name}.json"
        if file.exists():
            continue
        if time.monotonic() - started > 60 * arguments.minutes:
            left.append(name)
            continue
        print(name, flush=True)
        file.write_text(json.dumps(record(arguments, run()), indent=1, default=str) + "\n")
        summarise(arguments)
    print(summarise(arguments))
    if left:
        print(f"not begun: {', '.join(left)}; the same command goes on with them")


def parts(arguments: argparse.Namespace) -> Iterator[tuple[str, Any]]:
    """Return every part's name and the function that runs it."""
    if arguments.timed_steps:
        yield "cost", lambda: cost(arguments)
    everything = "+".join(arguments.tasks)
    for agent in arguments.agents:
        yield f"agent-{agent}", lambda agent=agent: learn(arguments, everything, agent)
    for task in arguments.tasks if arguments.alone is None else arguments.alone:
        yield f"alone-{task}", lambda task=task: learn(arguments, task, "sac-conditioned")


# What is learned.


def learn(arguments: argparse.Namespace, env_name: str, agent: str) -> dict[str, Any]:
    """Train one agent. A task alone uses the preset of the mixture, not its own tuned preset."""
    config = mtjax.preset("+".join(arguments.tasks), agent, arguments.preset)
    family = mtjax.make(env_name, **engine(arguments, env_name))
    steps = arguments.steps * family.train_count
    result = mtjax.train(
        family,
        config.learner,
        steps=steps,
        seeds=arguments.seeds,
        eval_every=-(-steps // 2),
        eval_episodes=arguments.episodes,
        settings=config.training,
        num_envs=arguments.num_envs,
        updates_per_step=arguments.updates_per_step,
        quiet=False,
        **settings_of(arguments.training),
    )
    returns = result.evaluations.returns["train"].mean(axis=-1)  # (S, V, T)
    names = family.labels("train") if "+" in env_name else [env_name]
    return {
        "tasks": names,
        "steps": result.evaluations.steps.tolist(),
        "returns": {name: returns[:, :, i].tolist() for i, name in enumerate(names)},
        "seconds": result.seconds,
        "compile_seconds": result.compile_seconds,
        "steps_per_second": steps * arguments.seeds / result.seconds,
    }


def engine(arguments: argparse.Namespace, env_name: str) -> dict[str, Any]:
    """Return the setting of the engine, if families have one."""
    families = [mtjax.make(name) for name in env_name.split("+")]
    return {"engine": arguments.engine} if any("engine" in vars(family) for family in families) else {}


# What a step costs.


def cost(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time a step of every world of each family, and of the mixture of them."""
    env = mtjax.mixture([mtjax.make(name, **engine(arguments, name)) for name in arguments.tasks])
    states, contestants = {}, {}
    for part in env.parts:
        before = time.perf_counter()
        states[part.name] = begin(part.family, arguments.num_envs)
        contestants[part.name] = Stepper(part.family, states[part.name], arguments)
        print(f"  {part.name}: ready in {time.perf_counter() - before:.1f} s", flush=True)
    together = States(env.tasks().blocks, tuple(states.values()))
    contestants["mixture"] = Stepper(env, together, arguments)
    for _ in range(_ROUNDS):  # in turn, so that what else the machine does falls on all of them
        for each in contestants.values():
            each.time()
    milliseconds = {name: 1e3 * statistics.median(each.seconds) for name, each in contestants.items()}
    whole = milliseconds.pop("mixture")
    total = sum(milliseconds.values())
    return {
        "milliseconds": milliseconds,
        "sum": total,
        "mixture": whole,
        "ratio": whole / total,
        "engines": {part.name: part.family.engine_name for part in env.parts},
        "compile_seconds": {name: each.compile_seconds for name, each in contestants.items()},
    }


def begin(family: Any, num_envs: int) -> Any:
    """Return the states of a family's worlds at the start of episodes."""
    tasks = family.tasks()
    keys = jax.random.split(jax.random.key(0), (1, len(tasks.id), num_envs))
    return jax.jit(lambda tasks, keys: family.reset_worlds(broadcast_tasks(tasks, keys.shape), keys).state)(tasks, keys)


class Stepper:
    """A compiled program that takes some steps of all worlds of an environment under random actions."""

    def __init__(self, env: Any, states: Any, arguments: argparse.Namespace):
        tasks, count = env.tasks(), arguments.timed_steps
        shape = (1, len(tasks.id), arguments.num_envs)

        def play(tasks, states, key):
            def step(states, key):
                actions = env.spec.action.random(key, shape)
                stepped = env.step_worlds(broadcast_tasks(tasks, shape), states, actions)
                return stepped.state, jnp.sum(stepped.reward)

            return jax.lax.scan(step, states, jax.random.split(key, count))

        before = time.perf_counter()
        program = jax.jit(play).lower(tasks, states, jax.random.key(0)).compile()
        self.compile_seconds = time.perf_counter() - before
        self.run = lambda: jax.block_until_ready(program(tasks, states, jax.random.key(1)))
        self.count, self.seconds = count, []
        self.run()

    def time(self) -> None:
        """Run it once."""
        before = time.perf_counter()
        self.run()
        self.seconds.append((time.perf_counter() - before) / self.count)


# Reporting.


def summarise(arguments: argparse.Namespace) -> str:
    """Print all finished parts, and write the files that join them."""
    found = {file.stem: json.loads(file.read_text()) for file in sorted(arguments.out.glob("*-*.json"))}
    alone = {name: part for part in found.values() if len(part["tasks"]) == 1 for name in part["tasks"]}
    agents = {name.removeprefix("agent-"): part for name, part in found.items() if name.startswith("agent-")}
    last = lambda part, task: float(np.mean(part["returns"][task], axis=0)[-1])
    score = lambda part, task: last(part, task) if part is not None and task in part["returns"] else None
    columns = {"alone": {task: score(alone.get(task), task) for task in arguments.tasks}}
    columns |= {name: {task: score(part, task) for task in arguments.tasks} for name, part in agents.items()}
    rows = [{"task": task, **{name: column[task] for name, column in columns.items()}} for task in arguments.tasks]
    with (arguments.out / "returns.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["task", *columns])
        writer.writeheader()
        writer.writerows(rows)
    cell = lambda x: "-" if x is None else f"{x:.0f}"
    lines = [[row["task"], *(cell(row[name]) for name in columns)] for row in rows]
    known = {name: [x for x in column.values() if x is not None] for name, column in columns.items()}
    means = {name: float(np.mean(x)) if len(x) == len(rows) else None for name, x in known.items()}
    lines.append(["mean", *(cell(means[name]) for name in columns)])
    lines.append(["seconds", "-", *(f"{part['seconds']:.0f}" for part in agents.values())])
    lines.append(["compile seconds", "-", *(f"{part['compile_seconds']:.0f}" for part in agents.values())])
    text = markdown(["task", *columns], lines)
    file = arguments.out / "cost.json"
    price = json.loads(file.read_text()) if file.exists() else None
    if price is not None:
        each = [[name, price["engines"][name], f"{x:.2f}"] for name, x in price["milliseconds"].items()]
        each += [["sum", "", f"{price['sum']:.2f}"], ["mixture", "", f"{price['mixture']:.2f}"]]
        text += "\n\n" + markdown(["family", "engine", "ms a step of all its worlds"], each)
        text += f"\n\nThe mixture's step takes {price['ratio']:.2f} of the sum of its parts."
    (arguments.out / "table.md").write_text(text + "\n")
    report = record(arguments, {"returns": rows, "parts": found, "cost": price})
    (arguments.out / "mixture.json").write_text(json.dumps(report, indent=1, default=str) + "\n")
    return text


if __name__ == "__main__":
    run_main(main)
