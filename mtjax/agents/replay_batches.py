"""Batches of a replay, for agents that learn from one: what the losses of soft actor-critic take and find."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from mtjax.agents.fit import Losses, above_least
from mtjax.agents.networks import Params
from mtjax.agents.parts.policies import Taken
from mtjax.agents.parts.values import reduce
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState, Nets, axes_of
from mtjax.experience import pictures
from mtjax.experience.replay import joined
from mtjax.types import Array, Key, Metrics, Task, Transition

_ROUNDING = 1e-3
"""Actions that differ by more are not those that the policy has drawn."""


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    action: Array  # (B, A)
    reward: Array  # (B,) in the task's units
    discount: Array  # (B,) gamma, or 0 where the episode terminated
    next_obs: Any  # (B, O)
    features: Array  # (Z,) or (B, Z) features of the task that need no learned parameters
    temperature: Array  # ()
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all
    model_targets: Any = None  # targets of the representation's models
    followed: Array | None = None  # (B,) bool: next_obs is what followed; None: it always is
    behaviour: Taken | None = None  # of the policy that acted, if targets ask for it
    cut: Array | None = None  # (B,) bool: sums of rewards end with the step, if targets sum over windows


class Sample(NamedTuple):
    """Holds actions that a policy has sampled."""

    action: Array  # (B, A)
    log_prob: Array  # (B,)
    cost: Array  # (B,) what the temperature weighs: log pi, in Distral less a share of log pi_0


class CriticAux(NamedTuple):
    """Holds what a critic loss finds beside the loss."""

    metrics: Metrics
    expected: Array  # (B,) the values that the critics are fitted to
    statistics: Any = {}  # new running statistics of the critics' bodies  # noqa: RUF012


class ActorAux(NamedTuple):
    """Holds what an actor loss finds beside the loss."""

    metrics: Metrics
    entropy: Array  # () of the policy
    statistics: Any = {}  # new running statistics of the actor's body  # noqa: RUF012


def prepare(agent: Any, state: AgentState, window: Transition, tasks: Task, key: Key | None = None) -> Batch:
    """Return the batch (T, ...) for the losses of ``agent``, of windows (T, B, L, ...).

    Args:
        key: for changing observations at random; None leaves them as they are.
    """
    batch, inputs, view = transitions(agent, window, tasks), state.nets["inputs"], agent.view
    batch = batch if key is None else agent.representation.augment(batch, key)
    kept = batch.extras if isinstance(batch.extras, Taken) else None
    last = batch.extras if isinstance(batch.extras, Transition) else batch
    past, next_past = view.around(inputs, window, batch, last)
    temperature = jnp.exp(state.nets["temperature"].parts["log"])
    bonus = temperature * abs(agent.target_entropy) * action_sizes(batch.action, tasks.action_mask) / 2
    gamma = discounts_of_all(agent, tasks)
    return Batch(
        obs=view.see_all(inputs, batch.obs, past),
        action=batch.action,
        reward=agent.scaling.rewards(state.nets["scaling"].own, batch, gamma, bonus),
        discount=gamma[:, None] * batch.discount,
        next_obs=view.see_all(inputs, batch.next_obs, next_past),
        features=view.features_of_all(state, batch, tasks),
        temperature=jnp.broadcast_to(temperature, len(tasks.id)),
        mask=tasks.action_mask,
        followed=pictures.followed(batch),
        behaviour=kept,
        cut=None if kept is None else batch.cut,
    )


def transitions(agent: Any, window: Transition, tasks: Task) -> Transition:
    """Return the transitions (T, N, ...) that windows (T, B, L, ...) are made to: all steps, or one n-step each.

    Steps of burn-in are none.
    """
    if agent.unroll:
        learned = lambda x: x[:, :, agent.conditioning.burn_in :].reshape(len(x), -1, *x.shape[3:])
        memory = None if agent.conditioning.recurs else window.memory
        return jax.tree.map(learned, window._replace(memory=memory))
    return joined(window, discounts_of_all(agent, tasks), agent.experience.n_step)


def action_sizes(action: Array, mask: Array | None) -> Array:
    """Count the actions (T,) that each task has, of actions (T, ..., A) with a mask (T, A), or without one."""
    return jnp.full(len(action), action.shape[-1]) if mask is None else jnp.sum(mask, axis=-1)


def slow_copies(agent: Any, nets: Nets) -> Nets:
    """Return copies of what targets are computed with: critics, representation and what is known of the task."""
    seen_by = agent.representation
    followed = nets["representation"].without((*seen_by.models, *seen_by.own_target))
    slow = {"critic": nets["critic"], "knowing": nets["knowing"], "representation": followed}
    return jax.tree.map(jnp.copy, slow)


def critic_data(agent: Any, state: AgentState, batch: Batch, key: Key) -> tuple[Batch, Any]:
    """Return the data of the critics' loss for all tasks (T, ...): the batch, and the targets."""
    representation = state.nets["representation"]
    followed = state.slow["representation"].filled(representation)
    slow = state.nets | state.slow | {"representation": followed}
    model_targets, keys = agent.representation.targets(representation, followed, batch.next_obs, key)
    target = jax.vmap(agent.critic_target, (axes_of(state.nets), axes_of(slow), 0, 0))
    return batch._replace(model_targets=model_targets), target(state.nets, slow, batch, keys)


