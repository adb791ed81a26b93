"""Observations that show the last steps too, for agents that must infer which task they are in.

The wrapped family shows one flat observation, so that everything between family and networks stays as it is; the agent
takes it apart again.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.types import Array, Env, InputError, Key, Spec, Step, Task, Transition


class Past(NamedTuple):
    """The last H steps of an episode, the latest one last; all zero where the episode had not begun."""

    obs: Array  # (..., H, O) in which the agent acted
    action: Array  # (..., H, A)
    reward: Array  # (..., H)
    known: Array  # (..., H) 1 for a step that was taken, 0 from before the episode


class Seen(NamedTuple):
    """An observation and the steps that led to it."""

    obs: Array  # (..., O)
    past: Past

    def then(self, action: Array, reward: Array, obs: Array) -> "Seen":
        """What is seen after one more step (no leading axes); the oldest one is forgotten."""
        latest = Past(self.obs, action, reward, jnp.float32(1))
        return Seen(obs, jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), self.past, latest))


def begin(obs: Array, action_size: int, steps: int) -> Seen:
    """What is seen at the start of an episode."""
    blank = lambda *shape: jnp.zeros((steps, *shape))
    return Seen(obs, Past(blank(*obs.shape), blank(action_size), blank(), blank()))


def pack(seen: Seen) -> Array:
    """Flatten to (..., O + H (O + A + 2)): the observation, then each field of the past, step by step."""
    lead = seen.obs.shape[:-1]
    return jnp.concatenate([seen.obs, *(x.reshape(*lead, -1) for x in seen.past)], axis=-1)


def unpack(packed: Array, obs_size: int, steps: int) -> Seen:
    """Take apart what ``pack`` made (..., O + H (O + A + 2)), where O is ``obs_size`` and H is ``steps``."""
    lead, action_size = packed.shape[:-1], (packed.shape[-1] - obs_size) // steps - obs_size - 2
    widths = (obs_size, steps * obs_size, steps * action_size, steps)
    ends = [sum(widths[: i + 1]) for i in range(len(widths))]
    obs, past_obs, action, reward, known = jnp.split(packed, ends, axis=-1)
    by_step = lambda x: x.reshape(*lead, steps, -1)
    return Seen(obs, Past(by_step(past_obs), by_step(action), reward, known))


def widen(spec: Spec, steps: int) -> Spec:
    """Sizes of a family whose observations show the last ``steps`` steps; 0 leaves them."""
    if not steps:
        return spec
    size = spec.obs_size + steps * (spec.obs_size + spec.action_size + 2)
    return spec._replace(obs_size=size, history=steps)


def plain_obs_size(spec: Spec) -> int:
    """The size O of the present observation alone."""
    return (spec.obs_size - spec.history * (spec.action_size + 2)) // (spec.history + 1)


class Remembering(NamedTuple):
    """The state of a wrapped family."""

    world: Any  # the family's own state
    seen: Seen


@dataclasses.dataclass(frozen=True)
class History:
    """A family whose observation (O + H (O + A + 2),) shows the last H steps too; else it is that family.

    The past is that of the episode: a reset forgets it, as the next episode's task may be another.

    Replay keeps all of ``obs`` and ``next_obs``, so that a transition takes about H + 1 times the memory: of the
    finger's 9 numbers and 2 actions, eight steps make 113.
    """

    env: Any  # Env
    steps: int  # H

    @property
    def spec(self) -> Spec:
        return widen(self.env.spec, self.steps)

    @property
    def episode_length(self) -> int:
        return self.env.episode_length

    def tasks(self, split: str = "train") -> Task:
        return self.env.tasks(split)

    def task_values(self, split: str) -> Any:
        return self.env.task_values(split)

    def reset(self, task: Task, key: Key) -> Step:
        start = self.env.reset(task, key)
        seen = begin(start.obs, self.env.spec.action_size, self.steps)
        return start._replace(state=Remembering(start.state, seen), obs=pack(seen))

    def step(self, task: Task, state: Remembering, action: Array) -> Step:
        after = self.env.step(task, state.world, action)
        seen = state.seen.then(action, after.reward, after.obs)
        return after._replace(state=Remembering(after.state, seen), obs=pack(seen))

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        """The same for a whole trajectory: what is remembered is that of the other task too."""
        before, after = (unpack(x, self.env.spec.obs_size, self.steps) for x in (transition.obs, transition.next_obs))
        one = lambda obs, action, reward, next_obs: self.env.relabel(
            task, transition._replace(obs=obs, action=action, reward=reward, next_obs=next_obs), key
        )
        new = one(before.obs, transition.action, transition.reward, after.obs)
        past = before.past
        following = jnp.concatenate([past.obs[1:], before.obs[None]])
        then = jax.vmap(one)(past.obs, past.action, past.reward, following)
        known = past.known > 0
        obs = jnp.where(known[:, None], then.obs, past.obs)
        past = past._replace(obs=obs, reward=jnp.where(known, then.reward, past.reward))
        seen = Seen(new.obs, past)
        return new._replace(obs=pack(seen), next_obs=pack(seen.then(new.action, new.reward, new.next_obs)))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # copying and pickling look for such names before there is a family
            raise AttributeError(name)
        return getattr(self.env, name)


def remember(env: Env, steps: int) -> Any:
    """The family with ``steps`` past steps in its observations; as it is if that is 0 or it shows them already.

    Raises:
        InputError: it shows another number of steps.
    """
    shown = env.spec.history
    if shown not in (0, steps):
        raise InputError(f"the family shows {shown} past steps already, and the agent needs {steps}; give it unwrapped")
    return env if shown == steps else History(env, steps)


def forget(env: Env) -> Any:
    """The family itself."""
    return env.env if isinstance(env, History) else env
