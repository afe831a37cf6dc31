"""Which bodies can touch, in the reference's fixed index order, and how pairs share out into solver batches.

Contacts are numbered: first contact points of the polygon pairs, second contact points of the polygon
pairs, circle-polygon pairs, circle-circle pairs.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from physics.types import FIXED_POLYGONS, SOLVER_BATCH, Size

KINDS = 3  # of pairs: polygons, circle-polygon, circles


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


class Table(NamedTuple):
    """What kernels look up by number: references, or the arrays behind them.

    A segment is one solver batch of one group of contacts: first points, second points, circle-polygon, circle-circle.
    """

    a: Any  # [contact] first body
    b: Any  # [contact] second body
    kept: Any  # [contact] 0 where the padding defect forgets the accumulated impulses, else 1
    first: Any  # [segment] first contact of the group
    last: Any  # [segment] the one after its last
    kind: Any  # [segment] of its pairs: 0 polygons, 1 circle-polygon, 2 circles
    pairs: Any  # [segment] of the kind
    batches: Any  # [segment] of the kind
    turn: Any  # [segment] number of the batch

    @property
    def segments(self) -> int:
        return self.first.shape[0]


def table_of(size: Size, faithful_padding: bool) -> Table:
    """The lookup tables of a size."""
    pairs = pairs_of(size)
    kinds = (pairs.polygon, pairs.circle_polygon, pairs.circle)
    a, b, kept, segments, start = [], [], [], [], 0
    for kind in (0, 0, 1, 2):
        pair = kinds[kind]
        a += pair.a
        b += pair.b
        forgotten = faithful_padding and pair.padded
        kept += [1.0] * (len(pair) - 1) + [0.0 if forgotten else 1.0] * min(len(pair), 1)
        segments += [(start, start + len(pair), kind, len(pair), pair.batches, turn) for turn in range(pair.batches)]
        start += len(pair)
    columns = (np.array(column, np.int32) for column in zip(*segments, strict=True))
    return Table(np.array(a, np.int32), np.array(b, np.int32), np.array(kept, np.float32), *columns)
