"""Checks of settings, which their dataclasses make on creation, and of JAX's precision."""

from collections.abc import Iterable
from math import inf, isfinite
from typing import Any

import jax
import numpy as np


def require(settings: Any, names: Iterable[str], least: float, most: float = inf, above: bool = False) -> None:
    """Check that each named setting is finite and within `least` .. `most` (if `above`: and not `least` itself,
    in single precision).

    Raises:
        ValueError: a setting is out of bounds; the message starts with its name.
    """
    for name in names:
        value = getattr(settings, name)
        if not isfinite(value) or not least <= value <= most or (above and np.float32(value) == np.float32(least)):
            low = f"above {least}" if above else f"at least {least}"
            within = f"{low} and at most {most}" if above else f"between {least} and {most}"
            wanted = "a finite number" if not isfinite(value) else low if most == inf else within
            raise ValueError(f"{name} is {value}: it must be {wanted}")


def require_32_bits() -> None:
    """Raise ValueError if `jax_enable_x64` is on: levels would differ, and kernels are 32-bit."""
    if jax.dtypes.canonicalize_dtype(np.int64) == np.int64:
        raise ValueError("jax_enable_x64 is on, but levels and physics are 32-bit: turn it off")
