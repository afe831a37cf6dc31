"""Where bodies touch: polygon-polygon, circle-polygon, circle-circle.

Geometry of Jax2D 1.0.1 (`jax2d.collision`): separating axes over the face normals of both polygons,
two contact points clipped to the reference face; a circle is clipped to the nearest edge.
Polygons are clockwise; a face goes from a vertex to the next one.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from physics.pairs import PairKind, pairs_of
from physics.types import MAX_VERTICES, Manifold, Model, State
from physics.vector import Vec, nonzero, rows, spin, unvec, vec, where

FLIP_BIAS = 0.01  # m; b must separate this much more than a to become the reference polygon (Jax2D `epsilon`)
FAR = 1e30  # m; stands for a vertex or edge that does not exist


class Contacts(NamedTuple):
    """Contacts of one kind of pair, components [pair, lane]."""

    active: Bool[Array, "pair lane"]
    normal: Vec
    penetration: Float[Array, "pair lane"]
    point: Vec


class Polygons(NamedTuple):
    """Polygons in the world, vertex by vertex; components [polygon, lane]."""

    centre: Vec
    vertex: list[Vec]  # MAX_VERTICES of them
    normal: list[Vec]  # outward unit normal of the face that starts at the vertex
    support: list[Array]  # largest projection of the own vertices on the normal, from the centre
    triangle: Bool[Array, "polygon lane"]


def find_contacts(model: Model, state: State) -> Manifold:
    """All contacts of a state, in the order of `pairs.py`, zero where not active.

    `state.velocity` is used for the restitution target only.
    """
    pairs = pairs_of(model.size)
    first, second = _polygon_polygon(model, state, pairs.polygon)
    kinds = [
        (pairs.polygon, first),
        (pairs.polygon, second),
        (pairs.circle_polygon, _circle_polygon(model, state)),
        (pairs.circle, _circle_circle(model, state, pairs.circle)),
    ]
    manifolds = [_manifold(model, state, pair, contacts) for pair, contacts in kinds if len(pair)]
    return Manifold(*(jnp.concatenate(leaves) for leaves in zip(*map(_leaves, manifolds), strict=True)))


def _leaves(m: Manifold) -> tuple:
    return m.active, m.normal, m.penetration, m.point, m.restitution_velocity


def _manifold(model: Model, state: State, pair: PairKind, c: Contacts) -> Manifold:
    """Add the restitution target and blank what is not active or may never collide."""
    active = c.active & may_touch(model, pair)
    position, velocity = vec(state.position), vec(state.velocity)

    def at(x, body):
        return rows(x, body)

    def point_velocity(body):
        r = c.point - position.map(lambda x: at(x, body))
        return velocity.map(lambda x: at(x, body)) + spin(at(state.angular_velocity, body), r)

    approach = (point_velocity(pair.b) - point_velocity(pair.a)).dot(c.normal)
    restitution = jnp.minimum(at(model.restitution, pair.a), at(model.restitution, pair.b))
    keep = lambda x: jnp.where(active, x, 0.0)
    return Manifold(
        active=active,
        normal=unvec(c.normal.map(keep)),
        penetration=keep(c.penetration),
        point=unvec(c.point.map(keep)),
        restitution_velocity=keep(approach * restitution),
    )


def may_touch(model: Model, pair: PairKind) -> Bool[Array, "pair lane"]:
    """Both bodies are active and their collision modes allow it (joined bodies still have manifolds)."""
    mode_a, mode_b = rows(model.collision_mode, pair.a), rows(model.collision_mode, pair.b)
    modes = (mode_a == 2) | (mode_b == 2) | (mode_a * mode_b > 0)
    return modes & rows(model.active, pair.a) & rows(model.active, pair.b)


def _polygons(model: Model, state: State) -> Polygons:
    n = model.size.polygons
    cos, sin = jnp.cos(state.rotation[:n]), jnp.sin(state.rotation[:n])
    centre = vec(state.position[:n])
    local = [vec(model.vertices[:, k]) for k in range(MAX_VERTICES)]
    triangle = jnp.broadcast_to(model.n_vertices == 3, cos.shape)
    after = [local[1], local[2], where(model.n_vertices == 3, local[0], local[3]), local[0]]
    normal, support = [], []
    for k in range(MAX_VERTICES):
        edge = after[k] - local[k]
        outward = Vec(-edge.y, edge.x).scale(1 / nonzero(edge.norm()))
        reach = [outward.dot(v) for v in local]
        reach[3] = jnp.where(model.n_vertices == 3, reach[0], reach[3])
        support.append(jnp.maximum(jnp.maximum(reach[0], reach[1]), jnp.maximum(reach[2], reach[3])))
        normal.append(outward.rotate(cos, sin))
    vertex = [v.rotate(cos, sin) + centre for v in local]
    return Polygons(centre, vertex, normal, support, triangle)


def _at(p: Polygons, index) -> Polygons:
    pick = lambda x: rows(x, index)
    return Polygons(
        p.centre.map(pick),
        [v.map(pick) for v in p.vertex],
        [v.map(pick) for v in p.normal],
        [pick(s) for s in p.support],
        pick(p.triangle),
    )


class Face(NamedTuple):
    """The face of least penetration of one polygon against another."""

    separation: Array
    normal: Vec
    start: Vec
    end: Vec


def _best_face(a: Polygons, b: Polygons) -> Face:
    """The face of a along whose normal b is farthest out; the first of equals, as the reference."""
    best = None
    for k in range(MAX_VERTICES):
        reach = [a.normal[k].dot(v - a.centre) for v in b.vertex]
        reach[3] = jnp.where(b.triangle, reach[0], reach[3])
        nearest = jnp.minimum(jnp.minimum(reach[0], reach[1]), jnp.minimum(reach[2], reach[3]))
        end = a.vertex[(k + 1) % MAX_VERTICES]
        if k == 2:
            end = where(a.triangle, a.vertex[0], end)
        face = Face(nearest - a.support[k], a.normal[k], a.vertex[k], end)
        if best is None:
            best = face
        else:
            better = face.separation > best.separation
            if k == 3:
                better &= ~a.triangle
            best = Face(
                jnp.where(better, face.separation, best.separation),
                where(better, face.normal, best.normal),
                where(better, face.start, best.start),
                where(better, face.end, best.end),
            )
    assert best is not None
    return best


def _polygon_polygon(model: Model, state: State, pair: PairKind) -> tuple[Contacts, Contacts]:
    """Two contact points: the incident polygon's two deepest vertices, clipped to the reference face."""
    world = _polygons(model, state)
    a, b = _at(world, pair.a), _at(world, pair.b)
    face_a, face_b = _best_face(a, b), _best_face(b, a)
    by_b = face_a.separation + FLIP_BIAS < face_b.separation
    separation = jnp.maximum(face_a.separation, face_b.separation)
    normal = where(by_b, face_b.normal, face_a.normal)
    start, end = where(by_b, face_b.start, face_a.start), where(by_b, face_b.end, face_a.end)
    incident = [where(by_b, va, vb) for va, vb in zip(a.vertex, b.vertex, strict=True)]

    along = end - start
    length = along.norm()
    along = along.scale(1 / nonzero(length))
    reach = [normal.dot(v - start) for v in incident]  # negative: inside the reference polygon
    reach[3] = jnp.where(jnp.where(by_b, a.triangle, b.triangle), FAR, reach[3])
    offset = [along.dot(v - start) for v in incident]
    (depth1, offset1), (depth2, offset2) = _two_smallest(reach, offset)

    def contact(depth, offset, active):
        point = start + normal.scale(depth) + along.scale(jnp.clip(offset, 0.0, length))
        return Contacts(active, where(by_b, -normal, normal), -separation, point)

    touching = separation < 0
    return contact(depth1, offset1, touching), contact(depth2, offset2, touching & (depth2 < 0))


