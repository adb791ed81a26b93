"""Families of tasks: what differs between them, how they are split, and what is refused."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest
from needs import needs

from mtjax import envs
from mtjax.envs import parameters
from mtjax.envs.compiled import stack_differing
from mtjax.envs.engines.base import mjx_module
from mtjax.tasks import episode_task
from mtjax.types import SPLITS, InputError

SIZES = np.linspace(0.95, 1.4, 10)
UNREAD = ".stat"  # statistics for viewers, which no step reads


@pytest.fixture(scope="module")
def sizes():
    return envs.make("finger-spin", {"size": "0.95:1.4:10"})


@pytest.fixture(scope="module")
def touch_sizes():
    return envs.make("finger-spin-vary-touch-size")


def values_of(env, split):
    return np.asarray(env.tasks(split).params[env.varied[0]])


def test_registered_sizes_are_those_that_agents_master():
    """The family as registered: ten sizes of the range that benchmarks/RESULTS.md shows to be solved."""
    np.testing.assert_allclose(
        values_of(envs.make("finger-spin-vary-size"), "train"), np.linspace(0.95, 1.13, 10), rtol=1e-6
    )


def test_dense_split_trains_on_all_and_tests_between_and_beyond(sizes):
    """Ten sizes train; nine midpoints and two steps beyond each end are held out; ids count through the table."""
    np.testing.assert_allclose(values_of(sizes, "train"), SIZES, rtol=1e-6)
    np.testing.assert_allclose(values_of(sizes, "interpolation"), SIZES[:-1] + 0.025, rtol=1e-6)
    np.testing.assert_allclose(values_of(sizes, "extrapolation"), [0.85, 0.9, 1.45, 1.5], rtol=1e-6)
    ids = [np.asarray(sizes.tasks(split).id) for split in SPLITS]
    np.testing.assert_array_equal(np.concatenate(ids), np.arange(23))
    np.testing.assert_array_equal(sizes.tasks("all").id, np.arange(23))
    assert [len(x) for x in ids] == [10, 9, 4] and ids[0].dtype == np.int32


def test_dense_steps_that_leave_the_range_are_dropped(touch_sizes):
    """A sensor of size 0 or less is no task, so that only two extrapolation tasks of the touch sizes remain."""
    np.testing.assert_allclose(values_of(touch_sizes, "extrapolation"), [0.275, 0.3], rtol=1e-6)
    assert len(values_of(touch_sizes, "interpolation")) == 9


def test_dense_steps_take_each_ends_own_spacing():
    """Uneven values extrapolate by the gap at that end."""
    env = envs.make("finger-spin", {"size": [0.9, 1.0, 1.3]})
    np.testing.assert_allclose(values_of(env, "interpolation"), [0.95, 1.15], rtol=1e-6)
    np.testing.assert_allclose(values_of(env, "extrapolation"), [0.7, 0.8, 1.6, 1.9], rtol=1e-6)


def test_hip_bmdp_split_follows_mtrl():
    """Of ten values: train 3, 4, 7, 8; interpolation 5, 6; extrapolation 2, 9, as MTRL's configuration counts them."""
    env = envs.make("finger-spin", {"size": "0.95:1.4:10"}, split="hip-bmdp")
    splits = (("train", [3, 4, 7, 8], range(4)), ("interpolation", [5, 6], (4, 5)), ("extrapolation", [2, 9], (6, 7)))
    for split, indices, ids in splits:
        np.testing.assert_allclose(values_of(env, split), SIZES[indices], rtol=1e-6)
        np.testing.assert_array_equal(env.tasks(split).id, list(ids))
    np.testing.assert_allclose(env.tasks().context[[0, -1], 0], [-1, 1], atol=1e-6)
    np.testing.assert_allclose(env.tasks("extrapolation").context[:, 0], [-1.4, 1.4], atol=1e-5)


def test_a_single_task_holds_nothing_out():
    """One value has no neighbours: both held-out splits are empty, and its context is 0."""
    env = envs.make("finger-spin")
    assert len(env.tasks().id) == 1 and env.tasks().context.tolist() == [[0.0]]
    assert len(env.tasks("interpolation").id) == len(env.tasks("extrapolation").id) == 0


