"""MuJoCo Warp's ray tracer, for NVIDIA GPUs. On a CPU it works and is slow."""

import dataclasses
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.kernels import compile_kernels, note_kernels
from mtjax.envs.engines.shared import call_of, first_of, keep, living
from mtjax.envs.engines.warp import ALONE, annotated, clear_graphs, keep_streams, own_devices, saved, short_hash
from mtjax.envs.painters.poses import Poses
from mtjax.envs.painters.scene import GROUPS, Scene
from mtjax.types import Array

_FIELDS = {"geom_size": 3, "geom_rgba": 4, "light_diffuse": 3}  # of the model, that differ between worlds


class Shot(NamedTuple):
    """All arrays that a picture depends on, with worlds along one leading axis, by their names in Warp."""

    geom_size: Array  # (ngeom, 3)
    geom_rgba: Array  # (ngeom, 4)
    light_diffuse: Array  # (nlight, 3)
    geom_xpos: Array  # (ngeom, 3)
    geom_xmat: Array  # (ngeom, 3, 3)
    cam_xpos: Array  # (ncam, 3)
    cam_xmat: Array  # (ncam, 3, 3)
    light_xpos: Array  # (nlight, 3)
    light_xdir: Array  # (nlight, 3)


class _Place(NamedTuple):
    """The memory of Warp on one device, for a number of worlds."""

    model: Any
    data: Any
    context: Any


