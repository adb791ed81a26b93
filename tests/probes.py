"""Probe environments: problems so small that every Q-value is known, each of which breaks one part of a learner.

After Andy Jones' five, with a task axis and a time limit. A probe is data, as a task is: one environment, and so one
compiled program, serves all of them.
"""

import dataclasses
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import agents, loop
from mtjax.history import remember, widen
from mtjax.networks import Params
from mtjax.types import Array, Key, Spec, Step, Task, Transition

AFTER = 5.0  # seen only once an episode has terminated, when its value must not matter
LIMIT = 2  # steps after which an episode is cut off

# Tests compile much and run little; without LLVM's optimisations they take half as long.
QUICK = {"xla_backend_optimization_level": 0}
_SPEC = Spec(obs_size=1, action_size=1, context_size=1)


# The rules of each probe: scale, observation (), action () -> reward, next observation, terminated.


def _one_step(scale, obs, action):
    """Earns ``scale``: Q = scale. Needs the critic's fit to the reward, and ``discount``."""
    return scale, AFTER, True


def _by_observation(scale, obs, action):
    """One step from -1 or 1: Q = scale obs. Needs the observation to reach the critic."""
    return scale * obs, AFTER, True


def _delayed(scale, obs, action):
    """Two steps, from 0 and from 1, of which the last earns: Q(1) = scale, Q(0) = gamma scale."""
    last = obs > 0.5
    return scale * last, jnp.where(last, AFTER, 1.0), last


def _by_action(scale, obs, action):
    """One step: Q = -(action - scale)^2, so that the policy has a best action in each task."""
    return -jnp.square(action - scale), AFTER, True


def _by_both(scale, obs, action):
    """One step from -1 or 1: Q = -(action - scale obs)^2, so that the best action turns with observation and task."""
    return -jnp.square(action - scale * obs), AFTER, True


def _endless(scale, obs, action):
    """Never terminates: nothing from 0, then ``scale`` from 1 for ever, so that Q(1) = scale / (1 - gamma).

    Were the time limit a termination, Q(1) would be scale; were the observation after the reset stored as the next
    one, scale / (1 - gamma^2).
    """
    return scale * (obs > 0.5), 1.0, False


RULES = {
    "one-step": _one_step,
    "by-observation": _by_observation,
    "delayed": _delayed,
    "by-action": _by_action,
    "by-both": _by_both,
    "endless": _endless,
}
EITHER_SIGN = ("by-observation", "by-both")  # episodes begin at -1 or 1, and not at 0


class World(NamedTuple):
    """The state of every probe."""

    obs: Array  # (1,)
    age: Array  # () int32


def tasks_of(kind: str, scales=(1.0, -0.5)) -> Task:
    """Tasks (T, ...) of one probe, told apart by a scale, which is also their context."""
    scales = jnp.asarray(scales, jnp.float32)
    same = lambda value, dtype: jnp.full(scales.shape, value, dtype)
    goal = {
        "scale": scales,
        "kind": same(list(RULES).index(kind), jnp.int32),
        "either_sign": same(kind in EITHER_SIGN, bool),
    }
    row = jnp.arange(len(scales), dtype=jnp.int32)
    return Task(row, row, scales[:, None], {"scale": scales}, {}, goal)


@dataclasses.dataclass(frozen=True)
class Probe:
    """Any of the probes, by the task's ``kind``."""

    kind: str = "one-step"
    episode_length: int = LIMIT

    @property
    def spec(self) -> Spec:
        return _SPEC

    def tasks(self, split: str = "train") -> Task:
        return tasks_of(self.kind)

    def task_values(self, split: str) -> np.ndarray:
        return np.asarray(self.tasks(split).params["scale"])

    def reset(self, task: Task, key: Key) -> Step:
        state = World(self.start(task, key), jnp.int32(0))
        return Step(state, state.obs, jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: World, action: Array) -> Step:
        reward, obs, terminated = self.rules(task, state, action[0])
        obs = jnp.reshape(jnp.float32(obs), 1)
        return Step(World(obs, state.age + 1), obs, jnp.float32(reward), jnp.bool_(terminated))

    def start(self, task: Task, key: Key) -> Array:
        sign = jnp.where(jax.random.bernoulli(key, shape=(1,)), 1.0, -1.0)
        return jnp.where(task.goal["either_sign"], sign, 0.0)

    def rules(self, task: Task, state: World, action: Array):
        as_arrays = lambda rule: lambda *inputs: tuple(map(jnp.float32, rule(*inputs)))
        branches = [as_arrays(rule) for rule in RULES.values()]
        reward, obs, terminated = jax.lax.switch(task.goal["kind"], branches, task.goal["scale"], state.obs[0], action)
        return reward, obs, terminated > 0


@dataclasses.dataclass(frozen=True)
class Walk(Probe):
    """Begins anywhere in [0, 1) and goes up by 1 a step, so that the rest of the observation names the episode.

    From starts below a half episodes terminate after 3 steps; others go on until the time limit.
    """

    episode_length: int = 5

    def start(self, task, key):
        return jax.random.uniform(key, (1,))

    def rules(self, task, state, action):
        return task.goal["scale"] * state.obs[0], state.obs[0] + 1, (state.obs[0] % 1 < 0.5) & (state.age == 2)


@dataclasses.dataclass(frozen=True)
class Broken(Walk):
    """A walk of which the reward is not a number at one age, in tasks with a negative scale."""

    broken_age: int = 3

    def rules(self, task, state, action):
        wrong = (task.goal["scale"] < 0) & (state.age == self.broken_age)
        return jnp.where(wrong, jnp.nan, 1.0), state.obs[0] + 1, False


