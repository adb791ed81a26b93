"""The documentation: its links, its names and commands, and the site that is built from it."""

import importlib.util
import json
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from needs import needs

import mtjax
from mtjax.agents import AGENTS
from mtjax.command.run_config import parse
from mtjax.envs import ENVS, SUITES
from mtjax.names import first_sentence
from mtjax.saved.config_json import write_config
from mtjax.training.launch import check

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [*DOCS, ROOT / "README.md", ROOT / "benchmarks" / "RESULTS.md"]
MADE = {
    *(ROOT / "docs" / "families" / f"{name}.md" for name in ["index", *ENVS]),
    *(ROOT / "docs" / "agents" / f"{name}.md" for name in ["index", *AGENTS]),
}


def identify(page: Path) -> str:
    return str(page.relative_to(ROOT))


def training(text: str) -> list[list[str]]:
    """Return the words behind each ``python -m mtjax.train`` in a page's shell blocks."""
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL)).replace("\\\n", " ")
    lines = [line.partition("python -m mtjax.train")[2] for line in blocks.splitlines() if "mtjax.train " in line]
    return [[word for word in shlex.split(line, comments=True) if word != "&"] for line in lines]


def commands(text: str) -> list[list[str]]:
    """Return those of a page's training commands that are whole."""
    not_here = ("--list", "--help", "--distributed", "--sweep")  # they do more than parse
    return [
        each
        for each in training(text)
        if not any(w in not_here or "..." in w or "$" in w or w.startswith(("--import", "--search")) for w in each)
    ]


@pytest.mark.parametrize("page", PAGES, ids=identify)
def test_links_lead_to_files(page):
    """Every relative link names a file of the repository, or a page that is made when the site is built."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    targets = [target.split("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    paths = [(page.parent / target).resolve() for target in targets if target and "://" not in target]
    assert [path for path in paths if not path.exists() and path not in MADE] == []


@pytest.mark.slow
def test_commands_of_the_documentation_parse():
    """Every whole training command in README and docs names what exists, and what is installed parses."""
    found = {tuple(each) for page in PAGES for each in commands(page.read_text())}
    assert len(found) >= 5
    for each in sorted(found):
        suites = {suite for suite in SUITES if any(word.startswith(f"--env={suite}:") for word in each)}
        if all(map(importlib.util.find_spec, suites)):  # a suite's name is that of its package
            parse(list(each))


def test_examples_in_the_pages_exist():
    """Files that pages include are files of the repository."""
    included = [name for page in DOCS for name in re.findall(r'--8<-- "([^"]+)"', page.read_text())]
    assert included and all((ROOT / name).is_file() for name in included)


def test_what_the_pages_document_exists():
    """Every name behind ``:::`` is found as the site's builder looks for it, and every public name has its place."""
    names = [name for page in DOCS for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)]
    assert set(mtjax._HOME) - {"AGENTS", "ENVS"} <= {name.rpartition(".")[2] for name in names} | {"preset"}
    for name in names:
        pkgutil.resolve_name(name)


def made_of(name):
    """Return a module that makes pages of the site."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def hooks():
    return made_of("hooks")


@pytest.fixture
def long_pages():
    return made_of("long_pages")


@needs("mkdocs")
def test_items_of_a_docstring_stay_whole(hooks):
    """An item of a list goes on in the next line, indented or not, until its sentence ends."""
    items = ["Size: two blocks of", "4096.", "Rate: it falls to", "    5e-5.", "``C51`` says more."]
    made = hooks.to_markdown("Learns.\n\nDiffers in:\n    " + "\n    ".join(items))
    joined = ["**Size**: two blocks of 4096.", "**Rate**: it falls to 5e-5.", "``C51`` says more."]
    assert made.splitlines()[4:] == [f"- {item}" for item in joined]


@needs("mkdocs")
def test_equation_below_a_sentence_is_code(hooks):
    """An indented equation is set apart, and an indented line that goes on with a label's text is not."""
    made = hooks.to_markdown("Learns.\n\nLayers compute\n    x <- W x\n\nStart: at rest, with\n    angle = 0.")
    assert made == "Learns.\n\nLayers compute\n\n```text\nx <- W x\n```\n\n**Start**: at rest, with angle = 0."


