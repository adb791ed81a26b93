"""Analytic families: their equations written again in NumPy, what is known to be best, and how episodes end."""

import dataclasses
from functools import lru_cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, Stub

import mtjax
from mtjax.envs.analytic import link, sailing, tracks, trading
from mtjax.envs.analytic.circle import cos_sin
from mtjax.learning.evaluation import record
from mtjax.learning.rollout import reset_envs, step_envs
from mtjax.report import films, render
from mtjax.types import InputError

NAMES = ("link", "racing", "sailing", "tabletop", "trading")
VALUES = {  # unlike the nominal ones in every parameter
    "link": {"bandwidth": 180.0, "delay": 0.11, "buffer": 40.0, "loss": 0.03},
    "racing": {"track": 4.5, "friction": 0.8, "power": 150.0, "width": 2.5},
    "sailing": {
        "wind-speed": 7.0,
        "wind-direction": 0.4,
        "current-speed": 0.3,
        "current-direction": 2.0,
        "sail": 0.8,
    },
    "tabletop": {"goal": 1.0, "pace": 0.3, "reach": 2.2},
    "trading": {"risk-aversion": 3.0, "volatility": 0.5, "impact": 1.7, "lasting-impact": 0.4},
}
KEY = jax.random.key(0)


@lru_cache
def family(name):
    return mtjax.make(name, vary=VALUES[name], combine="grid", split="none")


def alone(name, **values):
    """A family of a single task, and that task with some values of its own; one program is for all such tasks."""
    env = family(name)
    task = jax.tree.map(lambda x: x[0], env.tasks())
    goal = task.goal | {parameter: jnp.float32(x) for parameter, x in values.items()}
    if name == "racing":
        goal["waves"] = jnp.float32(tracks.make_track(float(goal["track"])))
    return env, task._replace(goal=goal)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def begin(env, task, key):
    """The start of an episode."""
    return env.reset(task, key)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=QUICK)
def follow(env, policy, tasks, states, entries):
    """Steps (B, H, ...) of a policy from tasks (B, ...), worlds (B, ...) and entries (B, H, ...) to actions."""

    def once(task, state, entry):
        step = env.step(task, state, policy(task, state, entry))
        return step.state, step

    return jax.vmap(lambda task, state, given: jax.lax.scan(partial(once, task), state, given)[1])(
        tasks, states, entries
    )


