"""The hyper-parameters that every agent has, the parts it is made of, and which of them do not go together."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import tyro

from mtjax.agents import parts
from mtjax.agents.parts.encoders import ENCODERS, Encoder
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.parts.samplers import SAMPLERS, Sampler
from mtjax.agents.parts.scaling import SCALINGS, Scaling
from mtjax.agents.parts.values import VALUES, Value
from mtjax.names import frozen, nearest_error
from mtjax.types import InputError

Conditioning = Literal["none", "one-hot", "embedding", "parameters", "vectors", "inferred"]
CONDITIONINGS = get_args(Conditioning)
Heads = Literal["shared", "per-task", "disjoint"]
Tune = Literal["all", "heads", "embedding"]

PARTS: dict[str, Mapping[str, type]] = {
    "encoder": ENCODERS,
    "gradients": surgery.RULES,
    "value": VALUES,
    "scaling": SCALINGS,
    "sampler": SAMPLERS,
}
_FLAT = tyro.conf.arg(name="")  # a part's fields are flags of the agent's; its name is read before tyro's turn


@dataclasses.dataclass(frozen=True)
class Hyperparameters:
    """Settings of SAC and of all that is made from it."""

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    actor_lr: float = 1e-3
    """Adam's learning rate of the actor."""
    critic_lr: float = 1e-3
    """Adam's learning rate of the critics."""
    temperature_lr: float = 1e-3
    """Adam's learning rate of the temperatures."""
    weight_decay: float = 0.0
    """Decoupled weight decay of actor and critics (AdamW)."""
    gamma: float = 0.99
    """Discount of future reward per step."""
    tau: float = 0.005
    """Share of the new critic that its slow copy takes at each update."""
    num_critics: int = 2
    """Critics."""
    believe: Literal["least", "mean"] = "least"
    """Which critic bootstraps and guides the actor: the least of them, or the mean of all."""
    initial_temperature: float = 0.1
    """Temperature at the start."""
    target_entropy: float = -0.5
    """Entropy that the temperature aims at, per action dimension."""
    shared_temperature: bool = False
    """One temperature for all tasks instead of one a task."""
    normalize_observations: bool = False
    """Scale observations by their running mean and variance, fitted on training data alone."""
    max_gradient_norm: float = 0.0
    """Clip the global norm of actor and critic gradients to this; 0 does not clip."""
    critic_layer_norm: bool = True
    """Layer normalisation in the critics."""
    actor_layer_norm: bool = False
    """Layer normalisation in the actor."""
    conditioning: Conditioning = "none"
    """What the networks are told of the task: none, one-hot, embedding (learned), parameters (the task's context),
    vectors (rows of a file) or inferred (from the last steps, by an encoder of trajectories). For one-hot, embedding
    and vectors, an unseen task is taken for its nearest neighbour."""
    embedding_size: int = 16
    """Width of learned task embeddings, and of what is inferred."""
    unit_embedding: bool = False
    """Scale learned task embeddings to length 1."""
    vectors: str = ""
    """A .npy file of task vectors (T, V), a row for every training task, for conditioning on vectors."""
    inferred_from: int = 8
    """Steps from which the task is inferred, if it is; replay keeps them with every transition."""
    heads: Heads = "shared"
    """What a task has for itself: nothing (shared), output layers (per-task) or whole networks (disjoint)."""
    gradient_scope: Literal["shared", "per-layer"] = "shared"
    """Combine the tasks' gradients over all shared parameters at once, or for each layer by its own."""
    tune: Annotated[Tune, tyro.conf.arg(name="tune", prefix_name=False)] = "all"
    """Which parameters of actor and critics learn: all, heads (output layers) or embedding (learned task embeddings).
    The others stay as the run left them that --from names."""
    encoder: Annotated[Encoder, _FLAT] = dataclasses.field(default_factory=Encoder)
    gradients: Annotated[surgery.Rule, _FLAT] = dataclasses.field(default_factory=surgery.Rule)
    value: Annotated[Value, _FLAT] = dataclasses.field(default_factory=Value)
    scaling: Annotated[Scaling, _FLAT] = dataclasses.field(default_factory=Scaling)
    sampler: Annotated[Sampler, _FLAT] = dataclasses.field(default_factory=Sampler)

    def __post_init__(self):
        for kind, table in PARTS.items():
            object.__setattr__(self, kind, parts.choose(kind, table, getattr(self, kind)))
        parts.require_choices(self)
        self._check_numbers()
        self._check_combination()

    def _check_numbers(self) -> None:
        rates = ("actor_lr", "critic_lr", "temperature_lr")
        parts.require_positive(self, *rates, "num_critics", "initial_temperature")
        if not self.max_gradient_norm >= 0:
            raise InputError(f"max-gradient-norm must be at least 0 (0 does not clip), not {self.max_gradient_norm}")
        parts.require_not_negative(self, "weight_decay")
        parts.require_layers(self, "hidden")
        if not 0 <= self.gamma <= 1 or not 0 < self.tau <= 1:
            raise InputError(f"gamma must be in [0, 1] and tau in (0, 1], not {self.gamma} and {self.tau}")
        for field in ("embedding_size", "inferred_from"):
            if getattr(self, field) < 1:
                raise InputError(f"{field.replace('_', '-')} must be at least 1, not {getattr(self, field)}")

    def _check_combination(self) -> None:
        """Refuse parts that do not go together."""
        if (self.conditioning == "vectors") != bool(self.vectors):
            raise InputError("conditioning=vectors and vectors=FILE.npy go together; give both or neither")
        if self.tune == "embedding" and self.conditioning != "embedding":
            raise InputError(f"tune=embedding needs conditioning=embedding, not {self.conditioning}")
        encoder, rule = (parts.name_of(PARTS[kind], getattr(self, kind)) for kind in ("encoder", "gradients"))
        reason = self.encoder.refuses(self.conditioning)
        if reason:
            raise InputError(f"{encoder} {reason}")
        self.encoder.body(self.hidden, layer_norm=False)  # which refuses widths that it cannot take
        if self.heads == "disjoint" and rule != "mean":
            raise InputError(f"heads=disjoint leaves no parameters that tasks share for gradients={rule}; use mean")
        if self.gradient_scope == "per-layer" and self.gradients.needs != "gradients":
            raise InputError(f"gradient-scope=per-layer needs gradients of every task, which {rule} does not use")
        value, scaling = (parts.name_of(PARTS[kind], getattr(self, kind)) for kind in ("value", "scaling"))
        if scaling == "popart" and (self.heads == "shared" or value != "scalar"):
            raise InputError(
                "scaling=popart rescales a scalar head of every task's own; use value=scalar and heads=per-task or "
                f"disjoint, not {value} and {self.heads}"
            )
        if scaling == "return" and self.gamma == 1:
            raise InputError("scaling=return needs discounted returns, which have bounds; use gamma below 1")

    @property
    def history(self) -> int:
        """How many past steps the agent sees beside each observation."""
        return self.inferred_from if self.conditioning == "inferred" else 0


def settings(agent: Hyperparameters) -> dict[str, Any]:
    """Return all of an agent's settings in one flat table: parts by name, and their own settings after them."""
    found = {}
    for name, value in parts.settings(agent).items():
        found |= {name: parts.name_of(PARTS[name], value), **parts.settings(value)} if name in PARTS else {name: value}
    return found


def build(name: str, cls: type[Hyperparameters], given: Mapping[str, Any]) -> Hyperparameters:
    """Make the agent called ``name`` from a flat table of settings.

    Raises:
        InputError: a setting is neither the agent's nor one of its parts', or its value is not allowed.
    """
    rest = frozen(given)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    chosen = {}
    for kind, table in PARTS.items():
        part = parts.choose(kind, table, rest.pop(kind, None) or fields[kind].default_factory())  # type: ignore
        chosen[kind] = parts.take(rest, part)
    unknown = next((name for name in rest if name not in fields), None)
    if unknown is not None:
        known = [*fields, *(name for part in chosen.values() for name in parts.settings(part))]
        raise nearest_error(f"setting of {name}", unknown, known)
    return cls(**rest, **chosen)
