"""The interface of painters, and the choice of one: MuJoCo Warp's ray tracer on NVIDIA GPUs, the caster anywhere."""

from collections.abc import Callable
from typing import Any, Protocol

from mtjax.envs.engines.base import is_nvidia, warp_installed
from mtjax.envs.painters.caster import Caster
from mtjax.envs.painters.poses import Poses
from mtjax.envs.painters.scene import Scene
from mtjax.envs.painters.warp import WarpPainter
from mtjax.types import Array, InputError

PAINTERS = ("auto", "caster", "warp")
MESHES = "only painter 'warp' draws these: --env.painter=warp on an NVIDIA GPU, or leave out --env.pixels"


class Painter(Protocol):
    """Draws the scene of one family. Worlds are single: the caller maps."""

    scene: Scene
    size: int  # pixels a side

    def paint(self, leaf: Callable[[str], Array], poses: Poses) -> Array: ...  # (H, W, 3) uint8


def choose_painter(name: str) -> Any:
    """Return the class of a painter.

    Raises:
        InputError: this device cannot run it, or Warp is not installed.
    """
    able = is_nvidia() and warp_installed()
    if name == "warp" and not is_nvidia():
        raise InputError("painter 'warp' needs an NVIDIA GPU; use --env.painter=caster")
    if name == "warp" and not able:
        raise InputError("painter 'warp' needs Warp, which is not installed: pip install 'mtjax[warp]'")
    return WarpPainter if name == "warp" or (name == "auto" and able) else Caster
