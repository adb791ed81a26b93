"""``python -m mtjax.train``: train an agent on a family of tasks, and keep all there is to know of it in a folder."""

import dataclasses
import itertools
import json
import os
import platform
import shlex
import sys
import time
import types
from collections.abc import Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mtjax import __version__, cli, devices, hindsight
from mtjax.agents import settings
from mtjax.cli import Program
from mtjax.finetune import require_fit
from mtjax.policy import Policy, load
from mtjax.run import Result, enable_compile_cache, train
from mtjax.types import InputError

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")


def main(argv: Sequence[str]) -> None:
    """Parse the command line, train, and say where the run is and how each split scored."""
    from mtjax import rounds, sweep

    if "--distributed" in argv:
        devices.initialise()  # before anything asks which devices there are
    argv = cli.import_files(argv)
    if sweep.wanted(argv):
        if "--distributed" in argv:
            raise InputError("a sweep runs in one process; leave out --distributed")
        return sweep.main(argv)
    program = cli.parse(argv)
    if program.list:
        print(cli.catalogue())
        return
    resume = any(word.split("=", 1)[0] == "--resume" for word in argv)
    directory = Path(program.resume) if resume else None
    if directory is not None:
        program = recorded(program, directory, argv)
    enable_compile_cache()
    check(program)
    start = starting(program) if directory is None else None
    if directory is None and rounds.too_many_seeds(program):
        return sweep.begin([program], "rounds")
    directory = devices.agreed(partial(_prepare, program, directory))
    result = launch(program, directory, start, resume)
    if devices.is_first():
        _conclude(program, result, directory)


def _prepare(program: Program, directory: Path | None) -> Path:
    """Make the run's folder with the record of it, or bring that of a run to go on with up to date."""
    if directory is not None:
        record_steps(directory / "config.json", program.plan.steps)
        return directory
    directory = new_directory(Path(program.runs), f"{program.env}-{program.agent}")
    (directory / "config.json").write_text(cli.to_json(program, circumstances(program)))
    return directory


def launch(program: Program, directory: Path, start: Policy | None, resume: bool, label: str = "") -> Result:
    """Run a program in its folder, from the start or from its newest checkpoint, and say what it is."""
    said = f"{label}: {' '.join(program.sweep)}\n" if program.sweep else ""
    origin = f"{_origin(program)}run: {directory}"
    if devices.is_first():
        print(f"{said}{program.agent} on {program.env}: {_summary(program)}\n{origin}", flush=True)
    plan = dataclasses.asdict(program.plan)
    return train(
        program.family,
        program.learner,
        **plan,
        settings=program.training,
        start=start,
        sweep=program.points,
        directory=directory,
        resume=resume,
        profile=program.profile,
        label=label,
        quiet=False,
    )


def recorded(program: Program, directory: Path, argv: Sequence[str]) -> Program:
    """The program of the run to go on with; ``--steps`` may extend it, and nothing else that it computes may change."""
    given = {word.split("=", 1)[0] for word in argv if word.startswith("--")}
    allowed = {"--resume", "--steps", "--import", "--distributed", "--profile"}
    if given - allowed:
        other = ", ".join(sorted(given - allowed))
        raise InputError(f"--resume goes on with a run as it was; only --steps may change, not {other}")
    recorded = cli.from_json(directory / "config.json")
    steps = program.plan.steps if "--steps" in given else recorded.plan.steps
    now = {"plan": dataclasses.replace(recorded.plan, steps=steps)}
    return dataclasses.replace(recorded, **now, profile=program.profile, distributed=program.distributed)


def record_steps(file: Path, steps: int) -> None:
    """Write how far a run goes now, so that resuming it once more goes as far."""
    record = json.loads(file.read_text())
    if record["plan"]["steps"] == steps:
        return
    record["command"] = record["command"].replace(f" --steps={record['plan']['steps']} ", f" --steps={steps} ")
    record["plan"]["steps"] = steps
    new = file.with_suffix(".new")
    new.write_text(json.dumps(record, indent=2) + "\n")
    os.replace(new, file)


def check(program: Program) -> None:
    """Meet whatever the family's and the agent's constructors could not check before a run's folder is made."""
    from mtjax.agents.conditioning import load_vectors

    family = program.family
    _ = family.engine_name, family.table
    devices.mesh_for(program.plan.seeds, family.train_count, program.training.num_envs)
    if program.training.hindsight:
        hindsight.require(family)
    if program.learner.vectors:
        load_vectors(program.learner.vectors, family.train_count)
    tune = program.learner.tune
    if tune != "all" and not program.start:
        raise InputError(f"--tune={tune} leaves the rest as a run left it; say which run: --from=RUN")
    if program.start and program.training.reset_every:
        raise InputError("--reset-every throws away what --from takes from a run; give one of them")


