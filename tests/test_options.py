"""Options: the three gradients against a chain's exact ones, targets by a plain loop, and worlds that are learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, assessed, one_in, only_seed, pick, quick, tasks_of, tiny, train
from test_ppo import KNOWN, LEARN, SCALES
from test_sketches import Corridor

import mtjax
from mtjax.agents import critics, for_action
from mtjax.agents.fit import learned
from mtjax.agents.options import NONE, Batch, Running, Taken, ending, for_actions, option_logits
from mtjax.agents.state import of_task
from mtjax.envs.probes import Probe
from mtjax.experience.rollouts import windows
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.types import Discrete, InputError, Spec, Transition

STATES, ACTIONS, OPTIONS, GAMMA, COST = 3, 2, 2, 0.9, 0.07
SPEC = Spec.vector(STATES, ACTIONS, 1)._replace(action=Discrete(ACTIONS))
TASKS = tasks_of("one-step", (1.0, -0.5))
EYE = jnp.eye(STATES)
LEARNS = {"learned": ("actor", "termination", "over_options"), "stop": ("actor", "over_options")}


def made(spec=SPEC, **settings):
    usual = {"num_options": OPTIONS, "gamma": GAMMA, "normalize_observations": False, "deliberation_cost": COST}
    return for_action(tiny("options", **usual | settings), spec.action)


def begun(agent, spec=SPEC, seed=0):
    """A state whose policies, terminations and values are far from uniform."""
    state = jax.jit(lambda: agent.init(spec, TASKS, jax.random.key(seed)), compiler_options=QUICK)()
    random = np.random.default_rng(seed)
    noise = lambda x: x + jnp.float32(random.normal(size=x.shape)) * 0.5
    return state.with_nets(
        **{name: jax.tree.map(noise, state.nets[name]) for name in (*LEARNS[agent.endings], "critic")}
    )


# The three gradients, exactly.


@dataclasses.dataclass(frozen=True)
class Chain:
    """A process of three states, without an end: its chances (S, A, S), rewards (S, A) and first states (S,)."""

    chances: np.ndarray
    rewards: np.ndarray
    first: np.ndarray

    @staticmethod
    def drawn(seed=0):
        random = np.random.default_rng(seed)
        chances = random.dirichlet(np.ones(STATES), size=(STATES, ACTIONS))
        return Chain(chances, random.normal(size=(STATES, ACTIONS)), random.dirichlet(np.ones(STATES)))


def tables(agent, nets):
    """The probabilities of actions (S, K, A), of ends (S, K) and of options (S, K) in every state."""
    features = jnp.float32([1.0])
    number = lambda o: jnp.full(STATES, o)
    outputs = [for_actions(agent, nets, EYE, number(o)) for o in range(OPTIONS)]
    ends = [ending(agent, nets, features, EYE, number(o)) for o in range(OPTIONS)]
    over = jax.nn.softmax(option_logits(agent, nets, features, EYE))
    return jax.nn.softmax(jnp.stack(outputs, axis=1)), jnp.stack(ends, axis=1), over


def solved(chain, pi, ends, over, cost=COST):
    """Q (S, K), V (S,) and U (S, K) by one system of linear equations."""
    earned = jnp.einsum("soa,sa->so", pi, chain.rewards).ravel()
    moves = jnp.einsum("soa,sat->sot", pi, chain.chances)
    goes_on = (1 - ends)[:, :, None] * jnp.eye(OPTIONS) + ends[:, :, None] * over[:, None]  # (S, before, now)
    steps = jnp.einsum("sot,ton->sotn", moves, goes_on).reshape(STATES * OPTIONS, -1)
    paid = jnp.einsum("sot,to->so", moves, ends).ravel() * cost
    q = jnp.linalg.solve(jnp.eye(STATES * OPTIONS) - GAMMA * steps, earned - GAMMA * paid).reshape(STATES, OPTIONS)
    v = jnp.sum(over * q, axis=1)
    return q, v, (1 - ends) * q + ends * (v[:, None] - cost), steps


def expected_batch(chain, pi, ends, over):
    """Every step that there is, as often as it is expected, discounted: a batch of advantages times these weights."""
    q, v, u, steps = (np.asarray(x) for x in solved(chain, pi, ends, over))
    begun = (chain.first[:, None] * over).ravel()
    visits = np.linalg.solve(np.eye(len(begun)) - GAMMA * np.asarray(steps).T, begun).reshape(STATES, OPTIONS)
    arrivals = GAMMA * np.einsum("so,soa,sat->to", visits, pi, chain.chances)
    choices = chain.first + np.sum(arrivals * ends, axis=1)
    rows = []
    for s in range(STATES):
        for o in range(OPTIONS):
            for a in range(ACTIONS):
                advantage = chain.rewards[s, a] + GAMMA * chain.chances[s, a] @ u[:, o] - q[s, o]
                rows.append((s, a, NONE, o, False, visits[s, o] * pi[s, o, a] * advantage, 0.0, 0.0))
            rows.append((s, 0, o, o, False, 0.0, 0.0, arrivals[s, o] * (q[s, o] - v[s] + COST)))
            rows.append((s, 0, NONE, o, True, 0.0, choices[s] * over[s, o] * (q[s, o] - v[s]), 0.0))
    s, a, before, option, chosen, *weighed = (np.array(x) for x in zip(*rows, strict=True))
    advantage, choice, end = (jnp.float32(len(rows) * x) for x in weighed)
    pi, over, zeros = jnp.log(pi), jnp.log(over), jnp.zeros(len(rows))
    return Batch(
        obs=EYE[s],
        taken=Taken(
            raw=jnp.int32(a),
            log_prob=pi[s, option, a],
            before=jnp.int32(before),
            now=Running(jnp.int32(option), jnp.ones(len(option))),
            chosen=jnp.asarray(chosen),
            option_log_prob=over[s, option],
        ),
        advantage=advantage,
        choice_advantage=choice,
        end_loss=end,
        value=zeros,
        target=zeros,
        features=jnp.float32([1.0]),
        mask=None,
    )


@pytest.mark.slow
@pytest.mark.parametrize("endings, seed", [("learned", 0), ("learned", 1), ("stop", 0)])
def test_the_actors_loss_has_the_gradient_of_the_return_exactly(endings, seed):
    """Of sub-policies, what ends them and the policy over options, with a cost: by a chain's linear equations."""
    agent, chain = made(entropy_cost=0.0, choice_entropy_cost=0.0, endings=endings), Chain.drawn(seed)
    nets = of_task(begun(agent, seed=seed).nets, 0)
    of_learned = lambda learns: nets | learns
    earned = lambda learns: chain.first @ solved(chain, *tables(agent, of_learned(learns)))[1]
    learns = {name: nets[name] for name in LEARNS[endings]}
    batch = expected_batch(chain, *tables(agent, nets))
    loss = lambda learns: agent.actor_loss(of_learned(learns), batch, jax.random.key(0))[0]
    exact, found = (jax.jit(jax.grad(f), compiler_options=QUICK)(learns) for f in (earned, loss))
    for name in learns:
        for ours, theirs in zip(jax.tree.leaves(found[name]), jax.tree.leaves(exact[name]), strict=True):
            assert np.any(np.abs(theirs) > 1e-4)
            np.testing.assert_allclose(-ours, theirs, rtol=2e-3, atol=2e-5)


