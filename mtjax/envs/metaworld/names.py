"""The names of Meta-World's tasks and benchmarks (Yu et al. 2019; McLean et al. 2025), without importing any task."""

from collections.abc import Sequence
from typing import Any

TASKS = {  # name -> "module:Class"
    "assembly": "assembly:Assembly",
    "basketball": "basketball:Basketball",
    "bin-picking": "bin:BinPicking",
    "box-close": "box:BoxClose",
    "button-press": "button:ButtonPress",
    "button-press-topdown": "button:ButtonPressTopdown",
    "button-press-topdown-wall": "button:ButtonPressTopdownWall",
    "button-press-wall": "button:ButtonPressWall",
    "coffee-button": "coffee:CoffeeButton",
    "coffee-pull": "coffee:CoffeePull",
    "coffee-push": "coffee:CoffeePush",
    "dial-turn": "dial:DialTurn",
    "disassemble": "assembly:Disassemble",
    "door-close": "door:DoorClose",
    "door-lock": "lock:DoorLock",
    "door-open": "door:DoorOpen",
    "door-unlock": "lock:DoorUnlock",
    "drawer-close": "drawer:DrawerClose",
    "drawer-open": "drawer:DrawerOpen",
    "faucet-close": "faucet:FaucetClose",
    "faucet-open": "faucet:FaucetOpen",
    "hammer": "hammer:Hammer",
    "hand-insert": "hole:HandInsert",
    "handle-press": "handle:HandlePress",
    "handle-press-side": "handle:HandlePressSide",
    "handle-pull": "handle:HandlePull",
    "handle-pull-side": "handle:HandlePullSide",
    "lever-pull": "lever:LeverPull",
    "peg-insert-side": "peg:PegInsertSide",
    "peg-unplug-side": "peg:PegUnplugSide",
    "pick-out-of-hole": "hole:PickOutOfHole",
    "pick-place": "pick_place:PickPlace",
    "pick-place-wall": "pick_place:PickPlaceWall",
    "plate-slide": "plate:PlateSlide",
    "plate-slide-back": "plate:PlateSlideBack",
    "plate-slide-back-side": "plate:PlateSlideBackSide",
    "plate-slide-side": "plate:PlateSlideSide",
    "push": "push:Push",
    "push-back": "push:PushBack",
    "push-wall": "push:PushWall",
    "reach": "reach:Reach",
    "reach-wall": "reach:ReachWall",
    "shelf-place": "shelf:ShelfPlace",
    "soccer": "soccer:Soccer",
    "stick-pull": "stick:StickPull",
    "stick-push": "stick:StickPush",
    "sweep": "sweep:Sweep",
    "sweep-into": "sweep:SweepInto",
    "window-close": "window:WindowClose",
    "window-open": "window:WindowOpen",
}
FAMILIES: dict[str, tuple[str, dict[str, Any]]] = {f"metaworld-{name}": (place, {}) for name, place in TASKS.items()}

_MT10 = """
    reach push pick-place door-open drawer-open drawer-close button-press-topdown peg-insert-side window-open
    window-close
""".split()
_MT25 = (
    _MT10
    + """
    coffee-pull pick-out-of-hole disassemble pick-place-wall basketball stick-pull button-press-wall faucet-open
    door-lock lever-pull sweep-into faucet-close coffee-button button-press-topdown-wall dial-turn
""".split()
)
_ML10 = """
    reach push pick-place door-open drawer-close button-press-topdown peg-insert-side window-open sweep basketball
""".split()
_ML10_TEST = "drawer-open door-close shelf-place sweep-into lever-pull".split()
_ML45_TEST = "bin-picking box-close hand-insert door-lock door-unlock".split()


def _mixed(train: Sequence[str], test: Sequence[str], **settings: Any) -> dict[str, dict[str, Any]]:
    """Return the settings of each family of a benchmark. Tasks of ``test`` are held out."""
    trained = {f"metaworld-{name}": settings for name in train}
    return trained | {f"metaworld-{name}": settings | {"held_out": True} for name in test}


BENCHMARKS: dict[str, tuple[str, dict[str, dict[str, Any]]]] = {  # name -> what it is, and family -> its settings
    "mt10": ("Ten tasks of Meta-World at once", _mixed(_MT10, [])),
    "mt25": ("Twenty-five tasks of Meta-World at once", _mixed(_MT25, [])),
    "mt50": ("All fifty tasks of Meta-World at once", _mixed([*TASKS], [])),
    "ml10": (
        "Ten tasks of Meta-World with hidden goals; five more are held out (split extrapolation)",
        _mixed(_ML10, _ML10_TEST, goal_hidden=True),
    ),
    "ml45": (
        "Forty-five tasks of Meta-World with hidden goals; five more are held out (split extrapolation)",
        _mixed([name for name in TASKS if name not in _ML45_TEST], _ML45_TEST, goal_hidden=True),
    ),
}
