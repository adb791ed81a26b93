"""Who imports whom: read from the source, so that no import is missed and none has to run."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from mtjax import types
from mtjax.agents import AGENTS
from mtjax.envs import ENVS

PACKAGE = Path(__file__).parent.parent / "mtjax"
FILES = {
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for file in PACKAGE.rglob("*.py")
}


@cache
def trees() -> dict[str, ast.Module]:
    """Every module's syntax."""
    return {module: ast.parse(file.read_text()) for module, file in FILES.items()}


# From the ground up: a module imports its own layer and those below it. Within a layer only a group's own modules.
GROUND = (
    "types",
    "names",
    "checks",
    "progress",
    "tasks",
    "frames",
    "parallel",
)
LAYERS = (
    [GROUND],
    [("envs",), ("experience",), ("agents",)],
    [("learning",)],
    [("compiling",), ("config",)],
    [("saved",)],
    [("training",), ("report",)],
    [("command",), ("gym",)],
    [("train",), ("evaluate",), ("plot",), ("__main__",)],
)
BESIDE = {("agents", "experience")}  # the groups of one layer of which the first may import the second


def imported(module: str, node: ast.AST) -> list[str]:
    """The modules of the package that a statement imports, or that a string names for a later import."""
    match node:
        case ast.Import():
            names = [alias.name for alias in node.names]
        case ast.ImportFrom():
            assert not node.level, f"{module} imports relatively"
            whole = f"{node.module}"
            names = [f"{whole}.{alias.name}" if f"{whole}.{alias.name}" in FILES else whole for alias in node.names]
        case ast.Constant(value=str(text)):
            names = [text.split(":")[0]] if ":" in text else []  # "module:name", for ``load``
        case _:
            names = []
    return [name for name in names if name in FILES and name != module]


@cache
def edges() -> dict[str, set[str]]:
    """Every module and what it imports, at once or, where a registry names it by a string, when it is asked for."""
    found = {
        module: {name for node in ast.walk(tree) for name in imported(module, node)} for module, tree in trees().items()
    }
    places = [place for place, _ in ENVS.data.values() if isinstance(place, str)]
    found["mtjax.envs"] |= {place.split(":")[0] for place in places}
    found["mtjax.agents"] |= {preset.place.split(":")[0] for preset in AGENTS.values()}
    del found["mtjax"]  # whose table says where each public name is
    return {module: names - {"mtjax"} for module, names in found.items()}


def place_of(module: str) -> tuple[int, int]:
    """The layer of a module and its group in it: by the longest name that the table has."""
    name = module.removeprefix("mtjax.")
    known = {
        start: (i, j)
        for i, layer in enumerate(LAYERS)
        for j, group in enumerate(layer)
        for start in group
        if f"{name}.".startswith(f"{start}.")
    }
    assert known, f"{module} has no layer: give it one in LAYERS"
    return known[max(known, key=len)]


def test_imports_go_in_no_circle():
    """Nor do those that wait until a registry's entry is asked for."""
    assert len(list(TopologicalSorter(edges()).static_order())) == len(FILES) - 1


