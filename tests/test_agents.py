"""Every agent with every way to tell it the task: shapes, determinism, and what its settings do and refuse."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest
from probes import OFF_POLICY, learner, one_in, pick, quick, random_batch, random_past, tasks_of, tiny, with_nets
from probes import act as act_once

from mtjax.agents import AGENTS, agent, normalize
from mtjax.agents.networks import Params
from mtjax.agents.parts.encoders import ENCODERS
from mtjax.agents.parts.gradients.surgery import RULES
from mtjax.agents.parts.knowing import CONDITIONINGS
from mtjax.agents.parts.knowing.vectors import load_vectors
from mtjax.agents.parts.representations import REPRESENTATIONS
from mtjax.agents.parts.samplers import SAMPLERS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.values import VALUES
from mtjax.agents.view import init_inputs
from mtjax.learning.rollout import Worlds
from mtjax.learning.rollout import act as act_in_all
from mtjax.parallel.axes import over_learners
from mtjax.types import InputError, Spec

SPEC, BATCH, ENVS = Spec.vector(3, 2, 1)._replace(sentences=("Walk.", "Run.", "Hop.")), 4, 2
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)
SAC_METRICS = {"critic_loss", "value", "td_error", "actor_loss", "entropy", "temperature"}
CONFLICTS = {f"{who}_{what}" for who in ("actor", "critic") for what in ("cosine", "conflict", "gradient_norm")}
LENGTHS = {f"{who}_gradient_norm" for who in ("actor", "critic")}


def valid(name, **settings):
    """Whether the agent's parts go together so; refusals have tests of their own."""
    try:
        return bool(tiny(name, **settings, **({"vectors": "x"} if settings.get("conditioning") == "vectors" else {})))
    except InputError:
        return False


VALID = [
    (name, conditioning)
    for name in OFF_POLICY
    for conditioning in CONDITIONINGS
    if valid(name, conditioning=conditioning)
]
SURGERY = [("embedding" if name == "sac" else "parameters", name) for name in OFF_POLICY]


def some(cases, every):
    """Cases of which one in so many is quick and most others are nightly, less those that cannot be."""
    cases = [(name, settings) for name, settings in cases if valid(name, **settings)]
    return one_in(every, cases, nightly=True)


# Each tells tasks apart in its own way, and pcgrad must compose with every network that tasks share.
TRACED = [
    *some([(name, {"conditioning": conditioning}) for name, conditioning in VALID], 34),
    *some([(name, {"conditioning": conditioning, "gradients": "pcgrad"}) for conditioning, name in SURGERY], 31),
    *some([("sac-conditioned", {"gradients": rule}) for rule in RULES], 14),
    *some([("sac-conditioned", {"gradients": rule, "gradient_scope": "per-layer"}) for rule in RULES], 10),
    *some([("sac-conditioned", {"encoder": name}) for name in ENCODERS], 6),
    *some([(name, {"value": value}) for value in VALUES for name in ("sac-conditioned", "deepmdp")], 6),
    *some([("multi-head", {"scaling": scaling, "reset_every": 100}) for scaling in SCALINGS], 2),
    *some([("sac-conditioned", {"sampler": sampler}) for sampler in SAMPLERS], 2),
]
# Those that are also run, as compiling takes seconds: every agent, and every way to tell the task.
RUN = [(name, {}) for name in OFF_POLICY]
RUN += [("sac", {"conditioning": conditioning}) for conditioning in ("one-hot", "embedding", "vectors")]
RUN += [
    ("multi-head", {"gradients": "pcgrad", "conditioning": "embedding"}),
    ("care", {"variant": "mtrl"}),
    ("multi-head", {"scaling": "popart"}),
    ("sac-conditioned", {"value": "hl-gauss", "sampler": "temperature"}),
]


@pytest.fixture(scope="session")
def vectors(tmp_path_factory):
    """A file of task vectors (T, 5)."""
    file = tmp_path_factory.mktemp("vectors") / "tasks.npy"
    np.save(file, np.random.default_rng(0).normal(size=(3, 5)))
    return str(file)


