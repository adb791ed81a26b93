"""Mixtures: every family as it is alone, padding that changes nothing, and whole runs."""

import csv
import dataclasses
import functools
import types
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from needs import needs
from probes import OFF_POLICY, Levers, one_in

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax import agents
from mtjax.agents import for_action, normalize
from mtjax.agents.networks import OVER_TASKS, Params
from mtjax.agents.parts.policies import Gaussian
from mtjax.agents.rates import discounts
from mtjax.agents.replay_batches import Batch, action_sizes
from mtjax.agents.state import AgentState
from mtjax.agents.view import init_inputs
from mtjax.command import run_config
from mtjax.envs import ENVS, Family, Mixture, make, mixture
from mtjax.envs.mixtures import apart
from mtjax.envs.parameters import Parameter
from mtjax.experience.replay import Replay
from mtjax.learning import loop, rollout
from mtjax.learning.evaluation import Episodes, Scores, evaluate, record
from mtjax.learning.loop import Settings
from mtjax.report.tables import split_table, task_table
from mtjax.saved.config_json import from_json, to_flags, to_json
from mtjax.saved.folder import short_name
from mtjax.types import SPLITS, Discrete, InputError, MultiDiscrete, Spec, Step, Task, Transition

QUICK = {"xla_backend_optimization_level": 0}


class State(NamedTuple):
    obs: jax.Array


@dataclasses.dataclass(frozen=True)
class Aim(Family):
    """Earns most for the action that the task's goal names, in episodes of four steps."""

    parameters: ClassVar = {"goal": Parameter("1", 0.0, minimum=-10), "drift": Parameter("1", 0.25, minimum=-10)}
    action_size: ClassVar[int] = 1
    obs_size: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 4

    def reset(self, task, key):
        obs = jax.random.normal(key, (self.obs_size,))
        return Step(State(obs), obs, jnp.float32(0), jnp.bool_(False))

    def step(self, task, state, action):
        obs = state.obs * 0.9 + task.goal["drift"] + 0.1 * action[0]
        return Step(State(obs), obs, -jnp.sum(jnp.square(action - task.goal["goal"])), jnp.bool_(False))


@dataclasses.dataclass(frozen=True)
class WideAim(Aim):
    """The same with two actions, three numbers to see, episodes of seven steps, and success."""

    action_size: ClassVar[int] = 2
    obs_size: ClassVar[int] = 3
    episode_steps: ClassVar[int] = 7

    def step(self, task, state, action):
        step = super().step(task, state, action)
        return step._replace(metrics={"success": jnp.float32(step.reward > -0.5)})


AIM = Aim(vary={"goal": "-1:1:3"})  # 3 training tasks, 2 between them, 4 beyond
WIDE = WideAim(vary={"goal": "0.5"})  # 1 and none
BOTH = mixture([AIM, WIDE])