def many(tree, count):
    """A tree (...) as leaves (count, ...), all alike."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), tree)


def follow_one(env, policy, task, state, entries):
    """Steps (H, ...) of one world."""
    one = lambda tree: jax.tree.map(lambda x: jnp.asarray(x)[None], tree)
    return jax.tree.map(lambda x: x[0], follow(env, policy, *map(one, (task, state, entries))))


def as_given(task, state, action):
    return action


def play(env, task, actions, key=KEY):
    """The start, and the steps under actions (H, A)."""
    start = begin(env, task, key)
    return start, follow_one(env, as_given, task, start.state, jnp.float32(actions))


def random_actions(env, steps=200, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, env.action_size))


@dataclasses.dataclass(frozen=True)
class Idle(Stub):
    """An agent that does nothing."""

    size: int = 1

    def choose(self, state, obs, task, key):
        return jnp.zeros(self.size)


def close(steps, expected, tolerance):
    """Fields of states, by name, as NumPy has them, for as many steps."""
    for name, values in expected.items():
        found = getattr(steps.state, name)[: len(values)]
        np.testing.assert_allclose(found, values, rtol=tolerance, atol=tolerance, err_msg=name)


# Equations.


@pytest.mark.parametrize("largest", [1, 4, 1000])
def test_cosine_and_sine_are_numpys(largest):
    """And so are their slopes; what is no number stays none."""
    angles = np.float32(np.linspace(-largest, largest, 20_001))
    cos, sin = jax.jit(cos_sin)(angles)
    np.testing.assert_allclose(cos, np.cos(np.float64(angles)), atol=1e-7)
    np.testing.assert_allclose(sin, np.sin(np.float64(angles)), atol=1e-7)
    (of_cos, of_sin) = jax.jvp(cos_sin, (angles,), (np.ones_like(angles),))[1]
    np.testing.assert_allclose(of_cos, -sin, atol=1e-6)
    np.testing.assert_allclose(of_sin, cos, atol=1e-6)
    assert np.all(np.isnan(cos_sin(jnp.float32([np.nan, np.inf]))))


def test_a_link_is_a_fluid_queue():
    """Rates, queues, losses and rewards of 200 random actions; the buffer overflows and runs empty among them."""
    env, task = alone("link")
    c, d, size, loss = VALUES["link"].values()
    actions = np.clip(random_actions(env) - np.linspace(0, 0.5, 200)[:, None], -1, 1)
    start, steps = play(env, task, actions)
    rate, queue, seconds = float(start.state.rate), 0.0, 2 * d
    assert 0.3 * c <= rate <= 1.5 * c
    found = {name: [] for name in ("rate", "queue", "used", "dropped", "reward", "report")}
    for a in actions[:, 0]:
        rate = np.clip(rate * (1 + 0.1 * a) if a >= 0 else rate / (1 - 0.1 * a), 10, 1000)
        arrived = rate * (1 - loss) * seconds
        delivered = min(queue + arrived, c * seconds)
        before, over = queue, max(queue + arrived - delivered - size, 0.0)
        queue = queue + arrived - delivered - over
        latency = seconds + queue / c
        report = (queue - before) / c / seconds, np.log(latency / seconds), np.log(rate * seconds / delivered)
        gained = delivered / (c * seconds) - queue / (c * seconds) - over / (rate * seconds)
        line = rate, queue, delivered / (c * seconds), over / (rate * seconds), gained, report
        for name, value in zip(found, line, strict=True):
            found[name].append(value)
    reward, report = found.pop("reward"), found.pop("report")
    close(steps, found, 2e-4)
    np.testing.assert_allclose(steps.reward, reward, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(steps.obs[-1, :30].reshape(10, 3), report[-10:], rtol=1e-3, atol=1e-3)
    assert steps.obs[-1, 30] == pytest.approx(np.log(rate / 200), abs=1e-3)
    assert 0 < np.mean(np.array(found["dropped"]) > 0) < 1 and 0 < np.mean(np.array(found["queue"]) > 0) < 1


def sail_on(state, action):
    """The boat of Jaulin and Le Bars after a step, by angles and in their letters."""
    a_w, from_, a_c, to, lift = VALUES["sailing"].values()
    p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11 = 0.03, 40, 6000, 200 * lift, 1500, 0.5, 0.5, 2, 300, 400, 0.2
    turn = lambda angle: np.array([np.cos(angle), np.sin(angle)])
    current = a_c * turn(to)
    wind = -a_w * turn(from_) - current
    a_tw, psi, d, most = np.hypot(*wind), np.arctan2(*wind[::-1]), action[0] * np.pi / 4, (1 + action[1]) * np.pi / 4
    place, theta, v, w = state
    for _ in range(5):
        apparent = a_tw * turn(psi - theta) - [v, 0]
        a_ap, psi_ap = np.hypot(*apparent), np.arctan2(*apparent[::-1])
        flaps = np.cos(psi_ap) + np.cos(most) < 0
        e = np.pi + psi_ap if flaps else -np.sign(np.sin(psi_ap)) * most
        f, g = p4 * a_ap * np.sin(e - psi_ap), p5 * v * v * np.sin(d)
        spin = (f * (p6 - p7 * np.cos(e)) - p8 * g * np.cos(d)) / p10
        w = (w + 0.1 * spin) / (1 + 0.1 * p3 * v / p10)
        drag = (p2 * v + p11 * p5 * v * np.sin(d) ** 2) / p9
        v = (v + 0.1 * f * np.sin(e) / p9) / (1 + 0.1 * drag)
        theta = theta + 0.1 * w
        place = place + 0.1 * (v * turn(theta) + p1 * wind + current)
    return place, theta, v, w


@pytest.mark.slow
def test_a_boat_moves_by_the_equations_of_jaulin_and_le_bars():
    """Place, heading, speed and turning of 100 random actions; and what is observed of the last one."""
    env, task = alone("sailing")
    start, steps = play(env, task, random_actions(env))
    steps = jax.tree.map(lambda x: x[:100], steps)
    state, found = (np.zeros(2), float(start.state.heading), 1.0, 0.0), []
    for action in random_actions(env)[:100]:
        state = sail_on(state, action)
        found.append(state)
    place, heading, speed, turning = (np.array(x) for x in zip(*found, strict=True))
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    close(steps, {"place": place, "speed": speed, "turning": turning}, 3e-3)
    np.testing.assert_allclose(np.exp(1j * np.asarray(steps.state.heading)), np.exp(1j * wrapped), atol=3e-3)
    distance = np.hypot(*(place - [100, 0]).T)
    gained = -np.diff(distance, prepend=100.0)
    np.testing.assert_allclose(steps.reward, gained / 10 - 0.05, atol=2e-3)
    bearing = np.arctan2(-place[-1, 1], 100 - place[-1, 0]) - heading[-1]
    wind = -7 * np.exp(0.4j) - 0.3 * np.exp(2j)
    ahead = np.exp(-1j * heading[-1])
    apparent, ground = wind * ahead - speed[-1], (0.03 * wind + 0.3 * np.exp(2j)) * ahead + speed[-1]
    seen = [distance[-1] / 100, np.cos(bearing), np.sin(bearing), speed[-1] / 5, turning[-1]]
    seen += [apparent.real / 10, apparent.imag / 10, ground.real / 5, ground.imag / 5, random_actions(env)[99, 1]]
    np.testing.assert_allclose(steps.obs[-1], seen, atol=3e-3)


def drive_on(state, action):
    """The car after a step: CommonRoad's equations with saturated forces, solved as matrices."""
    _, mu, power, _ = VALUES["racing"].values()
    m, inertia, height, lf, lr, cf, cr, g = 3.74, 0.04712, 0.074, 0.15875, 0.17145, 4.718, 5.4562, 9.81
    place, heading, v, beta, r, d = state
    for _ in range(2):
        d = d + np.clip(0.4189 * action[0] - d, -3.2 * 0.025, 3.2 * 0.025)
        a = np.clip(9.51 * action[1], -mu * g, min(mu * g, power / m / max(v, 0.5)))
        v = np.clip(v + 0.025 * a, 0, 20)
        u = max(v, 0.5)
        alpha_f, alpha_r = d - beta - lf * r / u, lr * r / u - beta
        front = mu * m * (g * lr - a * height) / (lf + lr) * cf / np.sqrt(1 + (cf * alpha_f) ** 2)
        rear = mu * m * (g * lf + a * height) / (lf + lr) * cr / np.sqrt(1 + (cr * alpha_r) ** 2)
        slips = np.array([[-1, -lf / u], [-1, lr / u]])  # of (beta, r), but for the steering angle
        rates = np.array([[front / m / u, rear / m / u], [lf * front / inertia, -lr * rear / inertia]])
        matrix = rates @ slips + [[0, -1], [0, 0]]
        beta, r = np.linalg.solve(np.eye(2) - 0.025 * matrix, [beta, r] + 0.025 * rates @ [d, 0])
        heading = heading + 0.025 * r
        place = place + 0.025 * v * np.array([np.cos(heading + beta), np.sin(heading + beta)])
    return place, heading, v, beta, r, d


