"""Painters: poses, rays and pictures against those of MuJoCo and of Warp."""

import dataclasses
import os
import subprocess
import sys
from functools import lru_cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs, require
from PIL import Image
from probes import slow_but

import mtjax
from mtjax.envs.engines.base import World
from mtjax.envs.painters.caster import Caster
from mtjax.envs.painters.poses import locate
from mtjax.envs.painters.scene import Scene, field, observed
from mtjax.envs.painters.shapes import SHAPES as KINDS
from mtjax.report import render
from mtjax.types import InputError

DOMAINS = (
    "acrobot-swingup",
    "ball-in-cup-catch",
    "cartpole-swingup",
    "cheetah-run",
    "finger-spin",
    "finger-turn-easy",
    "fish-swim",
    "hopper-hop",
    "humanoid-walk",
    "pendulum-swingup",
    "point-mass-easy",
    "quadruped-walk",
    "reacher-easy",
    "swimmer-swimmer6",
    "walker-walk",
)
FURTHER = ("finger-turn-hard", "reacher-hard", "swimmer-swimmer15", "cheetah-run-looks")  # other sizes and colours
LOOKS = {"hue": "0,100", "floor-hue": "0,80", "sky-hue": "0,-60", "light": "1,0.5", "camera-angle": "0,25"}
MAZES = ("corridor-maze", "two-goal-maze")
QUICK = ("finger-turn-easy",)
TARGETS = {  # in states that are not of play
    "finger-turn": [0.1, 0.07],
    "fish": [0.1, 0.1, 0.2],
    "reacher": [0.1, 0.1],
    "swimmer": [0.2, -0.1],
}
PICTURES = Path(__file__).parent / "pictures"  # by MuJoCo's own renderer; tests/draw_pictures.py makes them
SIZE = 64


def similarity(one, other, window=7):
    """The structural similarity of two pictures (Wang et al. 2004), a mean over windows and channels."""
    views = [
        np.lib.stride_tricks.sliding_window_view(np.float64(x), (window, window), axis=(0, 1)) for x in (one, other)
    ]
    means = [view.mean((-2, -1)) for view in views]
    apart = [view - mean[..., None, None] for view, mean in zip(views, means, strict=True)]
    covariance = lambda i, j: (apart[i] * apart[j]).sum((-2, -1)) / (window * window - 1)
    luminance, contrast = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    alike = (2 * means[0] * means[1] + luminance) * (2 * covariance(0, 1) + contrast)
    whole = (means[0] ** 2 + means[1] ** 2 + luminance) * (covariance(0, 0) + covariance(1, 1) + contrast)
    return float(np.mean(alike / whole))


@lru_cache
def family(name):
    name, looks, _ = name.partition("-looks")
    return mtjax.make(name, pixels=SIZE, **({"vary": LOOKS, "combine": "paired", "split": "none"} if looks else {}))


def task_of(name):
    """The last task, whose looks are not those of the model."""
    return jax.tree.map(lambda x: x[-1], family(name).tasks())


def played(name, steps=40):
    """A state of a domain after random actions, each held for some steps: positions, and what else it remembers."""
    name, _, _ = name.partition("-looks")
    env, random = mtjax.make(name, engine="c"), np.random.default_rng(0)
    task, step = jax.tree.map(lambda x: x[0], env.tasks()), jax.jit(env.step)
    world = jax.jit(env.reset)(task, jax.random.key(7)).state
    for i in range(steps):
        if i % 5 == 0:
            action = random.uniform(-1, 1, env.action_size).astype(np.float32)
        world = step(task, world, action).state
    return np.asarray(world.qpos), np.zeros(0) if world.extra is None else np.asarray(world.extra)


def states_of(name):
    """Two states: of a domain away from where it rests, and after play; of a maze at two starts."""
    if name in MAZES:
        env, keys = mtjax.make(name), jax.random.split(jax.random.key(3), 2)
        return jax.vmap(env.reset, (None, 0))(jax.tree.map(lambda x: x[0], env.tasks()), keys).state
    env = family(name)
    model = env.scenery.scene.model
    random = np.random.default_rng(0)
    moved = random.uniform(-0.4, 0.4, (1, model.nq))
    low, high = np.full((2, model.nq), [[-9.0], [9.0]])
    low[model.jnt_qposadr], high[model.jnt_qposadr] = np.where(model.jnt_limited, model.jnt_range.T, [[-9.0], [9.0]])
    qpos = np.float32(np.clip(model.qpos0 + moved, low, high))
    for place in model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]:
        qpos[:, place + 2] = model.qpos0[place + 2] + np.abs(moved[:, place + 2]) / 4  # over the floor
        qpos[:, place + 3 : place + 7] /= np.linalg.norm(qpos[:, place + 3 : place + 7], axis=1, keepdims=True)
    recorded = np.load(PICTURES / "play.npz")
    qpos = np.concatenate([qpos, recorded[f"{name} qpos"][None]])
    target = next((place for domain, place in TARGETS.items() if name.startswith(domain)), None)
    extra = None if target is None else np.float32([target, recorded[f"{name} extra"]])
    zeros = np.zeros((2, model.nv), np.float32)
    return World(qpos, zeros, zeros, None, extra)


