"""Start a run from its configuration: check it, load the policy to fine-tune, print a summary, and train."""

import dataclasses
from pathlib import Path

import jax

from mtjax.agents.parts.conditioning import load_vectors
from mtjax.config import RunConfig, require_value_range, wants_gpu
from mtjax.envs import Family
from mtjax.parallel import hosts, mesh
from mtjax.training import points
from mtjax.training.finetune import require_fit
from mtjax.training.policy import Policy, load
from mtjax.training.run import Result, train
from mtjax.types import InputError


def check(config: RunConfig) -> None:
    """Check a configuration as a whole, before a folder is made.

    Raises:
        InputError: family, agent, devices and flags do not go together.
    """
    family = config.family
    _ = family.engine_name, family.table
    mesh.mesh_for(config.plan.seeds, family.train_count, config.training.num_envs)
    config.learner.experience.check(family, config.training.num_envs)
    for learner in points.agents_at(config.learner, config.points):
        require_value_range(learner)
    if config.learner.vectors:
        load_vectors(config.learner.vectors, family.train_count)
    tune = config.learner.tune
    if tune != "all" and not config.start:
        raise InputError(f"--tune={tune} leaves the rest as a run left it; say which run: --from=RUN")
    if config.start and config.learner.experience.reset_every:
        raise InputError("--reset-every throws away what --from takes from a run; give one of them")


def load_start(config: RunConfig) -> Policy | None:
    """Return the policy that this run fine-tunes, or None."""
    if not config.start:
        return None
    start = load(config.start)
    require_fit(start, config.family, config.learner)
    return start


def launch(config: RunConfig, directory: Path, start: Policy | None, resume: bool, label: str = "") -> Result:
    """Print what a run does, and train it in ``directory`` from the start or from its newest checkpoint."""
    said = f"{label}: {' '.join(config.sweep)}\n" if config.sweep else ""
    origin = f"{_origin(config)}run: {directory}"
    if resume and "warp" in config.family.engine_name:
        origin += "\nMuJoCo Warp does not repeat bit for bit: the run goes on from its state, in other numbers"
    if jax.default_backend() == "cpu" and wants_gpu(config.env):
        origin += f"\n{config.env} wants a GPU: two CPU cores were not seen to learn it in seven minutes"
    plan = config.plan
    if resume and config.learner.lr_schedule != "constant" and not config.learner.lr_updates:
        origin += f"\nlearning rates go on along the schedule of a run of {plan.steps:,} steps"
    seeds = f"seeds {plan.seed} to {plan.seed + plan.seeds - 1}"
    if hosts.is_first():
        print(f"{said}{config.agent} on {config.env}: {config.family.summary}, {seeds}\n{origin}", flush=True)
    return train(
        config.family,
        config.learner,
        **dataclasses.asdict(plan),
        settings=config.training,
        start=start,
        sweep=config.points,
        directory=directory,
        resume=resume,
        profile=config.profile,
        label=label,
        quiet=False,
    )


def _origin(config: RunConfig) -> str:
    """Return a line on the run that is fine-tuned, or an empty string."""
    if not config.start:
        return ""
    family, told = config.family, config.learner.conditioning == "parameters"
    assert isinstance(family, Family)
    unseen = set(family.varied) - {name for name, _, _ in family.ranges} if told else ()
    blind = f"; its networks cannot be told {', '.join(sorted(unseen))}" if unseen else ""
    return f"from {config.start}: {config.learner.tune} of its parameters learn{blind}\n"
