"""What earlier tasks teach of a new one, in four ways from the literature, on decision processes of eight states.

python examples/identify.py [--seeds=10] [--out=identify.png]

Every task is one of four processes of the family ``tabular-mdp``, the classes; which one is not told. Twelve earlier
tasks, three of each class, are explored by random actions. Then each class comes as a new task for twenty episodes:

- elimination (Brunskill and Li 2013) clusters the earlier tasks, and tries what tells clusters apart until one is left;
- Thompson sampling over classes (Wilson et al. 2007, with known classes) plays a class drawn from its posterior;
- a start at the mean of earlier tables (Tanaka and Yamamura 2003) is where values begin, and the tables' standard
  deviation says which of them are backed up most;
- the group lasso (Calandriello et al. 2014) finds the features that no earlier task needed.

Beside each is the same learner without what earlier tasks taught. Regret is exact: the sum of what chosen actions lose
against the best policy of the task, by dynamic programming.

Axes: ``S`` states, ``A`` actions, ``C`` classes, ``T`` tasks, ``D`` features, ``H`` steps of an episode.
"""

import argparse
import dataclasses
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mtjax
from mtjax.report import figures, stats

STATES, ACTIONS, CLASSES, NOISE = 8, 4, 4, 20
EARLIER, EARLIER_EPISODES, EPISODES, HORIZON = 12, 20, 20, 100
DISCOUNT = 0.9  # of learners whose values do not know the time
Array = jax.Array


class Model(NamedTuple):
    """A Markov decision process, or several of them by leading axes."""

    rewards: Array  # (S, A) the probability of a reward of 1
    transitions: Array  # (S, A, S)


class Counts(NamedTuple):
    """What was seen of a process."""

    moves: Array  # (S, A, S)
    rewards: Array  # (S, A) their sum

    def add(self, seen: "Seen") -> "Counts":
        """Return the counts with one more step."""
        moves = self.moves.at[seen.cell, seen.action, seen.next_cell].add(1)
        return Counts(moves, self.rewards.at[seen.cell, seen.action].add(seen.reward))

    def model(self) -> Model:
        """Return the mean of a posterior with uniform priors (Laplace), in which nothing is impossible."""
        visits = self.moves.sum(-1)
        transitions = (self.moves + 1) / (visits + self.moves.shape[-1])[..., None]
        return Model((self.rewards + 1) / (visits + 2), transitions)


NOTHING = Counts(jnp.zeros((STATES, ACTIONS, STATES)), jnp.zeros((STATES, ACTIONS)))


class Seen(NamedTuple):
    """One step. Noise (M,) is seen beside the state, drawn anew each time, and means nothing."""

    cell: Array
    noise: Array
    action: Array
    reward: Array
    next_cell: Array
    next_noise: Array


def plan(model: Model, horizon: int, discount: float = 1.0) -> Array:
    """Return the values (H, S, A) of actions, with the best ones after them; row t has H - t steps left."""

    def back(values, _):
        values = model.rewards + discount * model.transitions @ jnp.max(values, axis=-1)
        return values, values

    return jax.lax.scan(back, jnp.zeros_like(model.rewards), length=horizon)[1][::-1]


# Elimination of known models (Brunskill and Li 2013).


class Pairs(NamedTuple):
    """Where two models (P,) each differ most in their rewards."""

    first: Array
    second: Array
    cell: Array
    action: Array
    gap: Array


def pairs_of(rewards: Array) -> Pairs:
    """Return all pairs of models with rewards (C, S, A), P = C (C - 1) / 2."""
    first, second = (jnp.asarray(index) for index in np.triu_indices(len(rewards), 1))
    gaps = jnp.abs(rewards[first] - rewards[second]).reshape(len(first), -1)
    cell, action = jnp.unravel_index(jnp.argmax(gaps, axis=1), rewards.shape[1:])
    return Pairs(first, second, cell, action, jnp.max(gaps, axis=1))


def visits_to_tell(gap: Array | float, models: int, error: float) -> Array:
    """Return how many visits tell two models apart: n = 2 ln(2 C / error) / gap^2, rounded up.

    By Hoeffding's inequality the mean of n rewards is off by gap / 2 with a probability of at most error / C. The true
    model is one of C - 1 pairs, so with n visits for each it is eliminated with a probability below ``error``.
    """
    return jnp.ceil(2 * jnp.log(2 * models / error) / jnp.square(gap))


