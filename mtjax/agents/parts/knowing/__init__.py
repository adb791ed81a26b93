"""Ways in which an agent knows its task, by name. To add one, add a file, and a line here."""

from mtjax.agents.parts.knowing.base import Nothing
from mtjax.agents.parts.knowing.embedding import Embedding
from mtjax.agents.parts.knowing.last_steps import LastSteps
from mtjax.agents.parts.knowing.one_hot import OneHot
from mtjax.agents.parts.knowing.parameters import Parameters
from mtjax.agents.parts.knowing.posterior import Posterior
from mtjax.agents.parts.knowing.recurrent import Recurrent
from mtjax.agents.parts.knowing.text import Text
from mtjax.agents.parts.knowing.transformer import Transformer
from mtjax.agents.parts.knowing.vectors import Vectors

Knowing = Nothing

CONDITIONINGS: dict[str, type[Knowing]] = {
    "none": Nothing,
    "one-hot": OneHot,
    "embedding": Embedding,
    "parameters": Parameters,
    "vectors": Vectors,
    "text": Text,
    "inferred": LastSteps,
    "recurrent": Recurrent,
    "posterior": Posterior,
    "transformer": Transformer,
}
