"""Where bodies touch: polygon-polygon, circle-polygon, circle-circle.

Geometry of Jax2D 1.0.1 (`jax2d.collision`): separating axes over the face normals of both polygons,
two contact points clipped to the reference face; a circle is clipped to the nearest edge.
Polygons are clockwise; face k goes from vertex k to vertex k + 1. A triangle's fourth vertex repeats its first, so
that its third face closes it; its fourth face does not exist.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics.motion import incidence
from physics.pairs import PairKind, pairs_of
from physics.types import MAX_VERTICES, Manifold, Model, State
from physics.vector import Vec, nonzero, rows, spin, stored, unvec, vec, where

FLIP_BIAS = 0.01  # m; b must separate this much more than a to become the reference polygon (Jax2D `epsilon`)
FAR = 1e30  # m; stands for a vertex or edge that does not exist


class Contacts(NamedTuple):
    """Contacts of one kind of pair, components [pair, lane]."""

    active: Bool[Array, "pair lane"]
    normal: Vec
    penetration: Float[Array, "pair lane"]
    point: Vec


class Polygons(NamedTuple):
    """Polygons in the world; components [vertex, polygon, lane]."""

    centre: Vec  # [polygon, lane]
    vertex: Vec
    normal: Vec  # outward unit normal of the face that starts at the vertex
    support: Float[Array, "vertex polygon lane"]  # largest projection on the normal, from the centre; FAR: no such face


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
    sheets = (*c.normal, c.penetration, *c.point, approach * restitution)
    n_x, n_y, penetration, p_x, p_y, bounce = stored(jnp.stack([keep(x) for x in sheets]))
    return Manifold(active, unvec(Vec(n_x, n_y)), penetration, unvec(Vec(p_x, p_y)), bounce)


def may_touch(model: Model, pair: PairKind) -> Bool[Array, "pair lane"]:
    """Both bodies are active and their collision modes allow it (joined bodies still have manifolds)."""
    mode_a, mode_b = rows(model.collision_mode, pair.a), rows(model.collision_mode, pair.b)
    modes = (mode_a == 2) | (mode_b == 2) | (mode_a * mode_b > 0)
    return modes & rows(model.active, pair.a) & rows(model.active, pair.b)


def _edges(model: Model) -> tuple[Vec, Vec, Bool[Array, "vertex polygon lane"]]:
    """Each face's first and last vertex in the polygon's frame, and which faces do not exist."""
    triangle = model.n_vertices == 3
    local = vec(jnp.moveaxis(model.vertices, 1, 0))
    closed = local.map(lambda x: jnp.concatenate([x[:3], jnp.where(triangle, x[0], x[3])[None]]))
    missing = triangle & (jnp.arange(MAX_VERTICES) == MAX_VERTICES - 1)[:, None, None]
    return closed, closed.map(lambda x: jnp.roll(x, -1, axis=0)), missing


def _polygons(model: Model, state: State) -> Polygons:
    n = model.size.polygons
    cos, sin = jnp.cos(state.rotation[:n]), jnp.sin(state.rotation[:n])
    start, end, missing = _edges(model)
    edge = end - start
    outward = Vec(-edge.y, edge.x).scale(1 / nonzero(edge.norm()))
    support = outward.map(lambda x: x[:, None]).dot(start.map(lambda x: x[None])).max(1)
    centre = vec(state.position[:n])
    vertex, normal = start.rotate(cos, sin) + centre, outward.rotate(cos, sin)
    return Polygons(centre, vertex, normal, jnp.broadcast_to(jnp.where(missing, FAR, support), vertex.x.shape))


def _choose(world: Polygons, index: tuple[int, ...]) -> Polygons:
    """The polygons `index`. A product with a 0-1 matrix, because XLA stores its operands: whatever reads the result
    would otherwise rotate all vertices anew."""
    leaves = [*world.centre, *world.vertex, *world.normal, world.support]
    sheets = [x.reshape(-1, *x.shape[-2:]) for x in leaves]
    packed = jnp.moveaxis(jnp.concatenate(sheets), 1, 0)
    chosen = incidence(len(packed), index).T @ packed.reshape(len(packed), -1)
    x = jnp.moveaxis(chosen.reshape(len(index), *packed.shape[1:]), 1, 0)
    k = MAX_VERTICES
    sheet = lambda i: x[2 + i * k : 2 + (i + 1) * k]
    return Polygons(Vec(x[0], x[1]), Vec(sheet(0), sheet(1)), Vec(sheet(2), sheet(3)), sheet(4))


class Face(NamedTuple):
    """The face of least penetration of one polygon against another."""

    separation: Array
    normal: Vec
    start: Vec
    end: Vec


def _first(found: Bool[Array, "vertex ..."]) -> Int[Array, "..."]:
    """Number of the first vertex for which it holds."""
    number = jnp.arange(len(found), dtype=jnp.int32).reshape(-1, *[1] * (found.ndim - 1))
    return jnp.where(found, number, len(found)).min(0)


def _pick(x: Float[Array, "vertex ..."], number: Int[Array, "..."]) -> Float[Array, "..."]:
    """x[number] for a vertex number that differs by pair and lane."""
    vertices = jnp.arange(len(x), dtype=jnp.int32).reshape(-1, *[1] * (x.ndim - 1))
    return jnp.where(vertices == number, x, 0.0).sum(0)


def _best_face(a: Polygons, b: Polygons) -> Face:
    """The face of a along whose normal b is farthest out; the first of equals, as the reference."""
    normal, offset = a.normal.map(lambda x: x[:, None]), (b.vertex - a.centre).map(lambda x: x[None])
    separation = normal.dot(offset).min(1) - a.support
    most = separation.max(0)
    best = _first(separation == most)
    end = a.vertex.map(lambda x: jnp.roll(x, -1, axis=0))
    return Face(most, *(v.map(lambda x: _pick(x, best)) for v in (a.normal, a.vertex, end)))


def _polygon_polygon(model: Model, state: State, pair: PairKind) -> tuple[Contacts, Contacts]:
    """Two contact points: the incident polygon's two deepest vertices, clipped to the reference face."""
    world, n = _polygons(model, state), len(pair)
    either = _choose(world, pair.a + pair.b)  # both orders at once: a against b, then b against a
    a, b = (jax.tree.map(lambda x, at=at: x[..., at, :], either) for at in (slice(n), slice(n, None)))
    swapped = jax.tree.map(lambda x, y: jnp.concatenate([x, y], axis=-2), b, a)
    face = _best_face(either, swapped)
    face_a, face_b = (jax.tree.map(lambda x, at=at: x[at], face) for at in (slice(n), slice(n, None)))
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
    first = _first(reach == reach.min(0))
    rest = jnp.where(jnp.arange(MAX_VERTICES)[:, None, None] == first, 2 * FAR, reach)
    second = _first(rest == rest.min(0))

    def contact(number, depth, active):
        point = start + normal.scale(depth) + along.scale(jnp.clip(_pick(offset, number), 0.0, length))
        return Contacts(active, where(by_b, -normal, normal), -separation, point)

    depth1, depth2 = _pick(reach, first), _pick(reach, second)
    touching = separation < 0
    return contact(first, depth1, touching), contact(second, depth2, touching & (depth2 < 0))


def _circle_polygon(model: Model, state: State) -> Contacts:
    """The circle's centre clipped to the polygon's nearest edge. Works on [circle, polygon, lane] blocks."""
    n = model.size.polygons
    cos, sin = jnp.cos(state.rotation[:n]), jnp.sin(state.rotation[:n])
    position = vec(state.position)
    polygon = position.map(lambda x: x[:n])
    centre = (position.map(lambda x: x[n:, None]) - polygon).unrotate(cos, sin)  # in the polygon's frame
    radius = model.radius[:, None]
    start, end, missing = (jax.tree.map(lambda x: x[:, None], edge) for edge in _edges(model))

    edge, to_centre = end - start, centre - start
    length = edge.norm()
    along = edge.scale(1 / nonzero(length))
    clipped = start + along.scale(jnp.clip(along.dot(to_centre), 0.0, length))
    gap = jnp.where(missing, FAR, (clipped - centre).norm())
    inside = (missing | (edge.cross(to_centre) < 0)).all(0)  # clockwise: the inside lies to the right
    distance = gap.min(0)
    nearest = _first(gap == distance)
    closest = clipped.map(lambda x: _pick(x, nearest))

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
