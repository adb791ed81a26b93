"""``python -m mtjax.evaluate --run=DIR``: score, plot, film or show a run on every task of every split."""

import dataclasses
import math
from collections.abc import Sequence

from mtjax.checks import require_episodes, require_run
from mtjax.command import flags, help, imports, parsing, process, refusals
from mtjax.names import SPLITS, InputError, become, command, load, nearest_error
from mtjax.saved import pretrained

_PROGRAM = "python -m mtjax.evaluate"
_WAYS = {
    "--run=RUN [FLAGS]": "",
    "--run=RUN --env.vary.NAME=VALUES": "on other values of a parameter: lo:hi:n or a,b,c",
    "--run=RUN --video": "film some tasks too",
    "--run=RUN --view": "show the run on a page, as it learns",
    "--run=RUN --import=FILE.py": "first run a file that registers your own",
}
_GROUPS = (
    ("what is played", "evaluate.py", "Played"),
    ("films", "evaluate.py", "Filmed"),
    ("what else is done", "evaluate.py", "Request"),
)


@dataclasses.dataclass(frozen=True)
class Played:
    """Says which run plays, and how."""

    run: str = ""
    """The run's folder, in which a new folder takes returns and a plot. Or the name of a trained policy that comes with
    the package, as --list of mtjax.train shows: then nothing is written, except with --video into a folder in runs/."""
    point: int = 0
    """Number of the setting in sweep.csv, if the run holds several settings of a sweep; of a member in a population."""
    episodes: int = -1
    """Episodes of each task and seed; -1 plays ten, or as many more as whole trials take."""
    sampled: bool = False
    """Draw actions from the policy, as in training. Else they are its mean ones, or the likeliest choices."""
    seed: int = 0
    """Seed of the starting states."""
    task_seed: int = -1
    """Seed of other goals than the run's, or other tasks, where they are drawn; -1 takes the run's own."""
    checkpoint: int = 0
    """Iteration of the checkpoint to evaluate, as its folder in checkpoints/ is called; 0 takes the newest."""


@dataclasses.dataclass(frozen=True)
class Filmed:
    """Says what is filmed."""

    video: bool = False
    """Film episodes of some tasks of each split, in one grid that names each (mp4 if ffmpeg is installed, else gif)."""
    video_splits: tuple[str, ...] = ()
    """Splits to film: train, interpolation, extrapolation; by default all."""
    video_tasks: tuple[int, ...] = ()
    """Numbers of the tasks to film in each split, counted from 0; by default the first, the middle and the last."""
    video_seconds: float = 10.0
    """Seconds that the film lasts. Slow worlds, such as a boat's, are shown faster than they are."""


@dataclasses.dataclass(frozen=True)
class Request(Filmed, Played):
    """Evaluate a trained run: ``python -m mtjax.evaluate --run=RUN``."""

    export: str = ""
    """File to write the first seed's policy into: one that ends with .npz for mtjax/saved/standalone.py, which
    reads it with NumPy or JAX alone, or with .onnx for other runtimes."""
    view: int = 0
    """Score nothing, and show a page on this machine: the run's curves as they come, and its newest policy in worlds
    that move. The number is the page's port; --view alone takes 8008."""
    diagnostics: bool = False
    """Measure conflicts between the tasks' gradients, and unused units of the networks, from the run's replay, or from
    a rollout that an agent without one plays for that."""

    @property
    def asked(self) -> int | None:
        """Return how many episodes are asked for; None for the usual ones."""
        return None if self.episodes == -1 else self.episodes

    @property
    def drawn(self) -> int | None:
        """The seed of other tasks than the run's, if any."""
        return None if self.task_seed == -1 else self.task_seed


@command
def main(argv: Sequence[str]) -> None:
    """Read the command line first, then import the evaluation code and score the run."""
    if {"--help", "-h"} & {*argv}:
        return print(help.overview(_PROGRAM, _WAYS, _GROUPS))
    request, vary = _parse(argv)
    load("mtjax.report.view:show" if request.view else "mtjax.report.scoring:report")(request, vary)


def _parse(argv: Sequence[str]) -> tuple[Request, dict[str, str]]:
    """Return the request, and the values of --env.vary.NAME=VALUES by name."""
    if argv and not argv[0].startswith("-"):
        raise InputError(f"say which run to evaluate by --run={argv[0]}")
    vary, argv = flags.vary_flags(imports.import_files(flags.with_port(argv)))
    refusals.check_flags_of(Request, argv)
    request = parsing.parse_with_tyro(Request, argv, Request(), _PROGRAM)
    if not request.run:
        raise InputError("say which run to evaluate: --run=DIR")
    require_episodes(request.asked, request.seed, request.drawn, request.checkpoint)
    if not 0 < request.video_seconds < math.inf:
        raise InputError(f"video-seconds must be greater than 0, not {request.video_seconds:g}")
    for split in request.video_splits:
        if split not in SPLITS:
            raise nearest_error("split", split, SPLITS)
    chosen = request.video_splits or request.video_tasks
    if chosen and not request.video:
        raise InputError("--video-splits and --video-tasks say what to film; give --video as well")
    if request.view and (request.video or request.export or request.diagnostics):
        raise InputError("--view shows a run and scores nothing; leave out --video, --export and --diagnostics")
    if vary and (request.video_splits or request.diagnostics):
        raise InputError("tasks of --env.vary belong to no split, and diagnostics are of the run's own tasks")
    if request.drawn is not None and (vary or request.diagnostics):
        raise InputError("--task-seed draws other tasks; leave out --env.vary, and diagnostics of the run's own tasks")
    folder = pretrained.folder(request.run)
    require_run(folder)
    if request.diagnostics and pretrained.is_pretrained(folder):
        raise InputError(f"diagnostics need a run's replay, and {request.run!r} is a policy alone")
    return request, vary


def run() -> None:
    """Run the command line."""
    process.main(main)


if __name__ == "__main__":
    run()
else:
    become(__name__, "mtjax.report.scoring:evaluate")
