"""The joint constraint: two anchors held together; angles held (fixed joint) or limited (revolute joint).

Facts: `jax2d.joint`. Joints are solved one after another; each also moves its bodies towards each other.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics.motion import Motion, add, placed, select
from physics.types import Model, Params, State
from physics.vector import Vec, nonzero, spin, stored, vec


class Joint(NamedTuple):
    """Every joint, constant over a step; leaves [joint, ..., lane]. Masses are 0 where it may not act."""

    acts: Bool[Array, "joint lane"]
    a: Int[Array, "joint lane"]
    b: Int[Array, "joint lane"]
    arm_a: Vec  # from the body's centre to its anchor, in the world
    arm_b: Vec
    mass_a: Array  # inverse
    mass_b: Array
    inertia_a: Array  # inverse
    inertia_b: Array
    weight_a: Array  # share of a's anchor in the joint's point: the heavier body decides
    fixed: Bool[Array, "joint lane"]
    turns: Bool[Array, "joint lane"]  # whether an angular impulse applies
    angle_bias: Array  # rad/s that the angle asks for


def joint_angle(model: Model, state: State) -> Float[Array, "joint lane"]:
    """Angle of body b relative to body a, from the joint's resting angle, rad."""
    angle = lambda body: jnp.stack([select(state.rotation, b) for b in body])
    return angle(model.joint_b) - angle(model.joint_a) - model.joint_rotation


def can_act(model: Model) -> Bool[Array, "joint lane"]:
    """Active, with active bodies, not both immovable."""
    each = lambda x, body: jnp.stack([select(x, b) for b in body])
    movable = lambda body: each(model.inverse_mass, body) != 0
    alive = each(model.active, model.joint_a) & each(model.active, model.joint_b)
    return model.joint_active & alive & (movable(model.joint_a) | movable(model.joint_b))


def prepare(model: Model, state: State, params: Params) -> tuple[Joint, Float[Array, "joint 3 lane"]]:
    """The joints as constraints, with their warm-start impulses (x, y, angular)."""
    acts, lanes = can_act(model), state.rotation.shape[-1]
    cos, sin = jnp.cos(state.rotation), jnp.sin(state.rotation)
    each = lambda x, body: jnp.stack([select(x, b) for b in body])

    def side(body, anchor):
        masses = (jnp.where(acts, each(x, body), 0.0) for x in (model.inverse_mass, model.inverse_inertia))
        return vec(anchor).rotate(each(cos, body), each(sin, body)), *masses

    arm_a, mass_a, inertia_a = side(model.joint_a, model.joint_anchor_a)
    arm_b, mass_b, inertia_b = side(model.joint_b, model.joint_anchor_b)
    heavy_a, heavy_b = 1 / nonzero(mass_a), 1 / nonzero(mass_b)
    weight_a = jnp.where(mass_a == 0, 1.0, jnp.where(mass_b == 0, 0.0, heavy_a / (heavy_a + heavy_b)))

    angle = joint_angle(model, state)
    beyond = angle - jnp.clip(angle, model.joint_min, model.joint_max)
    joint = Joint(
        acts=acts,
        a=model.joint_a,
        b=model.joint_b,
        arm_a=arm_a,
        arm_b=arm_b,
        mass_a=mass_a,
        mass_b=mass_b,
        inertia_a=inertia_a,
        inertia_b=inertia_b,
        weight_a=weight_a,
        fixed=model.joint_fixed,
        turns=model.joint_fixed | (model.joint_limited & (beyond != 0)),
        angle_bias=jnp.where(model.joint_fixed, angle * params.fixed_joint_bias, beyond * params.joint_limit_bias),
    )
    joint = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), joint)
    return joint, jnp.concatenate([state.joint_impulse, state.joint_angular_impulse[:, None]], axis=1)


