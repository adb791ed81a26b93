"""Convolutions in turn against JAX's own, of which they are other forms."""

import re
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents.parts import convolution
from mtjax.agents.parts.convolution import Transposed, convolve, multiply_patches

_IN_TURN = partial(nn.Conv, conv_general_dilated=convolve)
_ROUNDING = {"rtol": 2e-5, "atol": 2e-5}


def normal(*shape):
    return jnp.float32(np.random.default_rng(0).normal(size=shape))


def layers(conv):
    """Two convolutions, the first of pictures of 12 x 12 with stride 2."""
    return nn.Sequential([conv(4, (3, 3), (2, 2), "VALID"), nn.tanh, conv(5, (3, 3))])


def loss(network, params, pictures):
    return jnp.mean(network.apply(params, pictures) ** 2)


def of_seeds(network, pictures):
    """Return the network's loss and gradients for pictures (S, T, B, 12, 12, 3)."""
    params = jax.vmap(lambda key: network.init(key, pictures[0, 0]))(jax.random.split(jax.random.key(0), len(pictures)))
    return jax.vmap(jax.value_and_grad(partial(loss, network)))(params, pictures)


def of_tasks(network, pictures):
    """Return the gradients of every task for filters that all tasks share."""
    params = network.init(jax.random.key(0), pictures[0, 0])
    return jax.vmap(jax.vmap(jax.grad(partial(loss, network)), (None, 0)), (None, 0))(params, pictures)


def of_mean(network, pictures):
    """Return the gradient of a mean over tasks whose losses are mapped, for every seed."""
    params = jax.vmap(lambda key: network.init(key, pictures[0, 0]))(jax.random.split(jax.random.key(0), len(pictures)))
    mean = lambda params, pictures: jnp.mean(jax.vmap(partial(loss, network), (None, 0))(params, pictures))
    return jax.vmap(jax.grad(mean))(params, pictures)


def of_gradients(network, pictures):
    """Return the gradient of a gradient's norm."""
    params = network.init(jax.random.key(0), pictures[0, 0])
    norm = lambda params: sum(
        jnp.sum(x**2) for x in jax.tree.leaves(jax.grad(partial(loss, network))(params, pictures))
    )
    return jax.grad(norm)(params)


def of_many(network, pictures):
    """Return what twenty networks make of the same pictures."""
    params = jax.vmap(lambda key: network.init(key, pictures[0, 0]))(jax.random.split(jax.random.key(0), 20))
    return jax.vmap(network.apply, (0, None))(params, pictures)


@pytest.mark.parametrize("of", [of_seeds, of_tasks, of_mean, of_gradients, of_many])
@pytest.mark.slow
def test_maps_and_gradients_are_those_of_jax(of):
    pictures = normal(2, 3, 2, 12, 12, 3)
    jax.tree.map(
        partial(np.testing.assert_allclose, **_ROUNDING), of(layers(_IN_TURN), pictures), of(layers(nn.Conv), pictures)
    )


def test_a_product_of_patches_is_a_convolution():
    """With the gradients of seeds, and with none of XLA's convolutions, which are slow under a map over filters."""
    network = lambda **given: nn.Conv(5, (3, 2), padding="VALID", **given)
    pictures, product = normal(2, 3, 2, 7, 6, 3), network(conv_general_dilated=multiply_patches)
    close = partial(np.testing.assert_allclose, **_ROUNDING)
    jax.tree.map(close, of_seeds(product, pictures), of_seeds(network(), pictures))
    assert "convolution" not in jax.jit(partial(of_seeds, product)).lower(pictures).as_text()
    with pytest.raises(NotImplementedError, match="take convolve"):
        nn.Conv(5, (3, 3), conv_general_dilated=multiply_patches).init(jax.random.key(0), pictures[0, 0])


