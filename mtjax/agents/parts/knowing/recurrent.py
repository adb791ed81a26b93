"""Features of a hidden task, which a recurrent network keeps of all steps so far."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.knowing.base import Nothing
from mtjax.networks import Network, Params
from mtjax.types import Array, Key, Transition


class Hidden(NamedTuple):
    """Holds the hidden state before an observation."""

    state: Array  # (Z,)


class Track(NamedTuple):
    """Holds the steps of windows one after another, to tell the hidden state before each of them."""

    state: Array  # (B, Z) hidden state before the first step of each window
    obs: Array  # (B L, O)
    action: Array  # (B L, A)
    reward: Array  # (B L,)
    ended: Array  # (B L,) bool: the episode ended
    closed: Array  # (B L,) bool: the memory begins anew after the step


class Following(NamedTuple):
    """Holds what ``Track`` holds, to tell the hidden state after each step."""

    state: Array
    obs: Array
    action: Array
    reward: Array
    ended: Array
    closed: Array


def track(window: Transition, obs: Array) -> Track:
    """Return the track of windows (B, L, ...) whose observations are (B, L, O) as networks take them."""
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    steps = (obs, window.action, window.reward, window.ended, window.closed)
    return Track(window.memory.hidden[:, 0], *map(flat, steps))


@dataclasses.dataclass(frozen=True)
class Recurrent(Nothing):
    """Shows networks the hidden state of a recurrent network (Duan et al. 2016, "RL^2"; Wang et al. 2016).

    A gated recurrent unit reads every step once it is over, so that with s_t networks see all that is known before it:
        h_(t+1) = GRU(h_t, [s_t, a_t, r_t, e_t]),  h_0 = 0                 (e_t: the step ended an episode)
    It learns by the losses of the networks that see it, through the steps of a window. A window begins with the hidden
    state that acting had there, which does not learn.

    Differs from RL^2, where the unit reads s_t and the step before it at once, and the policy sees its output alone.
    Here the policy sees s_t beside h_t, which hold the same.
    """

    recurrent_size: int = 64
    """Size of the hidden state."""
    recurrent_steps: int = 16
    """Steps through which it learns from a replay; a rollout is learned from as a whole."""

    tells: ClassVar[bool] = True
    recurs: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_counts(self, "recurrent_size", "recurrent_steps")

    @property
    def cell(self) -> nn.GRUCell:
        return nn.GRUCell(self.recurrent_size)

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        inputs = read(seen.obs, action, jnp.float32(0), jnp.bool_(False))
        init = lambda key: self.cell.init(key, jnp.zeros(self.recurrent_size), inputs)["params"]
        if own:
            return Params({}, {"recurrent": Network.for_each_task(init, key, num_tasks)})
        return Params({"recurrent": init(key)}, {})

    def begin(self) -> Array:
        return jnp.zeros(self.recurrent_size)

    def remember(self, params: dict[str, Any], hidden: Array, step: Transition) -> Array:
        return self.advance(params, hidden, read(step.obs, step.action, step.reward, step.ended))

    def advance(self, params: dict[str, Any], hidden: Array, inputs: Array) -> Array:
        """Return the hidden state (..., Z) after inputs (..., I)."""
        return self.cell.apply({"params": params["recurrent"]}, hidden, inputs)[0]  # type: ignore

    def features(self, params: dict[str, Any], given: Array, seen: Any) -> Array:
        if isinstance(seen.past, Hidden):
            return seen.past.state
        before, after = self.over(params, Track(*seen.past))
        return after if isinstance(seen.past, Following) else before

    def over(self, params: dict[str, Any], track: Track) -> tuple[Array, Array]:
        """Return the hidden states (B L, Z) before and after every step."""
        count = len(track.state)
        in_time = lambda x: jnp.swapaxes(x.reshape(count, -1, *x.shape[1:]), 0, 1)
        inputs = read(track.obs, track.action, track.reward, track.ended)

        def step(hidden: Array, given: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            inputs, closed = given
            after = self.advance(params, hidden, inputs)
            return jnp.where(closed[:, None], self.begin(), after), (hidden, after)

        _, states = jax.lax.scan(step, track.state, (in_time(inputs), in_time(track.closed)))
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, x.shape[-1]), states)


def read(obs: Array, action: Array, reward: Array, ended: Array) -> Array:
    """Return a step (..., O), (..., A), (...), (...) as one input (..., I) of the recurrent unit."""
    return jnp.concatenate([obs, action, reward[..., None], jnp.float32(ended)[..., None]], axis=-1)
