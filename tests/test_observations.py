"""Observations of any tree of arrays: worlds, replay and rollouts carry it, and networks see one vector of it."""

import dataclasses
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs, require
from probes import slow_but, tiny, train

import mtjax
from mtjax import agents, frames, standalone
from mtjax.agents import for_action
from mtjax.agents.combinations import require_sight
from mtjax.envs import ENVS, Parameter
from mtjax.envs.family import Family
from mtjax.learning.rollout import broadcast_tasks
from mtjax.saved.policy import Policy
from mtjax.types import InputError, Spec, Step


class Place(NamedTuple):
    """The state of a pointer."""

    at: Any  # (2,)
    age: Any  # () int32


@dataclasses.dataclass(frozen=True)
class Pointer(Family):
    """A pointer earns by being near to its goal, and sees a map of where it was near to, a bool and floats."""

    flat: bool = False
    """Observe the vector that networks are to see."""
    discrete: ClassVar[bool] = False
    action_size: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 6
    relabels: ClassVar[tuple[str, ...]] = ("goal",)
    parameters = MappingProxyType({"goal": Parameter("m", 0.5)})

    def reset(self, task, key):
        return self._step(task, Place(jax.random.uniform(key, (2,), minval=-1.0), jnp.int32(0)), jnp.float32(0))

    def step(self, task, state, action):
        action = jnp.float32(action) - 1.0 if self.discrete else 0.3 * action
        new = Place(jnp.clip(state.at + action, -1, 1), state.age + 1)
        return self._step(task, new, self._earned(task, new.at))

    def _earned(self, task, at):
        return -jnp.sum(jnp.abs(at - task.goal["goal"]))

    def _step(self, task, state, reward):
        return Step(state, self.observe(task, state), reward, jnp.bool_(False))

    def observe(self, task, state):
        near = (jnp.arange(6).reshape(2, 3) + state.age) * jnp.where(state.at[0] > 0, 3, -1)
        far = jnp.any(jnp.abs(state.at) > 0.5)
        seen = {"map": near.astype(jnp.int8), "near": (far, {"at": state.at}), "age": state.age}
        return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in jax.tree.leaves(seen)]) if self.flat else seen

    def relabel(self, task, transition, key):
        at = transition.next_obs["near"][1]["at"] if not self.flat else transition.next_obs[..., -2:]
        return transition._replace(reward=self._earned(task, at))


class Chooser(Pointer):
    """A pointer that chooses among three steps."""

    discrete: ClassVar[bool] = True
    action_size: ClassVar[int] = 3


VARY = {"vary": {"goal": "0:0.5:2"}}
TREE, FLAT = Pointer(**VARY), Pointer(flat=True, **VARY)  # type: ignore
LOOP = {"num_envs": 4, "chunk_steps": 12}
REPLAY = {"batch_size": 8, "replay_size": 400, "warmup_steps": 4}
ROLLOUTS = {"unroll": 6, "epochs": 2, "minibatches": 2}
CASES = {
    "sac": ("sac", REPLAY | {"normalize_observations": True}),
    "ppo": ("ppo", ROLLOUTS | {"conditioning": "parameters"}),
    "rl2": ("rl2", ROLLOUTS),
    "last steps": ("sac", REPLAY | {"conditioning": "inferred", "inferred_from": 3, "n_step": 2}),
    "gru from a replay": (
        "sac",
        REPLAY | {"conditioning": "recurrent", "recurrent_steps": 4, "normalize_observations": True},
    ),
    "hindsight": ("sac", REPLAY | {"hindsight": 0.5}),
    "encoder": ("sac", REPLAY | {"representation": "encoded"}),
}


@pytest.fixture
def registered():
    """Gives a name to the family that observes a tree, for one test."""
    mtjax.register("pointer", Pointer, **VARY)
    yield
    del ENVS["pointer"]


def agent_of(case):
    name, given = CASES[case]
    return tiny(name, **given)


@pytest.mark.slow
@pytest.mark.parametrize("case", slow_but(CASES, "ppo", nightly=True))
def test_networks_learn_from_a_tree_what_they_learn_from_its_vector(case):
    """Bit for bit, whoever reads observations: moments, last steps, a memory of the episode, hindsight."""
    agent = agent_of(case)
    (tree, metrics), (flat, wanted) = (train(env, agent, LOOP, chunks=2) for env in (TREE, FLAT))
    jax.tree.map(
        np.testing.assert_array_equal, (tree.agent.nets | {"inputs": None}), flat.agent.nets | {"inputs": None}
    )
    jax.tree.map(
        np.testing.assert_array_equal,
        tree.agent.nets["inputs"].parts["moments"],
        flat.agent.nets["inputs"].parts["moments"],
    )
    jax.tree.map(np.testing.assert_array_equal, metrics, wanted)