@pytest.fixture(scope="module", autouse=True)
def names():
    """Makes ``aim`` and ``wide-aim`` names like any others, and keeps programs out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVS, "aim", (Aim, {"vary": {"goal": "-1:1:3"}}))
        patch.setitem(ENVS, "wide-aim", (WideAim, {"vary": {"goal": "0.5"}}))
        patch.setenv("MTJAX_CACHE", "0")
        yield
    jax.clear_caches()


def quick(function, *arguments):
    """Compile a function for such arguments, and call it."""
    return jax.jit(function).lower(*arguments).compile(QUICK)(*arguments)


def tiny(name="sac-conditioned", **settings):
    """An agent small enough to compile in a few seconds."""
    small = {
        "num_experts": 2,
        "expert_widths": (8, 4),
        "encoder_widths": (8,),
        "module_width": 8,
        "routing_widths": (8,),
        "hypernetwork_widths": (8, 4),
        "latent_widths": (8, 8),
        "model_widths": (8,),
        "embedding_size": 4,
        "theta_size": 4,
    }
    made = agents.agent(name, **{"hidden": (8,), **settings})
    small = {k: v for k, v in small.items() if k in agents.settings(made) and k not in settings}
    return agents.agent(name, **{**agents.settings(made), **small})


def keys_of(tasks: Task, envs: int = 2, seed: int = 0):
    return jax.random.split(jax.random.key(seed), (1, len(tasks.id), envs))


def spread(tasks: Task, envs: int = 2) -> Task:
    return rollout.broadcast_tasks(tasks, (1, len(tasks.id), envs))


def pick(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


@dataclasses.dataclass(frozen=True)
class Shown(Aim):
    """An aim that shows what it observes as a picture, with or without the numbers beside it."""

    side: int = 16
    state: str = "hidden"
    channels: int = 1
    frames: int = 2

    @property
    def spec(self):
        picture = jax.ShapeDtypeStruct((self.side, self.side, self.channels), jnp.uint8)
        beside = {"state": jax.ShapeDtypeStruct((self.obs_size,), jnp.float32)} if self.state == "also" else {}
        return super().spec._replace(obs={"pixels": picture} | beside, frames=self.frames)

    def show(self, step):
        size, bright = (self.side, self.side, self.channels), jnp.clip(50 * step.obs[0] + 100, 0, 255)
        picture = jnp.full(size, bright).astype(jnp.uint8)
        return step._replace(obs={"pixels": picture} | ({"state": step.obs} if self.state == "also" else {}))

    def reset(self, task, key):
        return self.show(super().reset(task, key))

    def step(self, task, state, action):
        return self.show(super().step(task, state, action))


@dataclasses.dataclass(frozen=True)
class WideShown(Shown):
    """The same with three numbers to see, and longer episodes."""

    obs_size: ClassVar[int] = 3
    episode_steps: ClassVar[int] = 7


def shown(**settings):
    return mixture([Shown(vary={"goal": "-1,1"}, split="none", **settings), WideShown(**settings)])


# Tasks.


def test_tasks_lie_family_after_family_in_every_split():
    tasks = {split: BOTH.tasks(split) for split in (*SPLITS, "all")}
    assert [len(tasks[split].id) for split in SPLITS] == [4, 2, 4]
    assert np.concatenate([tasks[split].id for split in SPLITS]).tolist() == list(range(10)) == tasks["all"].id.tolist()
    assert tasks["train"].row.tolist() == [0, 1, 2, 9] and tasks["interpolation"].row.tolist() == [3, 4]
    assert tasks["train"].horizon.tolist() == [4, 4, 4, 7] and BOTH.episode_length == 7
    assert tasks["train"].action_mask.tolist() == [[1, 0]] * 3 + [[1, 1]]
    assert BOTH.spec._replace(sentences=()) == Spec.vector(3, 2, 3)._replace(mixed=True)
    assert tasks["all"].blocks.runs == ((0, 3), (1, 1), (0, 6))


def test_the_context_says_which_family_and_what_is_different_there():
    # The marks of two families, and the one slot of the family that has several tasks.
    assert BOTH.tasks("train").context.tolist() == [[1, 0, -1], [1, 0, 0], [1, 0, 1], [0, 1, 0]]


def test_families_of_as_many_actions_need_no_mask():
    assert mixture(["control-cartpole", "control-acrobot"]).tasks().action_mask is None


def test_a_mixture_of_one_has_that_familys_tasks_but_for_what_only_the_family_reads():
    ours, theirs = mixture([AIM]).tasks("train"), AIM.tasks("train")
    for name in ("id", "row", "context", "horizon", "action_mask", "draws"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert mixture([AIM]).spec == AIM.spec


def test_the_nearest_training_task_is_of_the_same_family():
    env = mixture([make("tabular-mdp", num_tasks=2), make("bandit", num_tasks=3)])
    train, held_out = env.tasks("train"), env.tasks("interpolation")
    state = AgentState({"tasks": Params({"known": train.context}, {})}, {}, {})
    known = jax.vmap(state.known)
    nearest = np.asarray(known(held_out))
    families = np.argmax(held_out.context[:, :2], axis=1)
    assert np.argmax(train.context[nearest][:, :2], axis=1).tolist() == families.tolist() == [0] * 2 + [1] * 3
    far = held_out._replace(context=held_out.context.at[:, 2:].multiply(100.0))  # nearer to the other family
    assert np.argmax(train.context[known(far)][:, :2], axis=1).tolist() == families.tolist()


@pytest.mark.parametrize("name", ["finger-spin+", "+", "finger-spin++cheetah-run"])
def test_a_name_that_lacks_a_family_is_refused(name):
    with pytest.raises(InputError, match="lacks a family; a mixture is NAME"):
        make(name)


def test_names_of_families_and_tasks():
    env = mixture([make("walker-walk", vary={"friction": "0.7,1"}), make("bandit", scores=True), AIM])
    assert env.names == ("walker-walk", "bandit", "aim")
    assert env.labels("train")[:3] == ["walker-walk friction=0.7", "walker-walk friction=1", "bandit task=0"]
    assert env.labels("train")[-1] == "aim goal=1"
    twice = mixture([make("walker-walk", vary={"friction": "0.7,1"}), make("walker-walk", vary={"mass": "1,2"})])
    assert twice.names == ("walker-walk", "walker-walk#2") and twice.train_count == 4
    assert mixture([mixture(["bandit"]), "control-acrobot"]).names == ("bandit", "control-acrobot")
    assert "2 training tasks" in mixture(["cartpole-swingup", "walker-walk"]).summary


@pytest.mark.slow
def test_a_summary_says_what_every_episode_draws():
    """A range without a number of steps is of one task, and not of its two ends."""
    drawn = make("finger-spin", vary={"size": "1:1.2", "mass": "1,2"})
    assert drawn.summary.startswith("2 training tasks, size 1 to 1.2 drawn each episode, mass 1 to 2, split")
    assert make("finger-spin", vary={"size": "1:1.2:2"}).summary.startswith("2 training tasks, size 1 to 1.2, split")
    both = mixture([make("finger-spin", vary={"size": "1:1.2"}), "walker-walk"])
    assert "2 families: finger-spin (1: size 1 to 1.2 drawn each episode), walker-walk; split" in both.summary


@pytest.mark.parametrize(
    "make_it, said",
    [
        (lambda: make("cartpole-swingup+wlaker-walk"), "did you mean 'walker-walk'"),
        (lambda: make("bandit+bandit"), "bandit is in the mixture twice"),
        (lambda: make("bandit+control-acrobot", vary={"link-mass-1": "1,2"}), "control-acrobot.link-mass-1"),
        (lambda: make("bandit+control-acrobot", vary={"acrobot.torque": "1"}), "which family's torque varies"),
        (lambda: make("bandit+control-acrobot", num_task=2), "did you mean 'num_tasks'"),
        (lambda: mixture([]), "at least one family"),
        (lambda: make("bandit+control-acrobot").spec,
         "bandit has discrete actions and control-acrobot continuous ones; scores=True"),
        (lambda: mixture([Levers(), make("bandit")]).spec, r"multi-discrete \(3, 5\) actions and bandit discrete ones"),
        (lambda: mixture([Levers(), Levers(sizes=(5, 3))]).spec, r"\(3, 5\) actions and .* multi-discrete \(5, 3\) "),
        (lambda: mixture([make("control-cartpole", num_draws=3, combine="grid"),
                          make("control-acrobot", num_draws=2, combine="grid")]).tasks(), "num-draws"),
        (lambda: Replay(hindsight=0.5).check(BOTH, 1), "share no physics"),
    ],
)  # fmt: skip
def test_what_makes_no_mixture_is_refused_with_the_reason(make_it, said):
    with pytest.raises(InputError, match=said):
        make_it()


@needs("gymnasium")
def test_gymnasium_and_fine_tuning_take_one_family():
    import mtjax.gym as gym

    with pytest.raises(InputError, match="one space of observations"):
        gym.make("bandit+control-acrobot")
    from mtjax.training.finetune import require_fit

    start = types.SimpleNamespace(env=AIM, agent=tiny(), directory=None)
    with pytest.raises(InputError, match=r"aim\+wide-aim is a mixture; take one family"):
        require_fit(start, BOTH, tiny())  # type: ignore


# Worlds.


def steps_of(env, tasks, keys, actions):
    """The steps of worlds under actions (H, S, T, E, A), and the state after them; by NumPy but for the state."""

    def play(tasks, keys, actions):
        start = env.reset_worlds(tasks, keys)

        def step(state, action):
            step = env.step_worlds(tasks, state, action)
            return step.state, step._replace(state=())

        state, seen = jax.lax.scan(step, start.state, actions)
        return start.obs, seen, state

    start, seen, state = quick(play, spread(tasks, keys.shape[2]), keys, actions)
    return *jax.device_get((start, seen)), state


@pytest.mark.slow
@pytest.mark.parametrize("split", ["train", "all"])
def test_every_family_steps_as_it_does_alone(split):
    scored = [make(name, num_tasks=2, scores=True) for name in ("tabular-mdp", "two-goal-maze-seen")]
    env = mixture([make("control-cartpole", num_tasks=2), *scored])
    tasks = env.tasks(split)
    keys = keys_of(tasks)
    actions = np.asarray(jax.random.uniform(jax.random.key(1), (5, *keys.shape, env.spec.action_size), minval=-1.0))
    start, seen, states = steps_of(env, tasks, keys, actions)
    for part, state in zip(env.parts, apart(states), strict=True):
        size, width, places = part.family.spec.action_size, part.family.spec.obs_size, part.places[split]
        first, alone, end = steps_of(
            part.family, part.family.tasks(split), keys[:, places], actions[:, :, places, :, :size]
        )
        np.testing.assert_array_equal(start[:, places, :, :width], first)
        np.testing.assert_array_equal(seen.obs[:, :, places, :, :width], alone.obs)
        np.testing.assert_array_equal(seen.reward[:, :, places], alone.reward)
        np.testing.assert_array_equal(seen.terminated[:, :, places], alone.terminated)
        assert not np.any(seen.obs[:, :, places, :, width:])
        for ours, theirs in zip(jax.tree.leaves(state), jax.tree.leaves(end), strict=True):
            same = jax.random.key_data if jnp.issubdtype(ours.dtype, jax.dtypes.prng_key) else np.asarray
            np.testing.assert_array_equal(same(ours), same(theirs))


@pytest.mark.slow
def test_one_task_of_any_family_steps_as_it_does_alone():
    """One program plays every task, whose number it does not know; the other families' worlds stay to the bit."""
    env, tasks = BOTH, BOTH.tasks()

    @jax.jit
    def play(row):
        one = loop.rows_of(tasks, row[None])
        keys, mask = keys_of(one), jnp.array([[[True, False]]])
        actions = jax.random.uniform(jax.random.key(1), (*keys.shape, env.spec.action_size), minval=-1.0)
        begun = env.reset_worlds(spread(one), keys)
        moved = env.step_worlds(spread(one), begun.state, actions)
        return begun, moved, env.renew_worlds(spread(one), keys, mask, moved.state)

    for number in range(4):
        (i, family), task = (0, env.families[0]) if number < 3 else (1, env.families[1]), number % 3
        own = pick(family.tasks(), slice(task, task + 1))
        keys, found = keys_of(own), play(jnp.int32(number))
        actions = jax.random.uniform(jax.random.key(1), (*keys.shape, env.spec.action_size), minval=-1.0)
        begun = family.reset_worlds(spread(own), keys)
        moved = family.step_worlds(spread(own), begun.state, family.spec.action.narrow(actions))
        for step, alone in zip(found, (begun, moved, begun), strict=True):
            np.testing.assert_allclose(step.obs[..., : family.spec.obs_size], alone.obs, rtol=1e-5)
            np.testing.assert_allclose(step.reward, alone.reward, rtol=1e-5)
            assert not np.any(step.obs[..., family.spec.obs_size :])
        before, after, again = (step.state.families[i].obs for step in found)
        np.testing.assert_array_equal(again, np.where([[[[True], [False]]]], before, after))
        assert not np.any(found[1].state.families[1 - i].obs)


