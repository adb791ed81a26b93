"""Compare PPO with rejax's on Brax's hopper: seconds and returns of whole runs, with one seed and with many.

    python benchmarks/rejax_peer.py [--seeds 1 10 100] [--sides NAME ...] [--steps N] [--within N] [--out DIR]

    rejax             rejax 0.1.3 with the settings that its repository gives for PPO on brax/hopper
    mtjax-as-rejax    ours with the same worlds, steps of a rollout, passes, minibatches, rates and discounts
    mtjax             ours with its preset

Needs rejax==0.1.3 with gymnax==0.0.9 (later ones do not fit it), distrax and tfp-nightly. Both sides step Brax's hopper
with Brax's own backend "generalized", for as many steps of every seed, and are evaluated once, at the end, by 128
episodes of each seed under the mean action (ours) or sampled actions (rejax's evaluation draws them). Seconds are those
of the compiled run with this evaluation; compiling is apart. Networks differ: rejax's are two layers of 64 with tanh.

Every side and number of seeds is a process of its own, which writes ``OUT/SIDE-SEEDS.json``; ``parts.py`` says how an
interrupted comparison goes on. All results in OUT give ``OUT/table.md``.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import parts
from ppo_peer import gradient_steps
from report import markdown, record, run_main

SIDES = ("rejax", "mtjax-as-rejax", "mtjax")
_EPISODES = 128  # of an evaluation, rejax's own number
TUNED = {
    **{"num_envs": 32, "num_steps": 32, "num_epochs": 9, "num_minibatches": 2, "learning_rate": 0.000256740888},
    **{"max_grad_norm": 1.0, "gamma": 0.995, "gae_lambda": 0.95, "clip_eps": 0.2, "ent_coef": 0.01, "vf_coef": 0.5},
    "normalize_observations": True,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sides", nargs="+", default=list(SIDES), choices=SIDES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 10, 100])
    parser.add_argument("--steps", type=int, default=5_242_880, help="of each seed; rejax's own number")
    parts.add_peer_flags(parser, "rejax-peer", ("SIDE", "SEEDS"))
    arguments = parser.parse_args()
    pairs = [(side, seeds) for seeds in arguments.seeds for side in arguments.sides]
    parts.run_pairs(__file__, arguments, pairs, play, tabulate)


def play(arguments: argparse.Namespace, side: str, number: str) -> None:
    """Run one side with a number of seeds, and write its result."""
    seeds = int(number)
    found = theirs(arguments.steps, seeds) if side == "rejax" else ours(arguments.steps, seeds, side)
    figures = {"side": side, "seeds": seeds, "process_seconds": parts.since_start(), **found}
    parts.write_result(arguments.out / f"{side}-{seeds}.json", record(arguments, figures))


def theirs(steps: int, seeds: int) -> dict[str, Any]:
    """Train by rejax, all seeds mapped, and return seconds and final returns."""
    import jax
    from rejax import PPO  # type: ignore  # not a dependency of this package

    networks = {"activation": "tanh"}
    agent = PPO.create(
        env="brax/hopper", total_timesteps=steps, eval_freq=steps, skip_initial_evaluation=True,
        agent_kwargs=networks, **TUNED,
    )  # fmt: skip
    keys = jax.random.split(jax.random.PRNGKey(0), seeds)
    before = time.perf_counter()
    run = jax.jit(jax.vmap(agent.train)).lower(keys).compile()
    compiled = time.perf_counter()
    _, (_, returns) = jax.block_until_ready(run(keys))
    seconds = time.perf_counter() - compiled
    last = returns[:, -1].mean(axis=-1)
    return {
        "steps": steps,
        "compile_seconds": compiled - before,
        "seconds": seconds,
        "returns": [float(x) for x in last],
        "gradient_steps_per_million": gradient_steps(TUNED["num_epochs"], TUNED["num_minibatches"], 32 * 32),
        "choices": TUNED,
    }


def ours(steps: int, seeds: int, side: str) -> dict[str, Any]:
    """Train by PPO, all seeds in one program, and return seconds and final returns."""
    import mtjax
    from mtjax.config import configure

    config = mtjax.preset("brax-hopper", "ppo", "gpu")
    agent, settings = config.learner, config.training
    if side == "mtjax-as-rejax":
        given = {"num_envs": 32, "unroll": 32, "epochs": 9, "minibatches": 2, "chunk_steps": 320}
        rate = TUNED["learning_rate"]
        given |= {"actor_lr": rate, "critic_lr": rate, "gamma": TUNED["gamma"], "normalize_observations": True}
        agent, settings = configure(agent, settings, given)
    result = mtjax.train(
        *(config.family, agent),
        **{
            "steps": steps,
            "seeds": seeds,
            "eval_every": steps,
            "eval_episodes": _EPISODES,
            "settings": settings,
            "quiet": True,
        },
    )
    returns = result.evaluations.returns["train"][:, -1].mean(axis=(1, 2))
    return {
        "steps": int(result.evaluations.steps[-1]),  # whole chunks
        "compile_seconds": result.compile_seconds,
        "seconds": result.total_seconds - result.compile_seconds,
        "returns": [float(x) for x in returns],
        "gradient_steps_per_million": gradient_steps(
            agent.experience.epochs, agent.experience.minibatches, settings.num_envs * agent.experience.unroll
        ),
        "choices": {"agent": str(agent), "loop": str(settings)},
    }


def tabulate(out: Path) -> str:
    """Return the table of all results, by the number of seeds."""
    import numpy as np

    lines = []
    for x in sorted(parts.read_results(out), key=lambda x: (x["seeds"], SIDES.index(x["side"]))):
        returns = np.array(x["returns"])
        rate = x["steps"] * x["seeds"] / x["seconds"]
        cells = [x["side"], str(x["seeds"]), x["machine"]["device"], f"{returns.mean():.0f}"]
        cells += [f"{returns.min():.0f} to {returns.max():.0f}", f"{x['compile_seconds']:.1f}", f"{x['seconds']:.1f}"]
        lines.append(
            [*cells, f"{x['seconds'] / x['seeds']:.2f}", f"{rate:,.0f}", f"{x['gradient_steps_per_million']:,.0f}"]
        )
    head = [
        "side",
        "seeds",
        "card",
        "return, mean of seeds",
        "range of seeds",
        "compiled in s",
        "run s",
        "run s a seed",
    ]
    return markdown([*head, "env-steps/s, all seeds", "gradient steps a million steps"], lines)


if __name__ == "__main__":
    run_main(main)
