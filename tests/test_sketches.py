"""Sub-policies by sketch: what learns from what, the curriculum, and a corridor that is learned and told further."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import QUICK, only_seed, pick, tiny, train

import mtjax
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.on_policy import Batch
from mtjax.agents.sketches import SubPolicies
from mtjax.agents.state import of_task
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.envs.craft.sketched import Sketched
from mtjax.envs.parameters import Parameter
from mtjax.experience import Rollouts
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.types import Array, InputError

LENGTH = 7
STOP = 2
PATHS = {
    "l": ("left",),
    "r": ("right",),
    "lr": ("left", "right"),
    "rlr": ("right", "left", "right"),
    "rl": ("right", "left"),
}


class Walked(NamedTuple):
    place: Array  # () int32
    visits: Array  # () int32, ends that were visited in the order of the sketch


@dataclasses.dataclass(frozen=True)
class Corridor(Sketched):
    """Corridor: go to its ends in the order of the sketch. STOP must come at an end, and no sooner."""

    held_out: tuple[str, ...] = ("rl",)
    parameters: ClassVar[Mapping[str, Parameter]] = {
        "goal": Parameter("1", 0.0, minimum=-1.0, maximum=len(PATHS) - 1.0, names=tuple(PATHS))
    }
    sketches: ClassVar[Mapping[str, tuple[str, ...]]] = PATHS
    symbols: ClassVar[tuple[str, ...]] = ("left", "right")
    num_moves: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 40

    def begin(self, task, key):
        return Walked(jax.random.randint(key, (), 1, LENGTH - 1), jnp.int32(0))

    def move(self, task, world, chosen):
        place = jnp.clip(world.place + 2 * chosen - 1, 0, LENGTH - 1)
        due = task.goal["sketch"][jnp.minimum(world.visits, self.longest - 1)]
        return Walked(place, world.visits + (place == (LENGTH - 1) * due))

    def view(self, task, world):
        return jax.nn.one_hot(world.place, LENGTH)

    def reached(self, task, world):
        return world.visits >= task.goal["length"]

    def compile_spec(self, values=None):
        return mujoco.MjSpec()


ENV = Corridor(vary={"goal": "l,r,lr,rlr,rl"}, sketched=True)
TASKS = ENV.tasks()


def made(**settings):
    return for_action(tiny("sketches", **settings), ENV.action)


def begun(agent):
    return jax.jit(lambda: agent.init(ENV.spec, TASKS, jax.random.key(0)), compiler_options=QUICK)()


def observations(symbols):
    """One at each place of the corridor, with these symbols due; -1 for none."""
    place = np.eye(LENGTH)[np.arange(len(symbols)) % LENGTH]
    return jnp.float32(np.concatenate([place, np.eye(3)[symbols][:, :2]], axis=1))


# Networks.


def test_observations_choose_the_sub_policy_and_it_does_not_see_the_symbol():
    """Its outputs are those of a network of its own; where no symbol is due they are 0."""
    agent = made()
    state = begun(agent)
    obs = observations([0, 1, 1, 0, -1])
    outputs = agent.policy_outputs(of_task(state.nets, 0), jnp.zeros(0), obs)
    modules, network = state.nets["actor"].shared, dataclasses.replace(agent, sharing="tasks").actor
    for i, symbol in enumerate([0, 1, 1, 0]):
        own = Params({}, jax.tree.map(lambda x, symbol=symbol: x[symbol], modules))
        expected = network.apply(own, jnp.zeros(0), obs[i, :LENGTH])
        np.testing.assert_allclose(outputs[i], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(outputs[4], 0)
    assert modules["head"]["bias"].shape == (2, 3) and not state.nets["actor"].own
    np.testing.assert_allclose(modules["head"]["bias"], [[0, 0, -3]] * 2)


@pytest.mark.parametrize("sharing, heads", [("tasks", (4, 3)), ("all", (3,))])
def test_ablations_share_less_or_everything(sharing, heads):
    agent = made(sharing=sharing)
    actor = begun(agent).nets["actor"]
    assert actor.parts["head"]["bias"].shape == heads and bool(actor.own) == (sharing == "tasks")
    assert not isinstance(agent.actor, SubPolicies)


def test_unseen_tasks_use_what_sketches_share():
    """Only a policy for each task is borrowed from a nearest one."""
    said = {sharing: describe_unseen(made(sharing=sharing)) for sharing in ("symbols", "tasks", "all")}
    assert said == {
        "symbols": "each is played by the policies of its sketch's symbols",
        "tasks": "each uses the networks of the nearest training task",
        "all": "",
    }


# Gradients.


def batch_of(symbols, actions, seed=0):
    """Steps with random advantages, under these symbols."""
    random, count = np.random.default_rng(seed), len(symbols)
    normal = lambda: jnp.float32(random.normal(size=count))
    zeros = jnp.zeros(count)
    obs = observations(symbols)
    return Batch(obs, jnp.int32(actions), normal() - 1, normal(), zeros, zeros, jnp.zeros(0), None)


def test_a_step_moves_the_sub_policy_of_its_symbol_and_no_other():
    """Exactly 0 for others, in the actor's loss with its entropy; STOP counts for the symbol that was due."""
    agent = made()
    nets = of_task(begun(agent).nets, 0)
    loss = lambda actor, batch: agent.actor_loss(nets | {"actor": actor}, batch, jax.random.key(1))[0]
    grad = jax.jit(jax.grad(loss), compiler_options=QUICK)
    for symbol in (0, 1):
        found = grad(nets["actor"], batch_of([symbol] * 4, [0, 1, STOP, STOP])).shared
        for leaf in jax.tree.leaves(found):
            assert not np.any(leaf[1 - symbol])
        assert np.any(found["head"]["kernel"][symbol]) and np.any(found["head"]["bias"][symbol][STOP])
    both = grad(nets["actor"], batch_of([0, 1, 0, 1], [0, 1, STOP, STOP])).shared
    assert all(np.any(both["head"]["bias"][symbol]) for symbol in (0, 1))


