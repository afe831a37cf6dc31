"""What the solver moves: the bodies' places and velocities, and what it adds up to push them with."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from physics.lanes import Ref, each
from physics.trigonometry import cos_sin
from physics.types import FIXED_POLYGONS, Model, Params, State
from physics.vector import Vec


class Bodies(NamedTuple):
    """References, one row a body."""

    motion: Ref  # [body, 5, lane]: place x, y (m), velocity x, y (m/s), angular velocity (rad/s)
    push: Ref  # [body, 3, lane]: sum of impulses x, y (N s), angular (N m s), since the body last yielded to them
    turn: Ref  # [body, 2, lane]: cosine and sine of the rotation


def place(motion: Float[Array, "5 lane"]) -> Vec:
    return Vec(motion[0], motion[1])


def velocity(motion: Float[Array, "5 lane"]) -> Vec:
    return Vec(motion[2], motion[3])


def start(model: Model, before: State, bodies: Bodies, params: Params) -> None:
    """Read the bodies, and let those of finite mass fall."""

    def read(i):
        falls = jnp.where(model.inverse_mass[i] != 0, params.dt, 0.0)
        v = [before.velocity[i, k] + model.gravity[k] * falls for k in range(2)]
        place = before.position[i]
        bodies.motion[i] = jnp.stack([place[0], place[1], *v, before.angular_velocity[i]])
        bodies.push[i] = jnp.zeros_like(bodies.push[i])
        bodies.turn[i] = jnp.stack(cos_sin(before.rotation[i]))

    each(bodies.motion.shape[0], read)


def yield_one(model: Model, bodies: Bodies, i) -> None:
    """Let the impulses in `push` change the velocities of body i."""
    mass, push = model.inverse_mass[i], bodies.push[i]
    bodies.motion[i, 2] += mass * push[0]
    bodies.motion[i, 3] += mass * push[1]
    bodies.motion[i, 4] += model.inverse_inertia[i] * push[2]
    bodies.push[i] = jnp.zeros_like(push)


def yield_all(model: Model, bodies: Bodies) -> None:
    """The same for every body; the scenery never moves."""
    each(bodies.motion.shape[0], lambda i: yield_one(model, bodies, i), first=FIXED_POLYGONS)


def integrate(before: State, after: State, bodies: Bodies, params: Params) -> None:
    """Euler step, then bounds on places and speeds."""

    def clip(x, most):
        return jnp.clip(x, -most, most)

    def write(i):
        # -0 becomes 0: a push of nothing, because of another lane, would make it so
        x, y, v_x, v_y, w = (jnp.where(row == 0, 0.0, row) for row in bodies.motion[i])
        after.position[i, 0] = clip(x + v_x * params.dt, params.max_position)
        after.position[i, 1] = clip(y + v_y * params.dt, params.max_position)
        after.rotation[i] = before.rotation[i] + w * params.dt
        after.velocity[i, 0] = clip(v_x, params.max_velocity)
        after.velocity[i, 1] = clip(v_y, params.max_velocity)
        after.angular_velocity[i] = clip(w, params.max_angular_velocity)

    each(bodies.motion.shape[0], write)