@needs("mkdocs")
def test_formula_inside_a_labelled_text(hooks):
    """It stands apart, and the text goes on below it."""
    made = hooks.to_markdown("Runs.\n\nReward: with the speed v,\n        r = v / 10\n    at all times.")
    assert made == "Runs.\n\n**Reward**: with the speed v,\n\n```text\nr = v / 10\n```\n\nat all times."


def seen(formula):
    """The elements and texts of a formula, without the brackets of its markup."""
    made = made_of("formulas").to_mathml(formula)
    return re.sub(r"</?(mrow|mstyle|math)[^>]*>| (stretchy|[lr]space)=\"[a-z0]+\"", "", made)


@pytest.mark.parametrize(
    ("formula", "made"),
    [
        ("x_(t+1)", "<msub><mi>x</mi><mi>t</mi><mo>+</mo><mn>1</mn></msub>"),
        ("L_pi_i", "<msub><mi>L</mi><msub><mi>π</mi><mi>i</mi></msub></msub>"),
        ("s'_t^2", "<msubsup><mi>s</mi><mo>\N{PRIME}</mo><mi>t</mi><mn>2</mn></msubsup>"),
        ("Qbar", "<mover><mi>Q</mi><mo>¯</mo></mover>"),
        ("sum_k w", '<munder><mo>∑</mo><mi>k</mi></munder><mspace width="0.25em"/><mi>w</mi>'),
        ("sqrt(x) <- 2 y", '<msqrt><mi>x</mi></msqrt><mo>←</mo><mn>2</mn><mspace width="0.25em"/><mi>y</mi>'),
        ("<a, b>", "<mo>⟨</mo><mi>a</mi><mo>,</mo><mi>b</mi><mo>⟩</mo>"),
        ("a < b", "<mi>a</mi><mo>&lt;</mo><mi>b</mi>"),
    ],
)
@needs("mkdocs")
def test_formulas_are_set(formula, made):
    assert seen(formula) == made


@needs("mkdocs")
def test_sentences_in_a_block_are_not_set():
    set_apart = made_of("formulas").on_page_markdown
    prose = "```text\nw = 1, the one expert that one gives for a task\n```"
    assert set_apart(prose) == prose
    assert "<math" in set_apart("```text\nL = (V(s) - y)^2 / 2   (loss of the critic)\n```")


@needs("mkdocs")
def test_pages_of_families_have_one_shape(hooks):
    """What is observed and done, the reward, the start and the end stand in each, behind a label."""
    for name, (cls, _) in ENVS.items():
        if cls.__module__.startswith("mtjax"):  # and not another test's own
            page = "\n\n".join(hooks.to_markdown(each.__doc__) for each in (cls, *hooks._described_bases(cls)))
            lacks = [x for x in ("Observation", "Action", "Reward", "Start", "Episode") if f"**{x}" not in page]
            assert not lacks, (name, lacks)


def check_commands(page, teacher):
    """Take all that a made page trains up to the check, with a run where the reader's own is meant."""
    whole = [[word.replace("runs/...", str(teacher)) for word in each] for each in training(page)]
    assert whole
    for each in whole:
        check(parse(each))


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    """A folder with the configuration of a run that can teach ten goals."""
    write_config(folder := tmp_path_factory.mktemp("teacher"), parse(["--env=point-mass-vary-goal"]))
    return folder


@needs("mkdocs")
@pytest.mark.parametrize("name", AGENTS)
def test_pages_of_agents_train_what_they_can_learn(hooks, teacher, name):
    """The family has the actions, pictures, sketches and teachers that the agent needs."""
    check_commands(hooks.agent_page(name), teacher)


@needs("mkdocs")
def test_pages_of_agents_link_their_papers(hooks):
    """The survey links the same ones."""
    survey = (ROOT / "docs" / "guide" / "survey.md").read_text()
    assert hooks.PAPERS.keys() <= AGENTS.keys()
    assert "Paper: [arXiv 2102.06177](https://arxiv.org/abs/2102.06177)." in hooks.agent_page("care")
    assert all(f"arxiv.org/abs/{hooks.PAPERS[name]})" in survey for name in ("care", "brc", "pcgrad", "distil", "rl2"))


