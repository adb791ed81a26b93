"""Environment families by name. To add one, write a file for its domain and a line here, or ``register`` it."""

import ast
import dataclasses
import re
from collections import UserDict
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from mtjax.checks import OF_TRAIN, checked, require_text, shown
from mtjax.envs import variation
from mtjax.envs.metaworld.names import BENCHMARKS, FAMILIES
from mtjax.names import InputError, describe_unnamed, first_sentence, frozen, lazily, load, nearest_error, public

if TYPE_CHECKING:
    from mtjax.envs.domain import Domain
    from mtjax.envs.engines.base import World
    from mtjax.envs.family import Family
    from mtjax.envs.mixtures import Mixture
    from mtjax.envs.parameters import Parameter
    from mtjax.envs.stacked import stacked

__all__ = [
    "BENCHMARKS",
    "ENVS",
    "Domain",
    "Family",
    "Mixture",
    "Parameter",
    "World",
    "is_mixture",
    "make",
    "members",
    "mixture",
    "name_of",
    "outline",
    "register",
    "require_pictures",
    "stacked",
]

__getattr__, __dir__ = lazily(
    __name__,
    {
        "Domain": "mtjax.envs.domain",
        "Family": "mtjax.envs.family",
        "Mixture": "mtjax.envs.mixtures",
        "Parameter": "mtjax.envs.parameters",
        "World": "mtjax.envs.engines.base",
        "stacked": "mtjax.envs.stacked",
    },
)

Settings = dict[str, Any]
Entry = tuple[Any, Settings]  # a family's class, or the place that it is imported from; and its settings


SUITES = {
    "gymnasium": "mtjax.envs.hosted.gymnasium:Gymnasium",
    "envpool": "mtjax.envs.hosted.envpool:EnvPool",
    "craftax": "mtjax.envs.adapters.craftax:Craftax",
    "gymnax": "mtjax.envs.adapters.gymnax:Gymnax",
    "xminigrid": "mtjax.envs.adapters.xminigrid:XMiniGrid",
}
"""Families of the environments of other packages, by the first part of their names: SUITE:ENVIRONMENT."""


class Families(UserDict[str, Entry]):
    """Families by name. A class is imported when it is first used; ``data`` holds its place.

    The environments of ``SUITES`` have names too, and are not listed.
    """

    def __contains__(self, name: Any) -> bool:
        return name in self.data or _of_suite(name) is not None

    def __getitem__(self, name: str) -> Entry:
        family, settings = self.data[name] if name in self.data else _of_suite(name) or self.data[name]
        return load(family), settings


def _of_suite(name: Any) -> Entry | None:
    """Return the class and the settings of another package's environment; None if the name is of no suite."""
    suite, _, environment = name.partition(":") if isinstance(name, str) else ("", "", "")
    return (SUITES[suite], {"environment": environment}) if suite in SUITES and environment else None


# Where each class is in its folder, "module:Class", and its settings. Families whose tasks are drawn say how many.

# dm_control's tasks (Tassa et al. 2018). Their parameters vary on request.
_DOMAINS: dict[str, Entry] = {
    "acrobot-swingup": ("acrobot:AcrobotSwingup", {}),
    "acrobot-swingup-sparse": ("acrobot:AcrobotSwingup", {"sparse": True}),
    "ball-in-cup-catch": ("ball_in_cup:BallInCup", {}),
    "cartpole-balance": ("cartpole:CartpoleBalance", {}),
    "cartpole-balance-sparse": ("cartpole:CartpoleBalance", {"sparse": True}),
    "cartpole-swingup": ("cartpole:CartpoleSwingup", {}),
    "cartpole-swingup-sparse": ("cartpole:CartpoleSwingup", {"sparse": True}),
    "cheetah-run": ("cheetah:CheetahRun", {}),
    "dog-run": ("dog:DogRun", {}),
    "dog-stand": ("dog:DogStand", {}),
    "dog-trot": ("dog:DogTrot", {}),
    "dog-walk": ("dog:DogWalk", {}),
    "finger-spin": ("finger:FingerSpin", {}),
    "finger-turn-easy": ("finger:FingerTurn", {}),
    "finger-turn-hard": ("finger:FingerTurn", {"vary": {"target-size": "0.03"}}),
    "fish-swim": ("fish:FishSwim", {}),
    "fish-upright": ("fish:FishUpright", {}),
    "hopper-hop": ("hopper:HopperHop", {}),
    "hopper-stand": ("hopper:HopperStand", {}),
    "humanoid-run": ("humanoid:HumanoidRun", {}),
    "humanoid-stand": ("humanoid:HumanoidStand", {}),
    "humanoid-walk": ("humanoid:HumanoidWalk", {}),
    "pendulum-swingup": ("pendulum:PendulumSwingup", {}),
    "point-mass-easy": ("point_mass:PointMass", {}),
    "quadruped-run": ("quadruped:QuadrupedRun", {}),
    "quadruped-walk": ("quadruped:QuadrupedWalk", {}),
    "reacher-easy": ("reacher:Reacher", {}),
    "reacher-hard": ("reacher:Reacher", {"vary": {"target-size": "0.015"}}),
    "swimmer-swimmer6": ("swimmer:Swimmer", {}),
    "swimmer-swimmer15": ("swimmer:Swimmer", {"links": 15}),
    "walker-run": ("walker:WalkerRun", {}),
    "walker-stand": ("walker:WalkerStand", {}),
    "walker-walk": ("walker:WalkerWalk", {}),
}

