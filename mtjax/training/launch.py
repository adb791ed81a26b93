"""Start a run from its configuration: check it, load the policy to fine-tune, print a summary, and train."""

from pathlib import Path
from typing import Any

import jax

from mtjax import frames
from mtjax.agents import preset_of
from mtjax.checks import path
from mtjax.config import RunConfig, of_objects, require_value_range, slow_on_cpu
from mtjax.envs import Family
from mtjax.parallel import hosts
from mtjax.saved import points
from mtjax.saved.folder import remove_unused
from mtjax.saved.points import Sweep
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.training import sinks
from mtjax.training.finetune import require_fit
from mtjax.training.run import NO_HOOKS, Hooks, mesh_of, played_by, train
from mtjax.types import Agent, Env, InputError


def check(config: RunConfig, start: Policy | None = None) -> None:
    """Check a configuration as a whole, before a folder is made. Nothing after it checks again.

    Args:
        start: the policy to fine-tune, if it is loaded already.

    Raises:
        InputError: family, agent, devices and flags do not go together.
    """
    family = config.family
    sinks.require_libraries(config.tensorboard, config.wandb)
    if config.env:
        _check_named(config, start is not None or bool(config.start))
    mesh_of(config)
    played, _ = played_by(config)
    config.learner.experience.check(family, played.num_envs, played.chunk_steps)
    for learner in points.agents_at(config.learner, config.points):
        require_value_range(learner)
        if start is not None:
            require_fit(start, family, learner)


def _check_named(config: RunConfig, begins: bool) -> None:
    """Check what only families and agents with names have. ``begins``: whether a run is fine-tuned."""
    family, learner = config.family, config.learner
    if not config.runs:  # Path("") would be the working directory
        raise InputError("--runs needs a folder; that of the command is --runs=.")
    path(config.runs, "--runs")
    _ = family.engine_name, family.table, family.targets()  # its engine refuses a model that it cannot run
    learner.require_sight(family.spec)
    _require_pictures(config)
    learner.conditioning.table(family.spec, family.train_count)
    if learner.tune != "all" and not begins:
        raise InputError(f"--tune={learner.tune} leaves the rest as a run left it; say which run: --from=RUN")
    if begins and learner.experience.reset_every:
        raise InputError("--reset-every throws away what --from takes from a run; give one of them")


def _require_pictures(config: RunConfig) -> None:
    """Refuse an agent for pictures in a family that shows none.

    Raises:
        InputError: that is so.
    """
    if not preset_of(config.agent).sees_pictures or frames.shown(config.family.spec.obs):
        return
    raise InputError(
        f"{config.agent} learns from pictures, and {config.env} shows none: give --env.pixels=64, or for states use "
        "--agent=sac-conditioned, to which --agent.representation=encoded adds an encoder"
    )


def load_start(config: RunConfig) -> Policy | None:
    """Return the policy that this run fine-tunes, or None."""
    if not config.start:
        return None
    start = load(config.start)
    require_fit(start, config.family, config.learner)
    return start


def launch(
    config: RunConfig,
    directory: Path | None = None,
    start: Policy | None = None,
    resume: bool = False,
    hooks: Hooks = NO_HOOKS,
) -> Result:
    """Print what a run does, and train it in ``directory`` from the start or from its newest checkpoint."""
    if hosts.is_first() and not hooks.quiet and config.env:
        print(_introduction(config, directory, resume, hooks.label), flush=True)
    try:
        return train(config, directory, start, resume, hooks)
    except InputError:
        if config.env and directory is not None and not resume and hosts.is_first():
            remove_unused(directory)
        raise


def train_objects(
    env: Env,
    agent: Agent,
    directory: str | Path | None = None,
    start: Policy | None = None,
    resume: bool = False,
    sweep: Sweep = (),
    **given: Any,
) -> Result:
    """Train any agent in any environment, also those that no name makes again. Nothing is printed unless asked for.

    Args:
        given: the fields of ``Hooks``, and what ``config.of_objects`` takes.

    Raises:
        InputError: an argument cannot be used.
    """
    hooks = Hooks(**{"quiet": True, **{name: given.pop(name) for name in Hooks._fields if name in given}})
    config = of_objects(env, agent, points=points.grid(sweep), **given)
    if (config.profile or config.tensorboard or config.wandb) and directory is None:
        raise InputError("profile, tensorboard and wandb write into the run's folder; give directory as well")
    check(config, start)
    return launch(config, None if directory is None else Path(directory), start, resume, hooks)


def _introduction(config: RunConfig, directory: Path | None, resume: bool, label: str) -> str:
    """Return the first lines of a run: what learns, on which tasks, and where the results are."""
    plan = config.plan
    lines = [f"{label}: {' '.join(config.sweep)}"] if config.sweep else []
    seeds = f"seeds {plan.seed} to {plan.seed + plan.seeds - 1}" if plan.seeds > 1 else f"seed {plan.seed}"
    lines.append(f"{config.agent} on {config.env}: {config.family.summary}, {seeds}")
    lines.append(_sizes(config))
    lines += [line for line in (_origin(config),) if line]
    lines += [] if directory is None else [f"run: {directory}"]
    if resume and "warp" in config.family.engine_name:
        lines.append("MuJoCo Warp does not repeat bit for bit: the run goes on from its state, in other numbers")
    if jax.default_backend() == "cpu":
        lines += [_warning(family, agent) for family, agent in slow_on_cpu(config.env).items() if agent != config.agent]
    if resume and config.learner.lr_schedule != "constant" and not config.learner.lr_updates:
        lines.append(f"learning rates go on along the schedule of a run of {plan.steps:,} steps")
    return "\n".join(lines)


def _sizes(config: RunConfig) -> str:
    """Return a line on how many worlds and transitions of a batch a task has, and all tasks together."""
    count, experience = config.family.train_count, config.learner.experience
    sizes = {"worlds": config.training.num_envs, "transitions in a batch": getattr(experience, "batch_size", 0)}
    told = lambda size: f"{size:,}" if count == 1 else f"{size:,} a task, {count * size:,} in all"
    return "; ".join(f"{name}: {told(size)}" for name, size in sizes.items() if size)


def _warning(family: str, agent: str) -> str:
    """Return what to say of a family that a CPU is slow to learn, given the agent that did learn it there, if any."""
    if agent:
        return f"{family} wants a GPU or --agent={agent}, by which one CPU core learned it in five minutes"
    return f"{family} wants a GPU: two CPU cores were not seen to learn it in seven minutes"


def _origin(config: RunConfig) -> str:
    """Return a line on the run that is fine-tuned, or an empty string."""
    if not config.start:
        return ""
    family, told = config.family, config.learner.conditioning.by_parameters
    assert isinstance(family, Family)
    unseen = set(family.varied) - {name for name, _, _ in family.ranges} if told else ()
    blind = f"; its networks cannot be told {', '.join(sorted(unseen))}" if unseen else ""
    return f"from {config.start}: {config.learner.tune} of its parameters learn{blind}"
