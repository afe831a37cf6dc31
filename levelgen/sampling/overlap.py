"""How much a new body overlaps the others: the number of contacts that the engine would find.

The reference counts all contacts of every proposed level. Those among older bodies are the same in all proposals of a
body, so only pairs with the new body are counted here, all at once. Contacts count as in physics/manifold.py, which a
test compares: up to two per pair of polygons, one per pair with a circle; joined bodies count too. The geometry is not
shared with manifold.py, whose kernel projects on faces instead of measuring from vertices: its last bits, and
occasionally its count, differ, which would change the levels of existing ids.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.manifold import FLIP_BIAS, Faces, faces
from levelproof.physics.types import Model, State
from levelproof.physics.vector import Vec, nonzero, vec


class WorldPolygons(NamedTuple):
    """Polygons in the world frame, clockwise, all with four vertices."""

    vertex: Vec  # components [vertex, polygon, lane]
    face: Faces  # from a vertex to the next


class WorldCircles(NamedTuple):
    """Circles in the world frame."""

    centre: Vec  # components [circle, lane]
    radius: Float[Array, "circle lane"]


def count_contacts(
    model: Model,
    state: State,
    corners: Float[Array, "vertex 2 lane"],
    body: WorldCircles,
    is_polygon: Bool[Array, " lane"],
) -> Int[Array, " lane"]:
    """Count a new body's contacts with the active bodies; it is a polygon with `corners`, or the circle `body`."""
    n = model.size.polygons
    cos, sin, position = jnp.cos(state.rotation[:n]), jnp.sin(state.rotation[:n]), vec(state.position)
    local = vec(model.vertices).map(lambda x: x.swapaxes(0, 1))
    polygons = in_world(local.rotate(cos, sin) + position.map(lambda x: x[:n]))
    new = in_world(vec(corners).map(lambda x: x[:, None]))
    circles = WorldCircles(position.map(lambda x: x[n:]), model.radius)
    between = (circles.centre - body.centre).norm()
    touching = jnp.where(
        is_polygon,
        jnp.concatenate([polygon_contacts(polygons, new), touch(new, circles).astype(jnp.int32)]),
        jnp.concatenate([touch(polygons, body), between < circles.radius + body.radius]).astype(jnp.int32),
    )
    return jnp.where(model.active, touching, 0).sum(0)


def in_world(vertex: Vec) -> WorldPolygons:
    return WorldPolygons(vertex, faces(vertex))


def polygon_contacts(a: WorldPolygons, b: WorldPolygons) -> Int[Array, "polygon lane"]:
    """Count each pair's contacts, 0 to 2: the two deepest vertices beyond the face that separates most."""
    (first_a, second_a), (first_b, second_b) = deepest(a, b), deepest(b, a)
    second = jnp.where(first_a + FLIP_BIAS < first_b, second_b, second_a)
    touching = jnp.maximum(first_a, first_b) < 0
    return touching.astype(jnp.int32) + (touching & (second < 0))


def deepest(a: WorldPolygons, b: WorldPolygons) -> tuple[Float[Array, "polygon lane"], Float[Array, "polygon lane"]]:
    """Return the distances of b's two deepest vertices from the face of a that separates most (negative: inside)."""
    reach = [
        a.face.outward.dot(Vec(b.vertex.x[k] - a.vertex.x, b.vertex.y[k] - a.vertex.y)) for k in range(4)
    ]  # distance of b's vertex k from each face of a
    low, high = jnp.minimum(reach[0], reach[1]), jnp.maximum(reach[0], reach[1])
    low2, high2 = jnp.minimum(reach[2], reach[3]), jnp.maximum(reach[2], reach[3])
    first = jnp.minimum(low, low2)
    second = jnp.minimum(jnp.minimum(high, high2), jnp.maximum(low, low2))
    best, runner_up = first[0], second[0]
    for k in range(1, 4):
        better = first[k] > best
        best, runner_up = jnp.where(better, first[k], best), jnp.where(better, second[k], runner_up)
    return best, runner_up


def touch(polygons: WorldPolygons, circles: WorldCircles) -> Bool[Array, "pair lane"]:
    """Whether the circle's centre lies inside the polygon or within its radius of an edge."""
    vertex, (edge, length, normal) = polygons
    along = edge.scale(1 / nonzero(length))
    offset = circles.centre - vertex
    clipped = along.scale(jnp.clip(along.dot(offset), 0.0, length))
    inside = (normal.dot(offset) < 0).all(0)
    return inside | ((offset - clipped).norm().min(0) <= circles.radius)
