"""One scene with the subtrees of several scenes, and the places of each scene's numbers in it.

Scenes share the subtrees of one kind (``subtrees``). So the arm and the table are there once, and two tasks with the
same door have one door. A world uses the subtrees of its own scene. All others are parked: far away, and far from each
other.
"""

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.domain import Domain
from mtjax.envs.scene_bodies import Scene, Sensor, Subtree
from mtjax.types import InputError

_FAR = 10.0  # [m] between parked subtrees, and from the world's middle


class Places(NamedTuple):
    """Where the numbers of one scene are in the union."""

    qpos: np.ndarray  # (nq,)
    qvel: np.ndarray  # (nv,)
    bodies: np.ndarray  # (nbody,)
    sensors: np.ndarray  # (nsensordata,)


class Union(NamedTuple):
    """A model in which all subtrees are parked, and the places of each scene in it."""

    model: mujoco.MjModel
    qpos: np.ndarray  # (nq,) of parked subtrees
    warmstart: np.ndarray  # (nv,) of parked subtrees, which fall freely
    places: tuple[Places, ...]  # of each family


def compose(families: Sequence[Domain]) -> Union:
    """Compose the union of families' scenes that have the same ``Scene.frame``.

    Raises:
        InputError: MuJoCo compiles a subtree to other numbers in the union than in its own scene.
    """
    scenes = [Scene(family.models[0]) for family in families]
    spec, kinds = _gather(families, scenes)
    union = Scene(spec.copy().compile())
    if list(union.subtrees) != kinds or union.frame != scenes[0].frame:
        raise InputError("a subtree is another one in the union than in its own scene")
    sensors = list(dict.fromkeys(sensor for scene in scenes for sensor in scene.sensors))
    for sensor in sensors:
        _add_sensor(spec, union, sensor)
    for pair in combinations(kinds, 2):
        if not any(scene.subtrees.keys() >= set(pair) for scene in scenes):
            _keep_apart(spec, union.model, *(union.subtrees[kind] for kind in pair))
    whole = Scene(spec.compile())
    begins = dict(zip(sensors, whole.model.sensor_adr.tolist(), strict=True))
    return Union(whole.model, *_park(whole), tuple(_places(scene, whole, begins) for scene in scenes))


def _gather(families: Sequence[Domain], scenes: Sequence[Scene]) -> tuple[mujoco.MjSpec, list[bytes]]:
    """Return the first scene with all further kinds of subtrees of the others, and the kinds in order."""
    spec, kinds = _bare(families[0]), list(scenes[0].subtrees)
    for number, (family, scene) in enumerate(zip(families, scenes, strict=True)):
        new = [kind for kind in scene.subtrees if kind not in kinds]
        own = _bare(family) if new else None  # kept here, as MuJoCo's bodies are gone with their spec
        bodies = dict(zip(scene.subtrees, own.worldbody.bodies, strict=True)) if own else {}
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


def _keep_apart(spec: mujoco.MjSpec, model: mujoco.MjModel, *subtrees: Subtree) -> None:
    """Exclude contacts of two subtrees that no scene has both of, so that engines need not look for them."""
    solid = [[model.body(i).name for i in subtree.parts["body"] if model.body_geomnum[i]] for subtree in subtrees]
    for one, other in product(*solid):
        spec.add_exclude(bodyname1=one, bodyname2=other)


def _park(union: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Put all subtrees far away, and return their positions (nq,) and accelerations (nv,) there."""
    model, qpos = union.model, union.model.qpos0.copy()
    for i, subtree in enumerate(union.subtrees.values(), 1):
        place = [_FAR * i, 0, _FAR]
        model.body_pos[subtree.parts["body"][0]] = place
        if subtree.free:
            qpos[subtree.parts["qpos"][:3]] = place
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return qpos, data.qacc.copy()


def _places(scene: Scene, union: Scene, begins: dict[Sensor, int]) -> Places:
    """Return where a scene's numbers are in the union."""

    def places(part: str, size: int) -> np.ndarray:
        found = np.zeros(size, int)
        for kind, subtree in scene.subtrees.items():
            found[subtree.parts[part]] = union.subtrees[kind].parts[part]
        return found

    model = scene.model
    sizes = zip(scene.sensors, model.sensor_dim, strict=True)
    sensors = [begins[sensor] + np.arange(size) for sensor, size in sizes]
    own = places("qpos", model.nq), places("dof", model.nv), places("body", model.nbody)
    return Places(*own, np.concatenate([np.zeros(0, int), *sensors]))
