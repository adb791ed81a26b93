"""Pages of the documentation that are made from the package: one for every family and every agent.

MkDocs calls what begins with ``on_``. Texts are the docstrings, numbers are those in ``benchmarks/results``.
"""

import ast
import csv
import dataclasses
import inspect
import json
import logging
import re
import tempfile
import textwrap
import tomllib
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import groupby, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from mtjax import agents, envs
from mtjax.agents.hyperparameters import PARTS, flag_names, kinds_of, settings
from mtjax.agents.parts import name_of
from mtjax.agents.parts.policies import Gaussian
from mtjax.envs.domain import Domain
from mtjax.envs.family import Family
from mtjax.envs.metaworld.scene import INSTALL
from mtjax.envs.pixels import Pictured
from mtjax.names import InputError, first_sentence
from mtjax.report import figures
from mtjax.saved import pretrained

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = Path(__file__).parent / "pictures" / "families"
LATE = Path(__file__).parent / "late_search.js"
ADDRESSES = Path(__file__).parent / "addresses.toml"
_CLONE = "git clone <this repository>"
_LOG = logging.getLogger("mkdocs.plugins.mtjax")
_UNSEARCHED = "{ data-search-exclude }"  # of a heading whose text is on many pages, and would drown the search
GROUPS = {  # title -> whether a family belongs there; the first that fits
    "Brax": lambda name, module: module.endswith("envs.brax"),
    "MTEnv's own": lambda name, module: ".mtenv." in module,
    "Grids": lambda name, module: ".craft." in module,
    "Tasks that nothing shows": lambda name, module: module.endswith("envs.hidden"),
    "Worlds of a few equations": lambda name, module: ".analytic." in module,
    "Hands": lambda name, module: ".dexterous." in module,
    "Mazes seen from within": lambda name, module: ".corridors." in module,
    "Meta-World": lambda name, module: ".metaworld." in module,
    "One physics, several goals": lambda name, module: name in envs._GOALS,
    "Further tasks on dm_control's bodies": lambda name, module: name in envs._FURTHER,
    "HiP-BMDP's families": lambda name, module: name in envs._HIP_BMDP,
    "dm_control's tasks": lambda name, module: True,
}


def on_config(config: Any) -> Any:
    """Put the made pages into the navigation, and the owner's addresses where they belong. Tell those that lack."""
    known = addresses()
    missing = [name for name, address in known.items() if not address]
    if missing:
        _LOG.info("%s lacks %s", ADDRESSES.name, ", ".join(missing))
    for difference in differences(known):
        _LOG.warning(difference)
    config.repo_url = known["repository"] or None
    config.site_url = known["site"] or config.site_url
    for entry in config.nav:
        (title,) = entry
        if title == "Families":
            pages = [{group: [{n: f"families/{n}.md"} for n in names]} for group, names in _grouped().items()]
            entry[title] = ["families/index.md", *pages]
        if title == "Agents":
            entry[title] = ["agents/index.md", *({name: f"agents/{name}.md"} for name in agents.AGENTS)]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the made pages and the curves that they show."""
    try:
        pages = {f"families/{name}.md": family_page(name) for name in envs.ENVS}
    except InputError as error:  # Meta-World's scenes are another package's
        raise PluginError(str(error)) from None
    pages |= {f"agents/{name}.md": agent_page(name) for name in agents.AGENTS}
    pages |= {"families/index.md": families_page(), "agents/index.md": agents_page()}
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    files.append(File.generated(config, "llms.txt", content=llms(config, files)))
    for place, curves in _curves().items():
        files.append(File.generated(config, f"{place}.png", content=_drawn(curves)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Name the owner's addresses where they belong, and let the search rank pages by what they are."""
    known = addresses()
    if boost := _boost(page.file.src_uri):
        page.meta.setdefault("search", {"boost": boost})
    if known["repository"]:
        markdown = markdown.replace(_CLONE, f"git clone {known['repository']}")
    if known["doi"] and page.file.src_uri == "citing.md":
        markdown += f"\nDOI: <{known['doi']}>\n"
    return markdown


def _boost(place: str) -> float | None:
    """Return how much more than others a page counts in the search; None for as much."""
    if place.startswith(("guide/", "how-to/")):
        return 2
    return 0.5 if place.startswith("results/") and place != "results/index.md" else None


