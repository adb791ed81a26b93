"""Stacks of pictures: in rollouts, in the replay and in agents. ``envs/probes.py`` has a probe that is seen."""

import dataclasses
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest

import mtjax
import mtjax.evaluate
from mtjax import frames
from mtjax.agents.networks import Params
from mtjax.agents.parts import vision
from mtjax.agents.parts.representations.encoded import Encoded
from mtjax.agents.state import axes_of
from mtjax.config import with_preset
from mtjax.envs.probes import Pictured, Probe
from mtjax.experience import Rollouts, pictures
from mtjax.experience.replay import joined
from mtjax.training.launch import check
from mtjax.types import InputError, Transition

KEY = jax.random.key(0)
SIDE = 3


def picture(number):
    """A picture whose pixels tell which step of which episode it is."""
    return np.full((SIDE, SIDE, 2), divmod(number, 256), np.uint8)


class Episodes:
    """Steps of one environment as a plain list: pictures seen before and after each, and how episodes ended."""

    def __init__(self, lengths, terminates):
        self.steps, number = [], 0
        for length, terminated in zip(lengths, terminates, strict=True):
            seen = [picture(number := number + 1)]
            for age in range(length):
                seen.append(picture(number := number + 1))
                last = age == length - 1
                self.steps.append((list(seen[:-1]), seen[-1], last, last and terminated, len(self.steps)))

    def stack(self, seen, count):
        return np.concatenate(([seen[0]] * count + seen)[-count:], axis=-1)

    def rows(self):
        """The steps as a replay keeps them, leaves (L, ...)."""
        obs = np.stack([seen[-1] for seen, *_ in self.steps])
        ended, terminated = (np.array([step[i] for step in self.steps]) for i in (2, 3))
        reward = np.arange(1.0, len(self.steps) + 1, dtype=np.float32)
        return Transition({"pixels": obs}, reward[:, None], reward, 1 - np.float32(terminated), {}, *[ended] * 3)

    def expected(self, place, count, n_step, gamma):
        """The transition of a window whose ``place`` is in the middle: stack, reward, discount, stack after it."""
        cut = lambda step: step[2] and not step[3]
        place -= cut(self.steps[place])
        seen, total, factor = self.steps[place][0], 0.0, 1.0
        for i in range(n_step):
            step = self.steps[place + i]
            if i and cut(step):
                before = self.steps[place + i - 1]
                return self.stack(seen, count), total, factor / gamma, self.stack([*before[0], before[1]], count)
            total, factor = total + factor * (place + i + 1), factor * gamma
            if step[3]:
                return self.stack(seen, count), total, 0.0, None
        return self.stack(seen, count), total, factor / gamma, self.stack([*step[0], step[1]], count)


@pytest.mark.parametrize("n_step", (1, 3))
@pytest.mark.parametrize("count", (1, 3))
def test_windows_become_the_transitions_of_a_plain_list(count, n_step):
    """Of episodes of every length, which a limit cuts off or which terminate."""
    episodes = Episodes((5, 3, 4, 2, 6, 7), (False, True, False, True, True, False))
    rows, width, gamma = episodes.rows(), pictures.window(count, n_step), 0.9
    starts = np.arange(len(episodes.steps) - width + 1)
    windows = jax.tree.map(lambda x: np.stack([x[i : i + width] for i in starts]), rows)
    found = jax.jit(partial(pictures.join, frames=count, n_step=n_step))(windows, gamma)
    for i in starts:
        obs, reward, discount, after = episodes.expected(i + count, count, n_step, gamma)
        np.testing.assert_array_equal(found.obs["pixels"][i], obs)
        np.testing.assert_allclose([found.reward[i], found.discount[i]], [reward, discount], rtol=1e-6)
        if after is not None:
            np.testing.assert_array_equal(found.next_obs["pixels"][i], after)


