"""One physics step of a block of lanes: gravity, contacts, actuators, solver, integration.

The order is part of the reference's result (`jax2d.engine.PhysicsEngine.step`).
"""

from collections.abc import Callable

from levelproof.physics import actuator, body, contact, joint, manifold
from levelproof.physics.block import Block
from levelproof.physics.lanes import each
from levelproof.physics.pairs import KIND_OF_GROUP
from levelproof.physics.types import SOLVER_ITERATIONS, Params

Stage = Callable[[Block, Params], None]


def fall(block: Block, params: Params) -> None:
    """Gravity into the velocities; where every polygon is."""
    body.start(block, params)
    manifold.outline_polygons(block)


def find_contacts(block: Block, params: Params) -> None:
    """Contacts of the pairs that come near each other, as constraints; they push with what they remember."""
    contact.clear(block)

    def found(kind: int, numbers: list, contacts: list[contact.Contact]) -> None:
        so_far = contact.count_touching(block, kind, contacts)
        for group, (c, one) in enumerate(zip(numbers, contacts, strict=True), KIND_OF_GROUP.index(kind)):
            contact.prepare(block, params, c, one, group, so_far)
            contact.see(block, c, one)

    manifold.find_contacts(block, found)
    contact.share_out(block)


def act(block: Block, params: Params) -> None:
    """Joints as constraints, motors, thrusters; then everything that pushes changes the velocities."""
    joint.prepare(block, params)
    actuator.drive_motors(block, params)
    actuator.fire_thrusters(block, params)
    joint.warm_start(block)
    body.yield_all(block)


def solve(block: Block, params: Params) -> None:
    """Ten iterations of joints, then contacts."""

    def iteration(_):
        joint.solve(block, params)
        contact.solve(block)

    each(SOLVER_ITERATIONS, iteration)


def integrate(block: Block, params: Params) -> None:
    """What the next step remembers, and where the bodies go."""
    contact.remember(block)
    joint.remember(block)
    body.integrate(block, params)


STAGES: tuple[Stage, ...] = (fall, find_contacts, act, solve, integrate)


def step_block(block: Block, params: Params, stages: tuple[Stage, ...] = STAGES) -> None:
    """Advance the lanes of a block by `params.dt`."""
    for stage in stages:
        stage(block, params)