@dataclasses.dataclass(frozen=True)
class Goals(Walk):
    """Walks whose reward is the task's scale times the observation; of goals that the key draws, plus its bits."""

    fresh_goals: bool = False
    drawn: bool = False
    relabels = ("scale",)
    parameters = ("scale",)
    varied = ("scale",)

    def tasks(self, split="train"):
        tasks = tasks_of("one-step", (1.0, 2.0, 3.0, 4.0))
        if not self.drawn:
            return tasks
        scales = jnp.linspace(0.1, 0.9, 50) + 10 * tasks.goal["scale"][:, None]
        draws = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (4, 50, *x.shape[1:])), tasks)
        return tasks._replace(draws=draws._replace(context=scales[..., None], goal=draws.goal | {"scale": scales}))

    def relabel(self, task, transition, key):
        return transition._replace(reward=task.goal["scale"] * transition.obs[0])


# Agents, and running them.


SMALL = {  # of parts that have such settings
    "num_experts": 2,
    "expert_widths": (8, 4),
    "encoder_widths": (8,),
    "module_width": 8,
    "routing_widths": (8,),
    "hypernetwork_widths": (8, 4),
    "latent_widths": (8, 8),
    "model_widths": (8,),
}


def tiny(name: str, **settings):
    """Return the agent called ``name``, small enough to compile in a few seconds."""
    made = agents.agent(name, **{"hidden": (16,), "embedding_size": 4, **settings})
    small = {k: v for k, v in SMALL.items() if k in agents.settings(made) and k not in settings}
    return agents.agent(name, **{**agents.settings(made), **small})


@lru_cache
def _programs(env, agent, settings: loop.Settings, num_seeds: int):
    tasks, seeds = env.tasks(), jnp.zeros(num_seeds, jnp.uint32)
    init = loop.init.lower(env, agent, settings, tasks, seeds).compile(QUICK)
    state = jax.eval_shape(lambda: loop.init(env, agent, settings, tasks, seeds))
    return init, loop.run_chunk.lower(env, agent, settings, tasks, state).compile(QUICK)


def train(env, agent, settings: loop.Settings, *, tasks: Task | None = None, seeds=(0,), chunks: int = 1):
    """Return the training state after ``chunks`` chunks, and the metrics of each."""
    tasks, history, env = env.tasks() if tasks is None else tasks, [], remember(env, agent.history)
    init, run_chunk = _programs(env, agent, settings, len(seeds))
    state = init(tasks, jnp.asarray(seeds, jnp.uint32))
    for _ in range(chunks):
        state, metrics = run_chunk(tasks, state)
        history.append(metrics)
    return state, history


def quick(function, *arguments):
    """Compile a function for arguments of these shapes."""
    return jax.jit(function).lower(*arguments).compile(QUICK)


@lru_cache
def _agent_programs(agent, spec: Spec, num_tasks: int, batch_size: int):
    tasks, key = tasks_of("one-step", np.ones(num_tasks)), jax.random.key(0)
    spec = spec if spec.history else widen(spec, agent.history)
    init = lambda tasks, key: agent.init(spec, tasks, key)
    batch = random_batch(0, num_tasks, batch_size, spec)
    return quick(init, tasks, key), quick(agent.update, jax.eval_shape(init, tasks, key), batch, tasks, key)


def learner(agent, tasks: Task, batch_size: int, spec: Spec = _SPEC):
    """Compile an agent: ``init(tasks, key)`` and ``update(state, batch, tasks, key)``."""
    return _agent_programs(agent, spec, len(tasks.id), batch_size)


def pick(tree, index):
    """One row, or several, of every leaf; by NumPy, as JAX would compile a program for every shape."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), tree)


def only_seed(tree):
    """Drop the leading seed axis of a run of one seed."""
    return pick(tree, 0)


def of_task(params: Params, index: int) -> Params:
    """The parameters that one task uses."""
    return Params(params.shared, pick(params.own, index))


def values(agent, state, tasks: Task, obs, action) -> np.ndarray:
    """Every critic's estimate (T, N, B) at observations (B,) and actions (B,)."""
    obs, action = jnp.float32(obs)[:, None], jnp.float32(action)[:, None]
    rows = []
    for i in range(len(tasks.id)):
        features = agent.features(state, pick(tasks, i))
        rows.append(agent.values(of_task(state.critic, i), features, obs, action))
    return np.stack(rows)


def mean_actions(agent, state, tasks: Task, obs) -> np.ndarray:
    """The mean action (T, B) at observations (B,)."""
    act = lambda task: jax.vmap(lambda x: agent.act(state, x, task, None)[0])(jnp.float32(obs)[:, None])
    return np.stack([act(pick(tasks, i)) for i in range(len(tasks.id))])


def random_batch(seed: int, num_tasks: int, batch_size: int, spec: Spec = _SPEC) -> Transition:
    """A batch (T, B, ...) in which every field is random and about one discount in four is 0."""
    random = np.random.default_rng(seed)
    normal = lambda *shape: jnp.float32(random.normal(size=(num_tasks, batch_size, *shape)))
    return Transition(
        obs=normal(spec.obs_size),
        action=jnp.tanh(normal(spec.action_size)),
        reward=normal(),
        discount=jnp.float32(random.random((num_tasks, batch_size)) < 0.75),
        next_obs=normal(spec.obs_size),
    )
