"""What an agent plays a task by that it was not trained on, in place of what training tasks have for themselves."""

from mtjax.agents.base import BaseAgent


def describe_unseen(agent: BaseAgent) -> str:
    """Return a sentence on what stands in for unseen tasks; empty if nothing has to."""
    borrowed, replaced = " and ".join(_borrowed(agent)), agent.representation.unseen.replaced
    by_nearest = f"each uses the {borrowed} of the nearest training task" if borrowed else ""
    return ", and ".join(filter(None, (agent.stand_in, by_nearest, f"each has {replaced}" if replaced else "")))


def _borrowed(agent: BaseAgent) -> list[str]:
    """Name what such a task uses of its nearest training task to act."""
    own, encoder = () if agent.stand_in else agent.actor.own, agent.encoder
    found = ["networks"] if "body" in own else ["head"] if "head" in own else []
    found += ["input layer"] * (encoder.front() is not None) + ["statistics"] * encoder.has_statistics
    return [*found, *agent.conditioning.borrowed, *agent.representation.unseen.borrowed]
