import warnings

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from mtjax.report import figures as plot
from mtjax.types import InputError

STEPS = np.array([0, 500, 1000])


def random_returns(*shape):
    return np.random.default_rng(3).uniform(0, 1000, shape)


@pytest.fixture(autouse=True)
def nothing_global_changes():
    before = plt.get_fignums(), matplotlib.get_backend()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    assert (plt.get_fignums(), matplotlib.get_backend()) == before


@pytest.fixture
def drawn(monkeypatch):
    """The axes of every figure, which are also written."""
    all_axes, save = [], plot._save

    def record(figure, axes, path, **settings):
        all_axes.append(axes)
        save(figure, axes, path, **settings)

    monkeypatch.setattr(plot, "_save", record)
    return all_axes


def draw_learning_curve(path, seeds):
    returns = {
        "train": random_returns(seeds, 3, 4, 2),
        "interpolation": random_returns(seeds, 3, 0, 2),
        "extrapolation": random_returns(seeds, 3, 1, 2),
    }
    plot.learning_curve(path, STEPS, returns, "finger-spin")
    return returns


def draw_return_by_parameter(path, seeds):
    values = {"train": np.array([1.0, 2.0]), "interpolation": np.array([1.5]), "extrapolation": np.zeros(0)}
    returns = {split: random_returns(seeds, len(value), 2) for split, value in values.items()}
    plot.return_by_parameter(path, "size", "1", values, returns)
    return returns


def draw_compare(path, seeds):
    curves = {name: (STEPS, random_returns(seeds, 3, 2, 2)) for name in ("sac", "care")}
    plot.compare(path, curves)
    return curves


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("draw", [draw_learning_curve, draw_return_by_parameter, draw_compare])
def test_writes_a_png(draw, seeds, tmp_path):
    draw(tmp_path / "figure.png", seeds)
    with Image.open(tmp_path / "figure.png") as image:
        assert image.format == "PNG" and image.size == (720, 480)
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    inked = np.mean(np.any(pixels != 255, axis=1))
    assert 0.01 < inked < 0.5
    assert np.any(np.all(pixels == (0x00, 0x72, 0xB2), axis=1))  # the first colour of the palette


def test_learning_curve_shows_means_bands_and_axes(drawn, tmp_path):
    returns = draw_learning_curve(tmp_path / "figure.png", 3)
    (axes,) = drawn
    assert axes.get_legend_handles_labels()[1] == ["train (4 tasks)", "extrapolation (1 task)"]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), STEPS)
    np.testing.assert_allclose(axes.lines[0].get_ydata(), returns["train"].mean(axis=(0, 2, 3)))
    band = axes.collections[0].get_paths()[0].get_extents()
    per_seed = returns["train"].mean(axis=(2, 3))
    assert per_seed.min() <= band.y0 < band.y1 <= per_seed.max()
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_ylim()[0]) == ("environment steps", "return", 0)
    assert axes.get_title() == "finger-spin"


def test_random_actions_are_shaded(drawn, tmp_path):
    """From the first step to where learning begins, and the legend says what that is."""
    plot.learning_curve(tmp_path / "figure.png", STEPS, {"train": random_returns(1, 3, 1, 1)}, "", warmup=50)
    (shade,) = drawn[0].patches
    assert (shade.get_x(), shade.get_width()) == (0, 50)
    assert drawn[0].get_legend_handles_labels()[1] == ["train (1 task)", "random actions"]


def test_colour_of_a_split_does_not_depend_on_which_are_empty(drawn, tmp_path):
    draw_learning_curve(tmp_path / "one.png", 1)
    full = {split: random_returns(1, 3, 1, 1) for split in ("train", "interpolation", "extrapolation")}
    plot.learning_curve(tmp_path / "two.png", STEPS, full, "")
    assert drawn[0].lines[1].get_color() == drawn[1].lines[2].get_color()


@pytest.mark.parametrize("offset", [0, -400, -2000])
def test_all_returns_are_within_the_axes(drawn, tmp_path, offset):
    returns = random_returns(3, 3, 1, 1) + offset
    plot.learning_curve(tmp_path / "figure.png", STEPS, {"train": returns}, "")
    bottom, top = drawn[0].get_ylim()
    means = returns.mean(axis=(0, 2, 3))
    assert bottom <= 0 and bottom < means.min() and top > means.max()


@pytest.mark.parametrize("seeds", [1, 2])
def test_few_seeds_have_no_band_and_no_bars(drawn, tmp_path, seeds):
    draw_learning_curve(tmp_path / "figure.png", seeds)
    assert not drawn[0].collections
    draw_return_by_parameter(tmp_path / "other.png", seeds)
    assert not any(container.has_yerr for container in drawn[1].containers)
    draw_return_by_parameter(tmp_path / "third.png", 3)
    assert all(container.has_yerr for container in drawn[2].containers)


def test_return_by_parameter_shows_each_task(drawn, tmp_path):
    returns = draw_return_by_parameter(tmp_path / "figure.png", 3)
    (axes,) = drawn
    assert axes.get_xlabel() == "size" and axes.get_ylim()[0] == 0
    assert axes.get_legend_handles_labels()[1] == ["train", "interpolation"]
    line = axes.containers[0].lines[0]
    np.testing.assert_array_equal(line.get_xdata(), [1, 2])
    np.testing.assert_allclose(line.get_ydata(), returns["train"].mean(axis=(0, 2)))


def test_equal_seeds_have_bars_of_no_length(tmp_path):
    returns = {"train": np.full((7, 1, 3), 0.1)}
    plot.return_by_parameter(tmp_path / "figure.png", "size", "1", {"train": np.array([1.0])}, returns)


def test_compare_names_agents_and_seeds(drawn, tmp_path):
    curves = draw_compare(tmp_path / "figure.png", 3)
    assert drawn[0].get_legend_handles_labels()[1] == ["sac (3 seeds)", "care (3 seeds)"]
    np.testing.assert_allclose(drawn[0].lines[1].get_ydata(), curves["care"][1].mean(axis=(0, 2, 3)))


@pytest.mark.parametrize("last, scale", [(3_000, "linear"), (20_000, "log")])
def test_agents_with_far_more_steps_make_the_axis_logarithmic(last, scale, drawn, tmp_path):
    """Else the curves of the others are a line upwards."""
    returns = np.arange(4.0).reshape(1, 2, 2, 1)
    curves = {"sac": (np.array([500, 1_000]), returns), "ppo": (np.array([1_000, last]), returns)}
    plot.compare(tmp_path / "figure.png", curves)
    assert drawn[0].get_xscale() == scale


def test_single_evaluation_of_zero_return(tmp_path):
    plot.learning_curve(tmp_path / "figure.png", np.array([0]), {"train": np.zeros((1, 1, 1, 1))}, "")
    assert (tmp_path / "figure.png").exists()


def test_nothing_to_draw_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="nothing to draw"):
        plot.compare(tmp_path / "figure.png", {})