@pytest.mark.slow
def test_a_car_moves_by_the_single_track_model():
    """All of its state under 40 random actions."""
    env, task = alone("racing")
    start, steps = play(env, task, random_actions(env))
    steps = jax.tree.map(lambda x: x[:40], steps)
    state, found = (np.float64(start.state.place), float(start.state.heading), 3.0, 0.0, 0.0, 0.0), []
    for action in random_actions(env)[:40]:
        state = drive_on(state, action)
        found.append(state)
    place, heading, speed, slip, turning, steer = (np.array(x) for x in zip(*found, strict=True))
    close(steps, {"place": place, "speed": speed, "slip": slip, "turning": turning, "steer": steer}, 3e-3)
    np.testing.assert_allclose(np.exp(1j * np.asarray(steps.state.heading)), np.exp(1j * heading), atol=3e-3)


def test_small_slips_are_those_of_commonroad():
    """Beside the published right-hand side: slip and turning grow from rest as its derivatives say, to first order."""
    env, task = alone("racing", friction=1.0489)
    mu, m, inertia, h, lf, lr = 1.0489, 3.74, 0.04712, 0.074, 0.15875, 0.17145
    v, d, a = 6.0, 1e-3, 0.0
    rf, rr = 4.718 * (9.81 * lr - a * h), 5.4562 * (9.81 * lf + a * h)
    state = begin(env, task, KEY).state._replace(speed=jnp.float32(v), steer=jnp.float32(d))
    actions = jnp.tile(jnp.float32([d / 0.4189, a]), (200, 1))
    found = follow_one(env, as_given, task, state, actions).state
    beta, r = 0.0, 0.0
    for _ in range(2):  # implicit Euler of the linear model
        grip = mu / (v * (lr + lf))
        of_beta = [-grip * (rr + rf), grip * (rr * lr - rf * lf) / v - 1]
        of_r = np.array([lr * rr - lf * rf, -(lf**2 * rf + lr**2 * rr) / v]) * mu * m / inertia / (lr + lf)
        push = np.array([grip * rf, mu * m / inertia / (lr + lf) * lf * rf]) * d
        beta, r = np.linalg.solve(np.eye(2) - 0.025 * np.array([of_beta, of_r]), [beta, r] + 0.025 * push)
    assert float(found.slip[0]) == pytest.approx(beta, rel=1e-3)
    assert float(found.turning[0]) == pytest.approx(r, rel=1e-3)


