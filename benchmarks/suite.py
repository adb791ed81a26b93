"""Run a suite of tasks by its name, with its protocol: agents, seeds, steps, and the figures that the field reports.

    python benchmarks/suite.py mt10|mt50|ml1|ml10|ml45|dynamics|goals|domains|hard|pixels|looks|analytic|atari5|atari26
                               [--agents NAME ...] [--seeds N] [--steps-per-task N] [--training NAME=VALUE ...]
                               [--env NAME=VALUE ...] [--best] [--adapt K] [--unfinished] [--devices 0 1 ...]
                               [--within N] [--out DIR]

``--list`` prints the protocols. Every pair of environment and agent writes ``DIR/ENV/AGENT.csv`` (training over steps
and seconds) and ``AGENT.npz`` (every episode of every evaluation: returns and, where tasks have it, success), and the
policy of its first seed, ``DIR/policies/ENV/AGENT``, which ``mtjax.load`` takes. Finished pairs are not run again, so
that a long suite runs in parts. A pair that was stopped or killed goes on as in ``learning.py``; its checkpoints need
up to 45 GB in ``mt10``, ``hard``, ``pixels`` and ``looks``. All results in DIR together give ``scores.md`` (means over
tasks with 95% intervals over seeds, for every split), ``tasks.csv`` (every training task and seed of the last
evaluation) and, for suites that compare one agent for all tasks with one for each, ``sharing.md``, which compares them
after as many steps a task. ``scores.md`` names unfinished pairs. ``--unfinished`` adds their last evaluation, marked
with its steps, to it and to ``tasks.csv``, and their evaluations to ``sharing.md``.

Where a suite compares agents, those with a replay all have the worlds, updates a step, batch, replay and warm-up of the
preset of the agent that its protocol names; ``--best`` gives each its own preset in all. PPO always has its own.
Where a suite compares one agent for all tasks with one for each, a task has as many worlds by itself as among all. With
``--devices`` every pair is a process of its own, on one of these GPUs; ``--within`` ends the call after some seconds.

Atari's games are EnvPool's (``pip install envpool``): actions stick, whole games are played, and returns are the games'
own scores, whatever an agent makes of rewards when it learns. ``human.md`` has them in units in which a random policy
has 0 and a person 1 (``atari.py``), and their median, interquartile mean and mean over games.

Success is that of the last evaluation: at the episode's last step, and at any step. Both are shares of episodes.

``ml1``, ``ml10`` and ``ml45`` are Meta-World's protocols of meta-learning. The goal is hidden. A trial is K episodes of
adaptation (``--adapt``, 10 as in the original) and one that counts, with one task, one goal and one memory. Test tasks
are the split extrapolation: five others, or in ml1 other goals of the same task. The one evaluation, at the end, plays
a trial for each of a task's 50 goals. All tables are then of the last episode alone. ``episodes.md`` has return and
success of the first, the last and all episodes of trials, of training and of test tasks, and ``AGENT.npz`` has every
episode, those of a trial one after another.
They differ from ``metaworld.evaluation`` in this: there an episode that counts ends at its first success, so that its
success is that at any step; three such episodes are played, for 40 of a test task's goals; and RL2 as published freezes
its memory in them, while here it reads on.
``care`` knows its task as other agents do, in Meta-World by its number. As published it reads a sentence that says what
the task asks for: ``care-text``, by default with hashed words, and with ``--training text=MODEL`` by a model of
sentence-transformers.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import atari
import learning
import numpy as np
from parts import add_flags, dated, is_part, require_all
from report import markdown, run_main, write_lines

import mtjax
from mtjax.learning.evaluation import Evaluations
from mtjax.names import InputError
from mtjax.report.stats import iqm, seed_interval, unpaired_difference
from mtjax.types import SPLITS, Env

_HARD = ("dog-stand", "dog-walk", "dog-trot", "dog-run", "humanoid-stand", "humanoid-walk", "humanoid-run")
_DOMAINS = (
    *("acrobot-swingup", "ball-in-cup-catch", "cartpole-swingup", "cheetah-run", "finger-spin"),
    *("hopper-hop", "pendulum-swingup", "point-mass-easy", "reacher-easy", "walker-walk"),
)
_DYNAMICS = (
    *("cartpole-swingup-vary-pole-mass", "cheetah-run-vary-torso-length", "finger-spin-vary-size"),
    *("walker-run-vary-friction", "walker-walk-vary-foot-length"),
)
_GOALS = (
    *("cheetah-run-vary-speed", "cheetah-vary-direction", "finger-turn-vary-target"),
    *("point-mass-vary-goal", "reacher-vary-goal", "walker-vary-speed"),
)
_OF_META_WORLD = (
    *("sac-conditioned", "multi-head", "care-text", "pcgrad", "soft-modularization", "moore", "ppo", "brc", "care"),
)
_OF_TRIALS = ("rl2", "varibad", "blind")
_GAMES = tuple(map(atari.name, atari.FIVE))
_SEEN = ("pixels=64", "frames=3", "repeat=2")


@dataclasses.dataclass(frozen=True)
class Suite:
    """Environments, and how agents learn them."""

    says: str  # where the protocol is from
    envs: tuple[str, ...]
    agents: tuple[str, ...]
    steps_per_task: int
    seeds: int = 10
    equal_to: str = ""  # the agent whose worlds, updates, batch and replay all others with a replay have
    split: str | None = None
    together: str = ""  # the environment of all tasks, where others are its tasks alone
    settings: tuple[str, ...] = ()  # of the environments
    vary: tuple[str, ...] = ()  # what tasks differ in, besides what the families vary
    adapt: int = 0  # episodes of a trial before the one that counts
    episodes: int = 50  # of each task in an evaluation, or trials; Meta-World's tasks have 50 goals


SUITES = {
    "mt10": Suite(
        "Meta-World's ten tasks, 50 goals each, second rewards, 500 steps an episode (Yu et al. 2019; Sodhani et al. "
        "2021): success of one agent for all after 1.02M steps a task",
        ("mt10",),
        _OF_META_WORLD,
        1_024_000,
        3,
        equal_to="brc",
    ),
    "mt50": Suite("Meta-World's fifty tasks, as mt10", ("mt50",), _OF_META_WORLD, 1_024_000, 3, equal_to="brc"),
    "ml1": Suite(
        "one of Meta-World's tasks with 50 hidden goals, and 50 others to test (Yu et al. 2019): success after ten "
        "episodes of adaptation",
        ("metaworld-reach", "metaworld-push", "metaworld-pick-place"),
        _OF_TRIALS,
        20_000_000,
        settings=("goal_hidden=true", "test_goals=true"),
        adapt=10,
    ),
    "ml10": Suite(
        "ten of Meta-World's tasks with 50 hidden goals each, and five others to test, as ml1: 2M steps a task",
        ("ml10",),
        _OF_TRIALS,
        2_000_000,
        adapt=10,
    ),
    "ml45": Suite(
        "forty-five of Meta-World's tasks and five others to test, as ml10",
        ("ml45",),
        _OF_TRIALS,
        2_000_000,
        adapt=10,
    ),
    "dynamics": Suite(
        "families whose bodies differ, on HiP-BMDP's split (Zhang et al. 2021): four tasks train, six are unseen",
        _DYNAMICS,
        ("sac", "sac-conditioned", "multi-head", "care", "pcgrad", "deepmdp", "hip-bmdp", "brc"),
        500_000,
        equal_to="sac-conditioned",
        split="hip-bmdp",
    ),
    "goals": Suite(
        "families whose goals differ: agents that see the goal, that do not, and with heads or surgery",
        _GOALS,
        ("sac", "sac-conditioned", "multi-head", "care", "pcgrad", "brc"),
        200_000,
        equal_to="sac-conditioned",
    ),
    "domains": Suite(
        "ten of dm_control's domains in one mixture, padded to one size",
        ("+".join(_DOMAINS),),
        ("sac-conditioned", "multi-head", "care", "pcgrad", "brc"),
        500_000,
        5,
        equal_to="sac-conditioned",
    ),
    "hard": Suite(
        "seven tasks of dog and humanoid: one agent for all against one for each, 1M steps a task (as BRC, Nauman et "
        "al. 2025)",
        ("+".join(_HARD), *_HARD),
        ("brc",),
        1_000_000,
        5,
        together="+".join(_HARD),
    ),
    "pixels": Suite(
        "two families from pictures of 64 x 64, three frames, actions for two steps, on HiP-BMDP's split (Zhang et al. "
        "2021 learned the same families from pictures)",
        ("finger-spin-vary-size", "cheetah-run-vary-torso-length"),
        ("drq", "sac-ae", "deepmdp", "hip-bmdp", "care"),
        500_000,
        3,
        split="hip-bmdp",
        settings=_SEEN,
    ),
    "looks": Suite(
        "as pixels, but tasks differ in the camera's angle alone (Stone et al. 2021, the Distracting Control Suite)",
        ("finger-spin", "cheetah-run"),
        ("drq", "sac-ae", "deepmdp", "care"),
        500_000,
        3,
        split="hip-bmdp",
        settings=_SEEN,
        vary=("camera-angle=-20:20:10",),
    ),
    "analytic": Suite(
        "worlds of a few equations whose best is known, after the steps of the preset, with all that is held out: on "
        "two CPU cores each within 5 minutes (--preset cpu --seeds 1); success is a mark that is reached, or a lap",
        ("link", "sailing", "racing", "trading"),
        ("ppo",),
        0,  # those of the preset
        3,
        episodes=20,
    ),
    "atari5": Suite(
        "Atari's five games that tell most of all others (Aitchison et al. 2023): one agent for all against one for "
        "each, 12.5M steps of four frames a game, sticky actions, all actions, whole games (Machado et al. 2018)",
        ("+".join(_GAMES), *_GAMES),
        ("ppo", "impala"),
        12_500_000,
        3,
        together="+".join(_GAMES),
        settings=atari.SETTINGS,
        episodes=10,
    ),
    "atari26": Suite(
        "26 games (Kaiser et al. 2020), one agent for each, as atari5",
        tuple(map(atari.name, atari.TWENTY_SIX)),
        ("ppo", "impala"),
        12_500_000,
        3,
        settings=atari.SETTINGS,
        episodes=10,
    ),
}


_SCORES = {"return": "return", "success": "success at the end", "success_ever": "success at any step"}
_EPISODES = ("first episode", "last episode, which counts", "all")


class Last(NamedTuple):
    """Holds the last evaluation of a run: of its training tasks, and returns of all.

    Of suites with episodes of adaptation it is that of the episodes that count.
    """

    labels: list[str]  # (T,)
    returns: np.ndarray  # (S, T)
    success: np.ndarray | None  # (S, T) at the last step of episodes
    ever: np.ndarray | None  # (S, T) at any step
    splits: dict[str, np.ndarray]  # (S, T) returns by split, without empty ones
    held_out: dict[str, np.ndarray]  # (S, T) success at the last step on the splits that do not train
    steps: float  # of each task
    seconds: str  # of training, and by the clock; "-" without metrics
    wall: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=list(SUITES), nargs="?")
    parser.add_argument("--list", action="store_true", help="print every suite's protocol")
    parser.add_argument("--agents", nargs="*", metavar="NAME", help="by default the suite's")
    parser.add_argument("--envs", nargs="*", metavar="NAME", help="some of the suite's environments")
    parser.add_argument("--seeds", type=int, help="by default the suite's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps-per-task", type=int, help="by default the suite's")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--best", action="store_true", help="every agent with its own preset")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the loop or all agents")
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE", help="settings of families: pixels=64")
    parser.add_argument("--evaluations", type=int, help="by default four, and one of suites that adapt")
    parser.add_argument("--eval-episodes", type=int, help="of each task, or trials; by default the suite's")
    parser.add_argument(
        "--adapt", type=int, metavar="K", help="episodes before the one that counts, in ml1 and the like"
    )
    parser.add_argument("--unfinished", action="store_true", help=learning.UNFINISHED)
    parser.add_argument("--out", type=Path)
    add_flags(parser)
    arguments = parser.parse_args()
    if arguments.list or not arguments.suite:
        print("\n".join(map(describe, SUITES)))
        return
    suite = SUITES[arguments.suite]
    suite = dataclasses.replace(suite, settings=(*suite.settings, *arguments.env))
    if arguments.adapt is not None:
        if not suite.adapt or arguments.adapt < 1:
            raise InputError("--adapt is a number of episodes from 1 on, of suites that adapt: ml1, ml10, ml45")
        suite = dataclasses.replace(suite, adapt=arguments.adapt)
    arguments.out = arguments.out or dated(arguments.suite)
    arguments.equal_to = "" if arguments.best else suite.equal_to
    agents = suite.agents if arguments.agents is None else arguments.agents
    named = [(env, agent) for env in arguments.envs or suite.envs for agent in agents]
    left = learning.learn_all(arguments, __file__, named, lambda env, _: request(arguments, suite, env, arguments.out))
    if not is_part():
        print(tabulate(arguments.out, suite, arguments.unfinished))
    require_all(left)


def describe(name: str) -> str:
    """Return a suite's protocol in a line."""
    suite = SUITES[name]
    return f"{name:10} {suite.says}; {suite.seeds} seeds; agents {', '.join(suite.agents)}"


