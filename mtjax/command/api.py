"""``mtjax.train``: names or objects and keyword settings become the configuration of a run, which is then launched."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mtjax.agents import preset_of
from mtjax.agents.swept import Sweep
from mtjax.checks import checked, path, shown
from mtjax.command.keywords import from_keywords
from mtjax.config import Plan
from mtjax.learning.loop import Settings
from mtjax.names import InputError, public
from mtjax.report.curve import draw
from mtjax.saved.folder import prepare
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.training.journal import Hooks
from mtjax.training.launch import check, launch
from mtjax.types import Agent, Env


@dataclasses.dataclass(frozen=True)
class _Told:
    """Holds the types of those arguments of ``train`` that no configuration checks."""

    resume: bool
    profile: bool
    tensorboard: bool
    wandb: str
    trackio: str
    quiet: bool
    label: str


@public
def train(
    env: str | Env,
    agent: str | Agent | None = None,
    *,
    steps: int | None = None,
    seeds: int = Plan.seeds,
    seed: int = Plan.seed,
    eval_every: int | None = None,
    eval_episodes: int | None = None,
    eval_sampled: bool = Plan.eval_sampled,
    population: str = Plan.population,
    settings: Settings | None = None,
    start: Policy | str | Path | Sequence[Policy | str | Path] | None = None,
    sweep: Sweep = (),
    directory: str | Path | None = None,
    resume: bool = False,
    profile: bool = False,
    tensorboard: bool = False,
    wandb: str = "",
    trackio: str = "",
    quiet: bool = False,
    label: str = "",
    on_chunk: Callable[[dict[str, Any]], Any] | None = None,
    **given: Any,
) -> Result:
    """Train an agent on a family of tasks.

    Devices share the seeds evenly. Devices that are left over share the environments of each seed. Under
    ``jax.distributed`` every process makes the same call. The first process writes and prints. All return the same
    result, except that the leaves of ``Result.state`` are spread over the processes.

    Args:
        env: the family, as ``mtjax.make`` returns it, or its name; it trains on ``env.tasks("train")``.
        agent: the learner, as ``mtjax.agent`` returns it, or its name. A name brings the tuned settings of the command
            line. None takes the agent of ``start``.
        steps: environment steps of each seed, summed over tasks. They are rounded up to whole steps or rollouts of all
            worlds, in chunks of one length. None takes the preset's if both are names, else a million.
        seeds: how many seeds to train at once.
        seed: the first seed.
        eval_every: environment steps between evaluations. 0 means ten evaluations in the run. So does None, but fewer
            in a short run of an agent given by name.
        eval_episodes: episodes of each task in every evaluation. None means ten, and for an agent given by name rounded
            up to whole trials.
        eval_sampled: draw the actions of evaluations from the policy; else they are its mean ones, or the likeliest
            choices.
        population: "pbt:STEPS" or "halving:STEPS" makes a population of all seeds of all points of ``sweep``, as
            ``--population`` does.
        settings: settings of the training loop; by default the preset's for a name, else ``Settings()``.
        start: the policy to fine-tune, from ``mtjax.load``, or the folder of its run. A family that is given as an
            object is ``new.scaled_as(start.env)``, and the agent ``start.agent``; only learning rates and ``tune`` may
            differ. ``finetune.adopt`` says what is kept. For the agent options, also a policy of sketches, whose
            sub-policies become options. For the agent distil, the policies or runs that teach it: one, or a list.
        sweep: numbers of the agent that vary inside one program. Give ``{"actor_lr": [1e-4, 1e-3], "gamma": [0.98,
            0.99]}`` for every combination, or a list of points ``{"actor_lr": 1e-4, "gamma": 0.98}``. Every point has
            all seeds, and the S axis of the result holds them point by point. A seed whose numbers stop being finite
            is given up: its returns become NaN, and the other seeds continue.
        directory: the run's folder, which is made if it is absent: config.json, metrics, evaluations, checkpoints and
            curve.png, for ``mtjax.load``, ``python -m mtjax.evaluate`` and ``--resume``. None writes nothing.
        resume: continue from the newest checkpoint in ``directory``, with the settings of its run; only ``steps`` may
            differ. The number of devices may have changed.
        profile: write a trace of one chunk by ``jax.profiler`` into ``directory``/profile.
        tensorboard: write metrics for TensorBoard into ``directory``/tensorboard.
        wandb: name of a Weights & Biases project to log to.
        trackio: name of a trackio project to log to.
        quiet: print nothing. Else progress is a bar on a terminal, and lines elsewhere, as in notebooks.
        label: the first words of progress lines.
        on_chunk: a function that is called with each chunk's first row of metrics. If it returns True, the run stops
            after the chunk, with a checkpoint.
        given: any setting of ``Settings``, of the agent or of its parts, and of an environment that is given by name:
            ``num_envs=64, batch_size=128, vary={"size": "0.9:1.1:5"}``.

    Raises:
        InputError: an argument cannot be used.
        FloatingPointError: numbers stopped being finite (in a sweep: of every seed). The message names task and step.
    """
    begun = _begun(start, agent)
    if on_chunk is not None and not callable(on_chunk):
        raise InputError(f"on_chunk is a function of a row of metrics, not {shown(on_chunk)}")
    written = {"profile": profile, "tensorboard": tensorboard, "wandb": wandb, "trackio": trackio}
    checked(_Told, {"resume": resume, **written, "quiet": quiet, "label": label})
    if directory is None and (resume or any(written.values())):
        names = ", ".join(["resume", *written])
        raise InputError(f"{names} need the run's folder; give directory as well")
    plan = {"seeds": seeds, "seed": seed, "eval_sampled": eval_sampled, "population": population}
    may_be_none = {"steps": steps, "eval_every": eval_every, "eval_episodes": eval_episodes}
    plan |= {name: value for name, value in may_be_none.items() if value is not None}
    if agent is None and begun is not None:
        agent = (begun if isinstance(begun, Policy) else begun[0]).agent
    config = from_keywords(env, agent, given, plan=plan, settings=settings, start=begun, sweep=sweep, **written)
    check(config, begun)
    folder = None if directory is None else prepare(config, path(directory), resume)
    result = launch(config, Hooks(folder, begun, resume, on_chunk, quiet=quiet, label=label))
    if folder is not None:
        draw(config, result.evaluations, folder)
    return result


def _begun(start: Any, agent: Any) -> Policy | tuple[Policy, ...] | None:
    """Return the policy to fine-tune; for an agent that is taught, the policies that teach it."""
    if start is None:
        return None
    several = isinstance(start, list | tuple)
    found = tuple(x if isinstance(x, Policy) else load(path(x, "start")) for x in (start if several else [start]))
    learner = preset_of(agent).cls if isinstance(agent, str) else agent or (found and found[0].agent)
    if found and learner.taught:  # type: ignore
        return found
    if several:
        raise InputError("start is one policy, or for agent='distil' a list of those that teach it")
    return found[0]
