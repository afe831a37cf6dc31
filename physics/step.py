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
from physics.types import DEFAULT_PARAMS, Manifold, Model, Params, State


def step(
    model: Model,
    state: State,
    motor: Float[Array, "joint lane"],
    thrust: Float[Array, "thruster lane"],
    params: Params = DEFAULT_PARAMS,
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
    velocity = jnp.concatenate([state.velocity, state.angular_velocity[:, None]], axis=1)
    velocity = drive_motors(model, state, velocity, motor, params)
    velocity = fire_thrusters(model, state, velocity, thrust, params)
    motion, state = solve(model, state, manifold, Motion(state.position, velocity), params)
    return _integrate(state, motion, params), manifold


def _fall(model: Model, state: State, params: Params) -> Float[Array, "body 2 lane"]:
    return state.velocity + model.gravity * params.dt * (model.inverse_mass != 0)[:, None]


def _integrate(state: State, motion: Motion, params: Params) -> State:
    """Euler step, then bounds on places and speeds."""
    clip = lambda x, most: jnp.clip(x, -most, most)
    v, w = motion.velocity[:, :2], motion.velocity[:, 2]
    return replace(
        state,
        position=clip(motion.position + v * params.dt, params.max_position),
        rotation=state.rotation + w * params.dt,
        velocity=clip(v, params.max_velocity),
        angular_velocity=clip(w, params.max_angular_velocity),
    )
