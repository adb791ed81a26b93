"""Meta-World's scenes, read from the files of its package without importing it."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from mtjax.types import InputError

INSTALL = "pip install --no-deps metaworld==3.1.1"
_HAND = ("body:hand", "body:leftclaw", "body:rightclaw", "body:leftpad", "body:rightpad")
_HAND += ("site:leftEndEffector", "site:rightEndEffector")
_EYE, _SEEN = np.array([0.85, 1.35, 0.85]), np.array([0.0, 0.6, 0.08])  # [m] of pictures: camera and middle
_PADS = ("leftpad_geom", "rightpad_geom")
_STRONGEST_FORCE = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 2, 1]  # (3,) of two geoms' contacts, normal first
_KINDS = {
    "body": mujoco.mjtObj.mjOBJ_XBODY,  # the frame of the body, not its centre of mass
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
}


def folder() -> Path:
    """Return the folder with Meta-World's scenes.

    Raises:
        InputError: the package is not installed.
    """
    found = importlib.util.find_spec("metaworld")
    if found is None or not found.submodule_search_locations:
        raise InputError(f"Meta-World's scenes are not installed: {INSTALL}")
    return Path(found.submodule_search_locations[0]) / "assets" / "sawyer_xyz"


def whole(name: str) -> mujoco.MjSpec:
    """Return the editable scene of a task as Meta-World has it.

    Raises:
        InputError: there is no such file.
    """
    path = folder() / f"{name}.xml"
    if not path.is_file():
        raise InputError(f"Meta-World's package has no scene {name}; mtjax reads that of another version: {INSTALL}")
    return mujoco.MjSpec.from_file(str(path))


def pictured(name: str) -> mujoco.MjSpec:
    """Return the editable scene of a task with its meshes and textures, and one camera across the table from the arm.

    Meta-World's own cameras look at the table from above, some upside down, or move with the hand.
    """
    spec = whole(name)
    for camera in spec.cameras:
        spec.delete(camera)
    back = (_EYE - _SEEN) / np.linalg.norm(_EYE - _SEEN)
    right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    spec.worldbody.add_camera(name="eye", pos=_EYE, quat=quat, fovy=45)
    return spec


def read(name: str, watched: Mapping[str, str], pressed: str = "") -> mujoco.MjSpec:
    """Return the editable scene of a task, with sensors of the hand and of what is watched.

    Args:
        name: the scene's file without its ending.
        watched: a short name, and "body:NAME", "site:NAME" or "geom:NAME".
        pressed: a geom, whose contacts with the pads are then felt; or none.
    """
    spec = whole(name)
    weighs = range(spec.compiler.inertiagrouprange[0], spec.compiler.inertiagrouprange[1] + 1)
    _strip(spec, weighs, {place.partition(":")[2] for place in watched.values() if place.startswith("geom:")})
    _shrink(spec, weighs)
    for weld in spec.equalities:
        if weld.type == mujoco.mjtEq.mjEQ_WELD:  # hand and mocap body coincide; torques count five times
            weld.data[:11] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD  # MuJoCo 3.3, which Meta-World has, had no such
    position, turn = mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT
    for place in _HAND:
        add_sensor(spec, position, place.partition(":")[2], place)
    for short, place in watched.items():
        add_sensor(spec, position, f"position:{short}", place)
        add_sensor(spec, turn, f"quat:{short}", place)
    for pad in _PADS if pressed else ():
        contact = spec.add_sensor(name=f"press:{pad}", type=mujoco.mjtSensor.mjSENS_CONTACT, intprm=_STRONGEST_FORCE)
        contact.objtype = contact.reftype = mujoco.mjtObj.mjOBJ_GEOM
        contact.objname, contact.refname = pad, pressed
    return spec


def add_sensor(spec: mujoco.MjSpec, kind: mujoco.mjtSensor, name: str, place: str) -> None:
    """Add a sensor of a place, "body:NAME", "site:NAME" or "geom:NAME"."""
    of, _, thing = place.partition(":")
    spec.add_sensor(name=name, type=kind, objtype=_KINDS[of], objname=thing)


def _strip(spec: mujoco.MjSpec, weighs: range, kept: set[str]) -> None:
    """Delete what physics does not need: geoms that neither collide nor weigh, unused meshes, textures, cameras."""
    for geom in spec.geoms:
        geom.material = ""
        if not (geom.contype or geom.conaffinity or geom.group in weighs or geom.name in kept):
            spec.delete(geom)
    for site in spec.sites:
        site.material = ""
    used = {geom.meshname for geom in spec.geoms}
    unused = [mesh for mesh in spec.meshes if mesh.name not in used]
    for thing in (*unused, *spec.materials, *spec.textures, *spec.cameras, *spec.lights):
        spec.delete(thing)


def _shrink(spec: mujoco.MjSpec, weighs: range) -> None:
    """Replace meshes by their convex hulls, which are what collides. Each goal with its own model holds them again."""
    heavy = {geom.meshname for geom in spec.geoms if geom.group in weighs}
    model = spec.copy().compile()
    for mesh in spec.meshes:
        if mesh.name not in heavy and model.mesh(mesh.name).graphadr[0] >= 0:  # only what collides has a hull
            mesh.uservert = _hull(model, mesh.name).ravel()
            mesh.file, mesh.scale = "", [1, 1, 1]


def _hull(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the corners (V, 3) of a mesh's convex hull, in the coordinates of its file."""
    mesh = model.mesh(name)
    graph = model.mesh_graph[model.mesh_graphadr[mesh.id] :]  # counts of corners and faces, edges, then the corners
    corners = graph[2 + graph[0] : 2 + 2 * graph[0]]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[mesh.id])
    return model.mesh_vert[model.mesh_vertadr[mesh.id] + corners] @ turn.reshape(3, 3).T + model.mesh_pos[mesh.id]