def on_post_page(output: str, **_: Any) -> str:
    """Let the page read the search's index when it is wanted, and keep flags in its code whole."""
    output = re.sub(r"(?s)<code\b.*?</code>", lambda code: whole_flags(code[0]), output)
    return output.replace("</head>", f"<script>{LATE.read_text(encoding='utf-8')}</script></head>", 1)


def whole_flags(code: str) -> str:
    """Mark each ``--name`` in the HTML of code, so that no line ends behind its hyphens. The text stays the same."""
    return re.sub(r"(?<![\w-])--\w[\w.-]*", r'<span class="flag">\g<0></span>', code)


def on_post_template(output_content: str, **_: Any) -> str:
    """Do so on the page that stands for those that are missing."""
    return on_post_page(output_content)


@lru_cache
def addresses() -> dict[str, str]:
    """Return the addresses that only the owner of a published copy knows, by name; empty where there is none."""
    return tomllib.loads(ADDRESSES.read_text(encoding="utf-8"))


def differences(known: dict[str, str]) -> list[str]:
    """Return how the files that are read without the site differ from the owner's addresses, a sentence for each."""
    citation = dict(re.findall(r'(?m)^([\w-]+): "?([^"\n]+)', (ROOT / "CITATION.cff").read_text(encoding="utf-8")))
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
    places = (
        ("CITATION.cff", "repository-code", citation, known["repository"]),
        ("CITATION.cff", "url", citation, known["site"]),
        ("CITATION.cff", "doi", citation, known["doi"].removeprefix("https://doi.org/")),
        ("pyproject.toml", "Repository", urls, known["repository"]),
        ("pyproject.toml", "Documentation", urls, known["site"]),
    )
    return [
        f"{file}: {key} is {there.get(key, '')!r}, and {ADDRESSES.name} has {address!r}"
        for file, key, there, address in places
        if there.get(key, "") != address
    ]


def llms(config: Any, files: Files) -> str:
    """Return llms.txt, a list of all pages with what each is about, for programs that read the site."""
    root = f"{config.site_url.rstrip('/')}/" if config.site_url else ""  # or else links are relative
    lines = [
        f"# {config.site_name}",
        "",
        f"> {config.site_description}. Commands are whole and run as they stand; runs/... is a run of yours.",
    ]
    for entry in config.nav:
        ((title, inside),) = entry.items()
        lines += ["", f"## {title}", ""]
        pages = [inside] if isinstance(inside, str) else _pages(inside)
        lines += [_entry(root, files.get_file_from_path(page)) for page in pages]
    return "\n".join(lines) + "\n"


def _pages(entries: Iterable[Any]) -> Iterator[str]:
    """Yield the pages of a part of the navigation. Of made pages there is a list, which has them all."""
    for entry in entries:
        inside = entry if isinstance(entry, str) else next(iter(entry.values()))
        if isinstance(inside, str) and not ("/" in inside and inside.split("/")[0] in ("families", "agents")):
            yield inside
        elif isinstance(entry, str):
            yield entry


def _entry(root: str, file: Any) -> str:
    """Return a page's line: title, address and first sentence."""
    text = re.sub(r"(?s)\A---.*?\n---\n", "", file.content_string)  # what a page tells the builder
    title = re.search(r"^# (.+)$", text, re.M)
    plain = re.sub(r"(?m)^[#|!<].*$", "", re.sub(r"(?s)```.*?```", "", text))
    linked = lambda link: link[1] or ""
    says = first_sentence(re.sub(r"\[([^]]+)\]\([^)]*\)|[*`]", linked, plain.strip())).removesuffix(":")
    return f"- [{title[1] if title else file.name}]({root + file.url.removeprefix('./') or './'}): {says}"


# Families.


def _grouped() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {title: [] for title in reversed(GROUPS)}
    for name in envs.ENVS:
        module = envs.ENVS[name][0].__module__
        found[next(title for title, fits in GROUPS.items() if fits(name, module))].append(name)
    return found


