"""Policies that come with the package: they act as the runs they are of, and score what their page says."""

import dataclasses
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs
from probes import family_for, tiny
from test_export import ENV, observations, policy_of

import mtjax
import mtjax.evaluate
from mtjax import agents
from mtjax.command import add_pretrained as command
from mtjax.command.run_config import parse
from mtjax.learning.evaluation import Episodes
from mtjax.report import films
from mtjax.report.scoring import score
from mtjax.saved import policy_files, pretrained
from mtjax.saved.config_json import from_json
from mtjax.training import finetune
from mtjax.types import InputError

PAGE = Path(__file__).parents[1] / "docs/results/policies.md"
# What a policy needs to be scored, or that it takes a minute.
MARKS = {"mt10/brc": [needs("metaworld")], "brax-ant-vary-direction/ppo": [pytest.mark.nightly]}


@pytest.mark.slow
@pytest.mark.parametrize("name", [x for x in agents.AGENTS if family_for(x) == "finger-spin"])
def test_an_action_depends_on_what_is_kept_alone(name):
    """Whatever the other arrays of the state hold; and so does what is remembered, on which the second one depends."""
    policy = policy_of(tiny(name))
    read = policy_files.read_by_acting(policy)
    leaves, form = jax.tree.flatten(policy.state)
    other = [x if i in read else jnp.full_like(x, 3) for i, x in enumerate(leaves)]
    assert 0 < len(read) < len(leaves)
    task = jax.tree.map(lambda x: x[0], ENV.tasks())
    obs = observations(1)[0]

    def acts(state):
        played = dataclasses.replace(policy, state=state)
        first = policy.agent.act(state, memory := played.begin(task), obs, task, None).action
        memory = played.remember(memory, task, obs, first, 1.0, obs)
        return first, policy.agent.act(state, memory, obs, task, None).action

    np.testing.assert_array_equal(acts(policy.state), acts(jax.tree.unflatten(form, other)))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An empty folder in place of the package's policies."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    return tmp_path / "pretrained"


@pytest.mark.slow
def test_a_policy_is_shipped_and_acts_as_its_run(copied_run, package, tmp_path, monkeypatch, capsys):
    """By its name, in Python and on the command line, which writes nothing but what goes with a film."""
    command.main([str(copied_run), "finger-spin/care"])
    assert pretrained.names() == ["finger-spin/care"]
    ours, theirs = mtjax.load("finger-spin/care"), mtjax.load(copied_run)
    tasks = theirs.env.tasks("all")
    obs = np.ones((len(tasks.id), 9), np.float32)
    np.testing.assert_array_equal(jax.vmap(ours)(obs, tasks), jax.vmap(theirs)(obs, tasks))
    monkeypatch.chdir(tmp_path)
    mtjax.evaluate.main(["--run=finger-spin/care", "--episodes=1"])
    told = capsys.readouterr().out.splitlines()[-1]
    assert told == "look at it: python -m mtjax.evaluate --run=finger-spin/care --video"
    assert not (tmp_path / "runs").exists()
    monkeypatch.setattr(films, "write", lambda *_: None)
    mtjax.evaluate.main(["--run=finger-spin/care", "--episodes=1", "--video"])
    assert (tmp_path / "runs/finger-spin-care/evaluation-1/returns.csv").is_file()
    assert sorted(file.name for file in (package / "finger-spin/care").iterdir()) == ["config.json", "policy.npz"]
    with pytest.raises(InputError, match="is a policy alone"):
        mtjax.evaluate.main(["--run=finger-spin/care", "--diagnostics"])
    with pytest.raises(InputError, match="there is a policy 'finger-spin/care' already"):
        command.main([str(copied_run), "finger-spin/care"])


def test_a_run_with_a_policy_inside_stays_a_run(copied_run):
    """As an exported one may be put there."""
    before = mtjax.load(copied_run)
    np.savez(copied_run / "policy.npz", meta=np.zeros(3))
    after = mtjax.load(copied_run)
    assert jax.tree.structure(after.states) == jax.tree.structure(before.states)
    finetune.require_fit(after, after.env, after.agent)


def test_damaged_policies_are_refused(copied_run, package):
    policy_files.write(copied_run, package / "a/b")
    file = package / "a/b/policy.npz"
    whole = file.read_bytes()
    for content, said in ((whole[:-50], "cannot be read"), (b"", "cannot be read")):
        file.write_bytes(content)
        with pytest.raises(InputError, match=said):
            mtjax.load("a/b")
    np.savez(file, **{"0": np.zeros(77)})
    with pytest.raises(InputError, match="is of another agent"):
        mtjax.load("a/b")
    shutil.rmtree(package / "a/b")
    policy_files.write(copied_run, package / "a/c")
    with pytest.raises(InputError, match="unknown run or trained policy 'a/b'; did you mean 'a/c'"):
        mtjax.load("a/b")


@pytest.mark.parametrize("flag", ["resume", "from"])
def test_a_policy_of_the_package_cannot_go_on_learning(flag):
    with pytest.raises(InputError, match="is a policy without critics and replay"):
        parse([f"--{flag}=reacher-vary-goal/ppo"])


def test_nor_can_it_from_python():
    """Its critics would be zeros."""
    for start in ("reacher-vary-goal/ppo", mtjax.load("reacher-vary-goal/ppo")):
        with pytest.raises(InputError, match="reacher-vary-goal/ppo' is a policy without critics and replay"):
            mtjax.train("reacher-vary-goal", start=start, steps=10, chunk_steps=1, num_envs=1)


def test_a_policy_of_the_package_has_no_checkpoints_to_choose_from():
    """A number is not left unread."""
    with pytest.raises(InputError, match="is a policy alone, without checkpoints; leave out checkpoint"):
        mtjax.load("reacher-vary-goal/ppo", checkpoint=5)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in pretrained.names()])
def test_a_policy_scores_what_its_page_says(name):
    """The return on training tasks in the table, within what two other episodes of each task may differ.

    By drawn actions where the run was evaluated so. A car that leaves its track loses nearly all, and worlds of a few
    equations cost little: they have twenty. Tasks that trials draw differ in what can be earned: they have many.
    """
    told = re.search(rf"^\| `{name}` \|.*?\| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    assert told, f"{PAGE.name} has no row of {name}"
    policy, sampled = mtjax.load(name), from_json(pretrained.folder(name) / "config.json").plan.eval_sampled
    episodes = 2000 if policy.trial > 1 else 20 if policy.env.engine_name == "jax" else 2
    found = score(policy, Episodes(episodes, policy.trial, sampled))["train"].returns.mean()
    assert abs(found - float(told[1])) < 0.05 * float(told[1]), found
