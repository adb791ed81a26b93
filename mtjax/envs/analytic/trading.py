"""The sale of a block of shares, quick or slow. Tasks differ in how much the seller minds risk."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.analytic import bars
from mtjax.envs.family import Family
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter, not_negative, positive
from mtjax.envs.pixels import Mark, Pictured
from mtjax.types import Array, Key, Step, Task

_SHARES, _PRICE = 1.0, 50.0  # X [million shares] and S_0 [dollars] at the start
_SPREAD = 0.0625  # [dollars a share], half of it
_DAYS, _TRADES = 5.0, 50  # T and N
_TAU = _DAYS / _TRADES  # [days] between trades
_PACE = 30.0  # the fastest and the slowest pace, over an even one
_POINTS = 1e4 / (_SHARES * _PRICE)  # basis points of the first value in a million dollars
_SHOWN, _HALF, _BESIDE = 10, 0.07, 0.2  # bars of a film, half their width, and the place of one beside another


class Market(NamedTuple):
    """The state of a sale."""

    left: Array  # () [million shares] still held
    price: Array  # () [dollars]
    trades: Array  # () int32 so far
    gained: Array  # () [million dollars] of wealth and less risk, in the last step
    key: Key  # of the prices to come


@dataclasses.dataclass(frozen=True)
class Trading(Pictured, Family):
    """Trading: sell a million shares within five days, at little cost and little risk (Almgren and Chriss 2001).

    Quick sales press the price, and slow ones leave it to chance. In step k of N = 50, of tau = 0.1 days each, n shares
    are sold of the x that are left, where v = n / tau and z is a normal number:
        n = min(x, 30^a x / (N + 1 - k));  in the last step n = x
        x <- x - n
        cash <- cash + n (S - spread - eta v)
        S <- S + sigma sqrt(tau) z - tau gamma v

    Observation (3,): share that is left, and share of the time, both from 1 to 0; the change of the price since the
        start, over sigma sqrt(T).
    Action (1,): the pace a. 0 sells evenly over the rest of the time, 1 thirty times as fast.
    Reward: with the change D of cash + x S, and the x after the trade,
            r = D - lambda sigma^2 tau x^2
        in basis points of the first value of the shares, 50 million dollars.
    Start: one million shares at 50 dollars.
    Episode: at most 50 steps; it terminates when all is sold.

    The best is known. Returns are -(E + lambda V) on average, with E the mean and V the variance of what a plan of
    sales costs. With eta' = eta - gamma tau / 2 the best plan, ``best_holdings``, holds at the time t
        x = X sinh(kappa (T - t)) / sinh(kappa T),  2 (cosh(kappa tau) - 1) / tau^2 = lambda sigma^2 / eta'
    shares, and none that watches the price does better on average. It costs (``best_return``)
        E = gamma X^2 / 2 + spread X + eta' tanh(kappa tau / 2) (tau sinh(2 kappa T) + 2 T sinh(kappa tau)) X^2
            / (2 tau^2 sinh(kappa T)^2)
        V = sigma^2 X^2 (tau sinh(kappa T) cosh(kappa (T - tau)) - T sinh(kappa tau))
            / (2 sinh(kappa T)^2 sinh(kappa tau))

    Parameters that can vary:
        risk-aversion: lambda [1 / million dollars]. It is the reward's alone; only the context tells it.
        volatility: sigma [dollars a share in the square root of a day].
        impact: eta, which a sale's own price loses [dollars a share, at a million shares a day].
        lasting-impact: gamma, which the price loses for good [dollars a share, for a million shares].

    Their nominal values are those of Almgren and Chriss' example.

    Differs from their example in: ten trades a day, not one; the risk is charged step by step, where theirs is the
    variance of the whole cost. Both agree for every plan that does not watch the price.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "risk-aversion": positive("1/M$", 1.0),
            "volatility": positive("$/share/day^0.5", 0.95),
            "impact": positive("$/(M shares/day)", 2.5),
            "lasting-impact": not_negative("$/M shares", 0.25),
        }
    )
    asks: ClassVar[str] = "Sell a million shares within five days, at little cost and little risk."
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = _TRADES
    action_size: ClassVar[int] = 1
    step_seconds: ClassVar[float] = 86_400.0 * _TAU
    film_speed: ClassVar[float] = 86_400.0
    look: ClassVar[Look | None] = bars.LOOK

    def reset(self, task: Task, key: Key) -> Step:
        state = Market(jnp.float32(_SHARES), jnp.float32(_PRICE), jnp.int32(0), jnp.float32(0), key)
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: Market, action: Array) -> Market:
        """Return the market after a sale, and after the price has moved."""
        goal, (key, noise_key) = task.goal, jax.random.split(state.key)
        rest = jnp.maximum(_TRADES - state.trades, 1)
        pace = _PACE ** jnp.clip(action[0], -1.0, 1.0)
        sold = jnp.where(rest == 1, state.left, jnp.minimum(state.left, pace * state.left / rest))
        rate, left = sold / _TAU, state.left - sold
        noise = goal["volatility"] * math.sqrt(_TAU) * jax.random.normal(noise_key)
        moved = noise - _TAU * goal["lasting-impact"] * rate
        risk = goal["risk-aversion"] * jnp.square(goal["volatility"] * left) * _TAU
        gained = left * moved - sold * (_SPREAD + goal["impact"] * rate) - risk
        return Market(left, state.price + moved, state.trades + 1, gained, key)

    def observe(self, task: Task, state: Market) -> Array:
        """Return what is left of shares and time, and how the price has moved."""
        time = 1 - state.trades / _TRADES
        moved = (state.price - _PRICE) / (task.goal["volatility"] * math.sqrt(_DAYS))
        return jnp.stack([state.left / _SHARES, time, moved])

    def reward(self, task: Task, state: Market, action: Array) -> Array:
        """Return the wealth gained less the risk held, in basis points, ()."""
        return _POINTS * state.gained

    def terminates(self, task: Task, state: Market) -> Array:
        """Return whether () all is sold."""
        return state.left <= 0

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return bars of the best holdings over time (grey), and balls of what is held (blue) and the price (red)."""
        spec = bars.chart()
        for i in range(_SHOWN):
            bars.add_bar(spec, f"best {i}", _across(i / (_SHOWN - 1)), _HALF, bars.GREY)
        bars.add_ball(spec, "held", bars.BLUE)
        bars.add_ball(spec, "price", bars.RED)
        return spec

    def marks(self, task: Task, state: Market) -> dict[str, Mark]:
        """Return bars and balls. The price's ball is half way up where the price is that of the start."""
        kappa = _kappa(task.goal, jnp)
        times = np.arange(_SHOWN) / (_SHOWN - 1)
        best = jnp.sinh(kappa * _DAYS * (1 - times)) / jnp.sinh(kappa * _DAYS)
        now = _across(state.trades / _TRADES)
        moved = (state.price - _PRICE) / (4 * task.goal["volatility"] * math.sqrt(_DAYS))
        bars_of_best = {f"best {i}": bars.bar(_across(times[i]), best[i], _HALF) for i in range(_SHOWN)}
        held = bars.ball(now, state.left / _SHARES)
        return bars_of_best | {"held": held, "price": bars.ball(now, jnp.clip(0.5 + moved, 0, 1))}