def request(arguments: argparse.Namespace, suite: Suite, env: str, out: Path) -> argparse.Namespace:
    """Return what ``learning.learn`` reads: the suite's protocol, and what was given beside it."""
    steps = (arguments.steps_per_task or suite.steps_per_task) * family_of(suite, env).train_count
    given = {"seeds": arguments.seeds or suite.seeds, "steps": steps, "split": suite.split, "out": out}
    given |= {"env": [*suite.settings], "vary": [*suite.vary], "as_in": suite.together}
    given["evaluations"] = arguments.evaluations or (1 if suite.adapt else 4)
    given["eval_episodes"] = (arguments.eval_episodes or suite.episodes) * (suite.adapt + 1)
    given["training"] = [*arguments.training, *([f"trials={suite.adapt + 1}"] if suite.adapt else [])]
    return argparse.Namespace(**{**vars(arguments), **given})


def family_of(suite: Suite, env: str) -> Env:
    """Return a suite's environment, with its split and what its tasks differ in."""
    return mtjax.make(env, **learning.family_settings(suite.settings, suite.vary, suite.split))


def last_of(suite: Suite, pair: learning.Pair) -> Last:
    """Return the last evaluation, averaged over episodes."""
    labels, evaluations = family_of(suite, pair.env).labels("train"), that_count(suite, pair.evaluations)
    metrics, clocks = evaluations.metrics, ("-", "-")
    if pair.metrics.exists() and len(curve := learning.curve_of(pair)):
        clocks = (f"{x:.0f}" for x in curve[-1, :, 2:4].mean(axis=0))
    of = lambda name: np.asarray(metrics[name]["train"])[:, -1].mean(axis=-1) if name in metrics else None
    splits, success = learning.last_scores(evaluations), metrics.get("success", {})
    held_out = {split: np.asarray(success[split])[:, -1].mean(axis=-1) for split in splits if split in success}
    made = steps_a_task(evaluations)[-1]
    return Last(labels, splits["train"], of("success"), of("success_ever"), splits, held_out, made, *clocks)


