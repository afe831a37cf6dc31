"""One physics step: gravity, contacts, actuators, solver, integration.

The order is part of the reference's result (`jax2d.engine.PhysicsEngine.step`).
"""

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
    """References that a step reads."""

    model: Model
    before: State
    motor: Ref  # [joint, lane]: control of each joint's motor, in [-1, 1]
    thrust: Ref  # [thruster, lane]: control of each thruster, in [0, 1]


class Scratch(NamedTuple):
    """References that a step works in."""

    bodies: Bodies
    polygons: Polygons
    joints: Joints
    constraints: Constraints


def step_block(
    table: Table, given: Given, after: State, seen: Manifold | None, scratch: Scratch, params: Params
) -> None:
    """Advance the lanes of a block by `params.dt`.

    Args:
        table: lookup tables of the size.
        given: the worlds before.
        after: is given the worlds after.
        seen: is given the contacts, where somebody wants to see them.
        scratch: room to work in.
        params: constants of the engine.
    """
    model, before = given.model, given.before
    bodies, polygons, joints, constraints = scratch
    body.start(model, before, bodies, params)
    contact.clear(constraints, after)
    manifold.outline_polygons(model, bodies, polygons)
    if seen is not None:
        contact.see_nothing(seen)

    def found(kind: int, numbers: list, contacts: list) -> None:
        contact.count(constraints, kind, numbers, contacts)
        for c, one in zip(numbers, contacts, strict=True):
            contact.prepare(model, before, after, bodies, constraints, c, table, one, params)
            if seen is not None:
                contact.see(seen, model, bodies, c, table, one)

    manifold.find_contacts(model, bodies, polygons, table, found)
    contact.share_out(constraints, table)
    joint.prepare(model, before, bodies, joints, params)
    actuator.drive_motors(model, bodies, joints, given.motor, params)
    actuator.fire_thrusters(model, before, bodies, given.thrust, params)
    joint.warm_start(model, bodies, joints)
    body.yield_to(model, bodies)

    def iteration(_):
        joint.solve(model, bodies, joints, params)
        contact.solve(model, bodies, constraints, table)

    each(SOLVER_ITERATIONS, iteration)
    contact.remember(after, constraints)
    joint.remember(after, joints)
    body.integrate(before, after, bodies, params)
