"""Measure steps a second of environments on every engine, of MuJoCo Playground, and of the training loop.

    python benchmarks/steps_per_second.py [--domains finger cheetah ...] [--worlds N] [--json FILE]

All contestants of a domain are compiled first and then timed in turn, round after round, in this one process, so that
other load on the machine affects all of them. Figures are medians over the rounds, and ratios are medians of each
round's ratio. There are ten tasks, random actions, and fresh random starts every 1000 steps. "no resets" is the same
program with endless episodes. Playground 0.2 (pip install playground==0.2.0) runs one task, in its own wrapper for
training, whose automatic reset returns to one stored state. Compile time is reported separately.

A step is one of control. Both sides choose how many substeps of physics it takes, and by which integrator; where
Playground takes more or fewer than we do, "our substeps" is its environment with the length of ours. Every row has its
substeps a second too, and ratios are given by both.

``--families link sailing racing trading`` times families that step in plain JAX, with their own tasks, beside them.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from report import publish, run_main
from training import Training

import mtjax
from mtjax.envs import Domain
from mtjax.learning.rollout import broadcast_tasks
from mtjax.types import InputError

# Ours (with ten values of a physical parameter), and Playground's of the same task.
DOMAINS = {
    "finger": ("finger-spin-vary-size", {}, "FingerSpin"),
    "cheetah": ("cheetah-run-vary-torso-length", {}, "CheetahRun"),
    "walker": ("walker-walk-vary-friction", {}, "WalkerWalk"),
    "hopper": ("hopper-hop", {"gear": "0.8:1.2:10"}, "HopperHop"),
    "cartpole": ("cartpole-swingup-vary-pole-mass", {}, "CartpoleSwingup"),
}
# Where Playground integrates by Euler, with one solver iteration, what dm_control does by Runge and Kutta.
_EULER = ("cartpole",)
_OVER = "over_playground"
_ON_CPU = jax.default_backend() == "cpu"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", nargs="*", default=list(DOMAINS), choices=DOMAINS)
    parser.add_argument("--families", nargs="*", default=[], metavar="NAME", help="families that step in plain JAX")
    parser.add_argument("--engines", nargs="+", default=["c", "mjx"] if _ON_CPU else ["mjx", "warp"])
    parser.add_argument("--worlds", type=int, default=256 if _ON_CPU else 8192, help="environments, over all tasks")
    parser.add_argument("--steps", type=int, default=1000, help="steps of every environment in a timed call")
    parser.add_argument("--repeats", type=int, default=3, help="rounds")
    parser.add_argument("--resets-only", action="store_true", help="leave out the rows without resets")
    parser.add_argument("--no-playground", action="store_true", help="leave Playground out")
    parser.add_argument("--agent", default="sac-conditioned", help="the agent of the training loop; none leaves it out")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rows = []
    for domain in arguments.domains:
        rows += compare(domain, arguments)
        print(table(rows, domain), flush=True)
    for name in arguments.families:
        rows.append(plain(name, arguments))
        print(f"{name}: {rows[-1]['steps_per_second']:,.0f} steps/s", flush=True)
    if arguments.agent != "none":
        rows.append(training_rate(arguments))
        print(f"training {arguments.agent}: {rows[-1]['steps_per_second']:,.0f} env-steps/s", flush=True)
    publish(arguments, rows)


class Physics(NamedTuple):
    """Holds what one step of control is made of."""

    substeps: int
    substep_seconds: float
    integrator: str


class Contestant:
    """A compiled program that takes ``steps`` steps of ``worlds`` worlds at each call, with some physics in each."""

    def __init__(self, name: str, worlds: int, steps: int, physics: Physics, make: Callable[[], Callable[[], Any]]):
        self.name, self.worlds, self.steps, self.physics = name, worlds, steps, physics
        self.rates: list[float] = []
        before = time.perf_counter()
        self.run = make()
        jax.block_until_ready(self.run())
        self.first_call_seconds = time.perf_counter() - before

    def time(self) -> None:
        before = time.perf_counter()
        jax.block_until_ready(self.run())
        self.rates.append(self.worlds * self.steps / (time.perf_counter() - before))


def compare(domain: str, arguments: argparse.Namespace) -> list[dict]:
    """Time every contestant of a domain, in turn."""
    name, vary, other = DOMAINS[domain]
    contestants = []

    def enter(label: str, worlds: int, steps: int, physics: Physics, make: Callable[[], Callable[[], Any]]) -> None:
        try:
            contestants.append(Contestant(label, worlds, steps, physics, make))
        except (InputError, ImportError) as error:
            print(f"{domain}: {label} left out: {error}", flush=True)

    per_task = -(-arguments.worlds // 10)
    for engine in arguments.engines:
        settings = {"vary": vary, "engine": engine}
        kinds = [("", settings, True)] + [(", no resets", settings, False)] * (not arguments.resets_only)
        if domain in _EULER and engine != "c":
            kinds.append((", euler/1", {**settings, "integrator": "euler", "solver_iterations": 1}, True))
        for suffix, chosen, resets in kinds:
            make = lambda chosen=chosen, resets=resets: ours(name, chosen, per_task, arguments.steps, resets)
            enter(f"mtjax {engine}{suffix}", 10 * per_task, arguments.steps, physics_of(name, chosen), make)
    short, own = max(arguments.steps // 5, 1), physics_of(name, {"vary": vary})
    if _ON_CPU:
        enter("mujoco.batch alone", 10 * per_task, short, own, lambda: batch_alone(name, vary, per_task, short))
    for impl in () if arguments.no_playground else ("jax",) if _ON_CPU else ("jax", "warp"):
        for suffix, chosen, physics in playground_physics(other, own):
            make = lambda chosen=chosen, impl=impl: playground(other, {**chosen, "impl": impl}, arguments.worlds, short)
            enter(f"playground {impl}{suffix}", arguments.worlds, short, physics, make)
    for _ in range(arguments.repeats):
        for contestant in contestants:
            contestant.time()
    against = [c for c in contestants if c.name in ("playground jax", "playground warp")]
    best = max(against, key=lambda c: statistics.median(c.rates)) if against else None
    return [_row(domain, c, best) for c in contestants]


def plain(name: str, arguments: argparse.Namespace) -> dict:
    """Time a family that steps in plain JAX, a step of which is one of its own."""
    env = mtjax.make(name)
    per_task = -(-arguments.worlds // env.train_count)
    make = lambda: ours(name, {}, per_task, arguments.steps, True)
    physics = Physics(1, env.seconds_per_step, "jax")
    contestant = Contestant("mtjax jax", per_task * env.train_count, arguments.steps, physics, make)
    for _ in range(arguments.repeats):
        contestant.time()
    return _row(name, contestant, None)


def _row(domain: str, contestant: Contestant, best: Contestant | None) -> dict:
    ratio = (
        None if best is None else statistics.median(a / b for a, b in zip(contestant.rates, best.rates, strict=True))
    )
    return {
        "domain": domain,
        "contestant": contestant.name,
        "worlds": contestant.worlds,
        "steps_per_second": statistics.median(contestant.rates),
        "slowest": min(contestant.rates),
        "fastest": max(contestant.rates),
        _OVER: ratio,
        "over_playground_by_substep": ratio and best and ratio * contestant.physics.substeps / best.physics.substeps,
        **contestant.physics._asdict(),
        "substeps_per_second": statistics.median(contestant.rates) * contestant.physics.substeps,
        "first_call_seconds": contestant.first_call_seconds,
    }


def physics_of(name: str, settings: dict) -> Physics:
    """Return the physics of a step of one of our families, by its name and settings."""
    return physics_of_family(mtjax.make(name, **settings))


def physics_of_family(env: Any) -> Physics:
    assert isinstance(env, Domain)
    return Physics(env.num_substeps, env.models[0].opt.timestep, integrator_of(env.models[0]))


def playground_physics(name: str, own: Physics) -> list[tuple[str, dict, Physics]]:
    """Return label, settings and physics of Playground's environment, and of one with our substeps if they differ."""
    try:
        from mujoco_playground import registry  # type: ignore  # not a dependency of this package
    except ImportError as error:
        print(f"playground left out: {error}", flush=True)
        return []
    of = lambda chosen: registry.load(name, config_overrides={"impl": "jax", **chosen})
    physics = lambda env: Physics(env.n_substeps, env.sim_dt, integrator_of(env.mj_model))
    found = [("", {}, physics(of({})))]
    if found[0][2].substep_seconds != own.substep_seconds:
        chosen = {"sim_dt": own.substep_seconds}
        found.append((", our substeps", chosen, physics(of(chosen))))
    return found