def that_count(suite: Suite, evaluations: Evaluations) -> Evaluations:
    """Return evaluations of the last episodes of trials alone, if a suite has episodes of adaptation."""
    if not suite.adapt:
        return evaluations
    last = lambda scores: {split: x[..., evaluations.trial - 1 :: evaluations.trial] for split, x in scores.items()}
    metrics = {name: last(scores) for name, scores in evaluations.metrics.items()}
    return evaluations._replace(returns=last(evaluations.returns), metrics=metrics, trial=1)


def found(out: Path, suite: Suite, unfinished: bool = False) -> Iterator[tuple[str, str, Last]]:
    """Return environment, agent and last evaluation of every finished pair; if asked, of others too."""
    for pair in learning.pairs(out, unfinished):
        yield pair.env, pair.agent, last_of(suite, pair)


def tabulate(out: Path, suite: Suite, unfinished: bool = False) -> str:
    """Write the tables of all finished pairs, if asked of others too, and return that of scores."""
    lines, rows = [], []
    for env, agent, last in found(out, suite, unfinished):
        cells = [score(last.splits.get(split), ".0f") for split in SPLITS]
        cells += [score(x, ".3f") for x in (last.success, last.ever, *map(last.held_out.get, SPLITS[1:]))]
        lines.append([short(env), agent, str(len(last.returns)), *cells, f"{last.steps:,.0f}", last.seconds, last.wall])
        rows += [
            {"env": env, "agent": agent, "task": label, "seed": s, "return": f"{last.returns[s, t]:.1f}"}
            | {name: x[s, t] for name, x in (("success", last.success), ("success_ever", last.ever)) if x is not None}
            for s in range(len(last.returns))
            for t, label in enumerate(last.labels)
        ]
    head = ["environment", "agent", "seeds", "return", *SPLITS[1:], "success at the end", "success at any step"]
    head += [f"success, {split}" for split in SPLITS[1:]]
    head += ["steps a task", "training s", "wall s"]
    table = markdown(head, lines) + learning.list_stopped(out)
    (out / "scores.md").write_text(table + "\n")
    write_lines(out / "tasks.csv", rows)
    if suite.adapt:
        (out / "episodes.md").write_text(episodes(out, unfinished) + "\n")
    if human := human_scores(out, unfinished):
        (out / "human.md").write_text(human + "\n")
    if suite.together:
        (out / "sharing.md").write_text(sharing(out, suite, unfinished) + "\n")
    return table


