"""Which loss moves which parameters, for every agent: all that should learn does, and nothing else moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import OFF_POLICY, learner, pick, random_batch, slow_but, tasks_of, tiny, with_nets
from probes import act as act_once

from mtjax.agents.parts.encoders.care import Mixture
from mtjax.types import Spec

SPEC, BATCH = Spec.vector(3, 2, 1), 4
PICTURE = {"pixels": jax.ShapeDtypeStruct((16, 16, 1), jnp.uint8)}
SEEN = SPEC._replace(obs=PICTURE, frames=2)
BESIDE = SEEN._replace(obs=PICTURE | {"state": SPEC.obs})
SCALES = (1.0, -0.5, 0.3)
TASKS = tasks_of("one-step", SCALES)

TRUNK = {"shared/body/MLP_0", "shared/head"}
OWN = {"own/body", "own/head"}
CARE = {f"shared/body/{part}" for part in ("context", "context_out", "experts", "trunk")} | {"shared/head"}
BRONET = {f"shared/body/{kind}_{i}" for kind in ("Dense", "LayerNorm") for i in range(3)}
HYPERSPHERE = {f"shared/body/{kind}_{i}" for kind, count in (("UnitDense", 4), ("Scaler", 4)) for i in range(count)}
BATCH_NORM = {f"shared/body/{part}" for part in ("BatchNorm_0", "BatchNorm_1", "UnitDense_0", "task_0")}
MODELS = {"shared/transition", "shared/reward"}
both = lambda parts: {"actor": parts, "critic": parts}
knows = lambda part: {"knowing": {part}, "slow knowing": {part}}
TRUNKS = both(TRUNK)
ENCODED = {"representation": {"shared/latent"}, "slow representation": {"shared/latent"}}
LATENT = ENCODED | {"representation": {"shared/latent"} | MODELS}
REBUILT = ENCODED | {"representation": {"shared/latent", "shared/decoder"}}
SEES = {"actor": TRUNK | {"shared/sight"}, "critic": TRUNK}
# An encoder that is its own target has no slow copy.
once = lambda parts: parts | {"slow representation": parts["slow representation"] - {"shared/latent"}}
also = lambda part, parts: {who: of_it | {part} for who, of_it in parts.items()}
WHOLE_CARE = CARE | {"shared/body/after"}
body = lambda *parts: {f"shared/body/{part}" for part in parts} | {"shared/head"}
# The parts of actor and critics, or of every network, that losses must move. Slow critics have those of critics.
PARTS = {
    "sac": ("sac", {}, TRUNK),
    "sac-conditioned": ("sac-conditioned", {}, TRUNK),
    "sac-embedding": ("sac-conditioned", {"conditioning": "embedding"}, TRUNKS | knows("own/embedding")),
    "sac-inferred": ("sac", {"conditioning": "inferred", "inferred_from": 2}, TRUNKS | knows("shared/trajectory")),
    "sac-input-map": ("sac-conditioned", {"encoder": "input-map"}, TRUNK | {"own/front"}),
    "sac-hypernetwork": ("sac-conditioned", {"encoder": "hypernetwork"}, body("hypernetwork", "code", "trunk")),
    "multi-head": ("multi-head", {}, {"shared/body/MLP_0", "own/head"}),
    "disjoint": ("disjoint", {}, OWN),
    "distral": ("distral", {}, {"actor": OWN | {"shared/distilled"}, "critic": OWN}),
    "care": ("care", {}, WHOLE_CARE),
    "care-mtrl": ("care", {"variant": "mtrl"}, CARE | {"shared/body/gate", "shared/body/gate_out"}),
    "moe": ("moe", {}, body("experts", "gate", "trunk")),
    "moe-ensemble": ("moe", {"mode": "ensemble"}, body("experts", "trunk")),
    "film": ("film", {}, body("generator", "modulation", "trunk")),
    "film-scalar": ("film", {"film": "scalar"}, body("generator", "modulation", "trunk")),
    "moore": ("moore", {}, {"shared/body/experts", "shared/body/weights", "own/head"}),
    "attentive": ("attentive", {}, body("subnetworks", "attention", "scores")),
    "soft-modularization": (
        "soft-modularization",
        {"num_layers": 3},
        body("base_out", "modules_0", "modules_1", "routing", "task"),
    ),
    "paco": ("paco", {}, body("trunk", "weights")),
    "brc": ("brc", {"value": "hl-gauss"}, both(BRONET | {"shared/head"}) | knows("own/embedding")),
    "simba-v2": ("simba-v2", {"value": "hl-gauss"}, HYPERSPHERE | {"shared/head"}),
    "xqc": ("xqc", {"value": "hl-gauss"}, BATCH_NORM | {"shared/head", "own/batch_stats"}),
    "drq": ("drq", {"n_step": 1}, TRUNKS | once(ENCODED)),
    "drq-pictures": ("drq", {"n_step": 1}, SEES | once(also("shared/projection", ENCODED))),
    "asymmetric": ("drq", {"n_step": 1, "representation": "asymmetric"}, SEES),
    "sac-ae": ("sac-ae", {}, TRUNKS | REBUILT),
    "sac-ae-pictures": ("sac-ae", {}, SEES | also("shared/projection", REBUILT)),
    "deepmdp": ("deepmdp", {}, TRUNKS | LATENT),
    "hip-bmdp": ("hip-bmdp", {}, TRUNKS | also("own/embedding", LATENT)),
    "care-deepmdp": ("care", {"representation": "deepmdp"}, {"actor": WHOLE_CARE, "critic": WHOLE_CARE} | LATENT),
    "pcgrad": ("pcgrad", {}, TRUNK),
    "cagrad": ("cagrad", {}, TRUNK),
    "gradnorm": ("gradnorm", {}, TRUNK),
    "famo": ("famo", {}, TRUNK),
}
SPECS = {"drq-pictures": SEEN, "asymmetric": BESIDE, "sac-ae-pictures": SEEN}  # what agents see, if not vectors
QUICK = ["sac", "care"]
EVERY_AGENT = pytest.mark.parametrize("case", slow_but(PARTS, *QUICK, nightly=True))


def start(case, seed=0):
    """The agent's state and its compiled update."""
    name, settings, _ = PARTS[case]
    init, update = learner(tiny(name, **settings), TASKS, BATCH, SPECS.get(case, SPEC))
    return init(TASKS, jax.random.key(seed)), update