@pytest.mark.slow
def test_a_replay_keeps_ints_as_ints():
    """The store has the arrays as the family observes them."""
    state, _ = train(TREE, agent_of("sac"), LOOP)
    for seen in (state.data.ring.rows.obs, state.data.ring.rows.next_obs):
        kinds = jax.tree.map(lambda x: (str(x.dtype), x.shape[4:]), seen)
        assert kinds == {
            "map": ("int8", (2, 3)),
            "near": (("bool", ()), {"at": ("float32", (2,))}),
            "age": ("int32", ()),
        }
    assert len(np.unique(state.data.ring.rows.obs["map"])) > 6


# Outside of training.


def policy_of(env, name="ppo", **given):
    agent = for_action(tiny(name, **given), env.spec.action)
    state = jax.jit(lambda key: agent.init(env.spec, env.tasks(), key))(jax.random.key(0))
    return Policy(env, agent, state, None, jnp.arange(1))


def seen_by(env, count=3):
    """Observations of episodes after some steps, with a leading axis."""
    task = jax.tree.map(lambda x: x[0], env.tasks())
    begun = jax.vmap(lambda key: env.reset(task, key))(jax.random.split(jax.random.key(1), count))
    return task, jax.vmap(lambda state: env.step(task, state, jnp.ones(2)))(begun.state).obs


@pytest.mark.slow
def test_policies_take_trees_and_batches_of_them():
    """One, as dictionaries of NumPy's arrays or of lists, or a batch; and what is missing is told in a line."""
    policy, flat = policy_of(TREE), policy_of(FLAT)
    task, many = seen_by(TREE)
    vectors = seen_by(FLAT)[1]
    wanted = flat(vectors, task)
    np.testing.assert_array_equal(policy(many, task), wanted)
    np.testing.assert_array_equal(policy(jax.tree.map(lambda x: np.asarray(x[0]), many), task), flat(vectors[0], task))
    listed = {"map": many["map"][0].tolist(), "near": [False, {"at": [0.5, 0.25]}], "age": 1}
    assert policy(listed, task).shape == (2,)
    for wrong in ({**listed, "map": [1, 2]}, {"map": listed["map"]}, vectors[0]):
        with pytest.raises(InputError) as error:
            policy(wrong, task)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["choice", "vector"])
def test_exported_policies_take_trees(kind, tmp_path):
    """By NumPy, by JAX and by ONNX as the policy does."""
    env = Chooser(**VARY) if kind == "choice" else TREE  # type: ignore
    policy = policy_of(env)
    task, many = seen_by(TREE)
    wanted = np.asarray(policy(many, task))
    file = mtjax.export(policy, tmp_path / "policy.npz")
    by_numpy = standalone.load(file)
    shapes = {"age": (), "map": (2, 3), "near/0": (), "near/1/at": (2,)}
    assert standalone.shapes_of(by_numpy.meta) == shapes and "map (2, 3) int8" in by_numpy.meta["about"]
    np.testing.assert_allclose(by_numpy(jax.tree.map(np.asarray, many), goal=0.0), wanted, atol=2e-5)
    one = jax.tree.map(lambda x: np.asarray(x[0]), many)
    np.testing.assert_allclose(by_numpy(one, goal=0.0), wanted[0], atol=2e-5)
    named = standalone.entries(many, shapes)
    goals = np.zeros((3, 1), np.float32)
    np.testing.assert_allclose(standalone.load_jax(file)(named, goals), wanted, atol=2e-5)


@needs("onnx")
@needs("onnxruntime")
def test_a_model_of_onnx_takes_trees(tmp_path):
    """Its inputs are named by their paths, and have the family's types."""
    policy, (task, many) = policy_of(TREE), seen_by(TREE)
    session = require("onnxruntime").InferenceSession(mtjax.export(policy, tmp_path / "policy.onnx"))
    kinds = {put.name: put.type for put in session.get_inputs()}
    named = {name: np.asarray(x[0]) for name, x in standalone.entries(many, kinds.keys() - {"parameters"}).items()}
    given = named | {"parameters": np.zeros(1, np.float32)}
    (found,) = session.run(["action"], {name: given[name] for name in kinds})
    np.testing.assert_allclose(found, policy(jax.tree.map(lambda x: x[0], many), task), atol=2e-5)
    assert kinds["map"] == "tensor(int8)" and kinds["near/0"] == "tensor(bool)"


