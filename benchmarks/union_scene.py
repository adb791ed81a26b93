"""Measure one scene with the things of all of Meta-World's ten tasks (mt10) against a scene for each kind of task.

    python benchmarks/union_scene.py [--engine warp] [--worlds 4096] [--steps 200] [--json FILE]

The union is composed from the scenes of the installed package. Each world uses the things of its own task. Others are
parked far away: fixed ones by their place in the world's own model, and free ones in the air, without weight. So one
simulator steps all worlds, of 25 degrees of freedom each. The contestants are the union, the six simulators into which
mtjax joins the ten families, and these families one after another. It is physics alone: random actions move the hand
and close the gripper, without observations, rewards and resets. All are compiled first and then timed in turn.
"""

import argparse
import copy
import statistics
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from report import publish
from steps_per_second import Contestant

import mtjax
from mtjax.envs.domain import stack_differing
from mtjax.envs.engines.base import World, at_rest
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.warp import Warp
from mtjax.envs.metaworld import scene
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import InputError, Task

_BASE = "sawyer_reach_v3"  # with the arm, the table and the puck, which reach, push and pick-place share
_OTHERS = {  # scene -> the bodies that are its task's
    "sawyer_door_pull": ("door",),
    "sawyer_drawer": ("drawer",),
    "sawyer_button_press_topdown": ("box",),
    "sawyer_peg_insertion_side": ("peg", "box"),
    "sawyer_window_horizontal": ("window",),
}
_FREE = mujoco.mjtJoint.mjJNT_FREE
_ARM = 9  # numbers of qpos
_FAR = 10.0  # [m] between parked things
_LIGHT = 1e-6  # of the weight, that is held up though the thing is used: MuJoCo counts bodies that are held up


class Simulated(NamedTuple):
    """Worlds that one simulator steps, one for each task."""

    engine: Any
    models: list[mujoco.MjModel]
    starts: list[World]


