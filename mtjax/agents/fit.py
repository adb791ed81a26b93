"""A fit is one gradient step of some networks over all tasks: surgery on the tasks' gradients, and an optimiser."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import optax

from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.state import AgentState, FitState, Nets
from mtjax.types import Array, Key, Metrics, Spec, Task


class Fitted(NamedTuple):
    """Holds what a gradient step returns."""

    nets: Nets  # those that have learned
    state: FitState
    aux: Any  # of the loss, leaves (T, ...)
    metrics: Metrics  # of the conflict between tasks


class Losses(NamedTuple):
    """Holds the losses of an agent's fits on one batch, by which diagnostics look at it."""

    nets: Nets  # of all tasks, as the losses see them
    by_fit: dict[str, tuple[Callable, tuple]]  # a loss of one task, whose aux are metrics, and data (T, ...)
    batch: Any  # (T, B, ...) with ``obs`` and ``features``, and ``action`` where critics see it


class Problem(NamedTuple):
    """Holds a loss as a function of those networks alone that learn."""

    loss: Callable  # (Params of one task, data of one task) -> (loss, aux)
    params: Params  # of all tasks, by the networks' names
    data: Any  # leaves (T, ...)


@dataclasses.dataclass(frozen=True)
class Fit:
    """One gradient step of the networks called ``names``.

    A loss of one task, ``loss(nets, *data) -> (loss, aux)``, sees all networks. Only those that the fit names learn.

    Args:
        rule: combines the tasks' gradients.
        per_layer: weigh the tasks for each layer by its own gradients, instead of once for all shared parameters.
        over_devices: average over the devices, where each has other data.
    """

    names: tuple[str, ...]
    optimizer: optax.GradientTransformation
    rule: surgery.Rule = dataclasses.field(default_factory=surgery.Rule)
    per_layer: bool = False
    over_devices: bool = False

    def init(self, nets: Nets, num_tasks: int) -> FitState:
        """Return what is remembered before the first step."""
        rule = surgery.init(self.rule, _stacked(self._learned(nets)), num_tasks, self.per_layer)
        return FitState(self.optimizer.init(self._learned(nets)), rule)

    def step(
        self, state: FitState, loss: Callable, nets: Nets, data: tuple, key: Key, importance: Array | None = None
    ) -> Fitted:
        """Take a gradient step.

        Args:
            loss: of one task, see above.
            nets: of all tasks.
            data: leaves (T, ...).
            key: for rules that draw.
            importance: (T,) factors of the tasks' losses; None for 1.
        """
        loss, params, data = self.problem(loss, nets, data)
        combined = surgery.gradient(self.rule, loss, params, data, state.rule, key, importance, self.per_layer)
        gradients = _apart(combined.gradients)
        nets, optimizer = descent.step(self.optimizer, gradients, state.optimizer, self._learned(nets))
        rule = surgery.adapt_rule(self.rule, loss, _stacked(nets), data, combined)
        return Fitted(nets, FitState(optimizer, rule), combined.aux, combined.metrics)

    def problem(self, loss: Callable, nets: Nets, data: tuple) -> Problem:
        """Return the loss of one task as a function of the parameters that learn."""
        fixed = _stacked({name: net for name, net in nets.items() if name not in self.names})

        def of_learned(params: Params, data: tuple) -> tuple[Array, Any]:
            own, data = data
            return loss(_apart(Params(fixed.shared, own)) | _apart(params), *data)

        averaged = surgery.over_devices(of_learned) if self.over_devices else of_learned
        return Problem(averaged, _stacked(self._learned(nets)), (fixed.own, data))

    def _learned(self, nets: Nets) -> Nets:
        return {name: nets[name] for name in self.names}


def descend(
    fits: Mapping[str, Fit],
    name: str,
    state: AgentState,
    loss: Callable,
    data: tuple,
    key: Key,
    importance: Array | None = None,
    seen: Nets | None = None,
) -> tuple[AgentState, Fitted]:
    """Take the gradient step called ``name`` for a loss of one task on data (T, ...).

    Args:
        importance: (T,) factors of the tasks' losses; None for 1.
        seen: networks that the loss sees in place of the state's.
    """
    fitted = fits[name].step(state.fits[name], loss, state.nets | (seen or {}), data, key, importance)
    fitted = fitted._replace(metrics={f"{name}_{metric}": value for metric, value in fitted.metrics.items()})
    return state._replace(nets=state.nets | fitted.nets, fits=state.fits | {name: fitted.state}), fitted


def above_least(agent: Any, loss: Callable) -> Callable:
    """Subtract its lower bound from the critics' loss of one task, for rules of surgery that compare losses.

    Only a representation has one other than 0.
    """
    least = agent.representation.least_loss

    def excess(nets: Nets, *data: Any) -> tuple[Array, Any]:
        value, aux = loss(nets, *data)
        return value - least, aux

    return excess


def learned(fits: Collection[Fit]) -> tuple[str, ...]:
    """Return the names of all networks that some fit names."""
    return tuple(dict.fromkeys(name for fit in fits for name in fit.names))


def _stacked(nets: Nets) -> Params:
    """Return networks as one, divided by what tasks share."""
    return Params({name: net.shared for name, net in nets.items()}, {name: net.own for name, net in nets.items()})


def _apart(params: Params) -> Nets:
    """Return networks by name again."""
    return {name: Params(params.shared[name], params.own[name]) for name in params.shared}


def reset_networks(agent: Any, state: AgentState, spec: Spec, tasks: Task, key: Key) -> AgentState:
    """Return a state in which all that some fit trains begins anew; what is counted is kept."""
    fresh = agent.init(spec, tasks, key)
    nets = {name: fresh.nets[name] for name in learned(agent.fits.values())}
    nets |= {"scaling": Params({}, agent.scaling.reset(state.nets["scaling"].own))}
    return fresh._replace(nets=state.nets | nets, numbers=state.numbers)