def test_of_a_mixture_one_task_or_all_are_played():
    blocks = BOTH.tasks().blocks
    assert blocks.some(1).take("worlds", 0) == "worlds"
    with pytest.raises(InputError, match="one task is played at a time, or all are; not 2"):
        blocks.some(2)
    alone = mixture([BOTH.families[0]]).tasks().blocks.some(2)
    assert alone.runs == ((0, 2),)


def test_worlds_that_end_begin_anew_and_the_others_go_on():
    tasks, reset, move = BOTH.tasks("all"), jax.jit(BOTH.reset_worlds), jax.jit(BOTH.step_worlds)
    each, keys = spread(tasks), keys_of(tasks)
    old, new = reset(each, keys), reset(each, keys_of(tasks, seed=1))
    mask = jax.random.bernoulli(jax.random.key(2), shape=keys.shape)
    chosen = move(each, jax.jit(BOTH.where_worlds)(mask, new.state, old.state), jnp.zeros((*keys.shape, 2)))
    both = [move(each, step.state, jnp.zeros((*keys.shape, 2))).obs for step in (new, old)]
    np.testing.assert_array_equal(chosen.obs, np.where(np.asarray(mask)[..., None], *both))


def test_metrics_are_those_of_all_families_and_unknown_elsewhere():
    tasks = BOTH.tasks("train")
    actions = jnp.full((1, 1, 4, 2, 2), 0.5)
    success = steps_of(BOTH, tasks, keys_of(tasks), actions)[1].metrics["success"][0, 0]
    assert np.isnan(success[:3]).all() and (success[3] == 1).all()


def test_only_whole_splits_are_stepped():
    with pytest.raises(InputError, match="a whole split"):
        BOTH.reset_worlds(spread(pick(BOTH.tasks(), slice(2))), keys_of(pick(BOTH.tasks(), slice(2))))


