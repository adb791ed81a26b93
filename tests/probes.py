"""What tests run agents and loops on: the package's probes, some that break on purpose, and compiled programs."""

import dataclasses
import math
from functools import lru_cache, partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs

from mtjax import agents
from mtjax.agents import replay_batches
from mtjax.agents.base import Memory
from mtjax.agents.networks import Params
from mtjax.agents.parts.adaptation import adapt
from mtjax.agents.parts.continual import Continual
from mtjax.agents.parts.knowing import last_steps
from mtjax.agents.parts.plasticity import Plasticity
from mtjax.agents.parts.policies import Gaussian
from mtjax.command.keywords import from_keywords
from mtjax.config import Plan, configure
from mtjax.envs import ENVS, Family, Parameter
from mtjax.envs.choosing import Acting
from mtjax.envs.probes import AFTER, LIMIT, RULES, SPEC, Probe, tasks_of
from mtjax.experience import Replay, rollouts
from mtjax.frames import seen
from mtjax.learning import loop
from mtjax.training.journal import Hooks
from mtjax.training.launch import check, launch
from mtjax.types import Acted, MultiDiscrete, Spec, Step, Task, Transition

__all__ = ["AFTER", "LIMIT", "RULES", "SPEC", "Probe", "tasks_of"]

# Families that stand for all where a test takes long: Meta-World's fifty share one class but for rewards.
METAWORLD = [name for name in ENVS if name.startswith("metaworld-")]
FEW = [name for name in ENVS if name not in METAWORLD or name == "metaworld-reach"]
# Families, and a way to tell a task, that read or import what is not installed with mtjax.
_PACKAGES = {
    **dict.fromkeys(METAWORLD, "metaworld"),
    **{name: "dm_control" for name in ENVS if name.startswith("dog-")},
    "text": "sklearn",
}

# Tests compile much and run little; without LLVM's optimisations they take half as long.
QUICK = {"xla_backend_optimization_level": 0}


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
class Lost(Walk):
    """A walk that is lost in its second step from starts below a share, in tasks with a negative scale.

    Then reward and observation are not numbers, or beyond all bounds, and it seems to terminate.
    """

    share: float = 0.3
    value: float = math.nan

    def rules(self, task, state, action):
        wrong = (task.goal["scale"] < 0) & (state.age == 1) & (state.obs[0] % 1 < self.share)
        obs = jnp.where(wrong, self.value, state.obs[0] + 1)
        return task.goal["scale"] * obs, obs, ~(obs < 100)


@dataclasses.dataclass(frozen=True)
class Unsound(Walk):
    """A walk that begins with no number from starts below a share, in tasks with a negative scale; then it has one."""

    share: float = 0.3
    early: bool = True

    @property
    def ends_early(self):
        return self.early

    def start(self, task, key):
        obs = super().start(task, key)
        return jnp.where((task.goal["scale"] < 0) & (obs < self.share), jnp.nan, obs)

    def rules(self, task, state, action):
        obs = jnp.nan_to_num(state.obs[0])
        return 1.0, obs + 1, False


@dataclasses.dataclass(frozen=True)
class Goals(Walk):
    """Walks whose reward is the task's scale times the observation; of goals that the key draws, plus its bits."""

    fresh_goals: bool = False
    drawn: bool = False
    relabels = ("scale",)
    parameters = ("scale",)
    varied = ("scale",)
    pixels, repeat = 0, 1

    def tasks(self, split="train"):
        tasks = tasks_of("one-step", (1.0, 2.0, 3.0, 4.0), self.episode_length)
        if not self.drawn:
            return tasks
        scales = jnp.linspace(0.1, 0.9, 50) + 10 * tasks.goal["scale"][:, None]
        draws = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (4, 50, *x.shape[1:])), tasks)
        return tasks._replace(draws=draws._replace(context=scales[..., None], goal=draws.goal | {"scale": scales}))

    def relabel(self, task, transition, key):
        return transition._replace(reward=task.goal["scale"] * transition.obs[0])


@dataclasses.dataclass(frozen=True)
class Levers(Acting, Family):
    """A light shows where two levers, of three and of five places, must stand at once for a reward of 1.

    The lights follow each other, so that the best return of an episode is its length, 6.
    """

    sizes: tuple[int, ...] = (3, 5)
    parameters: ClassVar = {"turn": Parameter("1", 0.0)}
    episode_steps: ClassVar[int] = 6

    @property
    def action(self):
        return MultiDiscrete(self.sizes)

    def best(self, task, light):
        """Where the levers must stand."""
        return (light * jnp.array([1, 2]) + jnp.int32(task.goal["turn"])) % jnp.array(self.sizes)

    def reset(self, task, key):
        return self.show(jax.random.randint(key, (), 0, 3), jnp.float32(0))

    def step(self, task, state, action):
        return self.show((state + 1) % 3, jnp.float32(jnp.all(action == self.best(task, state))))

    def show(self, light, reward):
        return Step(light, jax.nn.one_hot(light, 3), reward, jnp.bool_(False))


