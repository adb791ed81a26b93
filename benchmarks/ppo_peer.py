"""Compare PPO with Brax PPO as MuJoCo Playground 0.2 tunes it: seconds until a return, on the same device.

    python benchmarks/ppo_peer.py [--envs NAME ...] [--sides NAME ...] [--seeds N] [--steps N] [--seconds N]
                                  [--within N] [--devices 0 1 ...] [--out DIR]

    playground-warp, playground-jax    ``brax.training.agents.ppo`` on one of Playground's tasks, with the settings of
                                       ``mujoco_playground.config.dm_control_suite_params``, on either engine
    mtjax                              ``python -m mtjax.train --env=NAME --agent=ppo`` with no further flags
    mtjax-as-wide                      the same with as many worlds and minibatches as Playground's settings

Needs playground==0.2.0. Every task, side and seed is a process of its own, which writes ``OUT/TASK/SIDE-SEED.json``;
``parts.py`` says how an interrupted comparison goes on. All results in OUT give ``OUT/table.md`` and
``OUT/settings.md``. ``--seeds 0 --out DIR`` runs nothing and only makes these.

Both sides learn for the same number of steps, until ``--seconds`` of the process are over, or until an evaluation has
reached ``--enough``. Both are evaluated after every ``--evaluate-every`` steps, by as many episodes under the mean
action. What differs is what each side chooses: physics substeps, passes over a batch, networks, starts of episodes, and
the time at which episodes end. The table has steps, substeps and gradient steps beside each other.

Times are of the first evaluation that reached a return, and evaluations themselves are left out of them. "training"
leaves out importing and compiling too: for ours as it is measured; for theirs the first interval, which compiles,
counts as much as the median of the later ones. "cold" counts from the start of a process whose caches of programs and
kernels are empty, as those of the first seed of every task and side in a call are; "cold start" is its part before
training.

Playground calls ``jax.device_put_replicated``, which JAX 0.11 has removed; it is put back for it.
"""

import argparse
import dataclasses
import functools
import itertools
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import parts
from report import markdown, record, run_main

# Playground's task and ours.
ENVS = {
    "CheetahRun": "cheetah-run",
    "FingerSpin": "finger-spin",
    "WalkerWalk": "walker-walk",
    "CartpoleSwingup": "cartpole-swingup",
    "HopperHop": "hopper-hop",
}
SIDES = ("playground-warp", "mtjax", "mtjax-as-wide", "playground-jax")
_CACHE = "MTJAX_CACHE"
_SHARE = 0.9  # of the best return of either side: a mark for tasks on which neither reaches the others


class Reached(NamedTuple):
    """Holds an evaluation, and the clocks when it began, without the evaluations before it."""

    steps: int
    process: float  # seconds since the start of the process
    training: float | None  # of these, seconds of training; None if compiling is not told apart
    mean: float  # return over episodes


