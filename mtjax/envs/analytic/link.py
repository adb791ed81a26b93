"""A link of a network, whose bandwidth, delay, buffer and losses a sender has to find out."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.analytic import bars
from mtjax.envs.family import Family
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter, not_negative, positive
from mtjax.envs.pixels import Mark, Pictured
from mtjax.types import Array, InputError, Key, Step, Task

_PACE = 0.1  # by which share an action changes the rate at most
_SLOWEST, _FASTEST = 10.0, 1000.0  # [packets/s]
_FIRST = (0.3, 1.5)  # first rates, in bandwidths
_USUAL = 200.0  # [packets/s], observed as 0
_RATE, _BANDWIDTH, _QUEUE, _WIDE = -0.6, 0.0, 0.6, 0.2  # places of the bars of a film, half their width
_TALL = 500.0  # [packets/s] of a bar of height 1


class LinkState(NamedTuple):
    """The state of a link and of its sender."""

    rate: Array  # () [packets/s] that are sent
    queue: Array  # () [packets] that wait
    reports: Array  # (reports, 3) of the last steps, the newest last; see ``Link``
    used: Array  # () share of the bandwidth that the last step used
    dropped: Array  # () share of the last step's packets that the buffer could not take


@dataclasses.dataclass(frozen=True)
class Link(Pictured, Family):
    """Congestion control: send as fast as a link can carry, without a queue in its buffer.

    A fluid queue (Misra, Gong and Towsley 2000) in steps of a round trip, T = 2 D. With rate r [packets/s], queue q
    [packets], bandwidth c, delay D, buffer B and random loss l:
        r <- r (1 + 0.1 a)  if a >= 0, else  r / (1 - 0.1 a),  within [10, 1000]
        arrived = r (1 - l) T;  delivered = min(q + arrived, c T);  left = q + arrived - delivered
        q <- min(left, B);  dropped = (left - q) / (r T)

    Observation (3 ``reports`` + 1,): of each of the last steps, oldest first: the change of latency over time,
        (q - q before) / (c T); the logarithm of latency over its least, log(1 + q / (c T)); that of packets sent over
        packets delivered, log(r T / delivered). Then log(r / 200), of the sender's own rate.
    Action (1,): how to change the rate, see a above.
    Reward: what arrives, less what waits and what is lost,
            r = delivered / (c T) - q / (c T) - dropped
    Start: an empty queue, a rate uniform in [0.3, 1.5] c, and reports as of a step that uses the whole link.
    Episode: 400 steps; nothing terminates it. Metrics ``used``, ``queueing`` (q / (c T)) and ``dropped`` are those of
        the last step.

    Known best: no step can earn more than 1, as delivered <= c T. It earns 1 exactly if q = 0 and r = c / (1 - l):
        the rate is the bandwidth, and what is lost on the way is sent on top.

    Parameters that can vary (in brackets, from what Jay et al. 2019, "Aurora", draw):
        bandwidth: c [packets/s] ([100, 500]).
        delay: D one way [s] ([0.05, 0.5]).
        buffer: B [packets] ([2, 2981]).
        loss: l, the share of packets that is lost at random ([0, 0.05]).

    Differs from Aurora in: packets are a fluid; a step is a round trip of an empty link; an action changes the rate by
    a tenth at most, and not a fortieth; ratios are observed as logarithms; the own rate is observed too; the reward
    counts throughput and latency in units of the link's own, so that the best is 1 for every link.
    """

    reports: int = 10
    """Steps whose reports are observed."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "bandwidth": positive("packets/s", 300.0),
            "delay": positive("s", 0.05),
            "buffer": positive("packets", 100.0),
            "loss": not_negative("1", 0.0, maximum=0.9),
        }
    )
    asks: ClassVar[str] = "Send as fast as a link can carry, without a queue in its buffer."
    episode_steps: ClassVar[int] = 400
    action_size: ClassVar[int] = 1
    step_seconds: ClassVar[float] = 0.1  # of the nominal link; others have round trips of their own
    look: ClassVar[Look | None] = bars.LOOK

    def __post_init__(self):
        super().__post_init__()
        if not 1 <= self.reports <= 100:
            raise InputError(f"reports must be at least 1 and at most 100, not {self.reports}")

    def reset(self, task: Task, key: Key) -> Step:
        rate = task.goal["bandwidth"] * jax.random.uniform(key, (), jnp.float32, *_FIRST)
        sent = -jnp.log1p(-task.goal["loss"])
        reports = jnp.zeros((self.reports, 3)).at[:, 2].set(sent)
        state = LinkState(rate, jnp.float32(0), reports, jnp.float32(0), jnp.float32(0))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: LinkState, action: Array) -> LinkState:
        """Return the link after a round trip at the changed rate."""
        bandwidth, seconds = task.goal["bandwidth"], 2 * task.goal["delay"]
        change = _PACE * jnp.clip(action[0], -1.0, 1.0)
        rate = state.rate * jnp.where(change >= 0, 1 + change, 1 / (1 - change))
        rate = jnp.clip(rate, _SLOWEST, _FASTEST)
        most = bandwidth * seconds
        there = state.queue + rate * (1 - task.goal["loss"]) * seconds
        delivered = jnp.minimum(there, most)
        queue = jnp.minimum(there - delivered, task.goal["buffer"])
        dropped = (there - delivered - queue) / (rate * seconds)
        gradient = (queue - state.queue) / most
        report = jnp.stack([gradient, jnp.log1p(queue / most), jnp.log(rate * seconds / delivered)])
        reports = jnp.concatenate([state.reports[1:], report[None]])
        return LinkState(rate, queue, reports, delivered / most, dropped)

    def observe(self, task: Task, state: LinkState) -> Array:
        """Return the last reports and the own rate."""
        return jnp.append(state.reports.ravel(), jnp.log(state.rate / _USUAL))

    def reward(self, task: Task, state: LinkState, action: Array) -> Array:
        """Return throughput less latency and losses, ()."""
        return state.used - _queueing(task, state) - state.dropped

    def metrics(self, task: Task, state: LinkState, action: Array) -> dict[str, Array]:
        """Return the three parts of the reward."""
        return {"used": state.used, "queueing": _queueing(task, state), "dropped": state.dropped}

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return bars of rate (blue), bandwidth (grey) and queue (red)."""
        spec = bars.chart()
        for name, x, rgba in (("rate", _RATE, bars.BLUE), ("bandwidth", _BANDWIDTH, bars.GREY)):
            bars.add_bar(spec, name, x, _WIDE, rgba)
        bars.add_bar(spec, "queue", _QUEUE, _WIDE, bars.RED)
        return spec

    def marks(self, task: Task, state: LinkState) -> dict[str, Mark]:
        """Return the bars. That of the queue is as high as the bandwidth if it delays by a round trip."""
        bandwidth = task.goal["bandwidth"] / _TALL
        return {
            "rate": bars.bar(_RATE, state.rate / _TALL, _WIDE),
            "bandwidth": bars.bar(_BANDWIDTH, bandwidth, _WIDE),
            "queue": bars.bar(_QUEUE, _queueing(task, state) * bandwidth, _WIDE),
        }


def best_rate(bandwidth: float, loss: float = 0.0) -> float:
    """Return the rate [packets/s] that uses a link whole and leaves its queue empty."""
    return bandwidth / (1 - loss)


def _queueing(task: Task, state: LinkState) -> Array:
    """Return the time () that packets wait, in round trips of an empty link."""
    return state.queue / (2 * task.goal["delay"] * task.goal["bandwidth"])