@needs("mkdocs")
@pytest.mark.parametrize("name", ["bandit", "craft", "craft-sketched", "grid-navi", "hidden-bandit", "walker-walk"])
def test_pages_of_families_train_an_agent_that_acts_there(hooks, teacher, name):
    check_commands(hooks.family_page(name), teacher)


@pytest.mark.nightly
@needs("mkdocs")
def test_pages_of_all_families_train_an_agent_that_acts_there(hooks, teacher):
    for name, (cls, _) in ENVS.items():
        if cls.__module__.startswith("mtjax"):  # and not another test's own
            check_commands(hooks.family_page(name), teacher)


@needs("mkdocs")
def test_pages_of_families_name_their_reward(hooks):
    """A family that changes another one shows that one's text too, up to the reward and the observation."""
    for name in ("walker-run", "cartpole-swingup", "hopper-hop-backward"):
        page = hooks.family_page(name)
        assert "**Reward**: " in page and "**Observation (" in page


@needs("mkdocs")
def test_a_familys_page_has_one_reward_and_what_it_needs(hooks):
    """A formula of the class that it is made from is called general; Meta-World's scenes are installed first."""
    page = hooks.family_page("metaworld-push")
    assert page.count("**Reward**: ") == 1 and "**Reward in general**: Meta-World's second version" in page
    assert "```bash\npip install --no-deps metaworld==3.1.1\npython -m mtjax.train" in page
    assert "pip install" not in hooks.family_page("hopper-stand")


@needs("mkdocs")
def test_a_film_names_the_agent_that_plays(hooks):
    """By a command of its own, unless the page's first one trains it, or one alone does not do it."""
    shown = "python -m mtjax.train --env=walker-run --agent=brc    # as in the film, on a GPU\n"
    assert shown in hooks.family_page("walker-run")
    assert hooks._film_flags("dog-stand") == hooks._film_flags("metaworld-push") == []
    plays = "As [`{}`](../results/policies.md) plays."
    assert plays.format("mt10/brc") in hooks._picture("metaworld-push")
    assert plays.format("grid-navi/rl2") in hooks._picture("grid-navi")
    assert not any("plays." in hooks._picture(name) for name in ("metaworld-assembly", "walker-run"))


def test_a_first_sentence_is_whole():
    """It goes on behind names of authors, and ends before the next one, also one that begins with the library."""
    assert first_sentence("It follows Teh et al. 2017 here. It learns.") == "It follows Teh et al. 2017 here"
    assert first_sentence("It is new. mtjax has it.") == "It is new"
    assert first_sentence("See ``a.b`` and c. d here.\n\nMore.") == "See ``a.b`` and c. d here"


def test_every_extra_is_listed():
    listed = (ROOT / "docs" / "guide" / "install.md").read_text()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert [name for name in extras if not re.search(rf"^\| .*`{name}`.* \|", listed, re.M)] == []


def test_a_chosen_device_leads_to_where_devices_are_chosen():
    """Which is on the page that a newcomer reads; who meets an error is led there."""
    guide, variables = ROOT / "docs" / "guide", ("JAX_PLATFORMS=", "CUDA_VISIBLE_DEVICES=")
    section = (guide / "install.md").read_text().partition("\n## Which device\n")[2].partition("\n## ")[0]
    assert all(variable in section for variable in variables)
    assert "(install.md#which-device)" in (guide / "troubleshooting.md").read_text()


@needs("mkdocs")
def test_the_search_ranks_what_explains_before_tables(hooks):
    page = lambda place: SimpleNamespace(file=SimpleNamespace(src_uri=place), meta={})
    pages = {place: page(place) for place in ("how-to/search.md", "results/speed-2.md", "results/index.md")}
    for each in pages.values():
        hooks.on_page_markdown("", each)
    ranks = [each.meta.get("search") for each in pages.values()]
    assert ranks == [{"boost": 2}, {"boost": 0.5}, None]


