"""Replay stores every step, and off-policy agents learn from random ones."""

import dataclasses
import math
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from jax.sharding import PartitionSpec

from mtjax.checks import require_counts, require_not_negative
from mtjax.experience import hindsight, multistep, pictures, store
from mtjax.experience import ring as rings
from mtjax.experience.ring import OVER_SEEDS, Ring
from mtjax.frames import PICTURES, shown
from mtjax.parallel import collectives
from mtjax.types import Array, Env, InputError, Key, Spec, Storage, Task, Transition

HindsightChoice = Literal["uniform", "inverse"]

_FLAG = tyro.conf.arg(prefix_name=False)  # --batch-size, not --agent.batch-size


_MAY_BE_NONE = ("updates_per_step", "reset_every", "hindsight", "host_replay_size")


class Buffer(NamedTuple):
    """Holds the replay of all seeds."""

    ring: Ring  # rows (S, T, H, E, ...)
    count: Array  # () int32, steps of every environment stored so far, with those overwritten since
    key: Key  # (S,) for random actions before learning; it never changes, so that a drawn action can be held


_SEEDS, _WHOLE = PartitionSpec("seeds"), PartitionSpec()
_RING = Ring(PartitionSpec("seeds", None, None, collectives.AXIS), _WHOLE, _WHOLE, _WHOLE)  # type: ignore
_SHARDING = Buffer(_RING, _WHOLE, _SEEDS)  # type: ignore
_STORAGE = Storage(Buffer(OVER_SEEDS, None, 0), _SHARDING, kept=True, flags=("replay-size",))  # type: ignore


