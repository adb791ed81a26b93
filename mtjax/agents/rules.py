"""Rules of gradient surgery: from the Gram matrix G (T, T) of the tasks' gradients J to weights w (T,) of their sum.

Conventions, for every rule. Weights stand beside the mean's 1 / T, so that an update scales as the gradients do and a
learning rate or a clipped norm means the same under each. Where all gradients are zero, weights are the mean's. A task
whose gradient is zero (it is absent from the batch) has no say: it neither constrains the others nor divides by zero.
Under Adam, which forgets the length of an update, rules differ in its direction alone.

Most rules solve their problem for unit gradients, on the matrix of cosines, as tasks' gradients differ in length by
orders of magnitude. A ridge on its diagonal, of the size of float32's rounding, makes the answer unique and finite for
gradients that repeat or oppose each other. Iterations are fixed in number, as all runs under one jit and vmap.
"""

from collections.abc import Callable
from functools import wraps

import jax
import jax.numpy as jnp

from mtjax.types import Array, Key

Rule = Callable[[Array, Key], Array]

RIDGE = 1e-6
"""Added to cosines' diagonal, times T, which is how their rounding grows."""
CENTRAL_STEPS = 30
"""Interior-point iterations: 15 bring 50 tasks to rounding, 30 also where lengths differ by a factor of 10 000."""
NEWTON_STEPS = 25
"""Newton steps to Nash's bargain: 20 bring 50 tasks to rounding, opposite gradients and unequal lengths included."""
CAGRAD_RADIUS = 0.5
"""c of CAGrad: how far its update may leave the mean, in lengths of the mean. Its authors: 0.5 (MT50), 0.9 (MT10)."""
CAGRAD_GRID = 16
"""Points at which CAGrad brackets its multiplier, twice."""


def of_gram(weigh: Callable[[Array], Array]) -> Rule:
    """Make a rule of a function of G alone: in full float32, and plain averaging where no task has a gradient."""

    @wraps(weigh)
    def rule(gram: Array, key: Key | None = None) -> Array:
        with jax.default_matmul_precision("highest"):
            largest = jnp.max(jnp.diagonal(gram))
            weights = weigh(gram / jnp.where(largest > 0, largest, 1.0))
        return jnp.where(largest > 0, weights, 1 / len(gram))

    return rule


def pcgrad(gram: Array, key: Key) -> Array:
    """Project away conflicts between tasks (Yu et al. 2020, algorithm 1), exactly, on T-vectors.

    Each task's gradient is c^T J with c = e_i; in a fresh random order over the other tasks j, where the two conflict,
    c_j loses (c . G[:, j]) / G[j, j]. The result is the mean over tasks.

    Args:
        gram: (T, T) inner products of the tasks' gradients.
        key: the random orders.

    Returns:
        weights (T,).
    """
    num_tasks = len(gram)
    orders = jax.vmap(lambda k: jax.random.permutation(k, num_tasks))(jax.random.split(key, num_tasks))
    norms = jnp.diagonal(gram)

    def project(task: Array, order: Array) -> Array:
        def against(c: Array, other: Array) -> tuple[Array, None]:
            conflict = jnp.minimum(jnp.sum(c * gram[:, other]), 0.0)
            share = jnp.where((other == task) | (norms[other] == 0), 0.0, conflict / norms[other])
            return c - share * jax.nn.one_hot(other, num_tasks), None

        return jax.lax.scan(against, jax.nn.one_hot(task, num_tasks), order, unroll=min(num_tasks, 10))[0]

    return jnp.mean(jax.vmap(project)(jnp.arange(num_tasks), orders), axis=0)