@needs("mkdocs")
def test_flags_in_code_stay_in_one_line(hooks):
    """Inline and in blocks, where colours cut the code; what is copied stays the same, and so does other text."""
    block = (
        '<code>train<span class="w"> </span>--agent.burn-in<span class="o">=</span>4 a--b -- <a id="l-0--1"></a></code>'
    )
    page = f'<head></head>\n<p>Not --here, <code class="x">--env=hop\n--split</code></p>{block}<p>--nor</p>'
    made = hooks.on_post_page(page).partition("</head>")[2]
    assert re.findall('<span class="flag">(.*?)</span>', made) == ["--env", "--split", "--agent.burn-in"]
    assert re.sub('<span class="flag">(.*?)</span>', r"\1", made) == page.partition("</head>")[2]
    assert re.search(r"\.flag \{\s*white-space: nowrap;", (ROOT / "docs" / "wide.css").read_text())


@needs("mkdocs")
def test_parts_of_a_page_are_called_by_their_titles(long_pages):
    nav = [{"Results": [{"Speed": "results/speed.md"}, "results/index.md"]}]
    long_pages._nest(nav, "results/speed.md", {"results/speed-2.md": long_pages._first("## [Of](a.md) `sac`, late\n")})
    assert nav[0]["Results"][:2] == [{"Speed": "results/speed.md"}, {"Of sac, late": "results/speed-2.md"}]


@pytest.fixture(scope="module")
def formulas():
    return made_of("formulas")


def reward_told(hooks, cls):
    """The first class of a family's page whose text tells a reward, and what it tells."""
    texts = ((each, hooks.to_markdown(each.__doc__)) for each in (cls, *hooks._described_bases(cls)))
    return next((each, told[0]) for each, text in texts if (told := re.search(_REWARD, text)))


_REWARD = r"(?ms)^\*\*Reward\*\*: .*?(?=^\*\*|\Z)"


@needs("mkdocs")
def test_pages_of_families_have_their_reward_as_a_formula(hooks, formulas):
    """The formula is of the class that computes the reward, or of one that goes on from there."""
    lacking = []
    for name, (cls, _) in ENVS.items():
        if cls.__module__.startswith("mtjax"):
            teller, told = reward_told(hooks, cls)
            computes = next((each for each in cls.__mro__ if {"reward", "evaluate"} & vars(each).keys()), object)
            if not (issubclass(teller, computes) and "<math" in formulas.on_page_markdown(told)):
                lacking.append(name)
    assert lacking == []


def weight(page):
    """The bytes of a page with its pictures, styles and scripts."""
    text = page.read_text()
    found = re.findall(r'<(?:img|script)[^>]*src="([^":]+)"|<link rel="stylesheet" href="([^":]+)"', text)
    shown = {page.parent / (one or other).split("?")[0] for one, other in found}
    return page.stat().st_size + sum(file.stat().st_size for file in shown)


RESULTS = [page for page in DOCS if page.parent.name == "results"]


@needs("mkdocs")
@pytest.mark.parametrize("page", RESULTS, ids=identify)
def test_pages_of_results_are_cut_at_titles(page, long_pages):
    """Into at most six screens, without losing a line."""
    parts = long_pages.cut(page.read_text())
    assert "".join(parts) == page.read_text()
    assert all(long_pages.screens(part) <= long_pages.MOST for part in parts)
    assert page.name != "index.md" or len(parts) == 1  # the list of all stands whole
    assert all(part.startswith("##") for part in parts[1:])


@needs("mkdocs")
def test_links_lead_to_the_part_that_has_their_anchor(long_pages):
    """From any page; links elsewhere stay."""
    long_pages._HOMES["results/speed.md"] = {"first": "results/speed.md", "late": "results/speed-2.md"}
    links = "[a](../results/speed.md#late) [b](../results/speed.md#first) [c](other.md#late) [d](#late)"
    read = lambda place, text: long_pages.on_page_markdown(text, SimpleNamespace(file=SimpleNamespace(src_uri=place)))
    assert read("guide/agents.md", links) == links.replace("speed.md#late", "speed-2.md#late")
    inside = "[a](#late) [b](#first) [c](speed.md#first)"
    assert read("results/speed.md", inside) == "[a](speed-2.md#late) [b](#first) [c](#first)"
    assert read("results/speed-2.md", inside) == "[a](#late) [b](speed.md#first) [c](speed.md#first)"
    assert read("index.md", "[a](results/speed.md#late)") == "[a](results/speed-2.md#late)"


