"""The page of a run: its numbers are those of the files, it serves nothing else, and training is as without it."""

import contextlib
import csv
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from http.client import HTTPConnection
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import SHORT_RUN
from PIL import Image

import mtjax.evaluate
import mtjax.train
from mtjax.checks import HOME
from mtjax.command import live_page
from mtjax.command.run_config import parse
from mtjax.learning.evaluation import load_evaluations
from mtjax.report import films, render
from mtjax.report.page_data import Metrics
from mtjax.report.view import Server, Worlds
from mtjax.saved import lock
from mtjax.saved.config_json import from_json
from mtjax.saved.folder import resumed_config
from mtjax.saved.policy import load
from mtjax.types import InputError


def request(run, **given):
    """What the command asks for; port 0 is any that is free."""
    return SimpleNamespace(
        **{"run": str(run), "view": 0, "point": 0, "checkpoint": 0, "seed": 0, "drawn": None, "sampled": False} | given
    )


@contextlib.contextmanager
def serving(run, vary=(), **given):
    with Server(request(run, **given), dict(vary)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def server(finished_run):
    with serving(finished_run) as made:
        yield made


def answer(server, path, method="GET", **headers):
    """Status, headers and body of what the server says to a path as it is, which clients would tidy up."""
    connection = HTTPConnection(HOME, server.server_port, timeout=60)
    connection.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    found = connection.getresponse()
    with contextlib.closing(connection):
        return found.status, found.headers, found.read()


def rows_of(run):
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_numbers_are_those_of_the_runs_files(finished_run, server):
    """Curves are means over seeds of what metrics.csv has, and scores means over seeds and episodes."""
    status, headers, body = answer(server, "/run.json")
    told, rows = json.loads(body), rows_of(finished_run)
    assert status == 200 and headers["Content-Type"] == "application/json"
    assert (told["title"], told["seeds"], told["total"]) == ("sac-conditioned on finger-short", 2, 600)
    assert (told["steps"], told["left"], told["running"]) == (600, 0, False)
    span = [float(rows[-1][name]) - float(rows[0][name]) for name in ("steps", "seconds")]
    assert told["rate"] == pytest.approx(told["seeds"] * span[0] / span[1])
    steps = sorted({int(row["steps"]) for row in rows})
    assert told["curves"]["steps"] == steps
    for name in ("return", "critic_loss"):
        for step, mean in zip(steps, told["curves"][name], strict=True):
            values = [float(row[name]) for row in rows if int(row["steps"]) == step and row[name]]
            assert mean == (pytest.approx(np.mean(values)) if values else None)
    assert not [name for name in told["curves"] if re.search(r"_\d+$|seconds|seed", name)]
    evaluations = load_evaluations(finished_run / "evaluations.npz")
    assert told["evaluated"] == evaluations.steps.tolist()
    for split, x in evaluations.returns.items():
        np.testing.assert_allclose(told["scores"]["return"][split], x.mean(axis=(0, 2, 3)), rtol=1e-6)
    train = [task for task in told["tasks"] if task["split"] == "train"]
    assert told["task_steps"] == steps and len(train[0]["curve"]) == len(steps)
    assert [(task["task"], task["label"]) for task in train] == [(0, "1"), (1, "1.2")]
    for t, task in enumerate(train):
        assert task["scored"] == pytest.approx(evaluations.returns["train"][:, -1, t].mean())
        assert task["trained"] == pytest.approx(np.mean([float(row[f"return_{t}"]) for row in rows[-2:]]))
    held_out = next(task for task in told["tasks"] if task["split"] == "extrapolation")
    np.testing.assert_allclose(held_out["curve"], evaluations.returns["extrapolation"][:, :, 0].mean((0, 2)), rtol=1e-6)


def test_the_page_asks_no_other_machine(server):
    """Neither its text nor what it lets the browser load."""
    status, headers, body = answer(server, "/")
    hosts = set(re.findall(r"https?://[\w.]+", body.decode()))
    assert status == 200 and headers["Content-Type"].startswith("text/html") and hosts == {"http://www.w3.org"}
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/config.json",
            "/metrics.csv",
            "/../config.json",
            "/..%2fconfig.json",
            "/%2e%2e/config.json",
            "/run.json/..",
        ),
        *("//etc/passwd", "/worlds/../config.json", "/worlds?task=x", "/worlds?task=-1", "/view.html", "/checkpoints/"),
    ],
)
def test_there_is_nothing_else_to_ask_for(server, path):
    assert answer(server, path)[0] == 404


