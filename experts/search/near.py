"""Distance to the goal: the gap between green and blue bodies, 0 when they touch.

The task's own distance is between centres. It says little about a long floor, and sums over several goals.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level, Role
from levelproof.physics.manifold import faces, may_touch
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Model, State
from levelproof.physics.vector import Vec, nonzero, select, vec

MAX_PAIRS = 2  # pairs of a green and a blue body that are measured, the first; sampled levels have one
FAR = 1e6  # m, gap without a pair


class Shape(NamedTuple):
    """One body of each pair. A circle has four corners, all at its centre, and a radius."""

    body: Int[Array, "pair lane"]
    corner: Vec  # in the body's frame, components [vertex, pair, lane]
    radius: Float[Array, "pair lane"]


class Goals(NamedTuple):
    """Pairs of a green and a blue body that can touch."""

    green: Shape
    blue: Shape
    there: Bool[Array, "pair lane"]  # whether the level has the pair


def goals_of(level: Level) -> Goals:
    """Return the first pairs of each lane."""
    bodies = len(level.role)
    a, b = np.divmod(np.arange(bodies * bodies), bodies)
    both = (level.role[a] == Role.GREEN) & (level.role[b] == Role.BLUE) & may_touch(level.model, a, b)
    both &= (np.maximum(a, b) >= FIXED_POLYGONS)[:, None]  # scenery never touches scenery
    turn = jnp.where(both, jnp.cumsum(both, axis=0), 0)
    number = jnp.arange(bodies * bodies)[:, None]
    pair = jnp.stack([jnp.where(turn == 1 + k, number, 0).sum(0) for k in range(MAX_PAIRS)])
    there = jnp.arange(MAX_PAIRS)[:, None] < both.sum(0)
    green, blue = jnp.divmod(pair, bodies)
    return Goals(_shape(level.model, green), _shape(level.model, blue), there)


def gap(goals: Goals, state: State) -> Float[Array, " lane"]:
    """Return the smallest gap of the pairs, m: the best separation along face normals and the line of centres.

    The gap is exact between circles and opposite a face, else a lower bound; 0 if the bodies overlap.
    """
    (centre_a, corner_a), (centre_b, corner_b) = _in_world(goals.green, state), _in_world(goals.blue, state)
    between = centre_b - centre_a
    towards = between.scale(1 / nonzero(between.norm()))
    beyond = [
        _beyond(corner_a, corner_b),
        _beyond(corner_b, corner_a),
        towards.dot(corner_b).min(0) - towards.dot(corner_a).max(0),
    ]
    apart = jnp.stack(beyond).max(0) - goals.green.radius - goals.blue.radius
    return jnp.where(goals.there, jnp.maximum(apart, 0.0), FAR).min(0)


def _shape(model: Model, body: Int[Array, "pair lane"]) -> Shape:
    polygons = model.size.polygons
    is_round, polygon = body >= polygons, jnp.minimum(body, polygons - 1)
    triangle = _pick(model.n_vertices, polygon) == MAX_VERTICES - 1
    local = jnp.where(is_round[:, None, None], 0.0, _pick(model.vertices, polygon))
    local = local.at[:, -1].set(jnp.where(triangle[:, None], local[:, 0], local[:, -1]))
    circle = jnp.maximum(body - polygons, 0)
    radius = jnp.where(is_round, _pick(model.radius, circle), 0.0) if len(model.radius) else jnp.zeros(body.shape)
    return Shape(body, vec(jnp.swapaxes(local, 0, 1)), radius)


def _pick(x: Float[Array, "entity *row lane"], index: Int[Array, "pair lane"]) -> Float[Array, "pair *row lane"]:
    return jnp.stack([select(x, of_pair) for of_pair in index])


def _in_world(shape: Shape, state: State) -> tuple[Vec, Vec]:
    """Return centres and corners in the world."""
    centre, rotation = vec(_pick(state.position, shape.body)), _pick(state.rotation, shape.body)
    return centre, shape.corner.rotate(jnp.cos(rotation), jnp.sin(rotation)) + centre


def _beyond(corner: Vec, other: Vec) -> Float[Array, "pair lane"]:
    """Return the distance of the other body's corners from the face that separates most."""
    outward = faces(corner).outward
    reach = [outward.dot(other.map(lambda x, k=k: x[k]) - corner) for k in range(MAX_VERTICES)]
    return jnp.stack(reach).min(0).max(0)