@needs("gymnasium")
def test_gymnasium_has_a_space_for_every_array():
    """Nested as the family observes them, in one world and in many."""
    from mtjax.gym.env import FamilyEnv
    from mtjax.gym.vector import FamilyVectorEnv

    for env in (FamilyEnv(TREE), FamilyVectorEnv(TREE, 4)):
        obs, _ = env.reset(seed=1)
        assert env.observation_space.contains(obs) and obs["env_obs"]["map"].dtype == np.int8
        obs, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs) and obs["env_obs"]["near"][0].dtype == bool


@pytest.mark.slow
def test_a_mixture_joins_and_pads_the_arrays_of_its_families():
    """The vectors that networks see, of the widest family."""
    both = mtjax.mixture([TREE, mtjax.make("two-goal-maze", scores=True)])
    alone = mtjax.mixture([FLAT, mtjax.make("two-goal-maze", scores=True)])
    assert both.spec == alone.spec
    seen = []
    for env in (both, alone):
        tasks, keys = env.tasks(), jax.random.split(jax.random.key(0), (1, 4, 2))
        each = broadcast_tasks(tasks, keys.shape)._replace(blocks=tasks.blocks)
        one = jax.tree.map(lambda x: x[0], tasks._replace(blocks=None))
        seen.append((jax.jit(env.reset_worlds)(each, keys).obs, env.reset(one, keys[0, 0, 0]).obs))
    jax.tree.map(np.testing.assert_array_equal, *seen)


# What agents take.

ARRAY = {name: jax.ShapeDtypeStruct(shape, kind) for name, (shape, kind) in {
    "floats": ((3,), jnp.float32), "ints": ((2, 2), jnp.int32), "picture": ((16, 16, 3), jnp.uint8),
    "complex": ((2,), jnp.complex64), "grey": ((16, 16), jnp.uint8)}.items()}  # fmt: skip


def spec_of(obs):
    return Spec.vector(1, 2, 1)._replace(obs=obs)


@pytest.mark.parametrize("name", agents.AGENTS)
def test_every_agent_says_what_it_takes(name):
    """In one line, which a refusal names."""
    cls, taken = agents.AGENTS[name].cls, "of any tree of numbers and bools"
    assert taken in cls.takes and "\n" not in cls.takes
    for obs in ({"x": ARRAY["complex"]}, {"pixels": ARRAY["grey"]}, {}):
        with pytest.raises(InputError, match=f"^{cls.__name__} takes observations of any tree .*; not ") as error:
            require_sight(mtjax.agent(name), spec_of(obs))
        assert "\n" not in str(error.value)


def test_vectors_are_taken_as_they_are_and_pictures_stay():
    """Those of one array or of a picture and a state have no layout, so that runs of them are what they were."""
    both = {"pixels": ARRAY["picture"], "state": ARRAY["floats"]}
    for obs in (ARRAY["floats"], {"pixels": ARRAY["picture"]}, both):
        assert frames.layout(obs) is None and frames.joined(obs) is obs
    found = frames.joined({"pixels": ARRAY["picture"], "arm": ARRAY["floats"], "grid": ARRAY["ints"]})
    assert jax.tree.map(lambda x: x.shape, found) == {"pixels": (16, 16, 3), "state": (7,)}
    require_sight(mtjax.agent("drq"), spec_of({"pixels": ARRAY["picture"], "grid": ARRAY["ints"]}))
    with pytest.raises(InputError, match="for pictures use --agent=drq"):
        require_sight(mtjax.agent("sac"), spec_of(both))


def test_what_cannot_go_together_is_refused():
    """Last steps hold vectors, which a family cannot relabel."""
    with pytest.raises(InputError, match="hindsight relabels last steps") as error:
        require_sight(mtjax.agent("sac", conditioning="inferred", inferred_from=3, hindsight=0.5), TREE.spec)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_runs_of_trees_are_saved_resumed_and_loaded(tmp_path, registered):
    """A family that is registered by name, through a run's whole life: its checkpoint, evaluation and policy."""
    given = REPLAY | {"hidden": (8,), "num_envs": 2, "chunk_steps": 5, "eval_episodes": 1, "eval_every": 40}
    play = lambda name, **more: mtjax.train("pointer", "sac", directory=tmp_path / name, quiet=True, **more)
    whole, begun = play("whole", steps=80, **given), play("begun", steps=40, **given)
    resumed = play("begun", steps=80, resume=True, **given)
    jax.tree.map(np.testing.assert_array_equal, resumed.state.agent, whole.state.agent)
    assert begun.state.agent.nets["inputs"].shared["layout"] == frames.Layout((0, 2, 0, 1))
    task, many = seen_by(TREE)
    policy = mtjax.load(tmp_path / "begun")
    np.testing.assert_array_equal(policy(many, task), whole.policy()(many, task))
    assert policy(many, goal=0.25).shape == (3, 2)
