"""Kinds of value interpret a critic's outputs as a number, or as a distribution over returns."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents import parts
from mtjax.types import Array, InputError


@dataclasses.dataclass(frozen=True)
class Scalar:
    """The critic outputs the value itself, and is fitted by the squared error (Haarnoja et al. 2018).

    Every kind of value is a class with these methods. Outputs of N critics have a leading N.
    """

    linear: ClassVar[bool] = True
    """Whether values are linear in a critic's outputs, so that its head can be rescaled."""

    def refuses(self, scaling: str, largest: float | None, usual: "Scalar") -> str:
        """Return why this kind of value cannot work with the scaling of that name; empty if it can.

        Args:
            largest: absolute return after scaling, or None if the scaling keeps returns in no range.
            usual: the value that the agent has if none is given.
        """
        return ""

    @property
    def outputs(self) -> int:
        """Number of a critic's outputs."""
        return 1

    def mean(self, outputs: Array) -> Array:
        """Return the value (...,) for which outputs (..., outputs) stand."""
        return outputs[..., 0]

    def target(self, next_outputs: Array, pessimistic: bool, reward: Array, discount: Array, bonus: Array) -> Array:
        """Compute the target (B, ...): reward + discount (value + bonus), by the critics' minimum or their mean.

        Args:
            next_outputs: (N, B, outputs) of the target critics.
            pessimistic: take the minimum of critics instead of the mean.
            reward, discount, bonus: (B,).
        """
        return reward + discount * (reduce(self.mean(next_outputs), pessimistic) + bonus)

    def loss(self, outputs: Array, target: Array) -> Array:
        """Compute each critic's loss (N, B) for outputs (N, B, outputs) and a result of ``target``."""
        return jnp.square(self.mean(outputs) - target)

    def expected(self, target: Array) -> Array:
        """Return the value (B,) for which a result of ``target`` stands."""
        return target


@dataclasses.dataclass(frozen=True)
class C51(Scalar):
    """The critic outputs a distribution over returns: logits of K evenly spaced atoms z_k (Bellemare et al. 2017).

    The next return's distribution p, shifted to the atoms reward + discount (z_k + bonus) and clipped to the range, is
    projected back onto the z_j (their equation 7):
        m_j = sum_k p_k max(0, 1 - |clip(reward + discount (z_k + bonus)) - z_j| / spacing)
    and fitted by the cross-entropy -sum_j m_j log p_j. The projection keeps the mean if all is inside the range.
    With several critics, p is for each sample the distribution of least mean, or the mean of all distributions.

    Differs from the paper: a soft value's bonus shifts the atoms, and the policy is the actor's, as in BRC (Nauman et
    al. 2025). The default range is BRC's, which fits returns under scaling=return. Without a scaling that keeps
    returns in a range one must be given, as the critic cannot represent returns beyond it.
    """

    linear: ClassVar[bool] = False
    num_bins: int = 101
    """Number of atoms, or bins, of the distribution over returns."""
    value_low: float = -10.0
    """Lowest return of the distribution; lower ones are clipped to it."""
    value_high: float = 10.0
    """Highest return of the distribution; higher ones are clipped to it."""

    def __post_init__(self):
        if self.num_bins < 2:
            raise InputError(f"num-bins must be at least 2, not {self.num_bins}")
        if not -np.inf < self.value_low < self.value_high < np.inf:
            raise InputError(f"value-low must be below value-high, not {self.value_low} and {self.value_high}")

    def refuses(self, scaling: str, largest: float | None, usual: Scalar) -> str:
        low, high = self.value_low, self.value_high
        furthest = max(-low, high)  # where no reward is negative, value-low may be 0
        unchosen = [(x.value_low, x.value_high) for x in (type(self), usual) if hasattr(x, "value_low")]
        if (low, high) not in unchosen if largest is None else largest <= furthest:
            return ""
        told, use = ("", "scaling=return with ") if largest is None else (f" with return-range={largest:g}", "")
        return (
            f"reaches returns from {low:g} to {high:g}, and scaling={scaling}{told} does not keep them there; use "
            f"{use}return-range={furthest:g}, or give a value-low and value-high that they fit"
        )

    @property
    def outputs(self) -> int:
        return self.num_bins

    @property
    def atoms(self) -> Array:
        """The return (K,) for which each output stands."""
        return jnp.linspace(self.value_low, self.value_high, self.num_bins)

    def mean(self, outputs: Array) -> Array:
        return jnp.sum(jax.nn.softmax(outputs) * self.atoms, axis=-1)

    def target(self, next_outputs: Array, pessimistic: bool, reward: Array, discount: Array, bonus: Array) -> Array:
        p = jax.nn.softmax(next_outputs)  # (N, B, K)
        if pessimistic:
            least = jnp.argmin(self.mean(next_outputs), axis=0)
            p = jnp.take_along_axis(p, least[None, :, None], axis=0)
        shifted = reward[:, None] + discount[:, None] * (self.atoms + bonus[:, None])
        return self.project(jnp.mean(p, axis=0), shifted)

    def project(self, p: Array, places: Array) -> Array:
        """Split each of the probabilities p (B, K) at places (B, K) between the two nearest atoms: (B, K)."""
        spacing = (self.value_high - self.value_low) / (self.num_bins - 1)
        position = (jnp.clip(places, self.value_low, self.value_high) - self.value_low) / spacing
        apart = jax.lax.optimization_barrier  # else XLA puts this, the softmax and the loss into one slow GPU kernel
        p, position = apart((p, position))
        shares = jnp.maximum(1 - jnp.abs(position[:, :, None] - jnp.arange(self.num_bins)), 0.0)  # (B, K, K)
        return apart(jnp.einsum("bk,bkj->bj", p, shares, precision=jax.lax.Precision.HIGHEST))

    def loss(self, outputs: Array, target: Array) -> Array:
        return -jnp.sum(target * jax.nn.log_softmax(outputs), axis=-1)

    def expected(self, target: Array) -> Array:
        return jnp.sum(target * self.atoms, axis=-1)


