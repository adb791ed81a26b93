"""The interface of painters, and the choice of one: a ray caster in plain JAX, or MuJoCo Warp's ray tracer."""

from collections.abc import Callable
from typing import Any, Protocol

from mtjax.envs.engines.base import is_nvidia, warp_installed
from mtjax.envs.painters.caster import Caster
from mtjax.envs.painters.poses import Poses
from mtjax.envs.painters.scene import Scene
from mtjax.envs.painters.warp import WarpPainter
from mtjax.types import Array, InputError

PAINTERS = ("auto", "caster", "warp")


class Painter(Protocol):
    """Draws the scene of one family. Worlds are single: the caller maps."""

    scene: Scene
    size: int  # pixels a side

    def paint(self, leaf: Callable[[str], Array], poses: Poses) -> Array: ...  # (H, W, 3) uint8


def choose_painter(name: str, meshes: bool = False, caster: type[Caster] = Caster) -> Any:
    """Return the class of a painter. "auto" is the caster: on an H200 too it draws dm_control's scenes faster.

    Args:
        meshes: whether the scene is of meshes, which only Warp draws.
        caster: the caster that "auto" is.

    Raises:
        InputError: it cannot draw meshes, this device cannot run it, or Warp is not installed.
    """
    if meshes and (name == "caster" or not (is_nvidia() and warp_installed())):
        raise InputError(
            "this scene is of meshes, which only painter 'warp' draws, on an NVIDIA GPU with Warp installed "
            "(--env.painter=warp); or leave out --env.pixels"
        )
    if name == "warp" and not is_nvidia():
        raise InputError("painter 'warp' needs an NVIDIA GPU; use --env.painter=caster")
    if name == "warp" and not warp_installed():
        raise InputError("painter 'warp' needs Warp, which is not installed: pip install 'mtjax[warp]'")
    if name == "warp" or meshes:
        return WarpPainter
    return caster if name == "auto" else Caster