def test_a_single_world_plays_outside_of_programs():
    task = pick(BOTH.tasks(), 1)
    start = BOTH.reset(task, jax.random.key(0))
    step = BOTH.step(task, start.state, jnp.array([0.5, 9.0]))
    alone = AIM.step(pick(AIM.tasks(), 1), start.state, jnp.array([0.5]))
    assert step.obs.shape == (3,) and step.reward == alone.reward
    with pytest.raises(InputError, match="reset_worlds"):
        jax.jit(BOTH.reset)(task, jax.random.key(0))


def test_episodes_draw_tasks_of_their_own_family():
    """Where a range is continuous, an episode's draw decides physics and context; other families' stay as they are."""
    drawn = Aim(vary={"goal": "-1:1"}, num_draws=50)
    env = mixture([drawn, WIDE])
    tasks, agent = env.tasks("train"), tiny()

    def play(keys):
        learners = jax.vmap(lambda key: agent.init(env.spec, tasks, key))(keys[:, 0, 0])
        worlds = rollout.reset_envs(env, agent, learners, tasks, keys)
        return worlds.task.context[0], rollout.step_envs(env, agent, learners, tasks, worlds, None)[1].transition

    context, step = quick(play, keys_of(tasks, 20))
    context = np.asarray(context)
    assert len(np.unique(context[0, :, 2])) > 10 and (context[0, :, :2] == [1, 0]).all()
    assert (context[1] == [0, 1, 0]).all()
    action = np.asarray(step.action)[0, 0, :, 0]
    np.testing.assert_allclose(step.reward[0, 0], -np.square(action - context[0, :, 2]), rtol=1e-4)
    assert not np.any(step.action[0, 0, :, 1])  # which that family has not


def test_episodes_end_at_their_own_horizons():
    tasks, agent = BOTH.tasks("all"), tiny()

    def play(key):
        return record(BOTH, agent, agent.init(BOTH.spec, BOTH.tasks("train"), key), tasks, jnp.int32(0))

    played = quick(play, jax.random.key(0))
    assert played.lengths[:, 0].tolist() == [4, 4, 4, 7] + [4] * 6
    aim, wide = apart(played.kept)
    assert aim.obs.shape == (9, 7, 2) and wide.obs.shape == (1, 7, 3)


def test_discounts_follow_horizons():
    env = mixture(["control-cartpole", make("tabular-mdp", scores=True)])
    found = discounts(tiny(discounting="horizon"), env.tasks())
    np.testing.assert_allclose(found, np.repeat([0.99, 0.95], 10), rtol=1e-6)


# Padding changes nothing.


def test_padded_actions_have_no_part_in_the_density():
    outputs, raw = jax.random.normal(jax.random.key(0), (2, 5, 4))
    small = jnp.concatenate([outputs[:, :1], outputs[:, 2:3]], axis=1)  # mean and deviation of the first action
    mask = jnp.array([1.0, 0.0])
    policy = Gaussian()
    np.testing.assert_allclose(
        policy.log_prob(outputs, raw[:, :2], mask), policy.log_prob(small, raw[:, :1]), rtol=1e-6
    )
    action, _, _ = policy.draw(outputs, mask, jax.random.key(1))
    assert not np.any(action[:, 1]) and np.all(action[:, 0] != 0)


def test_target_entropy_counts_the_actions_that_there_are():
    tasks = BOTH.tasks()
    assert action_sizes(jnp.zeros((4, 5, 2)), tasks.action_mask).tolist() == [1, 1, 1, 2]
    agent = tiny(target_entropy=-2.0)
    loss = lambda log, *of_task: agent.temperature_loss({"temperature": Params({}, {"log": log})}, *of_task)[0]
    slope = jax.vmap(jax.grad(loss))(jnp.zeros(4), jnp.array([-2.0, -2.0, -2.0, -4.0]), jnp.array([1, 1, 1, 2]))
    np.testing.assert_array_equal(slope, np.zeros(4))  # each is at its own target


def test_every_task_has_its_own_normaliser_and_padding_stays_zero():
    agent, random = tiny(normalize_observations=True), np.random.default_rng(0)
    obs = jnp.float32(random.normal(size=(4, 50, 3)) * [[[1]], [[2]], [[5]], [[9]]])
    obs = obs.at[:3, :, 2].set(0.0)  # of the three tasks that see two numbers
    inputs = agent.view.count(init_inputs(BOTH.spec, 4), obs)
    seen = quick(jax.vmap(agent.view.see, (OVER_TASKS, 0)), inputs, obs)
    assert not np.any(seen[:3, :, 2])
    for i, width in enumerate((2, 2, 2, 3)):
        alone = normalize.update(normalize.init(width), obs[i, :, :width])
        np.testing.assert_allclose(seen[i, :, :width], normalize.apply(alone, obs[i, :, :width]), rtol=1e-5, atol=1e-6)


@dataclasses.dataclass(frozen=True)
class SameAim(Aim):
    """What it observes means the same in all families of its kind."""

    observes: ClassVar[str] = "aims"


@dataclasses.dataclass(frozen=True)
class HeldOutAim(SameAim):
    """None of its tasks trains."""

    @functools.cached_property
    def variation(self):
        found = super().variation
        rows = {split: found.rows[split][:0] for split in SPLITS} | {"extrapolation": found.rows["train"]}
        return dataclasses.replace(found, rows=rows)


def test_tasks_of_a_family_that_does_not_train_are_seen_in_the_units_of_all_that_do():
    """Where all observe the same. Else such a task has those of the first one, which mean something else."""
    goals = {"vary": {"goal": "0,1"}, "split": "none"}
    same = mixture([SameAim(**goals), HeldOutAim(vary={"goal": "5"}, split="none")])
    assert same.counts == {"train": 2, "interpolation": 0, "extrapolation": 1}
    others = mixture([SameAim(**goals), SameAim(vary={"goal": "5"}, split="none")])
    apart = mixture([Aim(**goals), HeldOutAim(vary={"goal": "5"}, split="none")])
    assert (same.spec.mixed, others.spec.mixed, apart.spec.mixed) == (False, True, True)
    agent = tiny(normalize_observations=True)
    obs = jnp.float32(np.random.default_rng(0).normal(size=(2, 50, 2)) * [[[1]], [[9]]] + [[[0]], [[4]]])
    inputs = agent.view.count(init_inputs(same.spec, 2), obs)
    together = normalize.update(normalize.init(2), obs)
    np.testing.assert_allclose(agent.view.see(inputs, obs[0]), normalize.apply(together, obs[0]), rtol=1e-5, atol=1e-6)
    assert not inputs.own  # so that no task, also of the other family, has moments of its own