def main() -> None:
    on_cpu = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="c" if on_cpu else "warp", choices=("c", "warp"))
    parser.add_argument("--worlds", type=int, default=160 if on_cpu else 4096, help="of all ten tasks")
    parser.add_argument("--steps", type=int, default=200, help="control steps in a timed call")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    env = mtjax.make("mt10", num_draws=1, engine=arguments.engine)
    families: list[Any] = list(env.families)
    contestants, per_task = [], -(-arguments.worlds // len(families))
    for name, parts in {
        "union, one simulator": [union(families)],
        f"joined, {len(env.groups)} simulators": [apart(list(group.members.values())) for group in env.groups],
        f"apart, {len(families)} simulators": [apart([family]) for family in families],
    }.items():
        sizes = "/".join(str(part.models[0].nv) for part in parts)
        make = lambda parts=parts: program(parts, per_task, arguments.steps)
        contestants.append(Contestant(name, per_task * len(families), arguments.steps, make))
        print(f"{name}: nv {sizes}, compiled in {contestants[-1].first_call_seconds:.0f} s", flush=True)
    for _ in range(arguments.rounds):
        for contestant in contestants:
            contestant.time()
    rows = [
        {
            "contestant": each.name,
            "worlds": each.worlds,
            "steps_per_second": statistics.median(each.rates),
            "slowest": min(each.rates),
            "fastest": max(each.rates),
            "first_call_seconds": each.first_call_seconds,
        }
        for each in contestants
    ]
    for row in rows:
        print(f"{row['contestant']:28} {row['worlds']:6} {row['steps_per_second']:12,.0f} steps/s")
    publish(arguments, rows)


def apart(families: list[Sawyer]) -> Simulated:
    """Return the worlds of families that share a scene, each as its first goal begins."""
    models = [family.models[0] for family in families]
    states = [family.starts_of_goals[0].state for family in families]
    starts = [World(**{name: jnp.float32(x) for name, x in state.items()}) for state in states]
    return Simulated(families[0].join_simulator(models), models, starts)


def union(families: list[Sawyer]) -> Simulated:
    """Return the worlds of all families in the union scene, as their first goals begin."""
    base = compose().compile()
    if not isinstance(families[0].simulator, MujocoC):
        base.opt.iterations, base.opt.ls_iterations = families[0].warp_iterations, 2 * families[0].warp_iterations
    made = [in_union(base, family) for family in families]
    models, starts = [model for model, _ in made], [world for _, world in made]
    substeps = families[0].num_substeps
    engine = MujocoC(models, substeps) if isinstance(families[0].simulator, MujocoC) else Warp(models[0], substeps)
    return Simulated(engine, models, starts)


def compose() -> mujoco.MjSpec:
    """Return the editable union, with sensors of the hand and of all that tasks watch in their scenes."""
    spec = scene.read(_BASE, {"puck": "body:obj"})
    spec.body("obj").gravcomp = _LIGHT
    for name, bodies in _OTHERS.items():
        other = scene.read(name, {})
        for body in bodies:
            spec.worldbody.add_frame().attach_body(other.body(body), f"{name}/", "")
            thing = spec.body(f"{name}/{body}")
            thing.gravcomp = _LIGHT if any(joint.type == _FREE for joint in thing.joints) else 0
            scene.add_sensor(spec, mujoco.mjtSensor.mjSENS_FRAMEPOS, f"position:{name}/{body}", f"body:{name}/{body}")
            scene.add_sensor(spec, mujoco.mjtSensor.mjSENS_FRAMEQUAT, f"quat:{name}/{body}", f"body:{name}/{body}")
    return spec


def in_union(base: mujoco.MjModel, family: Sawyer) -> tuple[mujoco.MjModel, World]:
    """Return the union's model for a family's first goal, with other things parked, and the world as it begins."""
    start, model = family.starts_of_goals[0], copy.copy(base)
    qpos, qvel = np.array(base.qpos0), np.zeros(base.nv)
    qpos[:_ARM] = start.state["qpos"][:_ARM]
    things = [("", "obj"), *((f"{name}/", body) for name, bodies in _OTHERS.items() for body in bodies)]
    prefix = f"{family.scene_file}/" if family.scene_file in _OTHERS else ""
    used = _ARM
    for i, (owner, body) in enumerate(things):
        thing = base.body(owner + body).id
        joints = np.flatnonzero(base.body_rootid[base.jnt_bodyid] == thing)
        begins = [base.jnt_qposadr[j] + np.arange(7 if base.jnt_type[j] == _FREE else 1) for j in joints]
        places = np.concatenate([[], *begins]).astype(int)
        if owner == prefix:
            model.body_pos[thing] = start.model.body(body).pos
            qpos[places] = start.state["qpos"][used : used + len(places)]
            used += len(places)
        elif base.body_gravcomp[thing]:
            qpos[places[:3]], model.body_gravcomp[thing] = [_FAR * (i + 1), 0, 1], 1
        else:
            model.body_pos[thing] = [_FAR * (i + 1), 0, 0.5]
    mocap = jnp.float32(start.state["mocap"])
    return model, at_rest(base, jnp.float32(qpos), jnp.float32(qvel), None, mocap)


def program(parts: list[Simulated], per_task: int, steps: int) -> Any:
    """Return a function that takes some control steps of all worlds in one compiled scan."""

    def begin(part: Simulated) -> tuple[Task, World]:
        rows = np.repeat(np.arange(len(part.models)), per_task)
        leaves = {name: jnp.float32(x[rows]) for name, x in stack_differing(part.models).items()}
        task = Task(jnp.int32(rows), jnp.int32(rows), jnp.float32(rows), {}, leaves, {}, jnp.int32(rows))
        return task, jax.tree.map(lambda *x: jnp.stack(x)[rows], *part.starts)

    def step(part: Simulated, task: Task, world: World, key: Any) -> World:
        action = jax.random.uniform(key, (len(task.row), 4), minval=-1.0)
        low, high = jnp.array(Sawyer.hand_low), jnp.array(Sawyer.hand_high)
        hand = jnp.clip(world.mocap[:, 0, :3] + 0.01 * action[:, :3], low, high)
        ctrl = jnp.stack([action[:, 3], -action[:, 3]], axis=1)
        return jax.vmap(part.engine.step)(task, world._replace(mocap=world.mocap.at[:, 0, :3].set(hand)), ctrl)

    def play(tasks: list[Task], worlds: list[World], key: Any) -> tuple[list[World], Any]:
        def once(worlds: list[World], key: Any) -> tuple[list[World], Any]:
            keys = jax.random.split(key, len(parts))
            moved = [step(*each) for each in zip(parts, tasks, worlds, keys, strict=True)]
            return moved, sum(jnp.sum(world.sensors) for world in moved)

        return jax.lax.scan(once, worlds, jax.random.split(key, steps))

    key = jax.random.key(0)
    tasks, worlds = map(list, zip(*map(begin, parts), strict=True))
    lowered = jax.jit(play).lower(tasks, worlds, key)
    for part in parts:
        part.engine.load_kernels()
    compiled = lowered.compile()

    def run() -> Any:
        moved, seen = compiled(tasks, worlds, key)  # always from the start, so that all rounds have the same contacts
        if not np.all(np.isfinite(seen)):
            raise SystemExit("a world diverged")
        return moved

    return run


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
