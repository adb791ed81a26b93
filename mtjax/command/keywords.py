"""``mtjax.train``: names or objects and keyword settings become the configuration of a run, which is then launched."""

import dataclasses
from collections import ChainMap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mtjax import agents
from mtjax.agents import BaseAgent
from mtjax.agents.choices import flag_names, unknown_setting
from mtjax.agents.choices import settings as settings_of
from mtjax.checks import checked, path, shown
from mtjax.config import Plan, RunConfig, configure, fit_length, from_json, own_files, with_preset
from mtjax.envs import BENCHMARKS, ENVS, is_mixture, make, members, name_of
from mtjax.envs.family import Family
from mtjax.envs.tabled import Tabled
from mtjax.loop import Settings
from mtjax.names import InputError, nearest_error, public
from mtjax.parallel import hosts
from mtjax.report.curve import draw
from mtjax.saved import points
from mtjax.saved.folder import record_steps, require_unused, write_config
from mtjax.saved.points import Point, Sweep
from mtjax.saved.policy import Policy, load
from mtjax.saved.result import Result
from mtjax.training.launch import check, launch, train_objects
from mtjax.training.run import Hooks
from mtjax.types import Agent, Env


@dataclasses.dataclass(frozen=True)
class _Told:
    """Holds the types of those arguments of ``train`` that no configuration checks."""

    resume: bool
    profile: bool
    tensorboard: bool
    wandb: str
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
    eval_every: int = Plan.eval_every,
    eval_episodes: int = Plan.eval_episodes,
    settings: Settings | None = None,
    start: Policy | str | Path | None = None,
    sweep: Sweep = (),
    directory: str | Path | None = None,
    resume: bool = False,
    profile: bool = False,
    tensorboard: bool = False,
    wandb: str = "",
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
        steps: environment steps of each seed, summed over tasks. They are rounded up to whole chunks. None takes the
            preset's if both are names, else a million.
        seeds: how many seeds to train at once.
        seed: the first seed.
        eval_every: environment steps between evaluations. 0 means ten evaluations in the run.
        eval_episodes: episodes of each task in every evaluation.
        settings: settings of the training loop; by default the preset's for a name, else ``Settings()``.
        start: the policy to fine-tune, from ``mtjax.load``, or the folder of its run. A family that is given as an
            object is ``new.scaled_as(start.env)``, and the agent ``start.agent``; only learning rates and ``tune`` may
            differ. ``finetune.adopt`` says what is kept.
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
    if start is not None and not isinstance(start, Policy):
        start = load(path(start, "start"))
    agent = start.agent if agent is None and start is not None else agent
    plan = {"seeds": seeds, "seed": seed, "eval_every": eval_every, "eval_episodes": eval_episodes}
    plan |= {} if steps is None else {"steps": steps}
    found = points.grid(sweep)
    if on_chunk is not None and not callable(on_chunk):
        raise InputError(f"on_chunk is a function of a row of metrics, not {_kind(on_chunk)}")
    checked(_Told, {"resume": resume, "profile": profile, "tensorboard": tensorboard, "wandb": wandb})
    checked(_Told, {"quiet": quiet, "label": label})
    if not isinstance(env, str | Tabled) or not isinstance(agent, str | BaseAgent):
        _require_learning(env, agent, directory)
        told = {"quiet": quiet, "label": label, "on_chunk": on_chunk}
        return train_objects(env, agent, start=start, sweep=found, settings=settings, **plan, **told, **given)  # type: ignore
    config = _configured(env, agent, plan, settings, start, given)
    if tensorboard or wandb or profile:
        if directory is None:
            raise InputError("profile, tensorboard and wandb write into the run's folder; give directory as well")
        config = dataclasses.replace(config, profile=profile, tensorboard=tensorboard, wandb=wandb)
    config = dataclasses.replace(config, points=found, sweep=_written(config.learner, found))
    check(config, start)
    hooks = Hooks(on_chunk, quiet=quiet, label=label)
    if directory is not None:
        folder = path(directory)
        hosts.broadcast_path(lambda: _prepare(config, folder, resume))
        result = launch(config, folder, start, resume, hooks)
        draw(config, result.evaluations, folder)
        return result
    if resume:
        raise InputError("resume=True continues the run in a folder; give directory as well")
    return launch(config, None, start, resume, hooks)


