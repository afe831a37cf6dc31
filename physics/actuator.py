"""Motors turn the bodies of a revolute joint, thrusters push one body.

Facts: `jax2d.joint.apply_motor`, `jax2d.engine`.
"""

import jax.numpy as jnp

from physics.body import Bodies
from physics.joint import Joints
from physics.lanes import NOBODY, Ref, anywhere, each, pick, spread, when
from physics.trigonometry import cos_sin, tanh
from physics.types import FIXED_POLYGONS, Model, Params, State
from physics.vector import Vec


def drive_motors(model: Model, bodies: Bodies, joints: Joints, control: Ref, params: Params) -> None:
    """Angular impulses that bring each motor's joint to its speed, weakened near the joint limits.

    `control` [joint, lane] is in [-1, 1].
    """

    def one(j):
        runs = joints.acts[j] & model.motor_on[j] & (control[j] != 0) & ~model.joint_fixed[j]
        when(anywhere(runs), lambda: drive(j, runs))

    def drive(j, runs):
        a, b = model.joint_a[j], model.joint_b[j]
        motion_a, motion_b = pick(bodies.motion.shape[0], lambda i: bodies.motion[i], a, b)
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
        spread(
            bodies.push, (a, jnp.stack([none, none, turn])), (b, jnp.stack([none, none, -turn])), first=FIXED_POLYGONS
        )

    each(joints.acts.shape[0], one)


def fire_thrusters(model: Model, before: State, bodies: Bodies, control: Ref, params: Params) -> None:
    """A force on one body, along the thruster, at its place. `control` [thruster, lane] is in [0, 1]."""

    def one(t):
        force = model.thruster_power[t] * model.thruster_active[t] * params.thruster_power * control[t] * params.dt
        when(anywhere(force != 0), lambda: fire(t, force))

    def fire(t, force):
        body = model.thruster_body[t]
        turn, _ = pick(bodies.motion.shape[0], lambda i: jnp.stack([*bodies.turn[i], before.rotation[i]]), body, body)
        cos, sin, rotation = turn
        arm = Vec(*model.thruster_position[t]).rotate(cos, sin)
        push = Vec(*cos_sin(model.thruster_rotation[t] + rotation)).scale(force)
        body = jnp.where(force != 0, body, NOBODY)
        spread(bodies.push, (body, jnp.stack([push.x, push.y, arm.cross(push)])), first=FIXED_POLYGONS)

    each(model.thruster_active.shape[0], one)