def possible(rewards: Array, counts: Counts, error: float = 0.05) -> Array:
    """Return which models (C,) with rewards (C, S, A) are left: those that nothing seen rules out.

    Of two models the one that is farther from the mean reward goes, once their pair was visited often enough. A model
    goes at once where it says that what was seen cannot be.
    """
    pairs, visits = pairs_of(rewards), counts.moves.sum(-1)
    seen, paid = (table[pairs.cell, pairs.action] for table in (visits, counts.rewards))
    mean = paid / jnp.maximum(seen, 1)
    of_first, of_second = (jnp.abs(mean - rewards[i, pairs.cell, pairs.action]) for i in (pairs.first, pairs.second))
    told = seen >= visits_to_tell(pairs.gap, len(rewards), error)
    models = jnp.arange(len(rewards))[:, None]
    beaten = (models == pairs.first) & told & (of_first > of_second)
    beaten |= (models == pairs.second) & told & (of_second > of_first)
    never = (rewards == 0) & (counts.rewards > 0) | (rewards == 1) & (counts.rewards < visits)
    return ~(jnp.any(beaten, axis=1) | jnp.any(never, axis=(1, 2)))


# Thompson sampling over classes (Wilson et al. 2007).


def log_likelihoods(models: Model, seen: Seen) -> Array:
    """Return the logarithms (C,) of how likely each class makes a step's reward and next state."""
    paid = models.rewards[:, seen.cell, seen.action]
    moved = models.transitions[:, seen.cell, seen.action, seen.next_cell]
    return jnp.log(jnp.where(seen.reward > 0, paid, 1 - paid)) + jnp.log(moved)


# The mean of earlier tables as a start (Tanaka and Yamamura 2003).


def start_of(tables: Array) -> tuple[Array, Array]:
    """Return the mean (S, A) of earlier tables (T, S, A), and the shares (S, A) of backups by standard deviations."""
    deviations = jnp.std(tables, axis=0)
    return jnp.mean(tables, axis=0), deviations / jnp.sum(deviations)


# Fitted Q-iteration with a group lasso (Calandriello et al. 2014).


def shrink(weights: Array, threshold: Array | float) -> Array:
    """Return max(0, 1 - threshold / ||w||) w of the rows w of weights (D, T): the group lasso's proximal operator."""
    norms = jnp.linalg.norm(weights, axis=1, keepdims=True)
    return jnp.maximum(0, 1 - threshold / jnp.where(norms > 0, norms, jnp.inf)) * weights


def group_lasso(grams: Array, moments: Array, penalty: float, steps: int = 50) -> Array:
    """Return the weights W (D, T) that minimise sum_t (w_t' G_t w_t / 2 - w_t' m_t) + penalty sum_d ||W_d||.

    By proximal gradients with momentum (FISTA, Beck and Teboulle 2009), for matrices (T, D, D) and moments (T, D).
    """
    rate = 1 / jnp.max(jnp.linalg.norm(grams, ord=2, axis=(1, 2)))

    def descend(carry, _):
        weights, ahead, t = carry
        slope = jnp.einsum("tde,et->dt", grams, ahead) - moments.T
        new, t_new = shrink(ahead - rate * slope, rate * penalty), (1 + jnp.sqrt(1 + 4 * t**2)) / 2
        return (new, new + (t - 1) / t_new * (new - weights), t_new), None

    zero = jnp.zeros(moments.T.shape)
    return jax.lax.scan(descend, (zero, zero, jnp.float32(1)), length=steps)[0][0]


def features(cell: Array, noise: Array, action: Array) -> Array:
    """Return the features (D,) of an action: one-hot pairs of state and action, then the noise of each action."""
    pair = jax.nn.one_hot(cell * ACTIONS + action, STATES * ACTIONS)
    return jnp.concatenate([pair, (jax.nn.one_hot(action, ACTIONS)[:, None] * noise).ravel()])


