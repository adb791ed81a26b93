"""Stacks of the last pictures of an episode, newest last: arrays (..., H, W, N C) for N pictures of C channels.

An observation of an environment holds one picture. Rollouts keep the stack that an agent sees, and a replay stores the
newest picture of every stack. An episode's first picture is repeated where the episode is younger than the stack.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, InputError, Spec

PICTURES = "pixels"
"""The entry of an observation that holds pictures, uint8."""
STATE = "state"
"""The entry that holds a vector beside them."""


def shown(obs: Any) -> bool:
    """Return whether an observation, or its shapes, holds pictures."""
    return isinstance(obs, Mapping) and PICTURES in obs


def require_known(obs: Any) -> None:
    """Check that networks can be built for observations of these shapes.

    Raises:
        InputError: they are neither a vector of floats, nor pictures, nor both.
    """
    vector = lambda x: getattr(x, "ndim", 0) == 1 and jnp.issubdtype(x.dtype, jnp.floating)
    picture = lambda x: getattr(x, "ndim", 0) == 3 and x.dtype == jnp.uint8
    kinds = {PICTURES: picture, STATE: vector}
    known = all(name in kinds and kinds[name](x) for name, x in obs.items()) if shown(obs) else vector(obs)
    if not known:
        told = jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", obs)
        raise InputError(
            f"agents take a vector of floats (O,), or a dictionary of 'pixels', uint8 (H, W, C), and a vector 'state' "
            f"if there is one; not {told}"
        )


def begin(obs: Any, frames: int) -> Any:
    """Return what an agent sees first: an observation whose picture (..., H, W, C) is repeated ``frames`` times."""
    if frames == 1 or not shown(obs):
        return obs
    return obs | {PICTURES: jnp.concatenate([obs[PICTURES]] * frames, axis=-1)}


def push(seen: Any, obs: Any) -> Any:
    """Return what an agent sees after a step: the next observation, with its picture at the end of the stack."""
    if not shown(obs):
        return obs
    picture = obs[PICTURES]
    return obs | {PICTURES: jnp.concatenate([seen[PICTURES][..., picture.shape[-1] :], picture], axis=-1)}


def seen(spec: Spec) -> Any:
    """Return the shapes of what an agent sees: those of observations, with stacks in place of pictures."""
    return jax.eval_shape(lambda obs: begin(obs, spec.frames), spec.obs)


# The vector in an observation, if any: the observation itself, or what comes beside pictures.


def state(obs: Any) -> Array | None:
    """Return the vector (..., O) in an observation, or None."""
    return obs.get(STATE) if shown(obs) else obs


def with_state(change: Callable[[Array], Array], obs: Any) -> Any:
    """Return an observation whose vector is changed."""
    if not shown(obs):
        return change(obs)
    return obs | {STATE: change(obs[STATE])} if STATE in obs else obs


def state_size(spec: Spec) -> int:
    """Return the size O of the vector in observations, 0 if there is none."""
    found = state(spec.obs)
    return spec.obs_size if found is spec.obs else 0 if found is None else found.shape[0]
