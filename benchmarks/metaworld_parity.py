"""Measure Meta-World's tasks against the original: success of its scripted policies, and speed.

    python benchmarks/metaworld_parity.py success --original=PYTHON [--tasks NAME ...] [--goals 20] [--out FILE.csv]
    python benchmarks/metaworld_parity.py speed --original=PYTHON [--envs 16] [--processes 2] [--json FILE]

PYTHON is the interpreter of an environment with metaworld==3.1.1 and its own dependencies (MuJoCo 3.3, Gymnasium),
which cannot stand beside mtjax's. It plays the original, and is asked for the actions of the scripted policies.

``success`` plays an episode of 500 steps from each of the same goals in both, by the same policy. A success counts at
the end of the episode and at any step. ``speed`` times ten tasks (mt10) under random actions, with resets, in turn:
one program here, and there processes that send nothing to each other, which is more than any learner could use.
"""

import argparse
import csv
import json
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from report import machine

import mtjax
from mtjax.envs.metaworld.names import BENCHMARKS, TASKS
from mtjax.rollout import broadcast_tasks

_ROUNDS = 5
_STEPS = 500


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("success", "speed"))
    parser.add_argument("--original", required=True, metavar="PYTHON")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS, metavar="NAME")
    parser.add_argument("--goals", type=int, default=20, help="of each task, with one episode each")
    parser.add_argument("--envs", type=int, default=16, help="environments of each task, in speed")
    parser.add_argument("--processes", type=int, default=2, help="of the original, in speed")
    parser.add_argument("--out", type=Path, default=Path("metaworld-policies.csv"))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    original = Original(arguments.original)
    if arguments.what == "success":
        compare(original, arguments)
    else:
        race(original, arguments)


# Success of scripted policies.


def compare(original: Original, arguments: argparse.Namespace) -> None:
    """Write a line for each task."""
    with arguments.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "goals", "end", "original_end", "any_step", "original_any_step", "goals_that_differ"])
        for name in arguments.tasks:
            ours, vectors = play(original, name, arguments.goals)
            theirs = np.array(original.ask(do="play", task=name, vectors=vectors.tolist()))
            differ = int(np.sum(ours[:, 1] != theirs[:, 1]))
            means = [f"{x:.3g}" for pair in zip(ours.mean(0), theirs.mean(0), strict=True) for x in pair]
            writer.writerow([name, len(vectors), *means, differ])
            file.flush()
            print(name, *means, differ, flush=True)


def play(original: Original, name: str, goals: int) -> tuple[np.ndarray, np.ndarray]:
    """Return success (goals, 2) at the end and at any step, and the goals' vectors."""
    env = mtjax.make(f"metaworld-{name}", num_draws=goals)
    tasks = jax.tree.map(lambda x: jnp.asarray(x[0]), env.tasks().draws)
    start = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), goals))
    step = jax.jit(jax.vmap(env.step))
    state, obs, found = start.state, start.obs, []
    for _ in range(env.episode_length):
        actions = original.ask(do="policy", task=name, obs=np.asarray(obs, np.float64).tolist())
        after = step(tasks, state, jnp.float32(actions))
        state, obs = after.state, after.obs
        found.append(np.asarray(after.metrics["success"]))
    return np.stack([found[-1], np.max(found, axis=0)], axis=1), env.vectors()


# Speed.


def race(original: Original, arguments: argparse.Namespace) -> None:
    """Time both in turn, and print medians over the rounds."""
    ours = program(arguments.envs)
    names = [name.removeprefix("metaworld-") for name in BENCHMARKS["mt10"][1]]
    rounds = []
    for _ in range(_ROUNDS):
        before = time.perf_counter()
        jax.block_until_ready(ours())
        mine = len(names) * arguments.envs * _STEPS / (time.perf_counter() - before)
        theirs = original.ask(do="time", tasks=names, processes=arguments.processes, steps=_STEPS)
        rounds.append((mine, theirs))
    median = lambda values: statistics.median(values)
    result = {
        "steps_per_second": median(mine for mine, _ in rounds),
        "original_steps_per_second": median(theirs for _, theirs in rounds),
        "ratio": median(mine / theirs for mine, theirs in rounds),
        "envs": arguments.envs,
        "processes": arguments.processes,
        "rounds": rounds,
        "machine": machine(),
    }
    print(json.dumps(result, indent=2))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


def program(envs: int) -> Any:
    """Return a function that plays 500 steps of every world of mt10 from a reset."""
    env = mtjax.make("mt10")
    tasks = env.tasks()
    shape = (1, len(tasks.id), envs)
    each = broadcast_tasks(tasks, shape)._replace(blocks=tasks.blocks)
    keys = jax.random.split(jax.random.key(0), shape)

    @jax.jit
    def run(each: Any, keys: Any) -> Any:
        def step(states: Any, i: Any) -> tuple[Any, Any]:
            actions = jax.random.uniform(jax.random.fold_in(jax.random.key(1), i), (*shape, 4), minval=-1.0)
            after = env.step_worlds(each, states, actions)
            return after.state, after.reward.mean()

        return jax.lax.scan(step, env.reset_worlds(each, keys).state, jnp.arange(_STEPS))[1]

    jax.block_until_ready(run(each, keys))
    return lambda: run(each, keys)


if __name__ == "__main__":
    main()
