"""The canonical form of a level's content, the same however bodies, joints and thrusters are numbered.

Bodies are sorted by their own values; exact copies of a body (at one position, with one motion) by what is joined to
them; copies that are joined alike by their indices. Joints, thrusters and entries of the action are sorted by their
encoding. So levels with the same form have the same content; and levels with the same content have the same form,
unless they contain copies that are joined alike, whose order may then differ.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

MARK = b"exact"  # prefix of every form
NOBODY = -1  # in place of a neighbour's rank
NO_ENTRY = -1


class Side(NamedTuple):
    """An acting joint, as seen from one of its two bodies."""

    first: int
    second: int
    row: bytes  # values, reversed if seen from b
    direction: int  # which way the entry's forward turns it: 1 or -1; 0 if this makes no difference
    entry: int  # of the action that the motor obeys, or NO_ENTRY


class Push(NamedTuple):
    """An acting thruster."""

    body: int
    row: bytes
    entry: int


@dataclass(frozen=True)
class World:
    """The content of one level, with bodies in any order."""

    gravity: bytes
    bodies: list[bytes]  # own values of each active body
    joints: list[tuple[Side, Side]]
    pushes: list[Push]
    apart: list[tuple[int, int]]  # bodies that do not collide


def canonical_form(world: World) -> bytes:
    """Encode a world, with its bodies named by rank."""
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
    # which direction of an entry counts as forward is a convention, too: take the smaller encoding
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
    """Rank the bodies; no two share a rank."""
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
    """Rank keys from 0; equal keys share a rank."""
    rank = {key: i for i, key in enumerate(sorted(set(keys)))}
    return [rank[key] for key in keys]


def _joined(*parts: bytes) -> bytes:
    """Join parts, each with its length in front, so that boundaries are unambiguous."""
    return b"".join(len(part).to_bytes(4, "little") + part for part in parts)
