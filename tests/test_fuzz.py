"""Command lines and records that nobody would write: each is used as it says, or refused in a line."""

import contextlib
import copy
import dataclasses
import datetime
import json
import math
import string

import pytest
from conftest import SHORT_RUN
from needs import require

st = require("hypothesis.strategies")
from hypothesis import HealthCheck, given, settings

from mtjax.agents import AGENTS
from mtjax.agents import settings as settings_of
from mtjax.command import flag_files, process, refusals, run_config, sweep
from mtjax.names import InputError
from mtjax.saved.config_json import from_json, run_metadata, to_json
from mtjax.saved.folder import record_steps
from mtjax.training import launch

QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
quick = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=QUIET)
long = settings(quick, max_examples=150)
other = settings(max_examples=1000, deadline=None, suppress_health_check=QUIET)

NUMBERS = "0 1 2 3 7 -1 0.5 -0.5 1e-8 1e-300 1e30 1e39 1e308 nan inf -inf 2147483647 2147483648 99999999999 1e6".split()
VALUES = [*NUMBERS, "9" * 25, "9" * 5000, "", "=", "²", "٣", "true", "None", "[]", "a,b", "1,1", "../..", "\0", "--"]
RANGES = (
    "1:1:1 1:2:1000000000 2:1:3 1:2:0 1:2:-1 1:2:2.5 1:2 1:inf nan:1 1e308:1e309:3 :: 1:2:3:4 0.9:1.1:3 1,2,3".split()
)
ELSEWHERE = ("--runs", "--resume", "--from", "--list", "--sweep", "--config", "--quick")  # read before a run's flags
FLAGS = [flag for flag in run_config.flags(run_config.parse([])) if flag not in ELSEWHERE]
FAMILIES = "finger-spin walker-walk bandit two-goal-maze control-cartpole point-mass-vary-goal".split()
PARAMETERS = "size mass gravity torso-mass gear touch-size friction goal-x nonsense".split()

value = st.sampled_from(VALUES) | st.floats().map(str) | st.integers().map(str) | st.text(string.printable, max_size=6)
setting = st.tuples(st.sampled_from(FLAGS), value).map("=".join)
switch = st.sampled_from(FLAGS).map(lambda flag: "no-".join(flag.rpartition("--" if "." not in flag else ".")[1:]))
varied = st.tuples(st.sampled_from(PARAMETERS), st.sampled_from([*RANGES, *VALUES])).map(
    "--env.vary.{0[0]}={0[1]}".format
)
named = st.sampled_from(FAMILIES).map("--env={}".format) | st.sampled_from([*AGENTS]).map("--agent={}".format)
lines = st.lists(setting | varied | named | switch | value, min_size=1, max_size=4)


def require_use_or_refusal(words, folder):
    """What a command line or record says is refused in one line, or holds finite numbers and is recorded."""
    try:
        refusals.check_names(words)
        refusals.check_flags(words)
        config = run_config.parse(words)
        launch.check(config)
    except InputError as error:
        assert process.one_line(error)
        return
    assert config.plan.seed >= 0 and config.plan.seed + config.plan.seeds <= 2**31
    found = {**dataclasses.asdict(config.plan), **dataclasses.asdict(config.training), **settings_of(config.learner)}
    numbers = [x for x in found.values() if isinstance(x, int | float)]
    assert all(math.isfinite(x) for x in numbers) and config.family.train_count <= 10_000
    (folder / "config.json").write_text(to_json(config, {}))
    assert from_json(folder / "config.json") == config


@pytest.mark.nightly
@long
@given(words=lines)
def test_any_command_line_is_used_or_refused(words, tmp_path):
    """Before anything compiles."""
    require_use_or_refusal(words, tmp_path)


@pytest.mark.nightly
@other
@given(words=lines)
def test_other_command_lines_are_used_or_refused(words, tmp_path):
    """Others each time."""
    require_use_or_refusal(words, tmp_path)


KEYS = sorted({key for flag in FLAGS for key in (flag.lstrip("-"), *flag.lstrip("-").split("."))})
key = st.sampled_from([*KEYS, "vary", "size", "import", "resume", "config", ""])
leaf = st.sampled_from([*VALUES, *RANGES, *FAMILIES]) | st.integers() | st.floats() | st.booleans() | st.datetimes()
tables = st.recursive(st.dictionaries(key, leaf, max_size=3), lambda x: st.dictionaries(key, leaf | st.lists(leaf) | x))