def families_page() -> str:
    """Return the list of all families."""
    text = (
        "# Families\n\nA family is one model and the values in which its tasks differ. `python -m mtjax.train --list`"
    )
    text += " prints this list. Every parameter of every family can vary: `--env.vary.NAME=VALUES`.\n"
    for title, names in _grouped().items():
        text += f"\n## {title}\n\n| family | training tasks | |\n|---|---|---|\n"
        for name in names:
            count, says = envs.outline(name)
            text += f"| [{name}]({name}.md) | {count} | {says} |\n"
    text += "\n## Benchmarks\n\nMixtures of the families above, by a name.\n\n"
    text += "| benchmark | training tasks | |\n|---|---|---|\n"
    for name, (says, own) in envs.BENCHMARKS.items():
        text += f"| `{name}` | {sum('held_out' not in settings for settings in own.values())} | {says} |\n"
    return text


def family_page(name: str) -> str:
    """Return the page of one family: command, docstring, parameters, tasks and figures."""
    cls, _ = envs.ENVS[name]
    family = envs.make(name)
    before = [INSTALL] if ".metaworld." in cls.__module__ else []
    text = f"# {name}\n\n{_picture(name)}{_command(family_flags(name), *_film_flags(name), before=before)}"
    text += f"{to_markdown(cls.__doc__)}\n"
    for base in _described_bases(cls):
        text += _inherited(base, text)
    if family.parameters:
        text += "\n## Parameters\n\n| parameter | unit | nominal | in this family |\n|---|---|---|---|\n"
        vary = dict(family.vary)
        for key, parameter in family.parameters.items():
            nominal = f"{parameter.nominal:g}" if isinstance(parameter.nominal, int | float) else "its own"
            given = f"`{vary[key]}`" if key in vary else ""
            text += f"| `{key}` | {parameter.unit} | {nominal} | {given} |\n"
    text += _family_figures(name)
    return text + _family_settings(family)


def _command(*lines: str, before: Iterable[str] = ()) -> str:
    """Return commands that train, by their flags, behind those of the shell that they need."""
    return "\n".join(["```bash", *before, *(f"python -m mtjax.train {flags}" for flags in lines), "```\n\n"])


def family_flags(name: str) -> str:
    """Return the flags of a command that trains a family by an agent that draws its actions."""
    spec = envs.make(name).spec
    if spec.action.kind == "continuous":
        return f"--env={name}"
    return f"--env={name} {_TRIALS.get(name) or ('--agent=sketches' if spec.symbols else '--agent=ppo')}"


_TRIALS = {  # families whose tasks are hidden -> an agent that finds them out
    "grid-navi": "--agent=rl2 --trials=4 --agent.unroll=60",
    "hidden-bandit": "--agent=rl2 --trials=10 --agent.unroll=10",
}


def _film_flags(name: str) -> list[str]:
    """Return the flags of the agent that a family's film shows, if it is known and not the default one."""
    lines = []
    for runs, row in _filmed(name):
        agent = row["agent"]
        known = agent in agents.AGENTS and not agents.AGENTS[agent].sees_pictures
        flags = f"--env={name} --agent={agent}"
        if known and flags != family_flags(name):
            lines.append(f"{flags}    # as in the film{', on a GPU' * (runs == _ON_GPU)}")
    return lines


def _filmed(name: str) -> list[tuple[str, dict[str, str]]]:
    """Return the runs, and the last line in them, of the policy that a family's film shows, if one is known."""
    rows = [(runs, row) for runs in _FILMED for row in _runs_of(runs, name)]
    return rows[-1:] if (PICTURES / f"{name}.webp").exists() else []


def _described_bases(cls: type) -> list[type]:
    """Return the classes that a family is made from, up to those that all families are made from."""
    bases = takewhile(lambda base: base not in (Domain, Pictured, Family), cls.__mro__[1:])
    return [base for base in bases if base.__doc__ and base.__module__.startswith("mtjax")]


def _inherited(base: type, above: str) -> str:
    """Return the text of a class that a family is made from. What is told above of the family counts before it."""
    text = (
        f"\n## {base.__name__} {_UNSEARCHED}\n\nWhat stands here holds too, unless the text above says otherwise.\n\n"
    )
    told = to_markdown(base.__doc__)
    if "**Reward**: " in above:  # of which the formula above takes terms
        told = told.replace("**Reward**: ", "**Reward in general**: ")
    return f"{text}{told}\n"