def test_others_are_refused(server):
    """Sites whose name was made to lead to this machine, and whoever wants to change anything."""
    port = server.server_port
    assert answer(server, "/run.json", Host="example.com")[0] == 403
    assert answer(server, "/run.json", Host=f"localhost:{port + 1}")[0] == 200  # through a tunnel
    assert answer(server, "/run.json", method="POST")[0] == 501


def test_lines_are_read_as_they_come(tmp_path):
    """Once, when they are whole; a file that is written anew from its start; means are over those that are known."""
    file = tmp_path / "metrics.csv"
    metrics = Metrics(file)
    metrics.update()
    assert metrics.means(9) == {}
    file.write_text("seed,iteration,return\n0,1,2\n1,1,4\n0,2,6\n1,2,\n0,3")
    metrics.update()
    assert metrics.means(9)["return"].tolist() == [3, 6]
    with file.open("a") as end:
        end.write(",7\n1,3,9\nno,4,8\n0,4\n")
    metrics.update()
    assert metrics.means(9)["return"].tolist() == [3, 6, 8] and metrics.means(2)["iteration"].tolist() == [1, 3]
    new = tmp_path / "new"
    new.write_text("seed,iteration,return\n0,1,5\n")
    new.replace(file)
    metrics.update()
    assert metrics.means(9)["return"].tolist() == [5]


def test_a_run_goes_on_while_its_process_lives(tmp_path):
    assert not lock.is_held(tmp_path)
    with lock.hold(tmp_path):
        assert lock.is_held(tmp_path)
        kept = (tmp_path / "lock").read_text()
    assert not lock.is_held(tmp_path)
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    (tmp_path / "lock").write_text(re.sub(r"\d+", gone.stdout.strip(), kept, count=1))
    assert not lock.is_held(tmp_path)
    (tmp_path / "lock").write_text(f"process {gone.stdout.strip()} on another host")
    assert lock.is_held(tmp_path)


@pytest.fixture(scope="module")
def opengl():
    """Skips where nothing can be drawn."""
    try:
        render._open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except InputError:
        pytest.skip("needs OpenGL")


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_moving_worlds_are_those_of_films(finished_run):
    """At every time the frame that a film of the same episode has; the last one stays."""
    policy = load(finished_run)
    played = films.play(policy, policy.env.tasks("all"), 3)
    one = films.choose_one(policy.env, "extrapolation", 1)
    assert one[1:] == films.choose(policy.env, ["extrapolation"], [1])[0][1:]
    filmed = films._tile(policy.env, one, played[0], played[1][""], 10, 480)
    with films.moving(policy.env, [one], *played, {}) as (seconds, draw):
        assert seconds == pytest.approx(20 * policy.env.seconds_per_step)
        for i in (0, 3, len(filmed) - 1):
            np.testing.assert_array_equal(draw(i / 25 + 1e-6)[-360:], filmed[i])
        np.testing.assert_array_equal(draw(seconds), draw(seconds + 9))
    assert np.any(filmed[0] != filmed[3])


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_pictures_are_streamed_by_the_task(server):
    """As parts that replace each other; three tasks in a grid, or one that is larger."""
    sizes = []
    for query in ("", "?split=interpolation&task=0"):
        with urllib.request.urlopen(f"http://{HOME}:{server.server_port}/worlds{query}", timeout=120) as stream:
            edge = re.search("boundary=(.+)", stream.headers["Content-Type"])[1]
            for _ in range(3):
                assert stream.readline().decode() == f"--{edge}\r\n"
                assert stream.readline() == b"Content-Type: image/jpeg\r\n"
                length = int(stream.readline().split()[1])
                stream.readline()
                picture = np.asarray(Image.open(io.BytesIO(stream.read(length))))
                stream.readline()
        assert picture.std() > 10
        sizes.append(picture.shape[1])
    assert sizes == [2 * 320, 480]


