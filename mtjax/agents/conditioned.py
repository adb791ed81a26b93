"""SAC that is told its task."""

import dataclasses

from mtjax.agents.sac import SAC, Conditioning


@dataclasses.dataclass(frozen=True)
class ConditionedSAC(SAC):
    """SAC whose actor and critics see the task's features beside the observation (universal value functions, Schaul et
    al. 2015). By default these are the task's physical parameters, which unseen tasks have too."""

    conditioning: Conditioning = "parameters"
    """What the networks are told of the task: none, one-hot, embedding (learned), parameters (the task's context) or
    vectors (rows of a file). For one-hot, embedding and vectors, an unseen task is taken for its nearest neighbour."""