def episodes(out: Path, unfinished: bool = False) -> str:
    """Return a table of the first, the last and all episodes of trials in the last evaluation, of every split."""
    lines = []
    for pair in learning.pairs(out, unfinished):
        scores = {"return": pair.evaluations.returns, **pair.evaluations.metrics}
        for split, name in itertools.product(SPLITS, _SCORES):
            if name in scores and (x := scores[name][split]).size:
                found = learning.by_episode(x, pair.evaluations.trial)
                ends = found[..., 0], found[..., -1], found.mean(axis=-1)
                about = [short(pair.env), pair.agent, str(len(x)), split, str(x.shape[2]), _SCORES[name]]
                lines.append([*about, *(score(each, ".3g") for each in ends)])
    return markdown(["environment", "agent", "seeds", "split", "tasks", "", *_EPISODES], lines)


def sharing(out: Path, suite: Suite, unfinished: bool = False) -> str:
    """Return a table of every task: one agent for all tasks against one for this task, after as many steps a task."""
    pairs = {(pair.env, pair.agent.split(",")[0]): pair.evaluations for pair in learning.pairs(out, unfinished)}
    tasks, labels = suite.together.split("+"), family_of(suite, suite.together).labels("train")
    lines = []
    for agent in dict.fromkeys(agent for _, agent in pairs):
        if (shared := pairs.get((suite.together, agent))) is None:
            continue
        own = [task for task in tasks if (task, agent) in pairs]
        lines += [[task, agent, *compare(shared, labels.index(task), pairs[task, agent])] for task in own]
    head = ["task", "agent", "steps a task", "one agent for all", "one for this task", "difference"]
    return markdown(head, lines)