def starting(program: Program) -> Policy | None:
    """What the run learned that is to be fine-tuned, if one is."""
    if not program.start:
        return None
    start = load(program.start)
    require_fit(start, program.family, program.learner)
    return start


def _origin(program: Program) -> str:
    """A line on what is fine-tuned, if something is."""
    if not program.start:
        return ""
    family, told = program.family, program.learner.conditioning == "parameters"
    unseen = set(family.varied) - {name for name, _, _ in family.ranges} if told else ()
    blind = f"; its networks cannot be told {', '.join(sorted(unseen))}" if unseen else ""
    return f"from {program.start}: {program.learner.tune} of its parameters learn{blind}\n"


def new_directory(root: Path, name: str) -> Path:
    """Make a folder that did not exist before."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    root.mkdir(parents=True, exist_ok=True)
    for attempt in range(1000):
        directory = root / (f"{name}-{stamp}" + (f"-{attempt}" if attempt else ""))
        try:
            directory.mkdir()
            return directory
        except FileExistsError:
            continue
    raise InputError(f"cannot find a new name for a run in {str(root)!r}")


def circumstances(program: Program) -> dict:
    """What else decides a run's numbers: versions, device, engine; and the command that repeats it."""
    import jax

    versions = {"mtjax": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "engine": program.family.engine_name,
        "device": str(jax.devices()[0].device_kind),
        "python": platform.python_version(),
        "versions": versions,
        "command": shlex.join(["python", "-m", "mtjax.train", *repeat(program)]),
    }


def repeat(program: Program) -> list[str]:
    """Every flag of this program, so that the command means the same whatever the presets become."""
    words = [f"--env={program.env}", f"--agent={program.agent}", *cli.import_flag(program.family)]
    words += [f"--from={program.start}"] if program.start else []
    for part, prefix in (("plan", "--"), ("training", "--"), ("family", "--env."), ("learner", "--agent.")):
        value = getattr(program, part)
        items = (settings(value) if part == "learner" else dataclasses.asdict(value)).items()
        words += itertools.chain(*(_flag(prefix, name.replace("_", "-"), value) for name, value in items))
    return words + (["--sweep", *program.sweep] if program.sweep else [])


def _flag(prefix: str, name: str, value: object) -> list[str]:
    if name == "context-ranges":  # the run's of --from
        return []
    if name == "vary":
        return [f"{prefix}vary.{parameter}={values}" for parameter, values in value]  # type: ignore
    prefix = "--" if name in ("split", "engine", "tune") else prefix
    match value:
        case bool():
            return [f"{prefix}{name}" if value else f"{prefix}no-{name}"]
        case tuple():
            return [f"{prefix}{name}", *map(str, value)] if value else []
    return [f"{prefix}{name}={value}"] if value != "" else []


def _summary(program: Program) -> str:
    family, plan = program.family, program.plan
    found = family.variation
    ends = ", ".join(
        f"{name} {low:g} to {high:g}"
        for name, low, high in zip(found.names, found.low, found.high, strict=True)
        if low < high
    )
    count = family.train_count
    return (
        f"{count} training task{'s' * (count > 1)}{', ' * bool(ends)}{ends}, "
        f"split {family.split}, engine {family.engine_name}, seeds {plan.seed} to {plan.seed + plan.seeds - 1}"
    )


def _conclude(program: Program, result: Result, directory: Path) -> None:
    from mtjax import plot
    from mtjax.evaluate import split_table

    if not result.finished:
        words = [f"--resume={directory}", *cli.import_flag(program.family)]
        print(f"stopped; the state is saved. Go on with:\n  python -m mtjax.train {shlex.join(words)}")
        return
    if len(result.evaluations.steps):
        title = f"{program.agent} on {program.env}"
        plot.learning_curve(directory / "curve.png", result.evaluations.steps, result.evaluations.returns, title)
        print(split_table(result.evaluations))
        if program.learner.unseen:
            print(f"unseen tasks: {program.learner.unseen}")
    print(f"trained in {result.seconds:.1f} s (compiled in {result.compile_seconds:.1f} s); run: {directory}")


class _CallableModule(types.ModuleType):
    """Lets ``mtjax.train(...)`` stay a function after ``import mtjax.train`` has put this module in its place."""

    def __call__(self, *args, **kwargs) -> Result:
        return train(*args, **kwargs)


def run() -> None:
    """Entry point of the command line."""
    cli.main(main)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    run()
