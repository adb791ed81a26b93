"""Rules of gradient surgery map the Gram matrix G (T, T) of the tasks' gradients J to weights w (T,) of their sum.

Conventions for every rule: weights have the size of the mean's 1 / T, so that a learning rate, or a clipped norm, means
the same under each rule. If all gradients are zero, weights are 1 / T. A task whose gradient is zero is absent: it does
not constrain the others, and nothing is divided by zero. Adam normalises the length of updates, so rules matter by the
direction that they choose.

Most rules solve their problem for unit gradients, on the matrix of cosines, as lengths of gradients differ by orders of
magnitude. Numbers of iterations are fixed, as everything runs under one jit and vmap.
"""

import dataclasses
from collections.abc import Callable
from functools import wraps
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.agents.parts.gradients.quadratic import RIDGE, conditioned, minimise, solve
from mtjax.types import Array, InputError, Key

NEWTON_STEPS = 25
"""Newton steps of Nash-MTL: 20 converge to rounding for 50 tasks, even of opposite and unequal gradients."""
CAGRAD_GRID = 16
"""Points of each of CAGrad's two grids of multipliers."""
PCGRAD_BLOCK = 10
"""Projections that PCGrad unrolls into one block."""


@dataclasses.dataclass(frozen=True)
class Mean:
    """Averages all tasks' gradients. Every rule is a class with these methods; its fields are hyper-parameters."""

    needs: ClassVar[str] = ""  # "gradients" of every task, "losses" before and after each update, or "" for neither

    def init(self, num_tasks: int) -> Any:
        """Return the initial memory, which is carried from update to update."""
        return None

    def weigh(self, memory: Any, gram: Array, losses: Array, key: Key) -> tuple[Array, Any]:
        """Choose the weights of an update.

        Args:
            memory: from ``init`` or the last update.
            gram: (T, T) inner products of the tasks' gradients; None to rules that do not need gradients.
            losses: (T,).
            key: for rules that draw.

        Returns:
            weights (T,) and the new memory.
        """
        return jnp.full(len(losses), 1 / len(losses)), memory

    def adapt(self, memory: Any, before: Array, after: Array) -> Any:
        """Return the new memory from losses (T,) of one batch before and after the update, if the rule needs losses."""
        return memory

    @property
    def for_actor(self) -> "Mean":
        """The rule for the actor's gradients, whose losses may be negative."""
        return self


def of_gram(weights: Callable[[Any, Array], Array]):
    """Make the method ``weigh`` of a rule that needs the Gram matrix alone, in full float32.

    Args:
        weights: of the rule and a Gram matrix (T, T) whose largest entry is 1, returns weights (T,). They are 1 / T if
            all gradients are zero.
    """

    @wraps(weights)
    def weigh(self, memory: Any, gram: Array, losses: Array, key: Key) -> tuple[Array, Any]:
        with jax.default_matmul_precision("highest"):
            largest = jnp.max(jnp.diagonal(gram))
            found = weights(self, gram / jnp.where(largest > 0, largest, 1.0))
        return jnp.where(largest > 0, found, 1 / len(gram)), memory

    return weigh


@dataclasses.dataclass(frozen=True)
class PCGrad(Mean):
    """PCGrad projects away conflicts between tasks, exactly, on T-vectors (Yu et al. 2020, algorithm 1).

    Each task's gradient is c^T J with c = e_i. In a fresh random order over the other tasks j, where the two conflict,
    c_j loses (c . G[:, j]) / G[j, j]. The result is the mean over tasks; the paper takes the sum.

    A plain loop over T tasks has T small steps in sequence, and a GPU needs longer to launch each than to run it. Steps
    are therefore unrolled in blocks. A block needs c only at its start, and compiles to a few kernels.
    """

    needs = "gradients"

    def weigh(self, memory: Any, gram: Array, losses: Array, key: Key) -> tuple[Array, Any]:
        num_tasks, block = len(gram), min(len(gram), PCGRAD_BLOCK)
        squares = jnp.diagonal(gram)
        along = gram / jnp.where(
            squares > 0, squares, jnp.inf
        )  # components of gradients along each other, relative to the lengths of the latter
        along = jnp.pad(along, (0, -num_tasks % block)).T  # absent tasks fill the last block
        size = len(along)

        def against(c: Array, others: Array) -> tuple[Array, None]:
            """Project every task's gradient (T, T) against the next block of other tasks (T, block)."""
            parts = jnp.sum(c[:, None] * along[others], axis=-1)
            between = along[others[:, None], others[:, :, None]]
            counts = others != jnp.arange(size)[:, None]
            shares = []
            for k in range(block):
                left = parts[:, k] - sum(share * between[:, i, k] for i, share in enumerate(shares))
                shares.append(jnp.where(counts[:, k], jnp.minimum(left, 0.0), 0.0))
            return c - sum(x[:, None] * jax.nn.one_hot(others[:, k], size) for k, x in enumerate(shares)), None

        blocks = jnp.moveaxis(orders(key, size).reshape(size, -1, block), 1, 0)
        c, _ = jax.lax.scan(against, jnp.eye(size), blocks, unroll=min(len(blocks), 8))
        return jnp.sum(c, axis=0)[:num_tasks] / num_tasks, memory


