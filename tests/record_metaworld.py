"""Record episodes of Meta-World for the tests of ``mtjax.envs.metaworld``: tests/data/metaworld/NAME.npz.

It needs metaworld==3.1.1 with its own dependencies (mujoco 3.3.0, gymnasium, scipy), which cannot stand beside mtjax's,
so it runs in an environment of its own and imports nothing of mtjax:

    python tests/record_metaworld.py [NAME ...]

NAME may be ``goals``, and then writes tests/data/metaworld-goals.npz: the first and the last goal (T, 2, 6) that each
benchmark of BENCHMARKS draws for its seed, of every task in the benchmark's order, training tasks first. A vector of
three numbers ends with zeros. MT1-push is a single task's.

Each task has two episodes of its scripted policy, the second with noise on its actions. Every environment is new and
has been reset once, so that no earlier episode is felt. Windows of a few steps in a row are kept, evenly from the start
to just after the first success. Then come states that are posed, not simulated: things at the goal or about where they
are, the hand near them, any action; for what a scripted policy never does. A file holds, with E episodes and K kept
steps and poses:

    rand_vec (E, n) float64: the vector that Meta-World draws for an episode's goal
    start_qpos, start_qvel, start_mocap (E, 7: position and quaternion), start_obs (E, 39): after the reset
    const_NAME (E, ...): what the reset left in the environment's attribute of that name, in snake case. target is
        _target_pos, obj_init is obj_init_pos. One that is None until the first step has its value after it.
    boxes (2, 6 + n) float64: least and greatest place of the hand's target (3), goal in observations (3), and rand_vec
    live (n,): the constants that are views of the simulator's arrays and so change with every step
    watched (W,): "body:NAME", "site:NAME" or "geom:NAME" of all that the task's class reads, but for the robot
    episode, time (K,): which step is kept; time 1 is the first after the start, time -1 a pose
    action (K, 4); and after that step: qpos, qvel, mocap (K, 7), obs (K, 21: entries 0 to 18 of the observation and the
    goal, without the step before), tcp, left_pad, right_pad (K, 3), pose (K, W, 7: position and quaternion w x y z),
    reward, success (K,)
"""

import inspect
import pickle
import re
import sys
from pathlib import Path

import metaworld
import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

FOLDER = Path(__file__).parent / "data" / "metaworld"
WINDOWS, WINDOW, POSES = 5, 3, 11
PRESSED = ("stick-push-v3",)
NOISE = (0.0, 0.3)
LONGEST = 300
BENCHMARKS = {"MT10": 0, "MT25": 1, "MT50": 1, "ML10": 3, "ML45": 1}  # and their seeds
ALWAYS = ("_target_pos", "obj_init_pos", "init_tcp")
UNREAD = "init_(qpos|qvel)|_?prev_obs|_last_rand_vec|max[A-Z]|.*[hH]eight|target_reward"  # but by the first rewards
ROBOT = {"leftpad", "rightpad", "rightEndEffector", "leftEndEffector", "hand", "mocap"}
READS = {
    "body": r"(?:get_body_com|data\.body)\(\s*\"([^\"]+)\"",
    "site": r"(?:_get_site_pos|data\.site)\(\s*\"([^\"]+)\"",
    "geom": r"data\.geom\(\s*\"([^\"]+)\"",
}


def begin(name, vec):
    """Return a new environment of the task after its first reset, with the goal that the vector says."""
    cls = ALL_V3_ENVIRONMENTS[name]
    env = cls()
    given = {"env_cls": cls, "rand_vec": vec, "partially_observable": False}
    env.set_task(metaworld.Task(name, pickle.dumps(given)))
    fresh = {key: np.copy(value) for key, value in numbers(env).items()}
    obs, _ = env.reset()
    return env, obs, fresh


def draw_vec(name, seed):
    """Return a vector that the task's own reset accepts."""
    env = ALL_V3_ENVIRONMENTS[name]()
    env._freeze_rand_vec, env._set_task_called = False, True
    np.random.seed(seed)
    env.reset()
    return np.array(env._last_rand_vec)


def numbers(env):
    """Return the environment's attributes that are a float or up to eight of them."""
    found = {}
    for key, value in vars(env).items():
        array = np.asarray(value) if isinstance(value, float | np.floating | np.ndarray) else np.zeros(0)
        if 0 < array.size <= 8 and np.issubdtype(array.dtype, np.floating):
            found[key] = array
    return found


