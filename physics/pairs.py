"""Which bodies can touch, in the reference's fixed index order, and how pairs share out into solver batches.

Contacts are numbered: first contact points of the polygon pairs, second contact points of the polygon
pairs, circle-polygon pairs, circle-circle pairs.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from physics.types import FIXED_POLYGONS, SOLVER_BATCH, Size


@dataclass(frozen=True)
class PairKind:
    """All pairs of one kind: `a[i]` and `b[i]` are the body numbers of pair i."""

    a: tuple[int, ...]
    b: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.a)

    @property
    def batches(self) -> int:
        """Solver batches that run one after another (Jax2D: ceil(pairs / 16))."""
        return -(-len(self) // SOLVER_BATCH)

    @property
    def padded(self) -> bool:
        """True where the reference's last batch is padded, so that its defect resets the last pair."""
        return self.batches * SOLVER_BATCH > len(self)


@dataclass(frozen=True)
class Pairs:
    polygon: PairKind  # polygon-polygon, two contact points each
    circle_polygon: PairKind  # a is the circle
    circle: PairKind

    @property
    def contacts(self) -> int:
        return 2 * len(self.polygon) + len(self.circle_polygon) + len(self.circle)


@cache
def pairs_of(size: Size) -> Pairs:
    """All pairs that may touch: i < j, not both fixed scenery; circles with every polygon; circles."""
    polygons, bodies = range(size.polygons), range(size.polygons, size.bodies)
    polygon = [(i, j) for i in polygons for j in polygons if i < j and j >= FIXED_POLYGONS]
    circle_polygon = [(i, j) for i in bodies for j in polygons]
    circle = [(i, j) for i in bodies for j in bodies if i < j]
    kinds = (
        PairKind(*map(tuple, np.array(k, int).reshape(-1, 2).T.tolist())) for k in (polygon, circle_polygon, circle)
    )
    return Pairs(*kinds)