def test_critics_are_of_one_task_each():
    """A critic's loss on one task's steps moves its own critic, and no actor."""
    agent = made()
    state = begun(agent)
    assert not state.nets["critic"].shared
    assert all(len(leaf) == 4 for leaf in jax.tree.leaves(state.nets["critic"].own))
    nets = of_task(state.nets, 0)
    loss = lambda nets: agent.critic_loss(nets, batch_of([0, 1], [0, 1])._replace(target=jnp.ones(2)))[0]
    found = jax.jit(jax.grad(loss, allow_int=True), compiler_options=QUICK)(nets)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(found["actor"]))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(found["critic"].own["head"]))


# Curriculum.


def test_the_curriculum_knows_the_lengths_of_sketches():
    memory = begun(made()).nets["sampler"].own
    np.testing.assert_array_equal(memory.length, [1, 1, 2, 3])
    np.testing.assert_allclose(made().sampler.weights(memory, None), [2, 2, 0, 0])


SMALL = {"num_envs": 4, "unroll": 8, "minibatches": 2, "epochs": 1, "chunk_steps": 8}


@pytest.mark.slow
def test_tasks_that_do_not_take_part_yet_teach_nothing():
    """Beside "l", "rlr" is too long: its critic stays bit for bit, and so does the sub-policy of "right"."""
    env = dataclasses.replace(ENV, vary={"goal": "l,rlr"}, split="none")
    start, after = (only_seed(train(env, made(), SMALL, chunks=chunks)[0].agent.nets) for chunks in (0, 1))
    for part in (lambda nets: nets["critic"].own, lambda nets: nets["actor"].shared):
        moved = jax.tree.leaves(jax.tree.map(lambda a, b: np.asarray(a != b), part(start), part(after)))
        assert any(leaf[0].any() for leaf in moved) and not any(leaf[1].any() for leaf in moved)


# Learning.


def returns(agent, state, split, episodes=20):
    """The mean return of each task of a split under the likeliest actions."""
    tasks = ENV.tasks(split)
    places = np.asarray(tasks.id)
    play = lambda state: evaluate(ENV, agent, Episodes(episodes), state, tasks, jnp.arange(1), jnp.int32(0), places)
    return np.asarray(jax.jit(play, compiler_options=QUICK)(state).returns)[0].mean(axis=1)


@pytest.mark.slow
def test_sketches_are_learned_in_turn_and_a_new_one_is_played():
    """From one end to the other; chance earns less than a tenth. The held-out order was never trained."""
    agent = made(gamma=0.95, actor_lr=3e-3, critic_lr=3e-3, stop_bias=-1.0, return_rate=0.1)
    given = {"num_envs": 32, "unroll": 16, "minibatches": 4, "epochs": 4, "chunk_steps": 320}
    start, _ = train(ENV, agent, given, chunks=0)
    assert returns(agent, start.agent, "train").mean() < 0.5
    state, _ = train(ENV, agent, given, chunks=3)
    assert only_seed(state.agent.nets["sampler"].own).longest[0] >= 3
    assert np.all(returns(agent, state.agent, "train") > 0.9)
    assert returns(agent, state.agent, "interpolation").item() > 0.9


# Settings.


@pytest.mark.parametrize(
    "given, said",
    [
        ({"normalize_observations": True}, "reads symbols off observations as they are"),
        ({"heads": "shared"}, "heads is disjoint, not shared"),
        ({"representation": "deepmdp"}, "use representation=plain"),
        ({"sharing": "symbol"}, "unknown sharing 'symbol'; did you mean 'symbols'"),
    ],
)
def test_what_makes_no_sense_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        mtjax.agent("sketches", **given)


def test_families_that_follow_no_sketch_are_refused():
    env = mtjax.make("craft")
    with pytest.raises(InputError, match="families that follow a sketch, such as --env=craft-sketched"):
        for_action(mtjax.agent("sketches"), env.action).init(env.spec, env.tasks(), jax.random.key(0))
    assert isinstance(made().experience, Rollouts) and pick(TASKS, 0).goal["length"] == 1