def integrator_of(model: mujoco.MjModel) -> str:
    return mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_").lower()


def ours(name: str, settings: dict, per_task: int, steps: int, resets: bool) -> Callable[[], Any]:
    """Return our contestant: random actions in a scan, stepped and reset as in the training loop."""
    env = mtjax.make(name, **settings)
    tasks = env.tasks()
    shape = (1, len(tasks.id), per_task)

    def play(tasks, carry):
        worlds = broadcast_tasks(tasks, shape)

        def step(carry, _):
            state, age, key = carry
            key, act_key, reset_key = jax.random.split(key, 3)
            action = env.spec.action.random(act_key, shape)
            after = env.step_worlds(worlds, state, action)
            seen = jnp.sum(after.reward) + jnp.sum(after.obs)
            age = age + 1
            if not resets:
                return (after.state, age, key), seen
            fresh = lambda _: env.reset_worlds(worlds, jax.random.split(reset_key, shape)).state
            ended = age >= env.episode_length
            return (jax.lax.cond(ended, fresh, lambda _: after.state, None), jnp.where(ended, 0, age), key), seen

        carry, seen = jax.lax.scan(step, carry, length=steps)
        return carry, jnp.sum(seen)

    start = jax.jit(
        lambda tasks, key: env.reset_worlds(broadcast_tasks(tasks, shape), jax.random.split(key, shape)).state
    )
    program = jax.jit(play, donate_argnums=1)
    held = [(start(tasks, jax.random.key(0)), jnp.int32(0), jax.random.key(1))]

    def run():
        held[0], seen = program(tasks, held[0])
        return seen

    return run


