"""Steps in the host's memory: a store beside plain lists, segments on the device, and how often each age is drawn."""

import dataclasses
import shutil
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT_RUN
from probes import Stub, Walk, one_in, tiny, train_objects
from test_pictures import Episodes
from test_run import bytes_of

import mtjax
from mtjax.command import run_config
from mtjax.config import configure
from mtjax.envs.probes import Pictured
from mtjax.experience import Replay, pictures, store
from mtjax.experience import ring as rings
from mtjax.experience.replay import recall
from mtjax.experience.store import Store
from mtjax.learning import loop
from mtjax.learning.loop import Settings
from mtjax.names import Notice
from mtjax.saved import checkpoint
from mtjax.saved.policy import state_shapes
from mtjax.training import memory, run
from mtjax.types import InputError, Transition

SEEDS, TASKS, ENVS = 2, 2, 3
KEYS = np.uint32([[0, 1], [0, 2]])


def coded(first, last):
    """Steps ``first`` to ``last`` - 1 of all environments, rows (S, T, H, E, 4) that say seed, task, env and step."""
    places = np.meshgrid(*map(np.arange, (SEEDS, TASKS)), np.arange(first, last), np.arange(ENVS), indexing="ij")
    return np.stack([places[i] for i in (0, 1, 3, 2)], axis=-1).astype(np.int32)


def filled(num_slots, *ends):
    kept = Store(coded(0, 1), num_slots)
    for first, last in zip((0, *ends), ends, strict=False):
        kept.add(coded(first, last))
    return kept


@pytest.mark.parametrize("ends", [(4,), (4, 10), (4, 10, 14, 20), (7, 14, 21)])
def test_a_store_holds_the_last_steps_of_a_plain_list(ends):
    """Before and after it wraps around; filled backwards it holds the same."""
    kept, last = filled(10, *ends), ends[-1]
    first = max(last - 10, 0)
    slots = np.arange(first, last) % 10
    assert (kept.first, kept.count) == (first, last)
    np.testing.assert_array_equal(kept.rows[:, :, slots], coded(first, last))
    backwards = Store(coded(0, 1), 10, last)
    for start, end in reversed([*zip((0, *ends), ends, strict=False)]):
        backwards.add_before(coded(start, end)) if end > first else None
    np.testing.assert_array_equal(backwards.rows, kept.rows)
    assert (backwards.first, backwards.count) == (first, last)


def test_segments_are_runs_of_steps_of_one_environment():
    """Of their own seed and task, of any environment, and between those too old after five more steps, 25 to 29, and
    the fifteen that the ring will hold, from 55 on. A key and a count decide them.
    """
    kept = filled(40, 30, 60, 65)
    found = kept.draw(KEYS, 5, 15, 50, 4)
    assert found.shape == (SEEDS, TASKS, 200, ENVS, 4)
    runs = np.moveaxis(found.reshape(SEEDS, TASKS, 50, 4, ENVS, 4), 3, 4)
    for seed, task in np.ndindex(SEEDS, TASKS):
        assert np.all(runs[seed, task, ..., 0] == seed) and np.all(runs[seed, task, ..., 1] == task)
    assert np.all(np.ptp(runs[..., 2], axis=-1) == 0) and np.all(np.diff(runs[..., 3], axis=-1) == 1)
    assert {*runs[..., 0, 2].flat} == set(range(ENVS)) and {*runs[..., 0, 3].flat} == set(range(30, 52))
    np.testing.assert_array_equal(found, kept.draw(KEYS, 5, 15, 50, 4))
    assert np.mean(runs[0, ..., 2:] == runs[1, ..., 2:]) < 0.5
    kept.add(coded(65, 66))
    assert not np.array_equal(found, kept.draw(KEYS, 4, 15, 50, 4))  # from the same steps


@pytest.mark.parametrize(
    ("slots", "window", "grain", "expected"),
    [(1000, 0, 1, (31, 16)), (1000, 7, 1, (8, 56)), (60, 7, 1, (1, 30)), (1000, 3, 5, (20, 25)), (13, 7, 1, (0, 1))],
)
def test_segments_take_half_of_the_slots(slots, window, grain, expected):
    """With room for windows, in whole calls of learn; none if a window does not fit."""
    assert store.segments(slots, window, grain) == expected


