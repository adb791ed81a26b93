"""What steps the worlds of a domain: engines of its models, under its settings of the solver."""

import copy
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np

from mtjax.envs.engines.base import Blank, Engine
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.engines.warp import Warp

DECIDING = ("dof_frictionloss", "tendon_frictionloss", "opt.density", "opt.viscosity")
"""Fields that decide by being 0 what MJX and Warp make programs of."""


def make_engine(domain: Any) -> Engine:
    """Return the engine that runs a domain. MuJoCo C keeps the model's own solver settings.

    Raises:
        InputError: the engine cannot run the model.
    """
    if domain.engine_name == "c":
        return MujocoC(domain.models, domain.num_substeps)
    if domain.engine_name == "warp":
        return Warp(base_model(domain, domain.warp_iterations), domain.num_substeps)
    engine = mjx_engine(domain)
    engine.require_runnable()
    return engine


def mjx_engine(domain: Any) -> Mjx:
    """Return the MJX engine of a domain, whichever runs it."""
    return Mjx(base_model(domain, domain.default_iterations), domain.num_substeps)


def base_model(domain: Any, iterations: int) -> mujoco.MjModel:
    """Return the first task's model with the solver settings of MJX or Warp.

    What they leave out of a program if the model has none of it is there if any task has it.
    """
    base = copy.copy(domain.models[0])
    for path in DECIDING:
        largest = np.max([attrgetter(path)(model) for model in domain.models], axis=0)
        *owner, field = path.split(".")
        setattr(attrgetter(*owner)(base) if owner else base, field, largest)
    base.opt.iterations = domain.solver_iterations or iterations
    base.opt.ls_iterations = 2 * base.opt.iterations
    if domain.integrator == "euler":
        base.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    if domain.simplify is not None:
        domain.simplify(base)
    return base


def without_physics(domain: Any) -> Any:
    """Return the same domain on an engine whose worlds stand still, which takes no time to trace."""
    blank = copy.copy(domain)
    vars(blank).update(table=domain.table, models=domain.models, simulator=Blank(domain.models[0]))
    return blank