def make(name, settings, vectors):
    extra = {"vectors": vectors} if settings.get("conditioning") == "vectors" else {}
    return tiny(name, **settings, **extra)


def observations(spec=SPEC):
    return jnp.float32(np.random.default_rng(1).normal(size=(3, ENVS, spec.obs_size)))


def act(agent, state, obs, keys):
    """Actions (T, E, A) under the maps over tasks and environments; no keys: the mean ones."""
    if keys is None:
        of_task = jax.vmap(lambda task, obs: act_once(agent, state, obs, task, None), (None, 0))
        return jax.vmap(of_task)(TASKS, obs)
    of_task = jax.vmap(lambda task, obs, key: act_once(agent, state, obs, task, key), (None, 0, 0))
    return jax.vmap(of_task)(TASKS, obs, keys)


def shapes(tree):
    return jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)


def label(x):
    return "-".join(map(str, x.values())) if isinstance(x, dict) else x


@pytest.mark.parametrize(("name", "settings"), TRACED, ids=label)
def test_every_combination_has_the_right_shapes(name, settings, vectors):
    """Traced, not run: an update keeps the state's shapes and types, and acting gives an action for each world."""
    agent = make(name, settings, vectors)
    state = jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY))
    batch = probes.with_memory(agent, random_batch(0, 3, BATCH, SPEC, agent.view.history))
    after, metrics = jax.eval_shape(lambda state: probes.update(agent, state, batch, TASKS, KEY), state)
    assert shapes(after) == shapes(state)
    conflicts = CONFLICTS if agent.gradients.needs == "gradients" else set()
    assert set(metrics) >= SAC_METRICS | conflicts
    assert all(metrics[k].shape == () for k in conflicts - LENGTHS)
    assert all(metrics[k].shape == (3,) for k in set(metrics) - (conflicts - LENGTHS))
    for keys in (None, jax.random.split(KEY, (3, ENVS))):
        actions = jax.eval_shape(lambda state, keys=keys: act(agent, state, observations(), keys), state)
        assert (actions.shape, actions.dtype) == ((3, ENVS, 2), jnp.float32)


