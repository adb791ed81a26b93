"""A lever that holds an angle: four lengths, three angles."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

import mtjax
from mtjax.envs import Domain, Parameter


def set_length(spec, value):
    """Make the lever this long [m]. Its mass grows with it, by its density."""
    spec.geom("bar").fromto = [0, 0, 0, 0, 0, -value]


@dataclasses.dataclass(frozen=True)
class Lever(Domain):
    """Hold a lever at the task's angle. Observation (3,): sine and cosine of the angle, speed [rad/s]. Action (1,)."""

    model_file: ClassVar[str] = """
      <mujoco>
        <option timestep="0.01"/>
        <worldbody>
          <body name="lever">
            <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
            <geom name="bar" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" contype="0" conaffinity="0"/>
          </body>
        </worldbody>
        <actuator><motor joint="hinge" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
      </mujoco>"""
    parameters: ClassVar = {
        "length": Parameter("m", 0.5, set_length, minimum=0.1),
        "angle": Parameter("rad", 0.0, minimum=-3.0, maximum=3.0),
    }
    num_substeps: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 200
    default_iterations: ClassVar[int] = 1
    starts_untouched: ClassVar[bool] = True

    def start(self, task, key):
        return jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5), jnp.zeros(1)

    def observe(self, task, world):
        return jnp.concatenate([jnp.sin(world.qpos), jnp.cos(world.qpos), world.qvel])

    def reward(self, task, world, action):
        return jnp.exp(-5 * jnp.abs(world.qpos[0] - task.goal["angle"]))


mtjax.register("lever", Lever, vary={"length": "0.3:0.6:4", "angle": "-0.8,0,0.8"})