@of_gram
def cagrad(gram: Array) -> Array:
    """Improve the worst-off task near the mean gradient (Liu et al. 2021a, "CAGrad").

    With the mean g_0, the update d solves max_d min_i g_i . d under |d - g_0| <= c |g_0|. It is d = g_0 + J^T x, where
    for some multiplier t > 0 the vector t x minimises t g_0 . g_y + |g_y|^2 / 2 over y in the simplex (g_y = y^T J) and
    |J^T x| = c |g_0|; or less, where no d helps every task. |J^T x| falls with t, so that two grids of quadratic
    problems bracket t, and x is interpolated between the last two (exactly, if they hold the same tasks back): to 1e-3
    of c |g_0|. As in the authors' code, the result is d / (1 + c^2), which scales with the gradients.
    """
    matrix, norms, present = cosines(gram)
    along = jnp.mean(gram, axis=1)
    length = jnp.sqrt(jnp.maximum(jnp.mean(along), 0.0))  # |g_0|
    slope = jnp.clip(along / norms / jnp.where(length > 0, length, 1.0), -1.0, 1.0)
    lengths = jnp.where(present, norms, jnp.max(norms))
    shortest = jnp.min(lengths)
    budget = present * shortest / norms

    def at(multiplier: Array) -> tuple[Array, Array]:
        x = minimise(matrix, slope, multiplier * budget)
        return x, jnp.sqrt(x @ matrix @ x)

    def narrow(bracket: Array) -> tuple[Array, Array, Array]:
        multipliers = jnp.geomspace(bracket[0], bracket[1], CAGRAD_GRID)
        x, reach = jax.vmap(at)(multipliers)
        high = jnp.clip(jnp.sum(reach > CAGRAD_RADIUS), 1, CAGRAD_GRID - 1)
        pair = jnp.stack([high - 1, high])
        return multipliers[pair], x[pair], reach[pair]

    widest = jnp.stack([jnp.float32(1e-3), jnp.max(lengths) / shortest]) / CAGRAD_RADIUS
    _, x, reach = narrow(narrow(widest)[0])
    share = jnp.clip((reach[0] - CAGRAD_RADIUS) / jnp.maximum(reach[0] - reach[1], 1e-12), 0.0, 1.0)
    x = (1 - share) * x[0] + share * x[1]
    return (1 / len(gram) + length * present * x / norms) / (1 + CAGRAD_RADIUS**2)


@of_gram
def mgda(gram: Array) -> Array:
    """The shortest convex combination of gradients (Désidéri 2012; Sener & Koltun 2018): min w^T G w on the simplex.

    No task's loss rises along it; it is zero where no direction helps every task. Weights sum to one.
    """
    matrix, norms, present = cosines(gram)
    inverse = present * jnp.min(jnp.where(present, norms, jnp.inf)) / norms
    weights = inverse * minimise(matrix, jnp.zeros(len(gram)), inverse)
    return weights / jnp.sum(weights)


@of_gram
def imtl_g(gram: Array) -> Array:
    """Equal projections onto every task's direction (Liu et al. 2021b, "IMTL-G"): d . g_i / |g_i| the same for all i.

    With the matrix C of cosines, w_i = y_i / |g_i| where C y = 1. Weights sum to one, as in the paper, and may be
    negative. Differs from it where they cancel: magnitudes sum to ten at most, and the update never turns against all
    tasks, which the paper's does for gradients that agree but differ in length.
    """
    matrix, norms, present = cosines(gram)
    weights = present * jnp.linalg.solve(matrix, 1.0 * present) / norms
    return weights / jnp.maximum(jnp.sum(weights), 0.1 * jnp.sum(jnp.abs(weights)))


@of_gram
def nash_mtl(gram: Array) -> Array:
    """The tasks' bargain (Navon et al. 2022, "Nash-MTL"): w > 0 with G w proportional to 1 / w.

    The paper's G a = 1 / a makes every update as long as sqrt(T), however small the gradients; here weights sum to one.
    With the matrix C of cosines and y = a |g|, C y = 1 / y minimises y^T C y / 2 - sum log y; Newton's steps r in log y
    are shortened to r / (1 + max |r|), which always descends and tends to the full step.
    """
    matrix, norms, present = cosines(gram)

    def newton(y: Array, _) -> tuple[Array, None]:
        scaled = y[:, None] * matrix * y
        step = jnp.linalg.solve(scaled + jnp.eye(len(y)), 1 - jnp.sum(scaled, axis=1))
        return y * (1 + step / (1 + jnp.max(jnp.abs(step)))), None

    y, _ = jax.lax.scan(newton, jnp.ones(len(gram)), length=NEWTON_STEPS)
    weights = present * y / norms
    return weights / jnp.sum(weights)