@lru_cache
def drawn(name):
    return np.asarray(jax.jit(jax.vmap(family(name).look_at, (None, 0)))(task_of(name), states_of(name))["pixels"])


@pytest.mark.parametrize("name", slow_but(DOMAINS + FURTHER + MAZES, *QUICK, nightly=True))
def test_pictures_are_those_of_mujocos_renderer(name):
    """But for its smooth edges. It draws no shadows here, which no painter does. A shifted picture is less alike."""
    for i, picture in enumerate(drawn(name)):
        reference = np.asarray(Image.open(PICTURES / f"{name}-{i}.png"))
        assert similarity(picture, reference) > 0.92
        assert similarity(np.roll(picture, 3, axis=1), reference) < similarity(picture, reference) - 0.02


# dm_control's task, and the camera that its pictures are published from: 0 but for the quadruped (DrQ-v2).
SUITE = {name: (name.replace("ball-in-cup", "ball_in_cup").replace("point-mass", "point_mass"), 0) for name in DOMAINS}
SUITE |= {"quadruped-walk": ("quadruped-walk", 2), "swimmer-swimmer15": ("swimmer-swimmer15", 0)}


@pytest.mark.parametrize("name", SUITE)
def test_cameras_and_lights_are_those_of_dm_control(name):
    """In a state of play: places and directions, angles of view, and brightness. Targets have lights of their own."""
    title, eye = SUITE[name]
    domain, _, task = title.partition("-")
    suite = require("dm_control.suite")
    theirs = suite.load(domain, task.replace("-", "_"), {"random": 0}).physics
    model = mtjax.make(name, engine="c").scene_model(0)
    data = mujoco.MjData(model)
    with theirs.reset_context():
        theirs.data.qpos[7 if theirs.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 0 :] += 0.1
    data.qpos[:] = theirs.data.qpos
    mujoco.mj_forward(model, data)
    close = lambda ours, wanted: np.testing.assert_allclose(ours, wanted, atol=2e-3)
    close(data.cam_xpos[0], theirs.data.cam_xpos[eye])
    close(data.cam_xmat[0], theirs.data.cam_xmat[eye])
    assert model.cam_fovy[0] == theirs.model.cam_fovy[eye] and model.nlight == theirs.model.nlight
    for i in range(model.nlight):
        height = slice(2 if theirs.model.id2name(i, "light") == "target_light" else 0, 3)  # above where the target is
        close(data.light_xpos[i, height], theirs.data.light_xpos[i, height])
        close(data.light_xdir[i], theirs.data.light_xdir[i])
        for name in ("type", "diffuse", "specular", "ambient", "cutoff", "exponent"):
            close(getattr(model, f"light_{name}")[i], getattr(theirs.model, f"light_{name}")[i])


@pytest.mark.slow
def test_a_target_s_light_hangs_above_it():
    """In observations and in films."""
    env = family("swimmer-swimmer6")
    task, states = jax.tree.map(lambda x: x[0], env.tasks()), states_of("swimmer-swimmer6")
    world = jax.tree.map(lambda x: x[0], states)
    lamp = env.scenery.scene.model.light("target").id
    poses = env.scenery.poses(task, env.visible(task, world))
    np.testing.assert_allclose(poses.lights[lamp][0], [*world.extra, 1.5])
    model = env.scene_model(0)
    render._place(model, env.marks(task, world))
    np.testing.assert_allclose(model.light_pos[lamp], [*world.extra, 1.5])


