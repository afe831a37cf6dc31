"""One physics step: gravity, contacts, actuators, solver, integration.

The order is part of the reference's result (`jax2d.engine.PhysicsEngine.step`).
"""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from physics.actuator import drive_motors, fire_thrusters
from physics.manifold import find_contacts
from physics.motion import Motion
from physics.solver import solve
from physics.types import Manifold, Model, Params, State
from physics.vector import unvec, vec


def step(
    model: Model,
    state: State,
    motor: Float[Array, "joint lane"],
    thrust: Float[Array, "thruster lane"],
    params: Params = Params(),
) -> tuple[State, Manifold]:
    """Advance every lane by `params.dt`.

    Args:
        model: constants of each lane's level.
        state: the worlds before the step.
        motor: control of each joint's motor, in [-1, 1].
        thrust: control of each thruster, in [0, 1].

    Returns:
        The worlds after the step, and the contacts found at its start.
    """
    state = replace(state, velocity=_fall(model, state, params))
    manifold = find_contacts(model, state)
    motion = Motion(vec(state.position), vec(state.velocity), state.angular_velocity)
    motion = drive_motors(model, state, motion, motor, params)
    motion = fire_thrusters(model, state, motion, thrust, params)
    motion, state = solve(model, state, manifold, motion, params)
    return _integrate(state, motion, params), manifold


def _fall(model: Model, state: State, params: Params) -> Float[Array, "body 2 lane"]:
    return state.velocity + model.gravity * params.dt * (model.inverse_mass != 0)[:, None]


def _integrate(state: State, motion: Motion, params: Params) -> State:
    """Euler step, then bounds on places and speeds."""
    clip = lambda v, most: v.map(lambda x: jnp.clip(x, -most, most))
    v, w = motion.velocity, motion.angular_velocity
    return replace(
        state,
        position=unvec(clip(motion.position + v.scale(params.dt), params.max_position)),
        rotation=state.rotation + w * params.dt,
        velocity=unvec(clip(v, params.max_velocity)),
        angular_velocity=jnp.clip(w, -params.max_angular_velocity, params.max_angular_velocity),
    )