def warm_start(bodies: int, joint: Joint, impulse: Float[Array, "joint 3 lane"]) -> Float[Array, "body 3 lane"]:
    """The change of velocity by the impulses that the last step ended with, all joints at once."""
    p, turn = vec(impulse), impulse[:, 2]
    on_a = (joint.mass_a * p.x, joint.mass_a * p.y, joint.inertia_a * (joint.arm_a.cross(p) + turn))
    on_b = (-joint.mass_b * p.x, -joint.mass_b * p.y, -joint.inertia_b * (joint.arm_b.cross(p) + turn))
    return add(bodies, joint.a, jnp.stack(on_a, axis=1), joint.b, jnp.stack(on_b, axis=1))


def solve(
    motion: Motion, joints: Joint, impulses: Float[Array, "joint 3 lane"], params: Params
) -> tuple[Motion, Float[Array, "joint 3 lane"]]:
    """One pass over the joints, one after another."""

    def solve_next(motion, one):
        joint, impulse = one
        return _solve_one(motion, joint, impulse, params)

    return jax.lax.scan(solve_next, motion, (joints, impulses))


def _solve_one(
    motion: Motion, joint: Joint, impulse: Float[Array, "3 lane"], params: Params
) -> tuple[Motion, Float[Array, "3 lane"]]:
    x_a, x_b = (Vec(*select(motion.position, body)) for body in (joint.a, joint.b))
    (*v_a, w_a), (*v_b, w_b) = (select(motion.velocity, body) for body in (joint.a, joint.b))

    # anchors first, then their difference: a gap of exactly zero must come out as zero, because the
    # angle correction below looks at signs
    anchor_a, anchor_b = x_a + joint.arm_a, x_b + joint.arm_b
    gap = anchor_b - anchor_a
    point = anchor_a.scale(joint.weight_a) + anchor_b.scale(1 - joint.weight_a)
    drift = Vec(*v_b) + spin(w_b, point - x_b) - Vec(*v_a) - spin(w_a, point - x_a)
    direction = drift.scale(1 / nonzero(drift.norm()))
    mass = (
        joint.mass_a
        + joint.mass_b
        + jnp.square(joint.arm_a.cross(direction)) * joint.inertia_a
        + jnp.square(joint.arm_b.cross(direction)) * joint.inertia_b
    )
    pull = (drift + gap.scale(params.joint_bias_velocity)).scale(params.joint_stiffness / nonzero(mass))
    turn_a, turn_b = joint.inertia_a * joint.arm_a.cross(pull), -joint.inertia_b * joint.arm_b.cross(pull)

    spin_difference = w_b + turn_b - w_a - turn_a
    # a limit that is already being left (by a motor, say) gets no correction
    corrects = joint.fixed | (jnp.sign(spin_difference) == jnp.sign(joint.angle_bias))
    twist = (spin_difference + joint.angle_bias) / nonzero(joint.inertia_a + joint.inertia_b)
    twist = jnp.where(joint.turns & corrects, twist, 0.0)
    turn_a, turn_b = turn_a + joint.inertia_a * twist, turn_b - joint.inertia_b * twist

    closer = gap.scale(params.joint_bias_position / nonzero(joint.mass_a + joint.mass_b))

    def moved(x, row_a, row_b):
        on_a, on_b = stored(jnp.stack([jnp.stack(row_a), jnp.stack(row_b)]))
        return x + placed(len(x), joint.a, on_a) + placed(len(x), joint.b, on_b)

    motion = Motion(
        moved(motion.position, closer.scale(joint.mass_a), closer.scale(-joint.mass_b)),
        moved(motion.velocity, (*pull.scale(joint.mass_a), turn_a), (*pull.scale(-joint.mass_b), turn_b)),
    )
    angular = jnp.where(joint.fixed, impulse[2] + twist, 0.0)
    return motion, jnp.where(joint.acts, jnp.stack([impulse[0] + pull.x, impulse[1] + pull.y, angular]), 0.0)
