"""Start a run from its configuration: check it, load the policy to fine-tune, print a summary, and train."""

import tomllib
from collections.abc import Sequence
from importlib import resources
from typing import Any

import jax
from jax.sharding import Mesh

from mtjax.agents import preset_of
from mtjax.agents.combinations import require_sight
from mtjax.config import RunConfig
from mtjax.envs import Family
from mtjax.envs.contexts import ranges
from mtjax.envs.task_table import forgetful
from mtjax.frames import shown
from mtjax.learning import combinations
from mtjax.parallel import hosts
from mtjax.parallel.collectives import AXIS
from mtjax.saved.folder import remove_unused
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.training.distillation import require_teachers
from mtjax.training.finetune import require_start
from mtjax.training.journal import NO_HOOKS, Hooks
from mtjax.training.run import train
from mtjax.training.sinks import require_sinks
from mtjax.types import InputError


def check(config: RunConfig, start: Policy | Sequence[Policy] | None = None) -> None:
    """Check a configuration with what it needs, before a folder is made: the environment, devices, and a policy.

    ``RunConfig.checked`` has checked it by itself.

    Args:
        start: the policy to fine-tune, or those that teach, but for a run that has begun.

    Raises:
        InputError: they do not go together.
    """
    family, learner = config.family, config.learner
    if config.env or start is not None:
        require: Any = require_teachers if learner.taught else require_start  # of several policies, or one
        require(config, start)
    if config.env:
        _require_named(config)
    combinations.require_env(config.played, family, learner)
    if config.mesh is not None:
        _require_shared(config, config.mesh)
    require_sinks(config.tensorboard, config.wandb, config.trackio)


def _require_shared(config: RunConfig, mesh: Mesh) -> None:
    """Check that several devices can share a run's worlds."""
    if lost := forgetful(config.family):
        raise InputError(
            f"{lost} steps on the host of one device, and this run is on {mesh.size}; show JAX one, such as by "
            "CUDA_VISIBLE_DEVICES=0"
        )
    if config.learner.experience.adaptations and mesh.shape[AXIS] > 1:
        raise InputError(
            f"this agent adapts by all worlds of a seed together, and {mesh.shape[AXIS]} devices would share them; use "
            "no more devices than seeds, such as by CUDA_VISIBLE_DEVICES=0"
        )


def _require_named(config: RunConfig) -> None:
    """Check what only families and agents with names have."""
    family, learner = config.family, config.learner
    _ = family.engine_name, family.table, family.calls.targets()  # its engine refuses a model that it cannot run
    require_sight(learner, family.spec)
    if preset_of(config.agent).sees_pictures and not shown(family.spec.obs):
        raise InputError(
            f"{config.agent} learns from pictures, and {config.env} shows none: give --env.pixels=64, or for states "
            "use --agent=sac-conditioned, to which --agent.representation=encoded adds an encoder"
        )


def load_start(config: RunConfig) -> Policy | tuple[Policy, ...] | None:
    """Return the policy that this run fine-tunes, the policies that teach its agent, or None."""
    if not config.start:
        return None
    return tuple(map(load, config.start.split(","))) if config.learner.taught else load(config.start)


def launch(config: RunConfig, hooks: Hooks = NO_HOOKS) -> Result:
    """Print what a run does, and train. A run that is refused before it begins leaves no folder."""
    if hosts.is_first() and not hooks.quiet and config.env:
        print(*_introduction(config, hooks), sep="\n", flush=True)
    try:
        return train(config, hooks)
    except InputError:
        if hooks.directory is not None and not hooks.resume and hosts.is_first():
            remove_unused(hooks.directory)
        raise


def _introduction(config: RunConfig, hooks: Hooks) -> list[str]:
    """Return the first lines of a run: what learns, on which tasks, and where the results are."""
    plan = config.plan
    lines = [f"{hooks.label}: {' '.join(config.sweep)}"] if config.sweep else []
    seeds = f"seeds {plan.seed} to {plan.seed + plan.seeds - 1}" if plan.seeds > 1 else f"seed {plan.seed}"
    lines.append(f"{config.agent} on {config.env}: {config.family.summary}, {seeds}")
    lines.append(_sizes(config))
    trials = config.training.trials
    lines += [f"a trial is {trials} episodes of one task"] * (trials > 1)
    lines += [line for line in (_origin(config),) if line]
    lines += [] if hooks.directory is None else [f"run: {hooks.directory}"]
    if hooks.resume and "warp" in config.family.engine_name:
        lines.append("MuJoCo Warp does not repeat bit for bit: the run goes on from its state, in other numbers")
    if hooks.resume and (lost := forgetful(config.family)):
        lines.append(f"worlds of {lost} cannot be saved: new episodes begin, and the run goes on in other numbers")
    if jax.default_backend() == "cpu":
        lines += [_warning(family, agent) for family, agent in slow_on_cpu(config).items() if agent != config.agent]
    if hooks.resume and config.learner.lr_schedule != "constant" and not config.learner.lr_updates:
        lines.append(f"learning rates go on along the schedule of a run of {plan.steps:,} steps")
    return lines


def _sizes(config: RunConfig) -> str:
    """Return a line on how many worlds, and transitions or windows of a batch, a task has, and all tasks together."""
    count, experience = config.played_tasks, config.learner.experience
    drawn = "windows" if config.learner.unroll else "transitions"
    sizes = {"worlds": config.training.num_envs}
    sizes |= {f"{drawn} in a batch": experience.batch_size} if experience.storage.kept else {}
    told = lambda size: f"{size:,}" if count == 1 else f"{size:,} a task, {count * size:,} in all"
    return "; ".join(f"{name}: {told(size)}" for name, size in sizes.items())


def slow_on_cpu(config: RunConfig) -> dict[str, str]:
    """Return those of a run's families that a CPU was not seen to learn in minutes with the default agent.

    Returns:
        family -> the agent that did learn it there, or "" if none was seen to.
    """
    slow = tomllib.loads((resources.files("mtjax") / "configs" / "default.toml").read_text())["slow_on_cpu"]
    names = [part.name.partition("#")[0] or config.env for part in config.family.parts]
    return {name: slow[name] for name in names if name in slow}


def _warning(family: str, agent: str) -> str:
    """Return what to say of a family that a CPU is slow to learn, given the agent that did learn it there, if any."""
    if agent:
        return f"{family} wants a GPU or --agent={agent}, by which one CPU core learned it in five minutes"
    return f"{family} wants a GPU: two CPU cores were not seen to learn it in seven minutes"


def _origin(config: RunConfig) -> str:
    """Return a line on the run that is fine-tuned or teaches, or an empty string."""
    if not config.start:
        return ""
    if config.learner.taught:
        return f"taught by {config.start.replace(',', ', ')}"
    family, told = config.family, config.learner.conditioning.by_parameters
    assert isinstance(family, Family)
    unseen = set(family.varied) - {name for name, _, _ in ranges(family)} if told else ()
    blind = f"; its networks cannot be told {', '.join(sorted(unseen))}" if unseen else ""
    return f"from {config.start}: {config.learner.tune} of its parameters learn{blind}"
