"""Experience is what agents learn from: replay of all steps, or rollouts of the latest ones."""

from mtjax.experience.adapting import AdaptingRollouts
from mtjax.experience.replay import Replay
from mtjax.experience.rollouts import Rollouts

EXPERIENCES: dict[str, type] = {"replay": Replay, "rollouts": Rollouts, "adapting": AdaptingRollouts}
