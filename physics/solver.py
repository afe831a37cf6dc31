"""The order of the solver: warm start, then ten iterations of joints, polygon pairs, circle-polygon, circle-circle."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from physics import contact as contacts
from physics import joint as joints
from physics.motion import Motion
from physics.pairs import pairs_of
from physics.types import SOLVER_ITERATIONS, Manifold, Model, Params, State
from physics.vector import unvec


def solve(model: Model, state: State, manifold: Manifold, motion: Motion, params: Params) -> tuple[Motion, State]:
    """Bodies' motion after the solver, and `state` with the impulses that the next step starts from."""
    groups, impulses = _contact_groups(model, state, manifold, params)
    joint, joint_impulse = joints.prepare(model, state, params)

    for group, impulse in zip(groups, impulses, strict=True):
        motion = contacts.warm_start(model, motion, group, impulse)
    motion = joints.warm_start(motion, joint, joint_impulse)

    def iteration(carry, _):
        motion, joint_impulse, impulses = carry
        motion, joint_impulse = joints.solve(motion, joint, joint_impulse, params)
        arms = [contacts.arms(model, motion, group) for group in groups]
        solved = []
        for group, arm, impulse in zip(groups, arms, impulses, strict=True):
            motion, impulse = contacts.sweep(model, motion, group, arm, impulse, params)
            solved.append(impulse)
        return (motion, joint_impulse, solved), None

    carry = (motion, joint_impulse, impulses)
    (motion, joint_impulse, impulses), _ = jax.lax.scan(iteration, carry, None, length=SOLVER_ITERATIONS)
    return motion, replace(
        state,
        contact_active=manifold.active,
        contact_normal_impulse=jnp.concatenate([i.normal for i in impulses]),
        contact_tangent_impulse=jnp.concatenate([i.tangent for i in impulses]),
        joint_impulse=unvec(joint_impulse.linear),
        joint_angular_impulse=joint_impulse.angular,
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
