"""Some of many, spread evenly."""

import numpy as np
from jaxtyping import Int


def spread(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """At most so many of the numbers below `count`, ascending: the first, and the last where there are two."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
