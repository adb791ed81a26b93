"""Registration of a user's own families, agents and parts of agents under names."""

import dataclasses
import re
import sys
from typing import Any

from mtjax import agents, envs
from mtjax.agents.base import BaseAgent
from mtjax.agents.hyperparameters import CHOICES, PARTS
from mtjax.checks import shown
from mtjax.envs.family import Family
from mtjax.names import InputError, first_sentence, public

_GONE = {
    "check": "settings are checked in __post_init__",
    "relabel": "families relabel steps, by relabel(task, transition, key)",
    "consolidate": "a part of the kind continual does it, which derives from mtjax.agents.parts.continual.Nothing",
}
"""Methods of agents that once were called, and what is in their place."""


@public
def register(name: str, thing: "type | str", **defaults: Any) -> None:
    """Register your own class under a name that Python, notebooks and the command line accept.

    Args:
        name: what ``--env``, ``--agent`` or ``--agent.KIND`` takes.
        thing: a frozen dataclass, or the name of an agent that gets other defaults under the new name. The base of
            the class says what it is. An environment derives from ``Domain`` or ``Family``; an agent from
            ``BaseAgent``, ``SAC`` or ``PPO``; a part from the base of its kind. The fields of a part become flags of
            every agent that chooses it.
        defaults: values of the fields of a family or an agent, such as ``vary={"mass": "0.5:2:10"}``.

    Raises:
        InputError: the name is taken, the class has none of these bases, or a default is not allowed.
    """
    if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]*", name):  # "+" joins the names of a mixture
        raise InputError(f"a name is of letters, digits, -, _ and ., such as 'my-own', not {shown(name)}")
    if isinstance(thing, str):
        known, home = agents.preset_of(thing), sys._getframe(2).f_globals.get("__file__", "")
        return _register_agent(name, known._replace(defaults={**known.defaults, **defaults}, home=home))
    if not isinstance(thing, type):
        raise InputError(f"register takes a class, or the name of an agent, not {shown(thing)}")
    if issubclass(thing, Family):
        return envs.register(name, thing, **defaults)
    if issubclass(thing, BaseAgent):
        return _register_agent(name, agents.Preset(first_sentence(thing.__doc__ or thing.__name__), defaults, thing))
    _register_part(name, thing, defaults)


def _register_agent(name: str, preset: agents.Preset) -> None:
    if name in agents.AGENTS:
        raise InputError(f"there is an agent {name!r} already; choose another name")
    if gone := next((hook for hook in _GONE if hasattr(preset.cls, hook)), None):
        raise InputError(f"nothing calls {preset.cls.__name__}.{gone}: {_GONE[gone]}")
    agents.AGENTS[name] = preset
    try:
        agents.agent(name)
    except InputError:
        del agents.AGENTS[name]
        raise


def _register_part(name: str, part: type, defaults: dict[str, Any]) -> None:
    kind = next((kind for kind in CHOICES if issubclass(part, plainest(kind))), None)
    if kind is None:
        bases = ", ".join(plainest(kind).__name__ for kind in CHOICES)
        raise InputError(f"{part.__name__} must be a subclass of Domain, Family, BaseAgent, or of one of {bases}")
    if defaults:
        raise InputError(f"a part has the defaults of its class; leave out {', '.join(defaults)}")
    if name in PARTS[kind]:
        raise InputError(f"{kind} {name!r} exists already; choose another name")
    if not dataclasses.is_dataclass(part):
        raise InputError(f"{part.__name__} must be a frozen dataclass, whose fields are its settings")
    own = {field.name for field in dataclasses.fields(part)} - {f.name for f in dataclasses.fields(plainest(kind))}
    taken = sorted(own & _names_beside(kind))
    if taken:
        raise InputError(f"{part.__name__} and agents would both have a setting {taken[0]}; call it otherwise")
    PARTS[kind][name] = part  # type: ignore


def plainest(kind: str) -> type:
    """Return the class from which all parts of a kind derive."""
    return next(iter(PARTS[kind].values()))


def _names_beside(kind: str) -> set[str]:
    """Return the settings of all agents and of parts of other kinds, which a part's own must not repeat."""
    of_agents = {name for preset in agents.AGENTS.values() for name in preset.cls.__dataclass_fields__}
    others = [part for other in PARTS if other != kind for part in PARTS[other].values()]
    return of_agents | {field.name for part in others for field in dataclasses.fields(part)}
