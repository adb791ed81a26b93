"""Features of a hidden task, made of a memory of all steps so far, such as a recurrent network keeps."""

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params, init_params, orthogonal
from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, Key, Transition


class Hidden(NamedTuple):
    """Holds the memory before an observation."""

    state: Any  # as ``begin`` has it


class Track(NamedTuple):
    """Holds the steps of windows one after another, to tell the memory before each of them."""

    state: Any  # (B, ...) memory before the first step of each window
    obs: Array  # (B L, O)
    action: Array  # (B L, A)
    reward: Array  # (B L,)
    ended: Array  # (B L,) bool: the episode ended
    closed: Array  # (B L,) bool: the memory begins anew after the step
    cut: Array  # (B L,) bool: sums of rewards end with the step
    next_obs: Any = None  # (B L, O)
    key: Key | None = None  # () for losses that draw


class Following(Track):
    """Holds what ``Track`` holds, to tell the memory after each step."""


def track(window: Transition, obs: Array) -> Track:
    """Return the track of windows (B, L, ...) whose observations are (B, L, O) as networks take them."""
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    steps = (obs, window.action, window.reward, window.ended, window.closed, window.cut, window.next_obs)
    return Track(jax.tree.map(lambda x: x[:, 0], window.memory.hidden), *map(flat, steps))


@dataclasses.dataclass(frozen=True)
class Remembering(Nothing):
    """Shows networks what is made of a memory, which reads every step of a trial once it is over.

    It learns through the steps of a window, which begins with the memory that acting had there. That does not learn.
    Parameters have changed since, so a window of a replay may have steps in front, after which the memory is that of
    the present parameters, or of the slow ones in targets, and nothing learns (burn-in; Kapturowski et al. 2019,
    "R2D2"). A subclass says with which memory a trial begins and how it changes, and may say what is read of a step and
    what is shown.
    """

    recurrent_steps: int = 16
    """Steps through which it learns from a replay; a rollout is learned from as a whole."""
    burn_in: int = 0
    """Steps before these that only renew the stored memory (R2D2); for a replay alone."""

    tells: ClassVar[bool] = True
    recurs: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_counts(self, "recurrent_steps")
        parts.require_not_negative(self, "burn_in")

    def read(self, params: dict[str, Any], step: Any) -> Array:
        """Return what is read (..., I) of steps: transitions or a ``Track``."""
        return inputs(step.obs, step.action, step.reward, step.ended)

    @abc.abstractmethod
    def advance(self, params: dict[str, Any], memory: Any, read: Array) -> Any:
        """Return the memory (..., M) after steps (..., I) as they are read."""

    def show(self, params: dict[str, Any], memory: Any) -> Array:
        """Return what networks see (..., Z) of a memory (..., M)."""
        return memory

    def remember(self, params: dict[str, Any], hidden: Any, step: Transition) -> Any:
        return self.advance(params, hidden, self.read(params, step))

    def features(self, params: dict[str, Any], task_vector: Array, seen: Any) -> Array:
        if isinstance(seen.past, Hidden):
            return self.show(params, seen.past.state)
        track = self.burned_in(params, seen.past)
        return self.shown(params, track, isinstance(seen.past, Following))

    def shown(self, params: dict[str, Any], track: Track, after: bool) -> Array:
        """Return what networks see (B L, Z) before every step, or after it."""
        return self.show(params, self.over(params, track)[after])

    def over(self, params: dict[str, Any], track: Track) -> tuple[Any, Any]:
        """Return the memories (B L, ...) before and after every step.

        Where sums of rewards end, the value after the step is that of going on, so its memory has seen no end.
        """
        _, before = self._through(params, track)
        going_on = track._replace(ended=track.ended & ~track.cut)
        return before, self.advance(params, before, self.read(params, going_on))

    def burned_in(self, params: dict[str, Any], track: Track) -> Track:
        """Return a track (B L, ...) without the ``burn_in`` first steps of windows, and with the memory after them.

        No gradient flows through these.
        """
        if not self.burn_in:
            return track
        count, steps = _count(track), track._replace(state=None, key=None)
        by_window = lambda x, part: x.reshape(count, -1, *x.shape[1:])[:, part].reshape(-1, *x.shape[1:])
        take = lambda part: jax.tree.map(lambda x: by_window(x, part), steps)
        first, rest = take(slice(self.burn_in)), take(slice(self.burn_in, None))
        state, _ = self._through(jax.lax.stop_gradient(params), first._replace(state=track.state))
        return rest._replace(state=state, key=track.key)

    def _through(self, params: dict[str, Any], track: Track) -> tuple[Any, Any]:
        """Return the memories (B, ...) after all steps, and those (B L, ...) before every one."""
        begun, count = self.begin(track.obs.shape[-1], track.action.shape[-1]), _count(track)
        in_time = lambda x: jnp.swapaxes(x.reshape(count, -1, *x.shape[1:]), 0, 1)

        def step(memory: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
            read, closed = given
            renew = lambda new, old: jnp.where(closed.reshape(-1, *[1] * new.ndim), new, old)
            return jax.tree.map(renew, begun, self.advance(params, memory, read)), memory

        last, before = jax.lax.scan(step, track.state, (in_time(self.read(params, track)), in_time(track.closed)))
        return last, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), before)


def _count(track: Track) -> int:
    """Return the number B of windows."""
    return len(jax.tree.leaves(track.state)[0])


def gru(size: int) -> nn.GRUCell:
    """Return a gated recurrent unit with a memory (size,), whose kernels are drawn one after another."""
    return nn.GRUCell(size, recurrent_kernel_init=orthogonal())


@dataclasses.dataclass(frozen=True)
class Recurrent(Remembering):
    """Shows networks the hidden state of a recurrent network (Duan et al. 2016, "RL^2"; Wang et al. 2016).

    A gated recurrent unit reads every step once it is over, so that with s_t networks see all that is known before it:
        h_(t+1) = GRU(h_t, [s_t, a_t, r_t, e_t]),  h_0 = 0                 (e_t: the step ended an episode)
    Where a time limit cuts sums off, the value after the step is that of going on: of h_(t+1) with e_t = 0. The unit
    learns through the steps of a window, by the critics' loss, or in the step of an actor that learns from rollouts, by
    both losses. A window begins with the hidden state that acting had there, which does not learn.

    Differs from RL^2, where the unit reads s_t and the step before it at once, and the policy sees its output alone.
    Here the policy sees s_t beside h_t, which hold the same. A critic of states sees the same h_t; in RL^2 the
    baseline has a memory of its own.
    """

    recurrent_size: int = 64
    """Size of the hidden state."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_counts(self, "recurrent_size")

    @property
    def cell(self) -> nn.GRUCell:
        return gru(self.recurrent_size)

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        read = inputs(seen.obs, action, jnp.float32(0), jnp.bool_(False))
        init = lambda key: {"recurrent": self.cell.init(key, jnp.zeros(self.recurrent_size), read)["params"]}
        return init_params(init, own, key, num_tasks)

    def begin(self, obs_size: int, action_size: int) -> Array:
        return jnp.zeros(self.recurrent_size)

    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        return self.cell.apply({"params": params["recurrent"]}, memory, read)[0]  # type: ignore


def inputs(obs: Array, action: Array, reward: Array, ended: Array) -> Array:
    """Return a step (..., O), (..., A), (...), (...) as one input (..., I) of the recurrent unit."""
    return jnp.concatenate([obs, action, reward[..., None], jnp.float32(ended)[..., None]], axis=-1)
