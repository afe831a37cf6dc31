"""Which bodies can touch, in the reference's fixed order, and how many solver batches their pairs fill.

Contacts are indexed in four groups: first contact points of the polygon pairs, second contact points of the polygon
pairs, circle-polygon pairs, circle-circle pairs.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from levelproof.physics.lanes import Rows
from levelproof.physics.types import FIXED_POLYGONS, SOLVER_BATCH, Size

KINDS = 3  # of pairs: polygons, circle-polygon, circles
GROUPS = 4  # of contacts: first and second points of polygon pairs, circle-polygon, circles
POLYGONS, CIRCLE_POLYGON, CIRCLES = range(KINDS)
KIND_OF_GROUP = (POLYGONS, POLYGONS, CIRCLE_POLYGON, CIRCLES)


@dataclass(frozen=True)
class PairKind:
    """All pairs of one kind: `a[i]` and `b[i]` are the indices of the bodies of pair i."""

    a: tuple[int, ...]
    b: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.a)

    @property
    def batches(self) -> int:
        """Solver batches that run one after another (Jax2D: ceil(pairs / 16))."""
        return -(-len(self) // SOLVER_BATCH)


@dataclass(frozen=True)
class Pairs:
    """All pairs of a size, by kind."""

    polygon: PairKind  # polygon-polygon, two contact points each
    circle_polygon: PairKind  # a is the circle
    circle: PairKind

    @property
    def by_group(self) -> tuple[PairKind, ...]:
        """The pairs of each group of contacts."""
        return tuple((self.polygon, self.circle_polygon, self.circle)[kind] for kind in KIND_OF_GROUP)

    @property
    def contacts(self) -> int:
        return sum(map(len, self.by_group))


@cache
def pairs_of(size: Size) -> Pairs:
    """List all pairs that can touch: polygons i < j, not both scenery; circles with every polygon; circles i < j."""
    polygons, bodies = range(size.polygons), range(size.polygons, size.bodies)
    polygon = [(i, j) for i in polygons for j in polygons if i < j and j >= FIXED_POLYGONS]
    circle_polygon = [(i, j) for i in bodies for j in polygons]
    circle = [(i, j) for i in bodies for j in bodies if i < j]
    kinds = (
        PairKind(*map(tuple, np.array(k, int).reshape(-1, 2).T.tolist())) for k in (polygon, circle_polygon, circle)
    )
    return Pairs(*kinds)


class Table(NamedTuple):
    """Lookup tables of a kernel: references, or the arrays behind them. A segment is one solver batch of one group."""

    a: Int[Rows, "contact"]  # first body
    b: Int[Rows, "contact"]  # second body
    kept: Float[Rows, "contact"]  # 0 where the padding defect forgets the accumulated impulses, else 1
    start: Int[Rows, "group"]  # first contact
    kind: Int[Rows, "group"]  # kind of the group's pairs
    pairs: Float[Rows, "group"]  # number of pairs of the kind
    batches: Float[Rows, "group"]  # number of solver batches of the kind
    group: Int[Rows, "segment"]
    turn: Float[Rows, "segment"]  # index of the batch within its group

    @property
    def segments(self) -> int:
        return self.group.shape[0]


def table_of(size: Size, faithful_padding: bool) -> Table:
    """Build the lookup tables of a size. Integers that lanes calculate with are stored as floats, exact up to 2^24."""
    kinds = pairs_of(size).by_group
    kept = [np.ones(len(pair), np.float32) for pair in kinds]
    for pair, row in zip(kinds, kept, strict=True):
        padded = pair.batches * SOLVER_BATCH > len(pair)  # the reference's last batch: its defect resets the last pair
        row[len(pair) - 1 :] = not (faithful_padding and padded)
    whole, number = (lambda x: np.array(x, np.int32)), (lambda x: np.array(x, np.float32))
    return Table(
        a=whole([body for pair in kinds for body in pair.a]),
        b=whole([body for pair in kinds for body in pair.b]),
        kept=np.concatenate(kept),
        start=whole(np.cumsum([0, *map(len, kinds)])[:-1]),
        kind=whole(KIND_OF_GROUP),
        pairs=number([len(pair) for pair in kinds]),
        batches=number([pair.batches for pair in kinds]),
        group=whole([group for group, pair in enumerate(kinds) for _ in range(pair.batches)]),
        turn=number([turn for pair in kinds for turn in range(pair.batches)]),
    )
