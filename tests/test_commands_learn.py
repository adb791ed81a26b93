"""Every training command in README and docs, and README's example in Python, learns: the last return beats the first.

A new command needs a line in ``MARKS``: by how much it must learn, or why it is not run here.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from test_docs import PAGES, ROOT, training

from mtjax.learning.evaluation import load_evaluations


class Learns(NamedTuple):
    """By how much a command's last return on training tasks must beat its first, with flags that make it shorter."""

    gain: float
    flags: str = ""


_GPU = "takes hours without a GPU"
_OTHER = "needs a file or a run of the reader's own"
_HELP = "prints flags and trains nothing"
_MANY = "trains as many agents as the points of a sweep; tests/test_sweep.py has smaller ones"
_TRIALS = "trains sixteen agents or more; tests/test_search.py has smaller ones"
_COPIES = "trains twenty agents; tests/test_populations.py has smaller ones"
_HOSTS = "takes several processes; tests/test_devices.py has such runs"
_FINGER = "ten fingers still have a return of 0 to 2 after 300,000 steps, which take two minutes of a CPU core"
_WALKER = "a walker takes several minutes on two CPU cores, docs/results/returns.md"
_ONE = "--env.vary.size=1.1 --split=none --steps=250000"  # finger of the ten
_GYM = "needs Gymnasium; tests/test_hosted.py learns to balance there"
_GRID = "earns nearly all that can be earned in ten minutes of two CPU cores; tests/test_recurrent.py has a bandit"
_FOUND = "earns nearly all that it can before its first evaluation; tests/test_posterior.py has a bandit"
_READS = "begins to earn more after two minutes of two CPU cores"
_PULLS = "ten pulls earn between 5 and 6.02, too little to see in few trials; tests/test_own_inference.py trains it"
_BELIEVES = "ten pulls earn between 5 and 6.02; tests/test_posterior.py has beliefs that are known"
_STORED = "takes over ten minutes of two CPU cores; tests/test_recurrent.py has burn-in step by step"
_SOON = "earns nearly all that it can before its first evaluation; tests/test_pqn.py has probes"
_ON = "minutes of a GPU, by benchmarks/resets.py; tests/test_tabletop.py plays such worlds"
_KEEPS = "tests/test_remembering.py measures what it keeps"
_CRAFT = "takes longer than ten minutes of two CPU cores; tests/test_sketches.py learns in a small corridor"
_PAGE = "is --quick with a page; tests/test_view.py has a run with one"
_LOOP = "--env=point-mass-vary-goal --agent=multi-head"  # one pair of the loop around the command

