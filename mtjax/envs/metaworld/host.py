"""A scene on the host, where Meta-World's resets are played once with MuJoCo's own steps."""

import copy
from typing import Self

import mujoco
import numpy as np

SUBSTEPS = 5
_DOWN = (1.0, 0.0, 1.0, 0.0)  # the hand points at the table; MuJoCo scales it to unit length


class Host:
    """A scene after its hand has settled, for ``arrange``.

    Positions are copies. As in Meta-World they are those of the last ``forward``, or of the last substep before it.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData | None = None):
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model) if data is None else copy.copy(data)

    def copy(self) -> Self:
        """Return an independent copy."""
        return type(self)(self.model, self.data)

    def settle(self, hand: tuple[float, ...]) -> Self:
        """Begin anew, and hold the hand open at a place (3,) for 50 control steps."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.mocap_pos[0], self.data.mocap_quat[0], self.data.ctrl[:] = hand, _DOWN, (-1, 1)
        mujoco.mj_step(self.model, self.data, nstep=50 * SUBSTEPS)
        return self

    def forward(self) -> None:
        """Compute all positions from the state."""
        mujoco.mj_forward(self.model, self.data)

    def place_free(self, pos: np.ndarray) -> None:
        """Put the first free body at a position (3,) and at rest."""
        self.data.qpos[9:12], self.data.qvel[9:15] = pos, 0
        self.forward()

    def move(self, body: str, pos: np.ndarray) -> None:
        """Put a fixed body at a position (3,) in its parent, in the episode's model. Nothing is computed yet."""
        self.model.body(body).pos[:] = pos

    def body(self, name: str) -> np.ndarray:
        """Return the position (3,) of a body."""
        return self.data.body(name).xpos.copy()

    def geom(self, name: str) -> np.ndarray:
        """Return the position (3,) of a geom."""
        return self.data.geom(name).xpos.copy()

    def site(self, name: str) -> np.ndarray:
        """Return the position (3,) of a site."""
        return self.data.site(name).xpos.copy()

    def tcp(self) -> np.ndarray:
        """Return the tool centre (3,), between the fingers."""
        return (self.site("rightEndEffector") + self.site("leftEndEffector")) / 2

    def content(self) -> bytes:
        """Return the whole model, to see whether anything in it was moved."""
        saved = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, saved)
        return saved.tobytes()