def test_a_sale_changes_wealth_as_almgren_and_chriss_say():
    """Holdings and prices of 50 random paces; rewards are the shortfall in all, and the risk charged."""
    env, task = alone("trading")
    risk, sigma, eta, gamma = VALUES["trading"].values()
    actions = random_actions(env, 50) / 3
    _, steps = play(env, task, actions)
    left, cash, charged, earned = 1.0, 0.0, 0.0, []
    prices = np.concatenate([[50.0], np.float64(steps.state.price)])
    for k, a in enumerate(actions[:, 0]):
        sold = left if k == 49 else min(left, 30**a * left / (50 - k))
        cash += sold * (prices[k] - 0.0625 - eta * sold / 0.1)
        left -= sold
        charged += risk * sigma**2 * 0.1 * left**2
        earned.append((cash + left * prices[k + 1] - 50 - charged) / 50 * 1e4)
        assert float(steps.state.left[k]) == pytest.approx(left, abs=1e-5)
    np.testing.assert_allclose(np.cumsum(steps.reward), earned, rtol=1e-3, atol=0.05)
    noise = np.diff(prices) + gamma * np.diff(1 - np.concatenate([[1.0], np.float64(steps.state.left)]))
    assert np.std(noise) == pytest.approx(sigma * np.sqrt(0.1), rel=0.3) and abs(np.mean(noise)) < 0.1
    np.testing.assert_allclose(
        steps.obs[3], [steps.state.left[3], 0.92, (prices[4] - 50) / sigma / np.sqrt(5)], atol=1e-4
    )


# What is best.