@dataclasses.dataclass(frozen=True)
class Replay:
    """Stores every step in a ring for each task, and updates the agent on random batches.

    The first actions are random, and each is held for some steps. Then each step of every environment, or every
    ``update_every``-th, is followed by ``updates_per_step`` updates. ``multistep`` has the equations of ``n_step``.
    """

    storage: ClassVar[Storage] = _STORAGE
    adaptations: ClassVar[int] = 0  # the policy stays as it is while it plays
    updates_per_step: Annotated[int, _FLAG] = 1
    """Gradient updates after each step of every environment, or after every so many by update-every."""
    update_every: Annotated[int, _FLAG] = 1
    """Steps of every environment between two times of updates."""
    policy_delay: Annotated[int, _FLAG] = 1
    """Update the actor and the temperatures at every so many updates of the critics (TD3; Fujimoto et al. 2018). There
    target critics wait as well; here they move at every update."""
    batch_size: Annotated[int, _FLAG] = 64
    """Transitions of each task in an update."""
    replay_size: Annotated[int, _FLAG] = 100_000
    """Transitions that each task's replay holds on the device."""
    host_replay_size: Annotated[int, _FLAG] = 0
    """Transitions of each task that the host's memory keeps, if more than replay-size; 0 keeps none there. Then half of
    replay-size holds the latest transitions, and half is renewed from the host after every chunk, so that batches come
    from all of them."""
    warmup_steps: Annotated[int, _FLAG] = 100
    """Steps of every environment under random actions before learning starts."""
    warmup_hold: Annotated[int, _FLAG] = 10
    """Steps for which each random action is held; held actions explore more than ones that change every step."""
    reset_every: Annotated[int, _FLAG] = 0
    """Reset networks and optimisers after every so many steps of every environment, and keep the replay; 0 never."""
    n_step: Annotated[int, _FLAG] = 1
    """Number of rewards that a critic target sums before it bootstraps; fewer where the episode ends."""
    hindsight: Annotated[float, _FLAG] = 0.0
    """Share of each batch that comes from other tasks and is relabelled with this task's goal; only for families whose
    tasks differ in goals alone."""
    hindsight_choice: Annotated[HindsightChoice, _FLAG] = "uniform"
    """Which steps are relabelled for a task: any of other tasks (uniform), or those of all tasks for which its critics
    value them most beside other tasks' (inverse; Eysenbach et al. 2020)."""

    def __post_init__(self):
        if not 0 <= self.hindsight <= 1:
            raise InputError(f"hindsight is a share from 0 to 1, not {self.hindsight}")
        if self.hindsight_choice == "inverse" and not self.hindsight:
            raise InputError("hindsight-choice=inverse relabels nothing with hindsight=0; give its share")
        others = [field.name for field in dataclasses.fields(self) if field.name not in _MAY_BE_NONE]
        require_counts(self, *(name for name in others if name != "hindsight_choice"))
        require_not_negative(self, *_MAY_BE_NONE)
        if self.n_step > self.warmup_steps + 1:
            raise InputError(
                f"n-step={self.n_step} needs as many steps before the first update: warmup-steps of at least "
                f"{self.n_step - 1}, not {self.warmup_steps}"
            )

    def check(self, env: Env, num_envs: int, chunk_steps: int = 0, unroll: int = 0) -> None:
        """Check that the settings fit the environment, and chunks of so many steps of every environment.

        Args:
            unroll: steps of the windows through which a memory learns.

        Raises:
            InputError: the replay does not hold enough steps of every environment, or hindsight cannot relabel the
                family.
        """
        window = self.length(env.spec)
        if shown(env.spec.obs) and window > self.warmup_steps:
            raise InputError(f"{window} steps tell one transition of pictures; use warmup-steps of at least {window}")
        if shown(env.spec.obs) and env.episode_length < 2:
            raise InputError("the picture after an episode's last step is lost: it takes two steps; lower --env.repeat")
        window = max(window, unroll, 1)
        if self.capacity(num_envs) < max(window, self.update_every) * num_envs:
            least = math.ceil(window / self.update_every) * self.update_every
            steps = "one step" if least == 1 else f"{least} steps"
            raise InputError(f"replay-size ({self.replay_size}) must hold {steps} of num-envs ({num_envs})")
        if self.hindsight:
            hindsight.require(env)
        if self.host_replay_size:
            _require_host(self, env.spec, num_envs, chunk_steps)

    def describe(self, spec: Spec, num_envs: int) -> str:
        """Return a description of its size."""
        beside = f", and {self.host_slots(num_envs) * num_envs:,} on the host" if self.host_replay_size else ""
        return f"replay ({self.capacity(num_envs):,} transitions a task{beside})"

    def length(self, spec: Spec) -> int:
        """Return how many consecutive steps to draw for each transition; 0 if transitions are single steps."""
        if shown(spec.obs):
            return pictures.window(spec.frames, self.n_step)
        return self.n_step if self.n_step > 1 else 0

    @property
    def steps(self) -> int:
        """Steps of every environment before the agent learns again."""
        return self.update_every

    def capacity(self, num_envs: int) -> int:
        """Return how many transitions each task's ring holds: the replay size, rounded down to whole iterations."""
        stored = self.steps * num_envs
        return self.replay_size // stored * stored

    def host_slots(self, num_envs: int) -> int:
        """Return how many steps of every environment the host keeps."""
        return self.host_replay_size // num_envs

    def rollout_bytes(self, spec: Spec, num_envs: int) -> int:
        """Return 0, as all steps that are learned from lie in the data."""
        return 0

    # Data.

    def init(self, item: Transition, spec: Spec, num_tasks: int, num_envs: int, keys: Key) -> Buffer:
        """Return an empty replay for transitions like ``item`` (no leading axes) and seeds with ``keys`` (S,)."""
        item = pictures.compress(item, spec.obs[PICTURES].shape[-1]) if shown(spec.obs) else item
        own, segments = num_envs // collectives.count(), segments_of(self, spec, num_envs)
        latest = self.capacity(num_envs) // num_envs - math.prod(segments)
        blank = lambda _: rings.init(item, num_tasks, latest, own, segments)
        return Buffer(jax.vmap(blank, out_axes=OVER_SEEDS)(keys), jnp.int32(0), keys)

    def explore(self, data: Buffer, action: Array, step: Array) -> Array:
        """Replace actions (S, T, E, A) at a step () by held random ones until learning starts."""
        everywhere = (action.shape[1], action.shape[2] * collectives.count(), action.shape[3])
        fold = lambda key: jax.random.fold_in(key, step // self.warmup_hold)
        drawn = jax.vmap(lambda key: jax.random.uniform(fold(key), everywhere, minval=-1.0))(data.key)
        return jnp.where(step < self.warmup_steps, collectives.own(drawn, axis=2), action)

    def add(self, data: Buffer, steps: Transition) -> Buffer:
        """Store the latest steps of every environment, leaves (S, T, H, E, ...)."""
        kept = data.ring.rows.obs
        steps = pictures.compress(steps, kept[PICTURES].shape[-1]) if shown(kept) else steps
        ring, count = jax.vmap(rings.add, (OVER_SEEDS, 0), OVER_SEEDS)(data.ring, steps), data.count + self.steps
        if self.host_replay_size:
            ring = rings.weigh(ring, jnp.minimum(count, self.host_slots(steps.reward.shape[3] * collectives.count())))
        return Buffer(ring, count, data.key)

    # Learning.

    @property
    def updates(self) -> int:
        """The number U of updates each time that the agent learns."""
        return self.updates_per_step

    def batches(self, env: Env, agent: Any, tasks: Task, data: Buffer, key: Key, state: Any = None) -> Transition:
        """Draw windows (U, T, B, L, ...) for one seed's updates, by one gather, which is fastest.

        Args:
            state: the agent's, by which steps are chosen with hindsight-choice=inverse.
        """
        shape = (len(tasks.id), self.updates_per_step, self.batch_size)
        if self.hindsight:
            length = self.length(env.spec)
            judge = None if self.hindsight_choice == "uniform" else partial(agent.judge, state, tasks)
            rows = hindsight.sample(env, tasks, self.hindsight, data.ring, key, shape, length, judge)
            rows = rows if length else _single(rows, 3)
        else:
            rows = self.draw(env.spec, agent, data.ring, key, math.prod(shape[1:]))
            rows = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), rows)
        return jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), rows)

    def draw(self, spec: Spec, agent: Any, ring: Ring, key: Key, count: int) -> Transition:
        """Draw ``count`` windows of every task (T, count, L, ...), as long as the agent needs them."""
        length = max(self.length(spec), agent.unroll)
        rows = rings.sample(ring, key, count, length)
        return rows if length else _single(rows, 2)

    def window(self, data: Buffer, batch: Transition) -> Transition:
        """Return the windows (T, B, L, ...) of one update."""
        return batch