def values_of(weights: Array, cell: Array, noise: Array) -> Array:
    """Return the values (A,) of all actions by weights (D,)."""
    table, slopes = jnp.split(weights, [STATES * ACTIONS])
    return table.reshape(STATES, ACTIONS)[cell] + slopes.reshape(ACTIONS, -1) @ noise


def fitted_q(weights: Array, seen: Seen, known: Array, regress: Any, sweeps: int) -> Array:
    """Return weights (T, D) by fitted Q-iteration from earlier ones on the steps (T, N) of T tasks.

    ``known`` (T, N) is 1 for the steps that count. ``regress`` makes weights (D, T) of moments (T, D), given grams
    (T, D, D) first.
    """
    each = jax.vmap(jax.vmap(features))(seen.cell, seen.noise, seen.action) * known[..., None]
    solve = regress(jnp.einsum("tnd,tne->tde", each, each))
    ahead = jax.vmap(jax.vmap(values_of, (None, 0, 0)))

    def sweep(weights, _):
        targets = seen.reward + DISCOUNT * jnp.max(ahead(weights, seen.next_cell, seen.next_noise), axis=-1)
        return solve(jnp.einsum("tnd,tn->td", each, targets)).T, None

    return jax.lax.scan(sweep, weights, length=sweeps)[0]


# What earlier tasks teach.


class Lessons(NamedTuple):
    """What is known before a new task."""

    models: Model  # (C, ...) of clusters of earlier tasks
    plans: Array  # (C, H, S, A) their values
    probes: Array  # (P, S, A) values of coming to where two models differ most
    tables: Array  # (T, S, A) values of earlier tasks
    kept: Array  # (D,) whether any earlier task needed a feature


def clusters_of(counts: Counts, gap: float = 0.8) -> Model:
    """Return the models (C, ...) of clusters of tasks (T, ...), within which rewards differ by less than gap / 2."""
    rewards = counts.model().rewards
    near = jnp.max(jnp.abs(rewards[:, None] - rewards), axis=(2, 3)) < gap / 2
    leader = jnp.argmax(near, axis=1)  # the first task that is near
    (leaders,) = jnp.nonzero(leader == jnp.arange(len(leader)), size=CLASSES, fill_value=0)
    members = jnp.float32(leader == leaders[:, None])
    return jax.tree.map(lambda x: jnp.tensordot(members, x, 1), counts).model()


def probe_of(models: Model, first: Array, second: Array, cell: Array, action: Array) -> Array:
    """Return the values (S, A) of coming to one action of one state, in the mean of two models."""
    there = jnp.zeros((STATES, ACTIONS)).at[cell, action].set(1)
    return plan(Model(there, (models.transitions[first] + models.transitions[second]) / 2), 100, 0.95)[0]


def lessons_of(seen: Seen, penalty: float = 0.05) -> Lessons:
    """Return what the steps (T, N) of earlier tasks teach."""
    add = lambda counts, step: (counts.add(step), None)
    counts = jax.vmap(lambda steps: jax.lax.scan(add, NOTHING, steps)[0])(seen)
    models, steps = clusters_of(counts), seen.reward.shape[1]
    pairs = pairs_of(models.rewards)
    regress = lambda grams: lambda moments: group_lasso(grams / steps, moments / steps, penalty)
    zero = jnp.zeros((len(seen.reward), STATES * ACTIONS + ACTIONS * NOISE))
    weights = fitted_q(zero, seen, jnp.ones(seen.reward.shape), regress, 20)
    return Lessons(
        models,
        jax.vmap(lambda model: plan(model, HORIZON))(models),
        jax.vmap(lambda *pair: probe_of(models, *pair))(*pairs[:4]),
        jax.vmap(lambda model: plan(model, 100, DISCOUNT)[0])(counts.model()),
        jnp.any(weights != 0, axis=0),
    )


# Learners: ``begin`` a task, ``prepare`` for an episode, choose an action by ``values``, ``learn`` from a step.


