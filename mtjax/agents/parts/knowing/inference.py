"""How a belief about a hidden task follows from the steps of a trial, and how it learns: VariBAD, PEARL and CaDM."""

import abc
import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents.networks import MLP
from mtjax.agents.parts.knowing.recurrent import Track, gru
from mtjax.types import Array, Key, Metrics

_CHANGE = "change of state"
_DRAWS = 64  # of a belief, over which predictions are averaged


class Belief(NamedTuple):
    """Holds a Gaussian over latent tasks, whose entries are independent."""

    mean: Array  # (..., Z)
    log_var: Array  # (..., Z)

    def draw(self, key: Key) -> Array:
        """Draw latent tasks (..., Z), one from each Gaussian."""
        return self.mean + jnp.exp(self.log_var / 2) * jax.random.normal(key, self.mean.shape)


def divergence(p: Belief, q: Belief) -> Array:
    """Return the Kullback-Leibler divergence KL(p | q) (...,)."""
    ratio = jnp.exp(p.log_var - q.log_var) + jnp.square(p.mean - q.mean) * jnp.exp(-q.log_var)
    return 0.5 * jnp.sum(ratio - 1 + q.log_var - p.log_var, axis=-1)


def unit(like: Belief) -> Belief:
    """Return the prior N(0, 1) in the shape of another belief."""
    return Belief(jnp.zeros_like(like.mean), jnp.zeros_like(like.log_var))


class Dense(nn.Module):
    """Maps its inputs, joined, to outputs by an MLP with layer normalisation and a linear layer."""

    widths: tuple[int, ...]
    out: int

    @nn.compact
    def __call__(self, *inputs: Array) -> Array:
        return nn.Dense(self.out)(MLP(self.widths, layer_norm=True)(jnp.concatenate(inputs, axis=-1)))


def change(step: Any) -> Array:
    """Return the change of state (..., O) in steps; 0 where an episode ended, as what follows is another's start."""
    return (step.next_obs - step.obs) * within(step)[..., None]


def known_change(step: Any) -> Array:
    """Return the change of state (..., O) in steps; NaN where an episode ended."""
    return jnp.where(jnp.bool_(step.ended)[..., None], jnp.nan, change(step))


def within(step: Any) -> Array:
    """Return 1 for steps (...) within an episode, 0 for its last one."""
    return 1.0 - jnp.float32(step.ended)


def whole_step(step: Any) -> Array:
    """Return all of a step (..., 2 O + A + 2): state, action, reward, change of state, and whether an episode ended."""
    reward, ended = step.reward[..., None], jnp.float32(step.ended)[..., None]
    return jnp.concatenate([step.obs, step.action, reward, change(step), ended], axis=-1)


# Pairs of a belief and a step of the same trial.


class Pairs(NamedTuple):
    """Pairs every step t of B windows of L steps with the steps t + k of D shifts k, around the end of the window."""

    steps: Track  # the later steps, leaves (B, D, L, ...); the memory has no such leaf
    same: Array  # (B, D, L) 1 where both are of one trial, else 0
    length: Array  # (B, L) steps in the window of the trial of step t


def pair(track: Track, shifts: Array) -> Pairs:
    """Pair the steps of windows by shifts (D,), of which each is at least 0."""
    count = len(track.state)
    by_window = lambda x: x.reshape(count, -1, *x.shape[1:])
    steps = jax.tree.map(by_window, track._replace(state=None, key=None))
    closed = jnp.int32(steps.closed)
    trial = jnp.cumsum(closed, axis=1) - closed
    places = jnp.arange(trial.shape[1])
    later = (places + shifts[:, None]) % len(places)
    same = jnp.float32(trial[:, later] == trial[:, None])
    length = jnp.sum(jnp.float32(trial[:, :, None] == trial[:, None]), axis=2)
    return Pairs(jax.tree.map(lambda x: x[:, later], steps), same, length)


def spread(x: Array, like: Pairs) -> Array:
    """Return what belongs to every step (B L, Z) for all of its pairs (B, D, L, Z)."""
    count, shifts, length = like.same.shape
    return jnp.broadcast_to(x.reshape(count, 1, length, -1), (count, shifts, length, x.shape[-1]))


# The three ways.


