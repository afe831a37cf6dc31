"""Motors turn the bodies of a revolute joint, thrusters push one body. Facts: `jax2d.joint.apply_motor`, `jax2d.engine`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from physics.joint import can_act, joint_angle
from physics.motion import Motion, select, spread
from physics.types import Model, Params, State
from physics.vector import Vec, vec


def drive_motors(
    model: Model, state: State, motion: Motion, control: Float[Array, "joint lane"], params: Params
) -> Motion:
    """Angular impulses that bring each motor's joint to its speed, weakened near the joint limits.

    `control` is in [-1, 1], one per joint.
    """
    w, joints = motion.angular_velocity, range(model.size.joints)
    each = lambda x, body: jnp.stack([select(x, body[j]) for j in joints])
    inertia_a, inertia_b = each(model.inverse_inertia, model.joint_a), each(model.inverse_inertia, model.joint_b)
    both = inertia_a + inertia_b
    power = params.motor_power * params.dt * model.motor_power / jnp.where(both == 0, 1.0, both)
    excess = each(w, model.joint_b) - each(w, model.joint_a) - model.motor_speed * control * params.motor_speed

    angle = joint_angle(model, state)
    zone = params.motor_limit_zone
    beyond = angle - jnp.clip(angle, model.joint_min + zone, model.joint_max - zone)
    towards_limit = model.joint_limited & (beyond != 0) & (jnp.sign(beyond) == jnp.sign(control))
    power = power * jnp.where(towards_limit, jnp.maximum(0.0, 1 - jnp.abs(beyond) / zone), 1.0)

    runs = can_act(model) & model.motor_on & (control != 0) & ~model.joint_fixed
    turn = jnp.where(runs, power * jnp.tanh(excess * params.motor_decay), 0.0)
    terms = [(model.joint_a[j], (turn * inertia_a)[j]) for j in joints]
    terms += [(model.joint_b[j], (-turn * inertia_b)[j]) for j in joints]
    return Motion(motion.position, motion.velocity, w + spread(w.shape[0], terms))


def fire_thrusters(
    model: Model, state: State, motion: Motion, control: Float[Array, "thruster lane"], params: Params
) -> Motion:
    """A force on one body, along the thruster, at its place. `control` is in [0, 1], one per thruster."""
    thrusters = range(model.size.thrusters)
    each = lambda x: jnp.stack([select(x, model.thruster_body[t]) for t in thrusters])
    rotation = each(state.rotation)
    arm = vec(model.thruster_position).rotate(jnp.cos(rotation), jnp.sin(rotation))
    heading = model.thruster_rotation + rotation
    direction = Vec(jnp.cos(heading), jnp.sin(heading))
    force = model.thruster_power * model.thruster_active * params.thruster_power * control * params.dt
    push = direction.scale(force)

    def moved(x, change):
        return x + spread(x.shape[0], [(model.thruster_body[t], change[t]) for t in thrusters])

    mass, v = each(model.inverse_mass), motion.velocity
    return Motion(
        motion.position,
        Vec(moved(v.x, mass * push.x), moved(v.y, mass * push.y)),
        moved(motion.angular_velocity, each(model.inverse_inertia) * arm.cross(push)),
    )
