"""The configuration of a run: names, presets and settings, read from and written to JSON."""

import dataclasses
import math
import sys
import tomllib
from collections.abc import Collection, Mapping
from functools import cached_property
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import jax
import tyro
from jax.sharding import Mesh

from mtjax.agents import BaseAgent, agent, preset_of, settings, tuned_as
from mtjax.agents import name_of as agent_name_of
from mtjax.agents.hyperparameters import kinds_of, of_record, replace, require_value_range
from mtjax.agents.parts.policies import Gaussian, policy_for
from mtjax.agents.rates import planned
from mtjax.agents.swept import agents_at
from mtjax.agents.teacher import Teacher
from mtjax.checks import MOST_EPISODES, check_fields, path, require_counts, require_not_negative, require_text
from mtjax.envs import make
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.experience import Rollouts
from mtjax.learning import combinations, populations, trials
from mtjax.learning.loop import Settings
from mtjax.names import PRESETS, nearest_error, public
from mtjax.parallel import mesh as meshes
from mtjax.types import Agent, Env, InputError

TUNED_TASKS = 10
"""How many tasks a preset was tuned with if its file does not say so."""
_EVALUATED = 3  # the most steps that all evaluations play, in steps of the run
_LEAST = {"num_envs": 1, "batch_size": 4}  # of each task, however many tasks there are
_MOST_STEPS, _MOST_SEEDS = 10**15, 10**5
NO_FINE_TUNING = "fine-tuning takes the networks of one family's tasks to other tasks of the same shapes"


