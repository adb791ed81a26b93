"""Measure returns and the cost of a step on ten tasks of dm_control with ten models in one program.

    python benchmarks/mixture.py [--ways cost agent-care alone-finger-spin ...] [--steps N] [--seeds 1]
                                 [--within SECONDS] [--devices 0 ...] [--out DIR]

Ways are the cost of a step (``cost``), agents on the mixture (``agent-NAME``) and a task alone (``alone-NAME``) by
sac-conditioned, which is then plain SAC, with the same preset, steps, environments and updates per task. Every way is a
process of its own, and writes ``OUT/WAY.json``. Finished ways are not run again. All results in DIR together give
``table.md``. Times hold only where a way has the machine to itself.

A return is the mean of the last evaluation under the mean action, over episodes and seeds. ``disjoint`` is one SAC for
every task inside the mixture: beside "alone" it shows that padding and masks lose nothing. The cost is the median time
of a step of every world, without resets, by random actions; a family alone has as many worlds as in the mixture.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import parts
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
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="NAME")
    parser.add_argument(
        "--ways", nargs="+", metavar="WAY", help="by default all, with these agents: " + ", ".join(AGENTS)
    )
    parser.add_argument("--steps", type=parts.whole, default=1_000_000, help="environment steps of each task")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--num-envs", type=int, default=512, help="environments of each task")
    parser.add_argument("--updates-per-step", type=int, default=16)
    parser.add_argument("--episodes", type=int, default=10, help="of each task in an evaluation")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="such as replay_size=100000")
    parser.add_argument("--timed-steps", type=int, default=100, help="steps in a timed call")
    parser.add_argument("--out", type=Path, default=Path("runs") / "mixture")
    parts.add_flags(parser)
    arguments = parser.parse_args()
    alone = [f"alone-{task}" for task in arguments.tasks]
    arguments.ways = arguments.ways or ["cost", *(f"agent-{agent}" for agent in AGENTS), *alone]
    parts.run_ways(__file__, arguments, measure, lambda out: table(out, arguments.tasks))


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Run a way, and write its figures."""
    enable_compile_cache()
    kind, _, name = way.partition("-")
    match kind:
        case "cost":
            figures = cost(arguments)
        case "agent":
            figures = learn(arguments, "+".join(arguments.tasks), name)
        case _:
            figures = learn(arguments, name, "sac-conditioned")
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))


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


def table(out: Path, tasks: list[str]) -> str:
    """Return the last returns by task of all ways that have finished, and what a step costs."""
    found = parts.results_of(out, sorted(path.stem for path in out.glob("*.json")))
    agents = {name.removeprefix("agent-"): x for name, x in found.items() if name.startswith("agent-")}
    alone = {task: found[f"alone-{task}"]["returns"][task] for task in tasks if f"alone-{task}" in found}
    returns = {"alone": alone} | {name: x["returns"] for name, x in agents.items()}  # (S, V) of each task
    last = {name: {task: np.mean(x[task], axis=0)[-1] for task in tasks if task in x} for name, x in returns.items()}
    lines = [[task, *(f"{x[task]:.0f}" if task in x else "-" for x in last.values())] for task in tasks]
    lines.append(["mean", *(f"{np.mean([*x.values()]):.0f}" if len(x) == len(tasks) else "-" for x in last.values())])
    for clock in ("seconds", "compile_seconds"):
        lines.append([clock.replace("_", " "), "-", *(f"{x[clock]:.0f}" for x in agents.values())])
    text = markdown(["task", *last], lines)
    if "cost" not in found:
        return text
    price = found["cost"]
    each = [[name, price["engines"][name], f"{x:.2f}"] for name, x in price["milliseconds"].items()]
    each += [["sum", "", f"{price['sum']:.2f}"], ["mixture", "", f"{price['mixture']:.2f}"]]
    text += "\n\n" + markdown(["family", "engine", "ms a step of all its worlds"], each)
    return text + f"\n\nThe mixture's step takes {price['ratio']:.2f} of the sum of its parts."


if __name__ == "__main__":
    run_main(main)