# Agents, and running them.


@dataclasses.dataclass(frozen=True)
class Stub:
    """An agent without networks: subclasses say what it does."""

    experience: Replay = dataclasses.field(default_factory=Replay)

    unroll: ClassVar[int] = 0
    continual: ClassVar[Continual] = Continual()
    plasticity: ClassVar[Plasticity] = Plasticity()
    goes_on: ClassVar[bool] = False
    taught: ClassVar[bool] = False
    in_training: ClassVar = {}

    def init(self, spec, tasks, key):
        return jnp.zeros(1)

    def begin(self, state, task):
        return ()

    def act(self, state, memory, obs, task, key):
        return Acted(self.choose(state, obs, task, key))

    def choose(self, state, obs, task, key):
        """The action (A,)."""
        return jnp.zeros(1)

    def remember(self, state, memory, transition, task):
        return memory

    def assess(self, state, steps, tasks):
        return state, steps

    def adapt(self, state, steps, tasks):
        return state

    def update(self, state, window, tasks, key, number):
        return state, {}

    def observe(self, state, steps, tasks):
        return state


OFF_POLICY = [name for name, preset in agents.AGENTS.items() if issubclass(preset.cls, agents.SAC)]
"""The agents that learn from batches of a replay; ``test_ppo`` is of the one that does not."""


def family_for(agent: str) -> str:
    """A family whose actions an agent draws."""
    if agent == "sketches":
        return "craft-sketched"
    return "finger-spin" if Gaussian in agents.AGENTS[agent].cls.policies else "tabular-mdp"


def param(case, slow=False, nightly=False):
    """A case, or several values in a tuple, as a test's parameters, marked with the packages that they need."""
    values = case if isinstance(case, tuple) else (case,)
    words = [word for value in values for word in (value.values() if isinstance(value, dict) else (value,))]
    packages = [_PACKAGES[word] for word in words if isinstance(word, str) and word in _PACKAGES]
    marks = [*map(needs, packages), *([pytest.mark.slow] if slow else []), *([pytest.mark.nightly] if nightly else [])]
    return pytest.param(*values, marks=marks)


def one_in(count, cases, nightly=False):
    """All cases as a test's parameters, marked slow but for one in ``count``, and ``nightly`` as ``_later`` says."""
    return _later([(case, i % count == 0) for i, case in enumerate(cases)], nightly)


def slow_but(names, *quick, nightly=False):
    """All names as a test's parameters, marked slow but for the ``quick``, and ``nightly`` as ``_later`` says."""
    return _later([(name, name in quick) for name in names], nightly)


def _later(cases, nightly):
    """Mark cases that are not quick as slow, and four of seven of these as ``nightly`` too, if that is so.

    Seven has no divisor in common with the length of most inner loops over cases, so that all values are in the rest.
    """
    late = lambda i: nightly and i % 7 in (1, 3, 5, 6)
    return [param(case, slow=not quick, nightly=late(i) and not quick) for i, (case, quick) in enumerate(cases)]


# The loop and the replay with which SAC learns what a probe asks for.
LEARNING = {
    "num_envs": 8,
    "updates_per_step": 4,
    "batch_size": 32,
    "replay_size": 8000,
    "warmup_steps": 150,
    "warmup_hold": 1,
    "chunk_steps": 300,
}

SMALL = {  # of parts that have such settings
    "num_experts": 2,
    "expert_widths": (8, 4),
    "encoder_widths": (8,),
    "weight_widths": (8,),
    "num_subnetworks": 2,
    "attention_widths": (8,),
    "module_width": 8,
    "routing_widths": (8,),
    "hypernetwork_widths": (8, 4),
    "latent_widths": (8, 8),
    "model_widths": (8,),
    "inference_widths": (8,),
}


def tiny(name: str, **settings):
    """Return the agent called ``name``, small enough to compile in a few seconds."""
    made = agents.agent(name, **{"hidden": (16,), **settings})
    small = {k: v for k, v in SMALL.items() if k in agents.settings(made) and k not in settings}
    return agents.agent(name, **{**agents.settings(made), **small})


@lru_cache
def _programs(env, agent, settings: loop.Settings, num_seeds: int, level: int):
    tasks, seeds = env.tasks(), jnp.zeros(num_seeds, jnp.uint32)
    init = loop.init.lower(env, agent, settings, tasks, seeds).compile(QUICK)
    state = jax.eval_shape(lambda: loop.init(env, agent, settings, tasks, seeds))
    run_chunk = loop.run_chunk.lower(env, agent, settings, tasks, state)
    return init, run_chunk.compile({"xla_backend_optimization_level": level})


