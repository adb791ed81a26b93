"""Long pages of results, cut into several on the site. In the repository each stays one file.

MkDocs calls ``on_files`` and ``on_page_markdown``.
"""

import re
from pathlib import PurePosixPath
from typing import Any

from markdown.extensions.toc import slugify
from mkdocs.structure.files import File, Files

FOLDER = "results/"
MOST = 6.0  # screens of a page
_ROW, _LETTER, _PICTURE, _TEXT = 0.05, 0.00032, 0.7, 0.037  # screens of 1440 x 900, fitted to pages in a browser
_LIST = 1  # screen of what the first page says of the others
_LONG = 200  # letters of a text's line, links and all
_HOMES: dict[str, dict[str, str]] = {}  # of a page that was cut: anchor -> the page that has it now


def on_files(files: Files, config: Any) -> Files:
    """Cut the pages of results that are too long, and put their parts into the navigation."""
    _HOMES.clear()
    for file in [file for file in files.documentation_pages() if file.src_uri.startswith(FOLDER)]:
        parts = cut(file.content_string)
        if len(parts) == 1:
            continue
        names = [file.src_uri, *(file.src_uri.replace(".md", f"-{i}.md") for i in range(2, len(parts) + 1))]
        title = _title(parts[0])
        _HOMES[file.src_uri] = {x: name for name, part in zip(names, parts, strict=True) for x in anchors(part)}
        for i, (name, part) in enumerate(zip(names[1:], parts[1:], strict=True), 2):
            files.append(File.generated(config, name, content=f"# {title}, {i} of {len(parts)}\n\n{part}"))
        file.content_string = _with_contents(parts, names)
        _nest(config.nav, file.src_uri, {name: _first(part) for name, part in zip(names[1:], parts[1:], strict=True)})
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to the part of a page that has their anchor."""
    here = page.file.src_uri
    source = next((whole for whole, homes in _HOMES.items() if here in (whole, *homes.values())), here)

    def moved(link: re.Match[str]) -> str:
        target, anchor = link[1], link[2]
        whole = str(_resolved(PurePosixPath(here).parent / target)) if target else source
        home = _HOMES.get(whole, {}).get(anchor)
        if home is None:
            return link[0]
        if home == here:
            return f"](#{anchor})"
        folder = target.rpartition("/")[0]
        return f"]({folder}{'/' * bool(folder)}{PurePosixPath(home).name}#{anchor})"

    return re.sub(r"\]\(([\w./-]*\.md|)#([\w-]+)\)", moved, markdown) if _HOMES else markdown


def _resolved(path: PurePosixPath) -> PurePosixPath:
    """Return a path without parents in it."""
    found: list[str] = []
    for part in path.parts:
        found = found[:-1] if part == ".." else [*found, part]
    return PurePosixPath(*found)


def screens(text: str) -> float:
    """Return roughly how many screens a text takes."""
    return sum(map(_height, filter(None, text.splitlines())))


def _height(line: str) -> float:
    if line.startswith("|"):
        return _ROW + _LETTER * len(line)
    return _PICTURE if line.startswith("![") else _TEXT * max(len(line) / _LONG, 1)


def cut(text: str) -> list[str]:
    """Cut a page at its titles into parts of at most ``MOST`` screens, or of one title. The first lists the others."""
    if screens(text) <= MOST:
        return [text]
    pieces = re.split(r"(?m)^(?=###? )", text)
    parts = pieces[:1]
    for piece in pieces[1:]:
        most = MOST - _LIST * (len(parts) == 1)
        if screens(parts[-1] + piece) > most and anchors(parts[-1]):
            parts.append(piece)
        else:
            parts[-1] += piece
    return parts


def anchors(text: str) -> dict[str, str]:
    """Return the titles of a text by their anchors."""
    titles = re.findall(r"(?m)^#{2,3} (.+)$", text)
    return {slugify(_plain(title), "-"): title for title in titles}


def _plain(title: str) -> str:
    """Return a title without marks and addresses."""
    return re.sub(r"[`*]|\[([^]]*)\]\([^)]*\)", r"\1", title)


def _title(text: str) -> str:
    found = re.search(r"(?m)^# (.+)$", text)
    return found[1] if found else ""


def _with_contents(parts: list[str], names: list[str]) -> str:
    """Return the first part with a list of what the others hold, below its first paragraphs."""
    lines = [
        f"- [{title}]({PurePosixPath(name).name}#{anchor})"
        for name, part in zip(names[1:], parts[1:], strict=True)
        for anchor, title in anchors(part).items()
    ]
    head, rest = re.split(r"(?m)^(?=##)", parts[0], maxsplit=1)
    return "\n".join([head.rstrip(), "", "On the pages that follow:", "", *lines, "", rest])


def _first(part: str) -> str:
    """Return a part's first title as plain text."""
    return _plain(next(iter(anchors(part).values())))


def _nest(nav: list[Any], page: str, parts: dict[str, str]) -> None:
    """Put the parts of a page behind it in the navigation, each by its title."""
    for entry in nav:
        inside = next(iter(entry.values())) if isinstance(entry, dict) else None
        if isinstance(inside, list):
            _nest(inside, page, parts)
        if isinstance(entry, dict) and inside == page:
            at = nav.index(entry)
            nav[at + 1 : at + 1] = [{title: name} for name, title in parts.items()]
            return