def _two_smallest(keys: list[Array], values: list[Array]):
    """(key, value) of the smallest and of the second smallest key; ties go to the earlier one."""
    k1, v1, k2, v2 = keys[0], values[0], jnp.full_like(keys[0], 2 * FAR), values[0]
    for k, v in zip(keys[1:], values[1:], strict=True):
        first, second = k < k1, k < k2
        k2 = jnp.where(first, k1, jnp.where(second, k, k2))
        v2 = jnp.where(first, v1, jnp.where(second, v, v2))
        k1, v1 = jnp.where(first, k, k1), jnp.where(first, v, v1)
    return (k1, v1), (k2, v2)


def _circle_polygon(model: Model, state: State) -> Contacts:
    """The circle's centre clipped to the polygon's nearest edge. Works on [circle, polygon, lane] blocks."""
    n = model.size.polygons
    cos, sin = jnp.cos(state.rotation[:n])[None], jnp.sin(state.rotation[:n])[None]
    position = vec(state.position)
    polygon = position.map(lambda x: x[None, :n])
    centre = (position.map(lambda x: x[n:, None]) - polygon).unrotate(cos, sin)  # in the polygon's frame
    radius = model.radius[:, None]
    triangle = (model.n_vertices == 3)[None]
    local = [vec(model.vertices[:, k]).map(lambda x: x[None]) for k in range(MAX_VERTICES)]
    after = [local[1], local[2], where(triangle, local[0], local[3]), local[0]]

    inside, closest, distance = None, None, None
    for k in range(MAX_VERTICES):
        edge, to_centre = after[k] - local[k], centre - local[k]
        length = edge.norm()
        along = edge.scale(1 / nonzero(length))
        clipped = local[k] + along.scale(jnp.clip(along.dot(to_centre), 0.0, length))
        gap = (clipped - centre).norm()
        within = edge.cross(to_centre) < 0  # clockwise: the inside lies to the right
        if inside is None or closest is None or distance is None:
            inside, closest, distance = within, clipped, gap
            continue
        nearer = gap < distance
        if k == 3:
            nearer, within = nearer & ~triangle, within | triangle
        inside &= within
        closest, distance = where(nearer, clipped, closest), jnp.where(nearer, gap, distance)
    assert inside is not None and closest is not None and distance is not None

    outward = (centre - closest).scale(jnp.where(inside, 1.0, -1.0))  # from the circle to the polygon
    normal = outward.scale(1 / nonzero(outward.norm())).rotate(cos, sin)
    point = closest.rotate(cos, sin) + polygon
    flat = lambda x: jnp.broadcast_to(x, distance.shape).reshape(-1, distance.shape[-1])
    penetration = jnp.where(inside, radius, radius - distance)
    return Contacts(flat((distance <= radius) | inside), normal.map(flat), flat(penetration), point.map(flat))


def _circle_circle(model: Model, state: State, pair: PairKind) -> Contacts:
    n = model.size.polygons
    position = vec(state.position)
    at = lambda index: position.map(lambda x: rows(x, index))
    radius = lambda index: rows(model.radius, [i - n for i in index])
    between = at(pair.b) - at(pair.a)
    distance = between.norm()
    reach = radius(pair.a) + radius(pair.b)
    normal = between.scale(1 / nonzero(distance))
    return Contacts(distance < reach, normal, reach - distance, at(pair.a) + normal.scale(radius(pair.a)))