def test_a_link_is_best_used_at_its_bandwidth_with_an_empty_queue():
    """Among constant rates; there every step earns 1, and none earns more under any action."""
    env, task = alone("link", loss=0.02, buffer=500.0)
    best = link.best_rate(180.0, 0.02)
    rates = best * np.linspace(0.5, 1.5, 101)
    states = many(begin(env, task, KEY).state, 101)._replace(rate=jnp.float32(rates))
    rewards = np.asarray(follow(env, as_given, many(task, 101), states, jnp.zeros((101, 100, 1))).reward)
    assert rates[np.argmax(np.mean(rewards, axis=1))] == pytest.approx(best, rel=0.03)
    np.testing.assert_allclose(rewards[50], 1, atol=1e-3)
    assert rewards.max() <= 1 + 1e-6 and np.max(play(env, task, random_actions(env))[1].reward) <= 1 + 1e-6


def greedy(task, state, _):
    """The rate that fills the next round trip, queue and all, as far as a step can change it."""
    goal = task.goal
    room = goal["bandwidth"] - state.queue / (2 * goal["delay"])
    ratio = jnp.maximum(room, 1.0) / (1 - goal["loss"]) / state.rate
    return jnp.clip(jnp.where(ratio >= 1, ratio - 1, 1 - 1 / ratio) / 0.1, -1, 1)[None]


def test_a_sender_that_knows_the_link_earns_almost_the_whole_of_it():
    """From every first rate: within 3% of 1 a step."""
    env, task = alone("link")
    states = jax.vmap(lambda key: env.reset(task, key).state)(jax.random.split(KEY, 8))
    steps = follow(env, greedy, many(task, 8), states, jnp.zeros((8, 400)))
    assert np.min(np.mean(steps.reward, axis=1)) > 0.97


def upon(task, state, angle):
    """Hold an angle to the wind, to the left of it, with the sail at half the apparent wind's."""
    wind = -task.goal["wind-speed"] * jnp.exp(1j * task.goal["wind-direction"])
    apparent = wind * jnp.exp(-1j * state.heading) - state.speed
    sheet = (jnp.pi - jnp.abs(jnp.angle(apparent))) / 2
    error = jnp.angle(jnp.exp(1j * (state.heading - task.goal["wind-direction"] - angle)))
    return jnp.stack([jnp.clip(0.4 * error, -1, 1), 4 * sheet / jnp.pi - 1])


def sail(angles, headings, policy, **values):
    """Steps (B, H, ...) of boats that hold angles (B, H), from their headings (B,), in a wind from the mark."""
    env, task = alone("sailing", **{"current-speed": 0.0, "wind-direction": 0.0}, **values)
    states = many(begin(env, task, KEY).state, len(angles))._replace(heading=jnp.float32(headings))
    return follow(env, policy, many(task, len(angles)), states, jnp.float32(angles))


@pytest.mark.parametrize("wind", [4.0, 8.0])
def test_a_boat_is_as_fast_as_its_polar(wind):
    """At four angles, and the best speed to windward is at the angle that it is said to be at; all within 3%."""
    best, tack = sailing.best_to_windward(wind, 0.8)
    angles = np.array([tack, 1.3, 2.0, 3.0])
    steps = sail(np.tile(angles[:, None], 400), angles, upon, **{"wind-speed": wind})
    np.testing.assert_allclose(steps.state.speed[:, -1], sailing.polar(angles, wind, 0.8), rtol=0.03)
    made = np.asarray(steps.state.place[:, 140, 0] - steps.state.place[:, 80, 0]) / 30
    assert made[0] == pytest.approx(best, rel=0.03) and np.all(made[1:] < 0.97 * best)


def tacking(task, state, angle):
    """Hold the tack, to the left or to the right, until the other one leads to the mark."""
    side = jnp.where(state.heading >= 0, 1.0, -1.0)
    leads = side * state.place[1] > (100 - state.place[0]) * jnp.tan(angle)
    return upon(task, state, jnp.where(leads, -side, side) * angle)


@pytest.mark.slow
def test_tacks_reach_a_mark_to_windward_as_soon_as_the_polar_lets_them():
    """95 m away, where it is reached, and later by what a tack costs; straight ahead a boat goes nowhere."""
    best, tack = sailing.best_to_windward(7.0, 0.8)
    soonest = 95 / best / 0.5  # steps
    steps = sail(np.stack([np.full(400, tack), np.zeros(400)]), [tack, 0.0], tacking)
    reached = int(np.argmax(steps.terminated[0]))
    assert steps.terminated[0, reached] and steps.metrics["success"][0, reached] == 1
    assert 0.97 * soonest < reached < 1.25 * soonest
    assert not np.any(steps.terminated[1]) and float(steps.state.place[1, -1, 0]) < 10