def _require_learning(env: Any, agent: Any, directory: Any) -> None:
    """Refuse what is neither a name nor an environment or agent, and a folder for those that no name makes again."""
    if not isinstance(env, str) and (isinstance(env, type) or not hasattr(env, "reset_worlds")):
        several = "; mtjax.mixture takes several" if isinstance(env, list | tuple) else ""
        raise InputError(f"env is the name of a family, or what mtjax.make returns; not {_kind(env)}{several}")
    if not isinstance(agent, str) and (isinstance(agent, type) or not hasattr(agent, "update")):
        raise InputError(f"agent is a name such as 'care', or what mtjax.agent returns; not {_kind(agent)}")
    if directory is not None or isinstance(env, str) or isinstance(agent, str):
        raise InputError("names and a run's folder need an environment derived from Family and an agent from BaseAgent")


def _kind(value: Any) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    return shown(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def _configured(
    env: str | Tabled,
    agent: str | BaseAgent,
    plan: Mapping[str, Any],
    settings: Settings | None,
    start: Policy | None,
    given: Mapping[str, Any],
) -> RunConfig:
    """Return the configuration of a run, with the tuned settings of the command line where names are given."""
    family, given = _family(env, start, dict(given))
    env_name, known = env if isinstance(env, str) else name_of(env), {*_names(Settings)}
    of_agent = {name: value for name, value in given.items() if name not in known}
    if isinstance(agent, str):
        _require_known(of_agent, agents.agent(agent), env_name, family, isinstance(env, str))
        config = with_preset(env_name, agent, "auto", of_agent, family)
        config = config if isinstance(env, str) else dataclasses.replace(config, plan=Plan())
    else:
        config = RunConfig(env_name, agents.name_of(agent), family=family, learner=agent)
        _require_known(
            {k: v for k, v in given.items() if k not in known}, agent, env_name, family, isinstance(env, str)
        )
    base = config.training if settings is None else settings
    if not isinstance(base, Settings):
        raise InputError(f"settings is a mtjax.Settings, not {_kind(base)}; single settings are given by name")
    rest = {name: value for name, value in given.items() if name in known or not isinstance(agent, str)}
    learner, training = configure(config.learner, base, rest)
    config = dataclasses.replace(config, training=training, learner=learner, start=_place_of(start))
    config = dataclasses.replace(config, plan=dataclasses.replace(config.plan, **plan))
    if isinstance(agent, str):
        chosen = {name for name in plan if plan[name] != getattr(Plan, name)}
        config = fit_length(config, {*given, *chosen, *(_names(Settings) if settings is not None else ())})
    named = env_name in ENVS or is_mixture(env_name)
    return dataclasses.replace(config, imports=own_files(config)) if named else config


def _family(env: str | Tabled, start: Policy | None, given: dict[str, Any]) -> tuple[Tabled, dict[str, Any]]:
    """Return the family, and what of ``given`` is not a field of it."""
    if not isinstance(env, str):
        return env, given
    names = [name for name, _ in members(env)]
    unknown = next((name for name in names if name not in ENVS), None)
    if unknown is not None:
        raise nearest_error("environment", unknown, (*ENVS, *BENCHMARKS))
    own = {name for part in names for name in _names(ENVS[part][0])}
    family = make(env, **{name: value for name, value in given.items() if name in own})
    if start is not None and isinstance(family, Family) and isinstance(start.env, Family):
        family = family.scaled_as(start.env)
    return family, {name: value for name, value in given.items() if name not in own}


def _names(cls: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)]


