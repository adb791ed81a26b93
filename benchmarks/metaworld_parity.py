"""Measure Meta-World's tasks: success of the original's scripted policies or a trained one, and mt10's speed.

    python benchmarks/metaworld_parity.py success [--run RUN] [--engine warp] [--tasks NAME ...] [--goals 20]
                                                  [--out FILE.csv]
    python benchmarks/metaworld_parity.py speed [--engine warp] [--worlds 4096] [--json FILE]

``--original=PYTHON`` compares with the original: PYTHON is the interpreter of an environment with metaworld==3.1.1 and
its own dependencies (MuJoCo 3.3, Gymnasium with its "packaging"), which cannot stand beside mtjax's.

``success`` plays an episode of 500 steps from each goal, by the policies of the installed package, or by the policy
that a run trained. A success counts at the end of the episode and at any step. ``--together`` tasks are one program. A
task that has a line in the file is not played again. The same policies play the same goals in the original.

``speed`` times ten tasks (mt10) under random actions inside one scan, in turn: with one union of all scenes, with
families of a scene joined into one simulator, and apart; with resets as in training and without. The original runs in
processes that send nothing to each other, which is more than any learner could use.
"""

import argparse
import csv
import dataclasses
import json
import operator
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import metaworld_policies
import numpy as np
from physics import physics
from report import publish, run_main
from steps_per_second import Contestant, physics_of_family

import mtjax
from mtjax.envs.engines.base import ENGINES
from mtjax.envs.metaworld.names import BENCHMARKS, TASKS
from mtjax.envs.simulator_groups import SCENES
from mtjax.names import load

_HEAD = "task engine goals end any_step original_end original_any_step goals_that_differ".split()
_STEPS = 500
Player = Callable[[list[str], np.ndarray], np.ndarray]  # tasks and observations (T, G, 39) -> actions (T, G, 4)


class Original:
    """A process that answers as ``metaworld_original.py`` says."""

    def __init__(self, python: str):
        command = [python, "-W", "ignore", str(Path(__file__).with_name("metaworld_original.py"))]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, **question: Any) -> Any:
        assert self.process.stdin is not None and self.process.stdout is not None
        print(json.dumps(question), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            raise SystemExit("the original ended; see above")
        return json.loads(answer)


def main() -> None:
    on_cpu = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("success", "speed"))
    parser.add_argument("--original", metavar="PYTHON")
    parser.add_argument("--engine", default="auto", choices=ENGINES)
    parser.add_argument("--run", help="of a trained policy, in success; by default the scripted ones play")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, metavar="NAME", help="of success; by default all")
    parser.add_argument("--goals", type=int, default=20, help="of each task, with one episode each, in success")
    parser.add_argument("--together", type=int, default=2 if on_cpu else 25, help="tasks of a program, in success")
    parser.add_argument("--out", type=Path, help="by default metaworld-policies.csv, with --run metaworld-trained.csv")
    parser.add_argument("--worlds", type=int, default=160 if on_cpu else 4096, help="of all tasks, in speed")
    parser.add_argument("--steps", type=int, default=_STEPS, help="of a timed call, in speed")
    parser.add_argument("--rounds", type=int, default=5, help="in speed")
    parser.add_argument("--processes", type=int, default=2, help="of the original, in speed")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    original = Original(arguments.original) if arguments.original else None
    (compare if arguments.what == "success" else race)(original, arguments)


# Success.


def compare(original: Original | None, arguments: argparse.Namespace) -> None:
    """Add a line for each task that has none."""
    known, player = trained(arguments.run) if arguments.run else scripted()
    out = arguments.out or Path("metaworld-trained.csv" if arguments.run else "metaworld-policies.csv")
    engine = mtjax.make("metaworld-reach", engine=arguments.engine).engine_name
    done = read(out)
    if unknown := set(arguments.tasks or ()) - set(known):
        raise SystemExit(f"{arguments.run} has not trained on {', '.join(sorted(unknown))}")
    scene_of = lambda name: load(f"mtjax.envs.metaworld.{TASKS[name]}").scene_file
    left = [name for name in arguments.tasks or known if name not in done]
    left.sort(key=scene_of)  # whose simulators join
    if not out.exists():
        out.write_text(",".join(_HEAD) + "\n")
    for begin in range(0, len(left), arguments.together):
        names = left[begin : begin + arguments.together]
        for name, success, vectors in play(names, engine, arguments.goals, player):
            row = [name, engine, len(vectors), *(f"{x:.3g}" for x in success.mean(0))]
            if original is not None:
                theirs = play_original(original, name, vectors, player)
                row += [*(f"{x:.3g}" for x in theirs.mean(0)), int(np.sum(success[:, 1] != theirs[:, 1]))]
            with out.open("a", newline="") as file:
                csv.writer(file).writerow(row + [""] * (len(_HEAD) - len(row)))
            print(*row, flush=True)


def read(path: Path) -> set[str]:
    """Return the tasks that have a line in a file, which may not exist."""
    if not path.exists():
        return set()
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        if rows.fieldnames != _HEAD:
            raise SystemExit(f"{path} has other columns; give another --out")
        return {row["task"] for row in rows}


def scripted() -> tuple[list[str], Player]:
    """Return the names of all tasks, and what plays them by the installed package's policies."""
    policies = metaworld_policies.load()
    return list(TASKS), of_each(lambda name, obs: metaworld_policies.actions(policies[name], obs))