def cautious(task, state, _):
    """Steer along the line; brake so that no bend ahead takes more than 0.4 of the grip."""
    obs = family("racing").observe(task, state)
    grip, bends = task.goal["friction"] * 9.81, obs[7:] / 3
    fast = jnp.sqrt(0.4 * grip / jnp.maximum(jnp.abs(bends), 0.01) + 7.0 * 2 * jnp.arange(8))
    angle = jnp.arctan(0.33 * bends[0]) - 0.15 * obs[4] * task.goal["width"] / 2 - 0.8 * jnp.arctan2(obs[5], obs[6])
    push = jnp.clip(0.5 * (jnp.min(fast) - 10 * obs[0]), -0.45, 0.45)
    return jnp.clip(jnp.stack([angle / 0.4189, push]), -1, 1)


@pytest.mark.slow
def test_a_cautious_driver_laps_every_track():
    """All ten and those held out; a lap is as long as the line, and takes longer than the grip demands."""
    env = mtjax.make("racing")
    tasks = env.tasks("all")
    states = jax.jit(jax.vmap(env.reset), compiler_options=QUICK)(tasks, jax.random.split(KEY, len(tasks.id))).state
    steps = follow(env, cautious, tasks, states, jnp.zeros((len(tasks.id), 600)))
    laps, success = np.asarray(steps.metrics["laps"]), np.asarray(steps.metrics["success"])
    assert not np.any(steps.terminated) and np.all(laps[:, -1] > 1.5)
    assert np.all(success[:, -1] == 1) and np.array_equal(success, laps >= 1)
    whole = [tracks.length(tracks.make_track(x)) for x in np.asarray(tasks.params["track"])]
    np.testing.assert_allclose(np.sum(steps.reward, axis=1) / laps[:, -1], whole, rtol=0.15)  # one part is driven twice
    first = np.argmax(laps >= 1, axis=1)
    np.testing.assert_allclose([np.sum(r[: f + 1]) for r, f in zip(steps.reward, first, strict=True)], whole, rtol=0.01)


def test_tracks_are_closed_lines_whose_tightest_bend_is_known():
    """By differences of points along them; numbers give the same track always, and others give others."""
    for number in (0, 3.5, -2):
        waves = tracks.make_track(number)
        points = tracks.outline(waves, 0.0, 4000)
        sides = np.roll(points, -1, axis=0) - points
        heading, long = np.arctan2(*sides.T[::-1]), np.hypot(*sides.T)
        bends = np.angle(np.exp(1j * np.diff(heading, append=heading[0]))) / ((long + np.roll(long, -1)) / 2)
        assert np.max(np.abs(bends)) == pytest.approx(1 / 3, rel=0.01)
        assert np.sum(bends * long) == pytest.approx(2 * np.pi, rel=0.01)
        assert tracks.length(waves) == pytest.approx(np.sum(long), rel=1e-4)
        line = jax.vmap(partial(tracks.line_at, jnp.float32(waves)))(jnp.float32(2 * np.pi * np.arange(4000) / 4000))
        np.testing.assert_allclose(line.curvature[1:-1], bends[:-2], atol=3e-3)
        beside = tracks.outline(waves, 1.2, 50) - tracks.outline(waves, 0.0, 50)
        np.testing.assert_allclose(np.hypot(*beside.T), 1.2)
        np.testing.assert_array_equal(waves, tracks.make_track(number))
    assert len({tracks.make_track(x).tobytes() for x in (0, 1, -1, 0.5, 10, 1e6)}) == 6
    first = tracks.make_track(0)[0]  # in every version: runs are resumed by numbers
    assert first == pytest.approx((-0.016266, 0.130162), abs=1e-6)


