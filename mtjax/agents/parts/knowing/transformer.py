"""Features of a hidden task, made of attention over the last steps, whose keys and values are kept in a memory."""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents import parts
from mtjax.agents.networks import Params, ReLU, init_params
from mtjax.agents.parts.knowing.recurrent import Remembering, Track, inputs
from mtjax.types import Array, InputError, Key

_WIDER = 4  # how many times as wide the hidden layer of each block is (Vaswani et al. 2017)


class Cache(NamedTuple):
    """Holds what the last C steps of a trial left in N blocks, the oldest step first; before a trial all is zero."""

    keys: Array  # (..., N, C, D) of all heads, side by side
    values: Array  # (..., N, C, D)
    known: Array  # (..., C) 1 for a step of the trial, 0 from before it
    out: Array  # (..., D) what networks see: the output for the latest step


class Block(nn.Module):
    """Lets each step attend to itself, to steps before it and to nothing, and applies an MLP."""

    heads: int

    @nn.compact
    def __call__(self, x: Array, kept: tuple[Array, Array], earlier: Array) -> tuple[Array, Array, Array]:
        """Map R streams of L steps. The past of each is the first stream.

        Args:
            x: (..., R, L, D).
            kept: keys and values (..., C, D) of C steps before these.
            earlier: (..., L, C + L) bool, the steps before it to which each attends.

        Returns:
            outputs (..., R, L, D), and the first stream's keys and values (..., L, D).
        """
        size = x.shape[-1]
        by_head = lambda x: x.reshape(*x.shape[:-1], self.heads, size // self.heads)
        query, *new = jnp.split(nn.Dense(3 * size, use_bias=False)(nn.LayerNorm()(x)), 3, axis=-1)
        query, (key, value) = by_head(query) / np.sqrt(size // self.heads), map(by_head, new)
        first = [x[..., 0, :, :] for x in new]
        past = [by_head(jnp.concatenate(pair, axis=-2)) for pair in zip(kept, first, strict=True)]
        bias = self.param("bias", nn.initializers.zeros, (self.heads, kept[0].shape[-2] + 1))  # C steps ago, ..., now
        scores = jnp.einsum("...rlhd,...khd->...rhlk", query, past[0]) + shifted(bias[:, :-1], x.shape[-2])
        scores = jnp.where(earlier[..., None, None, :, :], scores, -jnp.inf)
        own = jnp.einsum("...lhd,...lhd->...hl", query, key)[..., None] + bias[:, -1:, None]
        weights = jax.nn.softmax(jnp.concatenate([scores, own, jnp.zeros_like(own)], axis=-1))
        found = jnp.einsum("...rhlk,...khd->...rlhd", weights[..., :-2], past[1])
        found += jnp.einsum("...hl,...lhd->...lhd", weights[..., -2], value)
        x += nn.Dense(size)(found.reshape(x.shape))
        x += nn.Dense(size)(ReLU()(nn.Dense(_WIDER * size)(nn.LayerNorm()(x))))
        return x, first[0], first[1]


class Blocks(nn.Module):
    """Reads steps by blocks, one upon the other."""

    size: int
    layers: int
    heads: int

    @nn.compact
    def __call__(self, cache: Cache, read: Array, closed: Array) -> tuple[Array, Array, Array]:
        """Map R streams of L steps (..., R, L, I), whose trials end with the steps that are ``closed`` (..., L).

        Returns:
            outputs (..., R, L, D), and the first stream's keys and values (..., N, L, D).
        """
        earlier, new = attended(cache.known, closed), []
        x = nn.Dense(self.size)(read)
        for i in range(self.layers):
            kept = cache.keys[..., i, :, :], cache.values[..., i, :, :]
            x, *of_block = Block(self.heads)(x, kept, earlier)
            new.append(of_block)
        keys, values = (jnp.stack(x, axis=-3) for x in zip(*new, strict=True))
        return nn.LayerNorm()(x), keys, values


def attended(known: Array, closed: Array) -> Array:
    """Return to which of C steps (..., C) and the next L (..., L) each of these attends: (..., L, C + L) bool.

    They are the last C before it that are of its trial.
    """
    kept, length = known.shape[-1], closed.shape[-1]
    before = np.triu(np.ones((length, length), np.float32), 1)
    trial = jnp.matmul(closed.astype(jnp.float32), before, precision="highest")  # how many have ended before the step
    steps = jnp.concatenate([jnp.where(known > 0, 0.0, -1.0), trial], axis=-1)
    distance = kept + np.arange(length)[:, None] - np.arange(kept + length)
    return (steps[..., None, :] == trial[..., None]) & ((distance > 0) & (distance <= kept))


def shifted(table: Array, length: int) -> Array:
    """Return (H, L, C + L) with the table (H, C) in each of L rows, one place further right in each, among zeros."""
    row = jnp.concatenate([table, jnp.zeros((len(table), length + 1))], axis=1)
    rows = jnp.broadcast_to(row[:, None], (len(row), length, row.shape[1]))
    return rows.reshape(len(row), -1)[:, :-length].reshape(len(row), length, -1)


@dataclasses.dataclass(frozen=True)
class Transformer(Remembering):
    """Shows networks the output of a causal transformer (Vaswani et al. 2017) over the steps of the trial so far.

    It reads a step t once it is over, by N blocks in which normalisation LN comes first:
        x = W [s_t, a_t, r_t, e_t]                                    (e_t: the step ended an episode)
        x = x + W_o sum_j w_tj v_j,  x = x + MLP(LN(x)) in every block,  h_(t+1) = LN(x),  h_0 = 0
    with queries, keys and values (q, k, v)_t = W_qkv LN(x_t), and in every head, over the step j = t, the C steps
    j < t before it that are of its trial, and nothing, whose key and value are 0:
        w_tj = exp(q_t k_j / sqrt(d) + b_(t-j)) / (1 + sum_i exp(q_t k_i / sqrt(d) + b_(t-i)))
    Positions are distances alone, with a learned bias b for each (Raffel et al. 2020), so that a trial may be of any
    length. What goes to nothing (Xiao et al. 2024) tells how many steps there were.

    The memory is a cache of the keys and values of the last C steps, 2 N C D + C + D numbers: acting costs one query a
    step, and the oldest step falls out. A rollout has it before its first step alone, a replay with every step. A
    window is learned from in one pass, of all steps at once. It begins with the cache that acting had there, which does
    not learn. Where a time limit cuts sums off, the value after the step is that of going on: of h_(t+1) with e_t = 0.

    It learns by the losses of the networks that see it. TrMRL (Melo 2022) finds out hidden tasks so too. Differs from
    there: normalisation, which comes first in a block, takes the place of the initialisation T-Fixup, biases that of
    encoded positions, and the policy sees s_t beside h_t. Differs from algorithm distillation (Laskin et al. 2023),
    where a transformer learns from the records of learners.
    """

    transformer_size: int = 64
    """Size of the transformer's output, and of the keys and values of all heads together."""
    transformer_layers: int = 2
    """Blocks, one upon the other."""
    transformer_heads: int = 4
    """Heads of attention in each block."""
    attended_steps: int = 64
    """Number of steps before it to which a step attends, and which the memory keeps."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_counts(self, "transformer_size", "transformer_layers", "transformer_heads", "attended_steps")
        if self.transformer_size % self.transformer_heads:
            raise InputError(
                f"transformer-size={self.transformer_size} must be a multiple of transformer-heads="
                f"{self.transformer_heads}"
            )

    @property
    def blocks(self) -> Blocks:
        return Blocks(self.transformer_size, self.transformer_layers, self.transformer_heads)

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        read = inputs(seen.obs, action, jnp.float32(0), jnp.bool_(False))[None, None]
        first = self.begin(len(seen.obs), len(action)), read, jnp.zeros(1)
        init = lambda key: {"transformer": self.blocks.init(key, *first)["params"]}
        return init_params(init, own, key, num_tasks)

    def begin(self, obs_size: int, action_size: int) -> Cache:
        """Return the memory of no step."""
        of_steps = jnp.zeros((self.transformer_layers, self.attended_steps, self.transformer_size))
        return Cache(of_steps, of_steps, jnp.zeros(self.attended_steps), jnp.zeros(self.transformer_size))

    def advance(self, params: dict[str, Any], memory: Cache, read: Array) -> Cache:
        out, keys, values = self.apply(params, memory, read[..., None, None, :], jnp.zeros((*read.shape[:-1], 1)))
        push = lambda old, new, axis: jnp.concatenate(
            [jax.lax.slice_in_dim(old, 1, None, axis=old.ndim + axis), new], axis=axis
        )
        known = push(memory.known, jnp.ones((*read.shape[:-1], 1)), -1)
        return Cache(push(memory.keys, keys, -2), push(memory.values, values, -2), known, out[..., 0, 0, :])

    def show(self, params: dict[str, Any], memory: Cache) -> Array:
        return memory.out

    def shown(self, params: dict[str, Any], track: Track, after: bool) -> Array:
        """Return what networks see (B L, D) before every step, or after it, by one pass over all steps of windows."""
        by_window = lambda x: x.reshape(len(track.state.out), -1, *x.shape[1:])
        read, closed = by_window(self.read(params, track)), by_window(track.closed)
        if after:  # going on where sums end, with the past of all others
            going_on = by_window(self.read(params, track._replace(ended=track.ended & ~track.cut)))
            out = self.apply(params, track.state, jnp.stack([read, going_on], axis=1), closed)[0][:, 1]
        else:
            out = self.apply(params, track.state, read[:, None], closed)[0][:, 0, :-1]
            begun = jnp.where(closed[:, :-1, None], 0, out)
            out = jnp.concatenate([track.state.out[:, None], begun], axis=1)
        return out.reshape(-1, out.shape[-1])

    def apply(self, params: dict[str, Any], *given: Any) -> tuple[Array, Array, Array]:
        return self.blocks.apply({"params": params["transformer"]}, *given)  # type: ignore
