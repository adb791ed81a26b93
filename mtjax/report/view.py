"""``python -m mtjax.evaluate --run=DIR --view``: a page of a run on this machine, with its curves and moving worlds.

The page is ``view.html``. It asks for ``run.json`` every other second, and shows ``worlds``, a stream of pictures.
There is nothing else to ask for: no file is served by its name. Worlds move only while somebody looks.
"""

import contextlib
import io
import itertools
import json
import math
import os
import stat
import threading
import time
from collections.abc import Generator, Mapping
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np
from PIL import Image

from mtjax.checks import HOME, require_port
from mtjax.compiling.programs import enable_compile_cache
from mtjax.learning.evaluation import Recording
from mtjax.names import SPLITS, InputError
from mtjax.report import films
from mtjax.report.page_data import Watched
from mtjax.report.scoring import first_seed, other_tasks, with_tasks
from mtjax.saved import checkpoint, lock, pretrained
from mtjax.saved.config_json import from_json
from mtjax.saved.policy import Policy, load
from mtjax.types import Task

_FPS, _LONGEST = 25, 30.0  # pictures a second at most, and seconds after which worlds move by a newer policy
_MOST = 9  # tasks beside each other
_WAIT = 2.0  # seconds until what failed is tried again
_PATIENCE = 4.0  # seconds in which a page that is open asks again
_EDGE = "next-picture"
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src 'self' data:; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'",
    "X-Content-Type-Options": "nosniff",
}


def show(request: Any, vary: Mapping[str, str]) -> None:
    """Serve the page of a run until Ctrl-C, or, where the input is a pipe, until that is closed.

    Args:
        request: the settings of ``mtjax.evaluate``.
        vary: values of parameters for tasks of its own, by name; without any, worlds of the run's tasks move.

    Raises:
        InputError: the port cannot be used, or the folder is not a run.
    """
    require_port(request.view)
    enable_compile_cache()
    with Server(request, vary) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"see it at http://{HOME}:{server.server_port}, and end it by Ctrl-C", flush=True)
        if _is_fed():
            threading.Thread(target=_end_with_input, args=(server,), daemon=True).start()
        server.serve_forever()


def _is_fed() -> bool:
    """Return whether a pipe is this process's input, which whoever holds it closes."""
    with contextlib.suppress(OSError):
        return stat.S_ISFIFO(os.fstat(0).st_mode)
    return False


def _end_with_input(server: "Server") -> None:
    """Stop a server when this process's input is closed, and a page that is open has the last numbers."""
    while os.read(0, 4096):
        pass
    server.wait_until_told()
    server.shutdown()


class _Playing(NamedTuple):
    """Holds a policy, the tasks that it plays, and other names of their splits."""

    policy: Policy
    tasks: Task
    named: Mapping[str, str]


class Worlds:
    """Plays the newest policy of a run, and draws what it does."""

    def __init__(self, request: Any, vary: Mapping[str, str]):
        self.request, self.vary = request, vary
        self.busy, self.ended = threading.Lock(), threading.Event()
        self.checkpoints = pretrained.folder(request.run) / "checkpoints"
        self.playing, self.played = lru_cache(1)(self._load), lru_cache(1)(self._play)

    def stream(self, split: str = "", number: int = 0) -> Generator[bytes, None, None]:
        """Yield pictures as JPEG, each when it is to be shown, until ``ended`` is set.

        Args:
            split: that of the task to show; by default the first, the middle and the last training task are shown.
            number: the task's number in the split.
        """
        for episode in itertools.count():
            try:
                yield from self._episode(episode, split, number)
            except (InputError, OSError) as error:  # a checkpoint may go while it is read
                yield _jpeg(_card(str(error)))
                self.ended.wait(_WAIT)
            if self.ended.is_set():
                return

    def _episode(self, episode: int, split: str, number: int) -> Generator[bytes, None, None]:
        newest = self._newest()
        if not self.played.cache_info().currsize:
            yield _jpeg(_card("the policy is loaded, and plays its first episode"))
        with self.busy:  # so that pages that look at once share what is played
            playing, played = self.playing(newest), self.played(newest, episode)
        env, named = playing.policy.env, playing.named
        chosen = [films.choose_one(env, split, number)] if split else films.choose(env, SPLITS[:1], ())[:_MOST]
        with films.moving(env, chosen, *played, named, shadows=False) as (seconds, draw):
            begun = time.monotonic()
            while (now := time.monotonic() - begun) < min(seconds, _LONGEST) and not self.ended.is_set():
                picture = _jpeg(draw(now))
                took = time.monotonic() - begun - now
                yield picture
                time.sleep(max(1 / _FPS - took, took))  # drawing takes half a core at most

    def _newest(self) -> str:
        """Return the name of the newest checkpoint; empty for a policy without any."""
        found = checkpoint.newest(self.checkpoints)
        if found is None and lock.is_held(self.checkpoints.parent):
            raise InputError("worlds move once there is a checkpoint, which follows the first evaluation")
        return "" if found is None else found.name

    def _load(self, newest: str) -> _Playing:
        asked = self.request
        policy = load(asked.run, first_seed(asked.run, asked.point), asked.checkpoint)
        policy, tasks, named = with_tasks(policy, self.vary, asked.drawn)
        films.require(policy.env)
        return _Playing(policy, policy.env.tasks("all") if tasks is None else tasks, named)

    def _play(self, newest: str, episode: int) -> tuple[Recording, dict[str, Any]]:
        policy, tasks, _ = self.playing(newest)
        return films.play(policy, tasks, self.request.seed + episode, self.request.sampled)


