"""Compare training speed with Brax SAC, with the same networks, batch and updates per step.

    python benchmarks/brax_sac.py [--agent sac-conditioned] [--json FILE]

Ours is the preset of this device on ten tasks of finger-spin-vary-size; theirs is ``brax.training.agents.sac`` on one
task, Playground's FingerSpin (pip install playground==0.2.0) in Playground's training wrapper, with as many worlds
as ours has over all tasks and one batch as large as ours of all tasks. Both learn during every step that is counted;
compiling, warming up and evaluating are left out. Ours is timed before and after theirs, as the machine may change.
``jax.device_put_replicated``, which Brax calls and JAX has removed, is put back for it.
"""

import argparse
import dataclasses
import functools
import importlib.util
import statistics

import jax
import jax.numpy as jnp
from report import publish, run_main
from training import Training

import mtjax
from mtjax.config import RunConfig
from mtjax.types import InputError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="sac-conditioned", choices=list(mtjax.AGENTS))
    parser.add_argument("--steps", type=int, default=100, help="steps of every environment that are timed at a time")
    parser.add_argument("--repeats", type=int, default=5, help="times that many steps")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    if importlib.util.find_spec("mujoco_playground") is None:
        raise InputError("Playground is not installed: pip install playground==0.2.0")
    program = mtjax.preset("finger-spin-vary-size", arguments.agent)
    settings = dataclasses.replace(program.training, warmup_steps=1, chunk_steps=arguments.steps)
    ours = Training(program.family, program.learner, settings)
    for _ in range(arguments.repeats):
        ours.time()
    theirs = brax_rates(program, ours.worlds, arguments)
    for _ in range(arguments.repeats):
        ours.time()
    rows = [row(f"mtjax {arguments.agent}", ours.worlds, ours.rates), row("brax sac", ours.worlds, theirs)]
    ratio = rows[0]["steps_per_second"] / rows[1]["steps_per_second"]
    for line in rows:
        span = f"{line['slowest']:,.0f} to {line['fastest']:,.0f}"
        print(f"{line['contestant']:24} {line['steps_per_second']:12,.0f} env-steps/s ({span})")
    print(f"ratio {ratio:.1f}", flush=True)
    rows[0]["over_brax"] = ratio
    publish(arguments, rows)


def brax_rates(program: RunConfig, worlds: int, arguments: argparse.Namespace) -> list[float]:
    """Return Brax's own environment steps a second of every epoch but the first, which compiles."""
    from brax.training.agents.sac import networks
    from brax.training.agents.sac import train as sac
    from mujoco_playground import registry, wrapper  # type: ignore  # not a dependency of this package

    jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
    agent = program.learner
    settings = agent.experience
    prefill, rates = 2 * worlds, []
    env = registry.load("FingerSpin", config_overrides={"impl": "jax"})
    sac.train(
        environment=env,  # type: ignore
        wrap_env_fn=wrapper.wrap_for_brax_training,
        num_timesteps=prefill + (arguments.repeats + 1) * arguments.steps * worlds,
        num_evals=arguments.repeats + 2,
        num_eval_envs=1,
        episode_length=1000,
        num_envs=worlds,
        batch_size=settings.batch_size * program.family.train_count,
        grad_updates_per_step=settings.updates_per_step,
        min_replay_size=prefill,
        max_replay_size=settings.replay_size * program.family.train_count,
        learning_rate=agent.critic_lr,
        tau=agent.tau,
        discounting=agent.gamma,
        normalize_observations=agent.normalize_observations,
        network_factory=functools.partial(  # type: ignore
            networks.make_sac_networks,
            hidden_layer_sizes=agent.hidden,
            policy_network_layer_norm=agent.actor_layer_norm,
            q_network_layer_norm=agent.critic_layer_norm,
        ),
        progress_fn=lambda _, metrics: rates.append(float(metrics.get("training/sps", 0))),
    )
    return rates[2:]  # before training, and with compiling


def row(name: str, worlds: int, rates: list[float]) -> dict:
    return {
        "contestant": name,
        "worlds": worlds,
        "steps_per_second": statistics.median(rates),
        "slowest": min(rates),
        "fastest": max(rates),
    }


if __name__ == "__main__":
    run_main(main)
