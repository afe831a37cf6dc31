"""The data of one step for a block of lanes: references to the worlds before and after, and to scratch memory.

The annotations are the only place where shapes and dtypes are stated; `physics.buffers` allocates scratch memory from
them.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from levelproof.physics.lanes import Ref
from levelproof.physics.pairs import Table
from levelproof.physics.types import Manifold, Model, State


class Inputs(NamedTuple):
    """Inputs of a step."""

    model: Model
    before: State
    motor: Float[Ref, "joint lane"]  # control of each joint's motor, in [-1, 1]
    thrust: Float[Ref, "thruster lane"]  # control of each thruster, in [0, 1]


class Bodies(NamedTuple):
    """The bodies' motion, and the impulses not yet applied to it."""

    motion: Float[Ref, "body 5 lane"]  # position x, y (m), velocity x, y (m/s), angular velocity (rad/s)
    push: Float[Ref, "body 3 lane"]  # sum of impulses x, y (N s), angular (N m s), since they were last applied
    turn: Float[Ref, "body 2 lane"]  # cosine and sine of the rotation


class Outlines(NamedTuple):
    """The polygons' geometry, with x and y in separate rows."""

    start: Float[Ref, "2 polygon vertex lane"]  # first vertex of each face, in the polygon's frame
    edge: Float[Ref, "2 polygon vertex lane"]  # from that vertex to the next
    along: Float[Ref, "2 polygon vertex lane"]  # unit vector along the edge
    length: Float[Ref, "polygon vertex lane"]
    support: Float[Ref, "polygon vertex lane"]  # largest projection on the face's normal, from the centre; or FAR
    vertex: Float[Ref, "2 polygon vertex lane"]  # in the world frame
    normal: Float[Ref, "2 polygon vertex lane"]  # outward unit normal of each face, in the world
    box: Float[Ref, "polygon 4 lane"]  # lowest x, y and highest x, y


class Joints(NamedTuple):
    """Joints as constraints: constant during a step, except the impulses. Masses are 0 where a joint may not act."""

    acts: Bool[Ref, "joint lane"]  # active, with active bodies, not both immovable
    turns: Bool[Ref, "joint lane"]  # whether an angular impulse applies
    arms: Float[Ref, "joint 4 lane"]  # from each body's centre to its anchor, in the world: a's x, y, then b's
    masses: Float[Ref, "joint 4 lane"]  # inverse masses of a and b, inverse inertias of a and b
    weight: Float[Ref, "joint lane"]  # share of a's anchor in the joint's point: the heavier body decides
    angle: Float[Ref, "joint lane"]  # angle of b relative to a, from the joint's resting angle, rad
    angle_bias: Float[Ref, "joint lane"]  # rad/s, angular velocity that corrects the angle
    impulse: Float[Ref, "joint 3 lane"]  # accumulated, x, y (N s) and angular (N m s)


class Constraints(NamedTuple):
    """Contacts as constraints; only rows of contacts that push in some lane are ever read. Groups: see `pairs`."""

    geometry: Float[Ref, "contact 4 lane"]  # normal x, y, point x, y
    effort: Float[Ref, "contact 5 lane"]  # target (m/s along the normal), friction, both inverse masses, inertias
    impulse: Float[Ref, "contact 2 lane"]  # accumulated, normal and tangent, N s
    batch: Float[Ref, "contact lane"]  # index of the solver batch; NO_BATCH where it does not push
    touching: Float[Ref, "kind lane"]  # number of touching pairs
    acting: Int[Ref, "contact"]  # contacts that push in some lane; each group starts at its first contact
    counts: Int[Ref, "group"]  # number of contacts in `acting`
    listed: Int[Ref, "listing"]  # indices of the contacts that push, grouped by solver batch
    ends: Int[Ref, "boundary"]  # where each solver batch begins and ends in `listed`


class Scratch(NamedTuple):
    """Scratch memory of a step."""

    bodies: Bodies
    outlines: Outlines
    joints: Joints
    constraints: Constraints


class Block(NamedTuple):
    """References to all data of a block of lanes."""

    table: Table  # lookup tables of the size
    inputs: Inputs  # the worlds before
    after: State  # receives the worlds after the step
    contacts: Manifold | None  # receives the contacts; None unless the caller asked for them
    scratch: Scratch

    @property
    def model(self) -> Model:
        return self.inputs.model