def orders(key: Key, num_tasks: int) -> Array:
    """Draw a random order of all tasks for each task: (T, T)."""
    return jnp.argsort(jax.random.bits(key, (num_tasks, num_tasks)))


@dataclasses.dataclass(frozen=True)
class CAGrad(Mean):
    """CAGrad improves the worst-off task near the mean gradient (Liu et al. 2021a).

    With the mean g_0, the update d solves max_d min_i g_i . d under |d - g_0| <= c |g_0|. It is d = g_0 + J^T x. For a
    multiplier t > 0, the vector t x minimises t g_0 . g_y + |g_y|^2 / 2 over y in the simplex, with g_y = y^T J; t is
    such that |J^T x| = c |g_0|, or less if no d helps every task. As |J^T x| falls with t, two grids of quadratic
    problems bracket t. Between the last two x is interpolated: to 1e-3 of c |g_0|, and exactly if the same entries of
    both are zero. As in the authors' code, the result is d / (1 + c^2), which scales with the gradients.
    """

    needs = "gradients"
    cagrad_radius: float = 0.5
    """Largest distance of CAGrad's update from the mean, in lengths of the mean (c). Paper: 0.5 (MT50), 0.9 (MT10)."""

    def __post_init__(self):
        if not 0 < self.cagrad_radius < 1:
            raise InputError(f"cagrad-radius must be in (0, 1), not {self.cagrad_radius}")

    @of_gram
    def weigh(self, gram: Array) -> Array:
        radius = self.cagrad_radius
        matrix, norms, present = conditioned(gram)
        along = jnp.mean(gram, axis=1)
        length = jnp.sqrt(jnp.maximum(jnp.mean(along), 0.0))  # |g_0|
        slope = jnp.clip(along / norms / jnp.where(length > 0, length, 1.0), -1.0, 1.0)
        lengths = jnp.where(present, norms, jnp.max(norms))
        shortest = jnp.min(lengths)
        budget = present * shortest / norms

        def constrained(multiplier: Array) -> tuple[Array, Array]:
            x = minimise(matrix, slope, multiplier * budget)
            return x, jnp.sqrt(x @ matrix @ x)

        def narrow(bracket: Array, _) -> tuple[Array, tuple[Array, Array]]:
            multipliers = jnp.geomspace(bracket[0], bracket[1], CAGRAD_GRID)
            x, reach = jax.vmap(constrained)(multipliers)
            high = jnp.clip(jnp.sum(reach > radius), 1, CAGRAD_GRID - 1)
            pair = jnp.stack([high - 1, high])
            return multipliers[pair], (x[pair], reach[pair])

        widest = jnp.stack([jnp.float32(1e-3), jnp.max(lengths) / shortest]) / radius
        _, (x, reach) = jax.tree.map(lambda x: x[-1], jax.lax.scan(narrow, widest, length=2))
        share = jnp.clip((reach[0] - radius) / jnp.maximum(reach[0] - reach[1], 1e-12), 0.0, 1.0)
        x = (1 - share) * x[0] + share * x[1]
        return (1 / len(gram) + length * present * x / norms) / (1 + radius**2)


