"""From one density to another: what is read is written again, a few levels at a time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from levelproof.configs.schema import Density
from levelproof.pipeline.store.merge import Place
from levelproof.pipeline.store.shard import Shard, read_together, write_shard

LEVELS = 256  # that are in memory at a time; of size l, 300 MB


def convert(
    places: Sequence[Place], density: Density, key_every: int, another: Callable[[], Path]
) -> Iterator[list[Place]]:
    """Write the trajectories at these places in another density, so many to a new shard, durably.

    Args:
        places: of one size and one set of rules.
        density: that they are to have.
        key_every: env steps between key frames of `witness`.
        another: gives the path of each.

    Yields:
        Where they lie then, shard after shard.

    Raises:
        Failure: a shard is damaged, or the engine on this machine gives other states than were stored.
        OSError: the disk refuses.
    """
    for first in range(0, len(places), LEVELS):
        some = places[first : first + LEVELS]
        by_shard = groupby(some, lambda place: place.shard)
        parts = [(Shard(path), [place.row for place in of]) for path, of in by_shard]
        arrays = {name: np.moveaxis(x, 0, -1) for name, x in read_together(parts, exactly=True).items()}
        encoding, path = replace(parts[0][0].encoding, density=density, key_every=key_every), another()
        write_shard(path, [place.level_id for place in some], arrays, encoding)
        yield [Place(path, row, place.level_id) for row, place in enumerate(some)]
