"""Bodies: gravity, impulses and integration.

Solvers add impulses to `push`; a body *yields* when its accumulated push changes its velocity. The two are kept apart
so that all contacts of a solver batch read the same velocities.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.physics.block import Block
from levelproof.physics.lanes import Scalar, each
from levelproof.physics.trigonometry import cos_sin
from levelproof.physics.types import FIXED_POLYGONS, Params
from levelproof.physics.vector import Vec


def position(motion: Float[Array, "5 lane"]) -> Vec:
    return Vec(motion[0], motion[1])


def velocity(motion: Float[Array, "5 lane"]) -> Vec:
    return Vec(motion[2], motion[3])


def start(block: Block, params: Params) -> None:
    """Load the bodies' motion, and add gravity to the velocities of those with finite mass."""
    model, before, bodies = block.model, block.inputs.before, block.scratch.bodies

    def read(i):
        falls = jnp.where(model.inverse_mass[i] != 0, params.dt, 0.0)
        v = [before.velocity[i, k] + model.gravity[k] * falls for k in range(2)]
        centre = before.position[i]
        bodies.motion[i] = jnp.stack([centre[0], centre[1], *v, before.angular_velocity[i]])
        bodies.push[i] = jnp.zeros_like(bodies.push[i])
        bodies.turn[i] = jnp.stack(cos_sin(before.rotation[i]))

    each(bodies.motion.shape[0], read)


def yield_one(block: Block, i: Scalar) -> None:
    """Apply the impulses in `push` to the velocities of body i, and reset them."""
    model, bodies = block.model, block.scratch.bodies
    mass, push = model.inverse_mass[i], bodies.push[i]
    bodies.motion[i, 2] += mass * push[0]
    bodies.motion[i, 3] += mass * push[1]
    bodies.motion[i, 4] += model.inverse_inertia[i] * push[2]
    bodies.push[i] = jnp.zeros_like(push)


def yield_all(block: Block) -> None:
    """Apply `yield_one` to every body except the immovable scenery."""
    each(block.scratch.bodies.motion.shape[0], lambda i: yield_one(block, i), first=FIXED_POLYGONS)


def integrate(block: Block, params: Params) -> None:
    """Take a semi-implicit Euler step, then clip positions and speeds."""
    before, after, bodies = block.inputs.before, block.after, block.scratch.bodies

    def clip(x, most):
        return jnp.clip(x, -most, most)

    def write(i):
        # -0 becomes 0, as when another lane forces a zero impulse here
        x, y, v_x, v_y, w = (jnp.where(row == 0, 0.0, row) for row in bodies.motion[i])
        after.position[i, 0] = clip(x + v_x * params.dt, params.max_position)
        after.position[i, 1] = clip(y + v_y * params.dt, params.max_position)
        after.rotation[i] = before.rotation[i] + w * params.dt
        after.velocity[i, 0] = clip(v_x, params.max_velocity)
        after.velocity[i, 1] = clip(v_y, params.max_velocity)
        after.angular_velocity[i] = clip(w, params.max_angular_velocity)

    each(bodies.motion.shape[0], write)