def test_contexts_show_an_angle_as_a_point():
    """Angles beyond the training range are close to it on the circle; other parameters are scaled as ever."""
    env = envs.make("reacher-vary-goal", {"target-angle": "-2,0,2", "damping": "1,2"})
    tasks = env.tasks()
    angle = np.asarray(tasks.params["target-angle"])
    damping, sine, cosine = (np.asarray(tasks.context[:, i]) for i in (2, 0, 1))
    np.testing.assert_allclose(sine, np.sin(angle), atol=1e-6)
    np.testing.assert_allclose(cosine, np.cos(angle), atol=1e-6)
    assert sorted(set(damping.tolist())) == [-1.0, 1.0]
    assert env.spec.context_size == 3


def test_context_is_scaled_by_the_training_range(sizes):
    """Training tasks fill [-1, 1] evenly, midpoints lie between, and extrapolation lies outside."""
    np.testing.assert_allclose(sizes.tasks().context[:, 0], np.linspace(-1, 1, 10), atol=1e-6)
    np.testing.assert_allclose(sizes.tasks("interpolation").context[:, 0], np.linspace(-8 / 9, 8 / 9, 9), atol=1e-6)
    assert np.all(np.abs(sizes.tasks("extrapolation").context) > 1.1)


def test_rows_of_the_table_name_their_own_models(sizes):
    """Every row's values, stacked leaves and compiled model belong to one task, in every split."""
    table = sizes.table
    for row, model in enumerate(sizes.models):
        size = float(table.tasks.params["size"][row])
        np.testing.assert_allclose(model.body("distal").pos[2], -0.18 * size, rtol=1e-6)
        np.testing.assert_allclose(table.tasks.model["geom_size"][row], model.geom_size, rtol=1e-6)


def test_size_scales_every_length_of_the_finger_and_nothing_else(sizes):
    """Radii, lengths, mounting points and the distal body go with size; the spinner, its tip and the base stay."""
    nominal = sizes.models[1]
    finger = [nominal.geom(n).id for n in ("proximal_decoration", "proximal", "distal", "fingertip")]
    links = [nominal.body(n).id for n in ("proximal", "distal")]
    touch = [nominal.site(n).id for n in ("touchtop", "touchbottom")]
    scaled = {"geom_size": finger, "geom_pos": finger, "site_pos": touch, "body_pos": links[1:], "body_ipos": links}
    fixed = ("site_size", "dof_damping", "dof_frictionloss", "dof_armature", "actuator_gear", "jnt_range", "jnt_pos")
    for size, model in zip(SIZES, sizes.models, strict=False):
        for field, ids in scaled.items():
            expected = getattr(nominal, field).copy()
            expected[ids] *= size
            np.testing.assert_allclose(getattr(model, field), expected, rtol=1e-9, atol=1e-12, err_msg=field)
        for field in fixed:
            np.testing.assert_array_equal(getattr(model, field), getattr(nominal, field), err_msg=field)


def test_mass_goes_with_the_cube_of_size_and_inertia_with_the_fifth_power(sizes):
    """Density is kept, so that both follow from geometry, for both links; the spinner keeps its own."""
    nominal = sizes.models[1]
    for size, model in zip(SIZES, sizes.models, strict=False):
        for body in ("proximal", "distal"):
            np.testing.assert_allclose(model.body(body).mass, nominal.body(body).mass * size**3, rtol=1e-9)
            np.testing.assert_allclose(model.body(body).inertia, nominal.body(body).inertia * size**5, rtol=1e-9)
        np.testing.assert_array_equal(model.body("spinner").mass, nominal.body("spinner").mass)
        np.testing.assert_array_equal(model.body("spinner").inertia, nominal.body("spinner").inertia)
    ratio = sizes.models[9].body_mass[1] / nominal.body_mass[1]
    assert ratio == pytest.approx(1.4**3)


def leaves_by_name(model):
    paths, _ = jax.tree_util.tree_flatten_with_path(model)
    named = {jax.tree_util.keystr(path): leaf for path, leaf in paths}
    return {name: leaf for name, leaf in named.items() if not name.startswith(UNREAD)}


@pytest.mark.parametrize("name", ["finger-spin-vary-size", "finger-spin-vary-touch-size"])
def test_stacked_leaves_turn_the_first_model_into_every_other(name):
    """MJX of the first model with a task's leaves put in equals MJX of that task's own model, leaf for leaf."""
    env, mjx = envs.make(name), mjx_module()
    table, base = env.table, mjx.put_model(env.models[0], impl="jax")
    for row, model in enumerate(env.models):
        leaves = {k: v[row] for k, v in table.tasks.model.items() if k != "site_size"}
        ours, own = leaves_by_name(base.tree_replace(leaves)), leaves_by_name(mjx.put_model(model, impl="jax"))
        assert ours.keys() == own.keys() and len(own) > 100
        assert [k for k in own if not np.array_equal(ours[k], own[k])] == []
        if "site_size" in table.tasks.model:
            np.testing.assert_array_equal(table.tasks.model["site_size"][row], np.float32(model.site_size))


