"""Agents by name. To add one: a file, and a line here."""

from mtjax.agents.care import CARE
from mtjax.agents.conditioned import ConditionedSAC
from mtjax.agents.multi_head import MultiHead
from mtjax.agents.pcgrad import PCGrad
from mtjax.agents.sac import SAC
from mtjax.names import frozen, nearest_error

AGENTS: dict[str, type[SAC]] = {
    "sac": SAC,
    "sac-conditioned": ConditionedSAC,
    "multi-head": MultiHead,
    "care": CARE,
    "pcgrad": PCGrad,
}


def agent(name: str, **settings) -> SAC:
    """Return the agent called ``name``, with any of its hyper-parameters replaced.

    Raises:
        InputError: no agent has that name, no hyper-parameter has one of the given names, or a value is not allowed.
    """
    if name not in AGENTS:
        raise nearest_error("agent", name, AGENTS)
    cls = AGENTS[name]
    unknown = next((s for s in settings if s not in cls.__dataclass_fields__), None)
    if unknown is not None:
        raise nearest_error(f"setting of {name}", unknown, cls.__dataclass_fields__)
    return cls(**frozen(settings))
