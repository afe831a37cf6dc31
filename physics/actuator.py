"""Actuators: motors turn the bodies of a revolute joint, thrusters push one body.

A motor is a speed control with a torque limit: the torque is power * tanh(decay * error in speed), so it saturates far
from the commanded speed and fades close to it. Within `motor_limit_zone` of a joint limit it weakens linearly to zero;
at full torque it would fight the limit's correction in every step.

Sources: `jax2d.joint.apply_motor`, `jax2d.engine`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from levelproof.physics.block import Block
from levelproof.physics.lanes import NOBODY, Scalar, anywhere, each, gather_pair, scatter_add, when
from levelproof.physics.trigonometry import cos_sin, tanh
from levelproof.physics.types import FIXED_POLYGONS, Params
from levelproof.physics.vector import Vec


def drive_motors(block: Block, params: Params) -> None:
    """Add the motors' angular impulses, which drive each joint to its commanded speed."""
    model, joints, control = block.model, block.scratch.joints, block.inputs.motor

    def one(j):
        runs = joints.acts[j] & model.motor_on[j] & (control[j] != 0) & ~model.joint_fixed[j]
        when(anywhere(runs), lambda: _drive(block, params, j, runs))

    each(joints.acts.shape[0], one)


def _drive(block: Block, params: Params, j: Scalar, runs: Bool[Array, " lane"]) -> None:
    model, bodies, joints, control = block.model, block.scratch.bodies, block.scratch.joints, block.inputs.motor
    a, b = model.joint_a[j], model.joint_b[j]
    motion_a, motion_b = gather_pair(bodies.motion.shape[0], lambda i: bodies.motion[i], a, b)
    _, _, inertia_a, inertia_b = joints.masses[j]
    both = inertia_a + inertia_b
    power = params.motor_power * params.dt * model.motor_power[j] / jnp.where(both == 0, 1.0, both)
    excess = motion_b[4] - motion_a[4] - model.motor_speed[j] * control[j] * params.motor_speed

    zone, angle = params.motor_limit_zone, joints.angle[j]
    beyond = angle - jnp.clip(angle, model.joint_min[j] + zone, model.joint_max[j] - zone)
    towards_limit = model.joint_limited[j] & (beyond != 0) & (jnp.sign(beyond) == jnp.sign(control[j]))
    power = power * jnp.where(towards_limit, jnp.maximum(0.0, 1 - jnp.abs(beyond) / zone), 1.0)
    turn = power * tanh(excess * params.motor_decay)
    none = jnp.zeros_like(turn)
    a, b = (jnp.where(runs, body, NOBODY) for body in (a, b))
    on_a, on_b = jnp.stack([none, none, turn]), jnp.stack([none, none, -turn])
    scatter_add(bodies.push, (a, on_a), (b, on_b), first=FIXED_POLYGONS)


def fire_thrusters(block: Block, params: Params) -> None:
    """Add the thrusters' impulses: a force on one body, along the thruster, at its mount."""
    model, control = block.model, block.inputs.thrust

    def one(t):
        force = model.thruster_power[t] * model.thruster_active[t] * params.thruster_power * control[t] * params.dt
        when(anywhere(force != 0), lambda: _fire(block, t, force))

    each(model.thruster_active.shape[0], one)


def _fire(block: Block, t: Scalar, force: Float[Array, " lane"]) -> None:
    model, before, bodies = block.model, block.inputs.before, block.scratch.bodies
    body = model.thruster_body[t]
    turn, _ = gather_pair(
        bodies.motion.shape[0], lambda i: jnp.stack([*bodies.turn[i], before.rotation[i]]), body, body
    )
    cos, sin, rotation = turn
    arm = Vec(*model.thruster_position[t]).rotate(cos, sin)
    push = Vec(*cos_sin(model.thruster_rotation[t] + rotation)).scale(force)
    body = jnp.where(force != 0, body, NOBODY)
    scatter_add(bodies.push, (body, jnp.stack([push.x, push.y, arm.cross(push)])), first=FIXED_POLYGONS)