def as_toml(value):
    """A value as TOML, tables inline."""
    match value:
        case dict():
            return "{" + ", ".join(f"{json.dumps(key)} = {as_toml(each)}" for key, each in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(as_toml, value)) + "]"
        case str() | bool():
            return json.dumps(value)
        case datetime.datetime():
            return value.isoformat()
    return repr(value)


@pytest.mark.slow
@long
@given(table=tables)
def test_any_toml_file_is_used_or_refused(table, tmp_path):
    """Whatever tables it holds."""
    file = tmp_path / "flags.toml"
    file.write_text("".join(f"{json.dumps(key)} = {as_toml(each)}\n" for key, each in table.items()))
    try:
        words = flag_files.expand([f"--config={file}"])
    except InputError as error:
        assert process.one_line(error)
        return
    require_use_or_refusal(words, tmp_path)


@pytest.mark.slow
@long
@given(text=st.binary(max_size=40) | st.text(string.printable, max_size=40).map(str.encode))
def test_any_text_as_toml_is_used_or_refused(text, tmp_path):
    """However little it is TOML."""
    file = tmp_path / "flags.toml"
    file.write_bytes(text)
    with contextlib.suppress(InputError):
        flag_files.expand([f"--config={file}"])


@quick
@given(words=st.lists(st.tuples(st.sampled_from(FLAGS), st.lists(value, max_size=3)), max_size=2))
def test_any_sweep_is_used_or_refused(words):
    """Axes and their values."""
    axes = [f"{flag.removeprefix('--')}={','.join(values)}" for flag, values in words]
    try:
        sweep.configurations(["--sweep", *axes])
    except InputError as error:
        assert process.one_line(error)


def places(node, path=()):
    """Every place in a record: the keys that lead there."""
    yield path
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, each in inner:
        yield from places(each, (*path, key))


def edited(record, path, new):
    """A record with another value at a place, or without the place."""
    if not path:
        return new
    record = copy.deepcopy(record)
    node = record
    for key in path[:-1]:
        node = node[key]
    if new is dataclasses.MISSING:
        del node[path[-1]]
    else:
        node[path[-1]] = new
    return record


JUNK = [dataclasses.MISSING, None, True, [], {}, "", "x", "²", -1, 0, 0.5, 2**31, 10**25, 1e308, -1e-9, [[]], {"a": 1}]
JUNK += [float("nan"), float("inf"), ["1", "2"], [1, 2.5], "1:2:1000000000", "../..", "finger-spin+walker-walk"]


@pytest.fixture(scope="module")
def record(short_family):
    config = run_config.parse(SHORT_RUN)
    return json.loads(to_json(config, run_metadata(config)))


def require_read_or_refused(record, folder):
    file = folder / "config.json"
    file.write_text(record if isinstance(record, str) else json.dumps(record))
    try:
        config = from_json(file)
        launch.check(config)
        record_steps(file, 5)
        assert from_json(file).plan.steps == 5
    except InputError as error:
        assert process.one_line(error)


@pytest.mark.nightly
def test_any_edited_record_is_read_or_refused(record, tmp_path):
    """Every place with some other value, and every place without any."""
    for number, path in enumerate(places(record)):
        for new in (dataclasses.MISSING, JUNK[number % len(JUNK)]) if path else (None, [], "x", 3):
            require_read_or_refused(edited(record, path, new), tmp_path)


@pytest.mark.nightly
def test_every_edited_record_is_read_or_refused(record, tmp_path):
    """Every place with every other value."""
    for path in places(record):
        for new in JUNK if path else JUNK[1:]:
            require_read_or_refused(edited(record, path, new), tmp_path)


TEXTS = {"lists": "[" * 100_000, "tables": '{"env":' * 100_000, "empty": "", "zeros": "\0" * 99, "number": "9" * 5000}
TEXTS |= {"half a character": '"\\ud800"', "no number": "NaN", "text": "text"}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_texts_that_are_no_record_are_refused(text, tmp_path):
    """However deep or long."""
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(InputError, match="does not describe a run") as caught:
        from_json(tmp_path / "config.json")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