@dataclasses.dataclass(frozen=True)
class Elimination:
    """Try what tells apart two models that are left; play the last one."""

    def begin(self, lessons):
        return NOTHING

    def prepare(self, lessons, counts, episode, key):
        return counts

    def values(self, lessons, counts, cell, noise, moment):
        left, pairs = possible(lessons.models.rewards, counts), pairs_of(lessons.models.rewards)
        gaps = pairs.gap * left[pairs.first] * left[pairs.second]
        probe = lessons.probes[jnp.argmax(gaps), cell]
        return jnp.where(jnp.any(gaps > 0), probe, lessons.plans[jnp.argmax(left), moment, cell])

    def learn(self, lessons, counts, seen):
        return counts.add(seen)


@dataclasses.dataclass(frozen=True)
class Thompson:
    """Play a class that is drawn from the posterior before every episode."""

    def begin(self, lessons):
        return jnp.zeros(CLASSES), jnp.int32(0)

    def prepare(self, lessons, state, episode, key):
        return state[0], jax.random.categorical(key, state[0])

    def values(self, lessons, state, cell, noise, moment):
        return lessons.plans[state[1], moment, cell]

    def learn(self, lessons, state, seen):
        return state[0] + log_likelihoods(lessons.models, seen), state[1]


@dataclasses.dataclass(frozen=True)
class Scratch:
    """Play a process that is drawn from a posterior over all processes before every episode (Strens 2000)."""

    def begin(self, lessons):
        return NOTHING, jnp.zeros((HORIZON, STATES, ACTIONS))

    def prepare(self, lessons, state, episode, key):
        counts, (reward_key, move_key) = state[0], jax.random.split(key)
        misses = counts.moves.sum(-1) - counts.rewards
        rewards = jax.random.beta(reward_key, 1 + counts.rewards, 1 + misses)
        return counts, plan(Model(rewards, jax.random.dirichlet(move_key, 1 + counts.moves)), HORIZON)

    def values(self, lessons, state, cell, noise, moment):
        return state[1][moment, cell]

    def learn(self, lessons, state, seen):
        return state[0].add(seen), state[1]


class Dyna(NamedTuple):
    """The state of ``Table``."""

    table: Array
    counts: Counts
    share: Array  # (S, A) how often pairs are backed up, as logarithms
    epsilon: Array
    key: Array


@dataclasses.dataclass(frozen=True)
class Table:
    """Back up the value of each step, and of pairs seen before, in the model that was counted (Dyna, Sutton 1990)."""

    taught: bool
    """Begin at the mean of earlier tables, and back up by their deviations; else at 0, and all alike."""
    exploration: float
    """Probability of a random action in the first episode; in the k-th it is this / k."""
    backups: int = 3

    def begin(self, lessons):
        start, share = start_of(lessons.tables)
        if not self.taught:
            start, share = jnp.zeros_like(start), jnp.ones_like(share)
        return Dyna(start, NOTHING, jnp.log(share), jnp.float32(1), jax.random.key(0))

    def prepare(self, lessons, state, episode, key):
        return state._replace(epsilon=self.exploration / (1 + episode), key=key)

    def values(self, lessons, state, cell, noise, moment):
        return explore(state.table[cell], state.epsilon, jax.random.fold_in(state.key, moment))

    def learn(self, lessons, state, seen):
        counts, (key, pair_key) = state.counts.add(seen), jax.random.split(state.key)
        visits = counts.moves.sum(-1)
        chances = jnp.where(visits > 0, state.share, -jnp.inf).ravel()
        drawn = jax.random.categorical(pair_key, chances, shape=(self.backups,))
        table = state.table
        for pair in [seen.cell * ACTIONS + seen.action, *drawn]:
            cell, action = pair // ACTIONS, pair % ACTIONS
            following = counts.moves[cell, action] @ jnp.max(table, axis=-1)
            value = (counts.rewards[cell, action] + DISCOUNT * following) / visits[cell, action]
            table = table.at[cell, action].set(value)
        return state._replace(table=table, counts=counts, key=key)


class Regression(NamedTuple):
    """The state of ``Linear``."""

    weights: Array
    steps: Seen  # (N, ...) all steps of the task
    count: Array
    epsilon: Array
    key: Array


