"""``python -m mtjax.evaluate --run=DIR``: score a trained run on every task of every split, plot it, film it."""

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mtjax import cli
from mtjax.config import from_json
from mtjax.envs import Domain
from mtjax.envs.family import Part
from mtjax.evaluation import Recording, evaluate, record
from mtjax.names import nearest_error
from mtjax.report import diagnostics, figures, render
from mtjax.report.tables import task_table
from mtjax.training.log import append_rows, number
from mtjax.training.policy import Policy, load, load_experience
from mtjax.training.programs import enable_compile_cache
from mtjax.types import SPLITS, InputError

_FIRST_NUMBER = 1_000_000  # far from the numbers of a run's own evaluations, so that the episodes are new
_FILM_FPS, _FILM_SECONDS = 25, 10


@dataclasses.dataclass(frozen=True)
class Request:
    """Evaluate a trained run: ``python -m mtjax.evaluate --run=DIR``."""

    run: str = ""
    """The run's folder."""
    point: int = 0
    """Which setting of a run that holds several of a sweep: its number in sweep.csv."""
    episodes: int = 10
    """Episodes of each task and seed."""
    seed: int = 0
    """Chooses the starting states."""
    video: bool = False
    """Film the first ten seconds of an episode of each task (mp4 if ffmpeg is installed, else gif)."""
    diagnostics: bool = False
    """Measure how the training tasks' gradients agree and how much of the networks is in use, from the run's replay."""


def main(argv: Sequence[str]) -> None:
    """Score the run, print the table, and leave table, plot and films in a new folder inside the run's."""
    request = _parse(argv)
    enable_compile_cache()
    seed = _first_seed(request)
    policy = load(request.run, seed)
    if request.video and not any(isinstance(part.family, Domain) for part in policy.env.parts):
        raise InputError("only MuJoCo families can be filmed; leave out --video")
    found = diagnostics.diagnose(policy, *load_experience(request.run, seed)) if request.diagnostics else None
    episodes = score(policy, request.episodes, request.seed)
    directory = _new_folder(Path(request.run))
    print(task_table(policy, episodes))
    if policy.agent.unseen:
        print(f"unseen tasks: {policy.agent.unseen}")
    _write(policy, episodes, directory)
    if found is not None:
        print(diagnostics.table(policy, found))
        diagnostics.write(policy, found, directory)
    if request.video:
        _film(policy, directory, request.seed)
    print(f"written to {directory}")


def _parse(argv: Sequence[str]) -> Request:
    argv = cli.import_files(argv)
    known = [f"--{f.name}" for f in dataclasses.fields(Request)] + ["--no-video", "--no-diagnostics", "--help", "-h"]
    for word in argv:
        if word.startswith("-") and word.split("=")[0] not in known:
            raise nearest_error("flag", word.split("=")[0], known)
    request = cli.parse_with_tyro(Request, argv, Request(), "python -m mtjax.evaluate")
    if not request.run:
        raise InputError("say which run to evaluate: --run=DIR")
    if request.episodes < 1 or request.seed < 0:
        raise InputError("episodes must be at least 1 and seed at least 0")
    return request


def _first_seed(request: Request) -> int:
    """The first number of a setting's seeds."""
    config = from_json(Path(request.run) / "config.json")
    if not 0 <= request.point < max(len(config.points), 1):
        raise InputError(f"point must be from 0 to {max(len(config.points), 1) - 1}, not {request.point}")
    return request.point * config.plan.seeds


def score(policy: Policy, episodes: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the returns (S, T, episodes) of each split, in episodes that no training run has seen."""
    env, config = policy.env, jnp.int32(_FIRST_NUMBER + seed)
    scores = evaluate(env, policy.agent, episodes, policy.states, env.tasks("all"), policy.seeds, config)
    returns = np.asarray(scores.returns)
    return {split: returns[:, np.asarray(env.tasks(split).id)] for split in SPLITS}


def _new_folder(run: Path) -> Path:
    for attempt in range(1, 10_000):
        with contextlib.suppress(FileExistsError):
            (run / f"evaluation-{attempt}").mkdir()
            return run / f"evaluation-{attempt}"
    raise InputError(f"{str(run)!r} is full of evaluations; move some away")


def _write(policy: Policy, episodes: dict[str, np.ndarray], directory: Path) -> None:
    env, (name, unit), many = policy.env, policy.env.task_axis, len(policy.env.parts) > 1
    labels = {split: env.labels(split) if many else map(number, env.task_values(split)) for split in episodes}
    labels = {split: list(found) for split, found in labels.items()}
    rows = [
        {"split": split, name: label, "seed": int(seed), "episode": e, "return": number(x)}
        for split, returns in episodes.items()
        for seed, of_seed in zip(policy.seeds, returns, strict=True)
        for label, of_task in zip(labels[split], of_seed, strict=True)
        for e, x in enumerate(of_task)
    ]
    append_rows(directory / "returns.csv", rows)
    file = directory / f"return_by_{name.replace('-', '_')}.png"
    if many:
        return figures.return_by_task(file, labels, episodes)
    figures.return_by_parameter(file, name, unit, {split: env.task_values(split) for split in episodes}, episodes)


def _film(policy: Policy, directory: Path, seed: int) -> None:
    """Film the beginning of one episode of every task of MuJoCo's families, at the speed at which it happens."""
    env = policy.env
    render.choose_backend()
    played = record(env, policy.agent, policy.state, env.tasks("all"), jnp.int32(seed))
    for part, states in zip(env.parts, env.apart(played.states), strict=True):
        if isinstance(part.family, Domain):
            _film_family(policy, part, played._replace(states=states), directory)
        else:
            print(f"{part.name} has no model to film")


def _film_family(policy: Policy, part: Part, played: Recording, directory: Path) -> None:
    """Film the tasks of one family, of which ``played`` has the states."""
    family: Any = part.family
    stride = max(round(1 / (_FILM_FPS * family.seconds_per_step)), 1)
    fps, longest = 1 / (stride * family.seconds_per_step), round(_FILM_SECONDS / family.seconds_per_step)
    for split in SPLITS:
        for i in family.table.rows[split]:
            place = part.places["all"][i]
            row = int(played.rows[place])  # where ranges are continuous, an episode's own
            shown = slice(0, min(longest, int(played.lengths[place])), stride)
            frames = render.film(family, policy.env.own_row(row), np.asarray(played.states.qpos[i, shown]))
            named = f"{split}-{policy.env.describe(row)}".replace("=", "-").replace(" ", "-")
            path = render.write_video(directory / named, frames, fps)
            print(f"filmed {path.name}: return {float(played.returns[place]):.0f}", flush=True)


def run() -> None:
    """Entry point of the command line."""
    cli.main(main)


if __name__ == "__main__":
    run()
