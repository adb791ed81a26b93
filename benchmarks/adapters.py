"""Compare environment steps a second of our loop with those of other packages' own scans, with as many worlds.

    python benchmarks/adapters.py [--names NAME ...] [--pictures] [--repeats N] [--json FILE]

Ours is a chunk of ``mtjax.train`` for an agent that acts at random and learns nothing: it acts in every world by a key
of its own, steps, begins ended episodes anew, sums returns, and looks for numbers that are not finite. Theirs is a scan
of the package's step, mapped over worlds, with its automatic reset and random actions; of EnvPool a loop in Python over
``step`` of one pool. Craftax's own reset draws a new world for every world at every step, so its scan resets as its
authors' baselines do: at every step it draws one for every 16, which those that have ended share. A scan that keeps
nothing learns nothing, so theirs is timed a second time where it keeps the observations of the last 32 steps, as a
learner has to. All are compiled first and then timed in turn, round after round, in one process, so that other load on
the machine affects all. Figures are medians over rounds, and ratios are medians of each round's ratio, of seconds and
of the CPU seconds of the process.
"""

import argparse
import dataclasses
import statistics
import time
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from report import publish, run_main
from training import Training

import mtjax
from mtjax.agents.parts.continual import Continual
from mtjax.agents.parts.plasticity import Plasticity
from mtjax.experience import Rollouts
from mtjax.learning.loop import Settings
from mtjax.types import Acted, Action, Metrics


class Contest(NamedTuple):
    """What is timed of an environment."""

    worlds: int
    steps: int  # of every world in a timed call, a multiple of a rollout's


UNROLL = 32  # steps of a rollout
CONTESTS = {
    "gymnax:CartPole-v1": Contest(1024, 1024),
    "gymnax:Breakout-MinAtar": Contest(1024, 512),
    "gymnax:Asterix-MinAtar": Contest(1024, 256),
    "xminigrid:MiniGrid-DoorKey-8x8": Contest(512, 256),
    "craftax:Craftax-Classic-Symbolic-v1": Contest(256, 64),
    "envpool:Pong-v5": Contest(64, 64),
}


@dataclasses.dataclass(frozen=True)
class Chance:
    """An agent that acts at random and learns nothing."""

    action: Action
    experience: Rollouts

    unroll: ClassVar[int] = 0
    continual: ClassVar[Continual] = Continual()
    plasticity: ClassVar[Plasticity] = Plasticity()
    goes_on: ClassVar[bool] = False
    taught: ClassVar[bool] = False
    in_training: ClassVar = {}

    def init(self, spec: Any, tasks: Any, key: Any) -> Any:
        return jnp.zeros(1)

    def begin(self, state: Any, task: Any) -> Any:
        return ()

    def act(self, state: Any, memory: Any, obs: Any, task: Any, key: Any) -> Acted:
        return Acted(self.action.random(key))

    def remember(self, state: Any, memory: Any, transition: Any, task: Any) -> Any:
        return memory

    def assess(self, state: Any, steps: Any, tasks: Any) -> tuple[Any, Any]:
        return state, steps

    def update(self, state: Any, window: Any, tasks: Any, key: Any, number: Any) -> tuple[Any, Metrics]:
        return state, {}

    def observe(self, state: Any, steps: Any, tasks: Any) -> Any:
        return state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", nargs="*", default=list(CONTESTS), choices=CONTESTS)
    parser.add_argument("--pictures", action="store_true", help="ours observes grids as pictures, which are bytes")
    parser.add_argument("--repeats", type=int, default=7, help="rounds")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.names:
        rows.append(compare(name, arguments.repeats, {"pictures": True} if arguments.pictures else {}))
        line = (
            "{environment}: ours {ours:,.0f}, theirs {theirs:,.0f} steps/s; ratio {ratio:.2f}, of CPU {cpu_ratio:.2f}, "
            "where theirs keeps observations {kept_ratio:.2f}"
        )
        print(line.format(**rows[-1]), flush=True)
    publish(arguments, rows)


def compare(name: str, repeats: int, given: dict[str, Any]) -> dict[str, Any]:
    """Time our loop, with settings of the family, and the package's own scans in turn."""
    contest, family = CONTESTS[name], mtjax.make(name, **given)
    settings = Settings(num_envs=contest.worlds, chunk_steps=contest.steps)
    agent: Any = Chance(family.spec.action, Rollouts(unroll=UNROLL, epochs=1, minibatches=1))
    training = Training(family, agent, settings, most_devices=1)
    make = own_pool if name.startswith("envpool:") else own_scan
    theirs, keeping = (make(name, family.spec.action, contest, kept) for kept in (False, True))
    rounds = [[timed(run) for run in (training.time, theirs, keeping)] for _ in range(repeats)]
    (seconds, cpu), (own, own_cpu), (kept, _) = (zip(*times, strict=True) for times in zip(*rounds, strict=True))
    ratios = [theirs / ours for ours, theirs in zip(seconds, own, strict=True)]
    count = contest.worlds * contest.steps
    return {
        "environment": name,
        **contest._asdict(),
        "ours": count / statistics.median(seconds),
        "theirs": count / statistics.median(own),
        "ratio": statistics.median(ratios),
        "ratios": [round(x, 3) for x in sorted(ratios)],
        "keeping": count / statistics.median(kept),
        "kept_ratio": statistics.median(theirs / ours for ours, theirs in zip(seconds, kept, strict=True)),
        "cpu_ratio": statistics.median(theirs / ours for ours, theirs in zip(cpu, own_cpu, strict=True)),
    }


