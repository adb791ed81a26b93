"""Step Meta-World's own environments, for ``benchmarks/metaworld_parity.py``.

It runs in an environment of its own with metaworld==3.1.1 and all that this needs, and imports nothing of mtjax. It
reads one JSON object from each line of standard input, and answers each with one line:

    {"do": "begin", "task": NAME, "vectors": [(n,), ...]}: begin an episode of each goal; observations (G, 39)
    {"do": "step", "actions": [(4,), ...]}: take a step of each episode; observations (G, 39), and successes (G,)
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
from metaworld.types import Task

PLAYED = []  # an environment of each goal


def begin(task, vectors):
    cls = ALL_V3_ENVIRONMENTS[f"{task}-v3"]
    PLAYED[:] = [cls() for _ in vectors]
    for env, vector in zip(PLAYED, vectors, strict=True):
        given = {"env_cls": cls, "rand_vec": np.asarray(vector), "partially_observable": False}
        env.set_task(Task(task, pickle.dumps(given)))
    return [env.reset()[0].tolist() for env in PLAYED]


def step(actions):
    steps = [env.step(np.float32(action)) for env, action in zip(PLAYED, actions, strict=True)]
    return [obs.tolist() for obs, *_ in steps], [bool(info["success"]) for *_, info in steps]


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
    DO = {"begin": begin, "step": step, "time": rate}
    answers = sys.stdout
    sys.stdout = sys.stderr  # where Meta-World prints
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(DO[asked.pop("do")](**asked)), file=answers, flush=True)