def test_only_what_differs_is_stacked(sizes, touch_sizes):
    """Touch sizes differ in the sensors' sites alone; sizes in geometry and mass, and not in any motor's strength."""
    assert set(touch_sizes.table.tasks.model) == {"site_size"}
    sites = touch_sizes.table.tasks.model["site_size"]
    np.testing.assert_allclose(sites[:10, :2, 0], np.linspace(0.025, 0.25, 10)[:, None].repeat(2, axis=1), rtol=1e-6)
    assert np.ptp(sites[:, 2], axis=0).max() == 0 and np.ptp(sites[:, :, 1:], axis=0).max() == 0
    stacked = set(sizes.table.tasks.model)
    assert {"geom_size", "geom_pos", "body_mass", "body_inertia", "body_pos", "site_pos", "body_invweight0"} <= stacked
    assert not stacked & {"site_size", "actuator_gear", "dof_damping", "geom_friction"}


def compiled(edit):
    """The nominal model, and one with an edit."""
    spec = envs.make("finger-spin").compile_spec()
    first = spec.compile()
    edit(spec)
    return first, spec.compile()


def test_a_static_field_that_differs_is_refused_by_name_and_task():
    """One program holds one collision table: the error names the field, and the first task that changes it."""

    def collide(spec):
        spec.geom("distal").contype = 1

    first, second = compiled(collide)
    with pytest.raises(InputError, match=r"task 2 changes geom_contype\b"):
        stack_differing([first, first, second])


def test_static_options_and_counts_that_differ_are_refused():
    """The solver's settings and the number of geoms shape the program too."""
    first, second = compiled(lambda spec: setattr(spec.option, "cone", mujoco.mjtCone.mjCONE_PYRAMIDAL))
    with pytest.raises(InputError, match=r"task 1 changes opt\.cone\b"):
        stack_differing([first, second])
    first, second = compiled(lambda spec: spec.delete(spec.geom("spinner_decoration")))
    with pytest.raises(InputError, match="task 1 changes n"):
        stack_differing([first, second])


def test_options_that_are_arrays_stack():
    """Gravity is data to MJX, under the owner's name."""
    first, second = compiled(lambda spec: setattr(spec.option, "gravity", [0, 0, -1]))
    np.testing.assert_array_equal(stack_differing([first, second])["opt.gravity"][:, 2], [-9.81, -1])


def test_friction_of_zero_never_reaches_mjx():
    """Beside a task with friction a task without gets a trace of it; joints no task rubs keep their exact 0."""

    def loosen(spec):
        spec.joint("hinge").frictionloss = 0

    first, second = compiled(loosen)
    np.testing.assert_array_equal(stack_differing([first, second])["dof_frictionloss"], [[0, 0, 0.1], [0, 0, 1e-8]])
    assert "dof_frictionloss" not in stack_differing([second, second])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("finger-spn", {}, "unknown environment 'finger-spn'; did you mean 'finger-spin'"),
        ("finger-spin", {"engin": "c"}, "unknown setting of finger-spin 'engin'; did you mean 'engine'"),
        ("finger-spin", {"vary": {"sise": "1"}}, "unknown parameter 'sise'; did you mean 'size'"),
        ("finger-spin", {"split": "sparse"}, "unknown split 'sparse'; choose from: dense, hip-bmdp, none"),
        ("finger-spin", {"combine": "pair"}, "unknown combine 'pair'; did you mean 'paired'"),
        pytest.param("metaworld-reach", {"split": "sparse"}, "unknown split 'sparse'", marks=needs("metaworld")),
        ("finger-spin", {"engine": "cc"}, "unknown engine 'cc'"),
        ("finger-spin", {"vary": {"size": [1.0, 0.9, 1.1]}}, "must increase"),
        ("finger-spin", {"vary": {"size": [1.0, 1.0]}}, "must increase"),
        ("finger-spin", {"vary": {"size": [0.0, 1.0]}}, "size must be greater than 0, not 0"),
        ("finger-spin", {"vary": {"size": [1.0, np.inf]}}, "size must be"),
        ("finger-spin", {"vary": {"size": "1:x:3"}}, "cannot read the values '1:x:3' of size; give lo:hi:n"),
        ("finger-spin", {"vary": {"size": "1.2:1:3"}}, "the range of size must go from low to high, not 1.2:1:3"),
        ("finger-spin", {"vary": {"size": "1:1.2:0"}}, "asks for 0 values of size"),
        (
            "finger-spin",
            {"vary": {"size": [1.0, 1.2]}, "split": "hip-bmdp"},
            "numbers ten tasks, and this family has 2",
        ),
        ("finger-spin-vary-size", {"vary": {"size": "1:1.1:9"}, "split": "hip-bmdp"}, "this family has 9"),
        ("finger-spin", {"num_tasks": 0}, "num-tasks and num-draws must be at least 1"),
        ("finger-spin", {"solver_iterations": -1}, "solver-iterations must be at least 0"),
    ],
)
def test_wrong_settings_are_refused(name, settings, message):
    """The error says what was given and what is allowed, before anything is compiled."""
    with pytest.raises(InputError, match=message):
        envs.make(name, **settings)