class Enough(Exception):
    """Training is stopped because its time is over, or because it has reached enough."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=list(ENVS), choices=ENVS)
    parser.add_argument("--sides", nargs="+", default=list(SIDES), choices=SIDES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=float, default=60e6, help="of each run; Playground's own number")
    parser.add_argument("--evaluate-every", type=float, default=2e6)
    parser.add_argument("--episodes", type=int, default=128, help="of each evaluation")
    parser.add_argument("--marks", type=float, nargs="+", default=[500, 700, 850])
    parser.add_argument("--enough", type=float, default=float("inf"), help="a return that ends a run")
    parser.add_argument("--smaller", type=int, default=1, help="divide worlds and batches by this, to try the script")
    parts.add_peer_flags(parser, "ppo-peer", ("TASK", "SIDE", "SEED"), seconds=300)
    arguments = parser.parse_args()
    if arguments.part:
        env, side, seed = arguments.part
        play(arguments, env, side, int(seed))
        return
    every = [(env, side, seed) for seed in range(arguments.seeds) for env in arguments.envs for side in arguments.sides]
    with tempfile.TemporaryDirectory() as caches:
        of_all = [part(env, side, seed, Path(caches), arguments.out) for env, side, seed in every]
        left = parts.run_parts(__file__, of_all, arguments.out, arguments)
    parts.end(tabulate(arguments.out, arguments.marks), arguments.out, left)


def part(env: str, side: str, seed: int, caches: Path, out: Path) -> parts.Part:
    """Return a part, which shares its caches of compiled programs and kernels with other seeds only."""
    cache = caches / env / side
    folders = {_CACHE: cache / "xla", "JAX_COMPILATION_CACHE_DIR": cache / "xla", "WARP_CACHE_PATH": cache / "warp"}
    words = [*sys.argv[1:], "--out", str(out), "--part", env, side, str(seed)]
    return parts.Part(f"{env}/{side}-{seed}", words, {name: str(folder) for name, folder in folders.items()})


def play(arguments: argparse.Namespace, env: str, side: str, seed: int) -> None:
    """Train one side on one task, and write its result."""
    learn = theirs if side.startswith("playground") else ours
    cold = not any(Path(os.environ[_CACHE]).glob("*"))
    curve, choices = learn(arguments, env, side, seed)
    result = {"env": env, "side": side, "seed": seed, "cold": cold, "choices": choices}
    result |= {"seconds": parts.since_start(), "curve": [point._asdict() for point in curve]}
    parts.write_result(arguments.out / env / f"{side}-{seed}.json", record(arguments, result))


def theirs(arguments: argparse.Namespace, name: str, side: str, seed: int) -> tuple[list[Reached], dict[str, Any]]:
    """Train by Brax PPO on Playground's task, and return its evaluations and what it chose."""
    import jax
    import jax.numpy as jnp
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo
    from mujoco_playground import registry, wrapper  # type: ignore  # not a dependency of this package
    from mujoco_playground.config import dm_control_suite_params  # type: ignore

    jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
    impl = side.removeprefix("playground-")
    env = registry.load(name, config_overrides={"impl": impl})
    if impl == "warp":
        silence(env)
    tuned = dict(dm_control_suite_params.brax_ppo_config(name, impl))
    tuned = {name: x // arguments.smaller if name in ("num_envs", "batch_size") else x for name, x in tuned.items()}
    chosen = dict(tuned.pop("network_factory", {}))
    batch = tuned["batch_size"] * tuned["num_minibatches"] * tuned["unroll_length"] * tuned["action_repeat"]
    # Worlds are reset after every batch, as they are with Playground's ten evaluations and ten resets between two.
    between = max(round(arguments.evaluate_every / batch), 1)
    tuned |= {"num_timesteps": int(arguments.steps), "num_resets_per_eval": between}
    tuned |= {"num_evals": 1 + max(int(arguments.steps / (between * batch)), 1)}
    begun, spent, points = parts.since_start(), [0.0], []

    def note(steps: int, metrics: Any) -> None:
        spent[0] += float(metrics["eval/epoch_eval_time"])
        now = parts.since_start()
        points.append(Reached(int(steps), now - spent[0], None, float(metrics["eval/episode_reward"])))
        show(side, points[-1])
        if now > arguments.seconds or points[-1].mean >= arguments.enough:
            raise Enough

    try:
        ppo.train(
            environment=env,
            wrap_env_fn=wrapper.wrap_for_brax_training,
            network_factory=functools.partial(networks.make_ppo_networks, **chosen),
            progress_fn=note,
            num_eval_envs=arguments.episodes,
            deterministic_eval=True,
            seed=seed,
            **tuned,
        )
    except Enough:
        pass
    passes = tuned["num_updates_per_batch"]
    choices = {
        "worlds": tuned["num_envs"],
        "gradient_steps_per_million": gradient_steps(passes, tuned["num_minibatches"], batch),
        "samples_per_gradient_step": batch // tuned["num_minibatches"],
        "passes": passes,
        "substeps": env.n_substeps,
        "substep_seconds": env.sim_dt,
        "engine": impl,
        "imported_after": begun,
        "all": {**tuned, "networks": chosen},
    }
    return without_compiling(points), choices


def silence(env: Any) -> None:
    """Let the kernels of Playground's task not print that a solver stopped after the iterations that it may take.

    Ours do not print it either. It was a gigabyte in three minutes of FingerSpin.
    """
    from mujoco.mjx.third_party import mujoco_warp

    model = env._mjx_model
    unwarned = mujoco_warp.OverflowType.ITERATIONS | mujoco_warp.OverflowType.LS_ITERATIONS
    own = model.opt._impl.replace(warn_overflow=int(model.opt._impl.warn_overflow & ~unwarned))
    env._mjx_model = model.replace(opt=model.opt.replace(_impl=own))


def without_compiling(points: list[Reached]) -> list[Reached]:
    """Return evaluations with the seconds of training: the first interval, which compiles, as the median of others."""
    between = [after.process - before.process for before, after in itertools.pairwise(points)]
    if len(between) < 2:
        return points
    usual = statistics.median(between[1:])
    first = points[1].process - min(usual, between[0])
    return [x._replace(training=max(x.process - first, 0.0)) for x in points]


def ours(arguments: argparse.Namespace, name: str, side: str, seed: int) -> tuple[list[Reached], dict[str, Any]]:
    """Train by PPO on the task of ours, and return its evaluations and what it chose."""
    import mtjax
    from mtjax.compiling.programs import enable_compile_cache
    from mtjax.config import configure
    from mtjax.training.journal import Hooks
    from mtjax.training.launch import check, launch

    enable_compile_cache()
    config = mtjax.preset(ENVS[name], "ppo", "gpu")
    given = {"num_envs": 2048, "minibatches": 32} if side == "mtjax-as-wide" else {}
    agent, settings = configure(config.learner, config.training, given)
    settings = dataclasses.replace(settings, num_envs=max(settings.num_envs // arguments.smaller, 1))
    choices = choices_of(config.family, agent, settings)
    begun, spent, points, seconds = parts.since_start(), [0.0], [], [0.0, 0.0]

    def begin(row: dict[str, Any]) -> bool:
        seconds[:] = float(row["seconds"]), parts.since_start()
        return seconds[1] > arguments.seconds or any(point.mean >= arguments.enough for point in points)

    def note(evaluations: Any) -> None:
        mean = float(evaluations.returns["train"][:, -1].mean())
        points.append(Reached(int(evaluations.steps[-1]), seconds[1] - spent[0], seconds[0], mean))
        spent[0] += parts.since_start() - seconds[1]
        show(side, points[-1])

    plan = {"steps": int(arguments.steps), "eval_every": int(arguments.evaluate_every)}
    plan = dataclasses.replace(config.plan, seed=seed, seeds=1, eval_episodes=arguments.episodes, **plan)
    config = config.checked(plan=plan, training=settings, learner=agent)
    check(config)
    launch(config, Hooks(on_chunk=begin, on_evaluation=note, quiet=True))
    return points, choices | {"imported_after": begun}


def choices_of(family: Any, agent: Any, settings: Any) -> dict[str, Any]:
    """Return what our side chooses, as the table shows it beside Playground's choices."""
    rollouts = agent.experience
    batch = settings.num_envs * rollouts.unroll
    return {
        "worlds": settings.num_envs,
        "gradient_steps_per_million": gradient_steps(rollouts.epochs, rollouts.minibatches, batch),
        "samples_per_gradient_step": batch // rollouts.minibatches,
        "passes": rollouts.epochs,
        "substeps": family.num_substeps,
        "substep_seconds": family.models[0].opt.timestep,
        "engine": family.engine_name,
        "all": {"agent": str(agent), "training": dataclasses.asdict(settings)},
    }


def gradient_steps(passes: int, minibatches: int, batch: int) -> float:
    """Return the gradient steps in a million steps of the environment, with passes over each batch of steps."""
    return 1e6 * passes * minibatches / batch


def show(side: str, point: Reached) -> None:
    print(f"{side}: {point.process:.1f} s, {point.steps:,} steps, return {point.mean:.1f}", flush=True)


def tabulate(out: Path, marks: list[float]) -> str:
    """Return the table of times of all results, and write that of settings."""
    found: dict[tuple[str, str], list[dict]] = {}
    for result in parts.read_results(out):
        found.setdefault((result["env"], result["side"]), []).append(result)
    best = {env: max(top(x) for (of, _), x in found.items() if of == env) for env, _ in found}
    texts = [*(f"{x:g}" for x in marks), f"{_SHARE:.0%} of the best"]
    head = ["task", "side", "seeds", "card", "best return", "cold start s"]
    head += [f"{clock} s to {text}" for text in texts for clock in ("training", "cold")]
    head += ["env-steps/s", "substeps/s", "gradient steps/s", "gradient steps a million steps"]
    lines = [cells(env, side, results, [*marks, _SHARE * best[env]]) for (env, side), results in found.items()]
    of_best = ", ".join(f"{env} {_SHARE * value:.0f}" for env, value in best.items())
    table = f"""{markdown(head, lines)}

{_SHARE:.0%} of the best is of the side with the highest mean over seeds of their best evaluations: {of_best}. Times are
medians over seeds, with the least and the largest. "-": not every seed reached the return."""
    names = ["worlds", "passes", "samples_per_gradient_step", "substeps", "substep_seconds", "engine", "imported_after"]
    rows = [[*key, *(f"{x[0]['choices'][name]}" for name in names)] for key, x in found.items()]
    (out / "settings.md").write_text(markdown(["task", "side", *(x.replace("_", " ") for x in names)], rows) + "\n")
    return table


def top(results: list[dict]) -> float:
    """Return the mean over seeds of the best evaluation of each."""
    return statistics.mean(max(point["mean"] for point in x["curve"]) for x in results)


def cells(env: str, side: str, results: list[dict], marks: list[float]) -> list[str]:
    """Return a row of the table: one side on one task."""
    cards, cold = ", ".join(sorted({x["machine"]["device"] for x in results})), [x for x in results if x["cold"]]
    starts = [x["process"] - x["training"] for of in cold for x in of["curve"][-1:] if x["training"] is not None]
    row = [env, side, str(len(results)), cards, f"{top(results):.0f}", span(starts)]
    for mark in marks:
        row.append(span([first(x["curve"], mark, "training") for x in results]))
        row.append(span([first(x["curve"], mark, "process") for x in cold]))
    rates = [rate for x in results if (rate := steps_per_second(x["curve"]))]
    if not rates:
        return [*row, *("-",) * 4]
    rate, choices = statistics.median(rates), results[0]["choices"]
    updates = choices["gradient_steps_per_million"]
    numbers = rate, rate * choices["substeps"], rate * updates / 1e6, updates
    return [*row, *(f"{x:,.0f}" for x in numbers)]


def first(curve: list[dict], mark: float, clock: str) -> float | None:
    """Return the seconds of the first evaluation at or above a return; None if there is none."""
    return next((point[clock] for point in curve if point["mean"] >= mark), None)


def span(times: list[float | None]) -> str:
    """Return the median of times, with the least and the largest if there are several; - if one is missing."""
    known = [x for x in times if x is not None]
    if len(known) < max(len(times), 1):
        return "-"
    middle = f"{statistics.median(known):.1f}"
    return middle if len(known) == 1 else f"{middle} [{min(known):.1f}, {max(known):.1f}]"


def steps_per_second(curve: list[dict]) -> float | None:
    """Return the environment steps a second of training, from the first evaluation after training began."""
    known = [point for point in curve if point["training"] is not None and point["steps"]]
    if len(known) < 2:
        return None
    return (known[-1]["steps"] - known[0]["steps"]) / (known[-1]["training"] - known[0]["training"])


if __name__ == "__main__":
    run_main(main)
