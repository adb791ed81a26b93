"""A simulator that families of different scenes share: one scene with the subtrees of all (``merged_scene``)."""

import copy
import dataclasses
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.base import Engine, World, some
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.warp import Warp
from mtjax.envs.merged_scene import Places, Union, compose
from mtjax.envs.shared_simulator import Joined, Of, reset_apart
from mtjax.types import Array, Key, Step, Task


@dataclasses.dataclass(frozen=True, eq=False)
class United(Joined):
    """Domains whose worlds one simulator steps in a union of their scenes.

    Worlds stay those of their own scenes. For a step they enter the union, where other scenes' subtrees are parked, and
    then leave it. Nothing of the union is kept between steps, so parked subtrees fall for one step at most.

    Raises:
        InputError: the scenes cannot be united.
    """

    @cached_property
    def union(self) -> Union:
        """Return the composed scene."""
        return compose(list(self.members.values()))

    @cached_property
    def _places(self) -> dict[int, Places]:
        return dict(zip(self.members, self.union.places, strict=True))

    @cached_property
    def _body_pos(self) -> np.ndarray:
        """Return where bodies (R, nbody, 3) are in the rows of all members' tables. Others' subtrees are parked.

        The models of one union differ in nothing else (``simulator_groups``).
        """
        rows = []
        for i, domain in self.members.items():
            own = np.stack([model.body_pos for model in domain.models])
            whole = np.repeat(self.union.model.body_pos[None], len(own), axis=0)
            whole[:, self._places[i].bodies] = own
            rows.append(whole)
        return np.concatenate(rows)

    @cached_property
    def _leaves(self) -> dict[str, np.ndarray]:
        return {"body_pos": self._body_pos.astype(np.float32)}

    @cached_property
    def _models(self) -> list[mujoco.MjModel]:
        """Return the union's model of every row. Rows whose bodies are in the same places share one."""
        made: dict[bytes, mujoco.MjModel] = {}
        places = [row.tobytes() for row in self._body_pos]
        for place, row in zip(places, self._body_pos, strict=True):
            if place not in made:
                made[place] = copy.copy(self.union.model)
                made[place].body_pos[:] = row
        return [made[place] for place in places]

    @cached_property
    def simulator(self) -> Engine:
        """Return the engine of the union, with the members' settings of the solver."""
        first = next(iter(self.members.values()))
        if isinstance(first.simulator, MujocoC):
            return MujocoC(self._models, first.num_substeps)
        base, own = copy.copy(self.union.model), first.simulator.base.opt
        for setting in ("iterations", "ls_iterations", "integrator"):
            setattr(base.opt, setting, getattr(own, setting))
        return Warp(base, first.num_substeps)

    def reset_worlds(self, tasks: Of[Task], keys: Of[Key]) -> Of[Step]:
        """Begin an episode in every world (S, T, E), each in its own scene."""
        return reset_apart(self.members, tasks, keys)

    def enter(self, i: int, world: World) -> World:
        """Return worlds of the union, with a member's subtrees as they are in its worlds (S, T, E, ...)."""
        union, places = self.union, self._places[i]
        return world._replace(
            qpos=_put(union.qpos, places.qpos, world.qpos),
            qvel=_put(np.zeros(union.model.nv), places.qvel, world.qvel),
            warmstart=_put(union.warmstart, places.qvel, world.warmstart),
            sensors=None,
        )

    def leave(self, i: int, world: World) -> World:
        """Return worlds of a member's own scene."""
        places = self._places[i]
        return world._replace(
            qpos=world.qpos[..., places.qpos],
            qvel=world.qvel[..., places.qvel],
            warmstart=world.warmstart[..., places.qvel],
            sensors=None if world.sensors is None else some(world.sensors[..., places.sensors]),
        )


def _put(parked: np.ndarray, places: np.ndarray, values: Array) -> Any:
    """Return the numbers (..., N) of parked subtrees, with values (..., n) in some places."""
    where = np.arange(len(parked)) + values.shape[-1]
    where[places] = np.arange(values.shape[-1])
    rest = jnp.broadcast_to(jnp.float32(parked), (*values.shape[:-1], len(parked)))
    return jnp.concatenate([values, rest], axis=-1)[..., where]