# Further tasks on dm_control's bodies, with rewards of our own.
_FURTHER: dict[str, Entry] = {
    "ball-in-cup-spin": ("ball_in_cup:BallInCupSpin", {}),
    "cheetah-jump": ("cheetah:CheetahJump", {}),
    "cheetah-run-backward": ("cheetah:CheetahRunBackward", {}),
    "hopper-hop-backward": ("hopper:HopperHopBackward", {}),
    "pendulum-spin": ("pendulum:PendulumSpin", {}),
    "walker-run-backward": ("walker:WalkerRunBackward", {}),
    "walker-walk-backward": ("walker:WalkerWalkBackward", {}),
}

# HiP-BMDP's families (Zhang et al. 2021) with the values of MTEnv's models; `--split=hip-bmdp` for its held-out tasks.
_HIP_BMDP: dict[str, Entry] = {
    "cartpole-swingup-vary-cart-mass": ("cartpole:CartpoleSwingup", {"vary": {"cart-mass": "1:5.5:10"}}),
    "cartpole-swingup-vary-pole-mass": ("cartpole:CartpoleSwingup", {"vary": {"pole-mass": "0.1:0.55:10"}}),
    "cheetah-run-vary-back-foot-length": ("cheetah:CheetahRun", {"vary": {"back-foot-length": "0.094:0.184:10"}}),
    "cheetah-run-vary-foot-position": (
        "cheetah:CheetahRun",
        {"vary": {"foot-position": "0.5,0.48,0.46,0.44,0.42,0.4,0.38,0.36,0.34,0.32"}},
    ),
    "cheetah-run-vary-foot-size": (
        "cheetah:CheetahRun",
        {"vary": {"foot-size": "0.046,0.0552,0.0598,0.0644,0.069,0.0736,0.0782,0.0828,0.0874,0.092"}},
    ),
    "cheetah-run-vary-torso-length": ("cheetah:CheetahRun", {"vary": {"torso-length": "0.5:1.4:10"}}),
    "finger-spin-vary-size": ("finger:FingerSpin", {"vary": {"size": "0.95:1.13:10"}}),
    "finger-spin-vary-touch-size": ("finger:FingerSpin", {"vary": {"touch-size": "0.025:0.25:10"}}),
    "walker-run-vary-foot-length": ("walker:WalkerRun", {"vary": {"foot-length": "0.08:0.17:10"}}),
    "walker-run-vary-friction": ("walker:WalkerRun", {"vary": {"friction": "0.7:1.6:10"}}),
    "walker-walk-vary-foot-length": ("walker:WalkerWalk", {"vary": {"foot-length": "0.08:0.17:10"}}),
    "walker-walk-vary-friction": ("walker:WalkerWalk", {"vary": {"friction": "0.7:1.6:10"}}),
}