def constants(env, fresh):
    """Return what the reset has set, by name, and the names of those that are views of the simulator's arrays."""
    found, live = {}, []
    for key, value in numbers(env).items():
        if re.match(UNREAD, key):
            continue
        if key in ALWAYS or key not in fresh or not np.array_equal(fresh[key], value):
            short = re.sub(r"(?<=[a-z])([A-Z])", r"_\1", key.strip("_")).lower()
            short = {"target_pos": "target", "obj_init_pos": "obj_init"}.get(short, short)
            found[short] = np.copy(value)
            if any(np.shares_memory(value, getattr(env.data, a)) for a in ("xpos", "site_xpos", "geom_xpos")):
                live.append(short)
    return found, live


def watch(name):
    """Return "kind:NAME" of what the task's class reads from the simulator."""
    source = inspect.getsource(ALL_V3_ENVIRONMENTS[name])
    return sorted({f"{kind}:{n}" for kind, read in READS.items() for n in re.findall(read, source) if n not in ROBOT})


def pose(env, watched):
    """Return position and quaternion (7,) of a watched thing."""
    kind, name = watched.split(":")
    thing, quat = getattr(env.data, kind)(name), np.zeros(4)
    mujoco.mju_mat2Quat(quat, thing.xmat)
    return np.concatenate([thing.xpos, thing.xquat if kind == "body" else quat])


def press(env):
    """Return the normal forces (2,) of the left and the right pad on the main object, as ``touching_object`` does."""
    pads, thing = [env.data.geom(f"{side}pad_geom").id for side in ("left", "right")], env._get_id_main_object()
    touching = [[x for x in env.data.contact if {pad, thing} == {x.geom1, x.geom2}] for pad in pads]
    return np.array([sum(env.data.efc_force[x.efc_address] for x in contacts) for contacts in touching], np.float64)


def boxes(name):
    """Return the least and greatest hand's target, goal in observations, and drawn vector (2, 6 + n)."""
    env = ALL_V3_ENVIRONMENTS[name]()
    drawn, goal = env._random_reset_space, env.goal_space
    return np.stack(
        [np.hstack([env.mocap_low, goal.low, drawn.low]), np.hstack([env.mocap_high, goal.high, drawn.high])]
    )


def mocap(env):
    return np.concatenate([env.data.mocap_pos[0], env.data.mocap_quat[0]])


def show(env, name, time, action, obs, reward, info):
    """Return what is kept of the environment as it is, by name."""
    shown = {
        "time": time,
        "action": action,
        "qpos": np.copy(env.data.qpos),
        "qvel": np.copy(env.data.qvel),
        "mocap": mocap(env),
        "obs": np.concatenate([obs[:18], obs[36:]]),
        "tcp": env.tcp_center,
        "left_pad": np.copy(env.get_body_com("leftpad")),
        "right_pad": np.copy(env.get_body_com("rightpad")),
        "pose": np.stack([pose(env, x) for x in watch(name)]),
        "reward": reward,
        "success": bool(info["success"]),
    }
    return shown | {"press": press(env)} if name in PRESSED else shown


def put(env, name, random):
    """Pose the environment at random, and return what is kept of it."""
    model, data = env.model, env.data
    data.qvel[:] = 0
    for joint in range(model.njnt):
        at, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
        if model.joint(joint).name.startswith("right_j"):
            continue
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            places = (env._target_pos, env.obj_init_pos, np.add(env.obj_init_pos, [0, 0, 0.05]))
            data.qpos[at : at + 3] = places[random.integers(3)] + random.normal(size=3) * 0.03
            data.qpos[at + 3 : at + 7] += random.normal(size=4) * random.choice([0.003, 0.05])
        elif model.jnt_limited[joint]:
            data.qpos[at] = random.choice([low, high, random.uniform(low, high)])
        else:
            data.qpos[at] = random.normal() * 0.1
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    reach(model, data, env._get_pos_objects()[:3] + random.normal(size=3) * random.choice([0.01, 0.03, 0.1]))
    obs = np.clip(env._get_obs(), env.sawyer_observation_space.low, env.sawyer_observation_space.high)
    action = np.float32(random.uniform(-1, 1, size=4))
    return show(env, name, -1, action, obs, *env.evaluate_state(obs, action))