@pytest.mark.parametrize(("name", "settings"), some(RUN, 36), ids=label)
def test_agents_act_and_learn(name, settings, vectors):
    """Finite, the same for the same keys and different for others; acting in a batch is acting one at a time."""
    agent, keys, obs = make(name, settings, vectors), jax.random.split(KEY, (3, ENVS)), observations()
    init, update = learner(agent, TASKS, BATCH, SPEC)
    state, batch = init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC)
    after, metrics = update(state, batch, TASKS, KEY)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((after, metrics)))
    assert all(metrics[k].shape == (3,) for k in SAC_METRICS)

    again, _ = update(init(TASKS, KEY), batch, TASKS, KEY)
    other, _ = update(state, batch, TASKS, jax.random.key(3))
    leaves = [jax.tree.leaves(x.nets["actor"]) for x in (after, again, other)]
    assert all(np.array_equal(a, b) for a, b in zip(leaves[0], leaves[1], strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(leaves[0], leaves[2], strict=True))

    noisy, mean = act(agent, after, obs, keys), act(agent, after, obs, None)
    assert noisy.shape == mean.shape == (3, ENVS, 2)
    assert np.all(np.abs(noisy) <= 1) and not np.allclose(noisy, mean)
    for t, e in ((0, 0), (1, 1), (2, 0)):
        np.testing.assert_allclose(
            act_once(agent, after, obs[t, e], pick(TASKS, t), keys[t, e]), noisy[t, e], atol=1e-5
        )
        np.testing.assert_allclose(act_once(agent, after, obs[t, e], pick(TASKS, t), None), mean[t, e], atol=1e-5)


MIXED = ("care", "moe", "hip-bmdp")


@pytest.mark.parametrize("name", [pytest.param(x, marks=[] if x in MIXED else pytest.mark.nightly) for x in OFF_POLICY])
@pytest.mark.slow
def test_a_world_among_many_is_that_world_alone(name):
    """Seeds x tasks x environments as an evaluation has them, on whatever device tests run: no row is another's."""
    agent, shape = tiny(name), (10, 8, 5)
    worlds = tasks_of("one-step", np.linspace(-1, 1, 8))
    init = lambda key: agent.init(SPEC, TASKS, key)
    states = quick(jax.vmap(init), jax.random.split(KEY, 10))(jax.random.split(KEY, 10))
    shake = lambda x: x + 0.2 * np.random.default_rng(0).normal(size=x.shape).astype(x.dtype) if x.dtype == "f" else x
    shaken = {name: jax.tree.map(shake, states.nets[name]) for name in ("actor", "critic", "representation")}
    states = with_nets(states, **shaken)
    obs = jnp.float32(np.random.default_rng(1).normal(size=(*shape, SPEC.obs_size)))
    places = jnp.stack(jnp.meshgrid(*map(jnp.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)

    def alone(states, obs):
        pick = lambda tree, i: jax.tree.map(lambda x: x[i], tree)
        one = lambda at: act_once(agent, pick(states, at[0]), obs[tuple(at)], pick(worlds, at[1]), None)
        return jax.lax.map(one, places).reshape(*shape, -1)

    def many(states, obs):
        memory = over_learners(lambda state, task, _: agent.begin(state, task))(states, worlds, obs)
        return act_in_all(agent, states, worlds, Worlds((), None, obs, memory, obs), None).action

    together, apart = (quick(f, states, obs)(states, obs) for f in (many, alone))
    assert np.ptp(np.asarray(apart), axis=(0, 2)).min() > 0.01
    np.testing.assert_allclose(together, apart, atol=1e-5 if jax.default_backend() == "cpu" else 0.02)


@pytest.mark.parametrize("conditioning", [x for x in CONDITIONINGS if x != "text"])
def test_what_the_networks_see_of_a_task(conditioning, vectors):
    """Features (Z,) of the second task."""
    agent = make("sac", {"conditioning": conditioning}, vectors)
    given = {"given": load_vectors(vectors, 3)} if conditioning == "vectors" else {}
    known = Params({"known": TASKS.context, **given}, {})
    state = with_nets(jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY)), tasks=known)
    expected = {"one-hot": [0, 1, 0], "parameters": [-0.5], "vectors": np.load(vectors)[1]}.get(conditioning, [])
    np.testing.assert_allclose(agent.view.features(state, pick(TASKS, 1)), np.float32(expected))


def test_the_context_limit_shows_a_task_beyond_the_range_as_its_end():
    """Acting and learning; a limit of 0 is none."""
    beyond = pick(TASKS, 1)._replace(context=jnp.array([1.7]))
    drawn = random_batch(0, 3, 4, SPEC)._replace(context=jnp.full((3, 4, 1), -1.7))
    for limit, expected in ((0.0, 1.7), (1.0, 1.0)):
        agent = tiny("sac", conditioning="parameters", context_limit=limit)
        shapes = jax.eval_shape(lambda agent=agent: agent.init(SPEC, TASKS, KEY))
        state = with_nets(shapes, tasks=Params({"known": TASKS.context}, {}))
        np.testing.assert_allclose(agent.view.features(state, beyond), [expected], rtol=1e-6)
        np.testing.assert_allclose(agent.view.features_of_all(state, drawn, TASKS), -expected, rtol=1e-6)


@pytest.mark.slow
def test_an_agent_that_is_told_nothing_acts_alike_in_all_tasks():
    """And one that is told does not."""
    obs = jnp.ones((3, 1, 3))
    for name in ("sac", "sac-conditioned"):
        state = learner(tiny(name), TASKS, BATCH, SPEC)[0](TASKS, KEY)
        actions = act(tiny(name), state, obs, None)[:, 0]
        assert (len(np.unique(np.asarray(actions), axis=0)) == 1) == (name == "sac")


@pytest.mark.slow
def test_observations_are_normalised_by_what_was_collected():
    """Each step counts once, and neither acting nor updates change the moments."""
    agent = tiny("sac", normalize_observations=True)
    init, update = learner(agent, TASKS, BATCH, SPEC)
    state, batch = init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC)
    batch = batch._replace(obs=batch.obs * 3 + 10, next_obs=batch.next_obs - 1000)
    after = probes.observe(agent, state, batch, TASKS)
    begun, moments = (x.nets["inputs"].shared["moments"] for x in (state, after))
    assert (begun.count, moments.count) == (0, 3 * BATCH)
    np.testing.assert_allclose(moments.mean, batch.obs.mean(axis=(0, 1)), rtol=1e-5)
    obs = observations()
    scaled = normalize.apply(moments, obs)
    np.testing.assert_allclose(act(agent, after, obs, None), act(tiny("sac"), after, scaled, None), atol=1e-6)
    assert not np.allclose(act(agent, after, obs, None), act(agent, after, scaled, None), atol=1e-3)

    # An update learns from observations and next observations scaled by these moments.
    learned, metrics = update(after, batch, TASKS, KEY)
    jax.tree.map(np.testing.assert_array_equal, learned.nets["inputs"], after.nets["inputs"])
    plain_update = learner(tiny("sac"), TASKS, BATCH, SPEC)[1]
    see = lambda x: normalize.apply(moments, x)
    _, expected = plain_update(state, batch._replace(obs=see(batch.obs), next_obs=see(batch.next_obs)), TASKS, KEY)
    np.testing.assert_allclose(metrics["critic_loss"], expected["critic_loss"], rtol=1e-3)
    np.testing.assert_allclose(metrics["actor_loss"], expected["actor_loss"], rtol=1e-3, atol=1e-4)


