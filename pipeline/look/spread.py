"""Evenly spread samples of indices."""

import numpy as np
from jaxtyping import Int


def spread(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """Up to `most` evenly spaced indices below `count`, ascending, including the first and, if `most` > 1, the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