def batch_of(case, seed):
    """A random batch of what the agent sees."""
    name, settings, _ = PARTS[case]
    return random_batch(seed, 3, BATCH, SPECS.get(case, SPEC), tiny(name, **settings).view.history)


def leaves_of(params):
    """Arrays by path, with flax's own level left out."""
    found = jax.tree_util.tree_leaves_with_path(params)
    name = lambda path: "/".join(str(getattr(p, "key", getattr(p, "name", p))) for p in path)
    return {name(path).replace("/params/", "/"): np.asarray(leaf) for path, leaf in found}


def parts_of(case, network):
    """What a network is made of."""
    parts = PARTS[case][2]
    parts = parts if isinstance(parts, dict) else both(parts)
    return {"slow critic": parts["critic"], **parts}.get(network, set())


def slices(network, path, leaf):
    """A leaf by all that owns a part of it: tasks, then critics, then experts."""
    axes = path.startswith("own/") + network.endswith("critic") + ("/experts/" in path)
    return leaf.reshape(-1, *leaf.shape[axes:]) if axes else leaf[None]


def with_slow(state):
    """All networks by name, also the slow ones."""
    return state.nets | {f"slow {name}": net for name, net in state.slow.items()}


def test_every_agent_is_in_the_table():
    """An agent that joins ``OFF_POLICY`` must say here what its losses move."""
    assert {name for name, _, _ in PARTS.values()} == set(OFF_POLICY)


TRAINED = ("actor", "critic", "representation", "knowing")


