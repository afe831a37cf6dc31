"""The order of the solver: warm start, then ten iterations of joints, polygon pairs, circle-polygon, circle-circle."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from physics import contact as contacts
from physics import joint as joints
from physics import slots as slotted
from physics.contact import Contact
from physics.motion import Motion, inverse_masses
from physics.pairs import pairs_of
from physics.slots import SLOTS_FROM, SlottedContacts, batches_of
from physics.types import SOLVER_ITERATIONS, Manifold, Model, Params, State

# Contacts that are solved together: of all pairs of a kind where a solver batch or two hold them, else in slots
Group = Contact | SlottedContacts


def solve(model: Model, state: State, manifold: Manifold, motion: Motion, params: Params) -> tuple[Motion, State]:
    """Bodies' motion after the solver, and `state` with the impulses that the next step starts from."""
    groups, impulses, warmth = _contact_groups(model, state, manifold, motion, params)
    joint, joint_impulse = joints.prepare(model, state, params)
    masses = inverse_masses(model)
    velocity = motion.velocity + masses * warmth + joints.warm_start(len(masses), joint, joint_impulse)

    def iteration(carry, _):
        motion, joint_impulse, impulses = carry
        motion, joint_impulse = joints.solve(motion, joint, joint_impulse, params)
        solved = []
        for group, impulse in zip(groups, impulses, strict=True):
            if isinstance(group, SlottedContacts):
                motion, impulse = slotted.sweep(masses, motion, group, impulse)
            else:
                for batch in range(SLOTS_FROM - 1 if group.batch is not None else 1):
                    impulse, change = contacts.solve(motion, group, impulse, batch)
                    motion = motion._replace(velocity=motion.velocity + masses * change)
            solved.append(impulse)
        return (motion, joint_impulse, solved), None

    carry = (Motion(motion.position, velocity), joint_impulse, impulses)
    (motion, joint_impulse, impulses), _ = jax.lax.scan(iteration, carry, None, length=SOLVER_ITERATIONS)
    by_pair = [
        slotted.scatter(group.slots, impulse) if isinstance(group, SlottedContacts) else impulse
        for group, impulse in zip(groups, impulses, strict=True)
    ]
    normal, tangent = jnp.concatenate(by_pair, axis=1)
    return motion, replace(
        state,
        contact_active=manifold.active,
        contact_normal_impulse=normal,
        contact_tangent_impulse=tangent,
        joint_impulse=joint_impulse[:, :2],
        joint_angular_impulse=joint_impulse[:, 2],
    )


def _contact_groups(
    model: Model, state: State, manifold: Manifold, motion: Motion, params: Params
) -> tuple[list[Group], list[Array], Float[Array, "body 3 lane"]]:
    """Constraints by kind, in solver order; their impulses from the last step; what these do to each body.

    The two points of polygon pairs are two groups, of the same batches.
    """
    pairs, bodies = pairs_of(model.size), len(motion.velocity)
    n = len(pairs.polygon)
    either = manifold.active[:n] | manifold.active[n : 2 * n]
    groups, impulses, warmth, start = [], [], jnp.zeros_like(motion.velocity), 0
    for pair in (pairs.polygon, pairs.polygon, pairs.circle_polygon, pairs.circle):
        at = slice(start, start + len(pair))
        start = at.stop
        if not len(pair):
            continue
        touching = either if pair is pairs.polygon else manifold.active[at]
        batch = batches_of(touching, pair) if 1 < pair.batches < SLOTS_FROM else None
        contact, impulse = contacts.prepare(model, state, manifold, pair, at, batch, params)
        warmth += contacts.push(contact, contacts.arms(motion.position, contact), impulse, bodies)
        group: Group = contact
        if pair.batches >= SLOTS_FROM:
            slots = slotted.assign(touching, pair)
            group, impulse = slotted.move(slots, contact), slotted.gather(slots, jnp.moveaxis(impulse, 0, 1))
        groups.append(group)
        impulses.append(impulse)
    return groups, impulses, warmth
