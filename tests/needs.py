"""Packages that some tests need beside those that every user of mtjax has.

A test says so with ``@needs("warp")``, and a file that imports such a package with ``require("warp")``. Where it is not
installed the test is skipped, and the end of the run tells how many tests were, and for want of what.
"""

import re
from collections import Counter
from importlib.util import find_spec

import pytest

_REASON = "needs "  # and the package's name


def needs(package):
    """Mark a test that needs a package, by the name that is imported."""
    return pytest.mark.needs(package=package)


def require(module):
    """Import a module of such a package for a whole file, or skip the file."""
    return pytest.importorskip(module, reason=_REASON + module.partition(".")[0])


def skip_without_packages(item):
    """Skip a test whose packages are not installed."""
    missing = [mark.kwargs["package"] for mark in item.iter_markers("needs") if not find_spec(mark.kwargs["package"])]
    if missing:
        pytest.skip(_REASON + " and ".join(sorted(missing)))


def count_skips(terminal):
    """Tell how many tests, and files of them, were skipped for want of each package."""
    skips = {(report.nodeid, report.longrepr[2]) for report in terminal.stats.get("skipped", ())}  # once, not by worker
    found = Counter()
    for name, reason in skips:
        lacking = re.fullmatch(f"(?:Skipped: )?{_REASON}(.+)", reason)
        if lacking:
            found[lacking[1], "test" if "::" in name else "file"] += 1
    for (packages, what), count in sorted(found.items()):
        terminal.write_line(f"{count} {what}{'s' if count > 1 else ''} skipped: needs {packages}")
