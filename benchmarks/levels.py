"""Levels for our side of a benchmark, read from the reference's plain arrays."""

import jax
import numpy as np

from levelproof.levelgen.files.kinetix import level_from_kinetix
from levelproof.levelgen.level import Level


def load_levels(path: str, first: int, count: int) -> Level:
    """Load levels `first` to `first + count - 1` of a file as numpy arrays; indices wrap around."""
    with np.load(path) as file:
        levels = level_from_kinetix({name: file[name] for name in file.files})
    index = (first + np.arange(count)) % levels.role.shape[-1]
    return jax.tree.map(lambda x: np.ascontiguousarray(x[..., index]), levels)