def test_what_cannot_be_shown_is_said_in_the_picture(copied_run, monkeypatch):
    """Before the first checkpoint, while the policy is loaded, and of a task that is not there."""
    said = []
    monkeypatch.setattr("mtjax.report.view._card", lambda text: said.append(text) or np.zeros((8, 8, 3), np.uint8))
    worlds = Worlds(request(copied_run), {})
    no_task = worlds.stream("train", 9)
    assert next(no_task) and next(no_task)
    shutil.rmtree(copied_run / "checkpoints")
    with lock.hold(copied_run):
        assert next(worlds.stream()).startswith(b"\xff\xd8")
    assert said[0].startswith("the policy is loaded") and said[1] == "there is no task 9 of train"
    assert "once there is a checkpoint" in said[2]


def test_other_tasks_are_listed_without_the_runs_returns(finished_run):
    with serving(finished_run, vary={"size": "0.8,1.9"}) as server:
        tasks = json.loads(server.numbers())["tasks"]
    assert [(task["called"], task["label"], task["scored"], task["curve"]) for task in tasks] == [
        ("given", "0.8", None, []),
        ("given", "1.9", None, []),
    ]


@pytest.fixture
def taken():
    """A port that another program has."""
    with socket.create_server((HOME, 0)) as other:
        yield other.getsockname()[1]


@pytest.fixture
def free():
    with socket.create_server((HOME, 0)) as other:
        port = other.getsockname()[1]
    return port


def test_a_taken_port_is_refused_before_anything_is_made(finished_run, taken, tmp_path):
    with pytest.raises(InputError, match=rf"^port {taken} cannot be used .*; give another one: --view=PORT$"):
        mtjax.evaluate.main([f"--run={finished_run}", f"--view={taken}"])
    with pytest.raises(InputError, match=f"port {taken} cannot be used"):
        mtjax.train.main([*SHORT_RUN, f"--runs={tmp_path / 'runs'}", f"--view={taken}"])
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--view=70000", "view must be at least 1 and at most 65535"),
        ("--view --video", "--view shows a run and scores nothing; leave out --video"),
        ("--view --export=x.npz", "leave out --video, --export"),
    ],
)
def test_what_evaluate_refuses_beside_it(finished_run, words, said):
    with pytest.raises(InputError, match=said):
        mtjax.evaluate.main([f"--run={finished_run}", *words.split()])


@pytest.mark.parametrize("words", ["--sweep agent.actor-lr=1e-4,1e-3", "--search=4 --agent.actor-lr=1e-5..1e-2"])
def test_many_runs_have_no_page(short_family, words, tmp_path):
    with pytest.raises(InputError, match="--view shows one run"):
        mtjax.train.main([*SHORT_RUN, f"--runs={tmp_path}", "--view", *words.split()])
    assert not list(tmp_path.iterdir())


def test_a_resumed_run_may_have_a_page_too(finished_run):
    """It is no setting of the run, and --view alone takes the port that the guide names."""
    words = [f"--resume={finished_run}", "--view"]
    assert resumed_config(parse(words), finished_run, words).view == 8008
    assert from_json(finished_run / "config.json").view == 0
    assert parse(["--view", "9000"]).view == parse(["--view=9000"]).view == 9000


def ask(port):
    """What the page of another process says of its run, once it answers."""
    for _ in range(600):
        with contextlib.suppress(urllib.error.URLError):
            with urllib.request.urlopen(f"http://{HOME}:{port}/run.json", timeout=60) as found:
                return json.loads(found.read())
        time.sleep(0.1)
    raise TimeoutError