@dataclasses.dataclass(frozen=True)
class Plan:
    """How long a run lasts, over which seeds, and when it is evaluated."""

    steps: int = 1_000_000
    """Environment steps of each seed, summed over tasks. They are rounded up to whole steps of all worlds,
    or whole rollouts of them, in chunks of one length."""
    seed: int = 0
    """The first seed."""
    seeds: int = 1
    """How many seeds to train at once, in one program."""
    eval_every: int = 0
    """Environment steps between evaluations, rounded up to whole chunks. 0 means ten evaluations in the run, and fewer
    in a short one."""
    eval_episodes: int = 10
    """Episodes of each task in every evaluation."""
    eval_sampled: bool = False
    """Draw the actions of evaluations from the policy, as in training. Else they are its mean ones, or the likeliest
    choices."""
    population: str = ""
    """Train all seeds of all swept numbers as one population: pbt:STEPS or halving:STEPS. At evaluations, every STEPS
    environment steps of each member, pbt replaces the worst fifth by copies of the best fifth, with swept numbers
    multiplied by 0.8 or 1.2; halving replaces the worse half by copies of the better one. Without --eval-every there is
    an evaluation at each."""

    def __post_init__(self):
        check_fields(self, steps=_MOST_STEPS, eval_every=_MOST_STEPS, seeds=_MOST_SEEDS, eval_episodes=MOST_EPISODES)
        require_counts(self, "steps", "seeds", "eval_episodes")
        require_not_negative(self, "seed", "eval_every")
        if self.seed + self.seeds > 2**31:
            raise InputError(f"seeds must end below 2^31, and {self.seed} + {self.seeds} does not")
        _ = self.rule

    @property
    def all_seeds(self) -> range:
        """Return the seeds that are trained at once."""
        return range(self.seed, self.seed + self.seeds)

    @property
    def interval(self) -> int:
        """Return the environment steps between evaluations."""
        return self.eval_every or (self.rule.steps if self.rule else math.ceil(self.steps / 10))

    @property
    def rule(self) -> populations.Rule | None:
        """Return how members of the population give way to others, or None for independent seeds."""
        return populations.read(self.population)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Train a multi-task agent: ``python -m mtjax.train --env=NAME --agent=NAME``."""

    env: str = "finger-spin-vary-size"
    """Name of the environment family. --list shows all names. --import=FILE.py runs a file that registers families,
    agents or parts of your own. NAME+NAME is a mixture of families: --engine, --split and --env.FIELD then hold for
    every family that has such a flag, and --env.vary.NAME.PARAMETER=VALUES holds for the family NAME. Benchmarks, such
    as mt10, are mixtures."""
    agent: str = "sac-conditioned"
    """Name of the agent. --list shows all names. Its parts are chosen by --agent.conditioning, --agent.representation,
    --agent.encoder, --agent.gradients, --agent.value, --agent.target, --agent.scaling, --agent.sampler,
    --agent.continual and --agent.plasticity, each by name. A part adds its own flags."""
    preset: Literal["auto", "cpu", "gpu"] = "auto"
    """Tuned defaults of the flags below for one kind of device. auto takes the device that JAX runs on."""
    runs: str = "runs"
    """Folder in which the run makes a folder of its own."""
    resume: str = ""
    """Folder of the run to resume. Of the settings only --steps may be given beside it."""
    start: Annotated[str, tyro.conf.arg(name="from")] = ""
    """Folder of a run whose agent is fine-tuned on this environment's tasks. Agent and networks are those of that run;
    learning rates and --tune may be given. Parameters of a single task start from the nearest training task of that
    run. Seed number k starts from seed k modulo the number of its seeds. With --agent=options, also a run of sketches,
    whose sub-policies become options. With --agent=distil, the run from whose policies a new one learns; RUN,RUN,...
    are several."""
    sweep: tuple[str, ...] = ()
    """Train once for every combination of values, such as agent.actor-lr=1e-4,1e-3 agent.num-experts=2,4. Flags are
    written without their dashes. Real numbers of the agent vary inside one program, beside the seeds. Other settings
    run as one program after another. The sweep's folder holds a table of all settings; --resume takes this folder."""
    points: Annotated[tuple[dict[str, float], ...], tyro.conf.Suppress] = ()
    teacher: Annotated[Any, tyro.conf.Suppress] = None
    search: int = 0
    """Look for good real numbers of the agent in so many trials. Ranges are flags such as --agent.actor-lr=1e-5..1e-2.
    A round of trials trains as one program. At each of --search-rungs its better half goes on (pip install
    'mtjax[search]'). The search's folder holds a table of all trials; --resume takes this folder."""
    search_batch: int = 0
    """Trials of a round. 0 means a quarter of all."""
    search_rungs: int = 3
    """How often a round is judged: at its end, and before it after half of the steps, a quarter and so on. With 3 it
    takes half of the steps of as many runs, with 5 and 16 trials or more a fifth; with 1 all go to the end."""
    quick: bool = False
    """Learn something in some 35 seconds of processor time: a point mass reaches ten goals. Other flags change it."""
    config: str = ""
    """TOML file with flags; those on the command line override it. A key is a flag without its dashes. The table agent
    holds --agent.NAME, the table env holds --env.NAME; there, name is the agent or the environment itself."""
    imports: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()
    tensorboard: bool = False
    """Write metrics for TensorBoard into the run's folder (pip install 'mtjax[tensorboard]')."""
    wandb: str = ""
    """Name of the Weights & Biases project to log to, with one run for each seed (pip install 'mtjax[wandb]').
    WANDB_MODE=offline keeps the logs in the run's folder."""
    trackio: str = ""
    """Name of the trackio project to log to, with one run for each seed (pip install 'mtjax[trackio]'). It is on this
    machine, where `trackio show` opens it, or in the Hugging Face Space that TRACKIO_SPACE_ID names."""
    view: int = 0
    """Show the run on a page of this machine while it lasts: its curves, and its newest policy in worlds that move. The
    number is the page's port; --view alone takes 8008."""
    profile: bool = False
    """Write a trace of one warm chunk by JAX's profiler into the run's folder."""
    distributed: bool = False
    """Run as one of several processes that share the seeds, each on its own devices. Start every process with the same
    command by SLURM's srun, Open MPI or Kubernetes. Elsewhere set JAX_COORDINATOR_ADDRESS (host:port of process 0),
    JAX_NUM_PROCESSES and JAX_PROCESS_ID in the environment. All processes must see the folder of --runs."""
    list: bool = False
    """Print the families and agents, then stop."""
    plan: Annotated[Plan, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Plan)
    training: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)
    family: Annotated[Any, tyro.conf.arg(name="env")] = dataclasses.field(default_factory=lambda: make("finger-spin"))
    learner: Annotated[BaseAgent, tyro.conf.arg(name="agent")] = dataclasses.field(default_factory=lambda: agent("sac"))

    def __post_init__(self):
        learner = _with_policy(self.learner, self.family)
        object.__setattr__(self, "learner", _with_teacher(learner, self.teacher, self.family))

    @property
    def members(self) -> int:
        """Return the length of S: the seeds of all points."""
        return self.plan.seeds * max(len(self.points), 1)

    @property
    def samples(self) -> populations.Samples:
        """Return the settings and seeds that statistics tell apart."""
        return populations.Samples.of(self.points, self.plan.all_seeds, self.plan.population)

    @cached_property
    def num_tasks(self) -> int:
        """Return the number of training tasks."""
        return len(self.family.task_values("train"))  # for which no task is built

    @property
    def played_tasks(self) -> int:
        """Return the number of training tasks that are played at a time."""
        return self.training.plays.count(self.num_tasks)

    @property
    def worlds(self) -> int:
        """Return the number of environments of each seed, summed over the tasks that are played at a time."""
        return self.played_tasks * self.training.num_envs

    @property
    def warmup(self) -> int:
        """Return the environment steps of a run under random actions, before learning begins."""
        return self.learner.experience.warmup_steps * self.worlds

    @cached_property
    def played(self) -> Settings:
        """Return the training settings with the chunks that are played, which divide the run evenly."""
        return fit_chunk(self.training, self.played_tasks, self.plan.steps, self.learner.experience.steps)

    @property
    def steps_per_chunk(self) -> int:
        """Return the environment steps of a chunk that is played, summed over tasks."""
        return self.played.chunk_steps * self.worlds

    @property
    def length(self) -> int:
        """Return the steps that every environment plays, in whole chunks."""
        return math.ceil(self.plan.steps / self.steps_per_chunk) * self.played.chunk_steps

    @cached_property
    def trained(self) -> BaseAgent:
        """Return the agent as it is trained, with its schedule's length."""
        return planned(self.learner, self.length) if isinstance(self.learner, BaseAgent) else self.learner

    @property
    def longest(self) -> int:
        """Return the most iterations that a chunk has, however many steps the run takes."""
        grain = self.learner.experience.steps
        return math.ceil(self.training.chunk_steps / grain) * grain

    @cached_property
    def mesh(self) -> Mesh | None:
        """Return the devices of the run, or None for a single one.

        Raises:
            InputError: they cannot share its seeds and worlds evenly.
        """
        return meshes.mesh_for(self.members, self.played_tasks, self.training.num_envs)

    def checked(self, **changes: Any) -> "RunConfig":
        """Return the configuration with changes, as runs take it: its settings, agent and length go together.

        Both ``mtjax.train`` and the command line make theirs by it. It builds no environment, and looks at no device;
        ``launch.check`` checks what depends on these.

        Raises:
            InputError: they do not go together.
        """
        made = dataclasses.replace(self, **changes)
        if made.env:
            if not made.runs:  # Path("") would be the working directory
                raise InputError("--runs needs a folder; that of the command is --runs=.")
            path(made.runs, "--runs")
        made._check_population()
        trials.require_whole(made.plan.eval_episodes, made.training.trials, "eval-episodes")
        combinations.require_agent(made.played, made.learner)
        for learner in agents_at(made.learner, made.points):
            require_value_range(learner)
        return made

    def _check_population(self) -> None:
        """Check that there are members to choose from, and evaluations to choose by."""
        rule, plan, told = self.plan.rule, self.plan, f"--population={self.plan.population}"
        if rule is None:
            return
        if rule.explores and not self.points:
            raise InputError(
                f"{told} perturbs numbers of the agent that are swept, and none is; give such as "
                "--sweep agent.actor-lr=1e-4,1e-3"
            )
        if self.members < 2:
            raise InputError(f"{told} needs several members, and one seed of one setting is one; give --seeds=10")
        if rule.steps >= plan.steps:
            raise InputError(f"{told} changes nothing in a run of {plan.steps:,} steps; give fewer steps to it")
        if rule.steps % plan.interval:
            raise InputError(f"{told} chooses at evaluations: give a multiple of --eval-every={plan.interval}")
        if rule.steps < self.steps_per_chunk:
            raise InputError(
                f"{told} chooses between chunks, of {self.steps_per_chunk:,} steps; give more steps, or a lower "
                "--chunk-steps"
            )


