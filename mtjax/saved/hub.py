"""Trained policies on the Hugging Face Hub: a run's policy with a page that describes it, and back again.

What is downloaded is data alone: arrays without pickled objects, and a JSON file of settings, from which only classes
are made that this process knows. Files of the author's own code that it names are never run.
"""

import contextlib
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mtjax.checks import amount, path, require_library, shown
from mtjax.envs import SUITES
from mtjax.names import SPLITS, InputError, public
from mtjax.saved import policy_files, pretrained
from mtjax.saved.config_json import from_json, read_record
from mtjax.saved.folder import evaluations_of
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result

_NAME = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")
_CARD = "README.md"
_FILES = ("config.json", pretrained.FILE)


@public
def push(run: Result | Policy | str | Path, name: str, *, private: bool = False) -> str:
    """Upload a trained policy to the Hugging Face Hub, and return its address.

    The repository is made if there is none, and gets three files: the arrays that acting reads, the run's settings, and
    a page with the command that trained it, its scores and the versions of all libraries. Critics, replay and paths of
    this machine stay here. Log in first, by ``hf auth login`` or the variable HF_TOKEN.

    Args:
        run: a run's folder, whose first seed is taken; a policy of ``mtjax.load``, which is one seed and in a sweep one
            point; or a result of ``mtjax.train`` with a directory.
        name: "owner/name" of the repository.
        private: make a new repository that others cannot see.

    Raises:
        InputError: huggingface_hub is not installed, the run has no folder, or the Hub refuses.
    """
    _require_name(name)
    folder, number = _place(run)
    api = require_library("huggingface_hub", "mtjax.push").HfApi()
    with tempfile.TemporaryDirectory() as made, _explaining("push", name):
        files = Path(made) / "policy"
        policy_files.write(folder, files, number)
        (files / _CARD).write_text(_card(name, folder, number, files), encoding="utf-8")
        api.create_repo(name, private=private, exist_ok=True)
        api.upload_folder(repo_id=name, folder_path=files, commit_message="A policy trained by mtjax")
    return f"https://huggingface.co/{name}"


@public
def pull(name: str, *, revision: str = "") -> Policy:
    """Download a policy that ``push`` uploaded, and return it. It is kept in the Hub's cache on this machine.

    A policy whose environment or agent is the author's own needs their file imported first; the message names it.

    Args:
        name: "owner/name" of the repository.
        revision: a branch, a tag or a commit; by default the newest.

    Raises:
        InputError: huggingface_hub is not installed, there is no such repository, or it holds no policy.
    """
    _require_name(name)
    api = require_library("huggingface_hub", "mtjax.pull").HfApi()
    with _explaining("pull", name):
        place = api.snapshot_download(name, revision=revision or None, allow_patterns=list(_FILES))
    folder = Path(place)
    missing = [file for file in _FILES if not (folder / file).is_file()]
    if missing:
        raise InputError(f"{name!r} holds no policy of mtjax: it has no {missing[0]}")
    _require_plain(name, read_record(folder / "config.json"))
    return load(folder)


def _require_name(name: Any) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"a repository is named owner/name, not {shown(name)}")


def _require_plain(name: str, record: Mapping[str, Any]) -> None:
    """Refuse an environment of another package whose name imports a module, as those of Gymnasium may.

    Raises:
        InputError: it is one.
    """
    given, family = str(record.get("env")), record.get("family")
    inner = str(family.get("environment", "")) if isinstance(family, dict) else ""
    named = [part.partition(":")[2] for part in given.split("+") if part.partition(":")[0] in SUITES]
    if any(":" in each for each in (*named, inner)):
        raise InputError(f"{name!r} is a policy for {given}, which would import a module that its author names")


@contextlib.contextmanager
def _explaining(what: str, name: str) -> Iterator[None]:
    """Tell the Hub's errors in a line.

    Raises:
        InputError: there was one.
    """
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        line = (str(error).strip().splitlines() or [""])[0][:200]
        raise InputError(f"cannot {what} {name!r}: {type(error).__name__}: {line}") from None


def _place(run: Any) -> tuple[Path, int]:
    """Return the folder of a run, and the number of the entry of S whose policy is meant."""
    if not isinstance(run, Result | Policy):
        return pretrained.folder(path(run, "run")), 0
    if run.directory is None:
        raise InputError("what is pushed needs the folder of a run: mtjax.train(..., directory='runs/mine')")
    if isinstance(run, Result):
        return run.directory, 0
    return run.directory, run.entry


# The page.


def _card(name: str, run: Path, number: int, files: Path) -> str:
    """Return the page of a repository, in Markdown with the entries that the Hub reads on top."""
    record, config = read_record(files / "config.json"), from_json(run / "config.json")
    family = config.family
    lines = ["---", "library_name: mtjax", "tags: [reinforcement-learning, multi-task, mujoco, jax]", "---"]
    lines += [f"# {name.split('/')[1]}", "", f"`{config.agent}` on `{config.env}`: {family.summary}.", ""]
    lines += ["```python", "import mtjax", "", f'policy = mtjax.pull("{name}")', "mtjax.evaluate(policy)", "```", ""]
    lines += ["## Scores", "", *_scores(config, run, number), "", "## Training", ""]
    lines += [f"{config.plan.steps:,} environment steps on {record.get('device', 'an unknown device')}:", ""]
    lines += ["```bash", _wrapped(str(record.get("command", ""))), "```", "", "| package | version |", "|---|---|"]
    versions = record.get("versions")
    lines += [f"| {key} | {value} |" for key, value in (versions.items() if isinstance(versions, dict) else ())]
    if config.imports:
        own = ", ".join(f"`{Path(file).name}`" for file in config.imports)
        lines += ["", f"It uses code of its author's own, which is not here and must be imported first: {own}."]
    return "\n".join(lines) + "\n"


def _wrapped(command: str) -> str:
    """Return a command with each of its flags on a line."""
    return re.sub(r" (?=--)", " \\\\\n  ", command)


def _scores(config: Any, run: Path, number: int) -> list[str]:
    """Return the lines of a table of the last evaluation of one seed; a sentence if it is not known."""
    try:
        found = evaluations_of(config, run)
    except InputError:
        return ["Its evaluations are not in the run's folder. `mtjax.evaluate` plays new episodes."]
    if not len(found.steps):
        return ["It was not evaluated yet."]
    last = {split: found.returns[split][number, -1] for split in SPLITS if found.returns[split].size}
    rows = [
        f"| {split} | {len(x)} | {amount(x.mean())} | {amount(x.mean(axis=1).min())} |" for split, x in last.items()
    ]
    episodes = last["train"].shape[1]
    told = f"Of one seed after {int(found.steps[-1]):,} steps: means of {episodes} episodes of each task."
    return [told, "", "| tasks | number | mean return | worst task |", "|---|---|---|---|", *rows]