POINT = (
    "--env=point-mass-vary-goal --env.num-tasks=2 --split=none --agent=sac --steps=4000 --eval-every=2000 "
    "--eval-episodes=1 --num-envs=2 --batch-size=4 --warmup-steps=5 --chunk-steps=250 --agent.hidden 8 8"
).split()


@pytest.mark.slow
def test_training_does_not_notice_its_page(tmp_path, free, monkeypatch, capsys):
    """Its metrics are the same, and the page ends with it. It is asked when the run begins."""
    asked = []
    page = live_page.page

    @contextlib.contextmanager
    def asking(port, *given):
        with page(port, *given):
            asked.append(ask(port)["title"] if port else "")
            yield

    monkeypatch.setattr(live_page, "page", asking)
    found = []
    for name, words in (("with", [f"--view={free}"]), ("without", [])):
        mtjax.train.main([*POINT, f"--runs={tmp_path / name}", *words])
        found += list((tmp_path / name).iterdir())
    clocks = {"seconds", "wall_seconds"}
    metrics = [[{k: x for k, x in row.items() if k not in clocks} for row in rows_of(run)] for run in found]
    assert metrics[0] == metrics[1] and len(metrics[0]) == 4
    assert asked == ["sac on point-mass-vary-goal", ""]
    assert f"see it live at http://{HOME}:{free}\n" in capsys.readouterr().out
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((HOME, free))


def test_a_page_gives_way_to_its_run(tmp_path, monkeypatch):
    """Linux heeds a priority among the processes of a session; in a group of its own Ctrl-C leaves the page alone."""
    made, begin = [], subprocess.Popen
    monkeypatch.setattr(live_page.subprocess, "Popen", lambda _, **given: made.append(begin("cat", **given)) or made[0])
    own, priority = os.getpid(), lambda process: os.getpriority(os.PRIO_PROCESS, process)
    with live_page.page(8008, tmp_path, []):
        page = made[0].pid
        assert os.getsid(page) == os.getsid(own) and os.getpgid(page) == page != os.getpgid(own)
        assert priority(page) == min(priority(own) + 10, 19)
    assert made[0].returncode == 0


@pytest.mark.parametrize("how", ["closed", "interrupted"])
@pytest.mark.slow
def test_a_page_ends_with_its_input_or_by_ctrl_c(free, how):
    """A run's page has a pipe as its input, which is closed when the run ends or is killed."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background, and so in what it starts
    words = [sys.executable, "-m", "mtjax.evaluate", "--run=point-mass-vary-goal/sac-conditioned", f"--view={free}"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == f"see it at http://{HOME}:{free}, and end it by Ctrl-C\n"
        assert ask(free)["title"] == "sac-conditioned on point-mass-vary-goal"
        process.stdin.close() if how == "closed" else process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


def test_a_page_that_is_open_has_the_last_numbers(finished_run):
    """The server waits until it asks again, and for no other."""
    with serving(finished_run) as server:
        server.wait_until_told()  # nobody asks
        answer(server, "/run.json")
        waiting = threading.Thread(target=server.wait_until_told)
        waiting.start()
        assert waiting.is_alive()
        answer(server, "/run.json")
        waiting.join(1)
        assert not waiting.is_alive()


def shown_by_chromium(server, folder):
    """The page's elements, as a browser has them a while after it was opened."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None) or pytest.skip("needs chromium")
    quiet = "gpu quic background-networking component-update sync".split()
    words = ["--headless", "--no-sandbox", "--no-first-run", *(f"--disable-{name}" for name in quiet), "--dump-dom"]
    words += [f"--user-data-dir={folder}", "--timeout=20000", "--virtual-time-budget=5000"]
    page = f"http://{HOME}:{server.server_port}/"
    return subprocess.run([browser, *words, page], capture_output=True, text=True, stdin=subprocess.DEVNULL).stdout