@pytest.mark.parametrize("families", [[SameAim()], [Aim(), SameAim()]], ids=["one normaliser", "one for each task"])
def test_a_world_that_blows_up_does_not_spoil_what_all_others_look_like(families):
    """One observation of 1e9 among 200,000 of a task would make all others 0. They keep two fifths of their size."""
    env = mixture(families)
    agent, tasks = tiny(normalize_observations=True), env.counts["train"]
    obs = np.float32(np.random.default_rng(0).normal(size=(tasks, 200_000, env.spec.obs_size)))
    inputs = agent.view.count(init_inputs(env.spec, tasks), jnp.asarray(obs))
    assert bool(inputs.own) == env.spec.mixed == (len(families) > 1)
    obs[0, 0] = 1e9
    seen = agent.view.see_all(agent.view.count(inputs, jnp.asarray(obs)), obs[:, 1:])
    assert np.all(np.std(seen, axis=1) > 0.4)


def widened(params: Params, like: Params, rows: np.ndarray, outputs: np.ndarray | None) -> Params:
    """Small networks inside of wide ones: weights at the wide one's input ``rows`` and ``outputs``, zero elsewhere."""

    def place(path, small, wide):
        name = jax.tree_util.keystr(path)
        if small.shape == wide.shape:
            return small
        index = [np.arange(n) for n in small.shape]
        if "Dense_0" in name:
            index[-2] = rows
        elif "BatchNorm_0" in name:
            index[-1] = rows
        elif outputs is not None and "head" in name:
            index[-1] = outputs
        return jnp.zeros_like(wide).at[np.ix_(*index)].set(small)

    return jax.tree_util.tree_map_with_path(place, params, like)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "constants"), one_in(2, [("sac", 0), ("simba-v2", 1), ("xqc", 0)]))
def test_losses_of_a_padded_task_are_those_of_the_task_alone(name, constants, monkeypatch):
    """A task with 2 observed numbers and 1 action, in networks of 4 and 3 that hold the same weights, and zeros."""
    noise = np.random.default_rng(1).normal(size=(6, 3)).astype(np.float32)
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.asarray(noise[: shape[0], : shape[1]]))
    agent, random = tiny(name, conditioning="none"), np.random.default_rng(0)
    task, features = WIDE.tasks(), jnp.zeros(0)
    pad = lambda x, width: jnp.pad(x, ((0, 0), (0, width - x.shape[1])))
    obs, next_obs = jnp.float32(random.normal(size=(2, 6, 2)))
    action, reward = jnp.tanh(jnp.float32(random.normal(size=(6, 1)))), jnp.float32(random.normal(size=6))
    common = {"reward": reward, "discount": jnp.full(6, 0.9), "features": features, "temperature": jnp.float32(0.3)}
    small = Batch(obs, action, next_obs=next_obs, mask=None, **common)
    wide = Batch(pad(obs, 4), pad(action, 3), next_obs=pad(next_obs, 4), mask=jnp.array([1.0, 0, 0]), **common)
    monkeypatch.undo()
    init = lambda o, a: quick(lambda key: agent.init(Spec.vector(o, a, 1), task, key), jax.random.key(0))
    of_small, of_wide = (probes.of_task(init(*sizes).nets, 0) for sizes in ((2, 1), (4, 3)))
    constant = np.arange(constants)  # what an encoder puts behind the inputs
    of_actor, of_critic = np.append([0, 1], 4 + constant), np.append([0, 1, 4], 7 + constant)
    of_wide["actor"] = widened(of_small["actor"], of_wide["actor"], of_actor, np.array([0, 3]))
    of_wide["critic"] = widened(of_small["critic"], of_wide["critic"], of_critic, None)
    monkeypatch.setattr(jax.random, "normal", lambda key, shape: jnp.asarray(noise[: shape[0], : shape[1]]))
    key = jax.random.key(0)

    def losses(nets, batch):
        target = agent.critic_target(nets, nets, batch, key)
        fit = lambda critic: agent.critic_loss(nets | {"critic": critic}, batch, target)
        improve = lambda actor: agent.actor_loss(nets | {"actor": actor}, batch, key)
        (critic_loss, _), critic_slope = jax.value_and_grad(fit, has_aux=True)(nets["critic"])
        (actor_loss, seen), slope = jax.value_and_grad(improve, has_aux=True)(nets["actor"])
        return critic_loss, actor_loss, seen.entropy, slope, critic_slope

    found = [quick(losses, *of_one) for of_one in ((of_small, small), (of_wide, wide))]
    np.testing.assert_allclose(found[1][:3], found[0][:3], rtol=1e-5)
    slopes = widened(found[0][3], found[1][3], of_actor, np.array([0, 3]))
    for ours, theirs in zip(jax.tree.leaves(found[1][3]), jax.tree.leaves(slopes), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6)  # zero for all that is padded
    slopes = widened(found[0][4], found[1][4], of_critic, None)
    for ours, theirs in zip(jax.tree.leaves(found[1][4]), jax.tree.leaves(slopes), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6)