@pytest.mark.parametrize("of", [of_seeds, of_mean])
def test_seeds_make_no_convolution_in_groups(of):
    text = jax.jit(partial(of, layers(_IN_TURN))).lower(normal(2, 3, 2, 12, 12, 3)).as_text()
    assert "feature_group_count = 1" in text and "feature_group_count = 2" not in text
    assert "batch_group_count = 1" in text and "batch_group_count = 2" not in text
    assert text.count("stablehlo.convolution") == 2 * 5  # two layers forwards, two filters and one picture back


def test_gradients_on_a_cpu_have_axes_in_the_order_that_is_fast():
    """XLA's CPU compiler brings axes into this order outside of loops alone."""
    text = jax.jit(partial(of_mean, layers(_IN_TURN))).lower(normal(2, 3, 2, 12, 12, 3)).as_text()
    orders = re.findall(r"stablehlo.convolution.* dim_numbers = (.+?), window", text)
    assert len(orders) == 10 and set(orders) == {"[b, 0, 1, f]x[0, 1, i, o]->[b, 0, 1, f]"}


@pytest.mark.parametrize("padding", [((0, 0), (0, 0)), ((1, 1), (1, 1)), ((2, 0), (1, 2))])
@pytest.mark.parametrize("strides", [(1, 1), (2, 2), (1, 3)])
def test_gradients_on_a_cpu_are_those_of_other_devices(strides, padding):
    pictures, filters = normal(4, 11, 12, 3), normal(3, 4, 3, 5)
    settings = {"window_strides": strides, "padding": padding, "dimension_numbers": ("NHWC", "HWIO", "NHWC")}
    shapes = {"picture_shape": pictures.shape[1:], "filters_shape": filters.shape}
    slopes = jnp.cos(jax.lax.conv_general_dilated(pictures, filters, **settings))
    for on_cpu, others, given in [
        (convolution._to_pictures_on_cpu, convolution._to_pictures, (slopes, filters)),
        (convolution._to_filters_on_cpu, convolution._to_filters, (pictures, slopes)),
    ]:
        np.testing.assert_allclose(
            on_cpu(*given, **settings, **shapes), others(*given, **settings, **shapes), atol=1e-4
        )


@pytest.mark.parametrize(("side", "stride"), [(7, 1), (12, 2), (11, 2)])
def test_transposed_layer_is_flax_s_with_its_filters_turned(side, stride):
    features, place = normal(2, 3, 5, 5, 4), (side, side, 3)
    own = Transposed(place, stride)
    params = own.init(jax.random.key(0), features)
    odd = side - (5 - 1) * stride - 3  # rows and columns that no window reaches
    theirs = nn.ConvTranspose(3, (3, 3), (stride, stride), padding=((2, 2 + odd), (2, 2 + odd)))
    turn = lambda kernel: jnp.swapaxes(kernel[::-1, ::-1], -1, -2)
    turned = lambda params: {"params": {**params["params"], "kernel": turn(params["params"]["kernel"])}}
    one = jax.value_and_grad(partial(loss, own), (0, 1))(params, features)
    other = jax.value_and_grad(partial(loss, theirs), (0, 1))(turned(params), features)
    assert own.apply(params, features).shape == (2, 3, *place)
    np.testing.assert_allclose(one[0], other[0], **_ROUNDING)
    jax.tree.map(partial(np.testing.assert_allclose, **_ROUNDING), turned(one[1][0]), other[1][0])
    np.testing.assert_allclose(one[1][1], other[1][1], **_ROUNDING)


def test_transposed_layers_begin_as_large_as_flax_s():
    kernel = Transposed((30, 30, 9), 1).init(jax.random.key(0), normal(1, 28, 28, 32))["params"]["kernel"]
    np.testing.assert_allclose(jnp.std(kernel), (9 * 32) ** -0.5, rtol=0.05)


@pytest.mark.parametrize(
    "settings", [{"kernel_dilation": (2, 2)}, {"input_dilation": (2, 2)}, {"feature_group_count": 3}]
)
def test_dilation_and_groups_are_refused(settings):
    with pytest.raises(NotImplementedError, match="dilation or groups"):
        _IN_TURN(3, (3, 3), **settings).init(jax.random.key(0), normal(1, 12, 12, 3))
