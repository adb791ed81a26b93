"""Solvers of the quadratic problems in T-vectors that rules of gradient surgery pose."""

import jax
import jax.numpy as jnp

from mtjax.types import Array

RIDGE = 1e-6
"""Ridge on the diagonal of cosines, to be multiplied by T, as rounding errors grow with T."""
CENTRAL_STEPS = 30
"""Interior-point iterations: 15 converge to rounding for 50 tasks, 30 even if lengths differ by 10 000 times."""
UNROLLED = 10
"""Most unknowns of a system that is solved by plain arithmetic."""


def conditioned(gram: Array) -> tuple[Array, Array, Array]:
    """Return cosines (T, T) with a ridge, lengths (T,) and a mask (T,) of the tasks that have a gradient.

    Tasks without a gradient count as orthogonal to the others, and of length 1.
    """
    present = jnp.diagonal(gram) > 0
    norms = jnp.where(present, jnp.sqrt(jnp.diagonal(gram)), 1.0)
    ridge = jnp.where(present, RIDGE * len(gram), 1.0)
    return gram / (norms[:, None] * norms) + jnp.diag(ridge), norms, present


def solve(matrix: Array, sides: Array) -> Array:
    """Solve matrix x = sides for a symmetric, positive definite matrix (T, T) and sides (T, K).

    Elimination needs no pivots then. For few unknowns it is unrolled into arithmetic on single numbers, which a
    compiler fuses into one kernel. A GPU's library launches many kernels, which take longer to launch than to run.
    """
    size = len(matrix)
    if size > UNROLLED:
        return jnp.linalg.solve(matrix, sides)
    rows = [[*matrix[i], *sides[i]] for i in range(size)]
    for k, row in enumerate(rows):
        for i in range(k + 1, size):  # entries below the diagonal are known by symmetry
            factor = row[i] / row[k]
            rows[i][i:] = [x - factor * y for x, y in zip(rows[i][i:], row[i:], strict=True)]
    found: list[list[Array]] = []
    for i in reversed(range(size)):
        right = rows[i][size:]
        for factor, known in zip(rows[i][i + 1 : size], found, strict=True):
            right = [x - factor * y for x, y in zip(right, known, strict=True)]
        found.insert(0, [x / rows[i][i] for x in right])
    return jnp.stack([jnp.stack(row) for row in found])


def minimise(matrix: Array, linear: Array, budget: Array) -> Array:
    """Minimise y . matrix y / 2 + linear . y over y >= 0 (T,), under budget . y = 1 unless budget is zero throughout.

    The method is an infeasible primal-dual interior-point method. With the multipliers z = matrix y + linear - price
    budget of y >= 0, each Newton step aims at y z = m, where m is a tenth of the current mean of y z.
    """
    bound = jnp.max(budget) > 0

    def step(point: tuple[Array, Array, Array], _) -> tuple[tuple[Array, Array, Array], None]:
        y, z, price = point
        centre = jnp.maximum(0.1 * jnp.mean(y * z), 1e-10) / y  # the floor keeps z / y within float32
        residual = centre - matrix @ y - linear + price * budget
        sides = jnp.stack([residual, budget], axis=1)
        free, paid = solve(matrix + jnp.diag(z / y), sides).T
        d_price = jnp.where(bound, (1 - budget @ (y + free)) / jnp.where(bound, budget @ paid, 1.0), 0.0)
        d_y = free + d_price * paid
        d_z = centre - z - z / y * d_y
        inwards = jnp.maximum(jnp.max(-d_y / y), jnp.max(-d_z / z))
        size = jnp.minimum(1.0, 0.95 / jnp.maximum(inwards, 0.95))
        return (y + size * d_y, z + size * d_z, price + size * d_price), None

    start = jnp.ones(len(linear))
    (y, _, _), _ = jax.lax.scan(step, (start, start, jnp.float32(0)), length=CENTRAL_STEPS)
    return y