@pytest.mark.slow
def test_a_step_moves_the_option_that_took_it_and_the_one_that_ended_alone():
    """Exactly 0 for others; and a choice that was not made moves no policy over options."""
    agent = made(entropy_cost=0.0)
    nets = of_task(begun(agent).nets, 0)
    chain = Chain.drawn()
    batch = pick(expected_batch(chain, *tables(agent, nets)), np.array([0]))
    took = lambda batch, **given: batch._replace(taken=batch.taken._replace(**given))
    batch = took(batch, before=jnp.int32([1]))._replace(end_loss=jnp.ones(1), choice_advantage=jnp.ones(1))
    loss = lambda nets, batch: agent.actor_loss(nets, batch, jax.random.key(0))[0]
    grad = jax.jit(jax.grad(loss, allow_int=True), compiler_options=QUICK)
    found = grad(nets, batch)
    assert batch.taken.now.option[0] == 0 and not batch.taken.chosen[0]
    for name, option in (("actor", 0), ("termination", 1)):
        for leaf in jax.tree.leaves(found[name].shared):
            assert not np.any(leaf[1 - option])
        assert np.any(found[name].shared["head"]["bias"][option])
    assert not any(np.any(x) for x in jax.tree.leaves(found["over_options"]))
    none = grad(nets, took(batch, before=jnp.int32([NONE])))
    assert not any(np.any(x) for x in jax.tree.leaves(none["termination"]))
    chose = grad(nets, took(batch, chosen=jnp.ones(1, bool)))
    assert any(np.any(x) for x in jax.tree.leaves(chose["over_options"]))


# Targets.


