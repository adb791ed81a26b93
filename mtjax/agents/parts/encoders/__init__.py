"""Encoders, by name, build the bodies of networks, below their heads. To add one, add a file, and a line here."""

from mtjax.agents.parts.encoders.attentive import Attentive
from mtjax.agents.parts.encoders.base import Identity, MLPEncoder
from mtjax.agents.parts.encoders.batch_norm import BatchNorm
from mtjax.agents.parts.encoders.care import CARE
from mtjax.agents.parts.encoders.composed import Hypernetwork, PaCo
from mtjax.agents.parts.encoders.film import FiLM
from mtjax.agents.parts.encoders.hypersphere import Hypersphere
from mtjax.agents.parts.encoders.input_map import InputMap
from mtjax.agents.parts.encoders.mixture import MoE
from mtjax.agents.parts.encoders.moore import MOORE
from mtjax.agents.parts.encoders.residual import BroNet, SimBa
from mtjax.agents.parts.encoders.soft_modules import SoftModules

Encoder = Identity

ENCODERS: dict[str, type[Encoder]] = {
    "identity": Identity,
    "mlp": MLPEncoder,
    "attentive": Attentive,
    "care": CARE,
    "moe": MoE,
    "moore": MOORE,
    "film": FiLM,
    "input-map": InputMap,
    "soft-modules": SoftModules,
    "paco": PaCo,
    "hypernetwork": Hypernetwork,
    "bronet": BroNet,
    "simba": SimBa,
    "hypersphere": Hypersphere,
    "batch-norm": BatchNorm,
}
