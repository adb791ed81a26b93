"""Quadratic problems in T-vectors, which rules of gradient surgery solve on the cosines of the tasks' gradients."""

import jax
import jax.numpy as jnp

from mtjax.types import Array

RIDGE = 1e-6
"""Added to cosines' diagonal, times T, which is how their rounding grows."""
CENTRAL_STEPS = 30
"""Interior-point iterations: 15 bring 50 tasks to rounding, 30 also where lengths differ by a factor of 10 000."""


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
