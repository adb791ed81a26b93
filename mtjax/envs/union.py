"""One scene with the things of several, and the places of each scene's numbers in it.

A thing is a body of the world with all that hangs on it. Scenes share a thing if its numbers are equal in them, wherever
it stands. So the arm and the table are there once, and two tasks with the same door have one door. A world uses the
things of its own scene. All others are parked: far away, and far from each other.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import combinations, product
from operator import attrgetter
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.domain import Domain
from mtjax.envs.fields import FIXED, VARIABLE
from mtjax.types import InputError

FAR = 10.0  # [m] between parked things, and from the world's middle
_REFERENCES = ("actuator_trnid", "eq_obj1id", "eq_obj2id")  # numbers of things, which scenes count each in its own way
_of = lambda names, *firsts: [name for name in names if name.replace(".", "_").split("_")[0] in firsts]
_NUMBERS = [name for name in _of(VARIABLE, "body", "jnt", "dof", "geom", "site") if name != "geom_matid"]
_STRUCTURE = """
    body_jntnum body_dofnum body_geomnum jnt_type jnt_limited jnt_actfrclimited jnt_actgravcomp geom_type geom_contype
    geom_conaffinity geom_condim geom_group geom_priority site_type
""".split()
_COMMON = [name for name in _of(FIXED + VARIABLE, "opt", "actuator", "eq") if name not in _REFERENCES]
_STRANGE = ("ntendon", "npair", "nexclude", "nflex", "nhfield", "nkey", "na")  # what the union does not carry over
_PARTS = {  # the kinds of MuJoCo's objects that belong to things
    int(mujoco.mjtObj.mjOBJ_BODY): "body",
    int(mujoco.mjtObj.mjOBJ_XBODY): "body",
    int(mujoco.mjtObj.mjOBJ_JOINT): "jnt",
    int(mujoco.mjtObj.mjOBJ_GEOM): "geom",
    int(mujoco.mjtObj.mjOBJ_SITE): "site",
}
Address = tuple[bytes, int]  # a thing's kind, and a part's number among those of the thing


class Thing(NamedTuple):
    """A body of the world and all that hangs on it, in one scene."""

    kind: bytes  # equal for things that differ in nothing but their place
    parts: dict[str, np.ndarray]  # "body", "jnt", "dof", "geom", "site", "qpos" -> their numbers in the scene


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene and its things."""

    model: mujoco.MjModel

    @cached_property
    def things(self) -> dict[bytes, Thing]:
        """Return the things by kind, in the order of their bodies. Further ones of a kind count as other kinds."""
        found: dict[bytes, Thing] = {}
        for body in np.flatnonzero(self.model.body_parentid[1:] == 0) + 1:
            parts = _parts(self.model, body)
            kind = _kind(self.model, parts)
            while kind in found:
                kind += b"again"
            found[kind] = Thing(kind, parts)
        return found

    @cached_property
    def frame(self) -> tuple[bytes, ...]:
        """Return what scenes of one union must have in common.

        These are options, motors, welds, bodies that a domain moves, the things that all of these belong to, and the
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
        floor = _fields(model, _parts(model, 0), [name for name in (*_NUMBERS, *_STRUCTURE) if name.startswith("geom_")])
        common = {name: attrgetter(name)(model) for name in _COMMON}
        return _bytes(floor), _bytes(common), repr(held).encode()

    def address(self, part: str, number: int) -> Address:
        """Return where a part of a thing is.

        Raises:
            InputError: it belongs to the world's own body.
        """
        for thing in self.things.values():
            if number in thing.parts[part]:
                return thing.kind, int(number - thing.parts[part][0])
        raise InputError(f"{part} {number} of a scene is part of no thing in it")

    def number(self, part: str, address: Address) -> int:
        """Return a part's number in this scene."""
        kind, among = address
        return int(self.things[kind].parts[part][among])

    @cached_property
    def sensors(self) -> list[tuple]:
        """Return the kinds of sensors, what they read and refer to, and their parameters."""
        model = self.model
        one = lambda i: (
            int(model.sensor_type[i]),
            self._object(model.sensor_objtype[i], model.sensor_objid[i]),
            self._object(model.sensor_reftype[i], model.sensor_refid[i]),
            tuple(model.sensor_intprm[i].tolist()),
            float(model.sensor_cutoff[i]),
        )
        return [one(i) for i in range(model.nsensor)]

    def _object(self, kind: int, number: int) -> tuple[int, Address] | None:
        if kind == mujoco.mjtObj.mjOBJ_UNKNOWN:
            return None
        if kind not in _PARTS:
            raise InputError("a scene with sensors of other things than bodies, joints, geoms and sites stays by itself")
        return int(kind), self.address(_PARTS[kind], number)


class Places(NamedTuple):
    """Where the numbers of one scene are in the union."""

    qpos: np.ndarray  # (nq,)
    qvel: np.ndarray  # (nv,)
    bodies: np.ndarray  # (nbody,)
    sensors: np.ndarray  # (nsensordata,)


class Union(NamedTuple):
    """A model in which all things are parked, and the places of each scene in it."""

    model: mujoco.MjModel
    qpos: np.ndarray  # (nq,) of parked things
    warmstart: np.ndarray  # (nv,) of parked things, which fall freely
    places: tuple[Places, ...]  # of each family