@dataclasses.dataclass(frozen=True, eq=False)
class WarpPainter:
    """Draws the scene of a family by MuJoCo Warp, without shadows.

    One call brings Warp's tree of geoms up to date and casts the rays. Two calls, as MJX has them, could be run in turn
    with those of another picture of the same program, such as that of a reset. Warp draws a fixed number of worlds
    along one axis, so nested maps are flattened into one axis.
    """

    scene: Scene
    size: int

    def paint(self, leaf: Callable[[str], Array], poses: Poses) -> Array:
        """Return the picture (H, W, 3) uint8 of one world.

        Args:
            leaf: a field of the task's scene, by its name.
            poses: of the world's geoms, camera and lights.
        """
        model = self.scene.model
        stack = lambda vectors: jnp.stack([jnp.stack(vector) for vector in vectors])
        matrix = lambda pose: jnp.stack([jnp.stack(axis, axis=-1) for axis in pose.axes], axis=-1)
        shot = Shot(
            *(leaf(name) for name in _FIELDS),
            geom_xpos=jnp.stack(poses.geoms.position, axis=-1),
            geom_xmat=matrix(poses.geoms),
            cam_xpos=stack([poses.camera.position] * model.ncam),
            cam_xmat=jnp.stack([matrix(poses.camera)] * model.ncam),
            light_xpos=stack([position for position, _ in poses.lights]),
            light_xdir=stack([direction for _, direction in poses.lights]),
        )
        packed = self._draw(jax.tree.map(lambda x: jnp.float32(x)[None], shot))[0]
        picture = packed.reshape(self.size, self.size)
        return jnp.stack([(picture >> shift).astype(jnp.uint8) for shift in (16, 8, 0)], axis=-1)

    @cached_property
    def _draw(self) -> Any:
        """Return the function that draws worlds along one leading axis. ``vmap`` extends that axis."""

        @jax.custom_batching.custom_vmap
        def draw(shot: Shot) -> Array:
            return self._call(shot)

        @draw.def_vmap
        def _(count: int, mapped: Any, shot: Shot) -> tuple[Array, bool]:
            full = jax.tree.map(lambda x, m: x if m else jnp.broadcast_to(x, (count, *x.shape)), shot, mapped[0])
            drawn = draw(jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), full))
            return drawn.reshape(count, len(drawn) // count, *drawn.shape[1:]), True

        return draw

    # What Warp runs.

    @cached_property
    def _first(self) -> "WarpPainter":
        """Return the painter whose memory all equal painters use."""
        return first_of(self._digest, self, clear_graphs)

    @cached_property
    def _places(self) -> dict[Any, _Place]:
        return {}

    @cached_property
    def _targets(self) -> dict[int, Any]:
        return {}

    def _call(self, shot: Shot) -> Array:
        count = len(shot.geom_xpos)
        self.provide(count)
        target = self._targets[count]
        target.call_id = 0  # Warp's number of a trace, part of the program: each trace makes the same call
        return keep(self._first, target(*shot)[0])

    def targets(self) -> dict[str, list[int]]:
        """Return the arguments of ``provide`` for every call until now, by the call's name in programs."""
        return {target.name: [count] for count, target in list(self._targets.items())}

    def provide(self, count: int) -> str:
        """Make the call that draws a number of worlds, and return its name in programs."""
        import warp

        warp.config.log_level = warp.LOG_WARNING  # before it first runs, and says so on standard output
        keep_streams(warp)
        with ALONE:
            for device in own_devices():
                if (device.alias, count) not in self._first._places:
                    self._first._places[device.alias, count] = self._make_place(device, count)
            if count not in self._targets:
                self._targets[count] = call_of(self._digest, count, partial(self._make_target, count))
        return self._targets[count].name

    def load_kernels(self) -> bool:
        """Compile or load all kernels of a picture, before programs run that would wait for them.

        Returns:
            whether programs record CUDA graphs when they first run.
        """
        from mujoco.mjx.third_party import mujoco_warp

        for (alias, _), place in list(self._first._places.items()):
            with ALONE:  # to make a place launches some of them
                draw = lambda place=place: (mujoco_warp.refit_bvh(*place), mujoco_warp.render(*place))
                compile_kernels(alias, note_kernels(alias, draw))
        return jax.default_backend() != "cpu"

    def _make_place(self, device: Any, count: int) -> _Place:
        """Allocate Warp's memory for a number of worlds."""
        import warp
        from mujoco.mjx.third_party import mujoco_warp

        base = self.scene.model
        with warp.ScopedDevice(device):
            context = mujoco_warp.create_render_context(
                base,
                nworld=count,
                cam_res=(self.size, self.size),
                cam_active=[i == 0 for i in range(base.ncam)],
                render_rgb=True,
                render_depth=False,
                render_seg=False,
                enabled_geom_groups=list(range(GROUPS)),
                render_skybox=bool(np.any(base.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)),
            )
            data = mujoco_warp.make_data(base, nworld=count, naconmax=1, njmax=1)
            return _Place(mujoco_warp.put_model(base), data, context)

    def _make_target(self, count: int) -> Any:
        """Return the JAX function that draws a number of worlds in Warp."""
        import warp

        vectors = {3: warp.vec3, 4: warp.vec4}
        kinds: dict[str, Any] = {name: warp.array(dtype=vectors[size], ndim=2) for name, size in _FIELDS.items()}
        for name in Shot._fields[len(_FIELDS) :]:
            kinds[name] = warp.array(dtype=warp.mat33 if name.endswith("xmat") else warp.vec3, ndim=2)
        kinds["picture"] = warp.array(dtype=warp.uint32, ndim=2)
        on_gpu = jax.default_backend() != "cpu"
        mode = warp.JaxCallableGraphMode.WARP if on_gpu else warp.JaxCallableGraphMode.NONE
        draw = _drawer(self._digest, count)
        draw.__qualname__ = f"draw_{short_hash(self._digest, count)}"  # the call's name is made of it
        target = warp.jax_callable(
            annotated(draw, kinds),
            num_outputs=1,
            graph_mode=mode,
            output_dims={"picture": (count, self.size * self.size)},
        )
        model = self.scene.model
        rows = {"geom": model.ngeom, "cam": model.ncam, "light": model.nlight}
        tails = {**{name: (size,) for name, size in _FIELDS.items()}, "geom_xmat": (3, 3), "cam_xmat": (3, 3)}
        shapes = [(count, rows[name.split("_")[0]], *tails.get(name, (3,))) for name in Shot._fields]
        given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        target.call_id = 0
        jax.eval_shape(target, *given)  # so that Warp knows the call if no program is traced
        return target

    @cached_property
    def _digest(self) -> str:
        """Return a short hash of all that decides a picture, so that calls have the same names in every process."""
        return short_hash("draw", saved(self.scene.model), self.size)


def _drawer(painter: str, count: int) -> Callable:
    """Return the function that Warp runs in a call.

    It finds the painter by its name. Warp keeps such functions for good, but a painter's memory must be freed.
    """
    from mujoco.mjx.third_party import mujoco_warp

    def draw(*arrays: Any) -> None:
        model, data, context = living(painter)._places[arrays[0].device.alias, count]
        for name, array in zip(Shot._fields, arrays, strict=False):
            setattr(model if name in _FIELDS else data, name, array)
        context.rgb_data = arrays[-1]
        mujoco_warp.refit_bvh(model, data, context)
        mujoco_warp.render(model, data, context)

    return draw