@public
def with_preset(
    env_name: str,
    agent_name: str,
    preset_name: str = "auto",
    agent_settings: Mapping[str, Any] = MappingProxyType({}),
    family: Any = None,
    training_settings: Mapping[str, Any] = MappingProxyType({}),
    **family_settings: Any,
) -> RunConfig:
    """Return the configuration of a family and an agent with the tuned settings of a preset.

    Args:
        agent_settings: values that replace those of the preset.
        family: the family if it is made already; by default it is made from its name and ``family_settings``.
        training_settings: values of ``Settings`` that replace those of the preset. The preset is fitted to as many
            tasks as their curriculum plays at a time.
        family_settings: fields of the family.

    Raises:
        InputError: a name or setting is unknown.
    """
    made = make(env_name, **family_settings) if family is None else family
    require_text(agent_name, "agent")
    require_text(preset_name, "preset")
    if preset_name not in PRESETS:
        raise nearest_error("preset", preset_name, PRESETS)
    device = preset_name
    if device == "auto":
        device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    preset, common = load_preset(env_name, device), load_preset("+", device)
    table = lambda name: common.get(name, {}) | preset.get(name, {})
    tuned, seen = tuned_as(agent_name), any(part.family.pixels for part in made.parts)
    chosen = table(tuned) | (table(f"{tuned}-pictures") if seen else {})
    if preset_of(agent_name).cls.common_presets:
        from_pictures = table("pictures") if seen else {}
        chosen = preset.get("training", {}) | preset.get("agent", {}) | from_pictures | chosen
    chosen = for_tasks(chosen, Settings(**training_settings).plays.count(made.train_count), device)
    take = lambda cls: {name: chosen.pop(name) for name in list(chosen) if name in cls.__dataclass_fields__}
    plan, played = preset.get("plan", {}) | take(Plan), take(Settings)
    config = RunConfig(
        env=env_name,
        agent=agent_name,
        preset=preset_name,  # type: ignore
        plan=Plan(**plan),
        training=Settings(**{**played, **training_settings}),
        family=made,
        learner=agent(agent_name, **{**chosen, **agent_settings}),
    )
    return fit_minibatches(config, {*agent_settings, *training_settings})