_GOALS: dict[str, Entry] = {
    "cheetah-run-vary-speed": ("cheetah:CheetahSpeed", {"vary": {"speed": "1:5.5:10"}}),
    "cheetah-vary-direction": ("cheetah:CheetahDirection", {"vary": {"direction": "-1,1"}, "split": "none"}),
    "finger-turn-vary-target": ("finger:FingerTurnTarget", {"vary": {"target-angle": "-2:2:10"}}),
    "point-mass-vary-goal": (
        "point_mass:PointMassNavigate",
        {"vary": {"goal-x": "-0.2:0.2", "goal-y": "-0.2:0.2"}, "combine": "random", "num_tasks": 10},
    ),
    "reacher-vary-goal": ("reacher:ReacherTarget", {"vary": {"target-angle": "-2:2:10"}}),
    "walker-vary-speed": ("walker:WalkerSpeed", {"vary": {"speed": "0.5:5:10"}}),
}

# From which MTEnv draws each task's parameters.
_ACROBOT_RANGES = {
    "link-length-1": "0.5:1.5",
    "link-length-2": "0.5:1.5",
    "link-mass-1": "0.5:1.5",
    "link-mass-2": "0.5:1.5",
    "torque-sign": "-1:1",
}
_CARTPOLE_RANGES = {
    "gravity": "4.8:14.8",
    "cart-mass": "0.5:1.5",
    "pole-mass": "0.01:0.19",
    "pole-length": "0.2:0.8",
    "force": "-10:10",
}
_MTENV: dict[str, Entry] = {
    "bandit": ("tabular:Bandit", {"num_tasks": 10}),
    "control-acrobot": ("control:Acrobot", {"vary": _ACROBOT_RANGES, "combine": "random", "num_tasks": 10}),
    "control-cartpole": ("control:CartPole", {"vary": _CARTPOLE_RANGES, "combine": "random", "num_tasks": 10}),
    "tabular-mdp": ("tabular:TabularMDP", {"num_tasks": 10}),
    "two-goal-maze": ("maze:TwoGoalMaze", {"vary": {"goal-box": "0,1"}, "split": "none"}),
    "two-goal-maze-seen": ("maze:TwoGoalMaze", {"vary": {"goal-box": "0,1"}, "split": "none", "observe_boxes": True}),
}

# Tasks that nothing shows, for trials of several episodes.
_HIDDEN: dict[str, Entry] = {
    "grid-navi": ("hidden:GridNavi", {}),
    "hidden-bandit": ("hidden:HiddenBandit", {}),
}

# Grids whose tasks are made of parts: recipes, paths, weights of colours.
_CRAFT: dict[str, Entry] = {  # of the errands, 72 are held out
    "coloured-maze": ("coloured:ColouredMaze", {"num_tasks": 10}),
    "craft": ("crafts:CraftWorld", {"vary": {"goal": "0:9:10"}, "split": "none"}),
    "craft-sketched": ("crafts:CraftWorld", {"vary": {"goal": "0:9:10"}, "split": "none", "sketched": True}),
    "errands": ("errands:Errands", {"vary": {"goal": "0:167:168"}, "num_tasks": 96}),
    "light-world": ("light:LightWorld", {"vary": {"goal": "0:9:10"}, "split": "none"}),
    "light-world-sketched": ("light:LightWorld", {"vary": {"goal": "0:9:10"}, "split": "none", "sketched": True}),
}

# Mazes seen from within.
_CORRIDORS: dict[str, Entry] = {
    "corridor-maze": ("maze:CorridorMaze", {}),
    "corridor-maze-vary-goal": ("maze:CorridorMaze", {"vary": {"goal-colour": "0,1,2"}}),
    "corridor-maze-vary-layout": ("maze:CorridorMaze", {"vary": {"layout": "0:9:10"}}),
}

# Worlds of a few equations, whose best outcomes are known.
_ANALYTIC: dict[str, Entry] = {
    "link": (
        "link:Link",
        {
            "vary": {"bandwidth": "100:500", "delay": "0.05:0.5", "buffer": "10:1000", "loss": "0:0.05"},
            "combine": "random",
            "num_tasks": 10,
        },
    ),
    "racing": ("racing:Racing", {"vary": {"track": "0:9:10"}}),
    "sailing": (
        "sailing:Sailing",
        {
            "vary": {"wind-speed": "4:8", "wind-direction": "-3.1:3.1", "current-speed": "0:0.3"},
            "combine": "random",
            "num_tasks": 10,
        },
    ),
    "tabletop": ("tabletop:Tabletop", {"vary": {"goal": "0,1,2,3"}, "split": "none", "num_tasks": 1}),
    "trading": ("trading:Trading", {"vary": {"risk-aversion": "0.5:5:10"}}),
}

