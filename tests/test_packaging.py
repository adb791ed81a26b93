"""What a user installs, and that the places which name a version agree."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import mtjax

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Where archive and wheel are built."""
    return tmp_path_factory.mktemp("dist")


@pytest.fixture(scope="module")
def built(place):
    """The names of the files in the source archive and in the wheel that is made from it."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--skip-dependency-check", "--outdir", place, ROOT]
    done = subprocess.run(command, capture_output=True, text=True, cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    (sdist,), (wheel,) = place.glob("*.tar.gz"), place.glob("*.whl")
    with tarfile.open(sdist) as archive:
        source = {member.name.split("/", 1)[1] for member in archive.getmembers() if member.isfile()}
    with zipfile.ZipFile(wheel) as archive:
        return source, set(archive.namelist()), archive.read(f"mtjax-{mtjax.__version__}.dist-info/METADATA").decode()


def package_files():
    kinds = (".py", ".xml", ".toml", ".npz", ".json", ".html")
    files = (path for path in (ROOT / "mtjax").rglob("*") if path.suffix in kinds)
    return {str(path.relative_to(ROOT)) for path in files}


@pytest.mark.slow
def test_wheel_holds_the_package_and_nothing_beside_it(built):
    """Code, models and presets; no folder called envs, agents, configs or tests is installed for all to import."""
    _, wheel, _ = built
    inside = {name for name in wheel if not name.startswith(f"mtjax-{mtjax.__version__}.dist-info/")}
    assert inside == package_files()
    assert any(name.endswith("models/finger.xml") for name in inside) and "mtjax/configs/default.toml" in inside


@pytest.mark.slow
def test_source_archive_holds_what_a_contributor_needs(built):
    """The package, tests, benchmarks and pins; nothing of the working folder's own."""
    source, _, _ = built
    tests = {f"tests/{path.name}" for path in (ROOT / "tests").glob("*.py")}
    assert package_files() | tests | {"pyproject.toml", "README.md", "LICENSE", "constraints.txt"} <= source
    tops = {"mtjax", "tests", "benchmarks", "docs", "examples", "notebooks"}
    assert {name.split("/")[0] for name in source if "/" in name} <= tops
    assert not [name for name in source if "__pycache__" in name]


@pytest.mark.slow
def test_the_wheel_works_by_itself(built, place, tmp_path):
    """Installed where nothing of the repository is: its command lists all, and a policy that came with it acts."""
    (wheel,) = place.glob("*.whl")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", tmp_path / "lib", wheel]
    subprocess.run(pip, check=True, cwd=tmp_path, timeout=300)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "lib"), "JAX_PLATFORMS": "cpu", "MTJAX_CACHE": "0"}

    def run(*words):
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "point-mass-vary-goal/sac-conditioned" in run(tmp_path / "lib" / "bin" / "mtjax-train", "--list")
    acts = """import jax, mtjax
policy = mtjax.load("point-mass-vary-goal/sac-conditioned")
task = jax.tree.map(lambda x: x[0], policy.env.tasks())
print(mtjax.__file__, policy(policy.env.reset(task, jax.random.key(0)).obs, task).shape)"""
    assert run(sys.executable, "-c", acts).split() == [str(tmp_path / "lib" / "mtjax" / "__init__.py"), "(2,)"]


@pytest.mark.slow
def test_wheel_says_its_version_and_commands(built):
    """The version is that of the package, which is read and not written twice."""
    _, wheel, metadata = built
    assert f"\nVersion: {mtjax.__version__}\n" in metadata
    assert f"mtjax-{mtjax.__version__}.dist-info/entry_points.txt" in wheel
    assert PROJECT["project"]["dynamic"] == ["version"]


@pytest.mark.parametrize("entry", PROJECT["project"]["scripts"].values())
def test_commands_point_to_functions(entry):
    """A function without arguments each."""
    module, name = entry.split(":")
    assert callable(getattr(import_module(module), name))


def test_citation_names_the_same_version():
    """One release, one number; so do the page that says how to cite, and the changelog's first title."""
    page, changes = ((ROOT / name).read_text() for name in ("docs/citing.md", "CHANGELOG.md"))
    assert f"version = {{{mtjax.__version__}}}" in page
    assert re.search(r"^## (\S+)", changes, re.M)[1] == mtjax.__version__
    assert re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)[1] == mtjax.__version__


@pytest.mark.parametrize("name", ["envs", "agents", "configs"])
def test_links_at_the_root_lead_into_the_package(name):
    """Relative, so that they work wherever the checkout is."""
    link = ROOT / name
    assert link.is_symlink() and str(link.readlink()) == f"mtjax/{name}"
    assert link.resolve() == ROOT / "mtjax" / name


def test_constraints_pin_names_and_versions_only():
    """An address would tie an installation to one machine."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line.strip() and not line.startswith("#")]
    assert pins and all(re.fullmatch(r"[A-Za-z0-9][\w.\-]*==\d[\w.+!]*( *;.*)?", pin) for pin in pins)
    assert not any("://" in line or " @ " in line for line in lines)


def test_constraints_pin_every_requirement():
    """What pyproject asks for, the pins answer."""
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    normal = lambda name: re.sub(r"[-_.]+", "-", name).lower()
    pinned = {normal(line.split("==")[0]) for line in pins if "==" in line}
    asked = {normal(re.match(r"[\w\-]+", text)[0]) for text in PROJECT["project"]["dependencies"]}
    assert asked <= pinned