@pytest.mark.parametrize("risk", [0.5, 3.0, 5.0])
def test_the_best_plan_of_a_sale_earns_the_closed_form(risk):
    """Almgren and Chriss' cost when their plan is played: exactly but for the luck of prices, which is taken out."""
    env, task = alone("trading", **{"risk-aversion": risk})
    goal = VALUES["trading"] | {"risk-aversion": risk}
    plan = trading.best_holdings(goal)
    assert plan[0] == 1 and plan[-1] == 0
    paces = [trading.pace_of(a - b, a, k) for k, (a, b) in enumerate(pairwise(plan[:-1]))]
    assert np.max(np.abs(paces)) < 1

    def lucky(actions, key):
        """What a sale earns, and the luck in it."""
        steps = play(env, task, actions, key)[1]
        held, prices = np.float64(steps.state.left), np.concatenate([[50.0], np.float64(steps.state.price)])
        noise = np.diff(prices) - goal["lasting-impact"] * np.diff(held, prepend=1.0)
        return np.sum(np.float64(steps.reward)), 1e4 / 50 * np.sum(held * noise)

    actions = np.append(paces, 0.0)[:, None]
    earned, luck = lucky(actions, KEY)
    best = trading.best_return(goal)
    assert earned - luck == pytest.approx(best, rel=1e-3)
    for seed, changed in enumerate((actions + 0.05, actions - 0.05, 0 * actions, np.minimum(actions + 0.2, 1))):
        other, by_chance = lucky(changed, jax.random.key(seed))
        assert other - by_chance < best


def test_luck_is_no_part_of_what_a_plan_earns_on_average():
    """Of an even sale, in a thousand markets."""
    env, task = alone("trading")
    states = jax.vmap(lambda key: env.reset(task, key).state)(jax.random.split(KEY, 1000))
    steps = follow(env, as_given, many(task, 1000), states, jnp.zeros((1000, 50, 1)))
    earned = np.sum(np.asarray(steps.reward), axis=1)
    risk, sigma, eta, gamma = VALUES["trading"].values()
    left = 1 - np.arange(1, 51) / 50
    mean = gamma / 2 + 0.0625 + (eta - gamma * 0.05) / 0.1 / 50
    expected = -200 * (mean + risk * sigma**2 * 0.1 * np.sum(left**2))
    assert np.mean(earned) == pytest.approx(expected, abs=4 * np.std(earned) / np.sqrt(1000))
    assert np.std(earned) == pytest.approx(200 * sigma * np.sqrt(0.1 * np.sum(left**2)), rel=0.1)


# Parameters and ends.


@pytest.mark.parametrize(("name", "parameter"), [(name, p) for name in NAMES for p in VALUES[name]])
def test_every_parameter_changes_what_happens(name, parameter):
    """From the same start under the same actions, some observation or reward differs."""
    env, task = alone(name)
    factor = 1.3 if parameter not in ("track", "goal") else 2.0
    changed = task._replace(goal=alone(name, **{parameter: factor * VALUES[name][parameter]})[1].goal)
    actions = random_actions(env)
    if name == "racing":  # fast and straight, so that power and grip are asked for
        actions = np.clip(0.2 * actions + [0, 0.9], -1, 1)
    start = begin(env, task, KEY).state
    one, other = (follow_one(env, as_given, t, start, jnp.float32(actions)) for t in (task, changed))
    seen = lambda steps: np.concatenate([steps.obs.ravel(), steps.reward, steps.terminated])
    assert np.max(np.abs(seen(one) - seen(other))) > 1e-3


@pytest.mark.parametrize("name", ["link", "sailing"])
def test_a_time_limit_truncates(name):
    """The last step may be followed: its discount is 1, and the episode has ended."""
    env, _ = alone(name)
    assert env.tasks().horizon == env.episode_length
    tasks, agent = env.tasks()._replace(horizon=jnp.int32([2])), Idle(size=env.action_size)
    worlds = reset_envs(env, agent, jnp.zeros(1), tasks, jax.random.split(KEY, (1, 1, 1)))
    for ended in (False, True):
        worlds, step = step_envs(env, agent, jnp.zeros(1), tasks, worlds, None)
        assert bool(step.transition.ended.all()) == ended and step.transition.discount.item() == 1
    assert name == "link" or env.ends_early