# Hands. The goals of ``claw`` are within what a few pushes turn.
_DEXTEROUS: dict[str, Entry] = {
    "claw": ("claw:Claw", {"vary": {"goal": "-2,-1,1,2"}, "split": "none", "num_tasks": 1}),
}

_BRAX_NAMES = (
    "ant",
    "fast",
    "halfcheetah",
    "hopper",
    "humanoid",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "pusher",
    "reacher",
    "walker2d",
)
_BRAX: dict[str, Entry] = {
    **{f"brax-{name.replace('_', '-')}": ("brax:Brax", {"environment": name}) for name in _BRAX_NAMES},
    "brax-ant-vary-direction": ("brax:BraxAntDirection", {"vary": {"direction": "-2:2:10"}}),
    "brax-halfcheetah-vary-speed": ("brax:BraxHalfcheetahSpeed", {"vary": {"speed": "0.3:3:10"}}),
}

PICTURES = ("pixels", "frames", "repeat", "grey", "state", "plain", "painter")
"""Settings that only families with a scene have: those of MuJoCo models, mazes and analytic worlds."""

_inside = lambda folder, table: {name: (f"{folder}.{place}", settings) for name, (place, settings) in table.items()}
ENVS = Families(
    _inside("mtjax.envs.dm_control", _DOMAINS | _FURTHER | _HIP_BMDP | _GOALS)
    | _inside("mtjax.envs.mtenv", _MTENV)
    | _inside("mtjax.envs.analytic", _ANALYTIC)
    | _inside("mtjax.envs.corridors", _CORRIDORS)
    | _inside("mtjax.envs.dexterous", _DEXTEROUS)
    | _inside("mtjax.envs.craft", _CRAFT)
    | _inside("mtjax.envs.metaworld", FAMILIES)
    | _inside("mtjax.envs", _BRAX | _HIDDEN)
)


@public
def make(name: str, vary: Mapping[str, Any] | tuple = (), **settings: Any) -> Any:
    """Return the family called ``name``, or a mixture, with any of its fields replaced.

    A mixture is "NAME+NAME", or a benchmark such as "mt10".

    Args:
        vary: values of parameters, {"mass": "0.5:1.5:10"}, beside those that the family varies by itself. A single
            value fixes a parameter. In a mixture, {"NAME.mass": ...} names the family.
        settings: fields of the family. In a mixture they apply to every family that has such a field.

    Raises:
        InputError: there is no such family or field, or a value is out of range.
    """
    if not isinstance(name, str):
        several = "; mtjax.mixture takes several" if isinstance(name, list | tuple) else ""
        raise InputError(f"an environment is chosen by name, such as 'finger-spin', not by {shown(name)}{several}")
    if is_mixture(name):
        return _make_mixture(members(name), _pairs(vary), dict(settings))
    if name not in ENVS:
        raise unknown_name(name)
    family, defaults = ENVS[name]
    fields = [field.name for field in dataclasses.fields(family)]
    unknown = next((s for s in (*settings, *defaults) if s not in fields), None)
    if unknown is not None:
        require_pictures(name, unknown)
        raise _unknown_setting(name, family, unknown, settings.get(unknown))
    varied = dict(defaults.get("vary", {})) | _pairs(vary)
    made = family(**checked(family, defaults | frozen(settings)) | {"vary": varied})
    if "combine" not in settings and defaults.get("combine") == "random":
        variation.require_ranges(name, _pairs(vary))
    return made


def make_from(env: Any, given: Mapping[str, Any]) -> tuple[str, Any, dict[str, Any]]:
    """Return the name of a family, the family, and what of ``given`` is not a field of it.

    Args:
        env: a name, whose family gets its fields from ``given``; or a family, which keeps its own.

    Raises:
        InputError: there is no such family, or a value is out of range.
    """
    if not isinstance(env, str):
        return name_of(env), env, dict(given)
    names = [name for name, _ in members(env)]
    unknown = next((name for name in names if name not in ENVS), None)
    if unknown is not None:
        raise unknown_name(unknown)
    own = {field.name for name in names for field in dataclasses.fields(ENVS[name][0])}
    rest = {name: value for name, value in given.items() if name not in own}
    return env, make(env, **{name: value for name, value in given.items() if name in own}), rest


