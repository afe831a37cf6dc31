"""How much a new body overlaps the others: the number of contacts that the engine would find.

The reference counts all contacts of every proposed level. Those among older bodies are the same in all proposals of a
body, so only pairs with the new body are counted here. Contacts count as in physics/manifold.py, which a test
compares: up to two per pair of polygons, one per pair with a circle; joined bodies count too. The geometry is not
shared with manifold.py, whose kernel projects on faces instead of measuring from vertices: its last bits, and
occasionally its count, differ, which would change the levels of existing ids.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.manifold import FLIP_BIAS, faces
from levelproof.physics.vector import Vec, nonzero


class WorldPolygon(NamedTuple):
    """A polygon in the world, clockwise, with four corners; components [corner, lane]."""

    corner: Vec
    along: Vec  # unit vector from a corner to the next
    outward: Vec  # unit normal of that face
    length: Float[Array, "corner lane"]

    @staticmethod
    def of(corner: Vec) -> "WorldPolygon":
        """Return the outline with these corners."""
        edge, length, outward = faces(corner)
        return WorldPolygon(corner, edge.scale(1 / nonzero(length)), outward, length)


class WorldCircle(NamedTuple):
    """A circle in the world; [lane]."""

    centre: Vec
    radius: Float[Array, " lane"]


def polygon_contacts(a: WorldPolygon, b: WorldPolygon) -> Int[Array, " lane"]:
    """Count a pair's contacts, 0 to 2: corners that lie behind the face that separates most."""
    (first_a, second_a), (first_b, second_b) = deepest(a, b), deepest(b, a)
    second = jnp.where(first_a + FLIP_BIAS < first_b, second_b, second_a)
    touching = jnp.maximum(first_a, first_b) < 0
    return touching.astype(jnp.int32) + (touching & (second < 0))


def deepest(a: WorldPolygon, b: WorldPolygon) -> tuple[Float[Array, " lane"], Float[Array, " lane"]]:
    """Return the distances of b's two deepest corners from the face of a that separates most (negative: inside)."""
    reach = [
        a.outward.dot(Vec(b.corner.x[k] - a.corner.x, b.corner.y[k] - a.corner.y)) for k in range(4)
    ]  # distance of b's corner k from each face of a
    low, high = jnp.minimum(reach[0], reach[1]), jnp.maximum(reach[0], reach[1])
    low2, high2 = jnp.minimum(reach[2], reach[3]), jnp.maximum(reach[2], reach[3])
    first = jnp.minimum(low, low2)
    second = jnp.minimum(jnp.minimum(high, high2), jnp.maximum(low, low2))
    best, runner_up = first[0], second[0]
    for k in range(1, 4):
        better = first[k] > best
        best, runner_up = jnp.where(better, first[k], best), jnp.where(better, second[k], runner_up)
    return best, runner_up


def touch(polygon: WorldPolygon, circle: WorldCircle) -> Bool[Array, " lane"]:
    """Whether the circle's centre lies inside the polygon or within its radius of an edge."""
    offset = circle.centre - polygon.corner
    clipped = polygon.along.scale(jnp.clip(polygon.along.dot(offset), 0.0, polygon.length))
    inside = (polygon.outward.dot(offset) < 0).all(0)
    return inside | ((offset - clipped).norm().min(0) <= circle.radius)


def discs_touch(a: WorldCircle, b: WorldCircle) -> Bool[Array, " lane"]:
    """Whether two circles overlap."""
    return (a.centre - b.centre).norm() < a.radius + b.radius