def _family_settings(family: Any) -> str:
    documented = _fields(type(family))
    text = f"\n## Settings {_UNSEARCHED}\n\nFields of `{type(family).__module__}.{type(family).__name__}`.\n\n"
    text += "| flag | default | |\n|---|---|---|\n"
    for field in dataclasses.fields(family):
        if field.name not in ("vary", "context_ranges"):
            flag = field.name.replace("_", "-")
            flag = flag if flag in ("split", "engine") else f"env.{flag}"
            text += _row(f"`--{flag}`", getattr(family, field.name), documented.get(field.name, ""))
    return text


def _row(flag: str, default: Any, text: str) -> str:
    shown = "" if default in ("", ()) else f"`{default}`"
    return f"| {flag} | {shown} | {text.replace('|', '&#124;')} |\n"


def _picture(name: str) -> str:
    """Return a film or a still of a family's tasks, if there is one."""
    text = ""
    for file in PICTURES.glob(f"{name}.*"):
        text += f"![tasks of {name}](../pictures/families/{file.name})\n\n"
        text += _caption(name) if file.suffix == ".webp" else ""
    return text


def _caption(name: str) -> str:
    """Return who plays in a family's film, and what is seen where trials have several episodes."""
    runs = [f"As {row['agent']} plays with a return of {_score(row)}." for _, row in _filmed(name)]
    lines = runs or [f"As [`{policy}`](../results/policies.md) plays." for policy in _players(name)[:1]]
    lines += ["The episodes of one trial, side by side."] * (name in _TRIALS)
    return "".join(f"{line}\n\n" for line in lines)


def _players(name: str) -> list[str]:
    """Return the policies of the package that play a family, alone or in a benchmark."""
    played = {policy: policy.split("/")[0] for policy in pretrained.names()}
    return [x for x, of in played.items() if of == name or name in envs.BENCHMARKS.get(of, ("", ()))[1]]


def _score(row: dict[str, str]) -> str:
    """Return a run's return as text; those of mazes are 1 at most."""
    value = float(row["return"])
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"


def _family_figures(name: str) -> str:
    text = ""
    if rows := _rows(RESULTS / _THREE_SEEDS / "table.md", 0, name):
        text += f"\n### One H200, three seeds {_UNSEARCHED}\n\n{rows}"
        text += "\nThe [command](../results/returns.md#returns-within-minutes-of-training-on-one-h200-three-seeds).\n"
        text += f"\n![return over steps, three seeds]({name}-{_THREE_SEEDS}.png)\n"
    text += _methods(0, name)
    for runs, (title, place) in _ONE_SEED.items():
        for row in _runs_of(runs, name)[-1:]:
            text += f"\n### {title} {_UNSEARCHED}\n\n{row['agent']} had a return of {_score(row)} after "
            text += f"{float(row['seconds']):.0f} seconds ({int(row['steps']):,} steps). The "
            text += f"[command](../results/returns.md#{place}).\n\n![return over steps]({_drawing(name, runs)}.png)\n"
    return f"\n## Figures\n{text}" if text else ""


_ON_GPU, _ON_CPU, _OF_FIFTY, _THREE_SEEDS = "h200-families", "cpu-films", "h100-metaworld/mt50-brc", "h200-returns"
_OF_BRAX = "h200-brax"
_FILMED = _ON_GPU, _ON_CPU, "h100-hard/films"  # runs whose policies the films show; the last one of a family
_ONE_SEED = {  # runs -> their title, and where their command stands
    _ON_GPU: (
        "One H200 that six to ten runs share, one seed",
        "fifty-families-for-a-few-minutes-each-on-a-shared-h200-one-seed",
    ),
    _ON_CPU: (
        "Two CPU cores beside other programs, one seed",
        "fifty-families-for-a-few-minutes-each-on-a-shared-h200-one-seed",
    ),
    _OF_BRAX: (
        "One H200 beside four other programs, one seed",
        "braxs-families-for-three-quarters-of-a-minute-each-on-a-shared-h200-one-seed",
    ),
    "cpu-families": ("Two CPU cores, one seed", "twenty-four-families-on-two-cpu-cores-seven-minutes-one-seed"),
    "cpu-minutes": (
        "Two CPU cores beside other programs, one seed, at most a minute",
        "families-of-a-few-equations-a-minute-each-on-two-cpu-cores-one-seed",
    ),
    _OF_FIFTY: (
        "One of the fifty tasks of mt50, one H100 beside another program, one seed",
        "meta-worlds-mt50-half-a-million-steps-a-task-one-h100-one-seed",
    ),
}


