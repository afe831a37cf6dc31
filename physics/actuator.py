"""Motors turn the bodies of a revolute joint, thrusters push one body.

Facts: `jax2d.joint.apply_motor`, `jax2d.engine`.
"""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from physics.joint import can_act, joint_angle
from physics.motion import inverse_masses, placed, select
from physics.types import Model, Params, State
from physics.vector import Vec, vec


def drive_motors(
    model: Model,
    state: State,
    velocity: Float[Array, "body 3 lane"],
    control: Float[Array, "joint lane"],
    params: Params,
) -> Float[Array, "body 3 lane"]:
    """Angular impulses that bring each motor's joint to its speed, weakened near the joint limits.

    `control` is in [-1, 1], one per joint.
    """
    w = velocity[:, 2]
    each = lambda x, body: jnp.stack([select(x, b) for b in body])
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
    on_a, on_b = (turn * inertia_a)[:, None], (turn * inertia_b)[:, None]
    gained = _total(model.joint_a, on_a, len(w)) - _total(model.joint_b, on_b, len(w))
    return jnp.concatenate([velocity[:, :2], velocity[:, 2:] + gained], axis=1)


def fire_thrusters(
    model: Model,
    state: State,
    velocity: Float[Array, "body 3 lane"],
    control: Float[Array, "thruster lane"],
    params: Params,
) -> Float[Array, "body 3 lane"]:
    """A force on one body, along the thruster, at its place. `control` is in [0, 1], one per thruster."""
    rotation = jnp.stack([select(state.rotation, body) for body in model.thruster_body])
    arm = vec(model.thruster_position).rotate(jnp.cos(rotation), jnp.sin(rotation))
    heading = model.thruster_rotation + rotation
    direction = Vec(jnp.cos(heading), jnp.sin(heading))
    force = model.thruster_power * model.thruster_active * params.thruster_power * control * params.dt
    push = direction.scale(force)
    impulse = jnp.stack([push.x, push.y, arm.cross(push)], axis=1)
    return velocity + inverse_masses(model) * _total(model.thruster_body, impulse, len(velocity))


def _total(body: Int[Array, "actuator lane"], change: Float[Array, "actuator row lane"], bodies: int) -> Array:
    """The sum of changes at each body, [body, row, lane]."""
    return functools.reduce(jnp.add, (placed(bodies, b, x) for b, x in zip(body, change, strict=True)))
