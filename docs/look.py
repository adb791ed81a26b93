"""Look at a built site in Chromium, at the widths of a phone, a tablet and a desk.

    pip install playwright    # and a Chromium, such as Debian's
    mkdocs build -d site && python docs/look.py site [--out DIR] [--pages PLACE ...]

It writes ``DIR/PLACE-WIDTH.png``, the first screen of each page, and prints each page's height in screens. A page that
is wider than its window, or that says an error to the browser's console, is told, and the exit code is 1.
"""

import argparse
import functools
import http.server
import shutil
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

WINDOWS = ((390, 844), (820, 1100), (1440, 900))  # width, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", type=Path)
    parser.add_argument("--out", type=Path, default=Path("looks"))
    parser.add_argument("--pages", nargs="+", help="such as guide/meta-rl/; by default all")
    arguments = parser.parse_args()
    found = sorted(str(path.parent.relative_to(arguments.site)) for path in arguments.site.rglob("index.html"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    faults = list(looked(served(arguments.site), arguments.pages or found, arguments.out))
    print(*faults or ["no fault"], sep="\n")
    sys.exit(bool(faults))


def served(site: Path) -> str:
    """Serve a folder on this machine while the process lasts, and return its address."""
    handler = functools.partial(_Silent, directory=site)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


class _Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


def looked(address: str, pages: list[str], out: Path) -> Iterator[str]:
    """Write a picture of every page at every width, print its height, and yield what is wrong with it."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for width, height in WINDOWS:
            tab, said = browser.new_page(viewport={"width": width, "height": height}), []
            tab.on("console", lambda message, said=said: message.type == "error" and said.append(message.text))
            for place in pages:
                said.clear()
                tab.goto(f"{address}/{place}", wait_until="load")
                wide, tall = tab.evaluate("(({scrollWidth: x, scrollHeight: y}) => [x, y])(document.documentElement)")
                print(f"{width} {place}: {tall / height:.1f} screens", flush=True)
                tab.screenshot(path=out / f"{place.strip('./').replace('/', '-') or 'index'}-{width}.png")
                yield from (f"{place} at {width}: {text}" for text in said)
                if wide > width:
                    yield f"{place} at {width}: {wide - width} pixels wider than the window"


if __name__ == "__main__":
    main()
