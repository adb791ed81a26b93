"""The flag of XLA that a command sets before JAX starts. This module needs no JAX."""

import os
from importlib import metadata, util

_TILINGS = "xla_gpu_experimental_cost_model_gemm_tiling_options"
_FIRST, _BEYOND = (0, 10, 2), (0, 13)  # versions of jaxlib: both ends of what is between know the flag


def try_few_tilings() -> None:
    """Let XLA try out four kernels for each matrix product on a GPU, and not dozens, so that it compiles sooner.

    They are those that its model of costs likes best. XLA ends the process at flags that it does not know, so versions
    of jaxlib that were not tried are left alone, and so is what the user's own $XLA_FLAGS says of this.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if _TILINGS not in given and _has_gpu() and _FIRST <= _version("jaxlib") < _BEYOND:
        os.environ["XLA_FLAGS"] = f"{given} --{_TILINGS}=top=4,top_from_default=1".strip()


def _has_gpu() -> bool:
    """Tell whether JAX's plugin for NVIDIA's GPUs is installed."""
    return any(util.find_spec(f"jax_cuda{number}_plugin") for number in (12, 13))


def _version(package: str) -> tuple[int, ...]:
    """Return the numbers of an installed package's version, without what follows them, such as "rc1" or "dev"."""
    numbers = metadata.version(package).split(".")[:3]
    return tuple(int(number) for number in numbers if number.isdigit())
