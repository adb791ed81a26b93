"""Policies turn a network's outputs into actions. Which one an agent has follows from the actions of its environment.

To add a kind of actions, add its class to ``mtjax.types``, and a file and a line here.
"""

from mtjax.agents.parts.policies.base import Drawn, Policy, Taken
from mtjax.agents.parts.policies.categorical import Categorical
from mtjax.agents.parts.policies.gaussian import Gaussian
from mtjax.agents.parts.policies.multi_categorical import MultiCategorical
from mtjax.types import Action, Continuous, Discrete, MultiDiscrete


def policy_for(action: Action) -> Policy:
    """Return the policy of an environment with such actions."""
    match action:
        case Continuous():
            return Gaussian()
        case Discrete(size):
            return Categorical(size)
        case MultiDiscrete():
            return MultiCategorical(action)


__all__ = ["Categorical", "Drawn", "Gaussian", "MultiCategorical", "Policy", "Taken", "policy_for"]
