"""The raw files of the results: the site has a copy of each, a page that lists them, and links where pages name them.

MkDocs calls ``on_files`` and ``on_page_markdown``.
"""

import posixpath
import re
from pathlib import Path
from typing import Any

from markdown.extensions.toc import slugify
from mkdocs.structure.files import File, Files

NAMED = "benchmarks/results/"
RESULTS = Path(__file__).parent.parent / NAMED
HERE = "results/raw"
_TOP = "Single files"


def on_files(files: Files, config: Any) -> Files:
    """Add the raw files and their list."""
    for name in names():
        files.append(File.generated(config, f"{HERE}/{copy_of(name)}", abs_src_path=str(RESULTS / name)))
    files.append(File.generated(config, f"{HERE}/index.md", content=listing()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Link raw files where a page names them, and show the copies of plots."""
    to = posixpath.relpath(HERE, posixpath.dirname(page.file.src_uri) or ".")
    markdown = re.sub(rf"\]\([./]*{NAMED}", f"]({to}/", markdown)
    linked = lambda found: f"[{found[0]}]({to}/{place(found[1])})"
    return re.sub(rf"(?<!\[)`{NAMED}([^`\s]*)`", linked, markdown)


def names() -> list[str]:
    """Return the paths of all raw files below the folder of results."""
    return sorted(file.relative_to(RESULTS).as_posix() for file in RESULTS.rglob("*") if file.is_file())


def copy_of(name: str) -> str:
    """Return what a raw file is called on the site, where a Markdown file would become a page."""
    return f"{name}.txt" if name.endswith(".md") else name


def place(name: str) -> str:
    """Return where a file is, or where the files of a folder or a pattern are listed, as seen from the raw files."""
    if (RESULTS / name).is_file():
        return copy_of(name)
    folder = name.split("/")[0] if "/" in name or (RESULTS / name).is_dir() else _TOP
    return f"index.md#{slugify(folder or _TOP, '-')}"


def listing() -> str:
    """Return the page that lists all raw files, by folder."""
    groups: dict[str, list[str]] = {_TOP: []}
    for name in names():
        folder, _, inside = name.rpartition("/")
        groups.setdefault(folder.split("/")[0] if inside and folder else _TOP, []).append(name)
    text = f"# Raw files\n\nWhat the tables and figures are made from, as `{NAMED}` in the repository has it.\n"
    for title, members in groups.items():
        shown = lambda name, title=title: name.removeprefix(f"{title}/")
        text += f"\n## {title}\n\n" + " · ".join(f"[{shown(name)}]({copy_of(name)})" for name in members) + "\n"
    return text
