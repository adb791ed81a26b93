"""Multi-head SAC."""

import dataclasses
from typing import Literal

from mtjax.agents.sac import SAC


@dataclasses.dataclass(frozen=True)
class MultiHead(SAC):
    """SAC whose actor and critics share their hidden layers and give every task its own output layer (Yu et al. 2020,
    Meta-World's multi-head SAC).

    The heads are the only place where the task enters, unless ``conditioning`` says otherwise. An unseen task uses the
    heads of the nearest training task. Differs from MTRL's version: linear heads, where MTRL's have a hidden layer.
    """

    heads: Literal["shared", "per-task"] = "per-task"
    """Output layers of actor and critics: one for all tasks, or one for each."""
