"""What a family's scene looks like: camera, light, floor and sky as in dm_control, and the parameters of looks.

A scene is a model of its own, made from the same MJCF as the physics and then dressed. So no camera or colour changes
the model that engines step.
"""

import colorsys
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.parameters import Parameter, positive

SELF, EFFECTOR, DECORATION, TARGET = (
    (0.7, 0.5, 0.3, 1.0),
    (0.7, 0.4, 0.2, 1.0),
    (0.3, 0.5, 0.7, 1.0),
    (0.6, 0.3, 0.3, 1.0),
)
SKY_HUE, CAMERA_ANGLE = "sky-hue", "camera-angle"
HIDDEN = 3  # a group that MuJoCo does not show unless asked to
_FLOORS = ("ground", "floor")
_FLOOR = (0.2, 0.3, 0.4)  # brighter tiles of the floor
_DARK = (0.5, 2 / 3, 0.75)  # factors of the darker ones
_SKY, _NADIR = (0.4, 0.6, 0.8), (0.0, 0.0, 0.0)
_HORIZON = (0.2, 0.3, 0.4)
_EXTENT = 2.0  # [m] of a model on a long floor, as MuJoCo draws nothing within a hundredth of the extent
_LAMP = (0.0, 0.0, 1.5)  # [m] of the light above a geom, wherever the geom is along x and y
_DISTANCE = 2.0  # from an own model's camera to its centre, in extents of the model
_LIGHT, _FOLLOW = mujoco.mjtLightType, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM


class Look(NamedTuple):
    """The camera and the light of a scene."""

    camera: tuple[float, float, float]  # position [m]; it looks along +y, or down
    tilt: float  # [deg] up from looking straight down
    turn: float = 0.0  # [deg] of the camera about z, to the left
    light: tuple[float, float, float] = (0.0, 0.0, 2.0)  # position [m] of a lamp that shines down
    diffuse: float = 0.7  # of the light
    sun: bool = False  # whether the light is directional
    follow: str = ""  # the body whose centre of mass camera and light follow; their positions are from its frame
    mounted: bool = False  # whether the light is mounted on that body, and turns with it
    fovy: float = 45.0  # [deg] angle of view
    lamp: str = ""  # the geom above which a further light, of its name, shines down
    colours: tuple[tuple[str, tuple[float, ...]], ...] = ()  # of geoms that are not as the model has them


def from_above(middle: float, cells: float, light: float = 9.0) -> Look:
    """Return the view of a square grid from above.

    Args:
        middle: x and y of the grid's middle.
        cells: how many cells of size 1 are seen along each side.
        light: height of the light.
    """
    height = 1.3 * cells
    return Look((middle, middle, height), tilt=0.0, light=(middle, middle, light), diffuse=0.2, sun=True)


def dress(spec: mujoco.MjSpec, look: Look | None, plain: bool) -> None:
    """Give a model floor, sky, camera and light. What the model has of its own stays.

    Args:
        look: None for a model with its own, or with none: then the camera shows all of it.
        plain: whether floor and sky have one colour each.
    """
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.8] * 3
    spec.visual.headlight.specular, spec.visual.map.znear = [0.1] * 3, 0.01
    _paint_background(spec, plain)
    for site in spec.sites:
        site.group = HIDDEN
    for name, rgba in look.colours if look else ():
        spec.geom(name).rgba = rgba
    if look is None:
        look = _survey(spec)
    if look.follow:
        spec.stat.extent = _EXTENT
    body = spec.body(look.follow) if look.follow else spec.worldbody
    follow = {"mode": _FOLLOW} if look.follow else {}
    if not spec.cameras:
        quat = _turned(_about("x", look.tilt), look.turn)
        body.add_camera(name="eye", pos=look.camera, quat=quat, fovy=look.fovy, **follow)
    if not spec.lights:
        kind = _LIGHT.mjLIGHT_DIRECTIONAL if look.sun else _LIGHT.mjLIGHT_SPOT
        follow = {} if look.mounted else follow
        body.add_light(name="light", pos=look.light, type=kind, diffuse=[look.diffuse] * 3, **follow)
    if look.lamp:
        spec.worldbody.add_light(name=look.lamp, pos=_LAMP, type=_LIGHT.mjLIGHT_SPOT, diffuse=[1] * 3)


