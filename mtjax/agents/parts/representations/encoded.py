"""Encoded gives actor and critics a latent state, which one encoder makes of observations."""

import dataclasses
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.parts.representations.base import Basis, Plain, without_past
from mtjax.agents.parts.trajectory import TrajectoryEncoder
from mtjax.agents.parts.vision import NETWORKS, Vision, shifted
from mtjax.networks import MLP, Network, Params, join
from mtjax.types import Array, Key, Transition

ENCODERS = ("latent", "trajectory", "embedding")


class Latent(nn.Module):
    """Encodes observations (..., O), or pictures with or without a state, as latent states (..., D) in (-1, 1)."""

    widths: tuple[int, ...]
    vision: str = "drq"

    @nn.compact
    def __call__(self, obs: Any) -> Array:
        *inner, size = self.widths
        end = lambda x: jnp.tanh(nn.LayerNorm()(nn.Dense(size)(x)))
        if not frames.shown(obs):
            return end(MLP(tuple(inner))(obs))
        seen = end(NETWORKS[self.vision]()(obs[frames.PICTURES]))
        state = frames.state(obs)
        return seen if state is None else jnp.concatenate([seen, state], axis=-1)


@dataclasses.dataclass(frozen=True)
class Encoded(Plain):
    """Encoded is an encoder phi that all critics train and share with the actor, above all for pictures.

    The critics' loss trains phi; the actor's input is sg(phi(s)). phi ends in layer normalisation and tanh (Yarats et
    al. 2021, SAC-AE). Pictures pass convolutions first (``vision``). A state that is observed beside them is appended
    to the latent state. Target critics see phibar(s), the target encoder. It moves by ``encoder_tau``; at 1 it is phi.

    In every update each picture of the batch is shifted at random by up to ``shift`` pixels, those of s and of s' on
    their own (Yarats, Kostrikov and Fergus 2021, DrQ; Yarats et al. 2022, DrQ-v2).

    The vectors of conditioning=embedding, and the trajectory encoder of conditioning=inferred, belong to this
    representation: all networks use the same, which critics train, and the actor does not.

    Differs from DrQ-v2: the linear layer after the convolutions is shared too, where there actor and critics have their
    own; shifts are by whole pixels.
    """

    latent_widths: tuple[int, ...] = (256, 50)
    """Widths of the encoder's layers; the last is the size of the latent state. Of pictures only the last counts."""
    encoder_tau: float = 0.05
    """Step of the target encoder towards the new encoder at each update, as a share of the distance."""
    vision: Vision = "drq"
    """Convolutions for pictures: drq (four, as in SAC-AE and DrQ) or impala (fifteen in residual blocks)."""
    shift: int = 4
    """Shift pictures of a batch by up to so many pixels at random; 0 for none."""

    names: ClassVar[tuple[str, ...]] = ENCODERS
    sees_pictures: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "latent_widths")
        parts.require_rates(self, "encoder_tau")
        parts.require_not_negative(self, "shift")

    @property
    def rates(self) -> dict[str, float]:
        return dict.fromkeys(ENCODERS, self.encoder_tau)

    # Networks: each is used by all N critics and by the actor.

    @property
    def has_theta(self) -> bool:
        """Whether every task has a learned vector."""
        return self.place.conditioning == "embedding"

    @property
    def infers(self) -> bool:
        """Whether task features are inferred from the last steps."""
        return self.place.conditioning == "inferred"

    @property
    def model_modules(self) -> dict[str, nn.Module]:
        """The models, by name."""
        return {}

    def model_inputs(self, latent: Array, features: Array, action: Array) -> dict[str, tuple]:
        """Return inputs of the models that are all zero, by name."""
        return {}

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The encoders and models, by name."""
        found: dict[str, nn.Module] = {"latent": Latent(self.latent_widths, self.vision), **self.model_modules}
        return found | ({"trajectory": self.trajectory} if self.infers else {})

    @property
    def trajectory(self) -> TrajectoryEncoder:
        return TrajectoryEncoder(self.place.embedding_size, layer_norm=self.place.layer_norm)

    def apply(self, params: Params, name: str, *inputs: Any) -> Array:
        """Map one task's inputs by an encoder or a model."""
        return self.modules[name].apply({**params.shared, **params.own}[name], *inputs)  # type: ignore

    def init(self, num_tasks: int, features: Array, obs: Any, action: Array, key: Key) -> Basis:
        key, theta_key, *keys = jax.random.split(key, 2 + len(self.modules))
        size, params = self.place.embedding_size, Params({}, {})
        latent = jnp.zeros(self.latent_size(without_past(obs)))
        features = jnp.zeros(len(features) + size * (self.has_theta + self.infers))
        inputs = {"latent": (without_past(obs),), **self.model_inputs(latent, features, action)}
        for (name, module), part_key in zip(self.modules.items(), keys, strict=True):
            self.init_part(params, name, module, part_key, num_tasks, *inputs.get(name, (obs,)))
        if self.has_theta:
            params.own["embedding"] = jax.random.normal(theta_key, (num_tasks, size))
        return Basis(params, features, latent, key)

    def init_part(self, params: Params, name: str, module: nn.Module, key: Key, num_tasks: int, *inputs: Any) -> None:
        """Add the initial parameters of an encoder or a model: one for all tasks, or every task's own."""
        if self.place.own:
            params.own[name] = Network.for_each_task(module.init, key, num_tasks, *inputs)
        else:
            params.shared[name] = module.init(key, *inputs)

    def latent_size(self, obs: Any) -> int:
        """Return the size D of latent states, to which a state beside pictures is appended."""
        state = frames.state(obs) if frames.shown(obs) else None
        return self.latent_widths[-1] + (0 if state is None else state.shape[-1])

    # Inputs of networks, for one task: features (Z,) or (B, Z), observations (..., O).

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Array]:
        """Return features of the task (Z,) or (..., Z), and latent states (..., D)."""
        if self.infers:
            features = self.apply(params, "trajectory", obs)
        features = join(features, task=self.theta(params)) if self.has_theta else features
        return features, self.apply(params, "latent", without_past(obs))

    def theta(self, params: Params) -> Array:
        """Return a task's learned vector (Z,)."""
        theta = params.own["embedding"]
        return theta / jnp.maximum(jnp.linalg.norm(theta), 1e-6) if self.place.unit_embedding else theta

    def augment(self, batch: Transition, key: Key) -> Transition:
        if not self.shift or not frames.shown(batch.obs):
            return batch
        keys = jax.random.split(key)
        move = lambda obs, key: obs | {frames.PICTURES: shifted(obs[frames.PICTURES], key, self.shift)}
        return batch._replace(obs=move(batch.obs, keys[0]), next_obs=move(batch.next_obs, keys[1]))