def joined(window: Transition, gamma: Array, n_step: int) -> Transition:
    """Join windows (T, B, L, ...) to transitions (T, B, ...) of ``n_step`` steps, for discounts (T,) of the tasks."""
    length, join = window.reward.shape[2], multistep.join
    if length == 1:
        return jax.tree.map(lambda x: x[:, :, 0], window)
    if shown(window.obs):
        join = partial(pictures.join, frames=pictures.frames(length, n_step), n_step=n_step)
    return jax.vmap(join)(window, gamma)


def _single(rows: Transition, axis: int) -> Transition:
    """Return single steps as windows of one step, whose axis is ``axis``."""
    return jax.tree.map(lambda x: jnp.expand_dims(x, axis), rows)


# Segments of older steps, which the host keeps.


def segments_of(replay: Replay, spec: Spec, num_envs: int) -> tuple[int, int]:
    """Return rows K and length L of the recalled segments on the device."""
    if not replay.host_replay_size:
        return 0, 0
    return store.segments(replay.capacity(num_envs) // num_envs, replay.length(spec), replay.steps)


def newest(data: Buffer, count: int) -> Any:
    """Return the latest steps of every environment in the order of time, leaves (S, T, count, E, ...)."""
    return jax.vmap(partial(rings.newest, count=count), (OVER_SEEDS,))(data.ring)


def recall(data: Buffer, segments: Any) -> Buffer:
    """Write recalled segments, leaves (S, T, F L, E, ...), over the oldest."""
    return data._replace(ring=jax.vmap(rings.recall, (OVER_SEEDS, 0), OVER_SEEDS)(data.ring, segments))


def _require_host(replay: Replay, spec: Spec, num_envs: int, chunk_steps: int) -> None:
    if replay.host_replay_size <= replay.replay_size:
        raise InputError(
            f"host-replay-size ({replay.host_replay_size}) must be more than replay-size ({replay.replay_size}); "
            "with 0 the device keeps all"
        )
    if jax.process_count() > 1:
        raise InputError("host-replay-size takes one process; leave out --distributed")
    count, length = segments_of(replay, spec, num_envs)
    if not count:
        least = 2 * math.ceil(max(replay.length(spec), 1) / replay.steps) * replay.steps * num_envs
        raise InputError(f"with host-replay-size, replay-size must be at least {least}, not {replay.replay_size}")
    latest = replay.capacity(num_envs) // num_envs - count * length
    if chunk_steps > latest:
        raise InputError(
            f"with host-replay-size the device keeps the latest {latest} steps of every environment until a chunk "
            f"ends, and one takes {chunk_steps}; lower --chunk-steps or raise --replay-size"
        )