def test_an_unknown_split_of_tasks_is_refused(sizes):
    """``tasks`` lists the splits it knows."""
    with pytest.raises(InputError, match="unknown split 'test'; choose from train, interpolation, extrapolation, all"):
        sizes.tasks("test")


def test_given_values_replace_the_familys_own():
    """A family trains on the values it is given; one value fixes a parameter."""
    env = envs.make("finger-spin-vary-size", {"size": (0.9, 1.1)})
    np.testing.assert_allclose(values_of(env, "train"), [0.9, 1.1], rtol=1e-6)
    fixed = envs.make("finger-spin-vary-size", {"size": 1.1, "touch-size": "0.02:0.04:3"})
    assert fixed.varied == ("touch-size",) and fixed.describe(1) == "touch-size=0.03"
    np.testing.assert_allclose(fixed.tasks().params["size"], 1.1)


@pytest.mark.slow
def test_what_episodes_draw_is_told_as_a_range():
    """And has no value in tables; tasks that are held out have one."""
    env = envs.make("finger-spin", {"size": "0.9:1.1", "touch-size": "0.1,0.2"})
    assert env.describe(1) == "size=0.9:1.1,touch-size=0.2"
    assert np.isnan(env.params("train")["size"]).all() and not np.isnan(env.params("train")["touch-size"]).any()
    row = int(env.table.rows["extrapolation"][0])
    assert "size=0" in env.describe(row) and ":" not in env.describe(row)
    assert not np.isnan(env.params("extrapolation")["size"]).any()


def test_a_continuous_range_gives_every_episode_a_task_of_its_own():
    """Draws fill the range without gaps, each with its own model and context, under the identity of their task."""
    env = envs.make("finger-spin", {"size": "0.95:1.15", "touch-size": [0.03, 0.05]}, num_draws=20)
    tasks = env.tasks()
    assert tasks.draws.params["size"].shape == (2, 20) and tasks.draws.context.shape == (2, 20, 2)
    parts = np.sort((np.asarray(tasks.draws.params["size"]) - 0.95) / 0.2 * 20, axis=1)
    np.testing.assert_array_equal(np.floor(parts), np.tile(np.arange(20), (2, 1)))
    drawn = jax.vmap(episode_task, (None, 0))(
        jax.tree.map(lambda x: x[1], tasks), jax.random.split(jax.random.key(0), 200)
    )
    assert set(np.asarray(drawn.id)) == {1} and len(set(np.asarray(drawn.row))) == 20
    np.testing.assert_allclose(drawn.params["touch-size"], 0.05)
    np.testing.assert_allclose(drawn.context[:, 0], (drawn.params["size"] - 1.05) / 0.1, atol=1e-5)
    for i in range(3):
        np.testing.assert_allclose(drawn.model["geom_size"][i], env.models[int(drawn.row[i])].geom_size, rtol=1e-6)


def test_held_out_tasks_of_a_continuous_range_stay_what_they_are():
    """Inside it five values, beyond each end one and two tenths; their draws are copies."""
    env = envs.make("finger-spin", {"size": "0.9:1.2"}, num_draws=3)
    np.testing.assert_allclose(values_of(env, "interpolation"), [0.95, 1.0, 1.05, 1.1, 1.15], rtol=1e-6)
    np.testing.assert_allclose(values_of(env, "extrapolation"), [0.84, 0.87, 1.23, 1.26], rtol=1e-6)
    held = env.tasks("extrapolation")
    np.testing.assert_array_equal(held.draws.params["size"], np.tile(held.params["size"][:, None], 3))
    assert env.tasks("all").draws.id.shape == (10, 3)