def batch_alone(name: str, vary: dict, per_task: int, steps: int) -> Callable[[], Any]:
    """Return MuJoCo's own threaded batch as a contestant, with the same models and substeps."""
    from mujoco import batch

    env = mtjax.make(name, vary, engine="c")
    assert isinstance(env, Domain)
    models = [env.models[row] for row in env.table.rows["train"] for _ in range(per_task)]
    worlds = batch.Batch(models[0], len(models))
    worlds.set_models(models)
    control, random = worlds.bind("ctrl"), np.random.default_rng(0)

    def run():
        for _ in range(steps):
            control[:] = random.uniform(-1, 1, control.shape)
            worlds.step(nstep=env.num_substeps, stage=mujoco.mjtStage.mjSTAGE_VEL)
        return ()

    return run


def playground(name: str, chosen: dict, worlds: int, steps: int) -> Callable[[], Any]:
    """Return Playground's environment in its training wrapper, with its default configuration but for the chosen."""
    from mujoco_playground import registry, wrapper  # type: ignore  # not a dependency of this package

    env = registry.load(name, config_overrides=chosen)
    env = wrapper.wrap_for_brax_training(env, episode_length=1000, action_repeat=1)

    def play(carry):
        def step(carry, _):
            state, key = carry
            key, act_key = jax.random.split(key)
            state = env.step(state, jax.random.uniform(act_key, (worlds, env.action_size), minval=-1.0))
            return (state, key), jnp.sum(state.reward) + jnp.sum(state.obs)  # type: ignore

        carry, seen = jax.lax.scan(step, carry, length=steps)
        return carry, jnp.sum(seen)

    program = jax.jit(play, donate_argnums=0)
    held = [(jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), worlds)), jax.random.PRNGKey(1))]
    held[0] = jax.tree.map(jnp.copy, held[0])  # its state holds some arrays twice, which cannot be donated twice

    def run():
        held[0], seen = program(held[0])
        return seen

    return run


def training_rate(arguments: argparse.Namespace) -> dict:
    """Time the whole loop as ``mtjax.train`` runs it with the preset of this device."""
    program = mtjax.preset("finger-spin-vary-size", arguments.agent)
    training = Training(program.family, program.learner, program.training, most_devices=1)
    for _ in range(arguments.repeats):
        training.time()
    return {
        "domain": "finger-spin-vary-size",
        "contestant": f"training {arguments.agent}",
        "worlds": training.worlds,
        "steps_per_second": statistics.median(training.rates),
        "slowest": min(training.rates),
        "fastest": max(training.rates),
        **physics_of("finger-spin-vary-size", {})._asdict(),
        "substeps_per_second": statistics.median(training.rates) * physics_of("finger-spin-vary-size", {}).substeps,
        "updates_per_second": training.updates / statistics.median(training.seconds),
        "first_call_seconds": training.compile_seconds,
    }


def table(rows: list[dict], domain: str) -> str:
    lines = [
        f"{domain:34} {'worlds':>6} {'steps/s':>12} {'range':>25} {'substeps':>16} {'substeps/s':>12} "
        f"{'over Playground':>16} {'by substep':>11} {'first call':>11}"
    ]
    for row in (row for row in rows if row["domain"] == domain):
        span = f"{row['slowest']:,.0f} to {row['fastest']:,.0f}"
        ratio, by_substep = (f"{x:.2f}" if x else "-" for x in (row[_OVER], row[f"{_OVER}_by_substep"]))
        physics = f"{row['substeps']} x {1000 * row['substep_seconds']:g} ms {row['integrator']}"
        lines.append(
            f"  {row['contestant']:32} {row['worlds']:6} {row['steps_per_second']:12,.0f} {span:>25} {physics:>16} "
            f"{row['substeps_per_second']:12,.0f} {ratio:>16} {by_substep:>11} {row['first_call_seconds']:9.1f} s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    run_main(main)
