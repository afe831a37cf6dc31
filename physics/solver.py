"""The order of the solver: warm start, then ten iterations of joints, polygon pairs, circle-polygon, circle-circle."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from physics import contact as contacts
from physics import joint as joints
from physics.motion import Motion, inverse_masses
from physics.pairs import pairs_of
from physics.types import SOLVER_ITERATIONS, Manifold, Model, Params, State


def solve(model: Model, state: State, manifold: Manifold, motion: Motion, params: Params) -> tuple[Motion, State]:
    """Bodies' motion after the solver, and `state` with the impulses that the next step starts from."""
    groups, impulses = _contact_groups(model, state, manifold, params)
    joint, joint_impulse = joints.prepare(model, state, params)
    masses, bodies = inverse_masses(model), len(motion.velocity)

    arms = [contacts.arms(model, motion.position, group) for group in groups]
    pushes = [contacts.push(g, a, i, bodies) for g, a, i in zip(groups, arms, impulses, strict=True)]
    velocity = motion.velocity + masses * sum(pushes) + joints.warm_start(joint, joint_impulse)

    def iteration(carry, _):
        motion, joint_impulse, impulses = carry
        motion, joint_impulse = joints.solve(motion, joint, joint_impulse, params)
        velocity, solved = motion.velocity, []
        for group, impulse in zip(groups, impulses, strict=True):
            arm = contacts.arms(model, motion.position, group)
            velocity, impulse = contacts.sweep(masses, velocity, group, arm, impulse, params)
            solved.append(impulse)
        return (Motion(motion.position, velocity), joint_impulse, solved), None

    carry = (Motion(motion.position, velocity), joint_impulse, impulses)
    (motion, joint_impulse, impulses), _ = jax.lax.scan(iteration, carry, None, length=SOLVER_ITERATIONS)
    normal, tangent = jnp.concatenate(impulses, axis=1)
    return motion, replace(
        state,
        contact_active=manifold.active,
        contact_normal_impulse=normal,
        contact_tangent_impulse=tangent,
        joint_impulse=joint_impulse[:, :2],
        joint_angular_impulse=joint_impulse[:, 2],
    )


def _contact_groups(model: Model, state: State, manifold: Manifold, params: Params):
    """Constraints by kind, in solver order; the two points of polygon pairs are two groups."""
    pairs = pairs_of(model.size)
    n = len(pairs.polygon)
    either = manifold.active[:n] | manifold.active[n : 2 * n]
    groups, impulses, start = [], [], 0
    for pair in (pairs.polygon, pairs.polygon, pairs.circle_polygon, pairs.circle):
        at = slice(start, start + len(pair))
        start = at.stop
        if len(pair):
            touching = either if pair is pairs.polygon else manifold.active[at]
            group, impulse = contacts.prepare(model, state, manifold, pair, at, touching, params)
            groups.append(group)
            impulses.append(impulse)
    return groups, impulses
