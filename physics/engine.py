"""One physics step of a block of lanes: gravity, contacts, actuators, solver, integration.

The stages work on velocities and move bodies last (semi-implicit Euler):

    fall           v += dt g
    find_contacts  which bodies touch; their warm-start impulses go to `push`
    act            motors, thrusters and the joints' warm start go to `push`; then all of `push` goes to v
    solve          ten times: joints, one after another; contacts, batch by batch
    integrate      x += dt v; impulses are stored for the next step's warm start

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
    """Add gravity to the velocities, and place every polygon's outline in the world."""
    body.start(block, params)
    manifold.outline_polygons(block)


def find_contacts(block: Block, params: Params) -> None:
    """Detect contacts, prepare them as constraints, and warm-start them."""
    contact.clear(block)

    def constrain(kind: int, indices: list, contacts: list[contact.Contact]) -> None:
        so_far = contact.count_touching(block, kind, contacts)
        for group, (c, one) in enumerate(zip(indices, contacts, strict=True), KIND_OF_GROUP.index(kind)):
            contact.prepare(block, params, c, one, group, so_far)
            contact.record(block, c, one)

    manifold.find_contacts(block, constrain)
    contact.assign_batches(block)


def act(block: Block, params: Params) -> None:
    """Prepare joints, drive motors, fire thrusters, warm-start joints; then apply all impulses so far."""
    joint.prepare(block, params)
    actuator.drive_motors(block, params)
    actuator.fire_thrusters(block, params)
    joint.warm_start(block)
    body.yield_all(block)


def solve(block: Block, params: Params) -> None:
    """Run the solver's iterations, each over joints and then contacts."""

    def iteration(_):
        joint.solve(block, params)
        contact.solve(block)

    each(SOLVER_ITERATIONS, iteration)


def integrate(block: Block, params: Params) -> None:
    """Store impulses for the next step, and move the bodies."""
    contact.remember(block)
    joint.remember(block)
    body.integrate(block, params)


STAGES: tuple[Stage, ...] = (fall, find_contacts, act, solve, integrate)


def step_block(block: Block, params: Params, stages: tuple[Stage, ...] = STAGES) -> None:
    """Advance the lanes of a block by `params.dt`."""
    for stage in stages:
        stage(block, params)
