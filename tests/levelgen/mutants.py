"""Sampled levels, mutated in every way that a proof depends on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.levelgen.level import SIZES, Level, Role
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.physics.types import FIXED_POLYGONS

SCENERY = slice(FIXED_POLYGONS)
CHANCE = 0.15  # of each mutation


def mutants(size: str, count: int, distribution: Distribution, seed: int = 0) -> Level:
    """Sample levels and mutate what moves, acts and touches, and where bodies start."""
    random = np.random.default_rng(seed)
    level = jax.tree.map(np.array, sample_levels(jnp.arange(count), SIZES[size], distribution))
    model, state = level.model, level.state

    def mutate(values: np.ndarray, new, chance: float = CHANCE) -> None:
        """Choose levels at random and replace half of their values."""
        chosen = (random.random(count) < chance) & (random.random(values.shape) < 0.5)
        values[...] = np.where(chosen, np.asarray(new, values.dtype), values)

    uniform = lambda values, low, high: random.uniform(low, high, values.shape)
    choice = lambda values, *options: random.choice(options, values.shape)
    for name in ("motor_on", "joint_fixed", "joint_limited", "joint_active", "thruster_active"):
        mutate(getattr(model, name), choice(getattr(model, name), True, False))
    mutate(level.motor_auto, True, 2 * CHANCE)
    for name in ("motor_speed", "motor_power", "thruster_power"):
        values = getattr(model, name)
        mutate(values, values * choice(values, 0, 0, -1, 3, 100), 2 * CHANCE)
    mutate(model.thruster_position, 5 * model.thruster_position)
    mutate(model.joint_rotation, uniform(model.joint_rotation, -20, 20))
    mutate(model.joint_min, model.joint_min - uniform(model.joint_min, 0, 8))
    mutate(model.joint_max, model.joint_max + uniform(model.joint_max, 0, 8))
    mutate(model.gravity, uniform(model.gravity, -9, 9))
    mutate(model.friction, uniform(model.friction, 0, 5))
    mutate(model.restitution, uniform(model.restitution, 0, 1.2))
    flipped = model.vertices[:, [1, 0, 3, 2]]
    model.vertices[...] = np.where(
        (random.random(count) < CHANCE) & (model.n_vertices == 4)[:, None, None], flipped, model.vertices
    )
    free = slice(FIXED_POLYGONS, None)
    mutate(model.n_vertices[free], 3)
    mutate(model.collision_mode[free], choice(model.collision_mode[free], 0, 1, 2))
    mutate(level.role[free], choice(level.role[free], *Role))
    mutate(model.inverse_mass[free], 0, 2 * CHANCE)
    model.inverse_inertia[...] = np.where(model.inverse_mass == 0, 0, model.inverse_inertia)
    mutate(model.inverse_mass[free], model.inverse_mass[free] * choice(model.inverse_mass[free], 0, 0.01, 100))
    mutate(state.velocity[free], uniform(state.velocity[free], -5, 5))
    mutate(state.angular_velocity[free], uniform(state.angular_velocity[free], -20, 20))
    mutate(state.position[free], uniform(state.position[free], 0, 5))
    mutate(state.joint_impulse, uniform(state.joint_impulse, -1, 1))
    return dataclasses.replace(level, model=dataclasses.replace(model, collides=np.asarray(collision_matrix(model))))