@dataclasses.dataclass(frozen=True)
class Inference(abc.ABC):
    """Makes a memory of the steps of a trial, what networks see of it, and the losses by which it learns."""

    settings: Any  # of the conditioning

    @abc.abstractmethod
    def modules(self, obs: Array, action: Array) -> dict[str, tuple]:
        """Return by name its modules, and inputs for their initialisation, of an observation (O,) and action (A,)."""

    @abc.abstractmethod
    def begin(self, obs_size: int, action_size: int) -> Array:
        """Return the memory with which a trial begins."""

    def read(self, params: dict[str, Any], step: Any) -> Array:
        """Return what is read (..., I) of steps."""
        return whole_step(step)

    @abc.abstractmethod
    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        """Return the memory (..., M) after steps (..., I) as they are read."""

    def show(self, params: dict[str, Any], memory: Array) -> Array:
        """Return what networks see (..., Z) of a memory (..., M): the belief's mean and log-variance."""
        return jnp.concatenate(self.belief(params, memory), axis=-1)

    @abc.abstractmethod
    def belief(self, params: dict[str, Any], memory: Array) -> Belief:
        """Return what is believed given memories (..., M); of a point the variance is 0."""

    def foretell(self, params: dict[str, Any], step: Any, belief: Belief, key: Key) -> dict[str, tuple[Array, Array]]:
        """Return by name what its models predict (...) or (..., O) of steps under beliefs, and what came."""
        return {}

    @abc.abstractmethod
    def losses(self, params: dict[str, Any], track: Track, before: Array, after: Array) -> Metrics:
        """Return the losses, by name, that add up to its own, given the memories (B L, M) around every step."""

    def dense(self, out: int) -> Dense:
        """Return a module with so many outputs."""
        return Dense(self.settings.inference_widths, out)

    def apply(self, params: Any, out: int, *inputs: Array) -> Array:
        """Map inputs by such a module with these parameters."""
        return self.dense(out).apply(params, *inputs)  # type: ignore


class VariBAD(Inference):
    """Reads steps by a recurrent network, and learns to predict the trial's rewards and states, past and future."""

    def modules(self, obs: Array, action: Array) -> dict[str, tuple]:
        settings, step = self.settings, (obs, action)
        latent, memory = jnp.zeros(settings.latent_size), jnp.zeros(settings.recurrent_size)
        read = jnp.zeros(2 * len(obs) + len(action) + 2)
        return {
            "unit": (gru(settings.recurrent_size), memory, read),
            "belief": (nn.Dense(2 * settings.latent_size, use_bias=False), memory),
            "reward": (self.dense(1), *step, obs, latent),
            "state": (self.dense(len(obs)), *step, latent),
        }

    def begin(self, obs_size: int, action_size: int) -> Array:
        return jnp.zeros(self.settings.recurrent_size)

    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        return gru(self.settings.recurrent_size).apply(params["unit"], memory, read)[0]  # type: ignore

    def belief(self, params: dict[str, Any], memory: Array) -> Belief:
        """Return the belief for memories (..., M): a memory of nothing is 0, and its belief is the prior N(0, 1)."""
        size = self.settings.latent_size
        outputs: Any = nn.Dense(2 * size, use_bias=False).apply(params["belief"], memory)
        return Belief(outputs[..., :size], outputs[..., size:])

    def show(self, params: dict[str, Any], memory: Array) -> Array:
        return jax.lax.stop_gradient(super().show(params, memory))

    def foretell(self, params: dict[str, Any], step: Any, belief: Belief, key: Key) -> dict[str, tuple[Array, Array]]:
        """Predict rewards and changes of state by the mean over latent tasks that are drawn from beliefs."""
        latents = jax.vmap(belief.draw)(jax.random.split(key, _DRAWS))
        mean = lambda model: jnp.mean(jax.vmap(lambda latent: model(params, step, latent))(latents), axis=0)
        return {"reward": (mean(self.rewards), step.reward), _CHANGE: (mean(self.changes), known_change(step))}

    def rewards(self, params: dict[str, Any], step: Any, latent: Array) -> Array:
        """Predict the rewards (...) of steps in latent tasks (..., Z)."""
        return self.apply(params["reward"], 1, step.obs, step.action, change(step), latent)[..., 0]

    def changes(self, params: dict[str, Any], step: Any, latent: Array) -> Array:
        """Predict the changes of state (..., O) in steps in latent tasks (..., Z)."""
        return self.apply(params["state"], step.obs.shape[-1], step.obs, step.action, latent)

    def losses(self, params: dict[str, Any], track: Track, before: Array, after: Array) -> Metrics:
        belief, earlier = self.belief(params, after), self.belief(params, before)
        shift_key, draw_key = jax.random.split(track.key)  # type: ignore
        length = len(track.reward) // len(track.state)
        count = min(self.settings.decoded_steps, length)
        pairs = pair(track, jax.random.permutation(shift_key, length)[:count])
        latent, steps = spread(belief.draw(draw_key), pairs), pairs.steps
        error = jnp.square(self.rewards(params, steps, latent) - steps.reward)
        moved = jnp.mean(jnp.square(self.changes(params, steps, latent) - change(steps)), axis=-1)
        error += self.settings.state_coefficient * moved * within(steps)
        of_trial = length / count * jnp.sum(pairs.same * error, axis=1) / pairs.length  # (B, L) mean over the trial
        parted = divergence(belief, earlier).reshape(pairs.length.shape) / pairs.length
        return {
            "decoding_loss": jnp.mean(of_trial),
            "divergence_loss": self.settings.kl_coefficient * jnp.mean(parted),
        }