def rollout(agent, state, length=4, envs=2, seed=0):
    """A rollout (T, H, E, ...) in which all is random, but each step's option goes on from the one before."""
    random, shape = np.random.default_rng(seed), (2, length, envs)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    whole = lambda n: jnp.int32(random.integers(n, size=shape))
    now = Running(whole(OPTIONS), jnp.ones(shape))
    taken = Taken(whole(ACTIONS), normal() - 1, whole(OPTIONS), now, jnp.asarray(random.random(shape) < 0.5), normal())
    closed = jnp.asarray(random.random(shape) < 0.3)
    begun = agent.begin(state, pick(TASKS, 0))
    memory = jax.tree.map(lambda x: jnp.broadcast_to(x, (*shape, *x.shape)), begun)
    return Transition(
        normal(STATES), taken.raw, normal(), jnp.float32(random.random(shape) < 0.8), normal(STATES),
        closed, closed, closed, None, taken, memory,
    )  # fmt: skip


@pytest.mark.parametrize("how", one_in(2, ["none", "task"]))
def test_targets_are_those_of_a_plain_loop(how):
    """One task, world and step at a time, by the equations."""
    agent = made(gae_lambda=0.7, advantage_normalization=how, value_normalization="none")
    state = begun(agent)
    steps = rollout(agent, state)
    _, after = quick(agent.assess, state, steps, TASKS)(state, steps, TASKS)
    found = after.extras
    wanted = {name: np.zeros(steps.reward.shape) for name in ("advantage", "choice", "end", "target")}
    for i in (0, 1):
        nets, features = of_task(state.nets, i), TASKS.context[i]
        q_of = lambda x, nets=nets, z=features: np.asarray(agent.output(nets, z, x), np.float64)
        over_of = lambda x, nets=nets, z=features: np.asarray(
            jax.nn.softmax(option_logits(agent, nets, z, x)), np.float64
        )
        q, next_q, over, next_over = q_of(steps.obs[i]), q_of(steps.next_obs[i]), over_of(steps.obs[i]), None
        next_over, option = over_of(steps.next_obs[i]), np.asarray(steps.extras.now.option[i])
        ends = np.asarray(ending(agent, nets, features, steps.next_obs[i], steps.extras.now.option[i]))
        for e in (0, 1):
            later = 0.0
            for t in reversed(range(4)):
                o, b = option[t, e], int(steps.extras.before[i, t, e])
                upon = (1 - ends[t, e]) * next_q[t, e, o]
                upon += ends[t, e] * (next_over[t, e] @ next_q[t, e] - COST)
                delta = steps.reward[i, t, e] + GAMMA * steps.discount[i, t, e] * upon - q[t, e, o]
                later = float(delta + GAMMA * 0.7 * (1 - steps.closed[i, t, e]) * later)
                v = over[t, e] @ q[t, e]
                wanted["advantage"][i, t, e], wanted["target"][i, t, e] = later, later + q[t, e, o]
                wanted["choice"][i, t, e], wanted["end"][i, t, e] = later + q[t, e, o] - v, q[t, e, b] - v + COST
    std = wanted["advantage"].std((1, 2), keepdims=True) if how == "task" else 1.0
    mean = wanted["advantage"].mean((1, 2), keepdims=True) if how == "task" else 0.0
    close = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4)
    close(found.target, wanted["target"])
    close(found.advantage, (wanted["advantage"] - mean) / std)
    close(found.choice_advantage, wanted["choice"] / std)
    close(found.end_loss, wanted["end"] / std)


@pytest.mark.slow
def test_the_batch_is_what_was_stored():
    agent = made()
    state = begun(agent)
    _, batch, steps = assessed(agent, state, rollout(agent, state), TASKS)
    flat = jax.tree.map(lambda x: x[:, :, 0], windows(steps, 0))
    np.testing.assert_array_equal(batch.taken.now.option, flat.extras.taken.now.option)
    np.testing.assert_array_equal(batch.taken.before, flat.extras.taken.before)
    np.testing.assert_array_equal(batch.advantage, flat.extras.advantage)


# Acting.


