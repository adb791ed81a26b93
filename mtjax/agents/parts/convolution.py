"""Convolutions whose gradients are fast in loops, and where filters differ as those of seeds do.

JAX's own gradients of filters are slow on a GPU in two cases: under ``vmap`` over filters, where it makes one
convolution in groups, and in a transposed convolution. XLA then convolves with windows as large as a picture, for which
cuDNN has no fast kernel. Here filters that differ are taken one after another, and every gradient is one that cuDNN
knows. On a CPU they are slow in every loop, and here they are not.

A convolution is linear in pictures and in filters. It and its two gradients are each other's gradients:

    CONVOLVE    (pictures, filters) -> features
    TO_PICTURES (features, filters) -> pictures
    TO_FILTERS  (pictures, features) -> filters
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mtjax.types import Array

_AXES = ("NHWC", "HWIO", "NHWC")
_UNROLLED = 16  # more filters, such as those of every world, are taken in a loop, which is compiled once


def convolve(pictures: Array, filters: Array, strides: Sequence[int], padding: Any, **given: Any) -> Array:
    """Do what ``jax.lax.conv_general_dilated`` does, for a ``flax.linen.Conv`` without dilation and groups.

    Args:
        pictures: (N, H, W, C).
        filters: (h, w, C, F).

    Returns:
        (N, H', W', F).

    Raises:
        NotImplementedError: it has dilation or groups.
    """
    if given.get("feature_group_count", 1) != 1 or any(
        step != 1 for name in ("lhs_dilation", "rhs_dilation") for step in given.get(name) or ()
    ):
        raise NotImplementedError("a convolution with dilation or groups has no gradient here; take JAX's own")
    if isinstance(padding, str):
        padding = jax.lax.padtype_to_pads(pictures.shape[1:3], filters.shape[:2], strides, padding)
    shapes = {"picture_shape": pictures.shape[1:], "filters_shape": filters.shape}
    settings = {
        "window_strides": tuple(strides),
        "padding": tuple(map(tuple, padding)),
        "batch_group_count": 1,
        **given,
    }
    return CONVOLVE.bind(pictures, filters, **shapes, **settings)  # type: ignore


def multiply_patches(pictures: Array, filters: Array, strides: Sequence[int], padding: Any, **_: Any) -> Array:
    """Do what ``convolve`` does, without strides and padding, as one product of all patches with the filters.

    The filters of all seeds are then one product too. Patches of large pictures would take much memory.

    Args:
        pictures: (N, H, W, C).
        filters: (h, w, C, F).

    Returns:
        (N, H - h + 1, W - w + 1, F).

    Raises:
        NotImplementedError: it has strides or padding.
    """
    if padding != "VALID" or any(step != 1 for step in strides):
        raise NotImplementedError("patches are of every place, without padding; take convolve")
    rows, columns = filters.shape[:2]
    height, width = pictures.shape[1] - rows + 1, pictures.shape[2] - columns + 1
    moved = [pictures[:, i : i + height, j : j + width] for i in range(rows) for j in range(columns)]
    return jnp.concatenate(moved, axis=-1) @ filters.reshape(-1, filters.shape[-1])


class Transposed(nn.Module):
    """Layer that maps features to pictures, as the gradient of a convolution of 3 x 3 without padding does."""

    picture_shape: tuple[int, int, int]  # height, width and channels
    stride: int = 1

    @nn.compact
    def __call__(self, features: Array) -> Array:
        """Map features (..., H', W', F) to pictures (..., H, W, C)."""
        shape = (3, 3, self.picture_shape[-1], features.shape[-1])
        filters = self.param("kernel", nn.initializers.lecun_normal(in_axis=-1, out_axis=-2), shape)
        bias = self.param("bias", nn.initializers.zeros_init(), shape[2:3])
        settings = {"window_strides": (self.stride,) * 2, "padding": ((0, 0),) * 2, "dimension_numbers": _AXES}
        settings |= {"picture_shape": self.picture_shape, "filters_shape": shape}
        flat = features.reshape(-1, *features.shape[-3:])
        drawn: Any = TO_PICTURES.bind(flat, filters, **settings)
        return (drawn + bias).reshape(*features.shape[:-3], *self.picture_shape)


def _convolve(pictures: Array, filters: Array, picture_shape: Any, filters_shape: Any, **settings: Any) -> Array:
    return jax.lax.conv_general_dilated(pictures, filters, **settings)


def _to_pictures(features: Array, filters: Array, picture_shape: Any, filters_shape: Any, **settings: Any) -> Array:
    forward = lambda pictures: jax.lax.conv_general_dilated(pictures, filters, **settings)
    place = jax.ShapeDtypeStruct((features.shape[0], *picture_shape), features.dtype)
    return jax.linear_transpose(forward, place)(features)[0]


def _to_filters(pictures: Array, features: Array, picture_shape: Any, filters_shape: Any, **settings: Any) -> Array:
    forward = lambda filters: jax.lax.conv_general_dilated(pictures, filters, **settings)
    place = jax.ShapeDtypeStruct(filters_shape, features.dtype)
    return jax.linear_transpose(forward, place)(features)[0]


# On a CPU, XLA is fast with axes in the order of _AXES alone. It brings others into it, but not in loops.


def _to_pictures_on_cpu(features: Array, filters: Array, window_strides: Any, **settings: Any) -> Array:
    sides = []
    for size, count, window, stride, before in _sizes(features, window_strides, **settings):
        first = window - 1 - before
        sides.append((first, size + window - 2 - (count - 1) * stride - first))
    turned = jnp.swapaxes(filters[::-1, ::-1], 2, 3)
    return jax.lax.conv_general_dilated(
        features, turned, (1, 1), sides, lhs_dilation=window_strides, dimension_numbers=_AXES
    )


def _to_filters_on_cpu(pictures: Array, features: Array, window_strides: Any, **settings: Any) -> Array:
    sides = []
    for size, count, window, stride, before in _sizes(features, window_strides, **settings):
        sides.append((before, (count - 1) * stride + window - size - before))
    of_channels, of_filters = jnp.swapaxes(pictures, 0, 3), jnp.moveaxis(features, 0, 2)  # (C, H, W, N), (H', W', N, F)
    found = jax.lax.conv_general_dilated(
        of_channels, of_filters, (1, 1), sides, rhs_dilation=window_strides, dimension_numbers=_AXES
    )
    return jnp.moveaxis(found, 0, 2)


def _sizes(features: Array, strides: Any, picture_shape: Any, filters_shape: Any, padding: Any, **_: Any) -> Iterator:
    """Return of height and of width: pixels, windows, the size of one, its stride, and the padding before."""
    return zip(picture_shape[:2], features.shape[1:3], filters_shape, strides, [x for x, _ in padding], strict=False)


def _bilinear(name: str, function: Callable[..., Array], on_cpu: Callable[..., Array], joins: bool = True) -> Primitive:
    """Return an operation that is linear in two arrays, and that ``vmap`` calls once for each element.

    Args:
        on_cpu: the same function for CPUs.
        joins: if the first array alone is mapped, its elements are one longer batch instead.
    """
    operation = Primitive(name)

    def shape(first: Any, second: Any, **settings: Any) -> Any:
        found = jax.eval_shape(partial(function, **settings), first, second)
        return jax.core.ShapedArray(found.shape, found.dtype)

    def batched(given: Sequence[Array], axes: Sequence[int | None], **settings: Any) -> tuple[Array, int]:
        one: Any = partial(operation.bind, **settings)
        lead = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(given, axes, strict=True)]
        count = next(x.shape[0] for x, axis in zip(lead, axes, strict=True) if axis is not None)
        if joins and axes[1] is None:
            found = one(lead[0].reshape(-1, *lead[0].shape[2:]), lead[1])
            return found.reshape(count, -1, *found.shape[1:]), 0
        each = lambda i: one(*(x if axis is None else x[i] for x, axis in zip(lead, axes, strict=True)))
        if isinstance(count, int) and count <= _UNROLLED:
            return jnp.stack([each(i) for i in range(count)]), 0
        return jax.lax.map(each, jnp.arange(count)), 0

    operation.def_impl(function)
    operation.def_abstract_eval(shape)
    mlir.register_lowering(operation, mlir.lower_fun(function, multiple_results=False))
    mlir.register_lowering(operation, mlir.lower_fun(on_cpu, multiple_results=False), platform="cpu")
    batching.primitive_batchers[operation] = batched
    return operation


CONVOLVE = _bilinear("conv_general_dilated", _convolve, _convolve)  # exporters go by this name
TO_PICTURES = _bilinear("conv_to_pictures", _to_pictures, _to_pictures_on_cpu)
TO_FILTERS = _bilinear("conv_to_filters", _to_filters, _to_filters_on_cpu, joins=False)

# The gradients by the first and by the second array. Rules are given the gradient of the result before both arrays.
ad.defbilinear(
    CONVOLVE,
    lambda features, _, filters, **settings: TO_PICTURES.bind(features, filters, **settings),
    lambda features, pictures, _, **settings: TO_FILTERS.bind(pictures, features, **settings),
)
ad.defbilinear(
    TO_PICTURES,
    lambda pictures, _, filters, **settings: CONVOLVE.bind(pictures, filters, **settings),
    lambda pictures, features, _, **settings: TO_FILTERS.bind(pictures, features, **settings),
)
ad.defbilinear(
    TO_FILTERS,
    lambda filters, _, features, **settings: TO_PICTURES.bind(features, filters, **settings),
    lambda filters, pictures, _, **settings: CONVOLVE.bind(pictures, filters, **settings),
)