@dataclasses.dataclass(frozen=True)
class MGDA(Mean):
    """MGDA takes the shortest convex combination of gradients (Désidéri 2012; Sener & Koltun 2018).

    Weights minimise w^T G w on the simplex. No task's loss rises along the update; it is zero where no direction helps
    every task.
    """

    needs = "gradients"

    @of_gram
    def weigh(self, gram: Array) -> Array:
        matrix, norms, present = conditioned(gram)
        inverse = present * jnp.min(jnp.where(present, norms, jnp.inf)) / norms
        weights = inverse * minimise(matrix, jnp.zeros(len(gram)), inverse)
        return weights / jnp.sum(weights)


@dataclasses.dataclass(frozen=True)
class IMTLG(Mean):
    """IMTL-G makes the projections d . g_i / |g_i| of the update on all gradients equal (Liu et al. 2021b).

    With the matrix C of cosines, w_i = y_i / |g_i| where C y = 1. Weights sum to one, as in the paper, and may be
    negative.

    Differs from the paper where weights cancel: their magnitudes sum to at most ten, and the update never points
    against all tasks. The paper's update does for gradients that agree in direction but differ in length.
    """

    needs = "gradients"

    @of_gram
    def weigh(self, gram: Array) -> Array:
        matrix, norms, present = conditioned(gram)
        weights = present * solve(matrix, 1.0 * present[:, None])[:, 0] / norms
        return weights / jnp.maximum(jnp.sum(weights), 0.1 * jnp.sum(jnp.abs(weights)))


@dataclasses.dataclass(frozen=True)
class NashMTL(Mean):
    """Nash-MTL finds the Nash bargaining solution of the tasks: w > 0 with G w ~ 1 / w (Navon et al. 2022).

    The paper's G a = 1 / a gives every update the length sqrt(T), however small the gradients; here weights sum to one.
    With the matrix C of cosines and y = a |g|, C y = 1 / y minimises y^T C y / 2 - sum log y; Newton's steps r in log y
    are shortened to r / (1 + max |r|), which always descends and tends to the full step.
    """

    needs = "gradients"

    @of_gram
    def weigh(self, gram: Array) -> Array:
        matrix, norms, present = conditioned(gram)

        def newton(y: Array, _) -> tuple[Array, None]:
            scaled = y[:, None] * matrix * y
            step = solve(scaled + jnp.eye(len(y)), 1 - jnp.sum(scaled, axis=1)[:, None])[:, 0]
            return y * (1 + step / (1 + jnp.max(jnp.abs(step)))), None

        y, _ = jax.lax.scan(newton, jnp.ones(len(gram)), length=NEWTON_STEPS)
        weights = present * y / norms
        return weights / jnp.sum(weights)


@dataclasses.dataclass(frozen=True)
class AlignedMTL(Mean):
    """Aligned-MTL makes gradients orthogonal and equally long, then averages them (Senushkin et al. 2023).

    With G = V diag(s) V^T and s_r its least eigenvalue above rounding, w = sqrt(s_r) V diag(s)^(-1/2) V^T 1 / T, over
    the eigenvalues of at least s_r. This rule uses G and not cosines, so gradients a thousand times shorter than the
    longest are lost to rounding.
    """

    needs = "gradients"

    @of_gram
    def weigh(self, gram: Array) -> Array:
        values, vectors = jnp.linalg.eigh(gram)
        kept = values > RIDGE * len(gram) * jnp.max(values)
        least = jnp.min(jnp.where(kept, values, jnp.inf))
        stretch = jnp.where(kept, jnp.sqrt(least / jnp.where(kept, values, 1.0)), 0.0)
        return vectors @ (stretch * jnp.mean(vectors, axis=0))


@dataclasses.dataclass(frozen=True)
class UPGrad(Mean):
    """UPGrad projects each gradient onto the directions that raise no loss, then averages (Quinton & Rey 2024).

    The nearest d to g_i with J d >= 0 is J^T (e_i + v_i), v_i minimising (e_i + v)^T G (e_i + v) over v >= 0; the
    weights are the mean of e_i + v_i. Without conflicts, they are 1 / T.
    """

    needs = "gradients"

    @of_gram
    def weigh(self, gram: Array) -> Array:
        matrix, norms, present = conditioned(gram)
        unit = jax.vmap(lambda row: minimise(matrix, row, jnp.zeros(len(gram))))(matrix)
        return jnp.mean(jnp.eye(len(gram)) + norms[:, None] * unit * present / norms, axis=0)
