"""Collision detection: where polygons and circles touch, how deep, and along which normal.

**Polygon and polygon.** Two convex shapes are apart if and only if some face normal separates them (the separating axis
theorem). The face with the largest separation, over both polygons, is the *reference face*; if its separation is
negative, the polygons overlap by that much along its normal. The other polygon's two vertices that lie deepest behind
the reference face, clipped to its ends, become the two contact points.

**Circle and polygon.** The circle's centre is clipped to the nearest edge.

Polygons are clockwise; face k runs from vertex k to vertex k + 1. A triangle's fourth vertex repeats its first, so that
its third face closes it; its fourth face does not exist. Geometry and tie-breaks: `jax2d.collision` of Jax2D 1.0.1.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.block import Block
from levelproof.physics.body import position
from levelproof.physics.contact import Contact
from levelproof.physics.lanes import Ref, Scalar, anywhere, each, when
from levelproof.physics.pairs import CIRCLE_POLYGON, CIRCLES, POLYGONS, pairs_of
from levelproof.physics.types import MAX_VERTICES, Model
from levelproof.physics.vector import Vec, nonzero, where

FLIP_BIAS = 0.01  # m; b must separate this much more than a to become the reference polygon (Jax2D `epsilon`)
# rad; Jax2D turns edges into normals by rmat(pi / 2) in single precision, whose cosine is -4.371139e-8: its faces lean
# by that much, so of equally deep corners the one nearer to the face's start comes first (docs/physics.md, "Ties")
TILT = 4.371139e-8
FAR = 1e30  # m; distance of a vertex or edge that does not exist
# m; pairs whose bounding boxes are farther apart are skipped. Convex clockwise polygons cannot touch there, whatever
# the rounding; for degenerate ones the separating axes may report a distant contact, which this margin discards
MARGIN = 0.01

# listener(kind, contact indices, contacts): called with the contacts of each pair that comes near
ContactListener = Callable[[int, list, list[Contact]], None]


class Outline(NamedTuple):
    """One polygon in the world; components [vertex, lane]."""

    centre: Vec  # [lane]
    vertex: Vec
    normal: Vec
    support: Array


def read_vec(ref: Ref, i: Scalar) -> Vec:
    return Vec(ref[0, i], ref[1, i])


def write_vec(ref: Ref, i: Scalar, v: Vec) -> None:
    ref[0, i], ref[1, i] = v.x, v.y


class Faces(NamedTuple):
    """The faces of polygons; components [vertex, ...]."""

    edge: Vec  # from a face's vertex to the next
    length: Array  # of the edge, m
    outward: Vec  # unit normal


def faces(start: Vec) -> Faces:
    """Return the faces of clockwise polygons whose vertices are `start`, [vertex, ...]."""
    edge = start.map(lambda x: jnp.roll(x, -1, axis=0)) - start
    length = edge.norm()
    return Faces(edge, length, Vec(-edge.y, edge.x).scale(1 / nonzero(length)))


def outline_polygons(block: Block) -> None:
    """Compute every polygon's geometry, in its own frame and in the world."""
    model, bodies, outlines = block.model, block.scratch.bodies, block.scratch.outlines

    def one(i):
        triangle = model.n_vertices[i] == 3
        corners = model.vertices[i]

        def close(x):
            return jnp.stack([x[0], x[1], x[2], jnp.where(triangle, x[0], x[3])])

        start = Vec(close(corners[:, 0]), close(corners[:, 1]))
        missing = triangle & (jnp.arange(MAX_VERTICES) == MAX_VERTICES - 1)[:, None]
        edge, length, outward = faces(start)
        support = outward.map(lambda x: x[:, None]).dot(start.map(lambda x: x[None])).max(1)
        cos, sin = bodies.turn[i]
        vertex = start.rotate(cos, sin) + position(bodies.motion[i])
        write_vec(outlines.start, i, start)
        write_vec(outlines.edge, i, edge)
        write_vec(outlines.along, i, edge.scale(1 / nonzero(length)))
        outlines.length[i] = length
        outlines.support[i] = jnp.where(missing, FAR, support)
        write_vec(outlines.vertex, i, vertex)
        write_vec(outlines.normal, i, outward.rotate(cos, sin))
        outlines.box[i] = jnp.stack([vertex.x.min(0), vertex.y.min(0), vertex.x.max(0), vertex.y.max(0)])

    each(outlines.support.shape[0], one)