def is_mixture(name: str) -> bool:
    """Return whether a name is that of a mixture: "NAME+NAME" or a benchmark."""
    return "+" in name or name in BENCHMARKS


def members(name: str) -> tuple[tuple[str, Settings], ...]:
    """Return the families that a name of ``make`` stands for, each with the settings that a benchmark has for it.

    Raises:
        InputError: a mixture's name lacks a family, or has commas.
    """
    if "," in name:
        raise InputError(f"{name!r} has commas; a mixture is NAME+NAME")
    if name and not all(name.split("+")):
        raise InputError(f"{name!r} lacks a family; a mixture is NAME+NAME")
    parts = [BENCHMARKS[part][1] if part in BENCHMARKS else {part: {}} for part in name.split("+")]
    return tuple(pair for part in parts for pair in part.items())


def _pairs(vary: Any) -> dict[str, Any]:
    """Return the values of each parameter by name.

    Raises:
        InputError: they are no mapping.
    """
    try:
        return dict(vary)
    except (TypeError, ValueError):
        raise InputError(
            f"vary maps parameters to values, such as {{'size': '0.9:1.1:5'}}; not {shown(vary)}"
        ) from None


def unknown_name(name: str) -> InputError:
    """Return an error for a name of no environment. Gymnasium's names, which end with a version, are told as such."""
    if re.search(r"[A-Z].*-v\d+$", name) and ":" not in name:
        return InputError(f"unknown environment {name!r}; did you mean 'gymnasium:{name}'? --list prints the others")
    suites = [f"{suite}:NAME" for suite in SUITES]
    own = describe_unnamed("mtjax.envs.family:Family", name, [home for home, _ in ENVS.data.values()])
    return nearest_error("environment", name, (*ENVS, *BENCHMARKS, *suites), own)


def _unknown_setting(name: str, family: Any, unknown: str, value: Any) -> InputError:
    """Return an error that says where a name belongs which is no field of a family."""
    parameter = unknown.replace("_", "-")
    if parameter in getattr(family, "parameters", ()):
        return InputError(f"{unknown} is a parameter of {name}, not a setting: use vary={{{parameter!r}: {value!r}}}")
    if unknown in OF_TRAIN:
        return InputError(f"{unknown} is no setting of an environment; give it to mtjax.train({unknown}=...)")
    return nearest_error(f"setting of {name}", unknown, [field.name for field in dataclasses.fields(family)])


def require_pictures(name: str, setting: str) -> None:
    """Refuse a setting of pictures for a family that does not have it.

    Raises:
        InputError: the setting belongs to families with a scene only.
    """
    if setting in PICTURES:
        raise InputError(f"{name} has no scene to draw, which {setting} needs; take a family such as cheetah-run")


@public
def mixture(families: "Sequence[str | Family | Mixture]", scenes: str = "auto") -> "Mixture":
    """Return a mixture of families, each given by name or as returned by ``make``.

    Families may share a model or a name if their tasks differ, such as a walker with varied friction and a walker with
    varied feet.

    Args:
        scenes: how many simulators step families of different scenes (``Mixture.scenes``).

    Raises:
        InputError: there is no family of a name, or a family is in the mixture twice.
    """
    cls = load("mtjax.envs.mixtures:Mixture")
    if isinstance(families, str) or not isinstance(families, Iterable) or not getattr(families, "ndim", 1):
        raise InputError(
            f"a mixture takes a list of families, such as ['bandit', 'finger-spin'], not {shown(families)}"
        )
    named: list[tuple[str, Any]] = []
    for given in families:
        found = make(given) if isinstance(given, str) else given
        if isinstance(found, cls):
            named += zip(found.names, found.families, strict=True)
        else:
            named.append((given if isinstance(given, str) else name_of(found), found))
    names: list[str] = []
    for name, _ in named:
        again = sum(other == name or other.startswith(f"{name}#") for other in names)
        names.append(f"{name}#{again + 1}" if again else name)
    return cls(tuple(family for _, family in named), tuple(names), scenes)


