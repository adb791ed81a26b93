"""``View`` says what networks see of the world and of the task."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import normalize
from mtjax.agents.networks import OVER_TASKS, Params
from mtjax.agents.parts.knowing import Knowing, last_steps
from mtjax.agents.parts.knowing.last_steps import Seen, without_past
from mtjax.agents.parts.knowing.recurrent import Following, Hidden, track
from mtjax.agents.parts.policies import Policy
from mtjax.agents.parts.representations import Representation
from mtjax.agents.state import AgentState, Nets, of_task
from mtjax.parallel import collectives
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Array, Key, Metrics, Spec, Task, Transition


@dataclasses.dataclass(frozen=True)
class View:
    """What networks see: observations, the steps before them, and features of the task.

    Observations are normalised and stand beside what an agent remembers; ``see`` returns both. ``know`` makes features
    of the task out of them, and ``actor_inputs`` and ``critic_inputs`` what the representation makes of both.
    """

    normalized: bool  # whether observations are scaled by their moments
    conditioning: Knowing
    representation: Representation
    policy: Policy

    @property
    def history(self) -> int:
        """Number of past steps that the networks take beside each observation."""
        return self.conditioning.history or self.representation.history

    def count(self, inputs: Params, obs: Any) -> Params:
        """Add the vectors (T, ..., O) in observations to the moments, with those on other devices.

        Numbers that lie far off count as less (``normalize.bounded``).
        """
        vectors = frames.state(join_arrays(inputs, obs))
        if not self.normalized or vectors is None:
            return inputs
        moments, mixed = inputs.parts["moments"], bool(inputs.own)
        vectors = vectors.reshape(len(vectors), -1, vectors.shape[-1])
        vectors = (jax.vmap(normalize.bounded) if mixed else normalize.bounded)(moments, vectors)
        count = (vectors.shape[1] if mixed else vectors.shape[0] * vectors.shape[1]) * collectives.count()
        mean, variance = (x.reshape(moments.mean.shape) for x in mean_and_variance(vectors, 1 if mixed else (0, 1)))
        one = normalize.Moments(jnp.full_like(moments.count, count), mean, count * variance)
        if mixed:
            return inputs._replace(own={"moments": jax.vmap(normalize.merge)(moments, one)})
        return inputs._replace(shared=inputs.shared | {"moments": normalize.merge(moments, one)})

    # Observations, and the steps before them.

    def see(self, inputs: Params, obs: Any, past: Any = None) -> Any:
        """Return observations (..., O) of one task as networks take them: normalised, and with the past if given."""
        obs = join_arrays(inputs, obs)
        scale = partial(normalize.apply, inputs.parts["moments"]) if self.normalized else lambda x: x
        scaled = lambda obs: frames.with_state(scale, obs)
        if past is None:
            return scaled(obs)
        if "obs" in past._fields:
            past = past._replace(obs=scaled(past.obs), action=self.policy.encode(past.action))
        if "next_obs" in past._fields:
            past = past._replace(next_obs=scaled(past.next_obs))
        return Seen(scaled(obs), past)

    def see_all(self, inputs: Params, obs: Any, past: Any = None) -> Any:
        """Return observations (T, B, O) of all training tasks as networks take them."""
        return jax.vmap(self.see, (OVER_TASKS, 0, 0))(inputs, obs, past) if inputs.own else self.see(inputs, obs, past)

    def example(self, spec: Spec, inputs: Params) -> Any:
        """Return an input of networks that is all zero."""
        past = None
        if self.conditioning.recurs:
            past = Hidden(self.conditioning.begin(frames.state_size(spec), spec.action_size))
        if self.history:
            past = last_steps.begin(self.history, frames.state_size(spec), spec.action.blank())
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), frames.seen(spec))
        return self.see(inputs.of_first(), zeros, past)

    def around(self, inputs: Params, window: Transition, first: Transition, last: Transition) -> tuple[Any, Any]:
        """Return what networks take of the steps before observations, and before the next ones; None for nothing.

        Args:
            window: (T, B, L, ...).
            first, last: the first and the last steps (T, N, ...) of the transitions that are made of it.
        """
        if self.conditioning.recurs:
            obs, next_obs = (join_arrays(inputs, x) for x in (window.obs, window.next_obs))
            before = jax.vmap(track)(window._replace(next_obs=next_obs), obs)
            return before, Following(*before)
        if not self.history:
            return None, None
        return first.memory.past, last_steps.append(
            last.memory.past, join_arrays(inputs, last.obs), last.action, last.reward
        )

    def steps(self, state: AgentState, window: Transition, tasks: Task) -> tuple[Transition, Array, Any, Any]:
        """Return the steps (T, B L, ...) of windows (T, B, L, ...), with features, observations and next ones."""
        flat = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), window)
        inputs = state.nets["inputs"]
        see, (past, next_past) = partial(self.see_all, inputs), self.around(inputs, window, flat, flat)
        return flat, self.features_of_all(state, flat, tasks), see(flat.obs, past), see(flat.next_obs, next_past)

    # Features of the task.

    def features(self, state: AgentState, task: Task) -> Array:
        """Return those features (Z,) of one task that need no learned parameters."""
        vectors = state.nets["tasks"].shared.get("given")
        return self.conditioning.task_vector(state.known(task), task, state.num_tasks, vectors)

    def features_of_all(self, state: AgentState, batch: Transition, tasks: Task) -> Array:
        """Return these features of a batch's tasks: (T, Z), or (T, B, Z) where each episode has its own."""
        if batch.context is not None and self.conditioning.by_parameters:
            of_episode = lambda task, context: self.features(state, task._replace(context=context))
            return jax.vmap(jax.vmap(of_episode, (None, 0)))(tasks, batch.context)
        return jax.vmap(partial(self.features, state))(tasks)

    # Inputs of one task's networks.

    def know(self, nets: Nets, features: Array, seen: Any) -> tuple[Array, Any]:
        """Return the features (Z,) or (..., Z) of one task, and observations (..., O) without the last steps.

        Args:
            features: those that need no learned parameters, (Z,) or (..., Z).
            seen: a result of ``see``.
        """
        return self.conditioning.features(nets["knowing"].parts, features, seen), without_past(seen)

    def actor_inputs(self, nets: Nets, features: Array, seen: Any) -> tuple[Array, Any]:
        """Return features (Z,) and inputs (..., O) of one task's actor, from what ``know`` takes."""
        nets = nets | {"knowing": nets.get("belief", nets["knowing"])}
        return self.representation.actor_inputs(nets["representation"], *self.know(nets, features, seen))

    def critic_inputs(self, nets: Nets, features: Array, seen: Any) -> tuple[Array, Any]:
        """Return features (Z,) and inputs (..., O) of one task's critics, from what ``know`` takes."""
        return self.representation.perceive(nets["representation"], *self.know(nets, features, seen))

    def keyed(self, batch: Any, key: Key) -> Any:
        """Give each task of a batch (T, ...) a key if the conditioning's own loss draws. Else return the batch."""
        if not self.conditioning.draws:
            return batch
        keys = jax.random.split(key, len(batch.features))
        return batch._replace(obs=batch.obs._replace(past=batch.obs.past._replace(key=keys)))

    def join(self, loss: Array, metrics: Metrics, nets: Nets, batch: Any) -> tuple[Array, Metrics]:
        """Add the losses of the representation, and of what is known of the task, to the critics' loss of one task."""
        known = batch._replace(features=self.know(nets, batch.features, batch.obs)[0])
        loss, metrics = self.representation.join(loss, metrics, nets["representation"], known)
        return self.conditioning.join(loss, metrics, nets["knowing"].parts, batch.obs)

    def acting(self, state: AgentState, memory: Any, obs: Any, task: Task) -> tuple[Nets, Array, Any]:
        """Return what one task needs to act: its networks, its features (Z,) and the observation (O,) as input."""
        nets = of_task(state.nets, state.known(task))
        past = memory.past if memory.hidden is None else Hidden(memory.hidden)
        inputs, of_all = self.see(nets["inputs"], obs, past), state.nets["representation"]
        trained = task.id < state.num_tasks
        own = self.representation.stand_in(nets["representation"], of_all, trained, inputs)
        return nets | {"representation": own}, self.features(state, task), inputs


def init_inputs(spec: Spec, num_tasks: int) -> Params:
    """Return moments of no observations, with their layout unless networks take them as they are.

    Where each task is scaled by itself (``Spec.mixed``), it has moments of its own, leaves (T, O).
    """
    moments = normalize.init(max(frames.state_size(spec), 1))  # checkpoints hold no empty arrays
    layout = frames.layout(spec.obs)
    shared: dict[str, Any] = {} if layout is None else {"layout": layout}
    if not spec.mixed:
        return Params(shared | {"moments": moments}, {})
    return Params(shared, {"moments": jax.tree.map(lambda x: jnp.stack([x] * num_tasks), moments)})


def join_arrays(inputs: Params, obs: Any) -> Any:
    """Return observations of a tree of arrays as vectors (..., O), beside which pictures stay; vectors as they are.

    Networks, moments and memories see observations through it alone.
    """
    layout = inputs.shared.get("layout")
    return obs if layout is None else layout(obs)