def test_every_method_says_what_differs_from_its_paper():
    """In the docstring of its class, which --help shows; what has no paper has nothing to say."""
    methods = {preset.cls for preset in AGENTS.values()}
    plain = ((REPRESENTATIONS, ("plain",)), (ENCODERS, ("identity", "mlp")), (SCALINGS, ("none",)))
    for table, own in (*plain, (VALUES, ("scalar",))):
        methods |= {cls for name, cls in table.items() if name not in own}
    assert not [cls.__name__ for cls in methods if "Differs from" not in (vars(cls)["__doc__"] or "")]


@pytest.mark.parametrize("name", ["sac", "ppo"])
def test_what_lies_far_from_what_was_learned_is_clipped(name):
    """What the networks see of observations and of the past, in acting and in learning; nothing if not normalised."""
    agent = tiny(name, normalize_observations=True, conditioning="inferred", inferred_from=2)
    inputs = agent.view.count(init_inputs(SPEC, 3), random_batch(0, 3, BATCH, SPEC).obs)
    obs, past = jnp.full((3, BATCH, 3), 1e3), random_past(np.random.default_rng(0), (3, BATCH, 2), SPEC)
    past = past._replace(obs=jnp.full_like(past.obs, -1e3))
    for see in (agent.view.see, agent.view.see_all):
        seen = see(inputs, obs, past)
        assert np.all(seen.obs == 10) and np.all(seen.past.obs == -10)
    plain = tiny(name, normalize_observations=False, conditioning="inferred", inferred_from=2).view.see(
        inputs, obs, past
    )
    assert np.all(plain.obs == 1e3) and np.all(plain.past.obs == -1e3)


def test_without_normalisation_moments_stay_empty():
    """Nothing is fitted that nobody asked for."""
    init, update = learner(tiny("sac"), TASKS, BATCH, SPEC)
    after, _ = update(init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC), TASKS, KEY)
    assert after.nets["inputs"].shared["moments"].count == 0


