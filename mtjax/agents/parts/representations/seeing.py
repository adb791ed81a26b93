"""``Seeing`` holds what all representations of pictures share."""

import dataclasses
from typing import Any, ClassVar

import jax

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.parts.representations.base import Plain
from mtjax.agents.parts.vision import Vision, shifted
from mtjax.types import Key, Transition


@dataclasses.dataclass(frozen=True)
class Seeing(Plain):
    """Seeing gives the encoder's settings, and shifts pictures at random before losses see them."""

    latent_widths: tuple[int, ...] = (256, 50)
    """Widths of the encoder's layers; the last is the size of the latent state. Of pictures only the last counts."""
    vision: Vision = "drq"
    """Convolutions for pictures: drq (four, as in SAC-AE and DrQ) or impala (fifteen in residual blocks)."""
    shift: int = 4
    """Shift pictures of a batch from the replay by up to so many pixels at random; 0 for none."""

    sees_pictures: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "latent_widths")
        parts.require_not_negative(self, "shift")

    def require(self, obs: Any) -> None:
        """Accept vectors, pictures, and both."""

    def augment(self, batch: Transition, key: Key) -> Transition:
        if not self.shift or not frames.shown(batch.obs):
            return batch
        keys = jax.random.split(key)
        move = lambda obs, key: obs | {frames.PICTURES: shifted(obs[frames.PICTURES], key, self.shift)}
        return batch._replace(obs=move(batch.obs, keys[0]), next_obs=move(batch.next_obs, keys[1]))