@needs("mkdocs")
def test_addresses_stand_in_one_file(hooks, monkeypatch):
    """They reach the pages where they belong; without them nothing is said there."""
    page = SimpleNamespace(file=SimpleNamespace(src_uri="citing.md"), meta={})
    assert set(hooks.addresses()) == {"repository", "site", "doi"}
    known = {"repository": "https://host/me/mtjax", "site": "", "doi": "https://doi.org/1"}
    monkeypatch.setattr(hooks, "addresses", lambda: known)
    read = hooks.on_page_markdown("git clone <this repository> && cd mtjax", page)
    assert read.startswith("git clone https://host/me/mtjax && cd mtjax") and "DOI: <https://doi.org/1>" in read
    monkeypatch.setattr(hooks, "addresses", lambda: dict.fromkeys(known, ""))
    assert hooks.on_page_markdown("git clone <this repository>", page) == "git clone <this repository>"


@needs("mkdocs")
def test_citation_and_package_have_the_same_addresses(hooks, monkeypatch, tmp_path):
    """What differs is told, line by line; a DOI stands in a citation without its host."""
    assert hooks.differences(hooks.addresses()) == []
    known = {"repository": "https://host/me/mtjax", "site": "", "doi": "https://doi.org/10.1/2"}
    (tmp_path / "CITATION.cff").write_text('title: "mtjax"\nrepository-code: "https://host/you/mtjax"\ndoi: 10.1/2\n')
    (tmp_path / "pyproject.toml").write_text('[project]\nurls = { Documentation = "https://me.host/mtjax/" }\n')
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    assert hooks.differences(known) == [
        "CITATION.cff: repository-code is 'https://host/you/mtjax', and addresses.toml has 'https://host/me/mtjax'",
        "pyproject.toml: Repository is '', and addresses.toml has 'https://host/me/mtjax'",
        "pyproject.toml: Documentation is 'https://me.host/mtjax/', and addresses.toml has ''",
    ]


@needs("mkdocs")
def test_raw_files_are_linked_where_a_page_names_them():
    """A file to its copy; a folder or a pattern to the list, whose titles have such anchors."""
    raw, anchors = made_of("raw_files"), made_of("long_pages").anchors
    read = lambda place, text: raw.on_page_markdown(text, SimpleNamespace(file=SimpleNamespace(src_uri=place)))
    name = "`benchmarks/results/h200-families.csv`"
    assert read("results/returns.md", name) == f"[{name}](raw/h200-families.csv)"
    assert read("guide/pixels.md", name) == f"[{name}](../results/raw/h200-families.csv)"
    for folder, anchor in (("h200-returns/", "h200-returns"), ("cpu-scaling-*.png", "single-files")):
        assert raw.place(folder) == f"index.md#{anchor}" and anchor in anchors(raw.listing())
    assert read("results/speed.md", "![a](../../benchmarks/results/a.png)") == "![a](raw/a.png)"
    assert not raw.copy_of("h200-returns/table.md").endswith(".md")


@pytest.mark.slow
@needs("mkdocs")
@needs("material")
@needs("mkdocstrings")
@needs("mkdocstrings_handlers")
def test_site_builds_without_a_broken_link(tmp_path):
    """Strict, so that a link or an anchor that leads nowhere is an error; with a page for every family and agent."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    say = "import json, mtjax; print(json.dumps([list(mtjax.ENVS), list(mtjax.AGENTS)]))"
    fresh = subprocess.run([sys.executable, "-c", say], cwd=ROOT, capture_output=True, text=True, check=True)
    for folder, names in zip(("families", "agents"), json.loads(fresh.stdout), strict=True):  # without other tests' own
        assert all((tmp_path / folder / name / "index.html").is_file() for name in names)
    listed = (tmp_path / "llms.txt").read_text()
    assert "# mtjax" in listed and "[Which agent](guide/which-agent/): Begin with one of three" in listed
    assert max(map(weight, tmp_path.rglob("index.html"))) < 600_000
    assert "1.65 times sac" in (tmp_path / "agents" / "care" / "index.html").read_text()
