"""Measure how fast a mixture of Meta-World steps with a union of its scenes, with joined families, and with each apart.

    python benchmarks/union_scene.py [--env mt10] [--engine warp] [--worlds 4096] [--steps 200] [--json FILE]

In a union one simulator steps worlds of several scenes: it holds the things of all, and parks those that a world does
not use. Joined families have the same scene. Steps are those of the mixture under random actions: physics,
observations, rewards, and resets as in training. All contestants are compiled first and then timed in turn.
"""

import argparse
import dataclasses
import statistics
import time

import jax
from physics import physics
from report import publish, run_main
from steps_per_second import Contestant, physics_of_family

import mtjax
from mtjax.envs import BENCHMARKS
from mtjax.envs.simulator_groups import SCENES


def main() -> None:
    on_cpu = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="mt10", choices=BENCHMARKS)
    parser.add_argument("--scenes", nargs="+", default=SCENES[1:], choices=SCENES[1:])
    parser.add_argument("--engine", default="c" if on_cpu else "warp", choices=("c", "warp"))
    parser.add_argument("--worlds", type=int, default=160 if on_cpu else 4096, help="of all tasks")
    parser.add_argument("--steps", type=int, default=200, help="control steps in a timed call")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    made = mtjax.make(arguments.env, engine=arguments.engine)
    _ = made.table  # the starts of all goals, once for all contestants
    contestants, grouping, per_task = [], {}, -(-arguments.worlds // made.train_count)
    for scenes in arguments.scenes:
        env, before = dataclasses.replace(made, scenes=scenes), time.perf_counter()
        name = f"{scenes}, {len(env.groups)} simulators"
        grouping[name] = time.perf_counter() - before
        make = lambda env=env: physics(env, per_task, arguments.steps, True)
        worlds, of_step = per_task * made.train_count, physics_of_family(made.families[0])
        contestants.append(Contestant(name, worlds, arguments.steps, of_step, make))
        print(f"{name}: compiled in {contestants[-1].first_call_seconds:.0f} s", flush=True)
    for _ in range(arguments.rounds):
        for contestant in contestants:
            contestant.time()
    rows = [
        {
            "contestant": each.name,
            "engine": arguments.engine,
            "worlds": each.worlds,
            "steps_per_second": statistics.median(each.rates),
            "substeps_per_second": statistics.median(each.rates) * each.physics.substeps,
            "slowest": min(each.rates),
            "fastest": max(each.rates),
            "first_call_seconds": each.first_call_seconds,
            "grouping_seconds": grouping[each.name],
        }
        for each in contestants
    ]
    for row in rows:
        print(f"{row['contestant']:28} {row['worlds']:6} {row['steps_per_second']:12,.0f} steps/s")
    publish(arguments, rows)


if __name__ == "__main__":
    run_main(main)
