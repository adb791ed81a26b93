"""The families of a mixture in groups that share a simulator."""

import hashlib
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from mtjax.envs.domain import Domain
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.family import Family
from mtjax.envs.fields import FIXED
from mtjax.envs.merged_simulator import United
from mtjax.envs.physics import DECIDING
from mtjax.envs.scene_bodies import Scene
from mtjax.envs.shared_simulator import Alone, Joined
from mtjax.types import InputError

SCENES = ("auto", "union", "joined", "apart")
Group = Alone | Joined  # and so United
_MOST_DOFS = 32  # of a union: beyond them Warp's matrices are sparse, and its factorisation takes several blocks


def grouped(families: Sequence[Family], scenes: str = "auto") -> tuple[Group, ...]:
    """Return all families in groups. Those of one group share a simulator (``Mixture.scenes``)."""
    rest = dict(enumerate(families))
    if scenes == "apart":
        return tuple(Alone({i: family}) for i, family in rest.items())
    united = [group for members in _unions(rest, scenes) for group in _try(United, members)]
    for group in united:
        rest = {i: family for i, family in rest.items() if i not in group.members}
    alike: dict[Any, dict[int, Any]] = {}
    for i, family in rest.items():
        found = structure(family)
        alike.setdefault(i if found is None else found, {})[i] = family
    alone = lambda members: [Alone({i: family}) for i, family in members.items()]
    joined = [group for members in alike.values() for group in _try(Joined, members) or alone(members)]
    return *united, *joined


def structure(family: Family) -> tuple[Any, ...] | None:
    """Return what families must have in common for one engine to step all of them; None for one that stays alone.

    Their models may differ in numbers only, as those of tasks.
    """
    if not isinstance(family, Domain) or family.repeat != 1:  # which is more than control, physics and outcome
        return None
    if type(family).step is not Domain.step or type(family).advance is not Domain.advance:
        return None
    in_c = isinstance(family.simulator, MujocoC)
    model: Any = family.models[0] if in_c else family.simulator.base  # type: ignore
    fixed = hashlib.sha256()
    for name in FIXED:
        field = np.asarray(attrgetter(name)(model))
        fixed.update(repr((name, field.shape)).encode() + field.tobytes())
    if not in_c:
        fixed.update(repr([np.asarray(attrgetter(path)(model) > 0).tolist() for path in DECIDING]).encode())
    return family.engine_name, family.num_substeps, fixed.digest()


def _try(kind: type[Joined], members: Mapping[int, Any]) -> list[Group]:
    """Return the group of several families; nothing if they cannot be one, or if there is one family only."""
    try:
        return [kind(members)] if len(members) > 1 else []
    except InputError:  # the engine has one value of a field in which they differ
        return []


def _unions(families: Mapping[int, Family], scenes: str) -> list[dict[int, Domain]]:
    """Return the families of each union: some that have the same frame, as many as it has room for."""
    alike: dict[Any, dict[int, tuple[Domain, Scene]]] = {}
    for i, family in families.items():
        if isinstance(family, Domain) and _may_unite(family, scenes):
            scene = Scene(family.models[0])
            try:
                _ = scene.sensors
                alike.setdefault((_settings(family), scene.frame), {})[i] = family, scene
            except InputError:  # the scene stays by itself
                continue
    unions = [members for candidates in alike.values() for members in _shared_out(candidates)]
    return [members for members in unions if len({structure(family) for family in members.values()}) > 1]


def _may_unite(family: Domain, scenes: str) -> bool:
    """Return whether a domain's scene may be part of a union: its tasks differ in nothing but places of bodies."""
    asked = scenes == "union" or (scenes == "auto" and family.engine_name == "warp")
    able = family.unites and family.engine_name in ("c", "warp") and structure(family) is not None
    return asked and able and set(family.table.tasks.model) <= {"body_pos"}


def _settings(family: Domain) -> Any:
    """Return the settings of physics that all domains of a union have in common."""
    return (
        family.engine_name,
        family.num_substeps,
        family.solver_iterations or family.warp_iterations,
        family.integrator,
    )


def _shared_out(candidates: Mapping[int, tuple[Domain, Scene]]) -> list[dict[int, Domain]]:
    """Share families out among unions, each into the one that grows least by it."""
    unions: list[tuple[dict[int, Domain], dict[bytes, int]]] = []
    for i, (family, scene) in candidates.items():
        dofs = {kind: len(subtree.parts["dof"]) for kind, subtree in scene.subtrees.items()}
        sizes = [sum((held | dofs).values()) for _, held in unions]
        more = {j: size - sum(unions[j][1].values()) for j, size in enumerate(sizes) if size <= _MOST_DOFS}
        if not more:
            unions.append(({}, {}))
        members, held = unions[min(more, key=more.__getitem__) if more else -1]
        members[i] = family
        held |= dofs
    return [members for members, _ in unions]