class PEARL(Inference):
    """Reads every step by itself as a Gaussian, and multiplies these with the prior: their order does not matter."""

    def modules(self, obs: Array, action: Array) -> dict[str, tuple]:
        read = jnp.zeros(2 * len(obs) + len(action) + 2)
        return {"factor": (self.dense(2 * self.settings.latent_size), read)}

    def begin(self, obs_size: int, action_size: int) -> Array:
        """Return sums (2, Z) of the precisions of factors, and of their means weighted by precision: none yet."""
        return jnp.zeros((2, self.settings.latent_size))

    def read(self, params: dict[str, Any], step: Any) -> Array:
        outputs = self.apply(params["factor"], 2 * self.settings.latent_size, whole_step(step))
        mean, precision = jnp.split(outputs, 2, axis=-1)
        return factor(mean, jax.nn.softplus(precision))

    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        return memory + read

    def belief(self, params: dict[str, Any], memory: Array) -> Belief:
        return product(memory)

    def losses(self, params: dict[str, Any], track: Track, before: Array, after: Array) -> Metrics:
        belief = product(before)
        return {"divergence_loss": self.settings.kl_coefficient * jnp.mean(divergence(belief, unit(belief)))}


def factor(mean: Array, precision: Array) -> Array:
    """Return a Gaussian's precision, and its mean weighted by it (..., 2, Z): those of a product are their sums."""
    return jnp.stack([precision, precision * mean], axis=-2)


def product(sums: Array) -> Belief:
    """Return the product of the prior N(0, 1) and Gaussians, given the sums (..., 2, Z) of their factors."""
    precision = 1 + sums[..., 0, :]
    return Belief(sums[..., 1, :] / precision, -jnp.log(precision))


class CaDM(Inference):
    """Encodes the last steps as a context, by which models predict the next states and the ones before."""

    def modules(self, obs: Array, action: Array) -> dict[str, tuple]:
        latent, model = jnp.zeros(self.settings.latent_size), self.dense(len(obs))
        return {
            "context": (self.dense(self.settings.latent_size), self.begin(len(obs), len(action)).reshape(-1)),
            "forward": (model, obs, action, latent),
            "backward": (model, obs, action, latent),
        }

    def begin(self, obs_size: int, action_size: int) -> Array:
        """Return a memory (K, I) of no step."""
        return jnp.zeros((self.settings.inferred_from, 2 * obs_size + action_size + 1))

    def read(self, params: dict[str, Any], step: Any) -> Array:
        return jnp.concatenate([step.obs, step.action, change(step), within(step)[..., None]], axis=-1)

    def advance(self, params: dict[str, Any], memory: Array, read: Array) -> Array:
        return jnp.concatenate([memory[..., 1:, :], read[..., None, :]], axis=-2)

    def context(self, params: dict[str, Any], memory: Array) -> Array:
        """Encode memories (..., K, I) as contexts (..., Z)."""
        flat = memory.reshape(*memory.shape[:-2], -1)
        return self.apply(params["context"], self.settings.latent_size, flat)

    def belief(self, params: dict[str, Any], memory: Array) -> Belief:
        context = self.context(params, memory)
        return Belief(context, jnp.full_like(context, -jnp.inf))

    def show(self, params: dict[str, Any], memory: Array) -> Array:
        return jax.lax.stop_gradient(self.context(params, memory))

    def foretell(self, params: dict[str, Any], step: Any, belief: Belief, key: Key) -> dict[str, tuple[Array, Array]]:
        """Predict changes of state by the forward model."""
        predicted = self.apply(params["forward"], step.obs.shape[-1], step.obs, step.action, belief.mean)
        return {_CHANGE: (predicted, known_change(step))}

    def losses(self, params: dict[str, Any], track: Track, before: Array, after: Array) -> Metrics:
        length = len(track.reward) // len(track.state)
        shifts = jnp.arange(min(self.settings.decoded_steps, length))
        pairs = pair(track, shifts)
        steps, context = pairs.steps, spread(self.context(params, before), pairs)
        ahead = jnp.arange(length) + shifts[:, None] < length  # not around the end
        used, there = pairs.same * ahead * within(steps), change(steps)

        def error(name: str, start: Array, target: Array) -> Array:
            missed = jnp.square(self.apply(params[name], start.shape[-1], start, steps.action, context) - target)
            return jnp.sum(used * jnp.mean(missed, axis=-1)) / jnp.maximum(jnp.sum(used), 1)

        backward = error("backward", steps.next_obs, -there)
        return {
            "forward_loss": error("forward", steps.obs, there),
            "backward_loss": self.settings.backward_coefficient * backward,
        }


INFERENCES: dict[str, type[Inference]] = {"varibad": VariBAD, "pearl": PEARL, "cadm": CaDM}