SHAPES = """
<mujoco>
  <worldbody>
    <camera pos="0 -3 1" xyaxes="1 0 0 0 0.3 1"/>
    <light pos="1 -2 4" dir="-0.2 0.4 -1" type="directional"/>
    <geom type="plane" size="2 2 .1" rgba=".3 .4 .5 1"/>
    <body pos="-.7 0 .9" euler="20 40 10"><freejoint/><geom type="box" size=".2 .3 .15" rgba=".8 .3 .2 1"/></body>
    <body pos="0 0 1.2" euler="50 20 0"><joint type="ball"/><geom type="ellipsoid" size=".1 .2 .3" pos="0 .1 0"/></body>
    <body pos=".7 0 .9" euler="70 30 0"><joint axis="0 1 0" pos=".1 0 .1" ref="20"/>
      <geom type="cylinder" size=".15 .25" rgba=".2 .7 .3 1"/>
      <body pos="0 0 -.4"><joint type="slide" axis="1 0 1"/><geom type="capsule" size=".08 .15"/></body>
    </body>
    <geom type="sphere" size=".2" pos="-.1 -.2 .3" rgba=".9 .8 .2 1"/>
  </worldbody>
</mujoco>"""


def moved_shapes(seed):
    model = observed(mujoco.MjModel.from_xml_string(SHAPES))
    data = mujoco.MjData(model)
    data.qvel[:] = np.random.default_rng(seed).uniform(-0.6, 0.6, model.nv)
    mujoco.mj_integratePos(model, data.qpos, data.qvel, 1.0)
    mujoco.mj_forward(model, data)
    return model, data


def leaf_of(model):
    return lambda name: jnp.asarray(field(model, name))


@pytest.mark.parametrize("name", ["all-joints", "cheetah-run", "reacher-easy"])
def test_poses_are_mujocos(name):
    """Of geoms, of cameras and lights that follow a centre of mass, under every kind of joint."""
    if name == "all-joints":
        model, data = moved_shapes(0)
    else:
        model = family(name).scenery.scene.model
        data = mujoco.MjData(model)
        data.qpos[:] = states_of(name).qpos[0]
        mujoco.mj_forward(model, data)
    poses = jax.jit(partial(locate, model, leaf_of(model)))(jnp.float32(data.qpos))
    matrix = lambda axes: np.stack([np.stack(axis, axis=-1) for axis in axes], axis=-1)
    np.testing.assert_allclose(np.stack(poses.geoms.position, axis=-1), data.geom_xpos, atol=2e-5)
    np.testing.assert_allclose(matrix(poses.geoms.axes), data.geom_xmat.reshape(-1, 3, 3), atol=2e-5)
    np.testing.assert_allclose(poses.camera.position, data.cam_xpos[0], atol=2e-5)
    np.testing.assert_allclose(matrix(poses.camera.axes), data.cam_xmat[0].reshape(3, 3), atol=2e-5)
    np.testing.assert_allclose(poses.lights[0][0], data.light_xpos[0], atol=2e-5)
    np.testing.assert_allclose(poses.lights[0][1], data.light_xdir[0], atol=2e-5)


def test_rays_meet_every_shape_where_mujocos_do():
    """The caster's nearest geom and its distance, for every pixel, against ``mj_ray``."""
    model, data = moved_shapes(1)
    caster = Caster(Scene(model), 32)
    poses = locate(model, leaf_of(model), jnp.float32(data.qpos))
    packed = np.asarray(jax.jit(lambda: caster._nearest(caster._view(leaf_of(model), poses)))())
    distance, number = (packed & ~63).view(np.float32), packed & 63
    rays = np.stack([caster._rays.u, caster._rays.v, -np.ones(32 * 32)], axis=1) @ data.cam_xmat[0].reshape(3, 3).T
    group, found = np.ones(6, np.uint8), np.zeros(1, np.int32)
    eye, geoms = data.cam_xpos[0], np.full(32 * 32, 63)
    depths = np.full(32 * 32, 5e8)
    for i, ray in enumerate(rays):
        depth = mujoco.mj_ray(model, data, eye, ray, group, 1, -1, found)
        if depth >= 0:
            geoms[i], depths[i] = found[0], depth
    same = number == geoms
    assert np.mean(same) > 0.99  # rays along an edge may go either way
    assert set(np.unique(geoms)) == {0, 1, 2, 3, 4, 5, 63}
    np.testing.assert_allclose(distance[same], depths[same], rtol=1e-3)