@dataclasses.dataclass(frozen=True)
class HLGauss(C51):
    """The critic outputs a histogram, fitted to a normal distribution around the target (Imani & White 2018).

    With y the target of a scalar critic, clipped to the range, and K bins between edges e_0 ... e_K that fill it,
        m_j proportional to Phi((e_j - y) / sigma) - Phi((e_(j-1) - y) / sigma)
    summing to one, fitted by the cross-entropy; the value is the mean of the bins' centres. Sigma is 0.75 bin widths,
    as in Farebrother et al. (2024). If y lies within two bin widths of an end of the range, the truncated normal's
    mean, and so the value, is nearer to the range's centre than y.

    Differs from the papers: y is a soft value, by the critics' minimum or their mean.
    """

    bin_sigma: float = 0.75
    """Standard deviation of the target's distribution, in widths of a bin."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "bin_sigma")

    @property
    def width(self) -> float:
        """The width of a bin."""
        return (self.value_high - self.value_low) / self.num_bins

    @property
    def atoms(self) -> Array:
        return jnp.linspace(self.value_low + self.width / 2, self.value_high - self.width / 2, self.num_bins)

    def target(self, next_outputs: Array, pessimistic: bool, reward: Array, discount: Array, bonus: Array) -> Array:
        return self.smooth(Scalar.target(self, next_outputs, pessimistic, reward, discount, bonus))

    def smooth(self, values: Array) -> Array:
        """Return bins' probabilities (B, K) for values (B,)."""
        edges = jnp.linspace(self.value_low, self.value_high, self.num_bins + 1)
        values = jnp.clip(values, self.value_low, self.value_high)
        below = jax.scipy.stats.norm.cdf((edges - values[:, None]) / (self.bin_sigma * self.width))
        return jnp.diff(below) / (below[:, -1:] - below[:, :1])


def reduce(values: Array, pessimistic: bool) -> Array:
    """Return the minimum (B,) of critics' values (N, B), with a gradient that is always finite, or their mean.

    The gradient of ``jnp.min`` looks for values that equal the minimum. Where XLA computes the values twice and rounds
    them differently it finds none, and the gradient is 0 / 0.
    """
    if not pessimistic:
        return jnp.mean(values, axis=0)
    lowest = jnp.arange(len(values))[:, None] == jnp.argmin(values, axis=0)
    return jnp.sum(jnp.where(lowest, values, 0), axis=0)


Value = Scalar
VALUES: dict[str, type[Value]] = {"scalar": Scalar, "c51": C51, "hl-gauss": HLGauss}