def _paint_background(spec: mujoco.MjSpec, plain: bool) -> None:
    builtin = mujoco.mjtBuiltin
    gradient = builtin.mjBUILTIN_FLAT if plain else builtin.mjBUILTIN_GRADIENT
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=32, height=32)
        sky.builtin, sky.rgb1, sky.rgb2 = gradient, _HORIZON if plain else _SKY, _HORIZON if plain else _NADIR
    floors = [geom for geom in spec.geoms if geom.name in _FLOORS and not geom.material]
    for geom in floors:
        geom.rgba = [*_FLOOR, 1]
    if floors and not plain:
        tiles = spec.add_texture(name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, width=128, height=128)
        tiles.builtin, tiles.rgb1, tiles.rgb2 = builtin.mjBUILTIN_CHECKER, _DARK, [1, 1, 1]
        material = spec.add_material(name="tiles", texuniform=True, texrepeat=[1, 1], specular=0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
        for geom in floors:
            geom.material = "tiles"


def _survey(spec: mujoco.MjSpec) -> Look:
    """Return a look that shows all of a model from the front."""
    model = spec.compile()
    roots = np.flatnonzero(model.body_parentid == 0)[1:]
    centre = model.body_pos[roots].mean(axis=0) if len(roots) else np.zeros(3)  # limbs at rest would move the middle
    slope = math.atan(0.5)
    away = _DISTANCE * model.stat.extent
    camera = centre + away * np.array([0, -math.cos(slope), math.sin(slope)])
    above = centre + np.array([0, 0, 2 * model.stat.extent])
    return Look(tuple(camera), 90 - math.degrees(slope), light=tuple(above), diffuse=0.6, sun=True)


def _about(axis: str, degrees: float) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.eye(3)["xyz".index(axis)], math.radians(degrees))
    return quat


def _turned(quat: np.ndarray, degrees: float) -> np.ndarray:
    """Return a rotation, turned about z."""
    turned = np.zeros(4)
    mujoco.mju_mulQuat(turned, _about("z", degrees), quat)
    return turned


# Parameters of looks. They edit scenes and never the physics.


def _turn_camera(spec: mujoco.MjSpec, degrees: float) -> None:
    camera = spec.cameras[0]
    quat = camera.quat
    if camera.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        quat = spec.copy().compile().cam_quat[0]
        camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, y, z = camera.pos
    camera.quat, camera.pos = _turned(quat, degrees), [cos * x - sin * y, sin * x + cos * y, z]


def _turn_hues(chosen: Callable[[mujoco.MjsGeom], bool]) -> Callable[[mujoco.MjSpec, float], None]:
    def edit(spec: mujoco.MjSpec, degrees: float) -> None:
        for geom in filter(chosen, spec.geoms):
            geom.rgba = [*_turn_hue(geom.rgba[:3], degrees), geom.rgba[3]]

    return edit


def _turn_sky(spec: mujoco.MjSpec, degrees: float) -> None:
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            texture.rgb1, texture.rgb2 = _turn_hue(texture.rgb1, degrees), _turn_hue(texture.rgb2, degrees)


def _turn_hue(rgb: np.ndarray, degrees: float) -> tuple[float, float, float]:
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb)
    return colorsys.hsv_to_rgb((hue + degrees / 360) % 1, saturation, value)


def _scale_lights(spec: mujoco.MjSpec, scale: float) -> None:
    for light in spec.lights:
        light.diffuse = light.diffuse * scale


_is_floor = lambda geom: geom.name in _FLOORS
LOOKS: Mapping[str, Parameter] = MappingProxyType(
    {
        CAMERA_ANGLE: Parameter("deg", 0.0, _turn_camera, -180.0, 180.0, looks=True),
        "hue": Parameter("deg", 0.0, _turn_hues(lambda geom: not _is_floor(geom)), -360.0, 360.0, looks=True),
        "floor-hue": Parameter("deg", 0.0, _turn_hues(_is_floor), -360.0, 360.0, looks=True),
        SKY_HUE: Parameter("deg", 0.0, _turn_sky, -360.0, 360.0, looks=True),
        "light": positive("1", 1.0, _scale_lights, looks=True),
    }
)
WITHOUT_CAMERA: Mapping[str, Parameter] = MappingProxyType(
    {name: x for name, x in LOOKS.items() if name != CAMERA_ANGLE}
)
"""The looks of scenes whose camera the world turns."""