@dataclasses.dataclass(frozen=True)
class SeenWalk(probes.Walk):
    """A walk whose picture tells the episode, which is one of 250, and its age."""

    @property
    def spec(self):
        return super().spec._replace(obs=jax.eval_shape(self.show, super().spec.obs), frames=3)

    def start(self, task, key):
        return jax.random.randint(key, (1,), 0, 250) / 256.0

    def show(self, obs):
        told = jnp.stack([obs[0] % 1 * 256, obs[0] // 1]).astype(jnp.uint8)
        return {"pixels": jnp.broadcast_to(told, (2, 2, 2)), "state": obs}

    def reset(self, task, key):
        step = super().reset(task, key)
        return step._replace(obs=self.show(step.obs))

    def step(self, task, state, action):
        step = super().step(task, state, action)
        return step._replace(obs=self.show(step.obs))


@dataclasses.dataclass(frozen=True)
class SightAuditor(probes.Stub):
    """Notes how far drawn transitions are from those of the walks that their states name."""

    n: int = 3

    def init(self, spec, tasks, key):
        return jnp.float32(0.5)  # its discount

    def unlike(self, obs, place):
        """How far the pictures of a stack (..., 2, 2, 6) are from those of the last steps up to a place (...)."""
        ages = jnp.maximum(place[..., None] // 1 - jnp.array([2, 1, 0]), 0)
        expected = jnp.stack([jnp.broadcast_to(place[..., None] % 1 * 256, ages.shape), ages], axis=-1)
        return jnp.max(jnp.abs(obs["pixels"].reshape(*place.shape, 4, 3, 2) - expected[..., None, :, :]), (-3, -2, -1))

    def update(self, state, window, tasks, key, number):
        batch = joined(window, jnp.broadcast_to(state, len(tasks.id)), self.experience.n_step)
        place, after = batch.obs["state"][..., 0], batch.next_obs["state"][..., 0]
        count = jnp.round(after - place)
        powers = jnp.where(jnp.arange(self.n) < count[..., None], state ** jnp.arange(self.n), 0)
        reward = jnp.sum(powers * (place[..., None] + jnp.arange(self.n)), axis=-1) * tasks.goal["scale"][:, None]
        terminated = (place % 1 < 0.5) & (after // 1 == 3)
        wrong = jnp.abs(batch.reward - reward) + (count > self.n) + (after >= 5)  # the last picture is lost
        wrong += jnp.abs(batch.discount - jnp.where(terminated, 0, state ** (count - 1)))
        wrong += self.unlike(batch.obs, place) + jnp.where(terminated, 0, self.unlike(batch.next_obs, after))
        return state, {"wrong": jnp.max(wrong, axis=1), "first": jnp.mean(place < 1, axis=1)}


@pytest.mark.parametrize("n_step", probes.one_in(2, [3, 1]))
def test_the_loop_draws_the_stacks_that_agents_have_seen(n_step):
    """Over two seeds, a ring that wraps around, and staggered episodes that terminate or are cut off."""
    settings = {"num_envs": 4, "batch_size": 32, "replay_size": 44, "warmup_steps": 7, "chunk_steps": 40}
    env, agent = SeenWalk(), SightAuditor(n=n_step)
    _, (metrics,) = probes.train(env, agent, {**settings, "n_step": n_step, "stagger": True}, seeds=(0, 1))
    np.testing.assert_allclose(metrics["wrong"], 0, atol=1e-4)
    assert np.all((metrics["first"] > 0.1) & (metrics["first"] < 0.5))


def test_a_replay_keeps_the_newest_picture_and_all_of_what_comes_beside():
    """No picture of what follows, which the next step holds."""
    stack, state = jnp.arange(6, dtype=jnp.uint8).reshape(1, 1, 6), jnp.ones(3)
    obs, after = {"pixels": stack, "state": state}, {"pixels": stack, "state": 2 * state}
    kept = pictures.compress(Transition(obs, state, state, state, after), 2)
    assert kept.obs["pixels"].tolist() == [[[4, 5]]] and set(kept.next_obs) == {"state"}
    np.testing.assert_array_equal((kept.obs["state"], kept.next_obs["state"]), (state, 2 * state))


def test_a_rollout_repeats_the_first_picture_and_then_moves_on():
    first = {"pixels": jnp.ones((2, 2, 1), jnp.uint8), "state": jnp.zeros(3)}
    then = {"pixels": 2 * jnp.ones((2, 2, 1), jnp.uint8), "state": jnp.ones(3)}
    seen = frames.begin(first, 3)
    np.testing.assert_array_equal(seen["pixels"][0, 0], [1, 1, 1])
    seen = frames.push(seen, then)
    np.testing.assert_array_equal(seen["pixels"][0, 0], [1, 1, 2])
    np.testing.assert_array_equal(seen["state"], np.ones(3))
    assert frames.push(jnp.zeros(2), jnp.ones(2)).tolist() == [1, 1]


def test_shifts_move_whole_pictures_by_whole_pixels():
    """Every shift up to 2 along both axes occurs, and its edge is repeated."""
    grid = np.arange(36, dtype=np.uint8).reshape(6, 6, 1)
    padded = np.pad(grid, ((2, 2), (2, 2), (0, 0)), mode="edge")
    allowed = {padded[y : y + 6, x : x + 6].tobytes() for y in range(5) for x in range(5)}
    found = np.asarray(vision.shifted(jnp.broadcast_to(grid, (20, 25, 6, 6, 1)), KEY, 2))
    assert {one.tobytes() for one in found.reshape(-1, 6, 6, 1)} == allowed


def test_pictures_before_and_after_a_step_are_shifted_on_their_own():
    """At the same time; what is seen beside them stays, and a shift of 0 changes nothing."""
    obs = {"pixels": jnp.broadcast_to(jnp.arange(36, dtype=jnp.uint8).reshape(6, 6, 1), (2, 20, 6, 6, 1))}
    obs["state"] = jnp.ones((2, 20, 3))
    batch = Transition(obs, jnp.zeros((2, 20, 1)), jnp.zeros((2, 20)), jnp.ones((2, 20)), obs)
    found = Encoded(shift=1).augment(batch, KEY)
    moved = [np.any(x["pixels"] != obs["pixels"], axis=(2, 3, 4)).mean() for x in (found.obs, found.next_obs)]
    assert min(moved) > 0.6  # 8 in 9 are to be expected
    assert np.any(found.obs["pixels"] != found.next_obs["pixels"], axis=(2, 3, 4)).mean() > 0.6
    np.testing.assert_array_equal(found.obs["state"], obs["state"])
    assert Encoded(shift=0).augment(batch, KEY) is batch


def test_brightness_becomes_a_number_around_zero():
    """For networks as it is, and for decoders as one of 32 levels with noise that fills each."""
    levels = jnp.broadcast_to(jnp.arange(256, dtype=jnp.uint8), (50, 256))
    np.testing.assert_allclose(vision.as_numbers(levels[0]), np.linspace(-0.5, 0.5, 256), atol=1e-6)
    found = (np.asarray(vision.coarse(levels, KEY)) + 0.5) * 32
    np.testing.assert_array_equal(np.floor(found), levels // 8)
    noise = found % 1
    assert noise.min() < 0.01 and noise.max() > 0.99 and noise.mean() == pytest.approx(0.5, abs=0.02)


def test_networks_have_the_sizes_of_their_papers():
    """DrQ: 35 x 35 x 32 features of 84 x 84 pixels. IMPALA: 11 x 11 x 32. PQN: 8 x 8 x 16 of 10 x 10 cells."""
    size = lambda network, side: features_of(network, jax.ShapeDtypeStruct((side, side, 9), jnp.uint8)).shape
    sides = {"drq": 84, "impala": 84, "grid": 10}
    assert {name: size(network, sides[name]) for name, network in vision.NETWORKS.items()} == {
        "drq": (35 * 35 * 32,),
        "impala": (11 * 11 * 32,),
        "grid": (8 * 8 * 16,),
    }


def features_of(name, seen):
    """Shapes of what a network makes of pictures."""
    return jax.eval_shape(lambda x: name().init_with_output(KEY, x)[0], seen)


@pytest.mark.parametrize("name", vision.NETWORKS)
def test_the_smallest_pictures_have_features(name):
    """And smaller ones are refused, as an encoder would see nothing; so is a vector without layers."""
    side, encoded = vision.LEAST[name], Encoded(vision=name)
    seen = lambda side: {"pixels": jax.ShapeDtypeStruct((side, side + 1, 3), jnp.uint8)}
    assert features_of(vision.NETWORKS[name], seen(side)["pixels"]).size > 0
    encoded.require(seen(side))
    with pytest.raises(
        InputError, match=rf"vision={name} takes pictures of at least {side} x {side}, not \({side - 1}"
    ):
        encoded.require(seen(side - 1))
    also = {"state": jax.ShapeDtypeStruct((2,), jnp.float32)}
    for other, beside in (("deepmdp", {}), ("hip-bmdp", {}), ("asymmetric", also)):
        representation = mtjax.agent("sac", representation=other, vision=name).representation
        representation.require(seen(side) | beside)
        with pytest.raises(InputError, match=rf"vision={name} takes pictures of at least {side}"):
            representation.require(seen(side - 1) | beside)
    Encoded(latent_widths=()).require(seen(15))
    with pytest.raises(InputError, match="latent-widths needs at least one layer"):
        Encoded(latent_widths=()).require(jnp.zeros(5))


def test_a_convolution_of_cells_is_normalised_over_its_filters():
    """By hand: filter k counts the middle cell k times, so that 16 numbers from 0 to 15 have variance 21.25."""
    network, seen = vision.NETWORKS["grid"](), np.zeros((3, 3, 2), np.uint8)
    params = network.init(KEY, seen)["params"]
    assert params["Conv_0"]["kernel"].shape == (3, 3, 2, 16)
    params["Conv_0"]["kernel"] = jnp.zeros((3, 3, 2, 16)).at[1, 1, 0].set(jnp.arange(16.0))
    np.testing.assert_array_equal(network.apply({"params": params}, seen), np.zeros(16))
    seen[1, 1] = 255
    expected = np.maximum((np.arange(16) - 7.5) / np.sqrt(21.25), 0)
    np.testing.assert_allclose(network.apply({"params": params}, seen), expected, atol=1e-5)


def test_residual_blocks_that_give_nothing_pass_on_what_they_got():
    seen = np.random.default_rng(0).integers(256, size=(16, 16, 2), dtype=np.uint8)
    network = vision.NETWORKS["impala"]()
    layers = network.init(KEY, seen)["params"]
    silent = {name: jax.tree.map(jnp.zeros_like, x) for name, x in layers.items() if int(name.split("_")[1]) % 5}
    assert len(silent) == 12
    assert np.ptp(network.apply({"params": layers | silent}, seen)) > 0


def test_a_projection_is_bounded_and_leaves_the_state_beside_it():
    """And it is the same for features of any scale, by its layer normalisation."""
    random = np.random.default_rng(0)
    obs = {"pixels": jnp.float32(random.normal(size=(7, 5))), "state": jnp.float32(random.normal(size=(7, 3)))}
    projection = vision.Projection(4)
    params = projection.init(KEY, obs)
    latent = projection.apply(params, obs)
    assert np.abs(latent[:, :4]).max() < 1
    np.testing.assert_array_equal(latent[:, 4:], obs["state"])
    scaled = projection.apply(params, obs | {"pixels": 100 * obs["pixels"]})
    np.testing.assert_allclose(scaled, latent, atol=1e-3)
    as_they_are = vision.Projection()
    np.testing.assert_array_equal(as_they_are.apply({}, obs), np.concatenate([obs["pixels"], obs["state"]], axis=1))


@pytest.mark.parametrize("name", vision.NETWORKS)
def test_networks_see_batches_as_single_pictures(name):
    random = np.random.default_rng(0).integers(256, size=(2, 3, 16, 16, 2), dtype=np.uint8)
    network = vision.NETWORKS[name]()
    params = network.init(KEY, random[0, 0])
    together = network.apply(params, random)
    assert together.shape[:2] == (2, 3) and np.ptp(together) > 0
    np.testing.assert_allclose(together[1, 2], network.apply(params, random[1, 2]), atol=1e-5)


def test_a_decoder_draws_pictures_of_the_size_that_it_saw():
    decoder = vision.Decoder(side=64, channels=9)
    latent = jnp.zeros((2, 50))
    assert decoder.apply(decoder.init(KEY, latent[0]), latent).shape == (2, 64, 64, 9)


def networks(state):
    """All that is learned but temperatures."""
    return {name: state.nets[name] for name in ("actor", "critic", "representation", "knowing")}


SMALL = dict(hidden=(32, 32), latent_widths=(16,), num_envs=2, batch_size=8, warmup_steps=10, replay_size=1000)
FAST = dict(actor_lr=3e-3, critic_lr=3e-3, initial_temperature=0.01, updates_per_step=1, chunk_steps=100)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drq", pytest.param("sac-ae", marks=pytest.mark.nightly)])
def test_agents_learn_what_only_pictures_show(name):
    """The best action is the task's scale times a sign that the picture shows: 0 reward, and about -1 without it."""
    agent = mtjax.agent(name, shift=1, n_step=1)
    result = mtjax.train(Pictured("by-both"), agent, steps=1600, eval_every=10**9, eval_episodes=1, **SMALL, **FAST)
    assert float(result.rows[-1]["return"]) > -0.15


BESIDE = Pictured("by-both", state="also")


@pytest.mark.slow
def test_an_actor_learns_from_pictures_under_critics_that_see_the_state():
    """Without seeing, the best mean return is -0.625."""
    agent = mtjax.agent("drq", representation="asymmetric", shift=1, n_step=1)
    _, history = probes.train(BESIDE, agent, SMALL | FAST, chunks=3)
    assert np.mean(history[-1]["return"]) > -0.15


ON_POLICY = dict(hidden=(32, 32), latent_widths=(16,), num_envs=16, unroll=4, minibatches=2, chunk_steps=40)
ON_POLICY |= dict(actor_lr=1.5e-3, critic_lr=1.5e-3, entropy_cost=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("representation", ["encoded", pytest.param("asymmetric", marks=pytest.mark.nightly)])
def test_ppo_learns_what_only_pictures_show(representation):
    """Without seeing, the best mean return is -0.625.

    One seed alone can be in a chunk in which it has unlearned: critics go on moving the encoder below the actor.
    """
    env = Pictured("by-both") if representation == "encoded" else BESIDE
    agent = mtjax.agent("ppo", representation=representation)
    state, history = probes.train(env, agent, ON_POLICY, seeds=range(4), chunks=4)
    assert np.mean([metrics["return"] for metrics in history[-2:]]) > -0.3
    nets = state.agent.nets
    assert ("latent" in nets["representation"].shared) == (representation == "encoded")
    assert "sight" in nets["actor"].shared


@pytest.mark.slow
@pytest.mark.parametrize("name", probes.slow_but(["drq", "deepmdp", "hip-bmdp"], "deepmdp"))
def test_what_follows_a_terminal_step_in_the_replay_changes_nothing(name):
    """It is the first picture of another episode. What follows other steps is what models predict."""
    spec, tasks = Pictured().spec, Pictured().tasks()
    agent = probes.tiny(name, n_step=1)
    init, update = probes.learner(agent, tasks, 6, spec)
    batch = probes.random_batch(0, len(tasks.id), 6, spec)
    batch = batch._replace(discount=jnp.tile(jnp.float32([1, 0, 1, 1, 0, 1]), (len(tasks.id), 1)))

    def learned(place):
        after = {"pixels": batch.next_obs["pixels"].at[:, place].add(77)}
        state, _ = update(init(tasks, KEY), batch._replace(next_obs=after), tasks, KEY)
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves((networks(state), state.slow))])

    as_it_is = learned(np.array([], int))
    np.testing.assert_array_equal(learned(np.array([1, 4])), as_it_is)
    assert not np.array_equal(learned(np.array([0])), as_it_is)


def test_rollouts_tell_what_their_pictures_take():
    """Two stacks of 2 x 16 x 16 bytes a step; vectors take so little that it is not told."""
    text = Rollouts(unroll=100).describe(Pictured(frames=2).spec, 10)
    assert "1,000 transitions" in text and "1 MB of pictures a task" in text
    assert "MB" not in Rollouts(unroll=100).describe(Probe().spec, 10)


RUN = dict(pixels=16, state="also", frames=2, engine="c", repeat=100, hidden=(8,), latent_widths=(4,), num_envs=2)
RUN |= dict(representation="asymmetric", batch_size=4, replay_size=100, warmup_steps=10, chunk_steps=10, n_step=1)


@pytest.mark.nightly
def test_a_policy_that_was_trained_beside_the_state_acts_by_pictures_alone(tmp_path, capsys):
    """A whole run: its checkpoint is loaded and evaluated."""
    folder = tmp_path / "run"
    plan = dict(eval_episodes=1, directory=folder, normalize_observations=True)
    mtjax.train("pendulum-swingup", "drq", steps=40, **plan, **RUN)
    policy = mtjax.load(folder)
    assert policy.agent == mtjax.agent("drq", **mtjax.agents.settings(policy.agent))
    task = jax.tree.map(lambda x: x[0], policy.env.tasks())
    stacks = mtjax.stacked(policy.env).reset(task, KEY).obs
    assert set(stacks) == {"pixels", "state"}
    alone = policy({"pixels": stacks["pixels"]}, task)
    np.testing.assert_array_equal(policy(stacks, task), alone)
    assert np.any(policy({"pixels": 255 - stacks["pixels"]}, task) != alone)
    with pytest.raises(InputError, match=r"shape .*16, 16, 6.* not .*16, 16, 3.*mtjax.stacked"):
        policy(policy.env.reset(task, KEY).obs, task)
    mtjax.evaluate.main([f"--run={folder}", "--episodes=1"])
    assert "train" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("env", "agent", "message"),
    [
        (Pictured(), mtjax.agent("sac"), "use agent='drq' or, with another agent, representation='encoded'"),
        (Pictured(), mtjax.agent("drq", representation="asymmetric"), "give pixels=64 state='also'"),
        (Probe(), mtjax.agent("ppo", representation="asymmetric"), "give pixels=64 state='also'"),
        (BESIDE, mtjax.agent("deepmdp"), "leave out state='also'"),
        (Pictured(), mtjax.agent("drq", conditioning="inferred"), "cannot be inferred from pictures"),
    ],
)
def test_observations_that_no_part_takes_are_refused(env, agent, message):
    with pytest.raises(InputError, match=message):
        mtjax.train(env, agent, steps=100)


@pytest.mark.parametrize("agent", ["drq", "sac-ae", mtjax.agent("drq")], ids=["drq", "sac-ae", "made"])
def test_agents_for_pictures_do_not_learn_from_states_in_silence(agent):
    """Refused with what to do. The encoder of states that is named there is allowed."""
    name = agent if isinstance(agent, str) else "drq"
    said = f"{name} learns from pictures, and pendulum-swingup shows none: give pixels=64, or for states use"
    with pytest.raises(InputError, match=said):
        mtjax.train("pendulum-swingup", agent, steps=100)
    check(with_preset("pendulum-swingup", "sac-conditioned", agent_settings={"representation": "encoded"}))


def test_a_run_is_refused_before_its_folder_is_made(tmp_path):
    with pytest.raises(InputError, match=r"give pixels=64 state='also'"):
        mtjax.train("pendulum-swingup", "drq", representation="asymmetric", directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_presets_of_a_part_do_not_apply_to_another():
    """And those of the agent and of other parts stay."""
    agent = mtjax.agent("drq", representation="asymmetric")
    assert (agent.experience.n_step, agent.tau) == (3, 0.01)
    agent = mtjax.agent("drq", encoder="film")
    assert (agent.experience.n_step, agent.representation.encoder_tau) == (3, 1.0)
    with pytest.raises(InputError, match="encoder_tau"):
        mtjax.agent("drq", representation="asymmetric", encoder_tau=0.5)


@pytest.mark.slow
def test_an_encoder_that_is_its_own_target_sees_the_next_pictures_once():
    """With a copy of it as the target encoder an update gives the same numbers by four convolutions more."""
    agent, family = probes.tiny("drq", n_step=1), Pictured()
    tasks = family.tasks()
    state, batch = agent.init(family.spec, tasks, KEY), probes.random_batch(0, len(tasks.id), 4, family.spec)
    latent = Params({"latent": state.nets["representation"].shared["latent"]}, {})
    copied = state._replace(slow=state.slow | {"representation": state.slow["representation"].filled(latent)})
    compiled = [
        jax.jit(partial(probes.update, agent)).lower(each, batch, tasks, KEY).compile() for each in (state, copied)
    ]
    once, twice = (len(re.findall(r" convolution\(|custom-call.*onvolution", each.as_text())) for each in compiled)
    assert twice == once + 4
    (after, _), (other, _) = compiled[0](state, batch, tasks, KEY), compiled[1](copied, batch, tasks, KEY)
    jax.tree.map(np.testing.assert_array_equal, networks(after), networks(other))


@pytest.mark.slow
def test_the_actor_learns_on_the_encoder_that_critics_had_before_their_step():
    """Its step is Adam's on the loss with the old encoder and the new critics, as in DrQ-v2; not with the new one."""
    agent, family = probes.tiny("drq", n_step=1, critic_lr=0.1), Pictured()
    tasks = family.tasks()
    state, batch = agent.init(family.spec, tasks, KEY), probes.random_batch(0, len(tasks.id), 4, family.spec)
    after, _ = jax.jit(partial(probes.update, agent))(state, batch, tasks, KEY)
    actor_key = jax.random.split(KEY, 4)[1]
    seen = probes.prepare(agent, state, agent.representation.augment(batch, jax.random.fold_in(KEY, 1)), tasks)

    @jax.jit
    def step(representation):
        nets, keys = after.nets | {"representation": representation}, jax.random.split(actor_key, len(tasks.id))
        losses = jax.vmap(agent.actor_loss, (axes_of(nets), 0, 0))
        mean = lambda actor: jnp.mean(losses(nets | actor, seen, keys)[0])
        actor, optimizer = {"actor": state.nets["actor"]}, agent.fits["actor"].optimizer
        steps, _ = optimizer.update(jax.grad(mean)(actor), state.fits["actor"].optimizer, actor)
        return optax.apply_updates(actor, steps)["actor"]

    gaps = lambda actor: jax.tree.map(lambda a, b: jnp.max(jnp.abs(a - b)), actor, after.nets["actor"])
    distance = lambda actor: max(map(float, jax.tree.leaves(gaps(actor))))
    old, new = state.nets["representation"], after.nets["representation"]
    assert distance(step(new.without(("latent",)).filled(old))) < 1e-6
    assert distance(step(new)) > 1e-4


def test_pictures_need_warm_up_steps_for_a_window():
    with pytest.raises(InputError, match="warmup-steps of at least 6"):
        mtjax.train(Pictured(), mtjax.agent("drq"), steps=100, warmup_steps=5)


def test_pictures_need_episodes_of_two_steps():
    """The picture after a step that a time limit cuts off is nowhere, so of single steps none could be drawn."""
    with pytest.raises(InputError, match=r"takes two steps; lower repeat"):
        mtjax.train("pendulum-swingup", "drq", pixels=16, repeat=1000, steps=20, num_envs=2, warmup_steps=10)


@pytest.mark.parametrize("name", probes.slow_but(probes.OFF_POLICY, "sac", "hip-bmdp"))
def test_every_agent_can_be_asymmetric(name):
    """Shapes alone: what one batch of pictures and states makes of a state is a state."""
    agent = probes.tiny(name, representation="asymmetric", n_step=1)
    spec, tasks = BESIDE.spec, BESIDE.tasks()
    batch = probes.random_batch(0, len(tasks.id), 4, spec)
    state = jax.eval_shape(lambda: agent.init(spec, tasks, KEY))
    after, _ = jax.eval_shape(lambda state: probes.update(agent, state, batch, tasks, KEY), state)
    assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)
    assert any("sight" in place or "sight" in place.get("distilled", ()) for place in state.nets["actor"])
    of_critics = (*state.nets["critic"], *state.nets["representation"])
    assert not any("sight" in place or "latent" in place for place in of_critics)