def _across(time: Any) -> Any:
    """Return the place of a time from 0 to 1 in a film."""
    return 1.8 * time - 0.9


def _kappa(goal: Mapping[str, Any], xp: Any = np) -> Any:
    """Return the urgency [1/day] of the best plan. ``xp`` is NumPy or JAX, as the values are."""
    impact = goal["impact"] - goal["lasting-impact"] * _TAU / 2
    ratio = goal["risk-aversion"] * goal["volatility"] ** 2 / impact
    return xp.arccosh(1 + ratio * _TAU**2 / 2) / _TAU


def best_holdings(goal: Mapping[str, float]) -> np.ndarray:
    """Return the shares (N + 1,) [millions] that the best plan holds after 0 to N trades, for values by parameter."""
    kappa = _kappa(goal)
    return _SHARES * np.sinh(kappa * (_DAYS - _TAU * np.arange(_TRADES + 1))) / np.sinh(kappa * _DAYS)


def best_return(goal: Mapping[str, float]) -> float:
    """Return what the best plan earns on average [basis points], for values by parameter."""
    kappa, impact = _kappa(goal), goal["impact"] - goal["lasting-impact"] * _TAU / 2
    sinh, cosh, square = np.sinh, np.cosh, np.sinh(kappa * _DAYS) ** 2
    mean = goal["lasting-impact"] * _SHARES**2 / 2 + _SPREAD * _SHARES
    slope = _TAU * sinh(2 * kappa * _DAYS) + 2 * _DAYS * sinh(kappa * _TAU)
    mean += impact * _SHARES**2 * np.tanh(kappa * _TAU / 2) * slope / (2 * _TAU**2 * square)
    spread = _TAU * sinh(kappa * _DAYS) * cosh(kappa * (_DAYS - _TAU)) - _DAYS * sinh(kappa * _TAU)
    variance = (goal["volatility"] * _SHARES) ** 2 * spread / (2 * square * sinh(kappa * _TAU))
    return float(-_POINTS * (mean + goal["risk-aversion"] * variance))


def pace_of(sold: float, left: float, trades: int) -> float:
    """Return the action that sells ``sold`` of the shares that are ``left``, after so many trades."""
    return math.log(sold * (_TRADES - trades) / left) / math.log(_PACE)
