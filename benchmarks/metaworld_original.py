"""Play Meta-World's own environments and scripted policies, for ``benchmarks/metaworld_parity.py``.

It runs in an environment of its own with metaworld==3.1.1 and all that this needs, and imports nothing of mtjax. It
reads one JSON object from each line of standard input, and answers each with one line:

    {"do": "play", "task": NAME, "vectors": [(n,), ...]}: success at the end and at any step of an episode of each goal
    {"do": "time", "tasks": [NAME, ...], "processes": N, "steps": N}: control steps a second under random actions, of
        processes that share the tasks and send nothing to each other
"""

import json
import multiprocessing
import pickle
import sys
import time

import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP
from metaworld.types import Task


def begin(name, vector):
    """Return an environment of a task with a goal, and the first observation."""
    cls = ALL_V3_ENVIRONMENTS[f"{name}-v3"]
    env = cls()
    given = {"env_cls": cls, "rand_vec": np.asarray(vector), "partially_observable": False}
    env.set_task(Task(name, pickle.dumps(given)))
    return env, env.reset()[0]


def policy(task, obs):
    policy = ENV_POLICY_MAP[f"{task}-v3"]()
    actions = [policy.get_action(np.array(each)) for each in obs]  # a policy may write into what it is shown
    return np.clip(actions, -1, 1).tolist()


def play(task, vectors):
    found = []
    for vector in vectors:
        env, obs = begin(task, vector)
        successes = []
        for _ in range(env.max_path_length):
            (action,) = policy(task, [obs])
            obs, _, _, _, info = env.step(np.float32(action))
            successes.append(bool(info["success"]))
        found.append((successes[-1], any(successes)))
    return found


def draw(name):
    env = ALL_V3_ENVIRONMENTS[f"{name}-v3"]()
    env._freeze_rand_vec, env._set_task_called = False, True
    env.reset()
    return env


def run(tasks, steps, ready, times):
    envs, random = [draw(task) for task in tasks], np.random.default_rng(0)
    ready.wait()
    before = time.perf_counter()
    for i in range(steps):
        for env in envs:
            if i % env.max_path_length == 0:
                env.reset()
            env.step(np.float32(random.uniform(-1, 1, 4)))
    times.put((before, time.perf_counter()))


def rate(tasks, processes, steps):
    context = multiprocessing.get_context("spawn")
    ready, times = context.Barrier(processes), context.Queue()
    parts = [tasks[i::processes] for i in range(processes)]
    workers = [context.Process(target=run, args=(part, steps, ready, times)) for part in parts]
    for worker in workers:
        worker.start()
    begun, ended = zip(*[times.get() for _ in workers], strict=True)
    for worker in workers:
        worker.join()
    return len(tasks) * steps / (max(ended) - min(begun))


if __name__ == "__main__":
    DO = {"play": play, "time": rate}
    answers = sys.stdout
    sys.stdout = sys.stderr  # where Meta-World prints
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(DO[asked.pop("do")](**asked)), file=answers, flush=True)
