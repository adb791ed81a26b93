"""What ``--help`` and ``--list`` print. This module needs no JAX."""

import textwrap
from collections.abc import Iterable, Mapping

from mtjax.agents import AGENTS
from mtjax.command.class_sources import documented_fields
from mtjax.envs import BENCHMARKS, ENVS, SUITES, outline, varied
from mtjax.saved import pretrained


def catalogue() -> str:
    """Return a list of families and agents, each with the first sentence of its documentation."""
    lines = ["environments, and what varies between their tasks (more by --env.vary.NAME=VALUES):"]
    for name in ENVS:
        tasks, says = outline(name)
        varies = varied(name)
        lines.append(f"  {name:36} {tasks:3} task{'s' if tasks > 1 else ' '}  {says}{f' [{varies}]' * bool(varies)}")
    lines.append("benchmarks, which are mixtures of the above:")
    for name, (says, families) in BENCHMARKS.items():
        lines.append(f"  {name:36} {sum('held_out' not in s for s in families.values()):3} tasks  {says}")
    others = ", ".join(f"{suite}:NAME" for suite in SUITES)
    lines.append(f"environments of other packages, by their names there, such as gymnasium:CartPole-v1: {others}")
    lines += ["agents:", *(f"  {name:36} {preset.says}" for name, preset in AGENTS.items())]
    lines += ["trained policies (python -m mtjax.evaluate --run=NAME, or mtjax.load(NAME)):"]
    return "\n".join(lines + [f"  {name}" for name in pretrained.names()])


def overview(program: str, ways: Mapping[str, str], groups: Iterable[tuple[str, str, str]]) -> str:
    """Return what a command's ``--help`` says: how to call it, and its flags.

    They are read from the classes' source, as JAX is not needed.

    Args:
        ways: what may follow the program's name, and what that does.
        groups: titles, and the files and names of the classes whose fields are flags.
    """
    width = max(map(len, ways))
    calls = [f"{program} {words:{width}}    {says}".rstrip() for words, says in ways.items()]
    lines = [f"usage: {calls[0]}", *(f"       {call}" for call in calls[1:])]
    for title, file, cls in groups:
        lines += ["", f"{title}:"]
        for flag, _, default, text in documented_fields(file, cls):
            lines.append(f"  --{flag + default}")
            lines += textwrap.wrap(text, 110, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)
