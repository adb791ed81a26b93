"""How episodes of Meta-World's tasks begin: for every goal once, on the host."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from mtjax.envs.compiled import compile_model
from mtjax.envs.metaworld.goals import draw_goals
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.names import TASKS, listed_with
from mtjax.names import load


class Start(NamedTuple):
    """How an episode of one goal begins."""

    model: mujoco.MjModel
    began: dict[str, np.ndarray]  # what the reward compares with
    state: dict[str, np.ndarray]  # of the physics, by its name in World


class Starting(Protocol):
    """A task whose episodes begin on the host; ``Sawyer`` says what each of these is."""

    benchmark: str
    num_draws: int
    task_seed: int
    test_goals: bool
    hand_start: tuple[float, ...]

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, Any]: ...
    def vectors(self) -> np.ndarray: ...


def name_in_metaworld(family: Any) -> str:
    """Return a task's name in Meta-World."""
    place = f"{type(family).__module__.rpartition('.')[2]}:{type(family).__name__}"
    return next((name for name, known in TASKS.items() if known == place), type(family).__name__)


def vectors(family: Starting) -> np.ndarray:
    """Return the vectors (P, K) of all goals of a task, first those of training."""
    own = name_in_metaworld(family)
    names, tasks = [own], (family,)
    if family.benchmark:
        names = listed_with(family.benchmark, own)
        tasks = tuple(load(f"mtjax.envs.metaworld.{TASKS[name]}")() for name in names)
    seeds = [family.task_seed + i for i in range(1 + family.test_goals)]
    place = names.index(own)
    return np.concatenate([draw_goals(tasks, seed, family.num_draws)[place] for seed in seeds])


def starts_of_goals(family: Starting) -> tuple[Start, ...]:
    """Return how episodes of a task begin, for every goal."""
    settled = Host(compile_model(family, {})).settle(family.hand_start)
    with ThreadPoolExecutor() as pool:
        return tuple(pool.map(partial(begin, family, settled, settled.content()), family.vectors()))


def of_rows(family: Any) -> tuple[Start, ...]:
    """Return how episodes begin in every row of a table: of each listed task's first goal, and then of every goal."""
    return (*family.starts_of_goals[:: family.num_draws], *family.starts_of_goals)


def begin(family: Starting, settled: Host, content: bytes, vec: np.ndarray) -> Start:
    """Begin an episode as Meta-World does, which resets twice: the second time, moved things are in place.

    Args:
        settled: the scene with nothing moved, whose hand has settled.
        content: its model.
        vec: (K,) of the goal.
    """
    host, model = settled.copy(), settled.model
    family.arrange(host, vec)
    if host.content() == content:
        host = settled.copy()
    else:
        host, model = host.settle(family.hand_start), host.model
    tcp, data = host.tcp(), host.data
    began = {"init_tcp": tcp} | {name: np.asarray(x, np.float64) for name, x in family.arrange(host, vec).items()}
    state = {"qpos": data.qpos, "qvel": data.qvel, "warmstart": data.qacc_warmstart, "sensors": data.sensordata}
    state["mocap"] = np.concatenate([data.mocap_pos, data.mocap_quat], axis=1)
    return Start(model, began, {name: x.copy() for name, x in state.items()})