def trained(run: str) -> tuple[list[str], Player]:
    """Return the names of a run's tasks, and what plays them by its policy's mean actions."""
    policy = mtjax.load(run)
    names, tasks = [x.removeprefix("metaworld-") for x in policy.env.labels("train")], policy.env.tasks("train")
    shown = not any(getattr(part.family, "goal_hidden", False) for part in policy.env.parts)
    if not shown or not set(names) <= set(TASKS) or jax.tree.map(np.shape, policy.takes) != (39,):
        raise SystemExit(f"{run} is not of a mixture of Meta-World's tasks that shows their goals, such as mt10")
    act = jax.jit(jax.vmap(policy, (0, None)))
    task = {name: jax.tree.map(lambda x, i=i: x[i], tasks) for i, name in enumerate(names)}
    return names, of_each(lambda name, obs: np.asarray(act(np.float32(obs), task[name])))


def of_each(act: Callable[[str, np.ndarray], np.ndarray]) -> Player:
    """Return what plays several tasks, from what acts (G, 4) in one."""
    return lambda names, obs: np.stack([act(name, seen) for name, seen in zip(names, obs, strict=True)])


def play_original(original: Original, name: str, vectors: np.ndarray, player: Player) -> np.ndarray:
    """Play an episode from each goal of a task in the original; return success (goals, 2) as ``play`` does."""
    obs, found = original.ask(do="begin", task=name, vectors=vectors.tolist()), []
    for _ in range(_STEPS):
        (actions,) = player([name], np.array([obs]))
        obs, success = original.ask(do="step", actions=actions.tolist())
        found.append(success)
    return at_end_and_ever(np.array(found))


def at_end_and_ever(success: np.ndarray) -> np.ndarray:
    """Return the success (..., 2) of episodes, at the end and at any step, from that of their steps (H, ...)."""
    return np.stack([success[-1], success.max(axis=0)], axis=-1)


def play(names: list[str], engine: str, goals: int, player: Player) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Play an episode from each goal of some tasks in one program.

    Returns:
        for each task its name, success (goals, 2) at the end and at any step, and the goals' vectors.
    """
    before = time.perf_counter()
    env = mtjax.mixture([mtjax.make(f"metaworld-{name}", num_draws=goals, engine=engine) for name in names])
    tasks = env.tasks()
    each = jax.tree.map(lambda x: jnp.asarray(x)[None], tasks.draws)._replace(blocks=tasks.blocks)
    keys = jax.random.split(jax.random.key(0), (1, len(names), goals))
    start = jax.jit(env.reset_worlds)(each, keys)
    nothing = jnp.zeros((1, len(names), goals, 4))
    lowered = jax.jit(env.step_worlds, donate_argnums=1).lower(each, start.state, nothing)  # in place: recorded once
    env.calls.load_kernels()
    step = lowered.compile()
    state, obs, found = jax.tree.map(jnp.copy, start.state), np.asarray(start.obs), []
    for i in range(env.episode_length):
        after = step(each, state, jnp.asarray(player(names, obs[0])[None]))
        state, obs = after.state, np.asarray(after.obs)
        found.append(np.asarray(after.metrics["success"])[0])
        if not i:
            print(f"{len(names)} tasks compiled after {time.perf_counter() - before:.0f} s", flush=True)
    print(f"{len(names)} tasks played after {time.perf_counter() - before:.0f} s", flush=True)
    success = at_end_and_ever(np.array(found))
    return [(name, success[t], env.families[t].vectors()) for t, name in enumerate(names)]


# Speed.


def race(original: Original | None, arguments: argparse.Namespace) -> None:
    """Time all contestants in turn, and print medians over the rounds."""
    env = mtjax.make("mt10", engine=arguments.engine)
    per_task = -(-arguments.worlds // len(env.families))
    contestants = []
    for label in SCENES[1:]:
        mixture = dataclasses.replace(env, scenes=label)  # of the same families, which have begun their episodes once
        for suffix, resets in ((", resets as in training", True), (", no resets", False)):
            make = lambda mixture=mixture, resets=resets: physics(mixture, per_task, arguments.steps, resets)
            name = f"{label} ({len(mixture.groups)} simulators){suffix}"
            worlds, of_step = per_task * len(env.families), physics_of_family(env.families[0])
            contestants.append(Contestant(name, worlds, arguments.steps, of_step, make))
            print(f"{name}: compiled in {contestants[-1].first_call_seconds:.0f} s", flush=True)
    theirs = []
    tasks = [name.removeprefix("metaworld-") for name in BENCHMARKS["mt10"][1]]
    for _ in range(arguments.rounds):
        for contestant in contestants:
            contestant.time()
        if original is not None:
            theirs.append(original.ask(do="time", tasks=tasks, processes=arguments.processes, steps=_STEPS))
    rows = [
        {
            "contestant": each.name,
            "engine": env.engine_name,
            "worlds": each.worlds,
            "steps_per_second": statistics.median(each.rates),
            "substeps_per_second": statistics.median(each.rates) * each.physics.substeps,
            "slowest": min(each.rates),
            "fastest": max(each.rates),
            "over_original": statistics.median(map(operator.truediv, each.rates, theirs)) if theirs else None,
            "first_call_seconds": each.first_call_seconds,
        }
        for each in contestants
    ]
    if theirs:
        rows.append({"contestant": "original", "worlds": len(tasks), "steps_per_second": statistics.median(theirs)})
    for row in rows:
        print(f"{row['contestant']:44} {row['worlds']:6} {row['steps_per_second']:12,.0f} steps/s")
    publish(arguments, rows)


if __name__ == "__main__":
    run_main(main)