def test_input_maps_begin_as_the_identity_and_are_every_tasks_own():
    agent = tiny("sac", encoder="input-map")
    state = quick(lambda key: agent.init(BOTH.spec, BOTH.tasks(), key), jax.random.key(0))
    actor = state.nets["actor"]
    front = actor.own["front"]["params"]["map"]
    np.testing.assert_array_equal(front["kernel"], np.broadcast_to(np.eye(3), (4, 3, 3)))
    plain = tiny("sac")
    without = probes.with_nets(state, actor=Params(actor.shared, {}))
    obs, task = jnp.array([0.3, -2.0, 0.0]), pick(BOTH.tasks(), 1)
    ours, theirs = (a.act(s, a.begin(s, task), obs, task, None).action for a, s in ((agent, state), (plain, without)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


# Agents.


def random_batch(env, num_batch: int = 3) -> Transition:
    random, tasks = np.random.default_rng(0), env.tasks()
    shape = (len(tasks.id), num_batch)
    normal = lambda size: jnp.float32(random.normal(size=(*shape, size)))
    return Transition(
        obs=normal(env.spec.obs_size),
        action=jnp.tanh(normal(env.spec.action_size)) * tasks.action_mask[:, None],
        reward=jnp.float32(random.normal(size=shape)),
        discount=jnp.ones(shape),
        next_obs=normal(env.spec.obs_size),
    )


def init_and_update(agent, tasks: Task, batch: Transition, key):
    state = agent.init(BOTH.spec, tasks, key)
    new, metrics = probes.update(agent, state, batch, tasks, key)
    act = lambda task, obs: agent.act(new, agent.begin(new, task), obs, task, key).action
    return state, new, metrics, jax.vmap(act)(tasks, batch.obs[:, 0])


@pytest.mark.parametrize("name", one_in(4, OFF_POLICY, nightly=True))
def test_every_agent_learns_a_mixture(name):
    """That it can be traced; what it computes, those agents show that are compiled below."""
    arguments = (BOTH.tasks(), random_batch(BOTH), jax.random.key(0))
    state, new, metrics, action = jax.eval_shape(lambda *x: init_and_update(tiny(name), *x), *arguments)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(lambda x: (x.shape, x.dtype), new)
    assert action.shape == (4, 2) and metrics["td_error"].shape == (4,)


@pytest.mark.slow
@pytest.mark.parametrize("name", one_in(3, ["distral", "hip-bmdp", "brc", "xqc", "simba-v2", "pcgrad"], nightly=True))
def test_an_update_is_finite_and_acts_where_there_are_actions(name):
    agent = tiny(name, normalize_observations=True, discounting="horizon")
    run = lambda *arguments: init_and_update(agent, *arguments)
    _, new, metrics, action = quick(run, BOTH.tasks(), random_batch(BOTH), jax.random.key(0))
    finite = [jnp.isfinite(x).all() for x in jax.tree.leaves((new, metrics)) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert all(finite)
    assert not np.any(action[:3, 1]) and np.all(action[:, 0] != 0)


# Whole runs.

PLAN = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 2, "chunk_steps": 5, "eval_episodes": 2}


@pytest.mark.slow
def test_a_mixture_of_one_learns_bit_for_bit_as_the_family():
    family, agent = AIM, tiny("multi-head", normalize_observations=True)
    plan = {**PLAN, "steps": 80, "eval_every": 40}
    alone, mixed = (mtjax.train(env, agent, **plan) for env in (family, mixture([family])))
    for ours, theirs in zip(jax.tree.leaves(mixed.state.agent), jax.tree.leaves(alone.state.agent), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for split in SPLITS:
        np.testing.assert_array_equal(mixed.evaluations.returns[split], alone.evaluations.returns[split])


@pytest.mark.slow
def test_mujocos_families_learn_in_one_program():
    env = mixture([make(name, engine="c") for name in ("cartpole-swingup", "pendulum-swingup")])
    assert env.engine_name == "c" and env.spec.obs_size == 5 and env.tasks().action_mask is None
    agent = tiny("sac", normalize_observations=True)
    result = mtjax.train(env, agent, **{**PLAN, "eval_episodes": 1}, steps=80, eval_every=80)
    returns = result.evaluations.returns["train"]
    assert returns.shape == (1, 1, 2, 1) and np.isfinite(returns).all() and result.evaluations.metrics == {}
    tasks = env.tasks("train")
    again = evaluate(env, agent, Episodes(1), result.state.agent, tasks, jnp.zeros(1, int), jnp.int32(0)).returns
    np.testing.assert_allclose(again, returns[:, 0], rtol=1e-3)


@pytest.fixture(scope="module")
def run(names, tmp_path_factory) -> Path:
    """The folder of a run on a mixture, by the program. Only to be read."""
    runs = tmp_path_factory.mktemp("runs")
    words = (
        "--env=aim+wide-aim --agent=multi-head --steps=80 --eval-every=40 --eval-episodes=2 --num-envs=2 "
        "--batch-size=4 --replay-size=40 --warmup-steps=2 --chunk-steps=5 --agent.hidden 8"
    )
    mtjax.train.main([*words.split(), f"--runs={runs}"])
    (directory,) = runs.iterdir()
    return directory


@pytest.mark.slow
def test_a_run_keeps_every_tasks_returns(run):
    with np.load(run / "evaluations.npz") as found:
        assert found["train"].shape == (1, 2, 4, 2) and found["interpolation"].shape == (1, 2, 2, 2)
        success = found["train_success"]
        assert np.isnan(success[:, :, :3]).all() and np.isfinite(success[:, :, 3]).all()
    with (run / "metrics.csv").open() as file:
        lines = [line.strip().split(",") for line in file]
    assert all(line[lines[0].index("success")] != "" for line in lines[2:])  # of the family that has it


@pytest.mark.slow
def test_a_run_is_scored_family_by_family(run, capsys):
    mtjax.evaluate.main([f"--run={run}", "--episodes=1", "--diagnostics"])
    said = capsys.readouterr().out
    assert said.rindex("\naim") > said.index("\naim\nsplit") and "all families" in said
    assert "wide-aim" in said and "aim goal=-1" in said
    (folder,) = run.glob("evaluation-*")
    assert {"returns.csv", "return_by_task.png", "diagnostics.json"} <= {file.name for file in folder.iterdir()}
    assert "train,aim goal=-1,0,0," in (folder / "returns.csv").read_text()
    with (folder / "returns.csv").open() as file:
        told = {line["task"].split()[0]: (line["success"], line["success_ever"]) for line in csv.DictReader(file)}
    assert told["aim"] == ("", "") and all(told["wide-aim"])  # of the family that has it
    heads = {name: f"\n{said}".split(f"\n{name}\n")[1].splitlines()[0] for name in ("aim", "wide-aim")}
    assert "success" not in heads["aim"] and "success, at any step" in heads["wide-aim"]
    with pytest.raises(InputError, match="only families whose worlds can be drawn can be filmed"):
        mtjax.evaluate.main([f"--run={run}", "--video"])


@pytest.mark.slow
def test_a_run_and_its_policy_are_read_back(run):
    config = from_json(run / "config.json")
    assert isinstance(config.family, Mixture) and config.family == make("aim+wide-aim")
    assert run_config.parse(to_flags(config)) == dataclasses.replace(config, runs="runs")
    policy = mtjax.load(run)
    task = pick(policy.env.tasks(), 0)
    action = policy(policy.env.reset(task, jax.random.key(0)).obs, task)
    assert action.shape == (2,) and action[1] == 0
    assert "aim" in task_table(policy, {"train": Scores(np.zeros((1, 4, 2)), {})})


@pytest.mark.slow
def test_a_run_goes_on_bit_for_bit(tmp_path, monkeypatch):
    """And tells its sinks the returns of evaluations, and the success of tasks that have it."""
    agent, plan = tiny("sac", normalize_observations=True), {**PLAN, "eval_every": 40}
    drawn, told = mixture([Aim(vary={"goal": "-1:1"}, num_draws=5), WIDE]), []
    with monkeypatch.context() as patch:
        patch.setattr("mtjax.training.journal.write_rows", lambda sinks, rows, names: told.extend(rows))
        whole = mtjax.train(drawn, agent, **plan, steps=80)
    found, logged = whole.evaluations, [row for row in told if "evaluation/train" in row]
    for scores, name in ((found.returns, ""), (found.metrics["success"], "/success")):
        expected = np.nanmean(scores["train"], axis=(0, 2, 3))
        assert [float(row[f"evaluation/train{name}"]) for row in logged] == pytest.approx(expected, rel=1e-5)
    mtjax.train(drawn, agent, **plan, steps=40, directory=tmp_path)
    rest = mtjax.train(drawn, agent, **plan, steps=80, directory=tmp_path, resume=True)
    for ours, theirs in zip(jax.tree.leaves(rest.state), jax.tree.leaves(whole.state), strict=True):
        if jnp.issubdtype(ours.dtype, jax.dtypes.prng_key):
            ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
        np.testing.assert_array_equal(ours, theirs)
    assert "wide-aim" in split_table(rest.evaluations, drawn.parts)


# The command line.


def test_flags_of_families_hold_for_all_of_them(tmp_path):
    words = "--env=control-cartpole+tabular-mdp+cartpole-swingup --split=none --env.num-tasks 3 --engine=mjx --seeds=2"
    config = run_config.parse([*words.split(), "--env.scores", "--env.vary.cartpole-swingup.pole-mass=0.1,0.2"])
    pole, table, swingup = config.family.families  # type: ignore
    assert (pole.num_tasks, table.num_tasks, pole.split, table.split) == (3, 3, "none", "none") and table.scores
    assert swingup.engine == "mjx" and swingup.train_count == 2 and config.plan.seeds == 2
    assert config.training == Settings(num_envs=16)  # the default preset's
    (tmp_path / "config.json").write_text(to_json(config, {}))
    assert from_json(tmp_path / "config.json") == config
    assert run_config.parse(to_flags(config)) == config


@pytest.mark.parametrize(
    "flag, said",
    [
        ("--env.vary.gravity=1,2", "say which family's gravity varies: one of bandit.gravity"),
        ("--env.num-task=3", "did you mean '--env.num-tasks'"),
        ("--env.num-tasks=many", "num-tasks"),
        ("--split=denze", "did you mean 'dense'"),
        ("--env.vary.control-cartpole.gravty=1,2", "did you mean 'gravity'"),
        ("--hindsight=0.5", "share no physics"),
    ],
)
def test_wrong_flags_are_refused(flag, said):
    with pytest.raises(InputError) as error:
        config = run_config.parse(["--env=bandit+control-cartpole", "--env.scores", flag])
        config.learner.experience.check(config.family, 16)
    assert said in str(error.value)


@pytest.mark.slow
def test_a_mixture_is_not_fine_tuned(run):
    with pytest.raises(InputError, match="is a mixture; take one family"):
        run_config.parse(["--env=aim", f"--from={run}"])


def test_names_of_many_families_are_shortened():
    assert short_name("bandit+tabular-mdp") == "bandit+tabular-mdp"
    assert short_name("+".join(f"family-number-{i}" for i in range(9))) == "mixture-of-9"


# Pictures.


def test_families_with_pictures_of_one_shape_mix():
    """Pictures are each family's own, and the numbers beside them are padded."""
    env = shown(state="also")
    assert {name: x.shape for name, x in env.spec.obs.items()} == {"pixels": (16, 16, 1), "state": (3,)}
    assert (env.spec.frames, env.spec.mixed, shown().spec.obs.keys()) == (2, True, {"pixels"})
    tasks, keys = env.tasks(), keys_of(env.tasks())
    start, seen, _ = steps_of(env, tasks, keys, jnp.ones((1, 1, 3, 2, 1)))
    for place, family in zip((slice(0, 2), slice(2, 3)), env.families, strict=True):
        own = family.tasks()
        theirs, then, _ = steps_of(family, own, keys[:, place], jnp.ones((1, 1, len(own.id), 2, 1)))
        for ours, alone in ((start, theirs), (jax.tree.map(lambda x: x[0], x.obs) for x in (seen, then))):
            np.testing.assert_array_equal(ours["pixels"][:, place], alone["pixels"])
            np.testing.assert_array_equal(ours["state"][:, place][..., : family.obs_size], alone["state"])
            assert not np.any(ours["state"][:, place][..., family.obs_size :])


def test_channels_of_single_pictures_are_padded():
    """With zeros at the end, when worlds begin and step, alone too; of stacks they must be as many."""
    few, many = Shown(vary={"goal": "-1,1"}, split="none", frames=1, channels=2), WideShown(frames=1, channels=3)
    env = mixture([few, many])
    assert env.spec.obs["pixels"].shape == (16, 16, 3)
    tasks, keys = env.tasks(), keys_of(env.tasks())
    start, seen, _ = steps_of(env, tasks, keys, jnp.ones((1, 1, 3, 2, 1)))
    alone = env.reset(pick(tasks, 0), keys[0, 0, 0]).obs["pixels"]
    for first in (start["pixels"][0, 0, 0], seen.obs["pixels"][0, 0, 0, 0], alone):
        assert first.shape == (16, 16, 3) and np.all(first[..., :2]) and not np.any(first[..., 2])
    assert np.all(start["pixels"][0, 2])
    with pytest.raises(InputError, match=r"2 pictures \(16, 16, 2\) and wide-shown 2 pictures \(16, 16, 3\)"):
        _ = mixture([Shown(channels=2), WideShown(channels=3)]).spec


def test_families_that_look_otherwise_do_not_mix():
    with pytest.raises(InputError, match=r"shown shows 2 pictures \(16, 16, 1\) and wide-shown 2 .*18, 18"):
        _ = mixture([Shown(), WideShown(side=18)]).spec
    with pytest.raises(InputError, match="and aim no pictures; give all the same pixels"):
        _ = mixture([Shown(), AIM]).spec
    with pytest.raises(InputError, match="beside a state"):
        _ = mixture([Shown(), WideShown(state="also")]).spec
    with pytest.raises(InputError, match="is a mixture; take one family"):
        mtjax.stacked(shown())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("drq", {}),
        pytest.param("drq", {"representation": "asymmetric"}, marks=pytest.mark.nightly),
        pytest.param("ppo", {"representation": "encoded"}, marks=pytest.mark.nightly),
    ],
)
def test_agents_learn_a_mixture_of_pictures(monkeypatch, name, settings):
    """Every task's own best action, which its number in the context tells."""
    monkeypatch.setattr(probes, "QUICK", {"xla_backend_optimization_level": 2})  # else convolutions are slow
    env = shown(state="also" if settings.get("representation") == "asymmetric" else "hidden")
    agent = agents.agent(name, latent_widths=(8,), hidden=(32,), actor_lr=3e-3, critic_lr=3e-3, **settings)
    given = {"unroll": 4, "minibatches": 2} if name == "ppo" else {"replay_size": 1000, "batch_size": 8, "n_step": 1}
    _, history = probes.train(env, agent, {"num_envs": 4, "chunk_steps": 100, **given}, chunks=5)
    first, last = (np.mean(x["return"]) for x in (history[0], history[-1]))
    assert last > first / 2, (first, last)


@pytest.mark.parametrize(
    "name", ["bandit", "tabular-mdp", "point-mass-vary-goal", "cartpole-swingup-vary-pole-mass", "bandit+tabular-mdp"]
)
def test_tasks_are_numbered_without_building_them(name):
    """Through the splits, in families and in mixtures; a single parameter tells its values."""
    env = make(name)
    for split in SPLITS:
        tasks, values = env.tasks(split), env.task_values(split)
        varied = env.varied if isinstance(env, Family) else ()
        told = tasks.params[varied[0]] if len(varied) == 1 else tasks.id
        np.testing.assert_array_equal(env.numbers(split), tasks.id)
        np.testing.assert_array_equal(values, told)
        assert values.dtype == told.dtype and env.counts[split] == len(tasks.id)


@pytest.mark.slow
def test_families_of_several_choices_mix_where_their_sizes_are_equal():
    """All tasks have all choices, and each family gets what the policy chose."""
    env = mixture([Levers(vary={"turn": "0,1"}, split="none"), Levers(vary={"turn": "2"}, split="none")])
    tasks = env.tasks()
    assert env.discrete and env.spec.action == MultiDiscrete((3, 5)) and tasks.action_mask is None
    keys = keys_of(tasks)
    none = np.zeros((1, *keys.shape, 2), np.int32)
    lights = np.argmax(steps_of(env, tasks, keys, none)[0], axis=-1)
    turns = np.array([0, 1, 2])[:, None]
    right = np.stack([(lights + turns) % 3, (2 * lights + turns) % 5], axis=-1).astype(np.int32)
    _, seen, _ = steps_of(env, tasks, keys, right[None])
    assert seen.reward.shape == (1, *keys.shape) and np.all(np.asarray(seen.reward) == 1)


@pytest.mark.slow
def test_families_of_discrete_actions_mix():
    """Policies choose among the actions of each family alone, and every family steps as it does alone."""
    env = mixture([make("bandit", num_tasks=2, num_arms=2), make("tabular-mdp", num_tasks=2)])
    tasks = env.tasks()
    assert env.discrete and env.spec.action == Discrete(5)
    assert tasks.action_mask.tolist() == [[1, 1, 0, 0, 0]] * 2 + [[1] * 5] * 2
    agent = for_action(tiny("ppo"), env.spec.action)
    state = quick(lambda key: agent.init(env.spec, tasks, key), jax.random.key(1))
    act = lambda task, key: agent.act(state, agent.begin(state, task), jnp.ones(env.spec.obs_size), task, key).action
    act_all, keys = jax.vmap(jax.vmap(act, (None, 0)), (0, None)), jax.random.split(jax.random.key(0), 200)
    actions = np.asarray(quick(act_all, tasks._replace(blocks=None), keys))
    assert [np.unique(x).tolist() for x in actions] == [[0, 1]] * 2 + [[0, 1, 2, 3, 4]] * 2
    keys = keys_of(tasks)
    drawn = np.asarray(jax.random.randint(jax.random.key(2), (3, *keys.shape), 0, 2))
    _, seen, _ = steps_of(env, tasks, keys, drawn)
    for part in env.parts:
        places = part.places["train"]
        _, alone, _ = steps_of(part.family, part.family.tasks(), keys[:, places], drawn[:, :, places])
        np.testing.assert_array_equal(seen.reward[:, :, places], alone.reward)
