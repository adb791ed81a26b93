"""A replay keeps one picture a step, and rebuilds the stacks that agents see from neighbouring steps.

The ring of a task holds the newest picture of every step's observation, and none of what follows: the picture after a
step is that of the next slot. After a time limit the next slot holds a new episode, and the true last picture is lost.
So a transition that a time limit cut off is not drawn, and a multi-step return stops before it; where an episode
terminated, the picture after it does not matter to values, and ``followed`` keeps it from models. Both cost one step of
an episode.
"""

import jax
import jax.numpy as jnp

from mtjax.experience import multistep
from mtjax.experience.multistep import take_steps
from mtjax.frames import PICTURES, shown
from mtjax.types import Array, Transition


def compress(steps: Transition, channels: int) -> Transition:
    """Keep the newest picture (..., H, W, C) of stacks (..., H, W, N C), and no picture of what follows."""
    newest = steps.obs[PICTURES][..., -channels:]
    after = {name: x for name, x in steps.next_obs.items() if name != PICTURES}
    return steps._replace(obs=steps.obs | {PICTURES: newest}, next_obs=after)


def window(frames: int, n_step: int) -> int:
    """Return how many consecutive steps tell a transition of ``n_step`` steps: those before it, and one after it."""
    return frames + n_step + 1


def frames(window: int, n_step: int) -> int:
    """Return how many pictures a stack has, if so many steps tell a transition of ``n_step`` steps."""
    return window - n_step - 1


def join(rows: Transition, gamma: float | Array, *, frames: int, n_step: int) -> Transition:
    """Join windows of consecutive steps (..., W) to a transition (...) each, with stacks (..., H, W, N C) of pictures.

    A window's transition begins at step N, or one step earlier if a time limit cut that step off.
    """
    cut = rows.cut & (rows.discount > 0)
    now = frames - cut[..., frames].astype(jnp.int32)
    bare = rows._replace(obs={name: x for name, x in rows.obs.items() if name != PICTURES})
    body = take_steps(bare, now[..., None] + jnp.arange(n_step))
    stops = jnp.concatenate([take_steps(cut, now[..., None] + jnp.arange(1, n_step)), cut[..., :1] & False], axis=-1)
    body = body._replace(cut=body.cut | stops)
    after = now + multistep.length(body.cut)
    joined = multistep.join(body, gamma) if n_step > 1 else jax.tree.map(lambda x: jnp.take(x, 0, now.ndim), body)
    see = lambda place: {PICTURES: stack(rows.obs[PICTURES], rows.ended, place, frames)}
    return joined._replace(obs=joined.obs | see(now), next_obs=joined.next_obs | see(after))


def followed(batch: Transition) -> Array | None:
    """Return for which transitions (...) of a replay ``next_obs`` is what followed; None for all.

    After a step that terminated, the next slot holds the first picture of another episode.
    """
    return batch.discount > 0 if shown(batch.obs) else None


def stack(pictures: Array, ended: Array, place: Array, frames: int) -> Array:
    """Return the stack (..., H, W, N C) whose newest picture is at ``place`` (...) of pictures (..., W, H, W, C)."""
    back = jnp.arange(1, frames)
    ended_before = take_steps(ended, place[..., None] - back)
    same = jnp.cumprod(~ended_before, axis=-1)  # whether the step so far back is of this episode
    age = jnp.sum(same, axis=-1, keepdims=True)
    steps = place[..., None] - jnp.minimum(jnp.arange(frames - 1, -1, -1), age)
    found = take_steps(pictures, steps)  # (..., N, H, W, C)
    return jnp.concatenate([found[..., i, :, :, :] for i in range(frames)], axis=-1)