def for_tasks(preset: Mapping[str, Any], count: int, device: str) -> dict[str, Any]:
    """Return a preset's settings for ``count`` tasks at a time; ``tuned_tasks`` says with how many it was tuned.

    A GPU steps thousands of worlds as fast as few. So there all tasks together have as many worlds, and transitions
    in a batch, as the tuned number of tasks, however many tasks there are. On a CPU an agent learns from few worlds of
    one task sooner than from many, as each step of its worlds is followed by as many updates. So there ``num_envs``
    and ``batch_size`` hold for each task, up to the tuned number of tasks. A preset that gives ``worlds``, as PPO's,
    says how many all tasks have together on either device. docs/results/task-counts.md has the runs.

    Args:
        device: cpu or gpu.
    """
    chosen = dict(preset)
    tuned = chosen.pop("tuned_tasks", TUNED_TASKS)
    share = lambda whole, least: max(math.ceil(whole / count), least)
    if "worlds" in chosen:
        return chosen | {"num_envs": share(chosen.pop("worlds"), 1)}
    if device == "cpu" and count <= tuned:
        return chosen
    return chosen | {name: share(chosen[name] * tuned, least) for name, least in _LEAST.items() if name in chosen}


def fit_minibatches(config: RunConfig, given: Collection[str]) -> RunConfig:
    """Return a configuration whose minibatches share whole windows, if each window is all of a world's rollout.

    An agent with a memory has a window for each world of a task, and a pass leaves out those that do not divide evenly.
    So a minibatch has the least whole number of windows with which there are no more minibatches than asked for, and
    there are as many worlds as the minibatches take: 42 in 14 for 41 in 16.

    Args:
        given: names of settings that somebody chose, which stay as they are.
    """
    rollouts, num_envs = config.learner.experience, config.training.num_envs
    if not isinstance(rollouts, Rollouts) or not config.learner.unroll:
        return config
    size, count = math.ceil(num_envs / rollouts.minibatches), rollouts.minibatches
    if "minibatches" not in given:
        count = min(count, num_envs if "num_envs" in given else math.ceil(num_envs / size))
    training = config.training
    if "num_envs" not in given:
        training = dataclasses.replace(training, num_envs=size * count)
    learner = dataclasses.replace(config.learner, experience=dataclasses.replace(rollouts, minibatches=count))
    return dataclasses.replace(config, training=training, learner=learner)


