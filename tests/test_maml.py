"""MAML: its steps by the closed form of two arms, what plays when, and navigation that a step makes better."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, adapted_gain, of_task, only_seed, pick, tiny, train, with_nets

import mtjax
from mtjax.agents import agent, clipped_ratio, for_action
from mtjax.agents.maml import MAML
from mtjax.agents.parts.policies import Taken
from mtjax.command.keywords import from_keywords
from mtjax.envs.probes import Probe, World, tasks_of
from mtjax.learning import loop
from mtjax.learning.evaluation import Episodes, adapted, evaluate
from mtjax.parallel import mesh as meshes
from mtjax.training.launch import check
from mtjax.types import Discrete, InputError, Spec, Step, Transition

KEY = jax.random.key(0)
SPEC = Spec.vector(2, 2, 1)._replace(action=Discrete(2))
TASKS = tasks_of("one-step", (1.0, -1.0))
SIGN = jnp.array([1.0, -1.0])  # of the arm that pays, 0 or 1
PLAIN = {
    "value_normalization": "none",
    "advantage_normalization": "none",
    "normalize_observations": False,
    "max_gradient_norm": 0.0,
}


def armed(**settings):
    """An agent for two arms, and its state at the log odds x of the first one."""
    made = for_action(tiny("maml", unroll=1, epochs=1, **{**PLAIN, **settings}), SPEC.action)
    return made, made.init(SPEC, TASKS, KEY)


def leaning(state, x):
    """A state whose policy has log odds x of the first arm, and has not adapted; values are 0."""
    zeros, head = (lambda net: jax.tree.map(jnp.zeros_like, net)), jnp.array([x / 2, -x / 2])
    actor = state.nets["actor"]
    actor = actor._replace(shared=actor.shared | {"head": {**actor.shared["head"], "bias": head}})
    copies = jax.tree.map(lambda x: jnp.stack([x, x]), actor.shared)
    adapted = state.nets["adapted"]._replace(own=copies)
    return with_nets(state, actor=actor, adapted=adapted, critic=zeros(state.nets["critic"]))


def chances(made, state):
    """The probabilities (T, 2) of arms with which the agent acts."""
    outputs = lambda nets: made.policy_outputs(nets | {"actor": nets["adapted"]}, jnp.zeros(0), jnp.zeros(2))
    return jnp.stack([jax.nn.softmax(outputs(of_task(state.nets, i))) for i in range(2)])


def pulls(made, state):
    """A rollout (T, 1, 2, ...) that stands for all: each arm once, its reward weighted by twice its probability."""
    chance, shape = chances(made, state), (2, 1, 2)
    arm = jnp.broadcast_to(jnp.arange(2), shape)
    pays = arm == jnp.array([0, 1])[:, None, None]
    ended = jnp.ones(shape, bool)
    obs, taken = jnp.zeros((*shape, 2)), Taken(arm, jnp.log(chance)[:, None])
    return Transition(obs, arm, 2 * chance[:, None] * pays, jnp.zeros(shape), obs, ended, ended, ended, extras=taken)


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize("x", [-0.7, 0.0, 1.2])
@pytest.mark.slow
def test_steps_are_those_of_the_closed_form(x, first_order):
    """Log odds are the difference of two biases, which move by the same: twice the rate. Hidden units are 0."""
    made, state = armed(inner_rate=1.5, first_order=first_order)
    state = leaning(state, x)
    before = pulls(made, state)
    moved = made.adapt(state, before, TASKS)
    s = jax.nn.sigmoid(x)
    expected = jax.nn.sigmoid(x + 3 * s * (1 - s) * SIGN)
    np.testing.assert_allclose(chances(made, moved)[:, 0], expected, rtol=1e-5)

    steps = jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=1), before, pulls(made, moved))
    state, steps = made.assess(state, steps, TASKS)
    window = made.experience.window(steps, made.experience.batches(None, made, TASKS, steps, KEY)[0])
    _, batch = made.prepare(state, window, TASKS)

    def loss(bias):
        head = {**state.nets["actor"].shared["head"], "bias": bias}
        actor = state.nets["actor"]._replace(shared=state.nets["actor"].shared | {"head": head})
        nets = state.nets | {"actor": actor}
        return sum(made.actor_loss(of_task(nets, i), pick(batch, i), KEY)[0] for i in range(2)) / 2

    found, slope = jax.value_and_grad(loss)(jnp.array([x / 2, -x / 2]))
    earned = lambda x, sign: jax.nn.sigmoid(sign * x)
    start = lambda x: adapted_gain(earned, x, SIGN[:, None], SIGN, 3.0, first_order)
    assert -found == pytest.approx(float(start(x)), rel=1e-5)
    np.testing.assert_allclose(-slope, jax.grad(start)(x) * SIGN, rtol=1e-4, atol=1e-6)


def test_first_order_is_another_slope():
    """The two closed forms are told apart by these log odds."""
    earned = lambda x, sign: jax.nn.sigmoid(sign * x)
    slope = lambda order: jax.grad(lambda x: adapted_gain(earned, x, SIGN[:, None], SIGN, 3.0, order))(1.2)
    assert abs(slope(True) - slope(False)) > 0.01


def test_advantages_end_with_their_rollout():
    """Those of two rollouts together are those of each, though no episode ends with the first."""
    made = tiny("maml", unroll=3)
    state = made.init(Spec.vector(3, 2, 1), TASKS, KEY)
    reward, value, following = jax.random.normal(KEY, (3, 2, 6, 4))
    no = jnp.zeros((2, 6, 4), bool)
    steps = Transition(None, reward, reward, jnp.ones((2, 6, 4)), None, no, no, no)
    of = lambda part: [jax.tree.map(lambda x: x[:, part], x) for x in (steps, value, following)]
    find = lambda part: clipped_ratio.advantages(made, of(part)[0], TASKS, *of(part)[1:], made.experience.apart)[1]
    apart = jnp.concatenate([find(slice(3)), find(slice(3, 6))], axis=1)
    np.testing.assert_allclose(find(slice(None)), apart, rtol=1e-5, atol=1e-6)
    assert jnp.mean(apart[:, :3], axis=(1, 2)) == pytest.approx(0, abs=1e-6)
    assert state.nets["adapted"].own.keys() == state.nets["actor"].shared.keys()


@pytest.mark.slow
def test_the_loop_plays_what_the_update_adapts():
    """The last rollout is by the adapted policy, with exactly which the first update begins: their ratio is 1."""
    given = {"num_envs": 8, "unroll": 4, "epochs": 1, "chunk_steps": 12, "inner_rate": 5.0}
    made = tiny("maml", inner_steps=2, normalize_observations=False)
    state, ((metrics),) = train(Probe("by-action"), made, given)
    assert metrics["kl"] == pytest.approx(0, abs=1e-6) and metrics["clip_fraction"] == pytest.approx(0)
    nets = only_seed(state.agent.nets)
    for adapted_leaf, leaf in zip(
        *map(jax.tree.leaves, (nets["adapted"].own, nets["actor"].shared)), strict=True
    ):  # forgotten after learning
        np.testing.assert_array_equal(adapted_leaf, np.stack([leaf] * 2))


@pytest.mark.slow
def test_steps_go_on_over_rollouts():
    """Each world takes all steps, one after another: ages of a walk, whose observation goes up by 1."""
    seen = []

    @dataclasses.dataclass(frozen=True)
    class Watched(MAML):
        def assess(self, state, steps, tasks):
            if steps.obs.shape[1] > self.experience.unroll:
                jax.debug.callback(lambda obs: seen.append(np.asarray(obs)), steps.obs)
            return super().assess(state, steps, tasks)

    train(Walk(), Watched(hidden=(4,)), {"num_envs": 2, "unroll": 2, "epochs": 1, "chunk_steps": 4})
    jax.effects_barrier()
    (obs,) = seen
    assert obs.shape == (2, 4, 2, 1)
    walks = np.moveaxis(obs[..., 0], 1, 2)
    long = walks[..., 0] % 1 >= 0.5
    assert long.any()
    np.testing.assert_allclose(np.diff(walks, axis=2)[long], 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"conditioning": "parameters"}, "use conditioning=none, not parameters"),
        ({"heads": "per-task"}, "heads is shared, not per-task"),
        ({"minibatches": 2}, "minibatches is 1, not 2"),
        ({"inner_steps": 0}, "inner-steps must be at least 1"),
        ({"inner_rate": 0.0}, "inner.rate"),
        ({"representation": "deepmdp"}, "representation=plain"),
    ],
)
def test_what_does_not_adapt_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        agent("maml", **settings)


def test_devices_that_would_share_a_seeds_worlds_are_refused_before_a_run(monkeypatch):
    mesh = SimpleNamespace(shape={"seeds": 2, "envs": 1}, size=2)
    config = from_keywords(Walk(), tiny("maml"), {}, plan={})
    monkeypatch.setattr(meshes, "mesh_for", lambda *_: mesh)
    check(config.checked())
    mesh.shape = {"seeds": 1, "envs": 2}
    with pytest.raises(InputError, match="2 devices would share them; use no more devices than seeds"):
        check(config.checked())


def test_drawn_tasks_are_refused_before_a_folder_is_made(tmp_path):
    with pytest.raises(InputError, match="trials draw tasks"):
        mtjax.train("hidden-bandit", "maml", directory=tmp_path / "run")
    assert not list(tmp_path.iterdir())


# Learning.


@dataclasses.dataclass(frozen=True)
class Arms(Probe):
    """One pull of two arms: the first pays where the scale is positive, else the second."""

    scales: tuple[float, ...] = (1.0, -1.0)

    @property
    def spec(self) -> Spec:
        return SPEC

    def tasks(self, split="train"):
        return tasks_of(self.kind, self.scales, 1)

    def reset(self, task, key):
        return Step(World(jnp.zeros(2), jnp.int32(0)), jnp.zeros(2), jnp.float32(0), jnp.bool_(False))

    def step(self, task, state, action):
        pays = jnp.float32((action == 0) == (task.goal["scale"] > 0))
        return Step(World(state.obs, state.age + 1), state.obs, pays, jnp.bool_(True))


@pytest.mark.slow
def test_it_learns_from_pulls_to_be_ready_for_either_arm():
    """From one that prefers an arm, it finds the indifferent start, which earns sigmoid(1) after an inner step."""
    env, seeds = Arms(), jnp.zeros(1, jnp.uint32)
    made, _ = armed(inner_rate=2.0, actor_lr=0.02)
    settings = loop.Settings(num_envs=256, chunk_steps=2 * 120, stagger=False)
    state = loop.init(env, made, settings, env.tasks(), seeds)
    lean = jax.tree.map(lambda x: x[None], leaning(only_seed(state.agent), 1.5))
    state, _ = loop.run_chunk(env, made, settings, env.tasks(), state._replace(agent=lean))

    unseen = Arms(scales=(0.9, -0.9)).tasks()
    unseen = unseen._replace(id=unseen.id + 2)
    for tasks in (env.tasks(), unseen):
        states = [adapted(env, made, 256, count, state.agent, tasks, seeds, jnp.int32(0)) for count in (0, 1)]
        first, second = (chances(made, only_seed(learner)) for learner, _ in states)
        right = lambda chance: float(chance[0, 0] + chance[1, 1]) / 2
        assert np.abs(first - 0.5).max() < 0.1 and right(first) == pytest.approx(0.5)
        assert right(second) == pytest.approx(float(jax.nn.sigmoid(1.0)), abs=0.05)
        earned = evaluate(env, made, Episodes(4), *states[1], seeds, jnp.int32(0)).returns
        np.testing.assert_array_equal(earned, 1)  # by the likelier arm


@dataclasses.dataclass(frozen=True)
class Aims(Probe):
    """One step from -1 or 1 that earns -(action - scale obs)^2, of scales that no observation tells."""

    kind: str = "by-both"
    scales: tuple[float, ...] = (-0.8, -0.4, 0.4, 0.8)

    def tasks(self, split="train"):
        return tasks_of(self.kind, self.scales, self.episode_length)


@pytest.mark.nightly
def test_a_network_learns_to_adapt_to_tasks_it_has_not_met():
    """The best for all tasks at once earns -0.4 in those of training, and -0.36 in those between them."""
    made, seeds = agent("maml", hidden=(16, 16), unroll=1, epochs=1, actor_lr=3e-3, entropy_cost=0.01), jnp.uint32([0])
    state, _ = train(Aims(), made, {"num_envs": 64, "chunk_steps": 600})

    def earned(scales, known, updates):
        env = Aims(scales=scales)
        tasks = env.tasks()._replace(id=jnp.arange(len(scales), dtype=jnp.int32) + 4 * (not known))
        given = adapted(env, made, 64, updates, state.agent, tasks, seeds, jnp.int32(0))
        return float(jnp.mean(evaluate(env, made, Episodes(8), *given, seeds, jnp.int32(0)).returns))

    for scales, known, blind in ((Aims.scales, True, -0.4), ((-0.6, 0.6), False, -0.36)):
        before, after = (earned(scales, known, updates) for updates in (0, 1))
        assert before == pytest.approx(blind, abs=0.1) and after > -0.2
