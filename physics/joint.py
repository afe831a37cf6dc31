"""The joint constraint: two anchors held together; the angle held (fixed joint) or limited (revolute joint).

A joint pins a point of body a to a point of body b. With the anchors' world positions p_a and p_b, the gap is
g = p_b - p_a and the anchors drift apart with d = v_b + w_b x r_b - v_a - w_a x r_a.

**Linear part.** Box2D solves the two equations d = 0 with a 2x2 matrix. The reference solves one, along the direction
of the drift, with that direction's effective mass, and adds the gap to what must be undone:

    impulse = stiffness * (d + joint_bias_velocity * g) / (1/m_a + 1/m_b + (r_a x e)^2 / I_a + (r_b x e)^2 / I_b),
    e = d / |d|

A stiffness below 1 under-relaxes: the joints of a chain disturb each other, and full impulses would overshoot.

**Position.** Velocities alone leave joints drifting apart, so each iteration also moves the bodies by the share
joint_bias_position of the gap, the lighter body farther. Bodies therefore move *within* the solver, and contacts
recompute their lever arms.

**Angle.** A fixed joint pulls b back to its resting angle; a revolute joint with limits pulls b back to a limit that it
has passed, but only while the bodies do not already turn back (`corrects`).

Joints are solved one after another, each seeing what the last one changed (Gauss-Seidel).
Source: `jax2d.joint`. The accumulated linear impulse is never reset there, nor here.
"""

import jax.numpy as jnp

from levelproof.physics.block import Block
from levelproof.physics.body import position, velocity
from levelproof.physics.lanes import NOBODY, Scalar, anywhere, each, gather_pair, scatter_add, when
from levelproof.physics.types import FIXED_POLYGONS, Params
from levelproof.physics.vector import Vec, nonzero, spin


def prepare(block: Block, params: Params) -> None:
    """Prepare every joint as a constraint: arms in the world, masses, angle and its bias."""
    model, before, joints = block.model, block.inputs.before, block.scratch.joints

    def one(j):
        joints.acts[j] = jnp.zeros_like(joints.acts[j])
        joints.impulse[j] = jnp.stack(
            [before.joint_impulse[j, 0], before.joint_impulse[j, 1], before.joint_angular_impulse[j]]
        )
        when(anywhere(model.joint_active[j]), lambda: _prepare_one(block, params, j))

    each(joints.acts.shape[0], one)


def _prepare_one(block: Block, params: Params, j: Scalar) -> None:
    model, before, bodies, joints = block.model, block.inputs.before, block.scratch.bodies, block.scratch.joints

    def read(i):
        alive = model.active[i].astype(bodies.turn.dtype)
        mass = [model.inverse_mass[i], model.inverse_inertia[i]]
        return jnp.stack([alive, *mass, before.rotation[i], *bodies.turn[i]])

    row_a, row_b = gather_pair(bodies.motion.shape[0], read, model.joint_a[j], model.joint_b[j])
    (alive_a, mass_a, inertia_a, rotation_a, *turn_a), (alive_b, mass_b, inertia_b, rotation_b, *turn_b) = row_a, row_b
    acts = model.joint_active[j] & (alive_a * alive_b != 0) & ((mass_a != 0) | (mass_b != 0))
    mass_a, mass_b, inertia_a, inertia_b = (jnp.where(acts, x, 0.0) for x in (mass_a, mass_b, inertia_a, inertia_b))
    arm_a = Vec(*model.joint_anchor_a[j]).rotate(*turn_a)
    arm_b = Vec(*model.joint_anchor_b[j]).rotate(*turn_b)
    heavy_a, heavy_b = 1 / nonzero(mass_a), 1 / nonzero(mass_b)
    weight = jnp.where(mass_a == 0, 1.0, jnp.where(mass_b == 0, 0.0, heavy_a / (heavy_a + heavy_b)))

    angle = rotation_b - rotation_a - model.joint_rotation[j]
    beyond = angle - jnp.clip(angle, model.joint_min[j], model.joint_max[j])
    fixed = model.joint_fixed[j]
    joints.acts[j] = acts
    joints.turns[j] = fixed | (model.joint_limited[j] & (beyond != 0))
    joints.arms[j] = jnp.stack([*arm_a, *arm_b])
    joints.masses[j] = jnp.stack([mass_a, mass_b, inertia_a, inertia_b])
    joints.weight[j] = weight
    joints.angle[j] = angle
    joints.angle_bias[j] = jnp.where(fixed, angle * params.fixed_joint_bias, beyond * params.joint_limit_bias)