def train(env, agent, given: dict, *, tasks: Task | None = None, seeds=(0,), chunks: int = 1, level: int = 0):
    """Return the training state after ``chunks`` chunks, and the metrics of each.

    ``given`` are settings of the loop and of the agent by name; episodes are not staggered unless they say so. At
    ``level`` 1 chunks take twice as long to compile, and large networks a tenth of the time to run.
    """
    agent, settings = configure(agent, loop.Settings(stagger=False), given)
    tasks, history = env.tasks() if tasks is None else tasks, []
    init, run_chunk = _programs(env, agent, settings, len(seeds), level)
    state = init(tasks, jnp.asarray(seeds, jnp.uint32))
    for _ in range(chunks):
        state, metrics = run_chunk(tasks, state)
        history.append(metrics)
    return state, history


def train_objects(env, agent, **given):
    """Train quietly, in a folder too, also what no name makes again. ``given`` are fields of hooks and settings."""
    hooks = Hooks(**{"quiet": True, **{name: given.pop(name) for name in Hooks._fields if name in given}})
    plan = {name: given.pop(name) for name in Plan.__dataclass_fields__ if name in given}
    written = ("settings", "sweep", "profile", "tensorboard", "wandb", "trackio")
    more = {name: given.pop(name) for name in written if name in given}
    config = from_keywords(env, agent, given, plan=plan, start=hooks.start, **more)
    check(config, hooks.start)
    return launch(config, hooks)


def quick(function, *arguments):
    """Compile a function for arguments of these shapes."""
    return jax.jit(function).lower(*arguments).compile(QUICK)


@dataclasses.dataclass(frozen=True)
class Named:
    """A spec that is a key: pictures lie in dicts, which are none."""

    text: str
    spec: Spec = dataclasses.field(compare=False)


@lru_cache
def _agent_programs(agent, named: Named, num_tasks: int, batch_size: int):
    spec = named.spec
    tasks, key = tasks_of("one-step", np.ones(num_tasks)), jax.random.key(0)
    init = lambda tasks, key: agent.init(spec, tasks, key)
    batch = with_memory(agent, random_batch(0, num_tasks, batch_size, spec, agent.view.history))
    learn = partial(update, agent)
    return quick(init, tasks, key), quick(learn, jax.eval_shape(init, tasks, key), batch, tasks, key)


def windows(batch: Transition) -> Transition:
    """Transitions (T, B, ...) as windows (T, B, 1, ...) of one step."""
    return jax.tree.map(lambda x: jnp.expand_dims(x, 2), batch)


def update(agent, state, batch: Transition, tasks: Task, key, number=0):
    """Take a gradient step of an agent on transitions (T, B, ...)."""
    return agent.update(state, windows(batch), tasks, key, jnp.int32(number))


def prepare(agent, state, batch: Transition, tasks: Task):
    """What an agent's losses take of transitions (T, B, ...)."""
    return replay_batches.prepare(agent, state, windows(batch), tasks)


def assessed(agent, state, steps: Transition, tasks: Task):
    """A rollout (T, H, E, ...) assessed, and the batch (T, H E, ...) that the losses take of all its steps."""
    state, steps = agent.assess(state, steps, tasks)
    state, batch = agent.prepare(state, rollouts.windows(steps, agent.unroll), tasks)
    return state, batch, steps


def learn(agent, state, steps: Transition, tasks: Task, key):
    """All that an agent learns from one rollout (T, H, E, ...), as the loop does it."""
    batch_key, update_key = jax.random.split(key)
    state, steps = agent.assess(state, steps, tasks)
    batches = agent.experience.batches(None, agent, tasks, steps, batch_key)

    def step(state, given):
        batch, key, number = given
        return agent.update(state, agent.experience.window(steps, batch), tasks, key, number)

    count = agent.experience.updates
    state, metrics = jax.lax.scan(step, state, (batches, jax.random.split(update_key, count), jnp.arange(count)))
    return agent.observe(state, steps, tasks), jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)


def observe(agent, state, batch: Transition, tasks: Task):
    """Count transitions (T, B, ...) as steps of B environments, whose episodes begin with them unless they say so."""
    shape = (len(tasks.id), 1, batch.reward.shape[1])
    steps = jax.tree.map(lambda x: jnp.expand_dims(x, 1), batch)
    if batch.memory is None:
        task = jax.tree.map(lambda x: x[0], tasks)
        begun = jax.tree.map(lambda x: jnp.broadcast_to(x, (*shape, *x.shape)), agent.begin(state, task))
        steps = steps._replace(memory=begun)
    ended = jnp.zeros(shape, bool) if batch.ended is None else steps.ended
    return agent.observe(state, steps._replace(ended=ended, closed=ended, cut=ended), tasks)


