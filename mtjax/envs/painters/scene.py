"""What painters need to know of a family's scene, from the compiled models of all tasks."""

import copy
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np

from mtjax.envs.painters.poses import FIELDS, require_known

SKY = "sky"
# The fields in which the scenes of tasks may differ.
LEAVES = (*FIELDS, "geom_size", "geom_rgba", "light_diffuse", SKY)
GROUPS = 3  # MuJoCo shows geoms of the groups 0, 1 and 2
_DEGREE = 7  # of the polynomials that the colours of the sky are fitted to
_UNSET = np.array([0.5, 0.5, 0.5, 1], np.float32)  # MuJoCo's colour of a geom that takes its material's
_TEXTURE, _ROLE = mujoco.mjtTexture, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


class Tiles(NamedTuple):
    """A checkered plane."""

    colours: np.ndarray  # (2, 3) factors of the geom's own colour
    repeat: tuple[float, float]  # pairs of tiles in a metre along x and y
    from_edge: tuple[bool, bool]  # whether the first pair begins at the plane's edge, or in the middle


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """The scene of a family: its first task's model, as ``observed`` returns it."""

    model: mujoco.MjModel

    def __post_init__(self):
        require_known(self.model)

    def field(self, name: str) -> np.ndarray:
        """Return a field by its name in MuJoCo, or its "sky"."""
        return self._sky if name == SKY else field(self.model, name)

    @cached_property
    def _sky(self) -> np.ndarray:
        return field(self.model, SKY)

    @cached_property
    def shown(self) -> tuple[int, ...]:
        """Return the geoms that can be seen."""
        return tuple(int(i) for i in np.flatnonzero(self.model.geom_group < GROUPS))

    @cached_property
    def gloss(self) -> np.ndarray:
        """Return how much of a light's highlight each geom shows (ngeom,), all with MuJoCo's default shininess."""
        model = self.model
        return np.where(model.geom_matid >= 0, np.append(model.mat_specular, 0.5)[model.geom_matid], 0.5)

    @cached_property
    def tiles(self) -> Mapping[int, Tiles]:
        """Return the tiles of each checkered plane."""
        model, found = self.model, {}
        for geom in self.shown:
            material = model.geom_matid[geom]
            texture = model.mat_texid[material, _ROLE] if material >= 0 else -1
            if texture < 0 or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            texels = _texels(model, texture)
            halves = [len(texels) // 2, texels.shape[1] // 2]
            corner = lambda rows, columns, texels=texels: texels[rows, columns].reshape(-1, 3).mean(axis=0)
            first, second = slice(0, halves[0]), slice(halves[0], None)
            same = (corner(first, slice(0, halves[1])) + corner(second, slice(halves[1], None))) / 2
            other = (corner(first, slice(halves[1], None)) + corner(second, slice(0, halves[1]))) / 2
            uniform, repeat, size = model.mat_texuniform[material], model.mat_texrepeat[material], model.geom_size[geom]
            scale = [repeat[i] * (0.5 if uniform or size[i] <= 0 else 0.5 / size[i]) for i in (0, 1)]
            from_edge = bool(size[0] > 0), bool(size[1] > 0)
            found[geom] = Tiles(np.array([same, other], np.float32), (scale[0], scale[1]), from_edge)
        return found


def observed(model: mujoco.MjModel, hides: tuple[str, ...] = ()) -> mujoco.MjModel:
    """Return a model in which geoms have the colours that are drawn, and those that are not seen are in no shown group.

    Args:
        hides: names of geoms that are not drawn.
    """
    model = copy.copy(model)
    for geom in range(model.ngeom):
        material = model.geom_matid[geom]
        if material >= 0 and np.all(model.geom_rgba[geom] == _UNSET):
            model.geom_rgba[geom] = model.mat_rgba[material]
        if model.geom_rgba[geom, 3] == 0 or model.geom(geom).name in hides:
            model.geom_group[geom] = GROUPS
    return model


def field(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return a field of a scene by its name in MuJoCo, or its "sky"."""
    return np.asarray(_fit_sky(model) if name == SKY else getattr(model, name), np.float32)


def _fit_sky(model: mujoco.MjModel) -> np.ndarray:
    """Return polynomials (degree + 1, 3) of the sine of the elevation, for the colours of the sky."""
    found = np.flatnonzero(model.tex_type == _TEXTURE.mjTEXTURE_SKYBOX)
    if not len(found):
        return np.zeros((1, 3), np.float32)
    texels = _texels(model, int(found[0]))
    width = texels.shape[1]
    line = (np.arange(width) + 0.5) / width * 2 - 1
    faces = np.split(texels, len(texels) // width) if len(texels) > width else [texels] * 6
    heights, colours = [], []
    for i, face in enumerate(faces):
        column, row = np.meshgrid(line, line)
        up = {2: 1.0, 3: -1.0}.get(i)
        sine = (-row if up is None else up) / np.sqrt(1 + column**2 + row**2)
        heights.append(np.broadcast_to(sine, row.shape).ravel())
        colours.append(face.reshape(-1, 3))
    powers = np.vander(np.concatenate(heights), _DEGREE + 1)
    return np.linalg.lstsq(powers, np.concatenate(colours), rcond=None)[0]


def _texels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Return the colours (height, width, 3) of a texture in [0, 1]."""
    shape = (model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture])
    first = model.tex_adr[texture]
    return model.tex_data[first : first + np.prod(shape)].reshape(shape)[..., :3] / 255.0
