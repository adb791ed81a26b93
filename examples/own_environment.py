"""A family of your own: a cart on a spring is to stand at a goal, whatever the spring.

python -m mtjax.train --import=examples/own_environment.py --env=spring --agent=care --steps=200000
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

import mtjax
from mtjax.envs import Domain, Parameter
from mtjax.envs.parameters import MASS


def set_stiffness(spec, value):
    """Parameters of the physics edit MuJoCo's model specification; MuJoCo derives whatever follows from it."""
    spec.joint("slide").stiffness[0] = value


@dataclasses.dataclass(frozen=True)
class Spring(Domain):
    """Hold a cart at the task's goal. Observation (2,): position [m], velocity [m/s]. Action (1,): force / 10 N."""

    model_file: ClassVar[str] = """
      <mujoco>
        <option timestep="0.01"/>
        <worldbody>
          <body name="cart">
            <joint name="slide" type="slide" axis="1 0 0" damping="1"/>
            <geom type="box" size="0.1 0.05 0.05" mass="1"/>
          </body>
        </worldbody>
        <actuator><motor joint="slide" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
      </mujoco>"""
    parameters: ClassVar = {
        "stiffness": Parameter("N/m", 0.0, set_stiffness, minimum=0.0),
        "mass": MASS,
        "goal": Parameter("m", 0.0, minimum=-1.0, maximum=1.0),  # no edit: it reaches the reward as task.goal["goal"]
    }
    num_substeps: ClassVar[int] = 2  # of the physics in a step of the agent
    episode_steps: ClassVar[int] = 100  # the time limit, which truncates: values are bootstrapped beyond it
    default_iterations: ClassVar[int] = 1  # of the solver in MJX, as nothing touches or has limits here; else 8
    starts_untouched: ClassVar[bool] = True  # no force sensor feels anything in a start: resets need not solve for it

    def start(self, task, key):
        return jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5), jnp.zeros(1)

    def observe(self, task, world):
        return jnp.concatenate([world.qpos, world.qvel])

    def reward(self, task, world, action):
        return jnp.exp(-10 * jnp.abs(world.qpos[0] - task.goal["goal"]))

    def terminates(self, task, world):
        """Whether the episode ends here, with no rewards after it. Without this method only the time limit ends one."""
        return jnp.abs(world.qpos[0]) > 2.0


# The methods are called once with abstract arrays, so that a wrong shape or name is told at once.
mtjax.register("spring", Spring, vary={"stiffness": "5:20:4", "goal": "-0.3,0,0.3"})
