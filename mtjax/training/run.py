"""The host loop around the jitted loop: log, evaluate, save checkpoints, stop cleanly and resume."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.agents.base import BaseAgent, judged
from mtjax.compiling.programs import Programs, compile_lowered, jit_programs, load_kernels, sharded_shapes, trace
from mtjax.config import RunConfig
from mtjax.envs.engines import host
from mtjax.envs.task_table import forgetful
from mtjax.learning.evaluation import Episodes, Evaluations
from mtjax.learning.loop import TrainState
from mtjax.parallel import hosts
from mtjax.parallel import mesh as meshes
from mtjax.progress import duration
from mtjax.saved import checkpoint, lock, log
from mtjax.saved.folder import evaluations_before, has_evaluations
from mtjax.saved.result import Result
from mtjax.training import allocator, distillation, finetune, memory, selection
from mtjax.training.entries import Entries, Watch
from mtjax.training.host_replay import Exchange
from mtjax.training.journal import NO_HOOKS, Hooks, Journal
from mtjax.training.stops import finite_seeds, stop_signals
from mtjax.types import SPLITS


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
    with contextlib.closing(run.journal.console), memory.explaining(), host.explaining(run.journal.records.last):
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


class _Fresh(NamedTuple):
    """Says how the state of a new run is made, before anything compiles."""

    program: jax.stages.Traced
    arguments: tuple[Any, ...]  # its training tasks, and the entries' seeds (S,) and swept values (S,)
    shapes: TrainState


def _trace_fresh(config: RunConfig, entries: Entries) -> _Fresh:
    agent, mesh = config.trained, config.mesh
    arguments = meshes.replicate(mesh, config.family.tasks("train")), *meshes.shard_by_seed(mesh, entries.axis)
    program = trace(jit_programs(mesh, agent).init, config.family, agent, config.played, *arguments)
    return _Fresh(program, arguments, selection.begin(config, sharded_shapes(mesh, agent, program.out_info)))


@dataclasses.dataclass(frozen=True)
class _Run:
    """Trains by one configuration."""

    config: RunConfig
    hooks: Hooks = NO_HOOKS

    @cached_property
    def entries(self) -> Entries:
        return Entries(self.config)

    @cached_property
    def journal(self) -> Journal:
        return Journal(self.config, self.hooks, self.entries)

    @property
    def watch(self) -> Watch:
        return Watch(self.entries, self.journal.records.last, self.journal.console.say)

    @cached_property
    def exchange(self) -> Exchange:
        return Exchange(
            self.config.family, self.config.trained, self.config.played, self.config.mesh, self.hooks.directory
        )

    def train(self, started: float) -> Result:
        """Prepare the run, and play its chunks; ``started`` is the clock when the user began to wait."""
        with contextlib.ExitStack() as held:
            if (folder := self.hooks.directory) is not None:
                hosts.by_first(lambda: held.enter_context(lock.hold(folder)))()
            resumed = self.journal.records.resumes(self.hooks.resume)
            if self.hooks.resume and not resumed:
                self.journal.console.say("there is no checkpoint yet, so the run starts over")
            if not resumed:
                self.journal.introduce()
            fresh = _trace_fresh(self.config, self.entries)
            if resumed * self.config.worlds >= self.config.plan.steps and (result := self._ended(fresh.shapes)):
                return result
            programs, state = self.prepare(fresh, bool(resumed))
            if self.hooks.start is not None and not resumed:
                begun = adopted(self.config, self.hooks, self.config.trained, hosts.gather(state.agent))
                state = state._replace(agent=meshes.shard_by_seed(self.config.mesh, begun))
            held.callback(self.exchange.close)
            self.exchange.begin(state)
            hosts.wait_for_all()
            compile_seconds = time.monotonic() - started
            self.journal.console.say(f"compiled in {duration(compile_seconds)}")
            return self.run_chunks(programs, state, started)._replace(compile_seconds=compile_seconds)

    def _ended(self, shapes: TrainState) -> Result | None:
        """Return the result of a run that has made all its steps, for which nothing compiles; None if some is lost."""
        records = self.journal.records
        state = records.restore(shapes)
        iteration = int(state.iteration)
        steps = iteration * self.config.worlds
        folder = self.hooks.directory
        known = hosts.largest(int(folder is not None and has_evaluations(folder)))
        if steps < self.config.plan.steps or not known:
            return None
        found = records.earlier_evaluations(steps, True, evaluations_before(self.config))
        self.journal.begin(steps)
        seconds, _ = records.earlier_seconds(iteration)
        return Result(state, found, log.Rows(), seconds, 0.0, True, self.hooks.directory)

    def prepare(self, fresh: _Fresh, resume: bool) -> tuple[Programs, TrainState]:
        """Compile all programs in parallel, and make or restore the state. Evaluation may be ready later."""
        env, agent, settings = self.config.family, self.config.trained, self.config.played
        lazy, pool = jit_programs(self.config.mesh, agent), ThreadPoolExecutor(3)
        (tasks, seeds, _), shapes = fresh.arguments, fresh.shapes
        everything = meshes.replicate(self.config.mesh, env.tasks("all"))
        self._describe(shapes)
        self.journal.console.say("compiling")
        kernels = pool.submit(load_kernels, env)
        make = None if resume else pool.submit(lambda: compile_lowered(fresh.program.lower(), "once"))
        chunk = trace(lazy.chunk, env, agent, settings, tasks, shapes)
        plan = self.config.plan
        episodes = Episodes(plan.eval_episodes, settings.trials, plan.eval_sampled)
        played = partial(trace, lazy.evaluate, env, judged(agent), episodes, shapes.agent, everything, seeds)
        score = pool.submit(lambda: compile_lowered(played(np.int32(0)).lower(), "seldom"))
        pool.shutdown(wait=False)
        starts = selection.starts(self.config, seeds)
        evaluate = lambda agents, number: score.result()(agents, everything, starts, np.int32(number))
        play = partial(compile_lowered(chunk.lower()), tasks)
        programs = Programs(play, evaluate, chunk.out_info[1], score.result)
        if kernels.result():  # else the first chunk would wait for them
            score.result()
        if make is not None:
            return programs, selection.begin(self.config, make.result()(*fresh.arguments))
        state = self.journal.records.restore(shapes)
        if forgetful(env):  # returns do not count episodes whose worlds are lost
            state = state._replace(counted=state.counted & False)
        return programs, state

    def _describe(self, shapes: TrainState) -> None:
        spec, agent, settings = self.config.family.spec, self.config.trained, self.config.played
        needs = memory.Needs.of(shapes, spec, agent, settings)
        memory.require_room(needs, spec)
        kind = agent.experience.describe(spec, settings.num_envs)
        for line in memory.tell(shapes.data, needs, kind, len(self.entries.seeds)):
            self.journal.console.say(line)
        if line := meshes.describe(self.config.mesh, len(self.entries.seeds), settings.num_envs):
            self.journal.console.say(line)
        if self.hooks.directory is not None:
            flags = [*agent.experience.storage.flags, *["host-replay-size"] * bool(needs.host)]
            checkpoint.require_space(self.hooks.directory, shapes, needs.host, flags)

    def _begin(self, programs: Programs, state: TrainState, steps: int) -> _Progress:
        """Return where a new or resumed run is."""
        iteration, plan, seeds = int(state.iteration), self.config.plan, self.entries.seeds
        none = evaluations_before(self.config)
        evaluations = self.journal.records.earlier_evaluations(steps, steps >= plan.interval, none)
        form = (self.journal.columns(programs.metrics), len(seeds), self.config.longest) if iteration else ()
        seconds, wall = self.journal.records.earlier_seconds(iteration, *form)
        self.journal.records.keep_history(steps)
        diverged = np.zeros(len(seeds), bool)
        if len(evaluations.steps) and not self.entries.end_with_one:
            diverged |= ~np.isfinite(evaluations.returns["train"][:, -1]).all(axis=(1, 2))
        now = _Progress(state, steps, seconds, wall, evaluations, diverged)
        if steps < plan.steps or len(evaluations.steps):
            return now
        spoiled = ~finite_seeds(state.agent)
        again = self._evaluate(programs.evaluate, now._replace(diverged=spoiled))  # they were lost after the run's end
        return now._replace(evaluations=again)

    def run_chunks(self, programs: Programs, state: TrainState, started: float) -> Result:
        """Run chunks until all steps are done or a signal asks to stop."""
        steps, rows, stop = int(state.iteration) * self.config.worlds, log.Rows(), False
        self.journal.begin(steps)
        now, forgets = self._begin(programs, state, steps), bool(forgetful(self.config.family))
        earlier = now.seconds
        doing = self.journal.console.doing
        with self.journal.sinks(steps) as sinks, stop_signals(doing) as received, self.journal.records.closing():
            asked = lambda enough: bool(hosts.largest(int(enough or bool(received))))
            while now.steps < self.config.plan.steps and not stop:
                self.journal.records.check()
                seconds = now.seconds
                now, metrics = self._play(programs.chunk, now, len(rows) // len(self.entries.seeds))
                if forgets:  # so that never more than this chunk is without a checkpoint
                    self.journal.records.wait()
                new = self.journal.chunk(metrics, now.seconds - seconds, now, started, sinks)
                rows.extend(new)
                enough = self.hooks.on_chunk is not None and self.hooks.on_chunk(new[0]) is True
                stop, due = asked(enough), is_due(self.config, now.steps)
                if due:
                    programs.ready()
                before, saves = time.monotonic(), due or stop or forgets
                if saves:
                    lost = self.watch.before_saving(now.state.agent, now.steps // self.config.worlds, now.diverged)
                    now = now._replace(diverged=lost)
                if due:
                    doing(f"{now.steps:,} steps  evaluating")
                    now = self._select(now._replace(evaluations=self._evaluate_or_save(programs.evaluate, now)))
                    self.journal.evaluation(now.evaluations, sinks)
                    stop = asked(stop)
                if saves:
                    self._save(now.state, now.steps // self.config.worlds)
                if due or stop:
                    self.journal.console.clock.evaluation(time.monotonic() - before)
                if due and self.hooks.on_evaluation is not None:
                    self.hooks.on_evaluation(now.evaluations)
            signal = hosts.largest(received[0] if received else 0)  # also one that came during the last save
        finished = now.steps >= self.config.plan.steps
        return Result(now.state, now.evaluations, rows, now.seconds, 0.0, finished, self.hooks.directory)._replace(
            trained_seconds=now.seconds - earlier, signal=signal
        )

    def _play(self, chunk: Callable, now: _Progress, done: int) -> tuple[_Progress, dict[str, Any]]:
        """Run one chunk, and return its metrics too. ``done`` counts the chunks before it in this process."""
        with self.journal.profiled(done, now.steps):
            before = time.monotonic()
            state, metrics = chunk(now.state)
            state = self.exchange.after_chunk(state)
            metrics = hosts.gather(metrics)
            elapsed = time.monotonic() - before
        iteration = now.steps // self.config.worlds
        diverged = self.watch.after_chunk(metrics, iteration, now.diverged)
        steps, seconds = now.steps + self.config.steps_per_chunk, now.seconds + elapsed
        return now._replace(state=state, steps=steps, seconds=seconds, diverged=diverged), metrics

    def _select(self, now: _Progress) -> _Progress:
        """Name the best member of a population after an evaluation, and replace the worst ones if that is due."""
        if self.config.plan.rule is None:
            return now
        returns = now.evaluations.returns["train"][:, -1]
        self.journal.console.say(selection.describe_best(returns, selection.numbers_of(now.state)))
        if not selection.is_due(self.config, now.steps):
            return now
        chosen = selection.select(self.config, now.state, returns)
        self.journal.records.add_history(selection.history(now.steps, self.entries.seeds, returns, chosen))
        self.journal.console.say(selection.describe_copies(chosen.sources))
        return now._replace(state=chosen.state)

    def _save(self, state: TrainState, iteration: int) -> None:
        """Save a checkpoint."""
        self.exchange.finish(iteration)
        self.journal.records.save(state)
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
        self.journal.records.save_evaluations(evaluations)
        if not diverged.all():
            last = lambda scores: {split: x[~diverged, -1] for split, x in scores.items()}
            self.journal.console.evaluation(
                now.steps, last(returns), last(metrics.get("success", {})), evaluations.trial
            )
        return evaluations


def is_due(config: RunConfig, steps: int) -> bool:
    """Return whether an evaluation is due after the chunk that ends at a step."""
    plan, before = config.plan, steps - config.steps_per_chunk
    return steps // plan.interval > before // plan.interval or steps >= plan.steps


def adopted(config: RunConfig, hooks: Hooks, agent: BaseAgent, fresh: Any) -> Any:
    """Return an agent's state with the values of the runs from which it begins, the same seeds for every point."""
    apart = lambda x: x.reshape(-1, config.plan.seeds, *x.shape[1:])
    together = lambda x: x.reshape(-1, *x.shape[2:])
    begin: Any = distillation.adopt if agent.taught else finetune.adopt  # one policy, or several
    adopt = partial(begin, hooks.start, agent, config.family.tasks("train"))
    return jax.tree.map(together, jax.vmap(adopt)(jax.tree.map(apart, fresh)))