@EVERY_AGENT
@pytest.mark.slow
def test_everything_that_should_learn_does(case):
    """After ten updates no leaf is where it began: no task's, no critic's and no expert's part of it."""
    before, update = start(case)
    after = before
    for i in range(10):
        after, _ = update(after, batch_of(case, i), TASKS, jax.random.key(i))
    for network in (*TRAINED, *(f"slow {name}" for name in TRAINED[1:])):
        old, new = (leaves_of(with_slow(state)[network]) for state in (before, after))
        deep = lambda path: path.startswith("shared/body/")
        assert {"/".join(path.split("/")[: 3 if deep(path) else 2]) for path in old} == parts_of(case, network)
        for path in old:
            parts = (slices(network, path, leaves[path]) for leaves in (old, new))
            for i, (a, b) in enumerate(zip(*parts, strict=True)):
                assert not np.array_equal(a, b), f"{network} {path}[{i}] stayed"
    temperatures = [state.nets["temperature"].parts["log"] for state in (before, after)]
    assert np.all(temperatures[0] != temperatures[1])


# With discount 0 the critic's target is the reward. What each input must leave alone, bit for bit, and what it moves.
FLOW = {
    "actor": (("critic", "target"), ("temperature",)),
    "critic": (("temperature",), ("actor",)),
    "target": (("actor", "critic", "temperature"), ()),
    "temperature": (("critic", "target"), ("actor",)),
    "reward": (("temperature",), ("actor", "critic", "target")),
}


# Where the actor stands on what critics train, all that moves this moves the policy's entropy; and what the
# slow encoder sees is what models predict. BRC scales rewards by what entropy pays. XQC's critics are normalised over
# the policy's next actions too.
_ON_ENCODED = {"critic": ((), ("actor",)), "reward": ((), ("actor", "critic", "target"))}
_ON_LATENT = {"critic": ((), ("actor",)), "target": ((), ("critic",)), "reward": ((), ("actor", "critic", "target"))}
FLOW_OF = {
    **dict.fromkeys(("drq", "sac-ae", "drq-pictures", "sac-ae-pictures"), _ON_ENCODED),
    **dict.fromkeys(("sac-embedding", "sac-inferred"), _ON_ENCODED),
    **dict.fromkeys(("deepmdp", "hip-bmdp", "care-deepmdp"), _ON_LATENT),
    "brc": _ON_ENCODED | {"temperature": ((), ("actor",))},
    "xqc": {"actor": ((), ("critic", "target", "temperature"))},
}


def networks(state, part):
    """The networks that a loss trains, or all slow ones; the critics' loss trains more than critics."""
    trained = TRAINED[1:] if part == "critic" else (part,)
    return state.slow if part == "target" else {name: state.nets[name] for name in trained}


def learned(state, part):
    """Parameters, and what their optimiser remembers of gradients: Adam's first step alone is little but a sign."""
    return networks(state, part), state.fits[part].optimizer if part in state.fits else ()


def nudged(state, part):
    """A state with other parameters."""
    other = nudge(networks(state, part))
    return state._replace(slow=other) if part == "target" else with_nets(state, **other)


def nudge(tree):
    """Other numbers of the same size; by NumPy, as JAX would compile a program for every shape."""
    return jax.tree.map(lambda x: np.asarray(x) * np.float32(1.5) + np.float32(0.05), tree)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@EVERY_AGENT
def test_losses_reach_their_own_parameters_alone(case):
    """Change one input of an update: if a loss leaked into foreign parameters, these would move too."""
    state, update = start(case)
    batch, key = batch_of(case, 0)._replace(discount=jnp.zeros((3, BATCH))), jax.random.key(1)
    plain, _ = update(state, batch, TASKS, key)
    for changed, (untouched, moved) in {**FLOW, **FLOW_OF.get(case, {})}.items():
        if changed == "reward":
            after, _ = update(state, batch._replace(reward=nudge(batch.reward)), TASKS, key)
        else:
            after, _ = update(nudged(state, changed), batch, TASKS, key)
        for part in untouched:
            assert same(learned(after, part), learned(plain, part)), f"{changed} reached {part}"
        for part in moved:
            assert not same(learned(after, part), learned(plain, part)), f"{changed} did not reach {part}"


def tau_of(agent, part):
    """How fast the slow copy of a part follows."""
    own = ("body", "head") if agent.representation.models else ("body", "head", "projection")
    return agent.tau if part in own else getattr(agent.representation, "encoder_tau", agent.tau)


