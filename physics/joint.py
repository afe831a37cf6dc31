"""The joint constraint: two anchors held together; angles held (fixed joint) or limited (revolute joint).

Facts: `jax2d.joint`. Joints are solved one after another; each also moves its bodies towards each other.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics.motion import Motion, select, spread
from physics.types import Model, Params, State
from physics.vector import Vec, nonzero, spin, vec


class Joint(NamedTuple):
    """Every joint, constant over a step; components [joint, lane]. Masses are 0 where it may not act."""

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


class JointImpulse(NamedTuple):
    linear: Vec
    angular: Float[Array, "joint lane"]


def joint_angle(model: Model, state: State) -> Float[Array, "joint lane"]:
    """Angle of body b relative to body a, from the joint's resting angle, rad."""
    return jnp.stack(
        [select(state.rotation, model.joint_b[j]) - select(state.rotation, model.joint_a[j]) for j in range(model.size.joints)]
    ) - (model.joint_rotation)


def can_act(model: Model) -> Bool[Array, "joint lane"]:
    """Active, with active bodies, not both immovable."""
    each = lambda x, body: jnp.stack([select(x, body[j]) for j in range(model.size.joints)])
    movable = lambda body: each(model.inverse_mass, body) != 0
    alive = each(model.active, model.joint_a) & each(model.active, model.joint_b)
    return model.joint_active & alive & (movable(model.joint_a) | movable(model.joint_b))


def prepare(model: Model, state: State, params: Params) -> tuple[Joint, JointImpulse]:
    """The joints as constraints, with their warm-start impulses."""
    each = lambda x, body: jnp.stack([select(x, body[j]) for j in range(model.size.joints)])
    acts = can_act(model)
    cos, sin = jnp.cos(state.rotation), jnp.sin(state.rotation)

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
        a=jnp.broadcast_to(model.joint_a, angle.shape),
        b=jnp.broadcast_to(model.joint_b, angle.shape),
        arm_a=arm_a,
        arm_b=arm_b,
        mass_a=mass_a,
        mass_b=mass_b,
        inertia_a=inertia_a,
        inertia_b=inertia_b,
        weight_a=weight_a,
        fixed=jnp.broadcast_to(model.joint_fixed, angle.shape),
        turns=model.joint_fixed | (model.joint_limited & (beyond != 0)),
        angle_bias=jnp.where(model.joint_fixed, angle * params.fixed_joint_bias, beyond * params.joint_limit_bias),
    )
    return joint, JointImpulse(vec(state.joint_impulse), state.joint_angular_impulse)


def warm_start(motion: Motion, joint: Joint, impulse: JointImpulse) -> Motion:
    """Apply the impulses that the last step ended with, all joints at once."""
    p, turn = impulse.linear, impulse.angular
    pull_a, pull_b = p.scale(joint.mass_a), p.scale(-joint.mass_b)
    turn_a = joint.inertia_a * (joint.arm_a.cross(p) + turn)
    turn_b = -joint.inertia_b * (joint.arm_b.cross(p) + turn)
    each = range(joint.acts.shape[0])

    def total(x, at_a, at_b):
        terms = [(joint.a[j], at_a[j]) for j in each] + [(joint.b[j], at_b[j]) for j in each]
        return x + spread(x.shape[0], terms)

    v = Vec(total(motion.velocity.x, pull_a.x, pull_b.x), total(motion.velocity.y, pull_a.y, pull_b.y))
    return Motion(motion.position, v, total(motion.angular_velocity, turn_a, turn_b))


def solve(motion: Motion, joint: Joint, impulse: JointImpulse, params: Params) -> tuple[Motion, JointImpulse]:
    """One pass over the joints, one after another. `joint` and `impulse` as prepared: [joint, lane]."""
    done = []
    for j in range(joint.acts.shape[0]):
        one = lambda x, j=j: x.map(lambda c: c[j]) if isinstance(x, Vec) else x[j]
        motion, change = _solve_one(motion, Joint(*map(one, joint)), JointImpulse(*map(one, impulse)), params)
        done.append(change)
    stack = lambda *xs: jnp.stack(xs)
    linear = Vec(stack(*(d.linear.x for d in done)), stack(*(d.linear.y for d in done)))
    return motion, JointImpulse(linear, stack(*(d.angular for d in done)))


def _solve_one(motion: Motion, joint: Joint, impulse: JointImpulse, params: Params) -> tuple[Motion, JointImpulse]:
    x_a, x_b = (motion.position.map(lambda x, body=body: select(x, body)) for body in (joint.a, joint.b))
    v_a, v_b = (motion.velocity.map(lambda x, body=body: select(x, body)) for body in (joint.a, joint.b))
    w_a, w_b = (select(motion.angular_velocity, body) for body in (joint.a, joint.b))

    # anchors first, then their difference: a gap of exactly zero must come out as zero, because the
    # angle correction below looks at signs
    anchor_a, anchor_b = x_a + joint.arm_a, x_b + joint.arm_b
    gap = anchor_b - anchor_a
    point = anchor_a.scale(joint.weight_a) + anchor_b.scale(1 - joint.weight_a)
    drift = v_b + spin(w_b, point - x_b) - v_a - spin(w_a, point - x_a)
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

    step = gap.scale(params.joint_bias_position / nonzero(joint.mass_a + joint.mass_b))

    def moved(x, at_a, at_b):
        return x + spread(x.shape[0], [(joint.a, at_a), (joint.b, at_b)])

    def moved_vec(x, at):
        a, b = at.scale(joint.mass_a), at.scale(-joint.mass_b)
        return Vec(moved(x.x, a.x, b.x), moved(x.y, a.y, b.y))

    motion = Motion(
        moved_vec(motion.position, step),
        moved_vec(motion.velocity, pull),
        moved(motion.angular_velocity, turn_a + joint.inertia_a * twist, turn_b - joint.inertia_b * twist),
    )
    keep = lambda x: jnp.where(joint.acts, x, 0.0)
    linear = (impulse.linear + pull).map(keep)
    return motion, JointImpulse(linear, jnp.where(joint.acts & joint.fixed, impulse.angular + twist, 0.0))