ELEMENTS = """
class Element {
  constructor(name) { Object.assign(this, { name, children: [], style: {} }); }
  append(...children) { this.children.push(...children); }
  replaceChildren(...children) { this.children = children; }
  querySelector(name) {
    if (!this.children.length) this.append(new Element(name));
    return this.children[0];
  }
  setAttribute() {}
  get firstElementChild() { return this.querySelector("div"); }
  get rows() { return this.children; }
  get cells() { return this.children; }
  get options() { return this.children; }
  set textContent(text) { this.children = [text]; }
  toString() { return `<${this.name}>${this.children.join("")}</${this.name}>`; }
}
const made = {}, address = process.argv[1], timers = [], asked = fetch;
globalThis.document = {
  getElementById: (id) => made[id] ??= new Element("div"),
  createElement: (name) => new Element(name),
  createElementNS: (_, name) => new Element(name),
  addEventListener() {},
};
globalThis.Option = class extends Element { constructor(text) { super("option"); this.textContent = text; } };
globalThis.fetch = (path) => asked(address + path);
globalThis.setTimeout = (then) => timers.push(then);
"""


def shown_by_node(server, then=""):
    """The page's elements, as its script makes them of the run's numbers in a document that has no more than it needs.

    Code that comes ``then`` runs after the page has asked once.
    """
    node = shutil.which("node") or pytest.skip("needs node")
    page = server.page.decode()
    script = page[page.index("<script>") + len("<script>") : page.index("</script>")]
    wait = f"(async () => {{ while (!run) await new Promise(setImmediate); {then}"
    words = [node, "-e", f"{ELEMENTS}{script}{wait}; console.log(Object.values(made).join('')); }})();"]
    done = subprocess.run([*words, f"http://{HOME}:{server.server_port}/"], capture_output=True, text=True, timeout=60)
    return done.stdout or pytest.fail(done.stderr)


@pytest.mark.parametrize("by", ["chromium", "node"])
def test_the_page_shows_the_run(server, tmp_path, by):
    """Its progress, the curves of all splits, and a row with the latest return of each task."""
    shown = shown_by_chromium(server, tmp_path) if by == "chromium" else shown_by_node(server)
    told = json.loads(server.numbers())
    assert "600 of 600 steps (100%) · means over 2 seeds" in shown and "· done</div>" in shown
    assert all(f"{split}, evaluated: " in shown for split in told["scores"]["return"]) and "while it trains: " in shown
    found = re.findall(r"<tr.*?<button>(.*?)</button>.*?<td>([\d.]*)</td><td>([\d.]+)</td></tr>", shown)
    assert [name for name, _, _ in found] == [f"{task['called']} {task['label']}" for task in told["tasks"]]
    np.testing.assert_allclose([float(x) for *_, x in found], [task["scored"] for task in told["tasks"]], rtol=0.05)


def test_a_policy_alone_has_no_empty_panels(finished_run):
    """Only a run has curves over steps, and returns of its tasks."""
    bare = lambda server: shown_by_node(server, then="console.log(`<${$('panels').className}>`)").splitlines()[0]
    with serving("finger-spin-vary-size/sac-conditioned") as server:
        page = server.page.decode()
        assert bare(server) == "<bare>" and ".bare #curves, " in page and '<section id="curves">' in page
    with serving(finished_run) as server:
        assert bare(server) == "<>"


def test_a_chosen_task_has_its_own_curve(server):
    """Of training where it was trained, else of evaluations; and its latest value is that of its row."""
    tasks = json.loads(server.numbers())["tasks"]
    for i, how in ((1, "while it trains"), (len(tasks) - 1, "evaluated")):
        shown = shown_by_node(server, then=f"$('list').children[0].rows[{i}].cells[0].children[0].onclick()")
        task = tasks[i]
        value = re.search(rf"{task['called']} {task['label']}, {how}: ([\d.]+)", shown)
        assert value and float(value[1]) == pytest.approx(task["curve"][-1], rel=0.05)
        assert f"of {task['called']} {task['label']}</div>" in shown
