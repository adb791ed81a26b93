"""Selection in a population, between two chunks: a gather on the axis S of all that the members' agents hold.

Networks, optimisers and numbers are copied. Worlds, random keys and the replay stay in their places: copying a replay
would take its memory twice, and whoever learns off-policy may learn from what another member did.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding

from mtjax.agents import swept
from mtjax.agents.base import BaseAgent
from mtjax.checks import amount
from mtjax.config import RunConfig
from mtjax.learning import populations
from mtjax.learning.loop import TrainState
from mtjax.parallel import hosts
from mtjax.parallel import mesh as meshes
from mtjax.saved.log import number

_SELECTION = 0x5E1E  # folded into the key of the first seed


class Chosen(NamedTuple):
    """Holds a population after a selection."""

    state: TrainState
    sources: np.ndarray  # (S,) whose copy each member is now; its own number if it stayed


def begin(config: RunConfig, state: TrainState) -> TrainState:
    """Return the state, or its shapes, with every member as its own origin; as it is if there is no population."""
    if config.plan.rule is None:
        return state
    origins = jnp.asarray(meshes.shard_by_seed(config.mesh, np.arange(config.members, dtype=np.int32)))
    if isinstance(state.iteration, jax.ShapeDtypeStruct):
        origins = jax.ShapeDtypeStruct(origins.shape, origins.dtype, sharding=origins.sharding)
    return state._replace(origins=origins)


def starts(config: RunConfig, seeds: Any) -> Any:
    """Return the seeds (S,) of evaluations' episodes: all members of a population play the same ones."""
    if config.plan.rule is None:
        return seeds
    return meshes.shard_by_seed(config.mesh, np.full(config.members, config.plan.seed, np.int32))


def is_due(config: RunConfig, steps: int) -> bool:
    """Return whether members give way after the chunk that ends at a step. At the run's end none does."""
    rule, before = config.plan.rule, steps - config.steps_per_chunk
    return rule is not None and steps // rule.steps > before // rule.steps and steps < config.plan.steps


def select(config: RunConfig, state: TrainState, returns: np.ndarray) -> Chosen:
    """Replace members by copies of others, given the returns (S, T, episodes) of an evaluation on training tasks."""
    rule = config.plan.rule
    assert rule is not None
    key = jax.random.fold_in(jax.random.key(config.plan.seed), _SELECTION)
    draw_key, perturb_key = jax.random.split(jax.random.fold_in(key, int(state.iteration)))
    origins = hosts.gather(state.origins)
    sources = rule.sources(populations.fitness(returns), origins, draw_key)
    numbers = {name: x[sources] for name, x in numbers_of(state).items()}
    if rule.explores:
        numbers = _explored(config.learner, numbers, sources != np.arange(len(sources)), perturb_key)
    place = lambda tree: jax.tree.map(jnp.asarray, meshes.shard_by_seed(config.mesh, tree))
    agent = _gather(config.mesh)(state.agent, meshes.replicate(config.mesh, sources))
    agent = agent._replace(numbers=place(numbers)) if numbers else agent
    return Chosen(state._replace(agent=agent, origins=place(origins[sources])), sources)


@cache
def _gather(mesh: Mesh | None) -> Any:
    """Return the program that takes entries (S,) of a tree with leaves (S, ...), compiled once for all selections."""
    take = lambda tree, sources: jax.tree.map(lambda x: x[sources], tree)
    return jax.jit(take) if mesh is None else jax.jit(take, out_shardings=NamedSharding(mesh, meshes.BY_SEED))


def _explored(agent: BaseAgent, numbers: dict[str, np.ndarray], copies: np.ndarray, key: Any) -> dict[str, np.ndarray]:
    """Return perturbed numbers of copies (S,). A value that the agent's constructor refuses is not taken."""
    found = populations.explore(numbers, copies, swept.shares(agent, numbers), key)
    allows = lambda name, k: swept.allows(agent, {name: float(found[name][k])})
    return {
        name: np.array([found[name][k] if allows(name, k) else x[k] for k in range(len(x))], x.dtype)
        for name, x in numbers.items()
    }


def numbers_of(state: TrainState) -> dict[str, np.ndarray]:
    """Return the members' numbers (S,) by name, as they are now."""
    return hosts.gather(dict(swept.numbers_of(state.agent)))


def history(steps: int, seeds: np.ndarray, returns: np.ndarray, chosen: Chosen) -> list[dict[str, Any]]:
    """Return a row for each member: whose copy it became at a step, its return before, and its numbers after."""
    numbers, fitness = numbers_of(chosen.state), populations.fitness(returns)
    return [
        {"steps": steps, "member": k, "seed": int(seeds[k]), "from": int(source), "return": number(fitness[k])}
        | {name: number(x[k]) for name, x in numbers.items()}
        for k, source in enumerate(chosen.sources)
    ]


def describe_best(returns: np.ndarray, numbers: dict[str, np.ndarray]) -> str:
    """Return a line on the member with the highest return (S, T, episodes), and its numbers; empty if none is known."""
    fitness = populations.fitness(returns)
    if not np.isfinite(fitness).any():
        return ""
    best = populations.best(returns)
    values = ", ".join(f"{name.replace('_', '-')} {x[best]:.4g}" for name, x in numbers.items())
    return f"best of the population: number {best}{f' ({values})' * bool(values)}, return {amount(fitness[best])}"


def describe_copies(sources: np.ndarray) -> str:
    """Return a line on how many members became copies of others."""
    copies = np.flatnonzero(sources != np.arange(len(sources)))
    if not len(copies):
        return "no member of the population gave way"
    return f"{len(copies)} of {len(sources)} members are now copies of {len(set(sources[copies].tolist()))} better ones"
