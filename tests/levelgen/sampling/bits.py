"""Hashes of the bits of levels."""

import hashlib
import json
import sys

import jax
import numpy as np

from levelproof.configs.compose import distributions
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import CHUNK, sample_levels
from tests.processors import become

COUNT = 10_240  # ids of each size and preset


def digest(level: Level) -> str:
    """Hash every bit of some levels."""
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(level):
        total.update(np.ascontiguousarray(leaf).tobytes())
    return total.hexdigest()[:16]


def digests(size: str, preset: str, count: int) -> list[str]:
    """Hash chunks of levels, from id 0 on."""
    level = jax.tree.map(np.asarray, sample_levels(np.arange(count), SIZES[size], distributions()[preset]))
    return [digest(level[first : first + CHUNK]) for first in range(0, count, CHUNK)]


if __name__ == "__main__":
    processor, count, *asked = sys.argv[1:]
    become(processor)
    print(json.dumps({name: digests(*name.split("/"), int(count)) for name in asked}))
