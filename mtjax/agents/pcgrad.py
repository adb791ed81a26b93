"""SAC with projected gradients."""

import dataclasses

from mtjax.agents import surgery
from mtjax.agents.conditioned import ConditionedSAC


@dataclasses.dataclass(frozen=True)
class PCGrad(ConditionedSAC):
    """Conditioned SAC whose per-task gradients lose the parts that conflict (Yu et al. 2020, algorithm 1).

    For the actor and for the critics, on the parameters that tasks share: each task's gradient is projected, in random
    order, onto the normal plane of every other task's gradient it has a negative inner product with; the update is the
    mean. Computed exactly on the Gram matrix of the gradients (``rules.pcgrad``).

    Any other agent takes it by ``--agent.gradients=pcgrad``. Differs from the paper: both critics count as one vector;
    heads, embeddings and temperatures of single tasks take plain gradients; the mean over tasks where the paper sums,
    as its authors' code does.
    """

    gradients: surgery.RuleName = "pcgrad"
    """How the tasks' gradients combine on the parameters that tasks share, in the actor and in the critics."""