def fit_chunk(settings: Settings, num_tasks: int, steps: int, grain: int = 1) -> Settings:
    """Return settings whose chunks, each a multiple of ``grain`` steps, make a run hardly longer than ``steps``.

    One program plays all chunks, so that they have one length: the longest of those that leave the last chunk fullest.
    There may be 50 chunks, or four times as many as are needed. So a run takes ``steps``, rounded up to ``grain`` steps
    of all its worlds, and at most 2% more.
    """
    units = math.ceil(steps / (num_tasks * settings.num_envs * grain))
    least = math.ceil(units / math.ceil(settings.chunk_steps / grain))
    counts = range(least, min(max(4 * least, 50), least + 100) + 1)
    lengths = {math.ceil(units / count) for count in counts}
    chunk = min(lengths, key=lambda length: (-units % length, -length))
    if every := settings.plays.steps:  # tasks change between chunks
        longest = max(lengths)
        chunk = next((length for length in range(longest, 1, -1) if every % (length * grain) == 0), 1)
    return dataclasses.replace(settings, chunk_steps=chunk * grain)


def fit_length(config: RunConfig, given: Collection[str]) -> RunConfig:
    """Return a configuration whose warm-up, chunks and evaluations fit a short run, and whose minibatches its worlds.

    Random actions take at most a tenth of the run, and so does a chunk. All evaluations together play at most three
    times as many steps on training tasks as the run, but there is one at the end. They play whole trials.

    Args:
        given: names of settings that somebody chose, which stay as they are.
    """
    config = fit_minibatches(config, given)
    plan, training, experience = config.plan, config.training, config.learner.experience
    count = config.played_tasks
    tenth = plan.steps // (10 * count * training.num_envs)
    if "chunk_steps" not in given:
        longest = tenth if plan.rule is None else min(tenth, plan.rule.steps // config.worlds)
        training = dataclasses.replace(training, chunk_steps=min(training.chunk_steps, max(longest, experience.steps)))
    if "eval_episodes" not in given:  # whole trials
        plan = dataclasses.replace(plan, eval_episodes=trials.at_least(plan.eval_episodes, training.trials))
    if "eval_every" not in given and not plan.eval_every and plan.rule is None:
        each = config.num_tasks * plan.eval_episodes * config.family.episode_length
        often = min(max(_EVALUATED * plan.steps // each, 1), 10)
        plan = dataclasses.replace(plan, eval_every=0 if often == 10 else math.ceil(plan.steps / often))
    if experience.warmup_steps > tenth and "warmup_steps" not in given:  # else no model is compiled for sizes
        least = max(experience.length(config.family.spec), config.learner.unroll, 1)
        experience = dataclasses.replace(experience, warmup_steps=min(experience.warmup_steps, max(tenth, least)))
    learner = dataclasses.replace(config.learner, experience=experience)
    return dataclasses.replace(config, plan=plan, training=training, learner=learner)


def configure(agent: Agent, settings: Settings, given: Mapping[str, Any]) -> tuple[Any, Settings]:
    """Return the agent and the loop's settings with the given values in place of their own.

    Raises:
        InputError: neither has a setting of that name, or a value is not allowed.
    """
    loop_names = {field.name for field in dataclasses.fields(Settings)}
    loop_values = {name: value for name, value in given.items() if name in loop_names}
    rest = {name: value for name, value in given.items() if name not in loop_values}
    return replace(agent, rest), dataclasses.replace(settings, **loop_values)


def _with_policy(agent: Agent, env: Env) -> Any:
    """Return the agent with the policy for an environment's actions.

    A policy of a family's continuous ones needs no size, which may take a compiled model.
    """
    if not isinstance(agent, BaseAgent):
        return agent
    policy = Gaussian() if isinstance(env, FamilyOrMixture) and not env.discrete else policy_for(env.spec.action)
    return agent if agent.policy == policy else dataclasses.replace(agent, policy=policy)


def describe_teacher(agent: BaseAgent, tasks: int, context: int, runs: int) -> dict[str, Any]:
    """Return the record of an agent that teaches, of values as JSON has them.

    Args:
        tasks: on how many tasks each run has trained it.
        context: size of their contexts.
        runs: how many runs have trained one.
    """
    sizes = {"tasks": tasks, "context": context, "runs": runs}
    plain = {name: list(x) if isinstance(x, tuple) else x for name, x in settings(agent).items()}
    return {"agent": agent_name_of(agent), "settings": plain, **sizes}


def _with_teacher(learner: Any, record: Mapping[str, Any] | None, env: Env) -> Any:
    """Return the agent with the teacher that a record describes, if there is one."""
    if record is None:
        return learner
    own = of_record(preset_of(record["agent"]).cls, record["settings"])
    made = _with_policy(agent(record["agent"], **own), env)
    teacher = Teacher(made, *(record[size] for size in ("tasks", "context", "runs")))
    return dataclasses.replace(learner, teacher=teacher)


def load_preset(env_name: str, name: str) -> dict[str, Any]:
    """Read the tables of a preset: those of the family's file, else its domain's, and others of the default file.

    Environments of other packages have the file of their suite and last word, such as gymnax-minatar, else of their
    suite. Mixtures of such have it too where it is the same for all; others without a name use the default file.
    """
    folder, names = resources.files("mtjax") / "configs", _preset_files(env_name)
    own = next((file for n in names if (file := folder / f"{n}.toml").is_file()), None)
    read = lambda file: tomllib.loads(file.read_text())
    return read(folder / "default.toml")[name] | ({} if own is None else read(own).get(name, {}))


def _preset_files(env_name: str) -> list[str]:
    """Return the names that a family's file may have, the first ones before others."""
    of_suites = [name.partition(":") for name in env_name.split("+")]
    if all(environment for *_, environment in of_suites):
        suites = {suite for suite, *_ in of_suites}
        kinds = {f"{suite}-{environment.split('-')[-1].lower()}" for suite, _, environment in of_suites}
        return [name for found in (kinds, suites) if len(found) == 1 for name in found]
    words = [] if "+" in env_name else env_name.split("-")
    return ["-".join(words[:n]) for n in range(len(words), 0, -1)]


def own_files(config: RunConfig) -> tuple[str, ...]:
    """Return the files of --import, and those with the user's own classes that a configuration uses."""
    parts = [config.learner, *(getattr(config.learner, kind) for kind in kinds_of(config.learner))]
    families = [part.family for part in config.family.parts]
    made = [type(each).__module__ for each in (*families, *parts)]
    modules = dict.fromkeys([*made, *(module for family in families for module in family.built_by)])
    own = [sys.modules.get(name) for name in modules if name.split(".")[0] != "mtjax"]
    files = [*(getattr(module, "__file__", None) for module in own), preset_of(config.agent).home]
    return tuple(dict.fromkeys([*config.imports, *(str(Path(file).resolve()) for file in files if file)]))
