"""Models of a user's own: what actions reach, what engines refuse, and where files are looked for."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mtjax.envs import Domain, Parameter


class Plain(Domain):
    """A family that observes positions and is rewarded for nothing."""

    parameters = {}  # noqa: RUF012
    num_substeps, episode_steps, default_iterations = 5, 100, 4

    def start(self, task, key):
        return jnp.asarray(self.models[0].qpos0, jnp.float32), jnp.zeros(self.models[0].nv)

    def observe(self, task, world):
        return world.qpos

    def reward(self, task, world, action):
        return jnp.float32(0)


def own(model, engine="c", vary=(), **words):
    """Return a family of one's own from an MJCF."""
    cls = dataclasses.dataclass(frozen=True)(type("Own", (Plain,), {"model_file": model, **words}))
    return cls(engine=engine, vary=vary)  # type: ignore


def first_task(env):
    return jax.tree.map(lambda x: x[0], env.tasks())


def play(env, action, steps):
    """Return the last observation (O,) after so many steps of one action."""
    task = first_task(env)
    step = jax.jit(env.step)
    state = env.reset(task, jax.random.key(0)).state
    for _ in range(steps):
        state = step(task, state, jnp.asarray(action, jnp.float32)).state
    return np.asarray(env.observe(task, state))


SERVO = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 1 0" damping="2"/>
<geom size="0.1" pos="0.2 0 0" mass="1"/></body></worldbody><actuator>%s</actuator></mujoco>"""
SPREAD = [  # actuators, and the angles to which -1, 0 and 1 turn the joint
    ('<position joint="j" kp="20" ctrlrange="-3 3"/>', [-3, 0, 3]),
    ('<position joint="j" kp="20" ctrlrange="0.5 1.5"/>', [0.5, 1, 1.5]),
    (  # as a gripper's: 0 to 255 for 0 to 2 rad
        '<general joint="j" ctrlrange="0 255" gainprm="0.15686" biastype="affine" biasprm="0 -20 0"/>',
        [0, 1, 2],
    ),
    ('<position joint="j" kp="20"/>', [-1, 0, 1]),
    ('<position joint="j" kp="20" ctrllimited="false" ctrlrange="-3 3"/>', [-1, 0, 1]),
]


@pytest.mark.parametrize("actuator, angles", SPREAD, ids=range(len(SPREAD)))
def test_actions_span_the_range_of_a_servo(actuator, angles):
    """Where it has a range; else an action is the control."""
    env = own(SERVO % actuator)
    found = [play(env, [action], steps=200)[0] for action in (-1, 0, 1)]
    np.testing.assert_allclose(found, angles, atol=2e-3)


def set_range(spec, value):
    """Set how far a servo turns."""
    spec.actuators[0].ctrlrange = [-value, value]


def test_actions_span_the_range_of_every_task():
    """If a parameter changes it."""
    env = own(SERVO % SPREAD[0][0], vary={"range": "1,2"}, parameters={"range": Parameter("rad", 3.0, set_range)})
    tasks, action = env.tasks(), jnp.ones(1)
    controls = jax.vmap(lambda task: env.control(task, env.reset(task, jax.random.key(0)).state, action)[1])(tasks)
    np.testing.assert_array_equal(controls, [[1], [2]])
