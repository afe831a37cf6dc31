"""Noise with which experts are tried: actions that stick, and other velocities at the start."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.levelgen.level import Level
from levelproof.physics.types import State

STICKINESS = 0.25  # probability of repeating the last action in sticky attempts (Machado et al. 2018, arXiv:1709.06009)
PERTURBATION = 0.1  # m/s and rad/s, largest change of the level's velocities in perturbed attempts


def pushed(level: Level, state: State, change: Float[Array, "3 body lane"]) -> State:
    """Return a state in which `change` is added to the velocities of bodies that can move: x, y, rotation."""
    movable = (level.model.inverse_mass > 0) & level.model.active
    change = jnp.where(movable, change, 0.0)
    return replace(
        state,
        velocity=state.velocity + jnp.moveaxis(change[:2], 0, 1),
        angular_velocity=state.angular_velocity + change[2],
    )