def bonus(agent: Any, nets: Nets, batch: Batch, cost: Array, next_q: Array, q: Callable[[], Array]) -> Array:
    """Return what adds to the next values (B,) of a batch: their entropy, and what later steps of windows add.

    Args:
        cost: (B,) what the temperature weighs of the actions that the policy has sampled there.
        next_q: (N, B, outputs) of the target critics for these actions.
        q: a function that returns theirs for the actions that were taken.
    """
    entropy, kept = -batch.temperature * cost, batch.behaviour
    if kept is None:
        return entropy
    outputs, mask = agent.policy_outputs(nets, batch.features, batch.obs), batch.mask
    drawn = jnp.all(jnp.abs(agent.policy.action(kept.raw, mask) - batch.action) < _ROUNDING, axis=-1)
    log_ratio = jnp.where(drawn, agent.policy.log_prob(outputs, kept.raw, mask) - kept.log_prob, -jnp.inf)
    value, next_value = (reduce(agent.value.mean(x), agent.critic_reduction == "min") for x in (q(), next_q))
    steps = Transition(None, None, batch.reward, batch.discount, None, cut=batch.cut)  # type: ignore
    length = agent.unroll - agent.conditioning.burn_in
    windows = jax.tree.map(lambda x: x.reshape(-1, length).T, (steps, value, next_value + entropy, log_ratio))
    return entropy + agent.target.beyond(*windows).T.reshape(-1)


def losses(agent: Any, state: AgentState, window: Transition, tasks: Task, key: Key) -> Losses:
    """Return the losses of critics and actor on windows (T, B, L, ...), without changing observations at random."""
    target_key, actor_key = jax.random.split(key)
    batch = prepare(agent, state, window, tasks)

    def critic_loss(nets: Nets, batch: Batch, target: Any) -> tuple[Array, Metrics]:
        loss, aux = agent.critic_loss(nets, batch, target)
        return loss, aux.metrics

    critic = above_least(agent, critic_loss), critic_data(agent, state, batch, target_key)
    actor = agent.actor_loss, (batch, jax.random.split(actor_key, state.num_tasks))
    return Losses(state.nets, {"critic": critic, "actor": actor}, batch)


def fitted(
    agent: Any, loss: Array, q: Array, target: Any, nets: Nets, batch: Batch, statistics: Any = None
) -> tuple[Array, CriticAux]:
    """Add the losses of what critics see by to theirs (), and return the sum with what all of them found.

    Args:
        q: the critics' outputs (N, B, outputs), which are fitted to ``target``.
        statistics: new running statistics of the critics' bodies, if they have any.
    """
    values, expected = agent.value.mean(q), agent.value.expected(target)
    metrics = {"critic_loss": loss, "value": jnp.mean(values), "td_error": jnp.mean(jnp.abs(values - expected))}
    loss, metrics = agent.view.join(loss, metrics, nets, batch)
    return loss, CriticAux(metrics, expected, statistics or {})


def update_target(agent: Any, state: AgentState) -> AgentState:
    """Move the target networks a step towards the new ones: ``tau`` of the distance, or the representation's rates."""

    def follow(net: str, new: dict, old: dict) -> dict:
        rates = agent.representation.rates if net == "representation" else {}
        return {k: optax.incremental_update(new[k], old[k], rates.get(k, agent.tau)) for k in old}

    moved = lambda net, new, old: Params(follow(net, new.shared, old.shared), follow(net, new.own, old.own))
    return state._replace(slow={net: moved(net, state.nets[net], old) for net, old in state.slow.items()})


def renew_scales(agent: Any, state: AgentState, target: Array) -> AgentState:
    """Update the scaling of rewards by the critics' targets (T, B), and rescale critics to the new units."""
    critics = (state.nets["critic"], state.slow["critic"])
    scaling, (critic, slow) = agent.scaling.renew(state.nets["scaling"].own, target, critics)
    state = state.with_nets(scaling=Params({}, scaling), critic=critic)
    return state._replace(slow=state.slow | {"critic": slow})


def with_statistics(state: AgentState, name: str, statistics: Any) -> AgentState:
    """Return a state with the running statistics that a loss found for the bodies of a network, if any."""
    net = state.nets[name]
    return state.with_nets(**{name: net._replace(own=net.own | statistics)})
