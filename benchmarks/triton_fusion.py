"""Reproduce a wrong program of XLA's on NVIDIA GPUs: a mixture of encoders by a softmax, GPU against CPU.

    python benchmarks/triton_fusion.py [--form NAME ...]

XLA joins a softmax over encoders, its transpose, the weighted sum of encodings and a concatenation into one Triton
kernel. Its tile holds two tasks, and the second one of each tile is wrong. Seen with jax 0.11.2 on an H200; the script
prints the versions of this machine. Each form leaves something out of the program, and prints the largest error for
each task; rounding is below 0.01. ``mtjax.agents.parts.encoders.mixture.mix`` keeps clear of the fault by a barrier.
"""

import argparse
from functools import partial
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from report import run_main

SEEDS, TASKS, ENVS, INPUTS, EXPERTS, WIDTH, HIDDEN = 10, 8, 5, 9, 4, 64, 256


def encode(params, obs):
    """Encode an observation (O,) by all experts: (K, D)."""
    hidden = jax.nn.relu(jnp.einsum("o,kod->kd", obs, params["first"]))
    return jnp.einsum("kd,kdf->kf", hidden, params["second"])


def gate(params, task):
    """Score the experts (K,) for a task (1,)."""
    hidden = jax.nn.relu(task @ params["gate"][0])
    return jax.nn.relu(hidden @ params["gate"][1]) @ params["gate"][2]


def mix(weights, encodings):
    return jnp.sum(weights[:, None] * encodings, axis=0)


def whole(params, task, obs, middle=lambda x: x):
    weights, encodings = middle((jax.nn.softmax(gate(params, task)), encode(params, obs)))
    return jnp.concatenate([mix(weights, encodings), task]) @ params["out"]


def without_output(params, task, obs):
    return jnp.concatenate([mix(jax.nn.softmax(gate(params, task)), encode(params, obs)), task])


def without_task(params, task, obs):
    return mix(jax.nn.softmax(gate(params, task)), encode(params, obs)) @ params["out"][:-1]


def without_gate(params, task, obs):
    return jnp.concatenate([mix(jax.nn.softmax(task * params["scores"]), encode(params, obs)), task]) @ params["out"]


FORMS = {
    "whole": whole,
    "without output layer": without_output,
    "without concatenation": without_task,
    "without gate": without_gate,
    "with barrier": partial(whole, middle=jax.lax.optimization_barrier),
}


def inputs():
    """Return parameters of every seed, tasks (T, 1) and observations (S, T, E, O)."""
    random = np.random.default_rng(0)
    draw = lambda *shape: random.normal(size=shape).astype(np.float32) / np.sqrt(shape[-2] if len(shape) > 1 else 1)
    params = {
        "first": draw(SEEDS, EXPERTS, INPUTS, WIDTH),
        "second": draw(SEEDS, EXPERTS, WIDTH, WIDTH),
        "gate": [draw(SEEDS, 1, WIDTH), draw(SEEDS, WIDTH, WIDTH), draw(SEEDS, WIDTH, EXPERTS)],
        "scores": draw(SEEDS, EXPERTS),
        "out": draw(SEEDS, WIDTH + 1, HIDDEN),
    }
    return params, np.linspace(-1.3, 1.3, TASKS, dtype=np.float32)[:, None], draw(SEEDS, TASKS, ENVS, INPUTS)


def errors(form) -> tuple[np.ndarray, bool]:
    """Return the largest error of each task (T,), and whether the program has Triton fusions."""
    over_all = jax.vmap(jax.vmap(jax.vmap(form, (None, None, 0)), (None, 0, 0)), (0, None, 0))
    found, text = [], ""
    for platform in ("cpu", jax.default_backend()):
        given = jax.device_put(inputs(), jax.devices(platform)[0])
        program = jax.jit(over_all).lower(*given).compile()
        found.append(np.asarray(program(*given)))
        text = program.as_text() or ""
    return np.abs(found[0] - found[1]).max(axis=(0, 2, 3)), "__triton" in text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--form", action="append", choices=FORMS)
    forms = parser.parse_args().form or list(FORMS)
    print(f"jax {jax.__version__}, jaxlib {version('jaxlib')}, {jax.devices()[0].device_kind}")
    for name in forms:
        error, triton = errors(FORMS[name])
        judged = "WRONG" if error.max() > 0.05 else "right"
        fused = "Triton fusions" if triton else "no Triton fusion"
        print(f"{name:22s} {judged}, {fused}; by task: {' '.join(f'{x:.4f}' for x in error)}", flush=True)


if __name__ == "__main__":
    run_main(main)
