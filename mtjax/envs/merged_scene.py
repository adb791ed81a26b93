"""One scene with the things of several scenes, and the places of each scene's numbers in it.

Scenes share the things of one kind (``things``). So the arm and the table are there once, and two tasks with the same
door have one door. A world uses the things of its own scene. All others are parked: far away, and far from each other.
"""

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.domain import Domain
from mtjax.envs.scene_bodies import Scene, Sensor, Thing
from mtjax.types import InputError

_FAR = 10.0  # [m] between parked things, and from the world's middle


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
        InputError: MuJoCo compiles a thing to other numbers in the union than in its own scene.
    """
    scenes = [Scene(family.models[0]) for family in families]
    spec, kinds = _gather(families, scenes)
    union = Scene(spec.copy().compile())
    if list(union.things) != kinds or union.frame != scenes[0].frame:
        raise InputError("a thing is another one in the union than in its own scene")
    sensors = list(dict.fromkeys(sensor for scene in scenes for sensor in scene.sensors))
    for sensor in sensors:
        _add_sensor(spec, union, sensor)
    for pair in combinations(kinds, 2):
        if not any(scene.things.keys() >= set(pair) for scene in scenes):
            _keep_apart(spec, union.model, *(union.things[kind] for kind in pair))
    whole = Scene(spec.compile())
    begins = dict(zip(sensors, whole.model.sensor_adr.tolist(), strict=True))
    return Union(whole.model, *_park(whole), tuple(_places(scene, whole, begins) for scene in scenes))


def _gather(families: Sequence[Domain], scenes: Sequence[Scene]) -> tuple[mujoco.MjSpec, list[bytes]]:
    """Return the first scene with all further kinds of things of the others, and the kinds in order."""
    spec, kinds = _bare(families[0]), list(scenes[0].things)
    for number, (family, scene) in enumerate(zip(families, scenes, strict=True)):
        new = [kind for kind in scene.things if kind not in kinds]
        own = _bare(family) if new else None  # kept here, as MuJoCo's bodies are gone with their spec
        bodies = dict(zip(scene.things, own.worldbody.bodies, strict=True)) if own else {}
        for kind in new:
            spec.worldbody.add_frame().attach_body(bodies[kind], f"{number}/", "")
        kinds += new
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:  # each scene brings all of its own
        spec.delete(mesh)
    return spec, kinds


def _bare(family: Domain) -> mujoco.MjSpec:
    """Return a family's editable scene without its sensors. All bodies have names."""
    spec = family.compile_spec()
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body {i}"
    for sensor in spec.sensors:
        spec.delete(sensor)
    return spec


def _add_sensor(spec: mujoco.MjSpec, union: Scene, sensor: Sensor) -> None:
    """Add a sensor of a part of the union, which may refer to another part."""
    added = spec.add_sensor(type=sensor.kind, intprm=list(sensor.integers), cutoff=sensor.cutoff)
    added.objtype, added.objname = sensor.of[0], union.name(*sensor.of)
    if sensor.relative_to is not None:
        added.reftype, added.refname = sensor.relative_to[0], union.name(*sensor.relative_to)


def _keep_apart(spec: mujoco.MjSpec, model: mujoco.MjModel, *things: Thing) -> None:
    """Exclude contacts of two things that no scene has both of, so that engines need not look for them."""
    solid = [[model.body(i).name for i in thing.parts["body"] if model.body_geomnum[i]] for thing in things]
    for one, other in product(*solid):
        spec.add_exclude(bodyname1=one, bodyname2=other)


def _park(union: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Put all things far away, and return their positions (nq,) and accelerations (nv,) there."""
    model, qpos = union.model, union.model.qpos0.copy()
    for i, thing in enumerate(union.things.values(), 1):
        place = [_FAR * i, 0, _FAR]
        model.body_pos[thing.parts["body"][0]] = place
        if thing.free:
            qpos[thing.parts["qpos"][:3]] = place
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return qpos, data.qacc.copy()


def _places(scene: Scene, union: Scene, begins: dict[Sensor, int]) -> Places:
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