def warm_start(block: Block) -> None:
    """Apply the impulses that the last step ended with."""
    model, bodies, joints = block.model, block.scratch.bodies, block.scratch.joints

    def one(j):
        x, y, turn = jnp.where(joints.acts[j], joints.impulse[j], 0.0)
        a_x, a_y, b_x, b_y = joints.arms[j]
        on_a = jnp.stack([x, y, Vec(a_x, a_y).cross(Vec(x, y)) + turn])
        on_b = jnp.stack([-x, -y, -(Vec(b_x, b_y).cross(Vec(x, y)) + turn)])
        a, b = (jnp.where(joints.acts[j], body[j], NOBODY) for body in (model.joint_a, model.joint_b))
        scatter_add(bodies.push, (a, on_a), (b, on_b), first=FIXED_POLYGONS)

    each(joints.acts.shape[0], lambda j: when(anywhere(joints.acts[j]), lambda: one(j)))


def solve(block: Block, params: Params) -> None:
    """Run one pass over the joints, one after another."""
    acts = block.scratch.joints.acts
    each(acts.shape[0], lambda j: when(anywhere(acts[j]), lambda: _solve_one(block, params, j)))


def _solve_one(block: Block, params: Params, j: Scalar) -> None:
    model, bodies, joints = block.model, block.scratch.bodies, block.scratch.joints
    a, b = model.joint_a[j], model.joint_b[j]
    motion_a, motion_b = gather_pair(bodies.motion.shape[0], lambda i: bodies.motion[i], a, b)
    mass_a, mass_b, inertia_a, inertia_b = joints.masses[j]
    a_x, a_y, b_x, b_y = joints.arms[j]
    arm_a, arm_b, fixed = Vec(a_x, a_y), Vec(b_x, b_y), model.joint_fixed[j]
    x_a, x_b, w_a, w_b = position(motion_a), position(motion_b), motion_a[4], motion_b[4]

    # Subtract the anchors, not the arms and the centres: a gap of exactly zero must come out as zero, because the
    # angle correction below compares signs
    anchor_a, anchor_b = x_a + arm_a, x_b + arm_b
    gap = anchor_b - anchor_a
    point = anchor_a.scale(joints.weight[j]) + anchor_b.scale(1 - joints.weight[j])
    drift = velocity(motion_b) + spin(w_b, point - x_b) - velocity(motion_a) - spin(w_a, point - x_a)
    direction = drift.scale(1 / nonzero(drift.norm()))
    mass = (
        mass_a
        + mass_b
        + jnp.square(arm_a.cross(direction)) * inertia_a
        + jnp.square(arm_b.cross(direction)) * inertia_b
    )
    pull = (drift + gap.scale(params.joint_bias_velocity)).scale(params.joint_stiffness / nonzero(mass))
    turn_a, turn_b = inertia_a * arm_a.cross(pull), -inertia_b * arm_b.cross(pull)

    spin_difference = w_b + turn_b - w_a - turn_a
    # no correction beyond a limit that the bodies are already leaving (driven by a motor, say)
    corrects = fixed | (jnp.sign(spin_difference) == jnp.sign(joints.angle_bias[j]))
    twist = (spin_difference + joints.angle_bias[j]) / nonzero(inertia_a + inertia_b)
    twist = jnp.where(joints.turns[j] & corrects, twist, 0.0)
    turn_a, turn_b = turn_a + inertia_a * twist, turn_b - inertia_b * twist

    closer = gap.scale(params.joint_bias_position / nonzero(mass_a + mass_b))
    on_a = jnp.stack([*closer.scale(mass_a), *pull.scale(mass_a), turn_a])
    on_b = jnp.stack([*closer.scale(-mass_b), *pull.scale(-mass_b), turn_b])
    a, b = (jnp.where(joints.acts[j], body, NOBODY) for body in (a, b))
    scatter_add(bodies.motion, (a, on_a), (b, on_b), first=FIXED_POLYGONS)
    x, y, angular = joints.impulse[j]
    joints.impulse[j] = jnp.stack([x + pull.x, y + pull.y, jnp.where(fixed, angular + twist, 0.0)])


def remember(block: Block) -> None:
    """Store the accumulated impulses for the warm start of the next step."""
    after, joints = block.after, block.scratch.joints

    def write(j):
        x, y, turn = jnp.where(joints.acts[j], joints.impulse[j], 0.0)
        after.joint_impulse[j] = jnp.stack([x, y])
        after.joint_angular_impulse[j] = turn

    each(joints.acts.shape[0], write)
