"""``AGENTS`` lists agents by name. To add one, add a line here, and a file if it is more than a choice of parts."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from mtjax.checks import shown
from mtjax.names import CHOICES, InputError, describe_unnamed, frozen, lazily, load, nearest_error, public

if TYPE_CHECKING:
    from mtjax.agents.base import BaseAgent
    from mtjax.agents.hyperparameters import PARTS, for_action, settings
    from mtjax.agents.sac import SAC

_PLACES = dict.fromkeys(("PARTS", "settings", "for_action"), "hyperparameters") | {"BaseAgent": "base", "SAC": "sac"}
__getattr__, __dir__ = lazily(__name__, {name: f"mtjax.agents.{place}" for name, place in _PLACES.items()})


class Preset(NamedTuple):
    """A preset names a class of agents and its settings."""

    says: str  # a description in one line
    defaults: Mapping[str, Any] = {}
    place: "str | type[BaseAgent]" = "mtjax.agents.sac:SAC"  # the class, or where it is, to be imported when it is used
    home: str = ""  # the file that registered it, if it is the user's own
    sees_pictures: bool = False  # whether it is for pictures alone

    @property
    def cls(self) -> "type[BaseAgent]":
        """The class of agents."""
        return load(self.place)


_PARAMS = {"conditioning": "parameters"}

AGENTS: dict[str, Preset] = {
    "sac": Preset("Soft actor-critic that does not see its task (Haarnoja et al. 2018)"),
    "sac-conditioned": Preset("SAC that sees the task's parameters (Schaul et al. 2015)", _PARAMS),
    "multi-head": Preset("SAC with an output layer for every task (Yu et al. 2020)", {"heads": "per-task"}),
    "disjoint": Preset("One SAC for every task, all in one program: nothing is shared", {"heads": "disjoint"}),
    "distral": Preset(
        "A policy for every task, held together by a distilled one (Teh et al. 2017)",
        {},
        "mtjax.agents.distral:Distral",
    ),
    "care": Preset("Attention over a mixture of encoders (Sodhani et al. 2021)", {"encoder": "care", **_PARAMS}),
    "moe": Preset("Soft mixture of encoders (Sodhani et al. 2021, MTRL)", {"encoder": "moe", **_PARAMS}),
    "attentive": Preset(
        "Outputs of shared sub-networks, weighed by state and task (Bram et al. 2019)",
        {"encoder": "attentive", "conditioning": "one-hot"},
    ),
    "film": Preset("Layers scaled and shifted by the task (Perez et al. 2018)", {"encoder": "film", **_PARAMS}),
    "moore": Preset(
        "Mixture of orthogonal experts (Hendawy et al. 2024)", {"encoder": "moore", "heads": "per-task", **_PARAMS}
    ),
    "soft-modularization": Preset("Modules routed by task (Yang et al. 2020)", {"encoder": "soft-modules", **_PARAMS}),
    "paco": Preset("Parameters composed for each task (Sun et al. 2022)", {"encoder": "paco", **_PARAMS}),
    "brc": Preset("Bigger, regularised, categorical critics (Nauman et al. 2025)", {}, "mtjax.agents.brc:BRC"),
    "simba-v2": Preset("Features and weights on unit spheres (Lee et al. 2025)", {}, "mtjax.agents.simba_v2:SimbaV2"),
    "xqc": Preset("Batches and weights normalised (Palenicek et al. 2025)", {}, "mtjax.agents.xqc:XQC"),
    "deepmdp": Preset(
        "SAC on a latent model of the task (Gelada et al. 2019)", {"representation": "deepmdp", **_PARAMS}
    ),
    "hip-bmdp": Preset(
        "DeepMDP with learned hidden parameters (Zhang et al. 2021)",
        {"representation": "hip-bmdp", "theta_size": 50},
    ),
    "drq": Preset(
        "SAC from pictures that are shifted at random (Yarats et al. 2022)",
        {"representation": "encoded", "encoder_tau": 1.0, "n_step": 3, "tau": 0.01, **_PARAMS},
        sees_pictures=True,
    ),
    "sac-ae": Preset(
        "SAC from pictures, with a decoder (Yarats et al. 2021)",
        {"representation": "autoencoder", "tau": 0.01, "target_entropy": -1.0, "temperature_momentum": 0.5, **_PARAMS},
        sees_pictures=True,
    ),
    "ppo": Preset(
        "Proximal policy optimisation (Schulman et al. 2017), sees its task", _PARAMS, "mtjax.agents.ppo:PPO"
    ),
    "impala": Preset(
        "Actor-critic corrected by V-trace, with PopArt (Espeholt et al. 2018)", _PARAMS, "mtjax.agents.impala:IMPALA"
    ),
    "rl2": Preset(
        "PPO with a recurrent memory of its trial (Duan et al. 2016)",
        {"conditioning": "recurrent"},
        "mtjax.agents.ppo:PPO",
    ),
    "maml": Preset("A policy that a gradient step adapts to a task (Finn et al. 2017)", {}, "mtjax.agents.maml:MAML"),
    "pqn": Preset(
        "Q-learning in parallel, of discrete actions, without replay (Gallici et al. 2025)",
        _PARAMS,
        "mtjax.agents.pqn:PQN",
    ),
    "sketches": Preset(
        "A sub-policy for every symbol of tasks' sketches (Andreas et al. 2017)",
        {"sampler": "by-length", "least_weight": 0.0},
        "mtjax.agents.sketches:Sketches",
    ),
    "options": Preset(
        "Options that tasks share, and a policy over them (Bacon et al. 2017)",
        _PARAMS,
        "mtjax.agents.options:Options",
    ),
    "distil": Preset(
        "One policy that learns from trained ones, by default without seeing its task (Rusu et al. 2016)",
        {},
        "mtjax.agents.distil:Distil",
    ),
    "pcgrad": Preset("Conflicting gradients projected (Yu et al. 2020)", {"gradients": "pcgrad", **_PARAMS}),
    "cagrad": Preset("Conflict-averse gradients (Liu et al. 2021)", {"gradients": "cagrad", **_PARAMS}),
    "gradnorm": Preset("Weights that even out learning rates (Chen et al. 2018)", {"gradients": "gradnorm", **_PARAMS}),
    "famo": Preset("Weights that even out losses' decrease (Liu et al. 2023)", {"gradients": "famo", **_PARAMS}),
}


@public
def agent(name: str, **given: Any) -> "BaseAgent":
    """Return the agent called ``name``, with any of its settings, or those of its parts, replaced.

    Raises:
        InputError: no agent has that name, no setting has one of the given names, or a value is not allowed.
    """
    preset = preset_of(name)
    return load("mtjax.agents.hyperparameters:build")(name, preset.cls, preset.defaults, given)


def preset_of(name: str) -> Preset:
    """Return the preset called ``name``.

    Raises:
        InputError: no agent has that name.
    """
    if not isinstance(name, str):
        raise InputError(f"an agent is chosen by name, such as 'care', not by {shown(name)}")
    if name not in AGENTS:
        own = describe_unnamed("mtjax.agents.base:BaseAgent", name, [preset.place for preset in AGENTS.values()])
        raise nearest_error("agent", name, AGENTS, own)
    return AGENTS[name]


def tuned_as(name: str) -> str:
    """Return the agent whose tuned settings one has: its own name, or that of the first agent of its class.

    Agents of common presets have tables of their own beside these.
    """
    preset = preset_of(name)
    same = (other for other, each in AGENTS.items() if each.place == preset.place)
    return name if preset.cls.common_presets else next(same, name)


def name_of(agent: Any) -> str:
    """Return the name of an agent: of those of its class, the one whose defaults it shares most."""
    cls, own = type(agent), load("mtjax.agents.hyperparameters:settings")(agent)
    homes = (cls, f"{cls.__module__}:{cls.__name__}")
    presets = {name: preset for name, preset in AGENTS.items() if preset.place in homes}
    shared = lambda preset: all(own.get(name) == value for name, value in frozen(preset.defaults).items())
    found = [name for name, preset in presets.items() if shared(preset)]
    return max(found, key=lambda name: len(presets[name].defaults), default=next(iter(presets), cls.__name__))


__all__ = [
    "AGENTS",
    "CHOICES",
    "PARTS",
    "SAC",
    "BaseAgent",
    "Preset",
    "agent",
    "for_action",
    "name_of",
    "preset_of",
    "settings",
]