class Rounds:
    """Rounds of chunks on the device and the host by a replay's own functions, on rows that say where they are from."""

    def __init__(self, rows, num_slots, stored, chunk, window):
        """Make a replay of so many slots, of which ``stored`` are on the host, for steps ``rows`` (T, H, E, ...)."""
        self.rows, self.chunk, self.stored, self.window, self.time = rows, chunk, stored, window, 0
        count, self.length = store.segments(num_slots, window, 1)
        self.latest, self.count = num_slots - count * self.length, count
        envs = jax.tree.leaves(rows)[0].shape[2]
        item = jax.tree.map(lambda x: x[0, 0, 0], rows)
        self.ring = rings.init(item, len(jax.tree.leaves(rows)[0]), self.latest, envs, (count, self.length))
        self.store = Store(jax.tree.map(lambda x: x[None], rows), stored)
        self.number = store.recalled_rows(chunk, count, self.length)
        step = lambda ring, items: (rings.add(ring, items), None)
        self.add = jax.jit(lambda ring, items: jax.lax.scan(step, ring, items)[0])
        self.recall = jax.jit(rings.recall)
        self.newest = jax.jit(partial(rings.newest, count=chunk))
        self.sample = jax.jit(rings.sample, static_argnums=(2, 3))

    def round(self):
        """Take a chunk's steps, and exchange as a run does, which knows the store of the round before."""
        end = self.time + self.chunk
        drawn = self.store.draw(KEYS[:1], self.chunk, self.latest, self.number, self.length)
        one_by_one = lambda x: np.moveaxis(x[:, self.time : end, None], 1, 0)
        self.ring = self.add(self.ring, jax.tree.map(one_by_one, self.rows))
        self.time = end
        self.store.add(jax.tree.map(lambda x: np.asarray(x)[None], self.newest(self.ring)))
        if drawn is not None:
            self.ring = self.recall(self.ring, jax.tree.map(lambda x: x[0], drawn))

    def draw(self, seed, number, steps=0):
        """Draw windows ``steps`` after the end of the last chunk, of steps that are in the ring already."""
        stored = jnp.int32(min(self.time, self.stored))
        return jax.tree.map(
            np.asarray, self.sample(rings.weigh(self.ring, stored), jax.random.key(seed), number, self.window)
        )


@pytest.mark.parametrize("window", one_in(2, [3, 0]))
def test_every_age_is_drawn_in_the_share_that_the_module_tells(window):
    """Ages of the first steps of windows, at the ends of chunks: as the segments' starts say, and nearly uniform."""
    slots, stored, chunk, rounds = 160, 500, 10, 400
    made = Rounds(coded(0, chunk * rounds)[0], slots, stored, chunk, window)
    delays = np.arange(made.count) // made.number * chunk  # of the rows of segments
    ages = []
    for i in range(rounds):
        made.round()
        if made.time < stored + made.latest + 100:
            continue
        rows = made.draw(i, 400).reshape(TASKS, 400, -1, 4)
        assert np.all(np.diff(rows[..., 3], axis=2) == 1) and np.all(np.ptp(rows[..., :3], axis=2) == 0)
        ages.append(made.time - 1 - rows[:, :, 0, 3].ravel())
    share = np.bincount(np.concatenate(ages), minlength=600)[:600] / np.size(ages)
    assert np.isclose(share.sum(), 1)

    every, width = np.arange(600), max(window, 1)
    alike = lambda low, high: ((every >= low) & (every < high)) / (high - low)
    expected = made.latest / stored * alike(width - 1, made.latest)
    offsets = np.ones(made.length - width + 1) / (made.length - width + 1)
    for delay in delays:
        starts = alike(made.latest + delay + made.length - 1, stored + delay)
        early = np.convolve(starts, offsets)[len(offsets) - 1 :]
        expected += (1 - made.latest / stored) / made.count * early
    bins = lambda x: x.reshape(-1, 20).sum(axis=1)
    assert np.abs(bins(share - expected)).max() < 0.006  # of 0.04 each

    distance = np.abs(expected - alike(0, stored)).sum() / 2
    assert distance < ((delays.max() + chunk + made.length) / 2 + window) / stored
    assert np.abs(bins(share - alike(0, stored))).sum() / 2 < distance + 0.03