def timed(run: Callable[[], Any]) -> tuple[float, float]:
    """Return the seconds, and the CPU seconds of this process, that a call takes."""
    before = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - before[0], time.process_time() - before[1]


def own_scan(name: str, action: Action, contest: Contest, keeps: bool) -> Callable[[], Any]:
    """Return the package's contestant: a call that goes on with all of its worlds.

    Args:
        keeps: hold the observations of the last rollout, in place of their sums.
    """
    suite, _, own = name.partition(":")
    reset, step = OWN[suite](own)

    def once(carry: Any, _: Any) -> tuple[Any, Any]:
        state, key = carry
        key, act_key, step_key = jax.random.split(key, 3)
        actions = action.random(act_key, (contest.worlds,))
        obs, state, reward = step(jax.random.split(step_key, contest.worlds), state, actions)
        return (state, key), (jnp.sum(reward), obs if keeps else sum(jnp.sum(x) for x in jax.tree.leaves(obs)))

    def rollout(carry: Any, _: Any) -> tuple[Any, Any]:
        worlds, (reward, obs) = jax.lax.scan(once, carry[0], length=UNROLL)
        return (worlds, obs), reward

    def play(carry: Any) -> tuple[Any, Any]:
        return jax.lax.scan(rollout, carry, length=contest.steps // UNROLL)

    states = jax.jit(reset)(jax.random.split(jax.random.key(0), contest.worlds))
    worlds = jax.tree.map(jnp.copy, (states, jax.random.key(1)))
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(rollout, (worlds, None), None)[0][1])
    carry = (worlds, nothing)
    program = jax.jit(play, donate_argnums=0).lower(carry).compile()
    held = [program(carry)[0]]

    def run() -> None:
        held[0], _ = jax.block_until_ready(program(held[0]))

    return run


def own_pool(name: str, action: Any, contest: Contest, keeps: bool) -> Callable[[], Any]:
    """Return EnvPool's contestant: a call that steps a pool with its own settings and single pictures.

    Args:
        keeps: hold the pictures of the last rollout.
    """
    import envpool  # type: ignore  # not a dependency of this package

    pool = envpool.make(name.partition(":")[2], env_type="gymnasium", num_envs=contest.worlds, stack_num=1)
    pool.reset()
    random = np.random.default_rng(0)

    def run() -> None:
        kept = deque(maxlen=UNROLL * keeps)
        for _ in range(contest.steps):
            kept.append(pool.step(random.integers(0, action.size, contest.worlds))[0])

    run()
    return run


def gymnax(name: str) -> tuple[Callable, Callable]:
    """Return reset and step of worlds of gymnax, which reset by themselves."""
    import gymnax  # type: ignore  # not a dependency of this package

    env, params = gymnax.make(name)
    step = lambda key, state, action: env.step(key, state, action, params)[:3]
    return jax.vmap(lambda key: env.reset(key, params)[1]), jax.vmap(step)


def xminigrid(name: str) -> tuple[Callable, Callable]:
    """Return reset and step of worlds of XLand-MiniGrid, whose state holds their keys."""
    import xminigrid  # type: ignore  # not a dependency of this package
    from xminigrid.wrappers import GymAutoResetWrapper  # type: ignore  # not a dependency of this package

    env, params = xminigrid.make(name)
    env = GymAutoResetWrapper(env)

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = env.step(params, state, action)
        return state.observation, state, state.reward

    return jax.vmap(lambda key: env.reset(params, key)), jax.vmap(step)


def craftax(name: str) -> tuple[Callable, Callable]:
    """Return reset and step of worlds of Craftax; a step draws a new world for every 16, which ended ones share."""
    from craftax.craftax_env import make_craftax_env_from_name  # type: ignore  # not a dependency of this package

    env = make_craftax_env_from_name(name, auto_reset=False)
    params = env.default_params
    reset = jax.vmap(lambda key: env.reset(key, params))

    def step(keys: Any, states: Any, actions: Any) -> tuple[Any, Any, Any]:
        one = lambda key, state, action: env.step(key, state, action, params)[:4]
        obs, states, reward, done = jax.vmap(one)(keys, states, actions)
        count = len(keys) // 16
        drawn, chosen = reset(keys[:count]), (jnp.cumsum(done) - 1) % count
        begun = jax.tree.map(lambda x: x[chosen], drawn)
        ended = lambda x: jnp.expand_dims(done, range(1, x.ndim))
        return *jax.tree.map(lambda new, old: jnp.where(ended(old), new, old), begun, (obs, states)), reward

    return lambda keys: reset(keys)[1], step


OWN = {"gymnax": gymnax, "xminigrid": xminigrid, "craftax": craftax}

if __name__ == "__main__":
    run_main(main)
