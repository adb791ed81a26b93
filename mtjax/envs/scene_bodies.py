"""The subtrees of a scene: the bodies of its world, each with all that hangs on it.

Subtrees of two scenes are of one kind if all their numbers are equal but for the places where they stand.
"""

import dataclasses
import hashlib
from collections.abc import Iterable
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.fields import FIXED, VARIABLE
from mtjax.types import InputError

_REFERENCES = ("actuator_trnid", "eq_obj1id", "eq_obj2id")  # numbers of parts, which every scene counts in its own way
_of = lambda names, *firsts: [name for name in names if name.replace(".", "_").split("_")[0] in firsts]
_NUMBERS = [name for name in _of(VARIABLE, "body", "jnt", "dof", "geom", "site") if name != "geom_matid"]
_STRUCTURE = """
    body_jntnum body_dofnum body_geomnum jnt_type jnt_limited jnt_actfrclimited jnt_actgravcomp geom_type geom_contype
    geom_conaffinity geom_condim geom_group geom_priority geom_fluid site_type
""".split()
_SOLID = _of((*_NUMBERS, *_STRUCTURE), "geom")
_COMMON = [name for name in _of(FIXED + VARIABLE, "opt", "actuator", "eq") if name not in _REFERENCES]
_STRANGE = ("ntendon", "npair", "nexclude", "nflex", "nhfield", "nkey", "na")  # what the union does not carry over
_PARTS = {  # the kinds of MuJoCo's objects that belong to subtrees
    int(mujoco.mjtObj.mjOBJ_BODY): "body",
    int(mujoco.mjtObj.mjOBJ_XBODY): "body",
    int(mujoco.mjtObj.mjOBJ_JOINT): "jnt",
    int(mujoco.mjtObj.mjOBJ_GEOM): "geom",
    int(mujoco.mjtObj.mjOBJ_SITE): "site",
}
Address = tuple[bytes, int]  # a subtree's kind, and a part's number among those of the subtree


class Subtree(NamedTuple):
    """A body of the world and all that hangs on it, in one scene."""

    kind: bytes  # equal for subtrees that differ in nothing but their place
    parts: dict[str, np.ndarray]  # numbers in the scene of its "body", "jnt", "dof", "geom", "site" and "qpos"
    free: bool  # whether it moves without a joint that holds it


class Sensor(NamedTuple):
    """A sensor, told by the subtree and the part that it reads, as their numbers differ between scenes."""

    kind: int
    of: tuple[int, Address]  # the kind of MuJoCo's object, and where it is
    relative_to: tuple[int, Address] | None
    integers: tuple[int, ...]
    cutoff: float


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene and its subtrees."""

    model: mujoco.MjModel

    @cached_property
    def subtrees(self) -> dict[bytes, Subtree]:
        """Return the subtrees by kind, in the order of their bodies. A second one of a kind counts as another kind."""
        found: dict[bytes, Subtree] = {}
        for body in np.flatnonzero(self.model.body_parentid[1:] == 0) + 1:
            parts = _parts(self.model, int(body))
            kind = _kind(self.model, parts)
            while kind in found:
                kind += b"again"
            found[kind] = Subtree(kind, parts, _is_free(self.model, parts))
        return found

    @cached_property
    def frame(self) -> tuple[bytes, ...]:
        """Return what scenes of one union must have in common.

        These are options, motors, welds, bodies that a domain moves, the subtrees that all of these belong to, and the
        geoms of the world's own body, such as a floor.

        Raises:
            InputError: the scene has something that a union cannot have.
        """
        model = self.model
        strange = next((name for name in _STRANGE if getattr(model, name)), None)
        if strange is not None:
            raise InputError(f"a scene with {strange}={getattr(model, strange)} stays by itself")
        bodies = [*model.eq_obj1id, *model.eq_obj2id, *np.flatnonzero(model.body_mocapid >= 0)]
        held = [self.address("body", body) for body in bodies]
        held += [self.address("jnt", joint) for joint in model.actuator_trnid[:, 0]]
        floor = _fields(model, _parts(model, 0), _SOLID)
        common = {name: attrgetter(name)(model) for name in _COMMON}
        return _digest(floor), _digest(common), repr(held).encode()

    def address(self, part: str, number: int) -> Address:
        """Return where a part of a subtree is.

        Raises:
            InputError: it belongs to the world's own body.
        """
        for subtree in self.subtrees.values():
            if number in subtree.parts[part]:
                return subtree.kind, int(number - subtree.parts[part][0])
        raise InputError(f"{part} {number} of a scene is part of no subtree in it")

    def name(self, kind: int, address: Address) -> str:
        """Return the name that a part of a subtree has in this scene, by the kind of MuJoCo's object."""
        subtree, among = address
        return mujoco.mj_id2name(self.model, kind, int(self.subtrees[subtree].parts[_PARTS[kind]][among]))

    @cached_property
    def sensors(self) -> list[Sensor]:
        """Return the sensors.

        Raises:
            InputError: one of them reads something that belongs to no subtree.
        """
        model = self.model
        reads = lambda i: self._object(model.sensor_objtype[i], model.sensor_objid[i])
        refers = lambda i: self._object(model.sensor_reftype[i], model.sensor_refid[i])
        given = lambda i: (tuple(model.sensor_intprm[i].tolist()), float(model.sensor_cutoff[i]))
        return [
            Sensor(int(kind), reads(i), refers(i) if model.sensor_refid[i] >= 0 else None, *given(i))
            for i, kind in enumerate(model.sensor_type)
        ]

    def _object(self, kind: int, number: int) -> tuple[int, Address]:
        if kind not in _PARTS:
            raise InputError("a scene with sensors of other than bodies, joints, geoms and sites stays by itself")
        return int(kind), self.address(_PARTS[kind], number)


