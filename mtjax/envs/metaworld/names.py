"""The names of Meta-World's tasks and benchmarks (Yu et al. 2019; McLean et al. 2025), without importing any task."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from mtjax.names import InputError, nearest_error

TASKS = {  # name -> "module:Class", in Meta-World's order, in which goals are drawn
    "assembly": "assembly:Assembly",
    "basketball": "basketball:Basketball",
    "bin-picking": "bin:BinPicking",
    "box-close": "box:BoxClose",
    "button-press-topdown": "button:ButtonPressTopdown",
    "button-press-topdown-wall": "button:ButtonPressTopdownWall",
    "button-press": "button:ButtonPress",
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
    "hand-insert": "hole:HandInsert",
    "drawer-close": "drawer:DrawerClose",
    "drawer-open": "drawer:DrawerOpen",
    "faucet-open": "faucet:FaucetOpen",
    "faucet-close": "faucet:FaucetClose",
    "hammer": "hammer:Hammer",
    "handle-press-side": "handle:HandlePressSide",
    "handle-press": "handle:HandlePress",
    "handle-pull-side": "handle:HandlePullSide",
    "handle-pull": "handle:HandlePull",
    "lever-pull": "lever:LeverPull",
    "pick-place-wall": "pick_place:PickPlaceWall",
    "pick-out-of-hole": "hole:PickOutOfHole",
    "pick-place": "pick_place:PickPlace",
    "plate-slide": "plate:PlateSlide",
    "plate-slide-side": "plate:PlateSlideSide",
    "plate-slide-back": "plate:PlateSlideBack",
    "plate-slide-back-side": "plate:PlateSlideBackSide",
    "peg-insert-side": "peg:PegInsertSide",
    "peg-unplug-side": "peg:PegUnplugSide",
    "soccer": "soccer:Soccer",
    "stick-push": "stick:StickPush",
    "stick-pull": "stick:StickPull",
    "push": "push:Push",
    "push-wall": "push:PushWall",
    "push-back": "push:PushBack",
    "reach": "reach:Reach",
    "reach-wall": "reach:ReachWall",
    "shelf-place": "shelf:ShelfPlace",
    "sweep-into": "sweep:SweepInto",
    "sweep": "sweep:Sweep",
    "window-open": "window:WindowOpen",
    "window-close": "window:WindowClose",
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
_ML45 = """
    assembly basketball button-press-topdown button-press-topdown-wall button-press button-press-wall coffee-button
    coffee-pull coffee-push dial-turn disassemble door-close door-open drawer-close drawer-open faucet-open faucet-close
    hammer handle-press-side handle-press handle-pull-side handle-pull lever-pull pick-place-wall pick-out-of-hole
    push-back pick-place plate-slide plate-slide-side plate-slide-back plate-slide-back-side peg-insert-side
    peg-unplug-side soccer stick-push stick-pull push-wall push reach-wall reach shelf-place sweep-into sweep
    window-open window-close
""".split()
_ML45_TEST = "bin-picking box-close hand-insert door-lock door-unlock".split()
_CW10 = """
    hammer push-wall faucet-close push-back stick-pull handle-press-side push shelf-place window-close peg-unplug-side
""".split()


class Benchmark(NamedTuple):
    """Holds the tasks of a benchmark, in the order in which goals are drawn."""

    says: str
    train: Sequence[str]
    test: Sequence[str] = ()
    goal_hidden: bool = False

    def families(self, name: str) -> dict[str, dict[str, Any]]:
        """Return every family's settings. Tasks of ``test`` are held out."""
        common = {"benchmark": name} | ({"goal_hidden": True} if self.goal_hidden else {})
        found = {f"metaworld-{task}": common for task in self.train}
        return found | {f"metaworld-{task}": common | {"held_out": True} for task in self.test}


_LISTED = {
    "mt10": Benchmark("Ten tasks of Meta-World at once", _MT10),
    "mt25": Benchmark("Twenty-five tasks of Meta-World at once", _MT25),
    "mt50": Benchmark("All fifty tasks of Meta-World at once", [*TASKS]),
    "cw10": Benchmark("The ten tasks of Continual World in its order, with V2 rewards, all at once", _CW10),
    "ml10": Benchmark(
        "Ten tasks of Meta-World with hidden goals; five more are held out (split extrapolation)",
        _ML10,
        _ML10_TEST,
        goal_hidden=True,
    ),
    "ml45": Benchmark(
        "Forty-five tasks of Meta-World with hidden goals; five more are held out (split extrapolation)",
        _ML45,
        _ML45_TEST,
        goal_hidden=True,
    ),
}
BENCHMARKS: dict[str, tuple[str, dict[str, dict[str, Any]]]] = {  # name -> what it is, and family -> its settings
    name: (listed.says, listed.families(name)) for name, listed in _LISTED.items()
}


def listed_with(benchmark: str, task: str) -> Sequence[str]:
    """Return the tasks of a benchmark whose goals one stream draws: its training tasks, or its test tasks.

    Raises:
        InputError: there is no such benchmark, or it does not have the task.
    """
    if benchmark not in _LISTED:
        raise nearest_error("benchmark", benchmark, _LISTED)
    found = next((part for part in (_LISTED[benchmark].train, _LISTED[benchmark].test) if task in part), None)
    if found is None:
        raise InputError(f"{benchmark} does not have the task {task}")
    return found
