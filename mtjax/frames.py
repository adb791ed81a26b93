"""Stacks of the last pictures of an episode, newest last.

Observations hold one picture, so that a replay keeps each picture once. A stack is the agent's memory of the pictures
before; a replay gathers the same stack from the pictures that it keeps. Where an episode is younger than the stack, its
first picture is repeated.
"""

from typing import NamedTuple

import jax.numpy as jnp

from mtjax.types import Array


class Frames(NamedTuple):
    """The pictures of an episode before the newest."""

    past: Array  # (N - 1, H, W, C) oldest first
    count: Array  # () int32, how many pictures the episode had before the newest


def begin(shape: tuple[int, ...], frames: int, dtype=jnp.uint8) -> Frames:
    """Return the memory with which an episode begins, for stacks of ``frames`` pictures of ``shape`` (H, W, C)."""
    return Frames(jnp.zeros((frames - 1, *shape), dtype), jnp.int32(0))


def push(memory: Frames, picture: Array) -> Frames:
    """Remember the picture (H, W, C) that was the newest until now."""
    past = jnp.concatenate([memory.past, picture[None]])[1:]
    return Frames(past, memory.count + 1)


def stack(memory: Frames, picture: Array) -> Array:
    """Return the last pictures (H, W, N C) with ``picture`` (H, W, C) as the newest."""
    everything = jnp.concatenate([memory.past, picture[None]])
    return join(gather(everything, jnp.int32(len(everything) - 1), memory.count, len(everything)))


def gather(pictures: Array, place: Array, age: Array, frames: int) -> Array:
    """Return the ``frames`` last pictures (N, H, W, C) up to ``place`` of a ring of pictures (L, H, W, C).

    Args:
        place: () index of the newest picture.
        age: () how many pictures of the same episode are before it. Older ones are replaced by the episode's first.
    """
    back = jnp.minimum(jnp.arange(frames - 1, -1, -1), age)
    return pictures[(place - back) % len(pictures)]


def join(pictures: Array) -> Array:
    """Join pictures (N, H, W, C) along their channels: (H, W, N C)."""
    return jnp.concatenate(list(pictures), axis=-1)
