"""The training loop for timing: compiled and warmed up once, then run chunk by chunk."""

import time
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.agents import BaseAgent
from mtjax.compiling.programs import compile_lowered, jit_programs
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.loop import Settings
from mtjax.parallel import mesh as meshes


class Training:
    """The training loop of ``mtjax.train`` without evaluations, logs and checkpoints.

    Args:
        family, agent, settings: the run. Learning has begun before the first timing.
        seeds: how many seeds to train at once.
        most_devices: the largest number of devices to use.
    """

    def __init__(
        self,
        family: FamilyOrMixture,
        agent: BaseAgent,
        settings: Settings,
        seeds: int = 1,
        most_devices: int | None = None,
    ):
        env, num_tasks, experience = family, family.train_count, agent.experience
        mesh = meshes.mesh_for(seeds, num_tasks, settings.num_envs, most_devices)
        programs, numbers = jit_programs(mesh, agent), meshes.shard_by_seed(mesh, jnp.arange(seeds))
        tasks = meshes.replicate(mesh, env.tasks())
        self.num_devices = 1 if mesh is None else mesh.size
        self.worlds = num_tasks * settings.num_envs
        self.family = family  # which programs on some engines need for as long as they run
        self.substeps: int = getattr(family, "num_substeps", 1)  # of a step of control
        self.steps = seeds * settings.chunk_steps * self.worlds
        self.updates = seeds * settings.chunk_steps // experience.steps * getattr(experience, "updates_per_step", 0)
        self.seconds: list[float] = []
        jax.clear_caches()  # of the programs of others, which may be the same
        before = time.perf_counter()
        init = compile_lowered(programs.init.lower(env, agent, settings, tasks, numbers, None), "once")
        self.state = init(tasks, numbers, None)
        chunk = compile_lowered(programs.chunk.lower(env, agent, settings, tasks, self.state))
        self.compile_seconds = time.perf_counter() - before
        self.run = lambda state: chunk(tasks, state)
        while int(self.state.iteration) <= getattr(experience, "warmup_steps", 0):
            self.time(count=False)

    def time(self, count: bool = True) -> None:
        """Run one chunk."""
        before = time.perf_counter()
        self.state, _ = jax.block_until_ready(self.run(self.state))
        if count:
            self.seconds.append(time.perf_counter() - before)

    @property
    def rates(self) -> list[float]:
        """Return the environment steps a second, of all seeds, of every timed chunk."""
        return [self.steps / seconds for seconds in self.seconds]

    def memory(self) -> int | None:
        """Return the peak bytes of the device's memory in this process; None on a CPU."""
        found: Any = jax.local_devices()[0].memory_stats() or {}
        return found.get("peak_bytes_in_use")
