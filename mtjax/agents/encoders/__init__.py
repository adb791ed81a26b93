"""Encoders by name: what stands between a network's inputs and its heads. To add one: a file, and a line here."""

from mtjax.agents.encoders.base import Identity, MLPEncoder
from mtjax.agents.encoders.care import CARE
from mtjax.agents.encoders.composed import Hypernetwork, PaCo
from mtjax.agents.encoders.film import FiLM
from mtjax.agents.encoders.input_map import InputMap
from mtjax.agents.encoders.mixture import MoE
from mtjax.agents.encoders.moore import MOORE
from mtjax.agents.encoders.residual import BroNet, SimBa
from mtjax.agents.encoders.soft_modules import SoftModules

Encoder = Identity

ENCODERS: dict[str, type[Encoder]] = {
    "identity": Identity,
    "mlp": MLPEncoder,
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
}
