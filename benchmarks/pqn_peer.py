"""Compare PQN with its authors' code on MinAtar's games: scores and seconds of whole runs, ten seeds in one program.

    python benchmarks/pqn_peer.py [--games NAME ...] [--sides NAME ...] [--seeds 10] [--steps N] [--within N]
                                  [--devices 0 1 ...] [--out DIR]

    purejaxql    ``make_train`` of its ``pqn_minatar.py`` with the settings of its ``pqn_minatar.yaml``
    mtjax        ``python -m mtjax.train --env=gymnax:GAME-MinAtar --agent=pqn --preset=gpu --split=none``
    mtjax-conv   the same with ``--env.pictures``

The first needs a clone of github.com/mttga/purejaxql (47af6d7) on PYTHONPATH. It was written for gymnax 0.0.6, whose
steps tell one end. Both sides play the games of gymnax 1.0; theirs are told its two ends as one. What purejaxql imports
and does not need here (wandb, hydra, omegaconf) may be missing.

Steps, worlds, rollouts, passes, minibatches, rates and exploration are the same. The network is a convolution of 16
channels and a layer of 128 there and in mtjax-conv, two layers of 128 in mtjax. There its input is 0 or 1/255, here 0
or 1. Optimisers differ: RAdam there, Adam here. All are evaluated at the end under the best actions. There the score is
the mean over all episodes that end in 128 worlds within one limit of steps, so that short ones count more; here over
``--episodes`` whole episodes of each seed. Seconds are those of the run, with 20 evaluations there and one here;
compiling is apart.

Every game and side is a process of its own, which writes ``OUT/GAME-SIDE.json``; ``parts.py`` says how an interrupted
comparison goes on. All results in OUT give ``OUT/table.md``: means with 95% intervals over seeds.
"""

import argparse
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import parts
from report import markdown, record, run_main

GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
SIDES = ("purejaxql", "mtjax", "mtjax-conv")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", default=list(GAMES), choices=GAMES)
    parser.add_argument("--sides", nargs="+", default=list(SIDES), choices=SIDES)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=10_000_000, help="of each seed; the authors' number")
    parser.add_argument("--episodes", type=int, default=20, help="of each of our seeds")
    parts.add_peer_flags(parser, "pqn-peer", ("GAME", "SIDE"))
    arguments = parser.parse_args()
    pairs = [(game, side) for game in arguments.games for side in arguments.sides]
    parts.run_pairs(__file__, arguments, pairs, play, tabulate)


def play(arguments: argparse.Namespace, game: str, side: str) -> None:
    """Learn one game by one side, and write its result."""
    name = f"{game}-MinAtar"
    found = theirs(arguments, name) if side == "purejaxql" else ours(arguments, name, pictures=side == "mtjax-conv")
    result = record(arguments, {"game": game, "side": side, **found})
    parts.write_result(arguments.out / f"{game}-{side}.json", result)


def theirs(arguments: argparse.Namespace, game: str) -> dict[str, Any]:
    """Learn a game by the authors' code, all seeds mapped, and return seconds and scores."""
    import jax

    for name in ("hydra", "omegaconf", "wandb"):
        stand_in(name)
    from purejaxql import pqn_minatar  # type: ignore  # not a dependency of this package

    pqn_minatar.LogWrapper = with_one_end(pqn_minatar.LogWrapper)
    settings = authors_settings(Path(pqn_minatar.__file__).parent / "config/alg/pqn_minatar.yaml")
    given = {"ENV_NAME": game, "WANDB_MODE": "disabled", "TOTAL_TIMESTEPS": arguments.steps}
    settings |= given | {"TOTAL_TIMESTEPS_DECAY": arguments.steps}
    keys = jax.random.split(jax.random.PRNGKey(0), arguments.seeds)
    before = time.perf_counter()
    run = jax.jit(jax.vmap(pqn_minatar.make_train(dict(settings)))).lower(keys).compile()
    compiled = time.perf_counter()
    metrics = jax.block_until_ready(run(keys)["metrics"])
    seconds = time.perf_counter() - compiled
    curve = np.asarray(metrics["test/returned_episode_returns"])  # (S, U), as of the last evaluation
    return {
        "steps": int(metrics["env_step"][0, -1]),
        "compile_seconds": compiled - before,
        "seconds": seconds,
        "scores": curve[:, -1].tolist(),
        "curve": curve[:, :: max(curve.shape[1] // 20, 1)].mean(axis=0).tolist(),
        "choices": settings,
    }


def stand_in(name: str) -> None:
    """Let an empty module be imported where one is missing that the authors' functions do not need."""
    try:
        __import__(name)
    except ModuleNotFoundError:
        sys.modules[name] = module = ModuleType(name)
        vars(module).update(OmegaConf=None, main=lambda **_: lambda function: function)


def with_one_end(wrapper: Any) -> Any:
    """Return a wrapper of gymnax's whose steps tell one end and numbers alone, as those of before 1.0 did."""

    class OneEnd(wrapper):
        def step(self, *given: Any) -> tuple:
            obs, state, reward, terminated, truncated, info = super().step(*given)
            info = {name: x for name, x in info.items() if x.ndim == 0}
            return obs, state, reward, terminated | truncated, info

    return OneEnd


def authors_settings(path: Path) -> dict[str, Any]:
    """Read the authors' settings, whose numbers with an exponent YAML takes for words."""
    import yaml

    number = lambda x: float(x) if isinstance(x, str) and x.replace("e", "").isdigit() else x
    return {name: number(x) for name, x in yaml.safe_load(path.read_text()).items()}


def ours(arguments: argparse.Namespace, game: str, pictures: bool) -> dict[str, Any]:
    """Learn a game by ours, all seeds in one program, and return seconds and scores."""
    import mtjax

    config = mtjax.preset(f"gymnax:{game}", "pqn", "gpu", split="none", pictures=pictures)
    result = mtjax.train(
        *(config.family, config.learner),
        settings=config.training,
        steps=arguments.steps,
        seeds=arguments.seeds,
        eval_every=arguments.steps,
        eval_episodes=arguments.episodes,
        quiet=True,
    )
    return {
        "steps": int(result.evaluations.steps[-1]),  # whole chunks
        "compile_seconds": result.compile_seconds,
        "seconds": result.total_seconds - result.compile_seconds,
        "scores": result.evaluations.returns["train"][:, -1].mean(axis=(1, 2)).tolist(),
        "choices": {"worlds": config.training.num_envs, "hidden": config.learner.hidden, "pictures": pictures},
    }


def tabulate(out: Path) -> str:
    """Return the table of all results, a line for each game and side."""
    from mtjax.report.stats import seed_interval

    lines = []
    for result in parts.read_results(out):
        scores = np.asarray(result["scores"])
        interval = format(seed_interval(scores[:, None]), ".1f")
        cells = [interval, f"{scores.min():.1f} to {scores.max():.1f}", f"{result['seconds']:.0f}"]
        count, steps = str(len(scores)), f"{result['steps']:,}"
        lines.append([result["game"], result["side"], count, steps, *cells, f"{result['compile_seconds']:.0f}"])
    head = ["game", "side", "seeds", "steps", "score", "range of seeds", "seconds", "compiling, s"]
    return markdown(head, sorted(lines))


if __name__ == "__main__":
    run_main(main)
