"""Environment families by name. To add one: a file for its domain, and a line here."""

from mtjax.envs.family import Family
from mtjax.envs.finger import FingerSpin
from mtjax.names import frozen, nearest_error

ENVS: dict[str, tuple[type[Family], dict]] = {
    "finger-spin": (FingerSpin, {}),
    "finger-spin-vary-size": (FingerSpin, {"low": 0.95, "high": 1.13, "num_tasks": 10}),
    "finger-spin-vary-touch-size": (FingerSpin, {"vary": "touch-size", "low": 0.025, "high": 0.25, "num_tasks": 10}),
}


def make(name: str, **settings) -> Family:
    """Return the family called ``name``, with any of its fields replaced.

    Raises:
        InputError: no family has that name, no field has one of the given names, or a value is out of range.
    """
    if name not in ENVS:
        raise nearest_error("environment", name, ENVS)
    family, defaults = ENVS[name]
    unknown = next((s for s in settings if s not in family.__dataclass_fields__), None)
    if unknown is not None:
        raise nearest_error(f"setting of {name}", unknown, family.__dataclass_fields__)
    return family(**{**defaults, **frozen(settings)})
