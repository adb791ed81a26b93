"""Shares of environments where nothing is shared; ``four_devices`` has them where it is."""

import jax
import jax.numpy as jnp

from mtjax.parallel import collectives as shares


def test_a_device_alone_has_all():
    """Every function gives back the very thing it is given, within a program or not."""

    def check(x):
        same = [f(x) for f in (lambda x: shares.own(x, 0), lambda x: shares.whole(x, 0), shares.total)]
        assert all(y is x for y in (*same, shares.pick(x, jnp.int32(1))))
        return shares.count()

    assert check(jnp.arange(3)) == jax.jit(check)(jnp.arange(3)) == 1