@pytest.mark.slow
def test_gradients_are_clipped_to_their_norm():
    """Actor's and critics' each by its own global norm, and not at all by default; the direction stays."""
    batch, recorded = random_batch(0, 3, BATCH, SPEC), {}
    for limit in (0.0, 0.01):
        init, update = learner(tiny("sac", max_gradient_norm=limit), TASKS, BATCH, SPEC)
        after, _ = update(init(TASKS, KEY), batch, TASKS, KEY)
        mean = lambda fit: optax.tree_utils.tree_get(fit.optimizer, "mu")  # a tenth, after one step
        flat = {name: jax.flatten_util.ravel_pytree(mean(fit))[0] for name, fit in after.fits.items()}
        recorded[limit] = {name: 10 * x for name, x in flat.items()}
    assert set(recorded[0.0]) == {"actor", "critic", "temperature"}
    for name, free in recorded[0.0].items():
        clipped = recorded[0.01][name]
        norm = np.linalg.norm(free)
        assert norm > 0.02
        if name != "temperature":
            np.testing.assert_allclose(np.linalg.norm(clipped), 0.01, rtol=1e-3)
            assert free @ clipped > 0.9 * norm * 0.01
        else:
            assert np.linalg.norm(clipped) > 0.02


def test_critics_and_heads_begin_apart():
    """Critics that began alike would stay alike, and their least would be no safeguard."""
    state = learner(tiny("multi-head"), TASKS, BATCH, SPEC)[0](TASKS, KEY)
    critic = state.nets["critic"]
    kernel = critic.own["head"]["kernel"]
    assert isinstance(critic, Params) and kernel.shape == (3, 2, 16, 1)
    flat = np.asarray(kernel).reshape(6, 16)
    assert len(np.unique(flat, axis=0)) == 6


@pytest.mark.parametrize(
    ("name", "settings"), [("sac", {}), ("ppo", {}), ("distral", {}), ("brc", {"num_bins": 5}), ("multi-head", {})]
)
def test_actor_and_critics_may_have_widths_of_their_own(name, settings):
    """Each as an agent of that common width has it."""

    def shapes(**widths):
        state = jax.eval_shape(lambda: tiny(name, **settings, **widths).init(SPEC, TASKS, KEY))
        return jax.tree.map(jnp.shape, (state.nets["actor"], state.nets["critic"]))

    (wide, narrow) = shapes(hidden=(6, 6)), shapes(hidden=(4,))
    assert shapes(hidden=(6, 6), actor_hidden=(4,)) == (narrow[0], wide[1])
    assert shapes(hidden=(6, 6), critic_hidden=(4,)) == (wide[0], narrow[1])
    assert shapes(hidden=(5,), actor_hidden=(4,), critic_hidden=(6, 6)) == (narrow[0], wide[1])


# Files of task vectors.


def test_vectors_are_read_in_the_order_of_tasks(vectors):
    """As float32, whatever the file's type."""
    found = load_vectors(vectors, 3)
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(found, np.float32(np.load(vectors)))


def write(path, kind):
    """Write a file that is no table of three rows."""
    array = {
        "two rows": np.ones((2, 5)),
        "one axis": np.ones(3),
        "three axes": np.ones((3, 2, 2)),
        "not a number": np.array([[1.0], [np.nan], [2.0]]),
        "objects": np.array([[{}], [{}], [{}]]),
        "words": np.array([["a"], ["b"], ["c"]]),
    }.get(kind)
    if array is not None:
        np.save(path, array)
    elif kind == "archive":
        with open(path, "wb") as file:
            np.savez(file, np.ones((3, 5)))
    elif kind != "missing":
        path.write_text({"text": "not an array", "empty": ""}[kind])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "cannot read task vectors from .*No such file"),
        ("text", "cannot read task vectors from"),
        ("objects", "cannot read task vectors from"),
        ("empty", "cannot read task vectors from"),
        ("two rows", r"must hold 3 finite rows.*\(2, 5\)"),
        ("one axis", r"must hold 3 finite rows.*\(3,\)"),
        ("three axes", r"must hold 3 finite rows.*\(3, 2, 2\)"),
        ("not a number", "must hold 3 finite rows"),
        ("words", "vectors.npy"),
        ("archive", "vectors.npy"),
    ],
)
def test_files_that_hold_no_vectors_are_refused(kind, message, tmp_path):
    """With the file's name, and what is wrong with it."""
    path = tmp_path / "vectors.npy"
    write(path, kind)
    with pytest.raises(InputError, match=message) as raised:
        load_vectors(str(path), 3)
    assert "vectors.npy" in str(raised.value)


