"""What ``python -m mtjax.evaluate`` does: score a trained run on every task of every split, plot it, film it."""

import contextlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from mtjax.config import from_json
from mtjax.envs import Domain
from mtjax.evaluation import evaluate, record
from mtjax.report import diagnostics, figures, render
from mtjax.report.tables import task_table
from mtjax.training.log import append_rows, number
from mtjax.training.policy import Policy, load, load_experience
from mtjax.training.programs import enable_compile_cache
from mtjax.types import SPLITS, InputError

_FIRST_NUMBER = 1_000_000  # far from the numbers of a run's own evaluations, so that the episodes are new
_FILM_FPS, _FILM_SECONDS = 25, 10


def report(run: str, point: int, episodes: int, seed: int, video: bool, diagnose: bool) -> None:
    """Score the run, print the table, and leave table, plot and films in a new folder inside the run's.

    Args:
        point: which setting of a run that holds several of a sweep.
        episodes: episodes of each task and seed.
        seed: chooses the starting states.
        video: film an episode of each task.
        diagnose: measure how the training tasks' gradients agree, from the run's replay.
    """
    enable_compile_cache()
    first = _first_seed(run, point)
    policy = load(run, first)
    if video and not isinstance(policy.env, Domain):
        raise InputError("only MuJoCo families can be filmed; leave out --video")
    found = diagnostics.diagnose(policy, *load_experience(run, first)) if diagnose else None
    scores = score(policy, episodes, seed)
    directory = _new_folder(Path(run))
    print(task_table(policy, scores))
    if policy.agent.unseen:
        print(f"unseen tasks: {policy.agent.unseen}")
    _write(policy, scores, directory)
    if found is not None:
        print(diagnostics.table(policy, found))
        diagnostics.write(policy, found, directory)
    if video:
        _film(policy, directory, seed)
    print(f"written to {directory}")


def _first_seed(run: str, point: int) -> int:
    """The first number of a setting's seeds."""
    config = from_json(Path(run) / "config.json")
    if not 0 <= point < max(len(config.points), 1):
        raise InputError(f"point must be from 0 to {max(len(config.points), 1) - 1}, not {point}")
    return point * config.plan.seeds


def score(policy: Policy, episodes: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the returns (S, T, episodes) of each split, in episodes that no training run has seen."""
    env, config = policy.env, jnp.int32(_FIRST_NUMBER + seed)
    returns = np.asarray(evaluate(env, policy.agent, episodes, policy.states, env.tasks("all"), policy.seeds, config))
    return {split: returns[:, env.table.rows[split]] for split in SPLITS}


def _new_folder(run: Path) -> Path:
    for attempt in range(1, 10_000):
        with contextlib.suppress(FileExistsError):
            (run / f"evaluation-{attempt}").mkdir()
            return run / f"evaluation-{attempt}"
    raise InputError(f"{str(run)!r} is full of evaluations; move some away")


def _write(policy: Policy, episodes: dict[str, np.ndarray], directory: Path) -> None:
    name, unit = policy.env.task_axis
    rows = [
        {"split": split, name: number(value), "seed": int(seed), "episode": e, "return": number(x)}
        for split, returns in episodes.items()
        for seed, of_seed in zip(policy.seeds, returns, strict=True)
        for value, of_task in zip(policy.env.task_values(split), of_seed, strict=True)
        for e, x in enumerate(of_task)
    ]
    append_rows(directory / "returns.csv", rows)
    values = {split: policy.env.task_values(split) for split in episodes}
    figures.return_by_parameter(directory / f"return_by_{name.replace('-', '_')}.png", name, unit, values, episodes)


def _film(policy: Policy, directory: Path, seed: int) -> None:
    """Film the beginning of one episode of every task, at the speed at which it happens."""
    env = policy.env
    assert isinstance(env, Domain)
    render.choose_backend()
    played = record(env, policy.agent, policy.state, env.tasks("all"), jnp.int32(seed))
    stride = max(round(1 / (_FILM_FPS * env.seconds_per_step)), 1)
    fps, longest = 1 / (stride * env.seconds_per_step), round(_FILM_SECONDS / env.seconds_per_step)
    for split in SPLITS:
        for i in env.table.rows[split]:
            row = int(played.rows[i])  # where ranges are continuous, an episode's own
            shown = slice(0, min(longest, int(played.lengths[i])), stride)
            frames = render.film(env, row, np.asarray(played.states.qpos[i, shown]))
            path = render.write_video(directory / f"{split}-{env.describe(row)}".replace("=", "-"), frames, fps)
            print(f"filmed {path.name}: return {float(played.returns[i]):.0f}", flush=True)