def compose(families: Sequence[Domain]) -> Union:
    """Compose the union of families' scenes that have the same ``Scene.frame``.

    Raises:
        InputError: MuJoCo makes something else of a thing in the union than in its own scene.
    """
    scenes = [Scene(family.models[0]) for family in families]
    spec, kinds = _bare(families[0]), list(scenes[0].things)
    for number, (family, scene) in enumerate(zip(families, scenes, strict=True)):
        new = [kind for kind in scene.things if kind not in kinds]
        other = _bare(family) if new else None  # MuJoCo's bodies are gone with their spec
        bodies = dict(zip(scene.things, other.worldbody.bodies, strict=True)) if other else {}
        for kind in new:
            spec.worldbody.add_frame().attach_body(bodies[kind], f"{number}/", "")
        kinds += new
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:  # each scene brings all of its own
        spec.delete(mesh)
    union = Scene(spec.copy().compile())
    if list(union.things) != kinds or union.frame != scenes[0].frame:
        raise InputError("a thing is another one in the union than in its own scene")
    sensors = list(dict.fromkeys(sensor for scene in scenes for sensor in scene.sensors))
    for sensor in sensors:
        _add_sensor(spec, union, *sensor)
    for one, other in combinations(kinds, 2):
        if not any(one in scene.things and other in scene.things for scene in scenes):
            _keep_apart(spec, union, union.things[one], union.things[other])
    whole = Scene(spec.compile())
    begins = dict(zip(sensors, whole.model.sensor_adr.tolist(), strict=True))
    return Union(whole.model, *_park(whole), tuple(_places(scene, whole, begins) for scene in scenes))


def _bare(family: Domain) -> mujoco.MjSpec:
    """Return a family's editable scene without its sensors. All bodies have names."""
    spec = family.compile_spec()
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body {i}"
    for sensor in spec.sensors:
        spec.delete(sensor)
    return spec


def _add_sensor(spec: mujoco.MjSpec, union: Scene, kind: int, of: tuple, to: tuple | None, given: tuple, cut: float):
    """Add a sensor of a part of the union, which may refer to another part."""
    name = lambda known: mujoco.mj_id2name(union.model, known[0], union.number(_PARTS[known[0]], known[1]))
    sensor = spec.add_sensor(type=kind, intprm=list(given), cutoff=cut, objtype=of[0], objname=name(of))
    if to is not None:
        sensor.reftype, sensor.refname = to[0], name(to)


def _keep_apart(spec: mujoco.MjSpec, union: Scene, *things: Thing) -> None:
    """Exclude contacts of two things that no scene has both of, so that engines need not look for them."""
    solid = [[body for body in thing.parts["body"] if union.model.body_geomnum[body]] for thing in things]
    for one, other in product(*solid):
        spec.add_exclude(bodyname1=union.model.body(one).name, bodyname2=union.model.body(other).name)


def _park(union: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Put all things far away; return positions (nq,) and accelerations (nv,) of the free and of the hinged ones."""
    model, qpos = union.model, union.model.qpos0.copy()
    for i, thing in enumerate(union.things.values(), 1):
        place = [FAR * i, 0, FAR]
        model.body_pos[thing.parts["body"][0]] = place
        if _is_free(model, thing.parts):
            qpos[thing.parts["qpos"][:3]] = place
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return qpos, data.qacc.copy()


def _places(scene: Scene, union: Scene, begins: dict[tuple, int]) -> Places:
    """Return where a scene's numbers are in the union."""

    def places(part: str, size: int) -> np.ndarray:
        found = np.zeros(size, int)
        for kind, thing in scene.things.items():
            found[thing.parts[part]] = union.things[kind].parts[part]
        return found

    model = scene.model
    sizes = zip(scene.sensors, model.sensor_dim, strict=True)
    sensors = [begins[sensor] + np.arange(size) for sensor, size in sizes]
    own = places("qpos", model.nq), places("dof", model.nv), places("body", model.nbody)
    return Places(*own, np.concatenate([np.zeros(0, int), *sensors]))


# What belongs to a thing.


def _parts(model: mujoco.MjModel, body: int) -> dict[str, np.ndarray]:
    """Return the numbers of all that belongs to a body of the world, or to the world's own body."""
    owners = {"body": np.arange(model.nbody)}
    owners |= {part: getattr(model, f"{part}_bodyid") for part in ("jnt", "dof", "geom", "site")}
    parts = {part: np.flatnonzero(model.body_rootid[owner] == body) for part, owner in owners.items()}
    ends = np.append(model.jnt_qposadr, model.nq)
    return parts | {"qpos": np.concatenate([np.zeros(0, int), *(np.arange(ends[j], ends[j + 1]) for j in parts["jnt"])])}


def _is_free(model: mujoco.MjModel, parts: dict[str, np.ndarray]) -> bool:
    return mujoco.mjtJoint.mjJNT_FREE in model.jnt_type[parts["jnt"]]


def _kind(model: mujoco.MjModel, parts: dict[str, np.ndarray]) -> bytes:
    """Return all numbers of a thing but its place."""
    body = parts["body"][0]
    fields = _fields(model, parts, (*_NUMBERS, *_STRUCTURE))
    fields |= {name: getattr(model, name)[parts["qpos"]] for name in ("qpos0", "qpos_spring")}
    fields["parents"] = np.maximum(model.body_parentid[parts["body"]] - body, -1)
    fields["body_pos"][0] = 0
    if _is_free(model, parts):
        fields["qpos0"][:3] = fields["qpos_spring"][:3] = 0
    return _bytes(fields)


def _fields(model: mujoco.MjModel, parts: dict[str, np.ndarray], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the numbers of parts in some fields, and the meshes of those that are geoms."""
    fields = {name: getattr(model, name)[parts[name.split("_")[0]]] for name in names}
    for i, geom in enumerate(parts["geom"]):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            begin = mesh.vertadr[0]
            fields[f"mesh {i}"] = model.mesh_vert[begin : begin + mesh.vertnum[0]]
    return fields


def _bytes(fields: dict[str, np.ndarray]) -> bytes:
    return b"".join(name.encode() + np.float32(x).tobytes() for name, x in fields.items())
