"""Encoded gives actor and critics a latent state, which one encoder makes of observations."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import MLP, OVER_TASKS, Network, Params
from mtjax.agents.parts.knowing.last_steps import without_past
from mtjax.agents.parts.representations.base import Plain
from mtjax.agents.parts.vision import NETWORKS, Projection, Vision, project, require_large, shift_pictures
from mtjax.types import Array, Key, Transition

PROJECTION = "projection"


class Latent(nn.Module):
    """Encodes vectors (..., O) as latent states (..., D) in (-1, 1), or pictures as features (..., F)."""

    widths: tuple[int, ...]
    vision: Vision = "drq"

    @nn.compact
    def __call__(self, obs: Any) -> Array:
        if frames.shown(obs):
            return NETWORKS[self.vision]()(obs[frames.PICTURES])
        *inner, size = self.widths
        return project(MLP(tuple(inner))(obs), size)


def require_visible(encoded: "Encoded", obs: Any) -> None:
    """Check that an encoder can take observations of these shapes.

    Raises:
        InputError: it has no layers for vectors, or pictures are smaller than its convolutions.
    """
    if not frames.shown(obs):
        parts.require_layers(encoded, "latent_widths")
    require_large(encoded.vision, obs)


@dataclasses.dataclass(frozen=True)
class Encoded(Plain):
    """Encoded is an encoder phi that all critics train and share with the actor, above all for pictures.

    Of vectors, phi is an MLP that ends in layer normalisation and tanh (Yarats et al. 2021, SAC-AE). The critics' loss
    trains it, and the actor's input is sg(phi(s)). Of pictures, phi is convolutions f (``vision``), and a projection: a
    linear layer, layer normalisation and tanh. The critics' loss trains f and the critics' projection. The actor has a
    projection of its own on sg(f(s)), which its loss trains. A state that is observed beside pictures is appended to
    the latent state. Target critics see phibar(s), the target encoder. It moves by ``encoder_tau``; of pictures this is
    f alone, and the projection's target copy moves by ``tau``, as those of the critics' other layers do. Without
    ``latent_widths`` there is no projection: actor and critics see f(s) itself.

    In every update from the replay each picture of the batch is shifted at random by up to ``shift`` pixels, those of s
    and of s' on their own (Yarats, Kostrikov and Fergus 2021, DrQ; Yarats et al. 2022, DrQ-v2). PPO shifts none.

    With encoder_tau=1 the target encoder is phi itself, and the actor's loss sees phi as it was before the critics'
    step, as in DrQ-v2. Differs from DrQ-v2: the learner is SAC, with tuned temperatures, and not DDPG with scheduled
    noise; weights of linear layers begin by LeCun's initialisation, there they are orthogonal. Widths, batches and
    rates are those of all agents here, where the paper has hidden layers of 1024, rates of 1e-4, batches of 256 (512
    for the walker, whose returns are of one step) and an update at every second step.
    """

    latent_widths: tuple[int, ...] = (256, 50)
    """Widths of the encoder's layers; the last is the size of the latent state. Of pictures only the last counts, and
    without any there is no projection."""
    vision: Vision = "drq"
    """Convolutions for pictures: drq (four, as in SAC-AE and DrQ), impala (fifteen in residual blocks) or grid (one,
    for grids of few cells)."""
    shift: int = 4
    """Shift pictures of a batch from the replay by up to so many pixels at random; 0 for none."""
    encoder_tau: float = 0.05
    """Step of the target encoder towards the new encoder at each update, as a share of the distance. With 1 an update
    encodes s and s' once each, for critics, targets and actor."""

    sees_pictures: ClassVar[bool] = True
    learns: ClassVar[bool] = True
    slow: ClassVar[tuple[str, ...]] = ("latent",)  # those whose target copies move by encoder_tau

    def __post_init__(self):
        (parts.require_layers if self.models else parts.require_widths)(self, "latent_widths")
        parts.require_not_negative(self, "shift")
        parts.require_rates(self, "encoder_tau")

    @property
    def rates(self) -> dict[str, float]:  # type: ignore[override]
        return dict.fromkeys(self.slow, self.encoder_tau)

    @property
    def own_target(self) -> tuple[str, ...]:  # type: ignore[override]
        swept = isinstance(self.encoder_tau, jax.Array)
        return self.slow if not swept and self.encoder_tau == 1 else ()

    require = require_visible  # type: ignore[override]

    def augment(self, batch: Transition, key: Key) -> Transition:
        return shift_pictures(batch, key, self.shift)

    # Networks: each is used by all N critics and by the actor.

    def model_inputs(self, latent: Array, features: Array, action: Array) -> dict[str, tuple]:
        """Return inputs of the models that are all zero, by name."""
        return {}

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The encoders and models, by name."""
        return {"latent": Latent(self.latent_widths, self.vision)}

    @property
    def sight(self) -> nn.Module:  # type: ignore[override]
        """Return a projection, which critics and actor each have of their own."""
        return Projection(*self.latent_widths[-1:])

    def apply(self, params: Params, name: str, *inputs: Any) -> Array:
        """Map one task's inputs by an encoder or a model."""
        return apply_part(self.modules | {PROJECTION: self.sight}, params, name, *inputs)

    def init(
        self, num_tasks: int, features: Array, obs: Any, seen: Any, action: Array, own: bool, key: Key
    ) -> tuple[Params, Key]:
        key, vector_key, *keys = jax.random.split(key, 2 + len(self.modules))
        params = self.init_vectors(num_tasks, vector_key)
        latent = jnp.zeros(self.latent_widths[-1:])  # models see no state beside pictures
        features = self.task_features(params.of_first(), features)
        inputs = {"latent": (obs,), **self.model_inputs(latent, features, action)}
        for (name, module), part_key in zip(self.modules.items(), keys, strict=True):
            init_part(params, name, module, own, part_key, num_tasks, *inputs.get(name, (seen,)))
        if frames.shown(obs):
            convolved = self.convolve(params.of_first(), obs)
            init_part(params, PROJECTION, self.sight, own, jax.random.fold_in(key, 1), num_tasks, convolved)
        return params, key

    def init_vectors(self, num_tasks: int, key: Key) -> Params:
        """Return the vectors that are learned for each task; none by default."""
        return Params({}, {})

    # Inputs of networks, for one task: features (Z,) or (B, Z), observations (..., O).

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Array]:
        """Return features of the task (Z,) or (..., Z), and latent states (..., D)."""
        return self.task_features(params, features), self.encode(params, without_past(obs))

    def actor_inputs(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """Return features of the task, and latent states; of pictures what the actor's own projection takes."""
        if not frames.shown(obs):
            return self.perceive(params, features, obs)
        return self.task_features(params, features), self.convolve(params, obs)

    def task_features(self, params: Params, features: Array) -> Array:
        """Return features of the task (Z,) or (..., Z), with those that a representation adds."""
        return features

    def encode(self, params: Params, obs: Any) -> Array:
        """Return the critics' latent states (..., D)."""
        if not frames.shown(obs):
            return self.apply(params, "latent", obs)
        return self.apply(params, PROJECTION, self.convolve(params, obs))

    def convolve(self, params: Params, obs: Any) -> Any:
        """Return observations with the features (..., F) of convolutions in place of pictures."""
        return obs | {frames.PICTURES: self.apply(params, "latent", obs)}


def encode_tasks(encoded: Encoded, params: Params, obs: Any) -> Array:
    """Return the critics' latent states (T, B, D) of all tasks' observations (T, B, O)."""
    return jax.vmap(encoded.encode, (OVER_TASKS, 0))(params, without_past(obs))


def apply_part(modules: Mapping[str, nn.Module], params: Params, name: str, *inputs: Any) -> Array:
    """Map one task's inputs by the encoder or model of that name."""
    return modules[name].apply(params.parts[name], *inputs)  # type: ignore


def init_part(params: Params, name: str, module: nn.Module, own: bool, key: Key, num_tasks: int, *inputs: Any) -> None:
    """Add the initial parameters of an encoder or a model: one for all tasks, or every task's own."""
    if own:
        params.own[name] = Network.for_each_task(module.init, key, num_tasks, *inputs)
    else:
        params.shared[name] = module.init(key, *inputs)
