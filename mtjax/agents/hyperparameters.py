"""Which parts agents have, and their settings in flat tables by name."""

import dataclasses
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar, get_type_hints

import tyro

from mtjax.agents import parts
from mtjax.agents.parts.continual import CONTINUAL
from mtjax.agents.parts.encoders import ENCODERS
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.parts.knowing import CONDITIONINGS
from mtjax.agents.parts.plasticity import PLASTICITY
from mtjax.agents.parts.policies import policy_for
from mtjax.agents.parts.representations import REPRESENTATIONS
from mtjax.agents.parts.samplers import SAMPLERS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.targets import TARGETS
from mtjax.agents.parts.values import VALUES
from mtjax.checks import OF_TRAIN, checked
from mtjax.experience import EXPERIENCES
from mtjax.names import CHOICES, InputError, frozen, nearest_error
from mtjax.types import Action

A = TypeVar("A")

PARTS: dict[str, Mapping[str, type]] = {
    "conditioning": CONDITIONINGS,
    "representation": REPRESENTATIONS,
    "encoder": ENCODERS,
    "gradients": surgery.RULES,
    "value": VALUES,
    "target": TARGETS,
    "scaling": SCALINGS,
    "sampler": SAMPLERS,
    "continual": CONTINUAL,
    "plasticity": PLASTICITY,
    "experience": EXPERIENCES,  # follows from the agent; all others are choices
}
FLAT = tyro.conf.arg(name="")  # a part's fields become flags of the agent; the part is chosen before tyro parses


def kinds_of(agent: Any) -> list[str]:
    """List the kinds of parts that an agent, or a class of agents, has."""
    return [field.name for field in dataclasses.fields(agent) if field.name in PARTS]


def parts_of(agent: Any, given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
    """Return an agent's parts by kind, with those that ``given`` has, by name or as they are, in place of its own.

    Raises:
        InputError: no part of a kind has that name.
    """
    return {kind: parts.choose(kind, PARTS[kind], given.get(kind, getattr(agent, kind))) for kind in kinds_of(agent)}


def flag_names(agent: Any) -> dict[str, str]:
    """Map the name of each of an agent's settings to its command-line flag, without dashes."""
    bare = {name for holder in (agent, agent.experience) for name in _unprefixed(type(holder))}
    names = {name: name.replace("_", "-") for name in settings(agent) if name != "experience"}
    return {name: flag if name in bare else f"agent.{flag}" for name, flag in names.items()}


def _unprefixed(cls: type) -> list[str]:
    """List the settings of a class whose flags have no prefix ``agent.``."""
    hints = get_type_hints(cls, include_extras=True)
    marks = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return [name for name, found in marks.items() if any(getattr(x, "prefix_name", None) is False for x in found)]


def settings(agent: Any) -> dict[str, Any]:
    """Return all of an agent's settings in one flat table: each part by name, followed by the part's settings."""
    found = {}
    for name, value in parts.settings(agent).items():
        found |= {name: parts.name_of(PARTS[name], value), **parts.settings(value)} if name in PARTS else {name: value}
    return found


def replace(agent: Any, given: Mapping[str, Any]) -> Any:
    """Return a copy of an agent with other settings, of its own or of its parts.

    Raises:
        InputError: it has no such setting, or the value is not allowed.
    """
    chosen = parts_of(agent, given)
    rest = {name: value for name, value in frozen(given).items() if name not in chosen}
    known = {name for holder in (agent, *chosen.values()) for name in parts.setting_names(holder)}
    unknown = next((name for name in rest if name not in known), None)
    if unknown is not None:
        raise unknown_setting("setting", unknown, [*settings(agent), *OF_TRAIN])
    taken = {kind: parts.take(rest, part) for kind, part in chosen.items()}
    return dataclasses.replace(agent, **checked(agent, rest), **taken)


def for_action(agent: A, action: Action) -> A:
    """Return an agent with the policy for such actions, which are those of its environment."""
    return dataclasses.replace(agent, policy=policy_for(action))  # type: ignore


def require_value_range(agent: Any) -> None:
    """Refuse categorical critics whose range is smaller than that of scaled returns, or nobody's choice without one.

    Raises:
        InputError: the agent has such critics.
    """
    if "value" not in kinds_of(agent):
        return
    usual, scaling = type(agent).__dataclass_fields__["value"].default_factory(), agent.scaling
    if reason := agent.value.refuses(parts.name_of(SCALINGS, scaling), scaling.return_range, usual):
        raise InputError(f"value={parts.name_of(VALUES, agent.value)} {reason}")


def build(name: str, cls: type, defaults: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
    """Make the agent called ``name`` from flat tables of settings: those of its preset, and those given.

    The preset's settings of a part do not apply to another part that is given in its place.

    Raises:
        InputError: a setting is neither the agent's nor one of its parts', or its value is not allowed.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}
    of_class = lambda kind: fields[kind].default_factory()  # type: ignore
    pick = lambda kind, part: parts.choose(kind, PARTS[kind], of_class(kind) if part is None else part)
    choose = lambda kind, table: pick(kind, table.get(kind))
    usual = {kind: choose(kind, defaults) for kind in kinds_of(cls)}
    chosen = {kind: choose(kind, {**defaults, **given}) for kind in usual}
    replaced = {x for kind, part in usual.items() for x in parts.settings(part).keys() - parts.settings(chosen[kind])}
    rest = frozen({**{k: v for k, v in defaults.items() if k not in replaced}, **given})
    for kind, part in chosen.items():
        rest.pop(kind, None)
        chosen[kind] = parts.take(rest, part)
    names = parts.setting_names(cls)
    unknown = next((name for name in rest if name not in names), None)
    if unknown in OF_TRAIN:
        raise InputError(f"{unknown} is no setting of an agent; give it to mtjax.train({unknown}=...)")
    if unknown is not None:
        known = [*names, *(name for part in chosen.values() for name in parts.settings(part))]
        raise unknown_setting(f"setting of {name}", unknown, known)
    return cls(**checked(cls, rest), **chosen)


def of_record(cls: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return an agent's settings from a record, without those that other agents have and its class does not.

    Agents had them for a while though nothing read them, and so have records of that time.
    """
    lacking = cls.__dataclass_fields__.keys() - {field.name for field in dataclasses.fields(cls)}
    return {name: value for name, value in given.items() if name not in lacking}


def unknown_setting(kind: str, name: str, known: Iterable[str]) -> InputError:
    """Return an error for a setting that an agent lacks. It names who has that setting, else the nearest match."""
    found = owners(name, "{}={!r}")
    return InputError(f"unknown {kind} {name!r}; it belongs to {found}") if found else nearest_error(kind, name, known)


def owners(name: str, form: str) -> str:
    """Return which parts or agents have a setting of that name; an empty string if none has.

    Args:
        form: how to write the choice of a part, given its kind and its name.
    """
    has = lambda cls: any(field.name == name for field in dataclasses.fields(cls))
    found = [form.format(kind, part) for kind in CHOICES for part, cls in PARTS[kind].items() if has(cls)]
    learn_from = {
        "replay": "agents with a replay, such as sac",
        "rollouts": "agents that learn from rollouts, such as ppo",
        "adapting": "agents that learn to adapt, such as maml",
    }
    return ", ".join(found or [told for kind, told in learn_from.items() if has(EXPERIENCES[kind])])