MARKS: dict[str, Learns | str] = {
    "--quick": Learns(25),
    "--import=examples/own_environment.py --env=spring --agent=care --steps=200000": Learns(30),
    "--import=examples/own_inference.py --env=hidden-bandit --trials=10 --agent=ppo --agent.conditioning=averages "
    "--agent.unroll=10": _PULLS,
    "'--env=$env' '--agent=$agent' --seeds=3 --steps=400000 --chunk-steps=250 --runs=runs/first": Learns(20, _LOOP),
    "--env=finger-spin-vary-size --agent=sac-conditioned": Learns(5, _ONE),
    "--env=cartpole-swingup+finger-spin+walker-walk-vary-friction --agent=multi-head": Learns(5, "--steps=400000"),
    "--agent=care --agent.num-experts=4 --agent.gradients=pcgrad --seeds=10": _FINGER,
    "--env=finger-spin-vary-size --agent=sac-conditioned --agent.encoder=moe --agent.mode=ensemble": _FINGER,
    "--import=examples/own_encoder.py --agent.encoder=gated --agent.gate-widths 32": _FINGER,
    "--import=examples/own_agent.py --agent=best-of --agent.candidates=8": _FINGER,
    "--env=cartpole-swingup+walker-walk --env.vary.walker-walk.friction=0.7:1.6:4 --split=none": _WALKER,
    "--env=walker-walk --env.vary.torso-mass=0.5:1.5:10 --env.vary.gravity=5:15": _WALKER,
    "--env=walker-walk-vary-friction --split=hip-bmdp --seeds=5": _WALKER,
    "--env=sailing --agent=ppo": Learns(2),
    "--env=tabletop --agent=ppo --reset-free --curriculum=forward-backward": _ON,
    "--env=point-mass-vary-goal --env.num-tasks=4 --split=none --agent=sac --agent.conditioning=one-hot "
    "--agent.normalize-observations=false --num-envs=8 --batch-size=32 --chunk-steps=500 --curriculum=sequence:2000 "
    "--steps=64000 --agent.continual=packnet --agent.retrain-updates=2000": _KEEPS,
    "--env=walker-walk --env.vary.friction=0.1:2:20 --split=none --agent=ppo --agent.conditioning=none "
    "--num-envs=103 --curriculum=sequence:100000 --chunk-steps=10000 --agent.plasticity=continual-backprop": _WALKER,
    "--env=cw10 --agent=brc --agent.conditioning=one-hot --agent.heads=per-task --num-envs=256 "
    "--batch-size=64 --curriculum=sequence:3000 --chunk-steps=750 --steps=7680000 --agent.continual=clone": _GPU,
    "--env=errands --agent=ppo --agent.conditioning=text --agent.encoder=film": _READS,
    "--env=bandit --agent=pqn": _SOON,
    "--env=gymnasium:CartPole-v1 --agent=ppo": _GYM,
    "--env=gymnax:Breakout-MinAtar --agent=pqn": "needs gymnax; tests/test_pqn.py has probes",
    "--env=gymnax:Asterix-MinAtar --env.pictures --agent=pqn": "needs gymnax; tests/test_pqn.py has probes",
    "--env=envpool:Pong-v5 --agent=impala --preset=gpu": _GPU,
    "--env=hidden-bandit --agent=ppo --trials=10 --agent.conditioning=posterior --agent.unroll=10": _BELIEVES,
    "--env=point-mass-vary-goal --env.num-tasks=4 --split=none --agent=sac --trials=2 --seeds=3 "
    "--agent.conditioning=recurrent --agent.burn-in=16 --agent.hidden 64 64 --num-envs=4 --updates-per-step=2 "
    "--batch-size=4 --chunk-steps=500 --steps=160000 --eval-every=40000 --eval-episodes=10": _STORED,
    "--env=craft-sketched --agent=sketches": _CRAFT,
    "--env=craft-sketched --agent=sketches --agent.sharing=tasks": _CRAFT,
    "--env=craft-sketched --agent=sketches --agent.sharing=all --agent.conditioning=one-hot": _CRAFT,
    "--env=light-world-sketched --agent=sketches": _CRAFT,
    "--env=craft --env.vary.goal=bed,axe --split=none --agent=options --agent.endings=stop --agent.keep-options "
    "--agent.heads=disjoint --agent.conditioning=none --agent.deliberation-cost=0 --from=runs/...": _OTHER,
    "--env=cheetah-run --agent=ppo": _GPU,
    "--env=brax-ant-vary-direction --agent=ppo": _GPU,
    "--env=grid-navi --agent=rl2 --trials=4 --agent.unroll=60": _GRID,
    "--env=grid-navi --env.size=3 --env.steps=6 --trials=3 --agent=ppo --agent.conditioning=posterior "
    "--agent.recurrent-size=32 --agent.inference-widths 32 32 --agent.decoded-steps=6 --agent.hidden 64 64 "
    "--agent.unroll=18 --agent.gamma=0.97 --agent.entropy-cost=0.02 --agent.actor-lr=1e-3 --num-envs=128 "
    "--chunk-steps=180 --steps=600000 --eval-every=200000 --eval-episodes=30": _FOUND,
    "--env=finger-spin --env.vary.size=0.95:1.13:200 --curriculum=random:10:4000": _FINGER,
    "--env=gymnasium:Pendulum-v1 --env.vary.g=5:15:5 --agent=ppo": _GYM,
    "--env=mt10 --agent=multi-head": _GPU,
    "--env=mt10 --agent=care --agent.num-experts=4 --agent.conditioning=text --agent.text=all-MiniLM-L6-v2 "
    "--batch-size=128 --steps=20000000 --seed=1": _GPU,
    "--env=finger-spin-vary-size --agent=drq --env.pixels=64 --env.frames=3 --env.repeat=2": _GPU,
    "--env=finger-spin-vary-size --agent=care --agent.representation=encoded --env.pixels=64 --n-step=3 "
    "--agent.encoder-tau=1 --env.repeat=2": _GPU,
    "--env=cheetah-run --agent=drq --env.pixels=64 --seeds=10 --replay-size=100000 --host-replay-size=1000000 "
    "--chunk-steps=100": _GPU,
    "--env=finger-spin-vary-size --agent=pcgrad --help": _HELP,
    "--env=finger-spin-vary-size --agent=care --help": _HELP,
    "--quick --view": _PAGE,
    "--config=settings.toml --steps=2000000": _OTHER,
    "--resume=runs/...": _OTHER,
    "'--resume=$run'": _OTHER,
    "--env=finger-spin-vary-size --seeds=10 --steps=20000000 --runs=runs/long": _MANY,
    "--resume=runs/... --steps=8000000": _OTHER,
    "--env=finger-spin-vary-size --env.vary.size=1.15:1.2:4 --split=none --from=runs/... --tune=all": _OTHER,
    "--env=point-mass-vary-goal --agent=distil --agent.conditioning=recurrent --from=runs/...": _OTHER,
    "--env=finger-spin --env.vary.size=0.95,1.13 --split=none --agent=distil --from=runs/...,runs/...": _OTHER,
    "--import=lever.py --env=lever --agent=sac-conditioned --steps=400000": _OTHER,
    "--seeds=5 --sweep agent.actor-lr=1e-4,3e-4,1e-3 agent.num-critics=2,4": _MANY,
    "--population=pbt:100000 --seeds=5 --sweep agent.actor-lr=1e-4,1e-3 agent.critic-lr=1e-4,1e-3": _COPIES,
    "--quick --steps=100000 --seeds=5 --sweep agent=sac,multi-head,sac-conditioned --runs=runs/compare": _MANY,
    "--quick --search=16 --agent.actor-lr=1e-5..1e-2 --agent.gamma=0.9..0.999": _TRIALS,
    "--env=tabular-mdp --agent=ppo --steps=49152 --seed=1 --search=32 --search-rungs=4 --agent.actor-lr=1e-5..1e-1 "
    "--agent.critic-lr=1e-5..1e-1 --agent.entropy-cost=1e-4..1e-1 --agent.gae-lambda=0.8..0.99": _TRIALS,
    "--seeds=3 --steps=400000 --sweep env=point-mass-vary-goal,reacher-vary-goal agent=sac,multi-head": _MANY,
    "--seeds=8 --distributed --runs=/shared/runs": _HOSTS,
    "--env=pendulum-swingup --engine=mjx --seeds=2 --distributed": _HOSTS,
}
LEARNING = {command: mark for command, mark in MARKS.items() if isinstance(mark, Learns)}
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}  # programs as users get them


