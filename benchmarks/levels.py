"""Levels of a bench on our side: read from the reference's plain arrays."""

import jax
import numpy as np

from levelproof.levelgen.files.kinetix import level_from_kinetix
from levelproof.levelgen.level import Level


def load_levels(path: str, first: int, count: int) -> Level:
    """Levels `first` to `first + count - 1` of a file, going round where it has fewer; numpy on the host."""
    with np.load(path) as file:
        levels = level_from_kinetix({name: file[name] for name in file.files})
    index = (first + np.arange(count)) % levels.role.shape[-1]
    return jax.tree.map(lambda x: np.ascontiguousarray(x[..., index]), levels)