def reach(model, data, place):
    """Turn the arm until the tool centre is at a place, if it can be."""
    arm = [model.joint(f"right_j{i}") for i in range(7)]
    angles, speeds = ([joint.qposadr[0] for joint in arm], [joint.dofadr[0] for joint in arm])
    ends = [data.site(f"{side}EndEffector") for side in ("left", "right")]
    for _ in range(40):
        turns = np.zeros((2, 3, model.nv))
        for end, turn in zip(ends, turns, strict=True):
            mujoco.mj_jacSite(model, data, turn, None, end.id)
        turn, left = turns.mean(0)[:, speeds], place - (ends[0].xpos + ends[1].xpos) / 2
        data.qpos[angles] += turn.T @ np.linalg.solve(turn @ turn.T + 1e-3 * np.eye(3), left)
        mujoco.mj_forward(model, data)


def play(name, seed, noise):
    """Return the start of an episode, its kept steps up to a little after the first success, and poses after it."""
    env, obs, fresh = begin(name, draw_vec(name, seed))
    start = {"rand_vec": env._last_rand_vec, "start_qpos": env.data.qpos, "start_qvel": env.data.qvel}
    start = {key: np.copy(value) for key, value in start.items()} | {
        "start_mocap": mocap(env),
        "start_obs": np.copy(obs),
    }
    consts, live = constants(env, fresh)
    policy, random = ENV_POLICY_MAP[name](), np.random.default_rng(seed)
    steps, left = [], LONGEST
    while left:
        action = policy.get_action(np.copy(obs)) + noise * random.normal(size=4)  # some policies write into it
        action = np.float32(np.clip(action, -1, 1))
        obs, reward, _, _, info = env.step(action)
        steps.append(show(env, name, len(steps) + 1, action, obs, reward, info))
        if len(steps) == 1:
            consts = constants(env, fresh)[0] | consts
        left = min(left - 1, 4) if info["success"] else left - 1
    posed = [put(env, name, random) for _ in range(POSES)]
    return start | {f"const_{key}": value for key, value in consts.items()}, keep(steps), posed, len(steps), live


def keep(steps):
    """Return windows of steps in a row, evenly from the first to the last."""
    firsts = np.linspace(0, max(len(steps) - WINDOW, 0), WINDOWS).astype(int)
    chosen = sorted({first + i for first in firsts for i in range(WINDOW) if first + i < len(steps)})
    return [steps[i] for i in chosen]


def record(name):
    """Record a task and return how it went, in words."""
    starts, kept, ended = [], [], []
    for episode, noise in enumerate(NOISE):
        start, steps, posed, count, live = play(name, 10 + episode, noise)
        starts.append(start)
        kept += [{"episode": episode} | step for step in (*steps, *posed)]
        ended.append(f"{count} steps{', success' * steps[-1]['success']}")
    data = {key: np.stack([np.asarray(start[key]) for start in starts]) for key in starts[0]}
    data |= {key: np.stack([np.asarray(step[key]) for step in kept]) for key in kept[0]}
    small = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int16}
    data = {key: x if key == "rand_vec" else x.astype(small.get(x.dtype, x.dtype)) for key, x in data.items()}
    words = {"watched": np.array(watch(name)), "live": np.array(live, dtype=np.str_)}
    file = FOLDER / f"{name.removesuffix('-v3')}.npz"
    np.savez_compressed(file, boxes=boxes(name), **words, **data)
    return f"{len(kept)} steps kept of " + " and ".join(ended) + f"; {file.stat().st_size / 1000:.1f} kB; live: {live}"


def record_goals():
    """Record the benchmarks' goals and return how many tasks they have, in words."""
    found = {f"{name.lower()}-{seed}": getattr(metaworld, name)(seed=seed) for name, seed in BENCHMARKS.items()}
    found["push-3"] = metaworld.MT1("push-v3", seed=3)
    data = {name: np.concatenate([ends(of.train_tasks), ends(of.test_tasks)]) for name, of in found.items()}
    np.savez_compressed(FOLDER.parent / "metaworld-goals.npz", **data)
    return ", ".join(f"{name} {len(goals)}" for name, goals in data.items())


def ends(tasks):
    """Return the first and the last of every environment's goals (T, 2, 6)."""
    goals = {}
    for task in tasks:
        vec = pickle.loads(task.data)["rand_vec"]
        goals.setdefault(task.env_name, []).append(np.pad(vec, (0, 6 - len(vec))))
    return np.array([[of[0], of[-1]] for of in goals.values()]).reshape(-1, 2, 6)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    if sys.argv[1:] == ["goals"]:
        sys.exit(print(record_goals()))
    for task in sys.argv[1:] or [name.removesuffix("-v3") for name in ALL_V3_ENVIRONMENTS]:
        print(f"{task}: {record(f'{task}-v3')}", flush=True)
