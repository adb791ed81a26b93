"""Train families for a few minutes each, one seed: a curve of each, and the policies that the films of docs show.

    python benchmarks/families.py [NAME ...] [--seconds 400] [--out DIR]
    python docs/make_films.py DIR/*/policy

``TRAINED`` says which agent learns a family, by its preset, and for how many steps; a run also ends after ``--seconds``
of training. Every family writes ``DIR/NAME/curve.csv`` (the mean return of the training episodes, at most forty lines)
and ``DIR/NAME/policy``, which ``mtjax.load`` takes. All curves in DIR together are ``DIR/families.csv``;
``DIR/origin.json`` has machine, versions and commit. Families that
have a policy are not run again. A signal ends the program, and the same command with the same DIR goes on.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from parts import dated
from report import note_origin, read_lines, run_main, write_lines
from resumable import train

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import with_preset
from mtjax.names import nearest_error
from mtjax.saved import policy_files

_M = 1_000_000
TRAINED = {  # family -> agent and steps
    **{f"cartpole-{name}": ("ppo", 10 * _M) for name in ("balance", "balance-sparse")},
    **{f"cartpole-swingup{name}": ("ppo", 15 * _M) for name in ("", "-vary-cart-mass", "-vary-pole-mass")},
    **{f"cheetah-{name}": ("ppo", 20 * _M) for name in ("run", "jump", "run-backward", "vary-direction")},
    **{f"cheetah-run-vary-{name}": ("ppo", 20 * _M) for name in ("speed", "back-foot-length")},
    **{f"cheetah-run-vary-foot-{name}": ("ppo", 20 * _M) for name in ("position", "size")},
    **{f"walker-{name}": ("ppo", 15 * _M) for name in ("stand", "walk", "walk-backward", "vary-speed")},
    **{f"walker-walk-vary-{name}": ("ppo", 15 * _M) for name in ("friction", "foot-length")},
    **{f"walker-run{name}": ("brc", 3 * _M) for name in ("", "-backward", "-vary-friction", "-vary-foot-length")},
    **{f"reacher-{name}": ("ppo", 20 * _M) for name in ("easy", "hard", "vary-goal")},
    **{f"finger-{name}": ("ppo", 15 * _M) for name in ("spin", "spin-vary-touch-size")},
    **{f"finger-turn-{name}": ("ppo", 60 * _M) for name in ("easy", "hard", "vary-target")},
    **{f"swimmer-{name}": ("ppo", 15 * _M) for name in ("swimmer6", "swimmer15")},
    **{f"fish-{name}": ("ppo", 20 * _M) for name in ("upright", "swim")},
    **{f"hopper-{name}": ("brc", 4 * _M) for name in ("hop", "hop-backward", "stand")},
    **{f"humanoid-{name}": ("brc", 4 * _M) for name in ("stand", "walk", "run")},
    **{f"dog-{name}": ("brc", 4 * _M) for name in ("stand", "walk", "trot", "run")},
    **{f"quadruped-{name}": ("brc", 2 * _M) for name in ("walk", "run")},
    **{f"acrobot-swingup{name}": ("brc", 5 * _M) for name in ("", "-sparse")},
    **{f"corridor-maze{name}": ("ppo", 20 * _M) for name in ("", "-vary-goal", "-vary-layout")},
    "ball-in-cup-catch": ("brc", _M),
    "ball-in-cup-spin": ("ppo", 5 * _M),
    "cartpole-swingup-sparse": ("brc", _M),
    "pendulum-spin": ("ppo", 10 * _M),
    "pendulum-swingup": ("brc", 3 * _M),
    "point-mass-easy": ("ppo", 10 * _M),
    "two-goal-maze": ("drq", 4 * _M),
    "two-goal-maze-seen": ("ppo", 10 * _M),
    "point-mass-vary-goal": ("sac-conditioned", 4 * _M),
    "bandit": ("ppo", _M // 10),
    "tabular-mdp": ("ppo", _M // 4),
    **{f"control-{name}": ("ppo", 4 * _M) for name in ("cartpole", "acrobot")},
    **{name: ("ppo", 2 * _M) for name in ("link", "racing", "sailing", "trading", "coloured-maze")},
    "light-world": ("ppo", 5 * _M),
    **{name: ("sketches", 10 * _M) for name in ("craft-sketched", "light-world-sketched")},
    **{name: ("ppo", 10 * _M) for name in ("craft", "errands")},
    **{name: ("ppo", 2 * _M) for name in ("claw", "tabletop")},
    **{
        f"brax-{name}": ("ppo", 20 * _M)
        for name in ("ant", "ant-vary-direction", "halfcheetah", "halfcheetah-vary-speed")
    },
    **{f"brax-{name}": ("ppo", 20 * _M) for name in ("hopper", "walker2d", "humanoid", "humanoidstandup")},
    **{f"brax-{name}": ("ppo", 10 * _M) for name in ("reacher", "pusher", "fast")},
    **{f"brax-inverted-{name}": ("ppo", 10 * _M) for name in ("pendulum", "double-pendulum")},
    "grid-navi": ("rl2", 3 * _M),
    "hidden-bandit": ("rl2", _M),
}
SETTINGS: dict[str, dict[str, Any]] = {
    "two-goal-maze": {"pixels": 64, "scores": True},  # pictures, as nothing else tells the goal
    "grid-navi": {"training_settings": {"trials": 4}, "agent_settings": {"unroll": 60}},
    "hidden-bandit": {"training_settings": {"trials": 10}, "agent_settings": {"unroll": 10}},
}
"""Settings with which families are learned, beside those of the preset."""
DRAWN = ("light-world",)
"""Families played by drawn actions: one observation stands for many places, and the likeliest action gets stuck."""
_LINES = 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("families", nargs="*", metavar="NAME", help="by default all of TRAINED")
    parser.add_argument("--seconds", type=float, default=400.0, help="of training, after which a run ends")
    parser.add_argument("--out", type=Path, default=dated("families"))
    arguments = parser.parse_args()
    for name in arguments.families:
        if name not in TRAINED:
            raise nearest_error("family", name, list(TRAINED))
    enable_compile_cache()
    note_origin(arguments, arguments.out)
    for name in arguments.families or TRAINED:
        if not (arguments.out / name / "policy").is_dir():
            learn(name, *TRAINED[name], arguments.out / name, arguments.seconds)
    lines = [line for file in sorted(arguments.out.glob("*/curve.csv")) for line in read_lines(file)]
    write_lines(arguments.out / "families.csv", lines)


def learn(name: str, agent: str, steps: int, folder: Path, seconds: float) -> None:
    """Train a family until it has made its steps or its time is over; keep the curve and the policy."""
    run, program = folder / "run", with_preset(name, agent, **SETTINGS.get(name, {}))
    result = train(
        run,
        program.family,
        program.learner,
        seconds,
        steps=steps,
        eval_every=steps,
        eval_episodes=5 * program.training.trials,
        eval_sampled=name in DRAWN,
        settings=program.training,
        quiet=False,
    )
    write_lines(folder / "curve.csv", curve(name, agent, result.rows))
    policy_files.write(run, folder / "policy")
    shutil.rmtree(run)


def curve(name: str, agent: str, metrics: Sequence[dict]) -> list[dict]:
    """Return lines in which episodes ended, evenly thinned and with the last one."""
    known = [line for line in metrics if line["return"]]
    every = -(-len(known) // _LINES) or 1
    kept = known[::-1][::every][::-1]
    numbers = [{"seconds": x["seconds"], "steps": x["steps"], "return": f"{float(x['return']):.1f}"} for x in kept]
    return [{"family": name, "agent": agent, **x} for x in numbers]


if __name__ == "__main__":
    run_main(main)