def test_links_do_not_end():
    assert not alone("link")[0].ends_early


def test_a_boat_ends_at_the_mark():
    """Within 5 m, with a prize; not before."""
    env, task = alone("sailing")
    state = begin(env, task, KEY).state
    for place, reached in (((94.9, 0), False), ((95.1, 0), True), ((100, 4.9), True), ((100, 5.1), False)):
        at = state._replace(place=jnp.float32(place), gained=jnp.float32(1))
        assert bool(env.terminates(task, at)) == reached == bool(env.metrics(task, at, None)["success"])
        assert float(env.reward(task, at, None)) == pytest.approx(0.05 + 10 * reached)


def test_a_car_ends_beside_the_track():
    """Half its width from the line, on either side."""
    env, task = alone("racing")
    line, waves = begin(env, task, KEY).state, tracks.make_track(4.5)
    for offset, off in ((1.15, False), (-1.15, False), (1.35, True), (-1.35, True)):
        cars = many(line, 12)._replace(place=jnp.float32(tracks.outline(waves, offset, 12)))
        assert np.all(np.asarray(jax.vmap(env.terminates, (None, 0))(task, cars)) == off)
        earned = jax.vmap(env.reward, (None, 0, None))(task, cars._replace(gained=jnp.ones(12)), None)
        np.testing.assert_array_equal(earned, 1 - 20 * off)


def test_a_sale_ends_with_the_last_share():
    """At the last trade whatever the pace, and before if all is sold."""
    env, task = alone("trading")
    slow, fast = (play(env, task, np.full((50, 1), pace))[1] for pace in (-1.0, 1.0))
    assert np.flatnonzero(slow.terminated)[0] == 49 and np.all(np.asarray(slow.state.left[:-1]) > 0)
    assert np.flatnonzero(fast.terminated)[0] < 40


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="reports must be at least 1"):
        mtjax.make("link", reports=0)
    with pytest.raises(InputError, match="loss must be greater than"):
        mtjax.make("link", vary={"loss": "-0.1"})
    assert mtjax.make("link", vary={"loss": "0,0.01"}, combine="grid", split="none").train_count


# What is seen.


def test_films_of_slow_worlds_are_quick():
    """A second of a film shows ten steps of a sale, twenty of a boat, of a car and of a table."""
    per_second = {name: family(name).film_speed / family(name).seconds_per_step for name in NAMES}
    assert per_second == pytest.approx({"link": 10, "racing": 20, "sailing": 20, "tabletop": 20, "trading": 10})


@pytest.mark.slow
def test_a_sale_is_filmed_though_its_state_has_a_key():
    """As the command films it: ten of the fifty steps for each second."""
    env, _ = alone("trading")
    played = record(env, Idle(), jnp.zeros((1, 1)), env.tasks("all"), jnp.int32(0))
    (one,) = films.choose(env, ["train"], [0])
    try:
        frames = films._tile(env, one, played, played.kept, 50, 40)
    except InputError as error:
        pytest.skip(str(error))
    assert frames.shape == (50, 30, 40, 3) and len(np.unique(frames, axis=0)) == 20


@pytest.mark.parametrize("name", NAMES)
def test_films_show_what_happens(name):
    """The first and the 30th world of an episode look different, and neither is empty."""
    env, task = alone(name)
    steps = play(env, task, np.full((200, env.action_size), 0.2))[1]
    shown = jax.tree.map(lambda x: x[jnp.array([0, 29])], steps.state)
    try:
        first, later = np.int32(render.film(env, int(task.row), shown, 80, 60))
    except InputError as error:
        pytest.skip(str(error))
    assert np.mean(np.any(first != later, axis=-1)) > 0.002
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20
