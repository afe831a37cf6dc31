"""One physics step of a block of lanes: gravity, contacts, actuators, solver, integration.

The order is part of the reference's result (`jax2d.engine.PhysicsEngine.step`).
"""

from collections.abc import Callable
from typing import NamedTuple

from physics import actuator, body, contact, joint, manifold
from physics.body import Bodies
from physics.contact import Constraints
from physics.joint import Joints
from physics.lanes import Ref, each
from physics.manifold import Polygons
from physics.pairs import Table
from physics.types import SOLVER_ITERATIONS, Manifold, Model, Params, State


class Given(NamedTuple):
    """What a step reads."""

    model: Model
    before: State
    motor: Ref  # [joint, lane]: control of each joint's motor, in [-1, 1]
    thrust: Ref  # [thruster, lane]: control of each thruster, in [0, 1]


class Scratch(NamedTuple):
    """What a step works in."""

    bodies: Bodies
    polygons: Polygons
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


Stage = Callable[[Block, Params], None]


def fall(block: Block, params: Params) -> None:
    """Gravity into the velocities; where every polygon is."""
    body.start(block.model, block.given.before, block.scratch.bodies, params)
    manifold.outline_polygons(block.model, block.scratch.bodies, block.scratch.polygons)


def find_contacts(block: Block, params: Params) -> None:
    """Contacts of the pairs that come near each other, as constraints; they push with what they remember."""
    bodies, polygons, _, constraints = block.scratch
    contact.clear(constraints, block.after)
    if block.seen is not None:
        contact.see_nothing(block.seen)

    def found(kind: int, numbers: list, contacts: list) -> None:
        rank = contact.rank(constraints, kind, contacts)
        for group, (c, one) in enumerate(zip(numbers, contacts, strict=True), kind + (kind > 0)):
            contact.prepare(
                block.model,
                block.given.before,
                block.after,
                bodies,
                constraints,
                c,
                group,
                rank,
                block.table,
                one,
                params,
            )
            if block.seen is not None:
                contact.see(block.seen, block.model, bodies, c, block.table, one)

    manifold.find_contacts(block.model, bodies, polygons, block.table, found)
    contact.share_out(constraints, block.table)


def act(block: Block, params: Params) -> None:
    """Joints as constraints, motors, thrusters; then everything that pushes changes the velocities."""
    model, bodies, joints = block.model, block.scratch.bodies, block.scratch.joints
    joint.prepare(model, block.given.before, bodies, joints, params)
    actuator.drive_motors(model, bodies, joints, block.given.motor, params)
    actuator.fire_thrusters(model, block.given.before, bodies, block.given.thrust, params)
    joint.warm_start(model, bodies, joints)
    body.yield_all(model, bodies)


def solve(block: Block, params: Params) -> None:
    """Ten iterations of joints, then contacts."""
    bodies, _, joints, constraints = block.scratch

    def iteration(_):
        joint.solve(block.model, bodies, joints, params)
        contact.solve(block.model, bodies, constraints, block.table)

    each(SOLVER_ITERATIONS, iteration)


def integrate(block: Block, params: Params) -> None:
    """What the next step remembers, and where the bodies go."""
    bodies, _, joints, constraints = block.scratch
    contact.remember(block.after, constraints, block.table)
    joint.remember(block.after, joints)
    body.integrate(block.given.before, block.after, bodies, params)


STAGES: tuple[Stage, ...] = (fall, find_contacts, act, solve, integrate)


def step_block(block: Block, params: Params, stages: tuple[Stage, ...] = STAGES) -> None:
    """Advance the lanes of a block by `params.dt`."""
    for stage in stages:
        stage(block, params)