def test_environments_are_equal_when_their_settings_are():
    """Equal settings hash alike, so that a jitted function is compiled once for both; every setting counts."""
    one, two = envs.make("finger-spin-vary-size", engine="c"), envs.make("finger-spin-vary-size", engine="c")
    assert one is not two and one == two and hash(one) == hash(two)
    traces = []
    count = jax.jit(lambda env: traces.append(env) or 0, static_argnums=0)
    for env in (one, two):
        count(env)
    assert len(traces) == 1
    others = {"vary": {"touch-size": "1"}, "combine": "paired", "num_tasks": 9, "num_draws": 9, "task_seed": 1}
    others |= {"split": "hip-bmdp", "engine": "mjx", "solver_iterations": 3, "integrator": "euler"}
    others |= {"context_ranges": (("size", 0.0, 1.0),), "pixels": 64, "frames": 2, "repeat": 2}
    pictured = {"grey": True, "state": "also", "plain": True, "painter": "caster"}
    seen = [envs.make("finger-spin-vary-size", engine="c", pixels=64, **{name: x}) for name, x in pictured.items()]
    assert len({*seen, dataclasses.replace(one, pixels=64)}) == 1 + len(seen)
    assert others.keys() | pictured.keys() == {f.name for f in dataclasses.fields(one)}
    for name, value in others.items():
        assert dataclasses.replace(one, **{name: value}) != one


def test_draws_have_no_context_where_all_have_that_of_their_task():
    """As of goals that agents do not see: an episode has its task's context, and its own parameters."""
    told = envs.make("finger-spin", {"size": "0.95:1.15"}, num_draws=20)
    tasks = dataclasses.replace(told, context_ranges=()).tasks()
    assert told.tasks().draws.context.shape == (1, 20, 1) and tasks.draws.context is None
    drawn = jax.vmap(episode_task, (None, 0))(
        jax.tree.map(lambda x: x[0], tasks), jax.random.split(jax.random.key(0), 9)
    )
    assert drawn.context.tolist() == [tasks.context[0].tolist()] * 9 and np.ptp(drawn.params["size"]) > 0.01


def test_environments_are_frozen():
    """A setting cannot change under a compiled program."""
    with pytest.raises(dataclasses.FrozenInstanceError):
        envs.make("finger-spin").num_tasks = 2


PINNED = """
<mujoco>
  <compiler settotalmass="14"/>
  <worldbody>
    <body name="trunk"><freejoint/><geom name="trunk" size="0.1"/>
      <body name="arm"><joint/><geom size="0.05" pos="1 0 0" mass="3"/></body>
      <body name="leg"><joint/><inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body>
    </body>
    <geom name="floor" type="plane" size="1 1 1"/>
  </worldbody>
  <contact><pair geom1="trunk" geom2="floor" friction="2 2 0.1 0.1 0.1"/></contact>
</mujoco>
"""


@pytest.mark.filterwarnings("ignore:compiler attribute")
@pytest.mark.parametrize("scale", [0.5, 1, 2])
def test_masses_scale_where_the_model_pins_their_sum(scale):
    """All of them to 7, 14 and 28 kg; and one body alone, without the others."""

    def edited(parameter):
        spec = mujoco.MjSpec.from_string(PINNED)
        parameter.edit(spec, scale)
        return spec.compile()

    plain = mujoco.MjModel.from_xml_string(PINNED)
    found = edited(parameters.MASS)
    np.testing.assert_allclose(found.body_mass, scale * plain.body_mass)
    np.testing.assert_allclose(found.body_inertia, scale * plain.body_inertia)
    np.testing.assert_allclose(np.sum(found.body_mass), 14 * scale)
    for name in ("trunk", "arm", "leg"):
        expected = np.where(np.arange(4) == plain.body(name).id, scale, 1) * plain.body_mass
        np.testing.assert_allclose(edited(parameters.body_mass(name)).body_mass, expected)


def test_friction_scales_in_pairs_that_have_their_own():
    spec = mujoco.MjSpec.from_string(PINNED)
    parameters.FRICTION.edit(spec, 0.5)  # type: ignore
    assert list(spec.pairs[0].friction) == [1, 1, 0.1, 0.1, 0.1]