def _card(text: str) -> np.ndarray:
    """Return a picture (height, width, 3) of a text."""
    return films.captioned([np.zeros((1, 240, 480, 3), np.uint8)], [[text]])[0][0]


def _jpeg(frame: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=88)
    return file.getvalue()


class Server(ThreadingHTTPServer):
    """Serves the page of a run, its numbers and its pictures, to this machine alone."""

    daemon_threads = True

    def __init__(self, request: Any, vary: Mapping[str, str]):
        folder = pretrained.folder(request.run)
        config = from_json(folder / "config.json")
        self.watched = Watched.of(folder, config, other_tasks(config.family, vary, request.drawn))
        self.worlds, self.reading = Worlds(request, vary), threading.Lock()
        self.streams: set[threading.Thread] = set()
        self.told, self.when = threading.Event(), -math.inf  # when a page had numbers
        self.page = (resources.files("mtjax.report") / "view.html").read_bytes()
        super().__init__((HOME, request.view), _Answers)

    def server_close(self) -> None:
        """Give the port back, and wait until whatever draws has ended, as Python must not end before."""
        super().server_close()
        self.worlds.ended.set()
        for thread in tuple(self.streams):
            thread.join()

    def numbers(self) -> bytes:
        """Return what the page shows of the run, as JSON."""
        with self.reading:
            return json.dumps(self.watched.told(), allow_nan=False).encode()

    def note_told(self) -> None:
        """Note that a page has the numbers of now."""
        self.when = time.monotonic()
        self.told.set()

    def wait_until_told(self) -> None:
        """Wait until a page that is open has the numbers of now."""
        self.told.clear()
        if time.monotonic() - self.when < _PATIENCE:
            self.told.wait(_PATIENCE)


class _Answers(BaseHTTPRequestHandler):
    """Answers one request."""

    server: Server  # type: ignore[assignment]
    timeout = 10  # seconds until who neither asks nor reads is given up

    def do_GET(self) -> None:
        """Answer with the page, the run's numbers or the pictures of a task; of anything else there is nothing."""
        asked, host = urlsplit(self.path), urlsplit(f"//{self.headers.get('Host', '')}").hostname
        query = {name: values[-1] for name, values in parse_qs(asked.query).items()}
        with contextlib.suppress(ConnectionError, TimeoutError):  # whoever looked has gone
            if host not in (HOME, "localhost"):  # another site's name that was made to lead here
                self.send_error(HTTPStatus.FORBIDDEN)
            elif asked.path == "/":
                self._answer("text/html; charset=utf-8", self.server.page)
            elif asked.path == "/run.json":
                self._answer("application/json", self.server.numbers())
                self.server.note_told()
            elif asked.path == "/worlds" and query.get("task", "0").isdecimal():
                self._stream(query.get("split", ""), int(query.get("task", "0")))
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

    def _answer(self, kind: str, body: bytes) -> None:
        self._begin(kind)
        self.wfile.write(body)

    def _stream(self, split: str, number: int) -> None:
        """Send pictures. Each takes the place of the one before."""
        self._begin(f"multipart/x-mixed-replace; boundary={_EDGE}")
        edge = f"--{_EDGE}\r\n".encode()
        self.server.streams.add(threading.current_thread())
        try:
            self.wfile.write(edge)
            with contextlib.closing(self.server.worlds.stream(split, number)) as pictures:
                for picture in pictures:  # which browsers show once they see where it ends
                    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
                    self.wfile.write(head.encode() + picture + b"\r\n" + edge)
        finally:
            self.server.streams.discard(threading.current_thread())

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in {"Content-Type": kind, **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Print nothing, as the page asks every other second."""
