"""Conversion of shards to another density, a few levels at a time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from levelproof.configs.schema import Density
from levelproof.pipeline.store.merge import Place
from levelproof.pipeline.store.shard import Shard, read_together, write_shard

LEVELS = 256  # in memory at a time; 300 MB of size l


def convert(
    places: Sequence[Place], density: Density, key_every: int, another: Callable[[], Path]
) -> Iterator[list[Place]]:
    """Write trajectories in another density, at most LEVELS to a new shard, durably.

    Args:
        places: of the trajectories, which have one size and one set of rules.
        density: of the new shards.
        key_every: env steps between key frames of `witness`.
        another: returns the path of the next new shard.

    Yields:
        The new places, shard after shard.

    Raises:
        Failure: a shard is damaged, or the engine on this machine computes states that differ from the stored ones.
        OSError: the write fails.
    """
    for first in range(0, len(places), LEVELS):
        some = places[first : first + LEVELS]
        by_shard = groupby(some, lambda place: place.shard)
        parts = [(Shard(path), [place.row for place in group]) for path, group in by_shard]
        arrays = {name: np.moveaxis(x, 0, -1) for name, x in read_together(parts, exactly=True).items()}
        encoding, path = replace(parts[0][0].encoding, density=density, key_every=key_every), another()
        write_shard(path, [place.level_id for place in some], arrays, encoding)
        yield [Place(path, row, place.level_id) for row, place in enumerate(some)]