@of_gram
def aligned_mtl(gram: Array) -> Array:
    """Gradients made orthogonal and equally long (Senushkin et al. 2023, "Aligned-MTL"), then averaged.

    With G = V diag(s) V^T and s_r its least eigenvalue above rounding, w = sqrt(s_r) V diag(s)^(-1/2) V^T 1 / T, over
    the eigenvalues from s_r up. Lengths are part of G here, and gradients a thousand times shorter than the longest are
    lost to rounding.
    """
    values, vectors = jnp.linalg.eigh(gram)
    kept = values > RIDGE * len(gram) * jnp.max(values)
    least = jnp.min(jnp.where(kept, values, jnp.inf))
    stretch = jnp.where(kept, jnp.sqrt(least / jnp.where(kept, values, 1.0)), 0.0)
    return vectors @ (stretch * jnp.mean(vectors, axis=0))


@of_gram
def upgrad(gram: Array) -> Array:
    """Project each gradient onto the directions that raise no loss, then average (Quinton & Rey 2024, "UPGrad").

    The nearest d to g_i with J d >= 0 is J^T (e_i + v_i), v_i minimising (e_i + v)^T G (e_i + v) over v >= 0; the
    weights are the mean of e_i + v_i. Without conflict that is the mean.
    """
    matrix, norms, present = cosines(gram)
    unit = jax.vmap(lambda row: minimise(matrix, row, jnp.zeros(len(gram))))(matrix)
    return jnp.mean(jnp.eye(len(gram)) + norms[:, None] * unit * present / norms, axis=0)


def cosines(gram: Array) -> tuple[Array, Array, Array]:
    """Cosines (T, T) with a ridge, lengths (T,) and who has a gradient (T,); the absent are orthogonal, of length 1."""
    present = jnp.diagonal(gram) > 0
    norms = jnp.where(present, jnp.sqrt(jnp.diagonal(gram)), 1.0)
    ridge = jnp.where(present, RIDGE * len(gram), 1.0)
    return gram / (norms[:, None] * norms) + jnp.diag(ridge), norms, present


def minimise(matrix: Array, linear: Array, budget: Array) -> Array:
    """Minimise y . matrix y / 2 + linear . y over y >= 0 (T,), under budget . y = 1 unless budget is zero throughout.

    An infeasible primal-dual interior-point method: Newton's steps towards y z = m with m a tenth of its mean at each,
    where z = matrix y + linear - price budget are the multipliers of y >= 0.
    """
    bound = jnp.max(budget) > 0

    def step(point: tuple[Array, Array, Array], _) -> tuple[tuple[Array, Array, Array], None]:
        y, z, price = point
        centre = jnp.maximum(0.1 * jnp.mean(y * z), 1e-10) / y  # the floor keeps z / y within float32
        rest = centre - matrix @ y - linear + price * budget
        sides = jnp.stack([rest, budget], axis=1)
        free, paid = jnp.linalg.solve(matrix + jnp.diag(z / y), sides).T
        d_price = jnp.where(bound, (1 - budget @ (y + free)) / jnp.where(bound, budget @ paid, 1.0), 0.0)
        d_y = free + d_price * paid
        d_z = centre - z - z / y * d_y
        inwards = jnp.maximum(jnp.max(-d_y / y), jnp.max(-d_z / z))
        size = jnp.minimum(1.0, 0.95 / jnp.maximum(inwards, 0.95))
        return (y + size * d_y, z + size * d_z, price + size * d_price), None

    start = jnp.ones(len(linear))
    (y, _, _), _ = jax.lax.scan(step, (start, start, jnp.float32(0)), length=CENTRAL_STEPS)
    return y
