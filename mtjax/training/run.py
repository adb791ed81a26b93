"""The host loop around the jitted loop: log, evaluate, save checkpoints, stop cleanly and resume."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.agents import settings as settings_of
from mtjax.agents import swept
from mtjax.agents.rates import planned
from mtjax.agents.swept import Point
from mtjax.compiling.programs import Programs, compile_lowered, jit_programs, load_kernels, sharded_shapes, trace
from mtjax.config import RunConfig
from mtjax.envs.engines import host
from mtjax.envs.task_table import forgetful
from mtjax.learning.evaluation import Episodes, Evaluations, no_evaluations
from mtjax.learning.loop import TrainState
from mtjax.parallel import hosts
from mtjax.parallel import mesh as meshes
from mtjax.saved import checkpoint, lock, log
from mtjax.saved.policy import Policy
from mtjax.saved.records import Records
from mtjax.saved.result import Result
from mtjax.training import allocator, distillation, finetune, memory, selection
from mtjax.training.console import (
    Clock,
    Console,
    describe_resumption,
    describe_rounding,
    describe_running,
    describe_warmup,
    duration,
)
from mtjax.training.host_replay import Exchange
from mtjax.training.sinks import Sink, open_sinks, write_rows
from mtjax.training.stops import finite_seeds, require_finite, require_finite_parameters, stop_signals
from mtjax.types import SPLITS

_WHEN = ("iteration", "steps", "seconds", "wall_seconds")  # columns of metrics.csv


class Hooks(NamedTuple):
    """What a run has beside its configuration: where it begins and is written, whom it calls, and what it prints."""

    directory: Path | None = None
    """An existing folder for metrics, evaluations and checkpoints, in which no other process writes; None for none."""
    start: Policy | tuple[Policy, ...] | None = None
    """The policy to fine-tune, or those that teach."""
    resume: bool = False
    """Continue from the newest whole checkpoint in ``directory``, or start over if there is none yet."""
    on_chunk: Callable[[dict[str, Any]], Any] | None = None
    on_evaluation: Callable[[Evaluations], None] | None = None
    quiet: bool = False
    label: str = ""
    """The first words of progress lines."""


NO_HOOKS = Hooks()


def train(config: RunConfig, hooks: Hooks = NO_HOOKS) -> Result:
    """Train an agent on a family of tasks, by a configuration that ``launch.check`` accepts.

    Raises:
        InputError: the run in the folder is another, or memory or disk have no room; or an environment outside of JAX
            has raised an error.
        FloatingPointError: numbers stopped being finite (in a sweep: of every seed). The message names task, step and
            the last checkpoint.
        OSError: a file could not be written. The checkpoint before it stays.
    """
    started = time.monotonic()
    run = _Run(config, hooks)
    with contextlib.closing(run.console), memory.explaining(), host.explaining(run.records.last):
        result = run.train(started)
    return result._replace(
        total_seconds=time.monotonic() - started,
        env=config.family,
        agent=config.learner,
        seeds=tuple(config.plan.all_seeds),
        points=config.points,
        population=config.plan.population,
    )


class _Progress(NamedTuple):
    """Holds what changes from chunk to chunk."""

    state: TrainState
    steps: int  # environment steps of each seed
    seconds: float  # of training, with those before the run was resumed
    wall: float  # seconds of the run before it was resumed
    evaluations: Evaluations
    diverged: np.ndarray  # (S,) bool, the seeds that are given up


@dataclasses.dataclass(frozen=True)
class _Run:
    """Trains by one configuration."""

    config: RunConfig
    hooks: Hooks = NO_HOOKS

    @cached_property
    def agent(self) -> Any:
        """Return the agent as it is trained: with its schedule's length."""
        return planned(self.config.learner, self.config.length)

    @cached_property
    def console(self) -> Console:
        total = self.config.length * self.config.worlds
        return Console(total, self.hooks.quiet or not hosts.is_first(), self.hooks.label)

    @cached_property
    def seed_axis(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the seeds (S,) of all points, and the swept values (S,) by name."""
        return swept.seed_axis(self.config.points, np.asarray(self.config.plan.all_seeds, np.int32))

    @property
    def seeds(self) -> np.ndarray:
        return self.seed_axis[0]

    def point(self, number: int) -> Point:
        """Return the swept values of one entry of S."""
        config = self.config
        return config.points[number // config.plan.seeds] if config.points else {}

    @property
    def ends_with_one(self) -> bool:
        """Return whether the run ends when one seed diverges, as in neither a sweep nor a population."""
        return not self.config.points and self.config.plan.rule is None

    def numbers(self, state: TrainState) -> list[Point]:
        """Return the values of every entry of S in rows: those swept, in a population as they are now."""
        if self.config.plan.rule is None:
            return [self.point(k) for k in range(len(self.seeds))]
        now = selection.numbers_of(state)
        return [{name: log.number(x[k]) for name, x in now.items()} for k in range(len(self.seeds))]  # type: ignore

    def adopt(self, tasks: Any, fresh: Any) -> Any:
        """Return the agent's state with the values of the runs from which it begins, the same seeds for every point."""
        apart = lambda x: x.reshape(-1, self.config.plan.seeds, *x.shape[1:])
        together = lambda x: x.reshape(-1, *x.shape[2:])
        begin: Any = distillation.adopt if self.agent.taught else finetune.adopt  # one policy, or several
        adopt = partial(begin, self.hooks.start, self.agent, tasks)
        return jax.tree.map(together, jax.vmap(adopt)(jax.tree.map(apart, fresh)))

    @cached_property
    def records(self) -> Records:
        return Records(self.hooks.directory)

    @cached_property
    def exchange(self) -> Exchange:
        return Exchange(self.config.family, self.agent, self.config.played, self.config.mesh, self.hooks.directory)

    def train(self, started: float) -> Result:
        """Prepare the run, and play its chunks; ``started`` is the clock when the user began to wait."""
        with contextlib.ExitStack() as held:
            if (folder := self.hooks.directory) is not None:
                hosts.by_first(lambda: held.enter_context(lock.hold(folder)))()
            resumed = self.records.found(self.hooks.resume)
            if self.hooks.resume and not resumed:
                self.console.say("there is no checkpoint yet, so the run starts over")
            if not resumed:
                self.introduce()
            programs, state = self.prepare(resumed)
            if self.hooks.start is not None and not resumed:
                begun = self.adopt(self.config.family.tasks("train"), hosts.gather(state.agent))
                state = state._replace(agent=meshes.shard_by_seed(self.config.mesh, begun))
            held.callback(self.exchange.close)
            self.exchange.begin(state)
            hosts.wait_for_all()
            compile_seconds = time.monotonic() - started
            self.console.say(f"compiled in {duration(compile_seconds)}")
            return self.run_chunks(programs, state, started)._replace(compile_seconds=compile_seconds)

    def prepare(self, resume: bool) -> tuple[Programs, TrainState]:
        """Compile all programs in parallel, and make or restore the state. Evaluation may be ready later."""
        env, agent, settings = self.config.family, self.agent, self.config.played
        lazy = jit_programs(self.config.mesh, agent)
        tasks, everything = (meshes.replicate(self.config.mesh, env.tasks(split)) for split in ("train", "all"))
        (seeds, numbers), pool = meshes.shard_by_seed(self.config.mesh, self.seed_axis), ThreadPoolExecutor(3)
        fresh = trace(lazy.init, env, agent, settings, tasks, seeds, numbers)
        shapes = selection.begin(self.config, sharded_shapes(self.config.mesh, agent, fresh.out_info))
        self._describe(shapes)
        self.console.say("compiling")
        kernels = pool.submit(load_kernels, env)
        make = None if resume else pool.submit(lambda: compile_lowered(fresh.lower(), "once"))
        chunk = trace(lazy.chunk, env, agent, settings, tasks, shapes)
        episodes = Episodes(self.config.plan.eval_episodes, settings.trials)
        played = partial(trace, lazy.evaluate, env, agent, episodes, shapes.agent, everything, seeds)
        score = pool.submit(lambda: compile_lowered(played(np.int32(0)).lower(), "seldom"))
        pool.shutdown(wait=False)
        starts = selection.starts(self.config, seeds)
        evaluate = lambda agents, number: score.result()(agents, everything, starts, np.int32(number))
        play = partial(compile_lowered(chunk.lower()), tasks)
        programs = Programs(play, evaluate, chunk.out_info[1], score.result)
        if kernels.result():  # else the first chunk would wait for them
            score.result()
        if make is None:
            return programs, self._restored(shapes)
        return programs, selection.begin(self.config, make.result()(tasks, seeds, numbers))

    def _restored(self, shapes: TrainState) -> TrainState:
        """Return the state of the newest checkpoint. Returns do not count episodes whose worlds are lost."""
        state = self.records.restore(shapes)
        return state._replace(counted=state.counted & False) if forgetful(self.config.family) else state

    def _describe(self, shapes: TrainState) -> None:
        spec, settings = self.config.family.spec, self.config.played
        needs = memory.Needs.of(shapes, spec, self.agent, settings)
        memory.require_room(needs, spec)
        kind = self.agent.experience.describe(spec, settings.num_envs)
        for line in memory.tell(shapes.data, needs, kind, len(self.seeds)):
            self.console.say(line)
        if line := meshes.describe(self.config.mesh, len(self.seeds), settings.num_envs):
            self.console.say(line)
        if self.hooks.directory is not None:
            flags = [*self.agent.experience.storage.flags, *["host-replay-size"] * bool(needs.host)]
            checkpoint.require_space(self.hooks.directory, shapes, needs.host, flags)

    def _open_sinks(self, steps: int) -> list[Sink]:
        """Return where metrics go beside metrics.csv, in a run that is at a step."""
        if not self.records.writes:
            return []
        assert self.hooks.directory is not None
        config, plan, played = self.config, dataclasses.asdict(self.config.plan), dataclasses.asdict(self.config.played)
        told = {**plan, **played, **settings_of(self.agent)}
        return open_sinks(self.hooks.directory, config.tensorboard, config.wandb, steps, told)

    def _name(self, k: int) -> str:
        """Return the name of entry k of S for TensorBoard and W&B."""
        values = [f"{name}={value:g}" for name, value in self.point(k).items()]
        return "-".join([*values, f"seed-{self.seeds[k]}"])

    def introduce(self) -> None:
        """Say how many steps a new run takes, and what the first of them are."""
        config, total = self.config, self.console.total
        rounding = describe_rounding(config.plan.steps, total, config.steps_per_chunk)
        for line in (*rounding, *describe_warmup(config.warmup, total)):
            self.console.say(line)

    def _clock(self, steps: int) -> Clock:
        """Return a clock that counts the chunks and evaluations to come, however many there are."""
        chunk, every = self.config.steps_per_chunk, self.config.plan.interval
        count = max(-(-(self.console.total - steps) // chunk), 0)
        last = steps + (count - 1) * chunk  # where the last chunk begins
        evaluations = max(count - 1 if chunk >= every else last // every - steps // every, 0) + (count > 0)
        return Clock(count, evaluations, min(max(-(-(self.config.warmup - steps) // chunk), 0), count))

    def _running(self, state: TrainState, returns: np.ndarray) -> str:
        """Return a text on episodes that still run, if none has ended in a chunk with these returns (S, T)."""
        if np.isfinite(returns).any() or jax.process_count() > 1:
            return ""
        totals, ages, counted = jax.device_get((state.total, state.worlds.age, state.counted))
        return describe_running(totals, ages, counted, self.config.family.episode_length)

    def run_chunks(self, programs: Programs, state: TrainState, started: float) -> Result:
        """Run chunks until all steps are done or a signal asks to stop."""
        steps = int(state.iteration) * self.config.worlds
        if steps:
            again = max(self.records.last_iteration() * self.config.worlds - steps, 0)
            self.console.say(describe_resumption(steps, self.console.total, again))
        self.console.clock = self._clock(steps)
        with contextlib.ExitStack() as opened:
            sinks = self._open_sinks(steps)
            for sink in sinks:
                opened.callback(sink.close)
            return self._run_chunks(programs, self._begin(programs, state, steps), started, sinks)

    def _begin(self, programs: Programs, state: TrainState, steps: int) -> _Progress:
        """Return where a new or resumed run is."""
        iteration = int(state.iteration)
        plan = self.config.plan
        evaluations = self.records.earlier_evaluations(steps, steps >= plan.interval, self._no_evaluations())
        form = (self._columns(programs.metrics), len(self.seeds), self.config.longest) if iteration else ()
        seconds, wall = self.records.earlier_seconds(iteration, *form)
        self.records.keep_history(steps)
        diverged = np.zeros(len(self.seeds), bool)
        if len(evaluations.steps) and not self.ends_with_one:
            diverged |= ~np.isfinite(evaluations.returns["train"][:, -1]).all(axis=(1, 2))
        now = _Progress(state, steps, seconds, wall, evaluations, diverged)
        if steps < plan.steps or len(evaluations.steps):
            return now
        spoiled = ~finite_seeds(state.agent)
        again = self._evaluate(programs.evaluate, now._replace(diverged=spoiled))  # they were lost after the run's end
        return now._replace(evaluations=again)

    def _run_chunks(self, programs: Programs, now: _Progress, started: float, sinks: list[Sink]) -> Result:
        rows, stop, earlier, forgets = log.Rows(), False, now.seconds, bool(forgetful(self.config.family))
        with stop_signals() as received, self.records.closing():
            asked = lambda enough: bool(hosts.largest(int(enough or bool(received))))
            while now.steps < self.config.plan.steps and not stop:
                self.records.check()
                seconds = now.seconds
                now, metrics = self._play(programs.chunk, now, len(rows) // len(self.seeds))
                if forgets:  # so that never more than this chunk is without a checkpoint
                    self.records.wait()
                new = self._log(metrics, now.seconds - seconds, now, started, sinks)
                rows.extend(new)
                enough = self.hooks.on_chunk is not None and self.hooks.on_chunk(new[0]) is True
                stop, due = asked(enough), self._is_due(now.steps)
                if due:
                    programs.ready()
                before, saves = time.monotonic(), due or stop or forgets
                if saves:
                    now = self._give_up_spoiled(now)
                if due:
                    self.console.doing(f"{now.steps:,} steps  evaluating")
                    now = self._select(now._replace(evaluations=self._evaluate_or_save(programs.evaluate, now)))
                    write_rows(sinks, *self._evaluation_rows(now.evaluations))
                    stop = asked(stop)
                if saves:
                    self._save(now.state, now.steps // self.config.worlds)
                if due or stop:
                    self.console.clock.evaluation(time.monotonic() - before)
                if due and self.hooks.on_evaluation is not None:
                    self.hooks.on_evaluation(now.evaluations)
            signal = hosts.largest(received[0] if received else 0)  # also one that came during the last save
        finished = now.steps >= self.config.plan.steps
        return Result(now.state, now.evaluations, rows, now.seconds, 0.0, finished, self.hooks.directory)._replace(
            trained_seconds=now.seconds - earlier, signal=signal
        )

    def _is_due(self, steps: int) -> bool:
        """Return whether an evaluation is due after the chunk that ends at a step."""
        plan, before = self.config.plan, steps - self.config.steps_per_chunk
        return steps // plan.interval > before // plan.interval or steps >= plan.steps

    def _play(self, chunk: Callable, now: _Progress, done: int) -> tuple[_Progress, dict[str, Any]]:
        """Run one chunk, and return its metrics too. ``done`` counts the chunks before it in this process."""
        with self._profile_chunk(done, now.steps):
            before = time.monotonic()
            state, metrics = chunk(now.state)
            state = self.exchange.after_chunk(state)
            metrics = hosts.gather(metrics)
            elapsed = time.monotonic() - before
        iteration = now.steps // self.config.worlds
        diverged = now.diverged | self._find_diverged(metrics, iteration, now.diverged)
        steps, seconds = now.steps + self.config.steps_per_chunk, now.seconds + elapsed
        return now._replace(state=state, steps=steps, seconds=seconds, diverged=diverged), metrics

    def _log(
        self, metrics: dict[str, Any], elapsed: float, now: _Progress, started: float, sinks: list[Sink]
    ) -> list[dict[str, Any]]:
        """Write the metrics of a chunk that took ``elapsed`` seconds, and return them: a row for each entry of S."""
        passed = time.monotonic() - started
        iteration = now.steps // self.config.worlds
        when = (iteration, now.steps, f"{now.seconds:.3f}", f"{now.wall + passed:.3f}")
        lines = log.metric_rows(metrics, np.asarray(self.seeds), dict(zip(_WHEN, when, strict=True)))
        numbers = self.numbers(now.state)
        new = [{"seed": row["seed"], **numbers[k], **row} for k, row in enumerate(lines)]
        self.records.add_rows(new)
        write_rows(sinks, lines, [self._name(k) for k in range(len(lines))])
        self.console.clock.chunk(elapsed)
        self._tell_lost(metrics["lost"])
        rate = self.config.steps_per_chunk * len(self.seeds) / elapsed
        self.console.progress(now.steps, passed, rate, metrics["return"], self._running(now.state, metrics["return"]))
        return new

    def _tell_lost(self, lost: np.ndarray) -> None:
        """Print how many worlds (S, T) a chunk has lost, and their tasks. Print nothing if there are none."""
        if count := int(lost.sum()):
            tasks = ", ".join(map(str, np.flatnonzero(lost.sum(axis=0))))
            worlds = "1 world" if count == 1 else f"{count} worlds"
            self.console.say(f"{worlds} (task {tasks}) blew up; new episodes began there")

    def _columns(self, metrics: Any) -> list[str]:
        """Return the columns of metrics.csv, given the shapes of a chunk's metrics."""
        empty = jax.tree.map(lambda x: np.zeros(x.shape), metrics)
        return list({"seed": 0, **self.point(0), **log.metric_rows(empty, np.zeros(1), dict.fromkeys(_WHEN))[0]})

    @contextlib.contextmanager
    def _profile_chunk(self, done: int, steps: int) -> Iterator[None]:
        """Trace the run's second, warm chunk, or its only one, if ``profile`` asks for it."""
        only = not done and steps + self.config.steps_per_chunk >= self.config.plan.steps
        if not (self.config.profile and self.records.writes and (done == 1 or only)):
            yield
            return
        place = self.hooks.directory / "profile"  # type: ignore
        with jax.profiler.trace(place):
            yield
        self.console.say(f"profile of one chunk: {place} (xprof --logdir={place}, or its *.trace.json.gz in Perfetto)")

    def _find_diverged(self, metrics: dict[str, Any], first_step: int, diverged: np.ndarray) -> np.ndarray:
        """Return which seeds (S,) have diverged in this chunk. In a sweep the other seeds continue."""
        broken = np.any(metrics["bad_step"] >= 0, axis=1)
        if self.ends_with_one or np.all(broken | diverged):
            require_finite(metrics["bad_step"], metrics["bad_reward"], first_step, self.records.last)
        self._tell_given_up(broken & ~diverged)
        return broken

    def _give_up_spoiled(self, now: _Progress) -> _Progress:
        """Give up the seeds that the chunk's last update has spoiled, as none of its losses has seen that.

        Raises:
            FloatingPointError: no seed is left, or none may be given up. The checkpoint before must stay.
        """
        agents = now.state.agent
        spoiled = ~finite_seeds(agents)
        if self.ends_with_one or np.all(spoiled | now.diverged):
            require_finite_parameters(agents, now.steps // self.config.worlds, self.records.last)
        self._tell_given_up(spoiled & ~now.diverged)
        return now._replace(diverged=now.diverged | spoiled)

    def _tell_given_up(self, seeds: np.ndarray) -> None:
        for k in np.flatnonzero(seeds):
            values = ", ".join(f"{name}={value:g}" for name, value in self.point(int(k)).items())
            name = f"seed {self.seeds[k]} of {values}" if self.config.plan.rule is None else f"number {k}"
            self.console.say(f"{name} diverged and is given up")

    def _select(self, now: _Progress) -> _Progress:
        """Name the best member of a population after an evaluation, and replace the worst ones if that is due."""
        if self.config.plan.rule is None:
            return now
        returns = now.evaluations.returns["train"][:, -1]
        self.console.say(selection.describe_best(returns, selection.numbers_of(now.state)))
        if not selection.is_due(self.config, now.steps):
            return now
        chosen = selection.select(self.config, now.state, returns)
        self.records.add_history(selection.history(now.steps, self.seeds, returns, chosen))
        self.console.say(selection.describe_copies(chosen.sources))
        return now._replace(state=chosen.state)

    def _save(self, state: TrainState, iteration: int) -> None:
        """Save a checkpoint."""
        self.exchange.finish(iteration)
        self.records.save(state)
        allocator.give_back_pages()

    def _evaluate_or_save(self, program: Callable, now: _Progress) -> Evaluations:
        """Evaluate. Where the program fails, as an environment's own code may, what was learned is saved first."""
        try:
            return self._evaluate(program, now)
        except jax.errors.JaxRuntimeError:
            self._save(now.state, now.steps // self.config.worlds)
            raise

    def _evaluate(self, program: Callable, now: _Progress) -> Evaluations:
        """Evaluate on all splits, and append the result to the run's evaluations."""
        past, diverged = now.evaluations, now.diverged
        scores = hosts.gather(program(now.state.agent, len(past.steps)))
        rows = {split: np.asarray(self.config.family.tasks(split).id) for split in SPLITS}

        def append(old: Mapping[str, np.ndarray], new: np.ndarray) -> dict[str, np.ndarray]:
            new = np.array(new, np.float32)
            new[diverged] = np.nan
            return {split: np.concatenate([x, new[:, None, rows[split]]], axis=1) for split, x in old.items()}

        none = {split: np.zeros((len(diverged), 0, *x.shape[2:]), np.float32) for split, x in past.returns.items()}
        metrics = {name: append(past.metrics.get(name, none), x) for name, x in scores.metrics.items()}
        returns = append(past.returns, scores.returns)
        evaluations = past._replace(steps=np.append(past.steps, now.steps), returns=returns, metrics=metrics)
        self.records.save_evaluations(evaluations)
        if not diverged.all():
            last = lambda scores: {split: x[~diverged, -1] for split, x in scores.items()}
            self.console.evaluation(now.steps, last(returns), last(metrics.get("success", {})), evaluations.trial)
        return evaluations

    def _evaluation_rows(self, evaluations: Evaluations) -> tuple[list[dict[str, Any]], list[str]]:
        """Return a row for each entry of S with the last evaluation's means by split, and its name.

        Means are of returns and of metrics, such as success, over the tasks that tell them.
        """
        scores = {"": evaluations.returns, **{f"/{name}": x for name, x in evaluations.metrics.items()}}
        last = {f"{split}{name}": x[:, -1] for name, of in scores.items() for split, x in of.items() if x.size}
        mean = lambda x: log.number(x[np.isfinite(x)].mean() if np.isfinite(x).any() else np.nan)
        rows = [{"steps": evaluations.steps[-1]} for _ in self.seeds]
        rows = [row | {f"evaluation/{name}": mean(x[k]) for name, x in last.items()} for k, row in enumerate(rows)]
        return rows, [self._name(k) for k in range(len(rows))]

    def _no_evaluations(self) -> Evaluations:
        """Return the evaluations of a run that has not begun."""
        values = {split: self.config.family.task_values(split) for split in SPLITS}
        plan, training = self.config.plan, self.config.training
        return no_evaluations(self.seeds, values, plan.eval_episodes, training.trials)