@pytest.mark.parametrize("n_step", [1, 3])
def test_stacks_and_returns_of_recalled_windows_are_those_of_a_plain_list(n_step):
    """Windows of a store several times as large as the ring, in which episodes end anywhere, never cross a seam."""
    random, gamma, frames = np.random.default_rng(n_step), 0.9, 3
    lengths = random.integers(2, 12, 60)
    episodes = Episodes(lengths, random.random(60) < 0.4)
    total = len(episodes.steps) // 10 * 10
    rows = jax.tree.map(lambda x: x[None, :total, None], episodes.rows())
    made = Rounds(rows, 80, 200, 10, pictures.window(frames, n_step))
    join = jax.jit(partial(pictures.join, frames=frames, n_step=n_step))
    found, before = 0, total
    for i in range(total // 10):
        made.round()
        if made.time < 100:
            continue
        windows = jax.tree.map(lambda x: x[0], made.draw(i, 40))
        joined = jax.tree.map(np.asarray, join(windows, gamma))
        for k, first in enumerate(windows.action[:, 0, 0].astype(int) - 1):  # actions count steps from 1
            np.testing.assert_array_equal(windows.action[k, :, 0], np.arange(first, first + made.window) + 1)
            obs, reward, discount, after = episodes.expected(first + frames, frames, n_step, gamma)
            np.testing.assert_array_equal(joined.obs["pixels"][k], obs)
            np.testing.assert_allclose([joined.reward[k], joined.discount[k]], [reward, discount], rtol=1e-5)
            if after is not None:
                np.testing.assert_array_equal(joined.next_obs["pixels"][k], after)
            old = first + made.window <= made.time - made.latest
            found, before = found + old, min(before, first)
    assert found > 300 and before < 20


def test_segments_are_written_in_place():
    """A replay that fills a device has no room for a copy of itself."""
    replay, spec = Replay(replay_size=4000, host_replay_size=8000), Walk().spec
    item = Transition(*[jnp.zeros(40)] * 2, jnp.float32(0), jnp.float32(0), jnp.zeros(40), jnp.bool_(0))
    data = jax.eval_shape(lambda keys: replay.init(item, spec, TASKS, 4, keys), jax.random.split(jax.random.key(0), 2))
    segments = jax.tree.map(lambda x: jax.ShapeDtypeStruct((*x.shape[:2], 64, *x.shape[3:]), x.dtype), data.ring.rows)
    used = jax.jit(recall, donate_argnums=0).lower(data, segments).compile().memory_analysis()
    assert used.temp_size_in_bytes < checkpoint.size_of(segments) < checkpoint.size_of(data) / 10


# Runs.

PLAY = {"num_envs": 2, "batch_size": 4, "warmup_steps": 4, "chunk_steps": 10, "stagger": False, "n_step": 2}
SPILL = PLAY | {"replay_size": 80, "host_replay_size": 160}


@dataclasses.dataclass(frozen=True)
class Reader(Stub):
    """Sums what it is given, so that its state tells every batch that it saw."""

    def init(self, spec, tasks, key):
        return jnp.zeros(len(tasks.id))

    def planned(self, steps):
        return self

    def update(self, state, window, tasks, key, number):
        return 0.9 * state + jnp.sum(window.obs[:, :, 0, 0], axis=1), {"seen": jnp.sum(state)}


def play(directory, chunks, settings=SPILL, **changes):
    if directory is not None:
        directory.mkdir(exist_ok=True)
    steps = {"steps": 40 * chunks, "eval_every": 200, "eval_episodes": 1}
    return train_objects(Walk(), Reader(), directory=directory, **settings, **{"seeds": 2, **steps, **changes})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of twenty chunks that nothing interrupted."""
    return play(tmp_path_factory.mktemp("whole"), 20)


@pytest.mark.slow
def test_a_run_keeps_its_steps_in_its_folder(whole):
    """All that a resumed run may need, and not those before: the steps that a large replay on the device holds."""
    files = sorted((whole.directory / "store").iterdir(), key=lambda path: int(path.stem))
    assert [int(path.stem) for path in files] == list(range(80, 201, 10))  # 80 before the checkpoint of step 150
    large = play(None, 20, PLAY | {"replay_size": 2 * 200, "updates_per_step": 0}).state.data.ring.rows
    for i, rows in enumerate(jax.tree.leaves(large)):
        kept = np.concatenate([np.load(path)[f"arr_{i}"] for path in files], axis=2)
        np.testing.assert_array_equal(kept, np.asarray(rows)[:, :, 70:])


@pytest.mark.slow
@pytest.mark.parametrize("lost", [None, "130"])
def test_a_run_goes_on_bit_for_bit(whole, tmp_path, lost):
    """Also from the checkpoint before, with later steps in the folder, which it takes again."""
    half = play(tmp_path / "run", 13)  # with checkpoints of steps 100 and 130
    assert bytes_of(half.state) != bytes_of(whole.state)
    if lost:
        shutil.rmtree(tmp_path / "run" / "checkpoints" / lost)
    result = play(tmp_path / "run", 20, resume=True)
    assert bytes_of(result.state) == bytes_of(whole.state)
    names = lambda folder: {path.name: path.read_bytes() for path in (folder / "store").iterdir()}
    found, expected = names(result.directory), names(whole.directory)
    assert {name: found[name] for name in expected} == expected


@pytest.mark.slow
def test_lost_steps_are_told_and_the_run_goes_on(tmp_path):
    """Without those before the file that is damaged; their segments are no longer drawn."""
    play(tmp_path / "run", 10)
    (tmp_path / "run" / "store" / "70.npz").write_bytes(b"no archive")
    with pytest.warns(Notice, match=r"70.npz' is missing or damaged; the run goes on without the steps"):
        result = play(tmp_path / "run", 20, resume=True)
    assert np.all(np.isfinite(result.state.agent)) and float(result.state.data.ring.recalled.share) > 0.5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"host_replay_size": -1}, "host-replay-size must be at least 0, not -1"),
        ({"host_replay_size": 80}, r"host-replay-size \(80\) must be more than replay-size \(80\)"),
        (
            {"replay_size": 8, "chunk_steps": 1, "n_step": 3},
            "with host-replay-size, replay-size must be at least 12, not 8",
        ),
        ({"chunk_steps": 30}, "keeps the latest 24 steps of every environment until a chunk ends, and one takes 25"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, message):
    """Before anything compiles, with the fix."""
    with pytest.raises(InputError, match=message):
        mtjax.train(Walk(), tiny("sac"), steps=4000, **SPILL | settings)


# Memory.


class Coloured(Pictured):
    """A probe with pictures in colour."""

    @property
    def spec(self):
        obs = {"pixels": jax.ShapeDtypeStruct((*super().spec.obs["pixels"].shape[:2], 3), jnp.uint8)}
        return super().spec._replace(obs=obs)

    def show(self, step):
        shown = super().show(step)
        return shown._replace(obs={"pixels": jnp.repeat(shown.obs["pixels"], 3, axis=-1)})


def needs(monkeypatch, device, host=1e12, seeds=5, backend="gpu", **given):
    """What a run from pictures needs, on a machine with so much memory on the device and on the host."""
    limit = [types.SimpleNamespace(memory_stats=lambda: {"bytes_limit": device})]
    monkeypatch.setattr(memory, "host_bytes", lambda: host)
    monkeypatch.setattr(jax, "local_devices", lambda: limit)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    env, pictured = Coloured(), {"num_envs": 2, "warmup_steps": 10, "chunk_steps": 10}
    agent, settings = configure(mtjax.agent("drq", n_step=1), Settings(), {**pictured, **given})
    tasks, key = env.tasks(), jnp.arange(seeds)
    state = jax.eval_shape(partial(loop.init, env, agent, settings), tasks, key)
    found = memory.Needs.of(state, env.spec, agent, settings)
    memory.require_room(found, env.spec)
    told = memory.tell(state.data, found, agent.experience.describe(env.spec, 2), seeds)
    return state, found, told


def test_memory_is_told_by_seed_for_device_and_host(monkeypatch):
    """Both grow with their sizes; a round of the exchange counts on both, and a CPU holds both."""
    state, alone, told = needs(monkeypatch, 1e12, replay_size=4000)
    assert (alone.moved, alone.host, alone.device) == (0, 0, alone.state)
    assert len(told) == 1 and "(4,000 transitions a task)" in told[0]
    both_sizes = {"replay_size": 4000, "host_replay_size": 40_000}
    spilled, both, told = needs(monkeypatch, 1e12, **both_sizes)
    slot, rows = (checkpoint.size_of(x.data.ring.rows) / 2000 for x in (state, spilled))
    moved = 10 + 64  # steps that a round takes, and brings back in two segments of 32
    assert slot == rows and (both.moved, both.host) == (moved * slot, (20_000 + moved) * slot)
    assert both.device == both.state + both.moved and both.state == pytest.approx(alone.state, rel=0.001)
    assert f"(4,000 transitions a task, and 40,000 on the host); {both.state / 5e6:,.0f} MB a seed" in told[0]
    by_seed = (
        f"memory of the host: {both.host / 1e6:,.0f} MB of replay; {both.host / 5e6:,.0f} MB a seed; a round moves"
    )
    assert told[1].startswith(by_seed)
    assert needs(monkeypatch, 1e12, backend="cpu", **both_sizes)[1].device == both.state + both.moved + both.host


def test_pictures_of_rollouts_count(monkeypatch, short_family):
    """Two stacks of three pictures with three channels, of each step of every seed, task and environment.

    They decide whether a run fits at all, and how many of its seeds run at once.
    """
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    env, settings = Coloured(frames=3), Settings(num_envs=4)
    rollout = 5 * 2 * 4 * 10 * 2 * (16 * 16 * 9)

    def of(unroll):
        agent = mtjax.agent("ppo", representation="encoded", hidden=(8,), latent_widths=(4,), unroll=unroll)
        state = jax.eval_shape(partial(loop.init, env, agent, settings), env.tasks(), jnp.arange(5))
        return memory.Needs.of(state, env.spec, agent, settings)

    short, long = of(10), of(200)
    assert (short.rollout, long.rollout) == (rollout, 20 * rollout)
    assert short.state == long.state and short.device == short.state + rollout
    monkeypatch.setattr(memory, "physical_bytes", lambda: long.device - 1)
    memory.require_room(short, env.spec)
    with pytest.raises(
        InputError, match=r"of rollouts\) and .* lower --agent.unroll, --num-envs or --seeds; with --env"
    ):
        memory.require_room(long, env.spec)
    config = run_config.parse([*SHORT_RUN, "--seeds=5"])
    for needs, rounds in ((long, [2, 2, 1]), (short, [5])):
        monkeypatch.setattr(memory, "_needs", lambda _, needs=needs: needs)
        parts = memory.split_to_fit(config, 0.6 * long.device)
        assert [part.plan.seeds for part in parts] == rounds


SMALLER = "and there are 0.1 GB; lower --replay-size, --num-envs or --seeds"


@pytest.mark.parametrize(
    ("given", "messages"),
    [
        (
            {"replay_size": 10**5},
            [SMALLER, "; with --env.grey pictures take a third; with --host-replay-size=N the host"],
        ),
        (
            {"device": 1e12, "host": 1e8},
            ["the replay on the host needs .* the machine has 0.1 GB; lower --host-replay"],
        ),
        ({"replay_size": 500, "backend": "cpu"}, ["of the host's replay", f"{SMALLER}, or --chunk-steps and --host"]),
    ],
    ids=["device", "host", "both are one"],
)
def test_what_no_memory_could_hold_is_refused_with_the_fix(monkeypatch, given, messages):
    """On the device, on the host, and on a CPU, whose memory holds both."""
    host = {} if given.get("replay_size") == 10**5 else {"host_replay_size": 300_000}
    for message in messages:
        with pytest.raises(InputError, match=message):
            needs(monkeypatch, **{"device": 1e8, **host, **given})


def test_it_is_refused_before_anything_compiles(monkeypatch):
    """By the devices' limit, as the run itself reads it."""
    monkeypatch.setattr(memory, "physical_bytes", lambda: 1e4)
    monkeypatch.setattr(run, "compile_lowered", None)
    with pytest.raises(InputError, match=r"the run needs 0.0 GB .* of worlds and data"):
        play(None, 1)


def test_seeds_run_in_rounds_that_fit_on_device_and_host(monkeypatch, short_family):
    """Of five seeds two at a time, where either has room for two and a half."""
    config = run_config.parse([*SHORT_RUN, "--seeds=5", "--host-replay-size=400"])
    shapes = state_shapes(config)
    stored = memory.Needs.of(shapes, config.family.spec, config.learner, config.training).host
    monkeypatch.setattr(memory, "state_shapes", lambda _: shapes)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    state = memory.required_bytes(config)
    for device, host, rounds in ((9, 9, [5]), (9, 0.5, [2, 2, 1]), (0.5, 9, [2, 2, 1])):
        monkeypatch.setattr(memory, "host_bytes", lambda host=host: host / 0.9 * stored)
        monkeypatch.setattr(memory, "available_bytes", lambda device=device: device / 0.9 * state)
        assert memory.seeds_exceed_memory(config) == (len(rounds) > 1)
        assert [part.plan.seeds for part in memory.split_to_fit(config, memory.available_bytes())] == rounds