def _require_known(given: Mapping[str, Any], agent: Any, env_name: str, family: Any, by_name: bool) -> None:
    """Refuse a keyword that the agent does not have, and say where it belongs."""
    known = set(settings_of(agent))
    for kind in (name for name in given if name in known and isinstance(given[name], str)):
        with_part = agents.agent(agents.name_of(agent), **{kind: given[kind]}) if kind in _kinds(agent) else agent
        known |= set(settings_of(with_part))
    unknown = next((name for name in given if name not in known), None)
    if unknown is None:
        return
    parameter, value = unknown.replace("_", "-"), given[unknown]
    if parameter in getattr(family, "parameters", ()):
        say = f"vary={{{parameter!r}: {value!r}}}"
        where = f"use {say}" if by_name else f"use mtjax.make({env_name!r}, {say})"
        raise InputError(f"{unknown} is a parameter of {env_name}, not a setting: {where}")
    if unknown in _names(type(family)):
        raise InputError(f"{unknown} is a setting of the environment: use mtjax.make({env_name!r}, {unknown}=...)")
    raise unknown_setting("setting", unknown, [*_names(Settings), *_names(Plan), *sorted(known)])


def _kinds(agent: Any) -> set[str]:
    return {kind for kind in agents.PARTS if hasattr(agent, kind)}


def _place_of(start: Policy | None) -> str:
    return "" if start is None or start.directory is None else str(start.directory)


def _written(agent: Any, found: tuple[Point, ...]) -> tuple[str, ...]:
    """Return points as ``--sweep`` writes them: each number's flag with its values."""
    flags = flag_names(agent) if found else {}
    values = {name: dict.fromkeys(f"{point[name]:.12g}" for point in found) for name in (found[0] if found else ())}
    return tuple(f"{flags.get(name, name)}={','.join(each)}" for name, each in values.items())


def _prepare(config: RunConfig, directory: Path, resume: bool) -> Path:
    """Make the folder of a new run with its config.json, or check that it holds the run to resume."""
    file = directory / "config.json"
    if resume:
        _require_same(config, from_json(file), directory)
        record_steps(file, config.plan.steps)
        return directory
    _require_names(config)
    require_unused(directory)
    directory.mkdir(parents=True, exist_ok=True)
    write_config(directory, config)
    return directory


def _require_names(config: RunConfig) -> None:
    """Refuse a family or an agent that its recorded name does not make again."""
    family: Any = config.family
    again = {
        "env": (family, lambda: make(config.env, **dataclasses.asdict(family))),
        "agent": (config.learner, lambda: agents.agent(config.agent, **settings_of(config.learner))),
    }
    for kind, (made, remake) in again.items():
        try:
            same = remake() == made
        except InputError:
            same = False
        if not same:
            name = type(made).__name__
            raise InputError(f"a run's folder needs a name for {name}: mtjax.register('my-{kind}', {name}) gives one")


def _require_same(config: RunConfig, recorded: RunConfig, directory: Path) -> None:
    """Refuse to resume a run with other settings than it had, apart from its steps."""
    fields = lambda held: {name: getattr(held, name) for name in _names(type(held))}
    alone = lambda config: {"env": config.env, "agent": config.agent, "sweep": config.points}
    parts = lambda config: (config.family, config.training, config.plan)
    every = lambda config: {**alone(config), **settings_of(config.learner), **ChainMap(*map(fields, parts(config)))}
    now, then = ({**every(each), "steps": None} for each in (config, recorded))
    name = next((name for name in {**now, **then} if now.get(name) != then.get(name)), None)
    if name is not None:
        raise InputError(
            f"the run in {str(directory)!r} had {name}={shown(then.get(name))}, not {shown(now.get(name))}; "
            "resume it with the same, or start a new run in another directory"
        )
