"""Scalings bring the rewards of all tasks to one scale.

A scaling gives every task units of its own: critics learn a value v as factor (v - offset), and so a reward r with the
discount d as factor (r - (1 - d) offset). Temperatures are in these units too. A scaling's memory is part of the
agent's state, so it is checkpointed; evaluation does not change it. Stored rewards are raw, and are scaled by the
latest statistics when an update uses them; logged returns are raw.
"""

from mtjax.agents.parts.scaling.base import NoScaling
from mtjax.agents.parts.scaling.popart import PopArt
from mtjax.agents.parts.scaling.returns import ReturnNormalization, ReturnScaling
from mtjax.agents.parts.scaling.rewards import AdaptiveScaling, RewardScaling

Scaling = NoScaling
SCALINGS: dict[str, type[Scaling]] = {
    "none": NoScaling,
    "reward": RewardScaling,
    "return": ReturnScaling,
    "return-std": ReturnNormalization,
    "popart": PopArt,
    "ars": AdaptiveScaling,
}
