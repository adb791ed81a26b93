"""Measure where the time of a step of all worlds goes on a GPU, with the updates that follow it: kernels and pauses.

    python benchmarks/step_trace.py [--env NAME] [--agent NAME] [--seeds 10] [--steps 40]
                                    [--training NAME=VALUE ...] [--kernels 40] [--json FILE]

A chunk of ``--steps`` steps of every environment is trained under JAX's profiler, once it has been compiled and
repeated. From the trace are, for one step: its kernels and their time, and the time in which no kernel ran. Settings
are those of the agent's preset, but for ``--training``; ``curriculum=sequence:100000`` plays one task of a mixture
alone. With one update a step, what is left is physics, acting, storing and new episodes.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
from report import markdown, publish, run_main, settings_of
from update_trace import busy, by_name, device_events

from mtjax.config import configure, with_preset
from mtjax.learning import loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="mt10")
    parser.add_argument("--agent", default="brc")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=40, help="of every environment, in the trace")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--kernels", type=int, default=40, help="so many of the longest are printed")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    if jax.default_backend() != "gpu":
        raise SystemExit("error: this needs a GPU, as it reads the times of its kernels")
    row = trace(arguments)
    lines = [[name, f"{x['microseconds']:.1f}", f"{x['calls']:.1f}"] for name, x in row["kernels"].items()]
    print(markdown(["kernel", "microseconds a step", "calls"], lines[: arguments.kernels]))
    head = ["worlds", "milliseconds", "milliseconds_traced", "busy_milliseconds", "launches"]
    print(markdown(head, [[f"{row[name]:.2f}" for name in head]]), flush=True)
    publish(arguments, [row])


def trace(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one step."""
    plain = with_preset(arguments.env, arguments.agent)
    given = {"chunk_steps": arguments.steps} | settings_of(arguments.training)
    agent, settings = configure(plain.learner, plain.training, given)
    family, tasks = plain.family, plain.family.tasks("train")
    state = loop.init(family, agent, settings, tasks, jax.numpy.arange(arguments.seeds))
    seconds = lambda state: _seconds_of_chunk(family, agent, settings, tasks, state)
    for _ in range(agent.experience.warmup_steps // arguments.steps + 2):  # compiling, and random steps
        state, _ = seconds(state)
    state, untraced = seconds(state)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            state, traced = seconds(state)
        events = device_events(next(Path(folder).glob("**/*.xplane.pb")))
    kernels = by_name(events, arguments.steps)
    return {
        "env": arguments.env,
        "agent": str(agent),
        "worlds": state.total.size,
        "milliseconds": 1e3 * untraced / arguments.steps,
        "milliseconds_traced": 1e3 * traced / arguments.steps,
        "busy_milliseconds": busy(events) / arguments.steps / 1e6,
        "launches": sum(x["calls"] for x in kernels.values()),
        "kernels": kernels,
    }


def _seconds_of_chunk(family: Any, agent: Any, settings: Any, tasks: Any, state: Any) -> tuple[Any, float]:
    """Train one chunk, and return the state after it and the seconds that it took."""
    before = time.perf_counter()
    state, _ = jax.block_until_ready(loop.run_chunk(family, agent, settings, tasks, state))
    return state, time.perf_counter() - before


if __name__ == "__main__":
    run_main(main)