def test_every_training_command_has_a_mark():
    """And every mark is of a command that is there."""
    found = {shlex.join(words) for page in PAGES for words in training(page.read_text())}
    assert found == set(MARKS)


def run(*words):
    pipes = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, *words], cwd=ROOT, env=ENVIRONMENT, **pipes)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_readmes_example_in_python_learns(gain=15):
    """The first array that it prints is the mean return of each evaluation, the other one that of each size."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (block,) = [block for block in blocks if "mtjax.train(" in block]
    printed = re.findall(r"\[([\d.\s]+)\]", run("-c", block))[-2]
    returns = np.array(printed.split(), float)
    assert len(returns) == 10 and returns[-1] - returns[0] > gain, returns


@pytest.mark.nightly
@pytest.mark.parametrize("command", LEARNING)
def test_a_command_learns(command, tmp_path):
    """Of all that a page trains, nothing may stay where it begins."""
    gain, flags = LEARNING[command]
    run("-m", "mtjax.train", *shlex.split(command), *shlex.split(flags), f"--runs={tmp_path}")
    (folder,) = Path(tmp_path).iterdir()
    returns = load_evaluations(folder / "evaluations.npz").returns["train"].mean(axis=(0, 2, 3))
    assert returns[-1] - returns[0] > gain, returns