@pytest.mark.slow
def test_an_option_runs_on_until_it_ends_and_ratios_are_one():
    """With a key it is kept where it did not end; what is stored is the log-probability of what was drawn."""
    agent = made(end_bias=0.0)
    state, task = begun(agent), pick(TASKS, 0)
    nets, obs = of_task(state.nets, 0), EYE[1]
    pi, _, over = tables(agent, nets)
    memory = agent.begin(state, task)
    act = jax.jit(lambda memory, key: agent.act(state, memory, obs, task, key), compiler_options=QUICK)
    first = act(memory, jax.random.key(0)).extras
    assert first.before == NONE and first.chosen
    kept = 0
    for seed in range(60):
        memory = memory._replace(running=Running(jnp.int32(seed % 2), jnp.float32(1)))
        acted = act(memory, jax.random.key(seed))
        taken = acted.extras
        option = int(taken.now.option)
        assert bool(taken.chosen) or option == seed % 2
        kept += not taken.chosen
        assert float(taken.log_prob) == pytest.approx(float(jnp.log(pi[1, option, acted.action])), abs=1e-5)
        assert float(taken.option_log_prob) == pytest.approx(float(jnp.log(over[1, option])), abs=1e-5)
    assert 5 < kept < 55


@pytest.mark.slow
def test_stop_ends_an_option_and_the_other_outputs_say_what_it_does():
    """By hand: with outputs ln 1, ln 2 and ln 3 it ends with 3 in 6, and draws 1 to 2; without action 0, 3 in 5."""
    agent = made(endings="stop")
    state, task = begun(agent), pick(TASKS, 0)
    head = {"kernel": jnp.zeros((OPTIONS, 16, 3)), "bias": jnp.log(jnp.float32([[1, 2, 3], [1, 1, 2]]))}
    actor = state.nets["actor"]
    state = state.with_nets(actor=actor._replace(shared=actor.shared | {"head": head}))
    found = learned(agent.fits.values())
    assert "termination" not in state.nets and found == ("critic", "representation", "actor", "knowing", "over_options")
    nets, before = of_task(state.nets, 0), jnp.int32([0, 1, 0])
    np.testing.assert_allclose(ending(agent, nets, TASKS.context[0], EYE, before), [0.5, 0.5, 0.5], rtol=1e-6)
    masked = ending(agent, nets, TASKS.context[0], EYE, before, jnp.float32([0, 1]))
    np.testing.assert_allclose(masked, [3 / 5, 2 / 3, 3 / 5], rtol=1e-6)
    memory = agent.begin(state, task)._replace(running=Running(jnp.int32(0), jnp.float32(1)))
    act = jax.jit(lambda key: agent.act(state, memory, EYE[0], task, key), compiler_options=QUICK)
    found = [act(jax.random.key(seed)) for seed in range(200)]
    kept = [x for x in found if not x.extras.chosen]
    assert 70 < len(kept) < 130 and all(x.extras.now == (0, 0.5) for x in kept)
    np.testing.assert_allclose(np.exp(kept[0].outputs), [1, 2], rtol=1e-6)
    for acted in kept:
        assert float(acted.extras.log_prob) == pytest.approx(np.log([1 / 3, 2 / 3][int(acted.action)]), abs=1e-5)


def test_options_begin_to_end_by_stop_as_often_as_by_terminations():
    agent = made(endings="stop", end_bias=-1.0)
    state = jax.jit(lambda: agent.init(SPEC, TASKS, jax.random.key(0)), compiler_options=QUICK)()
    ends = ending(agent, of_task(state.nets, 0), TASKS.context[0], EYE, jnp.int32([0, 1, 0]))
    np.testing.assert_allclose(ends, jax.nn.sigmoid(-1.0), atol=0.01)


@pytest.mark.parametrize("bias, length", one_in(3, [(-2.0, 6), (0.1, 1), (-1.0, 3)]))
def test_without_a_key_an_option_lasts_as_long_as_it_would_with_probability_one_half(bias, length):
    """(1 - sigmoid(bias))^n falls below one half at the n-th step: there the next is chosen."""
    agent = made(end_bias=bias)
    state = jax.jit(lambda: agent.init(SPEC, TASKS, jax.random.key(0)), compiler_options=QUICK)()
    state = state.with_nets(termination=jax.tree.map(jnp.zeros_like, state.nets["termination"]))
    head = state.nets["termination"].shared
    head = head | {"head": head["head"] | {"bias": jnp.full((OPTIONS, 1), bias)}}
    state = state.with_nets(termination=state.nets["termination"]._replace(shared=head))
    task = pick(TASKS, 0)
    memory, chosen = agent.begin(state, task), []
    act = jax.jit(lambda memory: agent.act(state, memory, EYE[0], task, None), compiler_options=QUICK)
    for _ in range(9):
        taken = act(memory).extras
        chosen.append(bool(taken.chosen))
        memory = memory._replace(running=taken.now)
    assert [i for i, x in enumerate(chosen) if x] == list(range(0, 9, length))