@lru_cache
def _all_runs(runs: str) -> list[dict[str, str]]:
    rows = _read(RESULTS / f"{runs}.csv")
    return _of_each(rows) if runs == _OF_FIFTY else rows


def _read(file: Path) -> list[dict[str, str]]:
    with file.open() as lines:
        return list(csv.DictReader(lines))


def _of_each(rows: list[dict[str, str]]) -> list[dict[str, Any]]:
    """Return the lines of one agent for all tasks of mt50 as lines of each task, with its own steps and return."""
    names = list(envs.BENCHMARKS["mt50"][1])
    line = lambda i, name, row: {
        **{"family": name, "agent": "brc", "seconds": row["seconds"], "return": row[f"return_{i}"]},
        "steps": str(int(row["steps"]) // len(names)),
    }
    return [line(i, name, row) for i, name in enumerate(names) for row in rows]


def _drawing(name: str, runs: str) -> str:
    """Return the name of the picture of a family's curve."""
    return f"{name}-{runs.replace('/', '-')}"


def _runs_of(runs: str, name: str) -> list[dict[str, str]]:
    """Return the lines of a family's run in a file of runs of one seed."""
    return [row for row in _all_runs(runs) if row["family"] == name]


# Agents.


PAPERS = {  # agents -> the numbers of their papers at arXiv, of those that are known for certain
    "sac": "1801.01290",
    "distral": "1707.04175",
    "care": "2102.06177",
    "film": "1709.07871",
    "moore": "2311.11385",
    "soft-modularization": "2003.13661",
    "paco": "2210.11653",
    "brc": "2505.23150",
    "simba-v2": "2502.15280",
    "xqc": "2509.25174",
    "deepmdp": "1906.02736",
    "hip-bmdp": "2007.07206",
    "drq": "2107.09645",
    "sac-ae": "1910.01741",
    "ppo": "1707.06347",
    "impala": "1802.01561",
    "rl2": "1611.02779",
    "maml": "1703.03400",
    "pqn": "2407.04811",
    "sketches": "1611.01796",
    "options": "1609.05140",
    "distil": "1511.06295",
    "pcgrad": "2001.06782",
    "cagrad": "2110.14048",
    "gradnorm": "1711.02257",
    "famo": "2306.03792",
}


def agents_page() -> str:
    """Return the list of all agents."""
    text = "# Agents\n\nMost agents are a choice of parts, and every agent takes every part that fits it.\n\n"
    text += "| agent | | parts that its name chooses |\n|---|---|---|\n"
    for name, preset in agents.AGENTS.items():
        chosen = ", ".join(f"`{key}={value}`" for key, value in preset.defaults.items())
        text += f"| [{name}]({name}.md) | {preset.says} | {chosen} |\n"
    return text + "\n" + "\n".join(_kind_table(kind) for kind in PARTS)


def _kind_table(kind: str) -> str:
    text = f"## `--agent.{kind}`\n\n| name | |\n|---|---|\n"
    for name, cls in PARTS[kind].items():
        text += f"| `{name}` | {first_sentence(cls.__doc__ or '')} |\n"
    return text


def agent_page(name: str) -> str:
    """Return the page of one agent: command, docstrings of agent and parts, settings and figures."""
    preset, agent = agents.AGENTS[name], agents.agent(name)
    paper = f" Paper: [arXiv {PAPERS[name]}](https://arxiv.org/abs/{PAPERS[name]})." if name in PAPERS else ""
    text = f"# {name}\n\n{preset.says}.{paper}\n\n{_command(*agent_flags(name))}"
    if preset.defaults:
        pairs = ", ".join(f"`{key}={value}`" for key, value in preset.defaults.items())
        text += f"It is `{preset.cls.__name__}` with {pairs}.\n\n"
    text += f"## {preset.cls.__name__}\n\n{to_markdown(preset.cls.__doc__)}\n"
    for kind in kinds_of(agent):
        if kind in preset.defaults:
            part = getattr(agent, kind)
            text += f"\n## {kind}: {name_of(PARTS[kind], part)}\n\n{to_markdown(type(part).__doc__)}\n"
    return text + _agent_figures(name) + _settings(agent)


def agent_flags(name: str) -> list[str]:
    """Return the flags of commands that train by an agent, one after another, on tasks that it can learn."""
    cls = agents.AGENTS[name].cls
    if agents.AGENTS[name].sees_pictures:
        return [f"--env=finger-spin-vary-size --agent={name} --env.pixels=64 --env.frames=3 --env.repeat=2"]
    if cls.follows_sketches:
        return [f"--env=craft-sketched --agent={name}"]
    if cls.taught:
        return ["--env=point-mass-vary-goal", f"--env=point-mass-vary-goal --agent={name} --from=runs/..."]
    return [f"--agent={name}" if Gaussian in cls.policies else f"--env=bandit --agent={name}"]


def _settings(agent: Any) -> str:
    holders = [agent, *(getattr(agent, kind) for kind in kinds_of(agent)), agent.experience]
    documented = {name: text for holder in reversed(holders) for name, text in _fields(type(holder)).items()}
    values, text = settings(agent), f"\n## Settings {_UNSEARCHED}\n\n| flag | default | |\n|---|---|---|\n"
    for name, flag in flag_names(agent).items():
        text += _row(f"`--{flag}`", values[name], documented.get(name, "a part, chosen by name"))
    return text


def _methods(column: int, name: str) -> str:
    """Return the rows of the tables of all agents whose family (column 0) or agent (1) is ``name``."""
    text = ""
    for folder, title, place in _METHODS:
        if rows := _rows(RESULTS / folder / "table.md", column, name):
            text += f"\n### {title} {_UNSEARCHED}\n\n{rows}\nThe [command](../results/methods.md#{place}).\n"
    return text


def _fields(cls: type) -> dict[str, str]:
    """Return the documentation of a dataclass's fields, its bases' included."""
    found: dict[str, str] = {}
    for base in reversed([each for each in cls.__mro__ if each.__module__.startswith("mtjax")]):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        for field, below in pairwise(node.body):  # type: ignore
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                found[ast.unparse(field.target)] = " ".join(str(below.value.value).split())
    return found


def _agent_figures(name: str) -> str:
    text = ""
    if rows := _rows(RESULTS / _THREE_SEEDS / "table.md", 1, name.upper()):
        text += f"\n### One H200, three seeds {_UNSEARCHED}\n\n{rows}"
        text += "\nThe [command](../results/returns.md#returns-within-minutes-of-training-on-one-h200-three-seeds).\n"
    text += _methods(1, name)
    if f"agents/{name}" in _curves():
        text += f"\n![return of training episodes over steps, ten seeds]({name}.png)\n"
    costs = {machine: _cost(file, name) for machine, file in _COSTS.items()}
    if any(costs.values()):
        told = ", ".join(f"{cost:.2f} times sac on {machine}" for machine, cost in costs.items() if cost)
        text += f"\n### Cost of an update {_UNSEARCHED}\n\n{told}, ten tasks. "
        text += "The [command](../results/speed.md#what-an-update-of-every-agent-costs).\n"
    return f"\n## Figures\n{text}" if text else ""


_METHODS = (
    ("h200-methods", "All agents, one H200, ten seeds", "every-agent-with-its-preset-ten-seeds-one-h200"),
    (
        "h200-hip-bmdp",
        "HiP-BMDP's split, one H200, ten seeds, shorter runs",
        "an-earlier-shorter-table-on-hip-bmdps-split",
    ),
)
_COSTS = {"one H200": "update-cost-h200-10-tasks.json", "two CPU cores": "update-cost-cpu.json"}


@lru_cache
def _cost(file: str, name: str) -> float | None:
    rows = json.loads((RESULTS / file).read_text())["rows"]
    return next((row["over_sac"] for row in rows if row["agent"] == name), None)


# Curves.


@lru_cache
def _curves() -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return what is drawn, by the place of the drawing: lines by name, of steps (V,) and returns (S, V, 1, 1)."""
    found: dict[str, dict[str, Any]] = {}
    for runs in _ONE_SEED:
        for name in sorted({row["family"] for row in _all_runs(runs)} & set(envs.ENVS)):
            rows = _runs_of(runs, name)
            found[f"families/{_drawing(name, runs)}"] = {rows[0]["agent"]: _curve(rows)}
    for file in sorted((RESULTS / _THREE_SEEDS).glob("*.csv")):
        agent = json.loads(file.with_suffix(".json").read_text())["agent"].partition("(")[0].lower()
        found[f"families/{file.stem}-{_THREE_SEEDS}"] = {agent: _curve(_read(file))}
    for file in sorted((RESULTS / "h200-methods").glob("*/*.csv")):
        if file.stem in agents.AGENTS:
            found.setdefault(f"agents/{file.stem}", {})[file.parent.name] = _curve(_read(file))
    return found


def _curve(rows: list[dict[str, str]]) -> tuple[np.ndarray, np.ndarray]:
    seeds = len({row.get("seed") for row in rows})
    steps, returns = (
        np.array([float(row[x] or "nan") for row in rows]).reshape(-1, seeds) for x in ("steps", "return")
    )
    known = np.all(np.isfinite(returns), axis=1)
    return steps[known, 0], returns[known].T[:, :, None, None]


def _drawn(curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        figures.compare(file := Path(folder) / "curves.png", curves, "return of training episodes")
        return file.read_bytes()


# Text.


def _rows(file: Path, column: int, value: str) -> str:
    """Return a Markdown table's head and those rows that have a value in a column, or nothing."""
    lines = file.read_text().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    kept = [line for line, row in zip(lines[2:], cells[2:], strict=True) if row[column : column + 1] == [value]]
    return "\n".join([*lines[:2], *kept]) + "\n" if kept else ""


def to_markdown(docstring: str | None) -> str:
    """Return a docstring as Markdown: labels in bold, indented lists as lists, equations set apart."""
    return "\n\n".join(_block(*block) for block in _blocks(inspect.cleandoc(docstring or "").splitlines()))


def _blocks(lines: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each paragraph or labelled line, and what is indented below it."""
    text, below, fresh = "", [], True
    for line in [*lines, ""]:
        if line.startswith("    "):
            below.append(line[4:])
            continue
        labelled = re.match(r"(?!Differs)[A-Z][\w ]*(\([^)]*\))?[^:.]*: ", line) and not text.endswith((",", "and"))
        if (not line or below or fresh or labelled) and text:
            yield text, below
            text, below = "", []
        text, fresh = f"{text} {line}".strip(), not line
    if text:
        yield text, below


def _block(text: str, below: list[str]) -> str:
    if below and text.endswith(":") and any(re.match(r"[\w, -]+: ", line) for line in below):
        items = [re.sub(r"^([\w, -]+?):", r"**\1**:", line) for line in _items(below)]
        return f"**{text}**\n\n" + "\n".join(f"- {item}" for item in items)
    if below and not re.match(_LABEL, text) and (text.endswith(":") or re.search(r" (=|<-) ", below[0])):
        return f"{text}\n\n{_code(below)}"
    told = []
    for deeper, group in groupby([text, *below], lambda line: line.startswith("    ")):
        lines = [line.strip() for line in group]
        told.append(_code(lines) if deeper else " ".join(lines))
    return re.sub(_LABEL, r"**\1**: ", "\n\n".join(told))


def _code(lines: Iterable[str]) -> str:
    return "\n".join(["```text", *lines, "```"])


def _items(lines: list[str]) -> list[str]:
    """Join the lines of each item. An item goes on in lines that are indented, or that follow an open sentence."""
    items: list[str] = []
    for line in lines:
        if items and (line.startswith(" ") or not items[-1].endswith((".", ";"))):
            items[-1] += f" {line.strip()}"
        else:
            items.append(line)
    return items


_LABEL = r"^(?!As )([A-Z][\w ]*?(?: \([^)]*\))?(?:,[^:.]*)?): "