@dataclasses.dataclass(frozen=True)
class Linear:
    """Fit linear values to all steps of the task before every episode, by least squares."""

    taught: bool
    """Use the features that the group lasso has kept; else all."""
    exploration: float
    """Probability of a random action in the first episode; in the k-th it is this / k."""
    ridge: float = 0.1

    def begin(self, lessons):
        one = Seen(jnp.int32(0), jnp.zeros(NOISE), jnp.int32(0), jnp.float32(0), jnp.int32(0), jnp.zeros(NOISE))
        steps = jax.tree.map(lambda x: jnp.zeros((EPISODES * HORIZON, *x.shape), x.dtype), one)
        zero = jnp.zeros(lessons.kept.shape)
        return Regression(zero, steps, jnp.int32(0), jnp.float32(1), jax.random.key(0))

    def prepare(self, lessons, state, episode, key):
        used = lessons.kept | (not self.taught)
        ridge = jnp.diag(jnp.where(used, self.ridge, 1e6))

        def regress(grams):
            inverse = jnp.linalg.inv(grams[0] + ridge)
            return lambda moments: (inverse @ moments[0])[:, None]

        known = jnp.float32(jnp.arange(EPISODES * HORIZON) < state.count)[None]
        steps = jax.tree.map(lambda x: x[None], state.steps)
        (weights,) = fitted_q(state.weights[None], steps, known, regress, 10)
        return state._replace(weights=weights, epsilon=self.exploration / (1 + episode), key=key)

    def values(self, lessons, state, cell, noise, moment):
        values = values_of(state.weights, cell, noise)
        return explore(values, state.epsilon, jax.random.fold_in(state.key, moment))

    def learn(self, lessons, state, seen):
        steps = jax.tree.map(lambda x, new: x.at[state.count].set(new), state.steps, seen)
        return state._replace(steps=steps, count=state.count + 1)


def explore(values: Array, epsilon: Array, key: Array) -> Array:
    """Return values (A,) of which the largest is a random action's with probability ``epsilon``."""
    which, draw = jax.random.split(key)
    return jnp.where(jax.random.bernoulli(which, epsilon), jax.random.uniform(draw, values.shape), values)


# Exploration is the best of 0.1, 0.2, 0.5 and 1 for each learner, on other seeds.
LEARNERS = {
    "Which known model is it?": {
        "elimination": Elimination(),
        "Thompson over classes": Thompson(),
        "from scratch": Scratch(),
    },
    "Where do values begin?": {"mean of earlier tables": Table(True, 0.2), "zero": Table(False, 0.5)},
    "Which features count?": {"those the lasso kept": Linear(True, 0.5), "all": Linear(False, 1.0)},
}


# The experiment.


def interact(env: Any, task: Any, episodes: int, start: Any, prepare: Any, act: Any, learn: Any, key: Array) -> Any:
    """Play episodes of a task; return what ``learn`` tells of every step, (episodes, H, ...)."""

    def step(carry, moment):
        state, world, cell, noise, key = carry
        key, act_key, noise_key = jax.random.split(key, 3)
        action = act(state, cell, noise, moment, act_key)
        after = env.step(task, world, action)
        next_noise = jax.random.normal(noise_key, (NOISE,))
        seen = Seen(cell, noise, action, after.reward, after.state.cell, next_noise)
        state, told = learn(state, seen, moment)
        return (state, after.state, after.state.cell, next_noise, key), told

    def episode(state, number):
        keys = jax.random.split(jax.random.fold_in(key, number), 4)
        world = env.reset(task, keys[0]).state
        noise = jax.random.normal(keys[1], (NOISE,))
        carry = (prepare(state, number, keys[2]), world, world.cell, noise, keys[3])
        carry, told = jax.lax.scan(step, carry, jnp.arange(HORIZON))
        return carry[0], told

    return jax.lax.scan(episode, start, jnp.arange(episodes))[1]


def wander(env: Any, task: Any, key: Array) -> Seen:
    """Return the steps (N,) of an earlier task under random actions."""
    act = lambda state, cell, noise, moment, key: jax.random.randint(key, (), 0, ACTIONS)
    stay = lambda state, number, key: state
    seen = interact(env, task, EARLIER_EPISODES, (), stay, act, lambda state, seen, moment: (state, seen), key)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)