def test_a_memory_outside_of_rollouts_follows_the_likeliest_option():
    agent = made()
    state, task = begun(agent), pick(TASKS, 0)
    step = Transition(EYE[0], jnp.int32(1), jnp.float32(0), jnp.float32(1), EYE[1], jnp.bool_(False), jnp.bool_(False))
    memory = agent.begin(state, task)
    expected = agent.act(state, memory, EYE[0], task, None).extras.now
    found = agent.remember(state, memory, step, task).running
    assert found.option == expected.option != NONE and found.lasts == expected.lasts


# Learning.


CORRIDOR = Corridor(vary={"goal": "l,r"}, held_out=(), split="none", sketched=False)
GIVEN = {"num_envs": 32, "unroll": 16, "minibatches": 4, "epochs": 4, "chunk_steps": 320}
FAST = {"gamma": 0.95, "actor_lr": 3e-3, "critic_lr": 3e-3}


def returns(agent, state):
    tasks = CORRIDOR.tasks()
    play = lambda state: evaluate(CORRIDOR, agent, Episodes(20), state, tasks, jnp.arange(1), jnp.int32(0))
    return np.asarray(jax.jit(play, compiler_options=QUICK)(state).returns)[0].mean(axis=1)


@pytest.mark.slow
def test_two_tasks_are_learned_and_a_cost_makes_options_last():
    """Sub-policies do not see the task: each needs the other option. With a cost an option ends more rarely."""
    ends = {}
    for cost in (0.0, 0.02):
        agent = made(CORRIDOR.spec, deliberation_cost=cost, **FAST)
        state, history = train(CORRIDOR, agent, GIVEN, chunks=3)
        assert np.all(returns(agent, state.agent) > 0.95)
        ends[cost] = float(history[-1]["option_ends"].mean())
    assert ends[0.02] < 0.05 < 0.1 < ends[0.0]


@pytest.mark.slow
@pytest.mark.parametrize("endings", LEARNS)
def test_options_that_are_kept_stay_as_they_are(endings):
    """Bit for bit, while the policy over them and the critic learn."""
    small = {**GIVEN, "num_envs": 4, "unroll": 8, "minibatches": 2, "epochs": 1, "chunk_steps": 8}
    agent = made(CORRIDOR.spec, keep_options=True, endings=endings)
    assert learned(agent.fits.values()) == ("critic", "representation", "knowing", "over_options")
    start, after = (only_seed(train(CORRIDOR, agent, small, chunks=n)[0].agent.nets) for n in (0, 1))
    moved = lambda name: any(
        np.any(x != y) for x, y in zip(*(jax.tree.leaves(nets[name]) for nets in (start, after)), strict=True)
    )
    *kept, choice = LEARNS[endings]
    assert not any(map(moved, kept)) and moved(choice) and moved("critic")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["by-observation", "delayed", "endless"])
def test_probes_have_their_known_values_under_every_option(kind):
    """Of every task, by Gaussian sub-policies: which option runs changes no reward there, and ends cost nothing."""
    settings = {"hidden": (32,), "num_options": 2, "deliberation_cost": 0.0, "end_bias": 0.0}
    agent = tiny("options", **settings, choice_entropy_cost=0.1)  # so that both run, as what never runs is not learned
    state, _ = train(Probe(kind), agent, LEARN)
    state, tasks = only_seed(state.agent), Probe(kind).tasks()
    expected, obs, tolerance = KNOWN[kind]
    seen = jax.vmap(lambda x: agent.view.see(state.nets["inputs"], x[None]))(jnp.float32(obs))
    found = critics.values(agent, state, tasks.context, jnp.broadcast_to(seen, (2, *seen.shape)))
    for i, scale in enumerate(SCALES):
        wanted = np.array([expected(scale, x) for x in obs])[:, None]
        np.testing.assert_allclose(found[i], np.broadcast_to(wanted, found[i].shape), atol=2 * tolerance)


@pytest.mark.parametrize(
    "given, said",
    [
        ({"num_options": 0}, "num-options must be at least 1"),
        ({"deliberation_cost": -0.1}, "deliberation-cost must be at least 0"),
        ({"representation": "deepmdp"}, "use representation=plain"),
        ({"encoder": "care"}, "options do not see the task, by which this encoder works"),
        ({"encoder": "input-map"}, "and another encoder"),
        ({"endings": "never"}, "unknown endings 'never'"),
    ],
)
def test_what_makes_no_sense_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        mtjax.agent("options", **given)


def test_stop_is_no_choice_beside_continuous_actions():
    with pytest.raises(InputError, match="use endings=learned"):
        mtjax.agent("options", endings="stop").init(Spec.vector(3, 2, 1), TASKS, jax.random.key(0))
