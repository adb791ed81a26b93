"""Environment families by name. To add one: a file for its domain, and a line here; or ``register`` your own."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from mtjax.envs.brax import NAMES, Brax, BraxAntDirection, BraxHalfcheetahSpeed
from mtjax.envs.dm_control.acrobot import AcrobotSwingup
from mtjax.envs.dm_control.ball_in_cup import BallInCup
from mtjax.envs.dm_control.cartpole import CartpoleBalance, CartpoleSwingup
from mtjax.envs.dm_control.cheetah import CheetahDirection, CheetahRun, CheetahSpeed
from mtjax.envs.dm_control.finger import FingerSpin, FingerTurn, FingerTurnTarget
from mtjax.envs.dm_control.hopper import HopperHop, HopperStand
from mtjax.envs.dm_control.pendulum import PendulumSwingup
from mtjax.envs.dm_control.point_mass import PointMass, PointMassNavigate
from mtjax.envs.dm_control.reacher import Reacher, ReacherTarget
from mtjax.envs.dm_control.walker import WalkerRun, WalkerSpeed, WalkerStand, WalkerWalk
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.family import Family, Tabled
from mtjax.envs.mixture import Mixture
from mtjax.envs.mtenv.control import ACROBOT_RANGES, CARTPOLE_RANGES, Acrobot, CartPole
from mtjax.envs.mtenv.maze import TwoGoalMaze
from mtjax.envs.mtenv.tabular import Bandit, TabularMDP
from mtjax.envs.parameters import Parameter
from mtjax.names import frozen, nearest_error
from mtjax.types import InputError

__all__ = ["ENVS", "Domain", "Family", "Mixture", "Parameter", "Tabled", "World", "make", "mixture", "register"]

Entry = tuple[type[Family], dict[str, Any]]

# dm_control's tasks (Tassa et al. 2018), with whatever parameters are asked for.
_DOMAINS: dict[str, Entry] = {
    "acrobot-swingup": (AcrobotSwingup, {}),
    "acrobot-swingup-sparse": (AcrobotSwingup, {"sparse": True}),
    "ball-in-cup-catch": (BallInCup, {}),
    "cartpole-balance": (CartpoleBalance, {}),
    "cartpole-balance-sparse": (CartpoleBalance, {"sparse": True}),
    "cartpole-swingup": (CartpoleSwingup, {}),
    "cartpole-swingup-sparse": (CartpoleSwingup, {"sparse": True}),
    "cheetah-run": (CheetahRun, {}),
    "finger-spin": (FingerSpin, {}),
    "finger-turn-easy": (FingerTurn, {}),
    "finger-turn-hard": (FingerTurn, {"vary": {"target-size": "0.03"}}),
    "hopper-hop": (HopperHop, {}),
    "hopper-stand": (HopperStand, {}),
    "pendulum-swingup": (PendulumSwingup, {}),
    "point-mass-easy": (PointMass, {}),
    "reacher-easy": (Reacher, {}),
    "reacher-hard": (Reacher, {"vary": {"target-size": "0.015"}}),
    "walker-run": (WalkerRun, {}),
    "walker-stand": (WalkerStand, {}),
    "walker-walk": (WalkerWalk, {}),
}

# HiP-BMDP's families (Zhang et al. 2021) with the values of MTEnv's models; `--split=hip-bmdp` for its held-out tasks.
_HIP_BMDP: dict[str, Entry] = {
    "cartpole-swingup-vary-cart-mass": (CartpoleSwingup, {"vary": {"cart-mass": "1:5.5:10"}}),
    "cartpole-swingup-vary-pole-mass": (CartpoleSwingup, {"vary": {"pole-mass": "0.1:0.55:10"}}),
    "cheetah-run-vary-back-foot-length": (CheetahRun, {"vary": {"back-foot-length": "0.094:0.184:10"}}),
    "cheetah-run-vary-foot-position": (
        CheetahRun,
        {"vary": {"foot-position": "0.5,0.48,0.46,0.44,0.42,0.4,0.38,0.36,0.34,0.32"}},
    ),
    "cheetah-run-vary-foot-size": (
        CheetahRun,
        {"vary": {"foot-size": "0.046,0.0552,0.0598,0.0644,0.069,0.0736,0.0782,0.0828,0.0874,0.092"}},
    ),
    "cheetah-run-vary-torso-length": (CheetahRun, {"vary": {"torso-length": "0.5:1.4:10"}}),
    "finger-spin-vary-size": (FingerSpin, {"vary": {"size": "0.95:1.13:10"}}),
    "finger-spin-vary-touch-size": (FingerSpin, {"vary": {"touch-size": "0.025:0.25:10"}}),
    "walker-run-vary-foot-length": (WalkerRun, {"vary": {"foot-length": "0.08:0.17:10"}}),
    "walker-run-vary-friction": (WalkerRun, {"vary": {"friction": "0.7:1.6:10"}}),
    "walker-walk-vary-foot-length": (WalkerWalk, {"vary": {"foot-length": "0.08:0.17:10"}}),
    "walker-walk-vary-friction": (WalkerWalk, {"vary": {"friction": "0.7:1.6:10"}}),
}

_GOALS: dict[str, Entry] = {
    "cheetah-run-vary-speed": (CheetahSpeed, {"vary": {"speed": "1:5.5:10"}}),
    "cheetah-vary-direction": (CheetahDirection, {"vary": {"direction": "-1,1"}, "split": "none"}),
    "finger-turn-vary-target": (FingerTurnTarget, {"vary": {"target-angle": "-2:2:10"}}),
    "point-mass-vary-goal": (
        PointMassNavigate,
        {"vary": {"goal-x": "-0.2:0.2", "goal-y": "-0.2:0.2"}, "combine": "random"},
    ),
    "reacher-vary-goal": (ReacherTarget, {"vary": {"target-angle": "-2:2:10"}}),
    "walker-vary-speed": (WalkerSpeed, {"vary": {"speed": "0.5:5:10"}}),
}

_MTENV: dict[str, Entry] = {
    "bandit": (Bandit, {}),
    "control-acrobot": (Acrobot, {"vary": ACROBOT_RANGES, "combine": "random"}),
    "control-cartpole": (CartPole, {"vary": CARTPOLE_RANGES, "combine": "random"}),
    "tabular-mdp": (TabularMDP, {}),
    "two-goal-maze": (TwoGoalMaze, {"vary": {"goal-box": "0,1"}, "split": "none"}),
    "two-goal-maze-seen": (TwoGoalMaze, {"vary": {"goal-box": "0,1"}, "split": "none", "observe_boxes": True}),
}

_BRAX: dict[str, Entry] = {
    **{f"brax-{name.replace('_', '-')}": (Brax, {"environment": name}) for name in NAMES},
    "brax-ant-vary-direction": (BraxAntDirection, {"vary": {"direction": "-2:2:10"}}),
    "brax-halfcheetah-vary-speed": (BraxHalfcheetahSpeed, {"vary": {"speed": "0.3:3:10"}}),
}

ENVS: dict[str, Entry] = {**_DOMAINS, **_HIP_BMDP, **_GOALS, **_MTENV, **_BRAX}


def make(name: str, vary: Mapping[str, Any] | tuple = (), **settings: Any) -> Any:
    """Return the family called ``name``, or the mixture of "NAME+NAME", with any of its fields replaced.

    Args:
        vary: values of parameters, {"mass": "0.5:1.5:10"}, beside those that the family varies by itself; a parameter
            given a single value no longer varies. In a mixture {"NAME.mass": ...} says of which family.
        settings: fields of the family; in a mixture, of every family that has such a field.

    Raises:
        InputError: no family has that name, no field has one of the given names, or a value is out of range.
    """
    if "+" in name:
        return _make_mixture(tuple(name.split("+")), dict(vary), dict(settings))
    if name not in ENVS:
        raise nearest_error("environment", name, ENVS)
    family, defaults = ENVS[name]
    fields = family.__dataclass_fields__
    unknown = next((s for s in (*settings, *defaults) if s not in fields), None)
    if unknown is not None:
        raise nearest_error(f"setting of {name}", unknown, fields)
    settings = defaults | frozen(settings)
    return family(**{**settings, "vary": dict(defaults.get("vary", {})) | dict(vary)})


def mixture(families: Sequence[str | Family | Mixture]) -> Mixture:
    """Return a mixture of families, each by its name or as ``make`` returned it.

    Families may share a model, or a name, as long as their tasks are not the same: a walker whose friction varies and
    one whose feet do make a mixture of two families.

    Raises:
        InputError: no family has a name, or one is in the mixture twice.
    """
    named: list[tuple[str, Family]] = []
    for given in families:
        found = make(given) if isinstance(given, str) else given
        if isinstance(found, Mixture):
            named += zip(found.names, found.families, strict=True)
        else:
            named.append((given if isinstance(given, str) else _name_of(found), found))
    names: list[str] = []
    for name, _ in named:
        again = sum(other == name or other.startswith(f"{name}#") for other in names)
        names.append(f"{name}#{again + 1}" if again else name)
    return Mixture(tuple(family for _, family in named), tuple(names))


def _name_of(family: Any) -> str:
    """The name under which ``make`` knows a family, whatever else it varies; or that of its class."""
    known = [name for name, (cls, _) in ENVS.items() if cls is type(family)]
    exact = [name for name in known if make(name) == family]
    plain = [name for name in known if not ENVS[name][1]]
    of_class = re.sub(r"(?<!^)(?=[A-Z])", "-", type(family).__name__).lower()
    return next(iter((*exact, *plain, *known)), of_class)


def _make_mixture(names: tuple[str, ...], vary: dict[str, Any], settings: dict[str, Any]) -> Mixture:
    """Make the families of a mixture by their names, with values of their parameters by "NAME.PARAMETER"."""
    recorded = settings.pop("families", None)
    if recorded is not None:  # of config.json
        return Mixture(tuple(make(n, **each) for n, each in zip(names, recorded, strict=True)), names)
    plain = [make(name) for name in names]
    for given in settings:
        known = dict.fromkeys(field for family in plain for field in family.__dataclass_fields__)
        if given not in known:
            raise nearest_error("setting of these families", given, known)
    own: dict[str, dict[str, Any]] = {name: {} for name in names}
    for given, values in vary.items():
        name, dot, parameter = given.rpartition(".")
        if not dot or name not in own:
            raise InputError(
                f"in a mixture, say which family's {parameter} varies: one of "
                f"{', '.join(f'{known}.{parameter}' for known in own)}; not {given}"
            )
        own[name][parameter] = values
    made = []
    for name, family in zip(names, plain, strict=True):
        mine = {key: value for key, value in settings.items() if key in family.__dataclass_fields__}
        made.append(make(name, vary=own[name], **mine))
    return Mixture(tuple(made), names)


def register(name: str, family: type[Family], **settings: Any) -> None:
    """Give a family of your own a name, under which ``make``, the command line and notebooks know it.

    Args:
        family: a frozen dataclass, a subclass of ``Domain`` (an MJCF file, parameters, observation and reward) or of
            ``Family`` (anything that steps in JAX).
        settings: values of its fields, such as ``vary={"mass": "0.5:2:10"}``.

    Raises:
        InputError: the name is taken, or a value is out of range.
    """
    if name in ENVS:
        raise InputError(f"there is an environment {name!r} already; choose another name")
    ENVS[name] = (family, settings)
    try:
        make(name)
    except InputError:
        del ENVS[name]
        raise