def regret_of(learner: Any, env: Any, lessons: Lessons, task: Any, key: Array) -> Array:
    """Return the regret (episodes,) of a learner on a new task."""
    best = plan(Model(task.goal["rewards"], task.goal["transitions"]), HORIZON)
    lost = lambda moment, seen: jnp.max(best[moment, seen.cell]) - best[moment, seen.cell, seen.action]
    act = lambda state, cell, noise, moment, key: jnp.argmax(learner.values(lessons, state, cell, noise, moment))
    prepare = lambda state, number, key: learner.prepare(lessons, state, number, key)
    learn = lambda state, seen, moment: (learner.learn(lessons, state, seen), lost(moment, seen))
    return jnp.sum(interact(env, task, EPISODES, learner.begin(lessons), prepare, act, learn, key), axis=1)


def measure(seeds: int) -> dict[str, dict[str, np.ndarray]]:
    """Return cumulative regrets (seeds, episodes), means over classes, by panel and learner. Tell the progress."""
    began = time.perf_counter()
    say = lambda text: print(f"{time.perf_counter() - began:5.1f} s  {text}", flush=True)
    families = [
        mtjax.make(
            "tabular-mdp", num_states=STATES, num_actions=ACTIONS, num_tasks=CLASSES, split="none", task_seed=seed
        )
        for seed in range(seeds)
    ]
    env, classes = families[0], jax.tree.map(lambda *x: jnp.stack(x), *(family.tasks() for family in families))
    keys = jax.random.split(jax.random.key(0), (seeds, EARLIER))
    order = np.stack([np.random.default_rng(seed).permutation(EARLIER) % CLASSES for seed in range(seeds)])
    earlier = jax.vmap(lambda tasks, rows: jax.tree.map(lambda x: x[rows], tasks))(classes, order)
    seen = jax.jit(jax.vmap(jax.vmap(lambda task, key: wander(env, task, key))))(earlier, keys)
    say(f"{seeds} seeds x {EARLIER} earlier tasks x {seen.reward.shape[2]} steps were explored")
    lessons = jax.block_until_ready(jax.jit(lambda seen: jax.lax.map(lessons_of, seen))(seen))
    useful = np.asarray(lessons.kept)[:, : STATES * ACTIONS].sum(axis=1)
    say(f"the lasso kept {useful.min()} to {useful.max()} of {STATES * ACTIONS} features that count")
    say(f"and {np.asarray(lessons.kept)[:, STATES * ACTIONS :].sum(axis=1).max()} of {ACTIONS * NOISE} that do not")
    keys, found = jax.random.split(jax.random.key(1), (seeds, CLASSES)), {}
    for panel, learners in LEARNERS.items():
        for name, learner in learners.items():
            one = lambda lessons, task, key, learner=learner: regret_of(learner, env, lessons, task, key)
            run = jax.jit(jax.vmap(jax.vmap(one, (None, 0, 0))))
            regrets = np.cumsum(np.mean(run(lessons, classes, keys), axis=1), axis=1)
            found.setdefault(panel, {})[name] = regrets
            say(f"{panel} {name}: regret {stats.seed_interval(regrets[:, -1]).point:.1f} after {EPISODES} episodes")
    return found


def draw(found: dict[str, dict[str, np.ndarray]], out: str) -> None:
    """Draw cumulative regrets over episodes, a panel for each question, with intervals over seeds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), dpi=80, layout="constrained")
    for axes, (panel, learners) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        figures.style(axes)
        for index, (name, regrets) in enumerate(learners.items()):
            figures.draw_line(axes, np.arange(1, EPISODES + 1), regrets, name, index)
        axes.set_title(panel, fontsize=10)
        axes.set_xlabel("episode of a new task")
        axes.set_ylabel("regret so far")
        axes.set_ylim(0)
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    figure.savefig(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", default="identify.png")
    arguments = parser.parse_args()
    found = measure(arguments.seeds)
    for learners in found.values():
        *_, without = learners.values()
        for name, regrets in learners.items():
            less = stats.paired_difference(regrets[:, -1], without[:, -1])
            print(f"{name:24} {stats.seed_interval(regrets[:, -1]):.1f}  {less:+.1f}")
    draw(found, arguments.out)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    main()
