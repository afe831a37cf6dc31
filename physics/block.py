"""What a step of a block of lanes works on: references to the worlds before and after, and to scratch memory.

The annotations say shapes and dtypes, and nothing else does: the scratch memory is made from them (`physics.buffers`).
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from levelproof.physics.lanes import Ref
from levelproof.physics.pairs import Table
from levelproof.physics.types import Manifold, Model, State


class Given(NamedTuple):
    """What a step reads."""

    model: Model
    before: State
    motor: Float[Ref, "joint lane"]  # control of each joint's motor, in [-1, 1]
    thrust: Float[Ref, "thruster lane"]  # control of each thruster, in [0, 1]


class Bodies(NamedTuple):
    """What the solver moves, and what it adds up to push it with."""

    motion: Float[Ref, "body 5 lane"]  # position x, y (m), velocity x, y (m/s), angular velocity (rad/s)
    push: Float[Ref, "body 3 lane"]  # sum of impulses x, y (N s), angular (N m s), since the body last yielded to them
    turn: Float[Ref, "body 2 lane"]  # cosine and sine of the rotation


class Outlines(NamedTuple):
    """Each polygon's geometry, x and y apart."""

    start: Float[Ref, "2 polygon vertex lane"]  # first vertex of each face, in the polygon's frame
    edge: Float[Ref, "2 polygon vertex lane"]  # from there to the next
    along: Float[Ref, "2 polygon vertex lane"]  # the same, of length 1
    length: Float[Ref, "polygon vertex lane"]
    support: Float[Ref, "polygon vertex lane"]  # largest projection on the face's normal, from the centre; or FAR
    vertex: Float[Ref, "2 polygon vertex lane"]  # in the world
    normal: Float[Ref, "2 polygon vertex lane"]  # outward unit normal of each face, in the world
    box: Float[Ref, "polygon 4 lane"]  # lowest x, y and highest x, y


class Joints(NamedTuple):
    """Joints as constraints: constant over a step but for the impulses. Masses are 0 where it may not act."""

    acts: Bool[Ref, "joint lane"]  # active, with active bodies, not both immovable
    turns: Bool[Ref, "joint lane"]  # whether an angular impulse applies
    arms: Float[Ref, "joint 4 lane"]  # from the centre of a to its anchor, of b to its, in the world
    masses: Float[Ref, "joint 4 lane"]  # inverse masses of a and b, inverse inertias of a and b
    weight: Float[Ref, "joint lane"]  # share of a's anchor in the joint's point: the heavier body decides
    angle: Float[Ref, "joint lane"]  # angle of b relative to a, from the joint's resting angle, rad
    angle_bias: Float[Ref, "joint lane"]  # rad/s that the angle asks for
    impulse: Float[Ref, "joint 3 lane"]  # accumulated, x, y (N s) and angular (N m s)


class Constraints(NamedTuple):
    """Contacts as constraints. Only rows of contacts that act in any lane are ever read.

    A group are the first points of polygon pairs, their second points, circle-polygon pairs, or pairs of circles.
    """

    geometry: Float[Ref, "contact 4 lane"]  # normal x, y, point x, y
    effort: Float[Ref, "contact 5 lane"]  # target (m/s along the normal), friction, both inverse masses, inertias
    impulse: Float[Ref, "contact 2 lane"]  # accumulated, normal and tangent, N s
    batch: Float[Ref, "contact lane"]  # number of the solver batch; NONE where it does not push
    touching: Float[Ref, "kind lane"]  # how many pairs of a kind touch
    acting: Int[Ref, "contact"]  # numbers of the contacts that push in any lane, each group from its first contact on
    counts: Int[Ref, "group"]  # how many these are
    listed: Int[Ref, "listing"]  # the same, by solver batch
    ends: Int[Ref, "boundary"]  # where each batch begins and ends in `listed`


class Scratch(NamedTuple):
    """What a step works in."""

    bodies: Bodies
    outlines: Outlines
    joints: Joints
    constraints: Constraints


class Block(NamedTuple):
    """References to everything of a block of lanes."""

    table: Table  # lookup tables of the size
    given: Given  # the worlds before
    after: State  # is given the worlds after
    seen: Manifold | None  # is given the contacts, where somebody wants to see them
    scratch: Scratch

    @property
    def model(self) -> Model:
        return self.given.model