def human_scores(out: Path, unfinished: bool = False) -> str:
    """Return tables of human-normalised scores: of all games and seeds, and of agents over their games; or nothing."""
    found = [(x.env, x.agent, learning.last_scores(x.evaluations)["train"]) for x in learning.pairs(out, unfinished)]
    found = [(*pair, atari.normalised(pair[0], pair[2])) for pair in found if atari.is_game(pair[0])]
    lines, scores = [], {}
    for env, agent, returns, human in found:
        names = env.split("+")
        for t, name in enumerate(names):
            cells = score(returns[:, [t]], ".1f"), score(human[:, [t]], ".3f")
            lines.append([name, agent, "with others" if len(names) > 1 else "alone", str(len(returns)), *cells])
        scores.setdefault((agent, env if len(names) > 1 else ""), []).append(human)
    if not lines:
        return ""
    games = markdown(["game", "agent", "learned", "seeds", "score", "human-normalised"], lines)
    head = ["agent", "learned", "games", "median", "interquartile mean", "mean"]
    return f"{games}\n\n{markdown(head, [over_games(agent, env, of) for (agent, env), of in scores.items()])}"


def over_games(agent: str, together: str, scores: list[np.ndarray]) -> list[str]:
    """Return a line of an agent's human-normalised scores (S, G) over games, of as many seeds as all have."""
    seeds = min(len(of_game) for of_game in scores)
    each = np.concatenate([of_game[:seeds] for of_game in scores], axis=1)
    found = seed_interval(np.median(each, axis=1)), seed_interval(each, iqm), seed_interval(each)
    how = "with others" if together else "alone"
    return [agent, how, str(each.shape[1]), *(f"{x:.3f}" for x in found)]


def compare(shared: Evaluations, row: int, alone: Evaluations) -> list[str]:
    """Return the steps a task that both have made, and the returns after these of a shared agent and of a task's own.

    Chunks round steps, so that an evaluation of one may come a little sooner than that of the other.
    """
    made = min(steps_a_task(shared)[-1], steps_a_task(alone)[-1])
    if made < max(steps_a_task(shared)[0], steps_a_task(alone)[0]):
        return [f"{made:,.0f}", "-", "-", "-"]
    ours, theirs = returns_after(shared, made)[:, [row]], returns_after(alone, made)
    gain = f"{unpaired_difference(ours, theirs):+.0f}"
    return [f"{made:,.0f}", *(score(x, ".0f") for x in (ours, theirs)), gain]


def steps_a_task(evaluations: Evaluations) -> np.ndarray:
    """Return the steps of each training task before each evaluation (V,)."""
    return evaluations.steps / evaluations.returns["train"].shape[2]


def returns_after(evaluations: Evaluations, steps: float) -> np.ndarray:
    """Return the training tasks' mean returns (S, T) of the last evaluation within so many steps a task."""
    last = np.flatnonzero(steps_a_task(evaluations) <= steps)[-1]
    return evaluations.returns["train"][:, last].mean(axis=-1)


def score(values: np.ndarray | None, form: str) -> str:
    """Return the mean of values (S, T) with its interval over seeds."""
    if values is None or not np.all(np.isfinite(values)):
        return "-"
    return format(seed_interval(values), form)


def short(env: str) -> str:
    """Return the name of an environment, or how many families its mixture has."""
    return env if "+" not in env else f"{env.count('+') + 1} families"


if __name__ == "__main__":
    run_main(main)
