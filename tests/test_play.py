"""The policy that plays in a page of the documentation: in JavaScript it does as in Python, and so does its world."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.learning.evaluation import record
from mtjax.saved.policy import load

DOCS = Path(__file__).parent.parent / "docs"
sys.path.insert(0, str(DOCS))
import make_play  # noqa: E402

EPISODES = """
const play = require(process.argv[1]), policy = require(process.argv[2]);
const goals = JSON.parse(require("fs").readFileSync(0)), act = play.policy(policy);
console.log(JSON.stringify(goals.map((goal) => {
  let ball = [0, 0, 0, 0], total = 0;
  const places = [];
  for (let step = 0; step < 100; step++) {
    const force = act(ball, goal);
    for (let i = 0; i < play.SUBSTEPS; i++) ball = play.substep(ball, force);
    places.push(ball.slice(0, 2));
    total += play.reward(ball, goal);
  }
  return { places, total };
})));
"""

pytestmark = pytest.mark.skipif(not shutil.which("node"), reason="needs node")


def node(script, *words, given=""):
    done = subprocess.run(["node", "-e", script, *map(str, words)], input=given, capture_output=True, text=True)
    return done.stdout, done.stderr


@pytest.mark.slow
def test_episodes_in_javascript_are_those_of_mujoco():
    """Of all tasks, held-out ones too: every place of the ball, and returns."""
    policy = load(make_play.RUN)
    played = record(policy.env, policy.agent, policy.state, policy.env.tasks("all"), jnp.int32(0))
    params = policy.env.params("all")
    goals = np.stack([params["goal-x"], params["goal-y"]], axis=1).tolist()
    out, error = node(EPISODES, DOCS / "play" / "policy.js", make_play.FILE, given=json.dumps(goals))
    found = json.loads(out or pytest.fail(error))
    np.testing.assert_allclose([x["places"] for x in found], played.kept.qpos, rtol=0, atol=1e-5)
    np.testing.assert_allclose([x["total"] for x in found], played.returns[:, 0], rtol=1e-5)
    assert len(goals) >= 20 and np.min(played.returns) > 50


def test_the_page_has_the_policy_of_the_package():
    kept, made = json.loads(make_play.FILE.read_text()), json.loads(json.dumps(make_play.exported(make_play.RUN)))
    assert kept["constants"] == made["constants"]
    assert [step[0] for step in kept["program"]["steps"]] == [step[0] for step in made["program"]["steps"]]


def test_an_operation_that_is_missing_is_named():
    script = "require(process.argv[1]).policy({ program: { steps: [['sort', [], [], {}]] }, constants: [] })"
    _, error = node(script, DOCS / "play" / "policy.js")
    assert "there is no operation sort here yet" in error
