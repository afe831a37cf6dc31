"""One way to write a level's content down, however its things are numbered and named.

Bodies are sorted by their own numbers, exact copies of a body (at one position, with one motion) by what is joined to
them, and copies that are joined alike by the numbers they have. Joints, thrusters and entries of the action are sorted
as they are written. So levels with the same form have the same content; and levels with the same content have the
same form unless they have copies that are joined alike, whose numbers may then show.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

MARK = b"exact"  # how every form begins
NOBODY = -1  # in place of a neighbour's rank
NO_ENTRY = -1


class Side(NamedTuple):
    """A joint that acts, as seen from one of its two bodies."""

    first: int
    second: int
    row: bytes  # numbers, turned around where it is seen from b
    direction: int  # that the entry's forward turns it in: 1, -1, or 0 where that makes no difference
    entry: int  # of the action, that the motor obeys


class Push(NamedTuple):
    """A thruster that acts."""

    body: int
    row: bytes
    entry: int


@dataclass(frozen=True)
class World:
    """The content of one level, bodies numbered at will."""

    gravity: bytes
    bodies: list[bytes]  # own numbers of each active body
    joints: list[tuple[Side, Side]]
    pushes: list[Push]
    apart: list[tuple[int, int]]  # bodies that do not collide


def canonical_form(world: World) -> bytes:
    """All there is, with the bodies' ranks for names."""
    rank = _body_ranks(world)
    name = [number.to_bytes(4, "little") for number in rank]
    held, motors, flames = [], defaultdict(list), defaultdict(list)
    for sides in world.joints:
        side = min(sides, key=lambda s: (rank[s.first], rank[s.second], s.row, s.direction))
        line = _joined(name[side.first], name[side.second], side.row)
        if side.entry == NO_ENTRY:
            held.append(line)
        else:
            motors[side.entry].append((line, side.direction))
    for push in world.pushes:
        flames[push.entry].append(_joined(name[push.body], push.row))
    # which direction of an entry is forward is a name, too
    both_ways = [[sorted((line, way * d) for line, d in bound) for way in (1, -1)] for bound in motors.values()]
    form = _joined(
        world.gravity,
        _joined(*sorted(_joined(*pair) for pair in zip(name, world.bodies, strict=True))),
        _joined(*sorted(held)),
        _joined(*sorted(_joined(*(line + bytes([1 + d]) for line, d in min(ways))) for ways in both_ways)),
        _joined(*sorted(_joined(*sorted(lines)) for lines in flames.values())),
        _joined(*sorted(_joined(*sorted((name[i], name[j]))) for i, j in world.apart)),
    )
    return _joined(MARK, form)


def _body_ranks(world: World) -> list[int]:
    """The rank of each body, no two the same."""
    own = _ranks(world.bodies)
    around: list[list[tuple[int, bytes]]] = [[] for _ in own]
    for sides in world.joints:
        for side in sides:
            around[side.first].append((own[side.second], side.row))
    for push in world.pushes:
        around[push.body].append((NOBODY, push.row))
    for i, j in world.apart:
        around[i].append((own[j], b""))
        around[j].append((own[i], b""))
    return _ranks([(own[i], tuple(sorted(around[i])), i) for i in range(len(own))])


def _ranks(keys: Sequence[Any]) -> list[int]:
    """Numbers from 0 in the order of the keys, the same for equal ones."""
    number = {key: i for i, key in enumerate(sorted(set(keys)))}
    return [number[key] for key in keys]


def _joined(*parts: bytes) -> bytes:
    """One string that says where each part ends."""
    return b"".join(len(part).to_bytes(4, "little") + part for part in parts)