@pytest.mark.parametrize("module", FILES)
def test_no_function_imports_the_package(module):
    """Which is how circles are hidden."""
    functions = [node for node in ast.walk(trees()[module]) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    inside = [node for function in functions for node in ast.walk(function)]
    hidden = [
        name for node in inside if isinstance(node, ast.Import | ast.ImportFrom) for name in imported(module, node)
    ]
    assert not hidden


@pytest.mark.parametrize("module", [module for module in FILES if module != "mtjax"])
def test_a_module_imports_none_above_it(module):
    """And of its own layer none of another group, unless the two are named together."""
    layer, group = place_of(module)
    for name in edges()[module]:
        other, theirs = place_of(name)
        assert other <= layer, f"{module} imports {name}, which is above it"
        if other == layer and theirs != group:
            pair = LAYERS[layer][group][0], LAYERS[layer][theirs][0]
            assert pair in BESIDE, f"{module} imports {name}, which is beside it"


def test_folders_import_in_no_circle():
    """So each can be read once those below it are known. The root's files are rooms of their own."""
    room = lambda module: ".".join(module.split(".")[:2])
    graph: dict[str, set[str]] = {}
    for module, names in edges().items():
        graph.setdefault(room(module), set()).update({room(name) for name in names} - {room(module)})
    assert len(list(TopologicalSorter(graph).static_order())) == len(graph)


# Classes of environments that have more, and are to become smaller.
LARGE = {"Sawyer": 19, "Warp": 27, "Sketched": 22}


@pytest.mark.parametrize("group", ["agents", "envs", "experience", "types"])
def test_a_class_fits_in_the_head(group):
    """With properties it has at most 15 methods of its own. Those that are listed as larger have no more than that."""
    of_group = [tree for module, tree in trees().items() if f"{module}.".startswith(f"mtjax.{group}.")]
    classes = [node for tree in of_group for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    methods = {cls.name: sum(isinstance(node, ast.FunctionDef) for node in cls.body) for cls in classes}
    assert methods
    assert {name: count for name, count in methods.items() if count > 15} == (LARGE if group == "envs" else {})


Class = tuple[str, str]  # a module and a class in it


@cache
def extended() -> dict[Class, list[Class]]:
    """Every class of the package and the classes of the package that it extends."""
    found = {}
    for module, tree in trees().items():
        for cls in (node for node in tree.body if isinstance(node, ast.ClassDef)):
            bases = [defined(module, ast.unparse(base).split("[")[0]) for base in cls.bases]
            found[module, cls.name] = [base for base in bases if base]
    return found


@cache
def defined(module: str, name: str) -> Class | None:
    """Where the class is defined that a module calls by a name; None outside the package."""
    first, _, rest = name.partition(".")
    for node in trees()[module].body:
        match node:
            case ast.ClassDef() if node.name == name:
                return module, name
            case ast.Assign(targets=[ast.Name(id=alias)], value=ast.Name()) if alias == name:
                return defined(module, node.value.id)
            case ast.ImportFrom():
                for alias in node.names:
                    place = f"{node.module}.{alias.name}"
                    if (alias.asname or alias.name) == first and (place in FILES or node.module in FILES):
                        return defined(place, rest) if place in FILES else defined(f"{node.module}", alias.name)
    return None


def chain(cls: Class) -> list[Class]:
    """A class and the longest line of classes above it."""
    return [cls, *max((chain(base) for base in extended()[cls]), key=len, default=[])]


LEVELS = {"agents.parts": 2, "agents": 3, "experience": 2, "learning": 2, "envs": 4}
"""How many classes a line has at most, from one to the root of those that it extends, by what the modules are in."""
EXTENDED = {"Encoded", "Remembering", "C51"}
"""Parts that are chosen by name or are for own ones to extend, so that their line may have a third class."""


def test_a_class_is_read_with_few_others():
    """What siblings have in common are values and functions, as a reader has to know all that a class extends."""
    deep = []
    for cls in extended():
        most = next((n for group, n in LEVELS.items() if f"{cls[0]}.".startswith(f"mtjax.{group}.")), 3)
        line = [name for _, name in chain(cls)]
        deep += [" < ".join(line)] * (len(line) > most + (len(line) == 3 and line[1] in EXTENDED))
    assert extended() and not deep


# The protocols: what is read of agents, environments and experiences, by the names that these have.
READ = {
    types.Env: ("env", "self.config.family", "config.family"),
    types.Agent: ("agent", "self.agent", "at_point(agent, learner)", "with_numbers(agent, numbers)"),
    types.Experience: ("experience", "self.experience", "agent.experience", "self.agent.experience"),
}
_RUN = ("training.run", "training.journal", "training.memory", "training.host_replay")
READERS = ("learning", "compiling", "parallel.axes", "saved.folder", *_RUN)
KNOWN = {  # where it is known which class it is
    types.Env: {"calls", "parts", "relabels", "varied", "fresh_goals", "observe_worlds", "returning", "distance"},
    types.Agent: {
        "adapt",
        "conditioning",
        "encoder",
        "gradients",
        "heads",
        "policies",
        "policy",
        "representation",
        "view",
    },
    types.Experience: {"capacity", "hindsight", "n_step"},
}


@pytest.mark.parametrize("protocol", READ, ids=lambda protocol: protocol.__name__)
def test_a_protocol_is_what_is_called(protocol):
    """No more, and no less: whatever else is read of one is of a class that is asked for before."""
    members = {name for name in {*vars(protocol), *protocol.__annotations__} if not name.startswith("_")}
    modules = [module for module in FILES if module.removeprefix("mtjax.").startswith(READERS)]
    nodes = [node for module in modules for node in ast.walk(trees()[module])]
    of_one = [x for x in nodes if isinstance(x, ast.Attribute) and ast.unparse(x.value) in READ[protocol]]
    assert {node.attr for node in of_one} == members | KNOWN[protocol]
    asked = [x.args[0] for x in nodes if isinstance(x, ast.Call) and ast.unparse(x.func) == "getattr"]
    assert protocol is types.Experience or not {*map(ast.unparse, asked)} & {*READ[protocol]}


@pytest.mark.parametrize("module", ["mtjax.command.keywords", "mtjax.command.run_config"])
def test_a_configuration_is_made_without_what_trains(module):
    """It is a value: from keywords or from a command line, neither training nor reports are needed to make it."""
    seen, ahead = set(), [module]
    while ahead:
        name = ahead.pop()
        seen.add(name)
        ahead += edges().get(name, set()) - seen
    assert not [name for name in seen if name.startswith(("mtjax.training", "mtjax.report"))]