def learner(agent, tasks: Task, batch_size: int, spec: Spec = SPEC):
    """Compile an agent: ``init(tasks, key)`` and ``update(state, batch, tasks, key)``."""
    return _agent_programs(agent, Named(str(spec), spec), len(tasks.id), batch_size)


def pick(tree, index):
    """One row, or several, of every leaf; by NumPy, as JAX would compile a program for every shape."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), tree)


def only_seed(tree):
    """Drop the leading seed axis of a run of one seed."""
    return pick(tree, 0)


def of_task(nets, index: int):
    """What one task uses of a network, ``Params``, or of networks by name."""
    if isinstance(nets, dict):
        return {name: of_task(net, index) for name, net in nets.items()}
    return Params(nets.shared, pick(nets.own, index))


def with_nets(state, **nets):
    """A state with other networks."""
    return state._replace(nets=state.nets | nets)


def values(agent, state, tasks: Task, obs, action) -> np.ndarray:
    """Every critic's estimate (T, N, B) at observations (B,) and actions (B,)."""
    obs, action = jnp.float32(obs)[:, None], jnp.float32(action)[:, None]
    rows = []
    for i in range(len(tasks.id)):
        features = agent.view.features(state, pick(tasks, i))
        rows.append(agent.values(of_task(state.nets, i), features, obs, action))
    return np.stack(rows)


def act(agent, state, obs, task, key, past=None):
    """The action (A,) at an observation (O,) of an episode that has just begun, or after a ``past``."""
    memory = agent.begin(state, task)
    memory = memory if past is None else memory._replace(past=past)
    return agent.act(state, memory, obs, task, key).action


def mean_actions(agent, state, tasks: Task, obs) -> np.ndarray:
    """The mean action (T, B) at observations (B,)."""
    one = lambda task, x: act(agent, state, x, task, None)[0]
    act_all = lambda task: jax.vmap(lambda x: one(task, x))(jnp.float32(obs)[:, None])
    return np.stack([act_all(pick(tasks, i)) for i in range(len(tasks.id))])


def random_batch(seed: int, num_tasks: int, batch_size: int, spec: Spec = SPEC, history: int = 0) -> Transition:
    """A batch (T, B, ...) in which every field is random and about one discount in four is 0."""
    random = np.random.default_rng(seed)
    normal = lambda *shape: jnp.float32(random.normal(size=(num_tasks, batch_size, *shape)))
    numbers = lambda shape: jnp.uint8(random.integers(256, size=(num_tasks, batch_size, *shape)))
    see = lambda: jax.tree.map(lambda x: numbers(x.shape) if x.dtype == jnp.uint8 else normal(*x.shape), seen(spec))
    batch = Transition(
        obs=see(),
        action=jnp.tanh(normal(spec.action_size)),
        reward=normal(),
        discount=jnp.float32(random.random((num_tasks, batch_size)) < 0.75),
        next_obs=see(),
    )
    if not history:
        return batch
    return batch._replace(memory=Memory(random_past(random, (num_tasks, batch_size, history), spec)))


def with_memory(agent, batch: Transition) -> Transition:
    """A batch (T, B, ...) with random hidden states, if the agent has one."""
    if not agent.conditioning.recurs:
        return batch
    begun = agent.conditioning.begin(batch.obs.shape[-1], batch.action.shape[-1])
    hidden = jax.tree.map(lambda x: jax.random.uniform(jax.random.key(0), (*batch.reward.shape, *x.shape)), begun)
    return batch._replace(memory=Memory(None, hidden), **dict.fromkeys(("ended", "closed", "cut"), batch.discount == 0))


def random_past(random: np.random.Generator, shape: tuple[int, ...], spec: Spec = SPEC) -> last_steps.Past:
    """Random last steps (..., H, x), ``shape`` being (..., H), of which the first half had not been taken yet."""
    known = np.broadcast_to(np.arange(shape[-1]) >= shape[-1] // 2, shape).astype(np.float32)
    normal = lambda size: jnp.float32(random.normal(size=(*shape, size)) * known[..., None])
    reward = jnp.float32(random.normal(size=shape) * known)
    return last_steps.Past(normal(spec.obs_size), jnp.tanh(normal(spec.action_size)), reward, jnp.asarray(known))


def adapted_gain(gain, params, before, after, rate, first_order: bool = False):
    """What tasks gain () on average by ``after`` (T, ...), once each has adapted to ``before`` (T, K, ...)."""
    adapt_one = partial(adapt, gain, params, rate=rate, first_order=first_order)
    return jnp.mean(jax.vmap(lambda before, after: gain(adapt_one(before), after))(before, after))


def set_physics(env, task, state, qpos, qvel):
    """Return the state of a domain with the given positions (nq,) and velocities (nv,)."""
    kept = () if state is None else (state.extra, state.mocap)
    return env.simulator.forward(task, jnp.float32(qpos), jnp.float32(qvel), *kept)
