"""Policies on the Hugging Face Hub, here a folder: what is uploaded acts as the run, and is data alone."""

import inspect
import json
import shutil
import sys
from importlib import import_module
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from conftest import SHORT_RUN
from needs import needs

import mtjax
import mtjax.train
from mtjax.checks import amount
from mtjax.envs import ENVS
from mtjax.saved import hub
from mtjax.types import InputError

NAME = "someone/finger"


class Folder:
    """The part of the Hub's interface that is called, with its repositories in a folder."""

    def __init__(self, root):
        self.root = root

    def create_repo(self, name, private, exist_ok):
        (self.root / name).mkdir(parents=True, exist_ok=exist_ok)
        (self.root / name / "private").write_text(str(private))

    def upload_folder(self, repo_id, folder_path, commit_message):
        shutil.copytree(folder_path, self.root / repo_id, dirs_exist_ok=True)

    def snapshot_download(self, name, revision, allow_patterns):
        if not (self.root / name).is_dir():
            raise OSError(f"404 Client Error: Repository Not Found for {name}\nplease log in")
        target = self.root / "cache" / name / str(revision)
        target.mkdir(parents=True, exist_ok=True)
        for file in allow_patterns:
            if (self.root / name / file).exists():
                shutil.copy(self.root / name / file, target)
        return str(target)


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """The folder that stands for the Hub."""
    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(HfApi=lambda: Folder(tmp_path / "hub")))
    return tmp_path / "hub"


def same_actions(ours, theirs):
    """Both policies act alike on every listed task."""
    tasks = theirs.env.tasks("all")
    obs = np.ones((len(tasks.id), 9), np.float32)
    np.testing.assert_array_equal(jax.vmap(ours)(obs, tasks), jax.vmap(theirs)(obs, tasks))


@pytest.mark.slow
def test_what_is_pulled_acts_as_what_was_pushed(copied_run, remote):
    """Any seed of the run; its page has the command, the scores of that seed and the versions."""
    theirs = mtjax.load(copied_run, seed=1)
    assert mtjax.push(theirs, NAME, private=True) == f"https://huggingface.co/{NAME}"
    same_actions(mtjax.pull(NAME), theirs)
    assert sorted(file.name for file in (remote / NAME).iterdir()) == [
        "README.md",
        "config.json",
        "policy.npz",
        "private",
    ]
    card = (remote / NAME / "README.md").read_text()
    assert "--env=finger-short" in card and f'mtjax.pull("{NAME}")' in card and f"| jax | {jax.__version__} |" in card
    with np.load(copied_run / "evaluations.npz") as file:
        mean = file["train"][1, -1].mean()
    assert f"| train | 2 | {amount(mean)} |" in card and "Of one seed after 600 steps" in card
    assert (remote / NAME / "private").read_text() == "True"
    assert str(copied_run.parent) not in card + (remote / NAME / "config.json").read_text()
    assert json.loads((remote / NAME / "config.json").read_text())["plan"]["seed"] == 1


@pytest.mark.slow
def test_a_policy_of_the_package_and_a_folder_can_be_pushed(copied_run, remote):
    """By name or path; of the first the page says that its scores are not there."""
    name = "finger-spin-vary-size/sac-conditioned"
    mtjax.push(name, NAME)
    same_actions(mtjax.pull(NAME), mtjax.load(name))
    assert "not in the run's folder" in (remote / NAME / "README.md").read_text()
    mtjax.push(str(copied_run), "a/b")
    same_actions(mtjax.pull("a/b", revision="v1"), mtjax.load(copied_run))


@pytest.mark.slow
def test_a_point_of_a_sweep_becomes_a_policy_of_its_own(short_family, tmp_path, remote):
    """With the values of its point, so that it needs no sweep."""
    mtjax.train.main([*SHORT_RUN, "--steps=200", f"--runs={tmp_path}/runs", "--sweep", "agent.actor-lr=1e-3,1e-2"])
    (run,) = (tmp_path / "runs").glob("*/run-1")
    theirs = mtjax.load(run, seed=3)
    mtjax.push(theirs, NAME)
    ours = mtjax.pull(NAME)
    same_actions(ours, theirs)
    record = json.loads((remote / NAME / "config.json").read_text())
    assert ours.agent.actor_lr == 1e-2 and record["points"] == [] and "--agent.actor-lr=0.01" in record["command"]


def test_nothing_of_an_author_runs_here(copied_run, remote, tmp_path, monkeypatch):
    """Neither a file that the settings name, nor a pickled object, nor a module of another package's environment."""
    own = tmp_path / "own.py"
    own.write_text("raise SystemExit('it ran')")
    mtjax.push(copied_run, NAME)
    file = remote / NAME / "config.json"
    record = json.loads(file.read_text())
    monkeypatch.delitem(ENVS.data, "finger-short")
    file.write_text(json.dumps(record | {"imports": [str(own)]}))
    with pytest.raises(InputError, match=r"uses code of your own: add --import="):
        mtjax.pull(NAME)
    for edit in ({"env": "gymnasium:own:X-v1"}, {"env": "gymnasium:X-v1", "family": {"environment": "own:X-v1"}}):
        file.write_text(json.dumps(record | edit))
        with pytest.raises(InputError, match="would import a module"):
            mtjax.pull(NAME)
    assert "own" not in sys.modules


def test_pickled_arrays_are_refused(copied_run, remote):
    """NumPy would run what a pickled array says."""
    mtjax.push(copied_run, NAME)
    np.savez(remote / NAME / "policy.npz", **{"0": np.array([{}], object)}, allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        mtjax.pull(NAME)


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda: mtjax.pull("no/where"), r"cannot pull 'no/where': OSError: 404 Client Error: .* for no/where$"),
        (lambda: mtjax.pull("nowhere"), "named owner/name, not 'nowhere'"),
        (lambda: mtjax.pull("../x"), "named owner/name"),
        (lambda: mtjax.push("nowhere", NAME), "nowhere"),
        (lambda: mtjax.push(3, NAME), "run must be a path"),
    ],
)
def test_mistakes_are_told_in_a_line(call, said, remote):
    """The Hub's own too."""
    with pytest.raises(InputError, match=said):
        call()


def test_a_repository_without_a_policy_is_told(remote):
    """By the file that is missing."""
    (remote / NAME).mkdir(parents=True)
    with pytest.raises(InputError, match=r"holds no policy of mtjax: it has no config\.json"):
        mtjax.pull(NAME)


def test_without_the_library_the_message_has_the_command(monkeypatch):
    """Which is in an extra of its own."""
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"mtjax.pull needs huggingface_hub: pip install 'mtjax\[hub\]'"):
        mtjax.pull(NAME)


@needs("huggingface_hub")
def test_the_hubs_interface_is_what_is_called():
    """Of the installed library, whose names and arguments may change."""
    api = import_module("huggingface_hub").HfApi
    calls = {"create_repo": ("private", "exist_ok"), "upload_folder": ("repo_id", "folder_path", "commit_message")}
    calls |= {"snapshot_download": ("revision", "allow_patterns")}
    for name, used in calls.items():
        assert set(used) <= set(inspect.signature(getattr(api, name)).parameters)
    assert hub._NAME.fullmatch(NAME)