@pytest.mark.slow
def test_normals_stand_on_every_shape():
    """Against the change of distance from one ray to the next, as ``mj_ray`` sees it."""
    model, data = moved_shapes(1)
    caster = Caster(Scene(model), 128)
    poses = locate(model, leaf_of(model), jnp.float32(data.qpos))
    view = caster._view(leaf_of(model), poses)
    packed = np.asarray(jax.jit(lambda: caster._nearest(view))()).reshape(128, 128)
    depth, number = (packed & ~63).view(np.float32), packed & 63
    rays = np.stack([caster._rays.u, caster._rays.v, -np.ones(128 * 128)], axis=1).reshape(128, 128, 3)
    points = rays * depth[..., None]
    across = np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[:-2, 1:-1] - points[2:, 1:-1])
    inner = np.ones((126, 126), bool)
    for dy in range(3):
        for dx in range(3):
            inner &= number[dy : dy + 126, dx : dx + 126] == number[1:-1, 1:-1]
    for i in range(model.ngeom):
        mask = inner & (number[1:-1, 1:-1] == i)
        kind, body = KINDS[int(model.geom_type[i])], jax.tree.map(lambda x, i=i: x[i], view.bodies)
        where = tuple(jnp.asarray(points[1:-1, 1:-1][mask][:, k]) for k in range(3))
        normal = np.stack([np.broadcast_to(x, mask.sum()) for x in kind.normal(where, body)], axis=1)
        slope = across[mask] / np.linalg.norm(across[mask], axis=1, keepdims=True)
        assert mask.sum() > 10
        assert np.median(np.sum(normal * slope, axis=1)) > 0.995


@pytest.mark.slow
def test_one_world_among_many_looks_as_it_does_alone():
    """More worlds than the caster draws at once, of which the last chunk is not full."""
    env = family("finger-spin")
    task = jax.tree.map(lambda x: x[0], env.tasks())
    qpos = jax.random.uniform(jax.random.key(0), (21, 3), minval=-1.0)
    worlds = World(qpos, jnp.zeros((21, 3)), jnp.zeros((21, 3)), None)
    together = np.asarray(jax.jit(jax.vmap(env.look_at, (None, 0)))(task, worlds)["pixels"])
    alone = jax.jit(lambda task, world: env.look_at(task, world)["pixels"])
    for i in (0, 15, 16, 20):
        picture = np.asarray(alone(task, jax.tree.map(lambda x, i=i: x[i], worlds)))
        apart = np.abs(np.int32(together[i]) - picture)  # XLA rounds otherwise where it computes one world alone
        assert np.max(apart) <= 1 and np.mean(apart > 0) < 0.01
    assert len(np.unique(together, axis=0)) == 21


def test_a_shape_that_the_caster_does_not_know_is_refused():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><asset><hfield name='h' nrow='2' ncol='2' size='1 1 1 1'/></asset>"
        "<worldbody><camera/><light/><geom type='hfield' hfield='h'/></worldbody></mujoco>"
    )
    with pytest.raises(InputError, match=r"knows no hfield; use --env.painter=warp"):
        Caster(Scene(model), 32)


@pytest.mark.slow
@needs("warp")
@pytest.mark.parametrize("name", ["finger-turn-easy", "swimmer-swimmer6"])
def test_warp_draws_what_the_caster_draws(name):
    """On a CPU, where Warp is slow; nested maps, tasks with colours and cameras of their own, a light that moves."""
    from mtjax.envs.painters.warp import WarpPainter

    varied = {"hue": "0,90", "camera-angle": "-20,20"}
    env = mtjax.make(name, pixels=SIZE, vary=varied, combine="paired", split="none")
    other = dataclasses.replace(env, frames=4)  # unequal, so that it is traced anew
    other.__dict__["scenery"] = dataclasses.replace(env.scenery, painter=WarpPainter(env.scenery.scene, SIZE))
    states = jax.tree.map(lambda x: jnp.stack([x, x[::-1]]), states_of(name))
    draw = lambda env: jax.jit(jax.vmap(jax.vmap(env.look_at, (None, 0))))(env.tasks(), states)["pixels"]
    ours, theirs = np.asarray(draw(env)), np.asarray(draw(other))
    for i in np.ndindex(2, 2):
        assert similarity(ours[i], theirs[i]) > 0.95
    assert [1, 4] in other.calls.targets().values()  # one batch of all worlds


@pytest.mark.slow
def test_committed_pictures_are_mujocos():
    """Where an OpenGL backend works: pictures drawn now equal those in the repository, to a level of brightness."""
    done = subprocess.run(
        [sys.executable, Path(__file__).parent / "draw_pictures.py", "--check"],
        capture_output=True,
        text=True,
        env={"MUJOCO_GL": "osmesa", **os.environ},
    )
    if "cannot draw" in done.stderr:
        pytest.skip("no OpenGL backend works here")
    assert done.returncode == 0, done.stderr