@EVERY_AGENT
def test_the_slow_critic_is_what_bootstraps(case):
    """With discount 1 it moves the critic; its own step is a share of the new critic and nothing else."""
    state, update = start(case)
    batch, key = batch_of(case, 0)._replace(discount=jnp.ones((3, BATCH))), jax.random.key(1)
    changed = nudged(state, "target")
    plain, other = (update(x, batch, TASKS, key)[0] for x in (state, changed))
    assert not same(networks(plain, "critic"), networks(other, "critic"))
    name, settings, _ = PARTS[case]
    agent = tiny(name, **settings)
    old, new, found = (leaves_of(x) for x in (changed.slow, other.nets, other.slow))
    assert old.keys() == found.keys()
    for path in old:  # models of the future have no slow copy
        tau = tau_of(agent, path.split("/")[2])
        np.testing.assert_allclose((1 - tau) * old[path] + tau * new[path], found[path], rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_critics_that_see_the_state_see_no_picture():
    """And the actor sees no state: it reaches the actor through the critics' values only."""
    state, update = start("asymmetric")
    batch, key = batch_of("asymmetric", 0)._replace(discount=jnp.zeros((3, BATCH))), jax.random.key(1)
    see = lambda name: batch._replace(obs=batch.obs | {name: batch_of("asymmetric", 1).obs[name]})
    plain, other_picture, other_state = (update(state, x, TASKS, key)[0] for x in (batch, see("pixels"), see("state")))
    assert same(learned(plain, "critic"), learned(other_picture, "critic"))
    assert not same(learned(plain, "actor"), learned(other_picture, "actor"))
    assert not same(learned(plain, "critic"), learned(other_state, "critic"))
    assert not same(learned(plain, "actor"), learned(other_state, "actor"))
    agent = tiny("drq", **PARTS["asymmetric"][1])
    task, obs = pick(TASKS, 0), pick(batch.obs, (0, 0))
    alone = {"pixels": obs["pixels"]}
    np.testing.assert_array_equal(act_once(agent, state, alone, task, None), act_once(agent, state, obs, task, None))


# What CARE detaches.

OBS = jnp.float32(np.random.default_rng(0).normal(size=(4, 3)))
FEATURES = jnp.float32([0.3, -0.7])


def mixture(variant, unit_attention=False):
    module = Mixture(3, (6, 4), variant, 2.0, unit_attention, (7,), layer_norm=False)
    params = jax.eval_shape(module.init, jax.random.key(0), OBS, FEATURES)
    random = np.random.default_rng(1)
    return module, jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), params)


def size_of_slope(function, params):
    """The largest absolute slope of a scalar function by part of the network."""
    slopes = jax.jit(jax.grad(function))(params)["params"]
    return {part: max(float(jnp.abs(x).max()) for x in jax.tree.leaves(tree)) for part, tree in slopes.items()}


@pytest.mark.parametrize("variant", ["paper", "mtrl"])
def test_attention_teaches_the_context_encoder_in_mtrl_alone(variant):
    """In the paper's variant scores move the experts; in MTRL's they move the gate and, through it, the context."""
    module, params = mixture(variant)

    def attention(params):
        _, seen = module.apply(params, OBS, FEATURES, mutable="intermediates")
        (weights,) = seen["intermediates"]["attention"]
        np.testing.assert_equal(weights.shape, (3, 4))
        return jnp.sum(weights[0] ** 2)

    slope = size_of_slope(attention, params)
    moved = {part for part, size in slope.items() if size > 0}
    assert moved == ({"experts"} if variant == "paper" else {"context", "context_out", "gate", "gate_out"})


