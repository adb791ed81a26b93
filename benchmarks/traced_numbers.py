"""What it costs to keep an agent's numbers (rates, discounts, weights) as data instead of constants of the program.

    python benchmarks/traced_numbers.py [--agents NAME ...] [--json FILE]

A sweep keeps its numbers as data, so that they differ within one program; a plain run has constants. Both forms take
the same updates (10 tasks x 64 transitions, 2 x 256) in turn; ratios are medians of seven rounds. Compiling is timed
once, without a cache.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from report import machine, markdown, run_main

import mtjax
from mtjax.agents.swept import sweepable, with_numbers
from mtjax.envs.probes import tasks_of
from mtjax.types import Spec, Transition

TASKS, BATCH, UPDATES, ROUNDS = 10, 64, 20, 7
SPEC = Spec.vector(9, 2, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=["sac-conditioned", "care", "pcgrad"], metavar="NAME")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [compare(name) for name in arguments.agents]
    head = ["agent", "numbers", "compile s, constants", "compile s, data", "ms, constants", "ms, data", "ratio of ms"]
    print(markdown(head, [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]))
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")


def compare(name: str) -> dict[str, Any]:
    """Compile and time the updates of one agent in both forms."""
    agent = mtjax.agent(name, hidden=(256, 256))
    tasks, key, values = tasks_of("one-step", np.linspace(-1, 1, TASKS)), jax.random.key(0), sweepable(agent)
    varied = with_numbers(agent, {name: jnp.float32(value) for name, value in values.items()})
    states = {
        "constants": (agent, jax.jit(lambda key: agent.init(SPEC, tasks, key))(key)),
        "data": (varied, jax.jit(lambda key: varied.init(SPEC, tasks, key))(key)),
    }
    compiled, compile_seconds = {}, {}
    for form, (learner, state) in states.items():

        def update(state, window, key, learner=learner):
            step = lambda state, key: (learner.update(state, window, tasks, key, jnp.int32(0))[0], None)
            return jax.lax.scan(step, state, jax.random.split(key, UPDATES))[0]

        lowered, before = jax.jit(update).lower(state, random_window(), key), time.perf_counter()
        compiled[form] = lowered.compile()
        compile_seconds[form] = time.perf_counter() - before
    seconds = {form: [] for form in states}
    for _ in range(ROUNDS + 1):
        for form, (_, state) in states.items():
            before = time.perf_counter()
            jax.block_until_ready(compiled[form](state, random_window(), key))
            seconds[form].append((time.perf_counter() - before) / UPDATES)
    each = {form: [1e3 * x for x in times[1:]] for form, times in seconds.items()}
    return {
        "agent": name,
        "numbers": len(values),
        **{f"compile_{form}": compile_seconds[form] for form in states},
        **{form: statistics.median(each[form]) for form in states},
        "ratio": statistics.median(b / a for a, b in zip(each["constants"], each["data"], strict=True)),
    }


def random_window() -> Transition:
    """Draw windows (T, B, 1, ...) of one step."""
    random = np.random.default_rng(0)
    normal = lambda *size: jnp.float32(random.normal(size=(TASKS, BATCH, 1, *size)))
    return Transition(normal(9), jnp.tanh(normal(2)), normal(), jnp.ones((TASKS, BATCH, 1)), normal(9))


if __name__ == "__main__":
    run_main(main)