def find_contacts(block: Block, listener: ContactListener) -> None:
    """Test all pairs that can touch, in the order of `pairs`, and call `listener` for those that come near."""
    pairs = pairs_of(block.model.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    each(n, lambda p: _polygons(block, p, n, listener))
    each(2 * n + m, lambda c: _circle_and_polygon(block, c, listener), first=2 * n)
    each(pairs.contacts, lambda c: _circles(block, c, listener), first=2 * n + m)


def _polygons(block: Block, p: Scalar, count: int, listener: ContactListener) -> None:
    """Test pair p of `count` pairs of polygons."""
    a, b = block.table.a[p], block.table.b[p]
    box = block.scratch.outlines.box
    mine, other = box[a], box[b]
    apart = (mine[:2] > other[2:] + MARGIN) | (other[:2] > mine[2:] + MARGIN)
    may = may_touch(block.model, a, b) & ~apart.any(0)

    def narrow():
        contacts = _polygon_polygon(_outline(block, a), _outline(block, b))
        listener(POLYGONS, [p, count + p], [c._replace(active=c.active & may) for c in contacts])

    when(anywhere(may), narrow)


def _circle_and_polygon(block: Block, c: Scalar, listener: ContactListener) -> None:
    a, b = block.table.a[c], block.table.b[c]
    (centre, radius), box = _disc(block, a), block.scratch.outlines.box[b]
    reach = radius + MARGIN
    apart = (centre.x < box[0] - reach) | (centre.x > box[2] + reach)
    apart |= (centre.y < box[1] - reach) | (centre.y > box[3] + reach)
    may = may_touch(block.model, a, b) & ~apart

    def narrow():
        contact = _circle_polygon(block, centre, radius, b)
        listener(CIRCLE_POLYGON, [c], [contact._replace(active=contact.active & may)])

    when(anywhere(may), narrow)


def _circles(block: Block, c: Scalar, listener: ContactListener) -> None:
    a, b = block.table.a[c], block.table.b[c]
    contact = _circle_circle(*_disc(block, a), *_disc(block, b))
    contact = contact._replace(active=contact.active & may_touch(block.model, a, b))
    when(anywhere(contact.active), lambda: listener(CIRCLES, [c], [contact]))


def _disc(block: Block, i: Scalar) -> tuple[Vec, Array]:
    """Return centre and radius of a circle, i being its index among all bodies."""
    return position(block.scratch.bodies.motion[i]), block.model.radius[i - block.model.size.polygons]


def may_touch(model: Model, a: ArrayLike, b: ArrayLike) -> Bool[Array, " lane"]:
    """Whether both bodies are active and their collision modes match (joined bodies still have manifolds)."""
    mode_a, mode_b = model.collision_mode[a], model.collision_mode[b]
    modes = (mode_a == 2) | (mode_b == 2) | (mode_a * mode_b > 0)
    return modes & model.active[a] & model.active[b]


def _outline(block: Block, i: Scalar) -> Outline:
    outlines, centre = block.scratch.outlines, position(block.scratch.bodies.motion[i])
    return Outline(centre, read_vec(outlines.vertex, i), read_vec(outlines.normal, i), outlines.support[i])


class Face(NamedTuple):
    """The face of least penetration of one polygon against another."""

    separation: Array
    normal: Vec
    start: Vec
    end: Vec


def _first(holds: Bool[Array, "vertex lane"]) -> Int[Array, " lane"]:
    """Return the index of the first vertex where `holds` is true."""
    number = jnp.arange(len(holds), dtype=jnp.int32)[:, None]
    return jnp.where(holds, number, len(holds)).min(0)


def _pick(x: Float[Array, "vertex lane"], number: Int[Array, " lane"]) -> Float[Array, " lane"]:
    """Return x[number] for a vertex index that differs by lane."""
    chosen = x[0]
    for k in range(1, len(x)):
        chosen = jnp.where(number == k, x[k], chosen)
    return chosen


def _best_face(a: Outline, b: Outline) -> Face:
    """Find the face of a that separates b the most; the first if several tie, as in the reference."""
    normal, offset = a.normal.map(lambda x: x[:, None]), (b.vertex - a.centre).map(lambda x: x[None])
    separation = normal.dot(offset).min(1) - a.support
    most = separation.max(0)
    best = _first(separation == most)
    end = a.vertex.map(lambda x: jnp.roll(x, -1, axis=0))
    return Face(most, *(v.map(lambda x: _pick(x, best)) for v in (a.normal, a.vertex, end)))


def _polygon_polygon(a: Outline, b: Outline) -> list[Contact]:
    """Find two contact points: the incident polygon's two deepest vertices, clipped to the reference face."""
    face_a, face_b = _best_face(a, b), _best_face(b, a)
    by_b = face_a.separation + FLIP_BIAS < face_b.separation
    separation = jnp.maximum(face_a.separation, face_b.separation)
    normal = where(by_b, face_b.normal, face_a.normal)
    start, end = where(by_b, face_b.start, face_a.start), where(by_b, face_b.end, face_a.end)
    incident = where(by_b, a.vertex, b.vertex)
    missing = jnp.where(by_b, a.support, b.support) == FAR

    along = end - start
    length = along.norm()
    along = along.scale(1 / nonzero(length))
    reach = jnp.where(missing, FAR, normal.dot(incident - start))  # negative: inside the reference polygon
    offset = along.dot(incident - start)
    deepest = reach + TILT * offset
    first = _first(deepest == deepest.min(0))
    rest = jnp.where(jnp.arange(MAX_VERTICES)[:, None] == first, 2 * FAR, deepest)
    second = _first(rest == rest.min(0))

    def contact(number, depth, active):
        point = start + normal.scale(depth) + along.scale(jnp.clip(_pick(offset, number), 0.0, length))
        return Contact(active, where(by_b, -normal, normal), -separation, point)

    depth1, depth2 = _pick(reach, first), _pick(reach, second)
    touching = separation < 0
    return [contact(first, depth1, touching), contact(second, depth2, touching & (depth2 < 0))]


def _circle_polygon(block: Block, centre: Vec, radius: Array, i: Scalar) -> Contact:
    """Find the contact of a circle: its centre, clipped to the polygon's nearest edge."""
    bodies, outlines = block.scratch.bodies, block.scratch.outlines
    cos, sin = bodies.turn[i]
    polygon = position(bodies.motion[i])
    local = (centre - polygon).unrotate(cos, sin)  # in the polygon's frame
    start, length = read_vec(outlines.start, i), outlines.length[i]
    edge, along = read_vec(outlines.edge, i), read_vec(outlines.along, i)
    missing = outlines.support[i] == FAR

    to_centre = local - start
    clipped = start + along.scale(jnp.clip(along.dot(to_centre), 0.0, length))
    gap = jnp.where(missing, FAR, (clipped - local).norm())
    inside = (missing | (edge.cross(to_centre) < 0)).all(0)  # clockwise: the inside lies to the right
    distance = gap.min(0)
    nearest = _first(gap == distance)
    closest = clipped.map(lambda x: _pick(x, nearest))

    outward = (local - closest).scale(jnp.where(inside, 1.0, -1.0))  # from the circle to the polygon
    normal = outward.scale(1 / nonzero(outward.norm())).rotate(cos, sin)
    penetration = jnp.where(inside, radius, radius - distance)
    return Contact((distance <= radius) | inside, normal, penetration, closest.rotate(cos, sin) + polygon)


def _circle_circle(centre_a: Vec, radius_a: Array, centre_b: Vec, radius_b: Array) -> Contact:
    between = centre_b - centre_a
    distance = between.norm()
    reach = radius_a + radius_b
    normal = between.scale(1 / nonzero(distance))
    return Contact(distance < reach, normal, reach - distance, centre_a + normal.scale(radius_a))