def name_of(family: Any) -> str:
    """Return the name of a family in ``make``, or else the name of its class."""
    cls = type(family)
    if cls is load("mtjax.envs.mixtures:Mixture"):
        known = (name for name, (_, own) in BENCHMARKS.items() if tuple(own) == family.names and make(name) == family)
        return next(known, "+".join(family.names))
    place = f"{cls.__module__}:{cls.__name__}"
    if place in SUITES.values():
        return family.name
    known = [name for name, (home, _) in ENVS.data.items() if home is cls or home == place]
    exact = [name for name in known if make(name) == family]
    plain = [name for name in known if not ENVS.data[name][1]]
    of_class = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()
    return next(iter((*exact, *plain, *known)), of_class)


def _make_mixture(own: tuple[tuple[str, Settings], ...], vary: Settings, settings: Settings) -> "Mixture":
    """Make a mixture from its families' own settings, and values of parameters by "NAME.PARAMETER"."""
    cls, names = load("mtjax.envs.mixtures:Mixture"), tuple(name for name, _ in own)
    recorded, scenes = settings.pop("families", None), settings.pop("scenes", "auto")
    if recorded is not None:  # of config.json
        made = [make(name.partition("#")[0], **each) for name, each in zip(names, recorded, strict=True)]
        return cls(tuple(made), names, scenes)
    plain = [make(name) for name in names]
    for given in settings:
        known = dict.fromkeys(["scenes", *(field.name for family in plain for field in dataclasses.fields(family))])
        if given not in known:
            raise nearest_error("setting of these families", given, known)
    chosen: dict[str, dict[str, Any]] = {name: {} for name in names}
    for given, values in vary.items():
        require_text(given, "the name of a parameter")
        name, dot, parameter = given.rpartition(".")
        if not dot or name not in chosen:
            raise InputError(
                f"in a mixture, say which family's {parameter} varies: one of "
                f"{', '.join(f'{known}.{parameter}' for known in names)}; not {given}"
            )
        chosen[name][parameter] = values
    made = []
    for (name, fixed), family in zip(own, plain, strict=True):
        known = {field.name for field in dataclasses.fields(family)}
        mine = {key: value for key, value in settings.items() if key in known}
        made.append(make(name, vary=chosen[name], **fixed | mine))
    return cls(tuple(made), names, scenes)


def register(name: str, family: "type[Family]", **settings: Any) -> None:
    """Register your own family under a name that ``make``, the command line and notebooks accept.

    Its methods are called once with abstract arrays, so that a wrong shape or name is found here.

    Args:
        family: a frozen dataclass, a subclass of ``Domain`` (an MJCF file, parameters, observation and reward) or of
            ``Family`` (anything that steps in JAX).
        settings: values of its fields, such as ``vary={"mass": "0.5:2:10"}``.

    Raises:
        InputError: the name is taken, a value is out of range, a method is wrong, or a parameter changes nothing.
    """
    if name in ENVS:
        raise InputError(f"there is an environment {name!r} already; choose another name")
    ENVS[name] = (family, settings)
    try:
        made = make(name)
        load("mtjax.envs.registration_checks:check")(made)
        load("mtjax.envs.effects:require_effects")(made)
    except TypeError as error:  # an abstract method is missing
        del ENVS[name]
        raise InputError(f"{family.__name__} cannot be made: {error}") from None
    except Exception:
        del ENVS[name]
        raise


def varied(name: str) -> str:
    """Return what differs between the tasks of a registered family, as ``--env.vary`` takes it."""
    given = dict(ENVS.data[name][1].get("vary", {}))
    return ", ".join(f"{parameter}={variation.write_values(values)}" for parameter, values in given.items())


def outline(name: str) -> tuple[int, str]:
    """Return a family's number of training tasks and its first sentence, without importing families of mtjax."""
    place, settings = ENVS.data[name]
    if isinstance(place, str):
        module, _, cls = place.partition(":")
        count, text = variation.count_tasks(settings), _documented(module)[cls]
    else:
        count, text = make(name).train_count, place.__doc__ or ""
    return count, first_sentence(text).split(" (")[0]


@lru_cache
def _documented(module: str) -> dict[str, str]:
    """Return the docstrings of a module's classes, read from its file without importing it."""
    spec = find_spec(module)
    assert spec is not None and spec.loader is not None
    tree = ast.parse(spec.loader.get_source(module))  # type: ignore
    return {node.name: ast.get_docstring(node) or "" for node in tree.body if isinstance(node, ast.ClassDef)}