# Settings that make no sense.

REFUSED = [
    ("sac", {"conditioning": "onehot"}, r"unknown conditioning 'onehot'; did you mean 'one-hot'\?"),
    ("sac", {"heads": "own"}, "unknown heads 'own'; .*shared, per-task"),
    ("sac", {"gradients": "pc-grad"}, "unknown gradients 'pc-grad'; did you mean 'pcgrad'"),
    ("sac", {"tune": "head"}, "unknown tune 'head'; did you mean 'heads'"),
    ("sac", {"hiden": (8,)}, "unknown setting of sac 'hiden'; did you mean 'hidden'"),
    ("sac", {"actor_lr": 0.0}, "actor-lr must be greater than 0, not 0.0"),
    ("sac", {"critic_lr": -1.0}, "critic-lr must be greater than 0, not -1.0"),
    ("sac", {"temperature_lr": float("nan")}, "temperature-lr must be a finite number, not nan"),
    ("sac", {"initial_temperature": 0.0}, "initial-temperature must be greater than 0"),
    ("sac", {"num_critics": 0}, "num-critics must be greater than 0, not 0"),
    ("sac", {"hidden": ()}, r"hidden needs at least one layer .*not \(\)"),
    ("sac", {"encoder": "mlp", "encoder_widths": ()}, r"encoder-widths needs at least one layer .*not \(\)"),
    ("sac", {"hidden": (8, 0)}, r"at least one unit, not \(8, 0\)"),
    ("sac", {"critic_hidden": (8, 0)}, r"critic-hidden must be of at least one unit each, not \(8, 0\)"),
    ("sac", {"encoder": "simba", "actor_hidden": (8, 4)}, r"hidden=\(8, 4\) has several"),
    ("sac", {"gamma": 1.1}, r"gamma must be in \[0, 1\], not 1.1"),
    ("sac", {"tau": 0.0}, r"tau must be in \(0, 1\], not 0.0"),
    ("sac", {"tau": float("nan")}, "tau must be a finite number, not nan"),
    ("sac", {"max_gradient_norm": -1.0}, "max-gradient-norm"),
    ("sac", {"conditioning": "embedding", "embedding_size": 0}, "embedding-size"),
    ("sac", {"conditioning": "vectors"}, "conditioning=vectors and vectors=FILE.npy go together"),
    ("sac", {"vectors": "x.npy"}, "unknown setting of sac 'vectors'; it belongs to conditioning='vectors'"),
    ("sac", {"context_limit": 1.0}, "unknown setting of sac 'context_limit'; it belongs to conditioning='parameters'"),
    ("sac", {"temperature_momentum": 1.0}, r"temperature-momentum must be in \[0, 1\), not 1.0"),
    ("care", {"conditioning": "none"}, "conditioning cannot be none; use parameters"),
    ("care", {"variant": "papers"}, "unknown variant 'papers'; did you mean 'paper'"),
    ("care", {"num_experts": 0}, "at least one expert"),
    ("care", {"expert_widths": ()}, "at least one layer"),
    ("cares", {}, "unknown agent 'cares'; did you mean 'care'.*in all"),
]


@pytest.mark.parametrize(("name", "settings", "message"), REFUSED)
def test_settings_that_make_no_sense_are_refused(name, settings, message):
    """Before anything compiles, with what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        agent(name, **settings)


@pytest.mark.parametrize("name", AGENTS)
def test_agents_are_static_under_jit(name):
    """Two agents with the same settings are one program."""
    assert hash(tiny(name)) == hash(tiny(name)) and tiny(name) == tiny(name)
    assert tiny(name) != tiny(name, weight_decay=0.5)
