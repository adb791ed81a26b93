"""Representations, by name, encode the inputs of an agent's networks. To add one, add a file, and a line here."""

from mtjax.agents.parts.representations.asymmetric import Asymmetric
from mtjax.agents.parts.representations.autoencoder import Autoencoder
from mtjax.agents.parts.representations.base import Plain
from mtjax.agents.parts.representations.deepmdp import DeepMDP
from mtjax.agents.parts.representations.encoded import Encoded
from mtjax.agents.parts.representations.hip_bmdp import HiPBMDP

Representation = Plain

REPRESENTATIONS: dict[str, type[Representation]] = {
    "plain": Plain,
    "encoded": Encoded,
    "asymmetric": Asymmetric,
    "autoencoder": Autoencoder,
    "deepmdp": DeepMDP,
    "hip-bmdp": HiPBMDP,
}