@pytest.mark.parametrize("unit_attention", [False, True])
def test_attention_compares_each_encoding_with_the_context(unit_attention):
    """By inner products, or by cosines, which bound the scores by 1 / temperature."""
    module, params = mixture("paper", unit_attention)
    _, seen = module.apply(params, OBS, FEATURES, mutable="intermediates")
    p = jax.tree.map(np.float64, params["params"])
    relu = lambda x: np.maximum(x, 0)
    context = relu(FEATURES @ p["context"]["Dense_0"]["kernel"] + p["context"]["Dense_0"]["bias"])
    context = context @ p["context_out"]["kernel"] + p["context_out"]["bias"]
    experts, scores = p["experts"], []
    for k in range(3):
        code = relu(OBS @ experts["kernel_0"][k] + experts["bias_0"][k]) @ experts["kernel_1"][k] + experts["bias_1"][k]
        size = np.linalg.norm(code, axis=-1) * np.linalg.norm(context, axis=-1) if unit_attention else 1
        scores.append(np.sum(code * context, axis=-1) / size / 2.0)
    weights = np.exp(scores - np.max(scores, axis=0))
    np.testing.assert_allclose(seen["intermediates"]["attention"][0], weights / weights.sum(axis=0), rtol=1e-4)


@pytest.mark.parametrize("variant", ["paper", "mtrl"])
def test_context_learns_through_the_trunk_in_the_paper(variant):
    """With the trunk's weights on the context cut, the paper's context encoder receives exactly nothing."""
    module, params = mixture(variant)
    kernel = params["params"]["trunk"]["Dense_0"]["kernel"]
    total = lambda params: jnp.sum(module.apply(params, OBS, FEATURES) ** 2)
    whole = size_of_slope(total, params)
    params["params"]["trunk"]["Dense_0"]["kernel"] = kernel.at[-4:].set(0.0)
    cut = size_of_slope(total, params)
    assert whole["context"] > 0 and whole["context_out"] > 0
    assert (cut["context"] == cut["context_out"] == 0) == (variant == "paper")
    assert cut["experts"] > 0


# Which parameters stand for a task.


def test_training_tasks_are_themselves_and_others_the_nearest():
    """By number if they were trained on, whatever their context; else by the distance of contexts."""
    state = start("multi-head")[0]
    known = state.known
    np.testing.assert_array_equal(jax.vmap(known)(TASKS), [0, 1, 2])
    moved = TASKS._replace(context=TASKS.context[::-1])
    np.testing.assert_array_equal(jax.vmap(known)(moved), [0, 1, 2])
    unseen = tasks_of("one-step", [0.9, 0.2, -3.0, 0.64, 0.66])
    unseen = unseen._replace(id=jnp.arange(3, 8, dtype=jnp.int32))
    np.testing.assert_array_equal(jax.vmap(known)(unseen), [0, 2, 1, 2, 0])


@pytest.mark.parametrize("case", ["multi-head", "sac-embedding", "sac-conditioned"])
def test_an_unseen_task_acts_as_its_nearest_or_by_its_own_parameters(case):
    """Head and embedding are borrowed; physical parameters are the task's own."""
    name, settings, _ = PARTS[case]
    agent, state = tiny(name, **settings), start(case)[0]
    unseen = pick(tasks_of("one-step", [0.2]), 0)._replace(id=jnp.int32(7))
    act = lambda task: np.asarray(act_once(agent, state, OBS[0], task, None))
    actions = np.stack([act(pick(TASKS, i)) for i in range(3)])
    assert len(np.unique(actions, axis=0)) == 3
    assert np.array_equal(act(unseen), actions[2]) == (case != "sac-conditioned")


def test_a_head_or_embedding_moves_the_action_of_its_task_alone():
    """The actor looks up the parameters of the task that it is asked about."""
    for case, net, part in (("multi-head", "actor", "head"), ("sac-embedding", "knowing", "embedding")):
        name, settings, _ = PARTS[case]
        agent, state = tiny(name, **settings), start(case)[0]
        own = jax.tree.map(lambda x: x.at[1].add(0.5), state.nets[net].own)
        assert set(own) == {part}
        changed = with_nets(state, **{net: state.nets[net]._replace(own=own)})
        acts = [
            np.stack([act_once(agent, s, OBS[0], pick(TASKS, i), None) for i in range(3)]) for s in (state, changed)
        ]
        np.testing.assert_array_equal(np.any(acts[0] != acts[1], axis=1), [False, True, False])
