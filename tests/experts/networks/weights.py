"""Random weights for networks: initial ones take seconds to compile."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def random_weights(init: Callable[[], Any], scale: float) -> Any:
    """Return parameters with the shapes of those that `init` makes, biases included; none is 0.

    Args:
        init: makes initial parameters; it is traced only.
        scale: standard deviation; the scales of normalising layers have a mean of 1.
    """
    rng = np.random.default_rng(0)

    def drawn(path: Any, x: jax.ShapeDtypeStruct) -> np.ndarray:
        mean = 1.0 if "scale" in jax.tree_util.keystr(path[-1:]) else 0.0
        return rng.normal(mean, scale, x.shape).astype(x.dtype)

    return jax.tree_util.tree_map_with_path(drawn, jax.eval_shape(init))