def _parts(model: mujoco.MjModel, body: int) -> dict[str, np.ndarray]:
    """Return the numbers of all that belongs to a body of the world, or to the world's own body."""
    owners = {"body": np.arange(model.nbody)}
    owners |= {part: getattr(model, f"{part}_bodyid") for part in ("jnt", "dof", "geom", "site")}
    parts = {part: np.flatnonzero(model.body_rootid[owner] == body) for part, owner in owners.items()}
    ends = np.append(model.jnt_qposadr, model.nq)
    qpos = [np.arange(ends[joint], ends[joint + 1]) for joint in parts["jnt"]]
    return parts | {"qpos": np.concatenate([np.zeros(0, int), *qpos])}


def _is_free(model: mujoco.MjModel, parts: dict[str, np.ndarray]) -> bool:
    return mujoco.mjtJoint.mjJNT_FREE in model.jnt_type[parts["jnt"]]


def _kind(model: mujoco.MjModel, parts: dict[str, np.ndarray]) -> bytes:
    """Return a hash of all numbers of a subtree but its place."""
    body = parts["body"][0]
    fields = _fields(model, parts, (*_NUMBERS, *_STRUCTURE))
    fields |= {name: getattr(model, name)[parts["qpos"]] for name in ("qpos0", "qpos_spring")}
    fields["parents"] = np.maximum(model.body_parentid[parts["body"]] - body, -1)
    fields["body_pos"][0] = 0
    if _is_free(model, parts):
        fields["qpos0"][:3] = fields["qpos_spring"][:3] = 0
    return _digest(fields)


def _fields(model: mujoco.MjModel, parts: dict[str, np.ndarray], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return some fields of a subtree's parts, by name, and the corners of its meshes."""
    fields = {name: getattr(model, name)[parts[name.split("_")[0]]] for name in names}
    for i, geom in enumerate(parts["geom"]):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            begin = mesh.vertadr[0]
            fields[f"mesh {i}"] = model.mesh_vert[begin : begin + mesh.vertnum[0]]
    return fields


def _digest(fields: dict[str, np.ndarray]) -> bytes:
    """Return a hash of fields. The last bits of numbers that MuJoCo derives may depend on the rest of the scene."""
    content = hashlib.sha256()
    for name, field in fields.items():
        rounded = np.float32(field) if np.issubdtype(np.asarray(field).dtype, np.floating) else np.asarray(field)
        content.update(f"{name} {rounded.shape}".encode() + rounded.tobytes())
    return content.digest()
