"""The contact constraint: non-penetration with friction, by accumulated impulses (Catto's sequential impulses).

All contacts of a solver batch read the same velocities; what they do to a body adds up.
Facts: `jax2d.collision.resolve_collision`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from levelproof.physics.block import Block, Bodies, Constraints
from levelproof.physics.body import position, velocity, yield_all, yield_one
from levelproof.physics.lanes import Scalar, anywhere, each, when
from levelproof.physics.pairs import GROUPS
from levelproof.physics.types import FIXED_POLYGONS, Params
from levelproof.physics.vector import Vec, nonzero, spin

NONE = -1.0  # instead of a batch


class Contact(NamedTuple):
    """One contact of a pair of bodies, as geometry finds it; leaves [lane]."""

    active: Array
    normal: Vec  # from the pair's first body to its second
    penetration: Array  # m
    point: Vec  # m, in the world


class Levers(NamedTuple):
    """Geometry of a contact; r goes from a body's centre to the contact point."""

    normal: Vec  # n
    cross_a: Array  # r x n
    cross_b: Array
    dot_a: Array  # r . n; the tangent is (n.y, -n.x), so r x t = -(r . n)
    dot_b: Array


def clear(block: Block) -> None:
    """No contact acts, none is remembered, and none is active, if anybody looks."""
    constraints, after, seen = block.scratch.constraints, block.after, block.seen

    def blank(ref):
        def one(i):
            ref[i] = jnp.zeros_like(ref[i])

        return one

    contacts = after.contact_active, after.contact_normal_impulse, after.contact_tangent_impulse
    for ref in (*contacts, constraints.touching, constraints.counts):
        each(ref.shape[0], blank(ref))
    if seen is not None:

        def blank_all(c):
            for ref in (seen.active, seen.normal, seen.penetration, seen.point, seen.restitution_velocity):
                ref[c] = jnp.zeros_like(ref[c])

        each(seen.active.shape[0], blank_all)


def count_touching(block: Block, kind: int, contacts: list[Contact]) -> Float[Array, " lane"]:
    """The how-manieth touching pair of its kind a pair is, from 1: it touches where any of its contacts is active."""
    touching = functools.reduce(jnp.logical_or, (contact.active for contact in contacts))
    so_far = block.scratch.constraints.touching[kind] + touching
    block.scratch.constraints.touching[kind] = so_far
    return so_far


def bounce(block: Block, a: Scalar, b: Scalar, contact: Contact) -> Float[Array, " lane"]:
    """Velocity along the normal that restitution asks for, m/s."""
    model, bodies = block.model, block.scratch.bodies

    def point_velocity(body):
        motion = bodies.motion[body]
        return velocity(motion) + spin(motion[4], contact.point - position(motion))

    approach = (point_velocity(b) - point_velocity(a)).dot(contact.normal)
    return approach * jnp.minimum(model.restitution[a], model.restitution[b])


def see(block: Block, c: Scalar, contact: Contact) -> None:
    """Write a contact down, zero where it is not active, if anybody looks."""
    seen, table = block.seen, block.table
    if seen is None:
        return
    keep = lambda x: jnp.where(contact.active, x, 0.0)
    seen.active[c] = contact.active
    seen.normal[c] = keep(jnp.stack([*contact.normal]))
    seen.penetration[c] = keep(contact.penetration)
    seen.point[c] = keep(jnp.stack([*contact.point]))
    seen.restitution_velocity[c] = keep(bounce(block, table.a[c], table.b[c], contact))


def prepare(
    block: Block, params: Params, c: Scalar, contact: Contact, group: int, so_far: Float[Array, " lane"]
) -> None:
    """Contact c as a constraint, pushing with what it remembers; `so_far`: see `count_touching`."""
    model, a, b = block.model, block.table.a[c], block.table.b[c]
    mass_a, mass_b = model.inverse_mass[a], model.inverse_mass[b]
    acts = contact.active & model.collides[a, b] & ((mass_a != 0) | (mass_b != 0))
    block.after.contact_active[c] = contact.active
    keep = lambda x: jnp.where(acts, x, 0.0)

    def constrain():
        before, bodies, to = block.given.before, block.scratch.bodies, block.scratch.constraints
        excess = jnp.maximum(contact.penetration - params.slop, 0.0)
        target = params.contact_bias / params.dt * excess - bounce(block, a, b, contact)
        rough = lambda body: jnp.square(model.friction[body] * params.base_friction)
        friction = jnp.sqrt(rough(a) + rough(b))
        inertia = [keep(model.inverse_inertia[body]) for body in (a, b)]
        to.geometry[c] = keep(jnp.stack([*contact.normal, *contact.point]))
        to.effort[c] = jnp.stack([keep(target), keep(friction), keep(mass_a + mass_b), *inertia])
        remembered = acts & before.contact_active[c]  # where the contact acted in the last step and does now
        last = jnp.stack([before.contact_normal_impulse[c], before.contact_tangent_impulse[c]])
        impulse = jnp.where(remembered, last, 0.0)
        to.impulse[c] = impulse
        to.batch[c] = jnp.where(acts, so_far, NONE)  # until `share_out` knows the batch
        to.acting[block.table.start[group] + to.counts[group]] = c
        to.counts[group] += 1
        normal, point = _geometry(to, c)
        lever = _levers(bodies.motion[a], bodies.motion[b], normal, point)
        _push(bodies, a, b, lever, acts, (impulse[0], impulse[1]))

    when(anywhere(acts), constrain)


def share_out(block: Block) -> None:
    """Share the contacts that act out into solver batches.

    The reference sorts the pairs of a kind stably, those that do not touch first, and the pair of rank p, from 0,
    belongs to batch p mod batches: the k-th of A touching pairs among N, k from 1, has rank N - A + k - 1.
    """
    to, table = block.scratch.constraints, block.table

    def assign(group):
        kind, batches = table.kind[group], table.batches[group]
        first = table.pairs[group] - to.touching[kind] - 1

        def one(k):
            c = to.acting[k]
            rank = first + to.batch[c]
            turn = rank - batches * jnp.floor((rank + 0.5) / batches)  # exact: whole numbers
            to.batch[c] = jnp.where(to.batch[c] == NONE, NONE, turn)

        each(table.start[group] + to.counts[group], one, first=table.start[group])

    def fill(s, filled):
        group, turn = table.group[s], table.turn[s]

        def list_if_in(k, filled):
            c = to.acting[k]
            to.listed[filled] = c  # the next one overwrites it if it is in another batch
            return filled + anywhere(to.batch[c] == turn)

        first = table.start[group]
        filled = jax.lax.fori_loop(first, first + to.counts[group], list_if_in, filled)
        to.ends[s + 1] = filled
        return filled

    each(GROUPS, assign)
    to.ends[0] = jnp.int32(0)
    jax.lax.fori_loop(0, table.segments, fill, jnp.int32(0))


def solve(block: Block) -> None:
    """One pass over the contacts, batch by batch."""
    bodies, to, table = block.scratch.bodies, block.scratch.constraints, block.table

    def batch(s):
        def one(k):
            _solve_one(block, to.listed[k], s)

        def yield_both(k):
            for body in (table.a[to.listed[k]], table.b[to.listed[k]]):
                when(body >= FIXED_POLYGONS, functools.partial(yield_one, block, body))

        first, end = to.ends[s], to.ends[s + 1]
        each(end, one, first=first)
        few = 2 * (end - first) < bodies.motion.shape[0] - FIXED_POLYGONS
        when(few, lambda: each(end, yield_both, first=first))
        when(~few, lambda: yield_all(block))

    each(table.segments, batch)


def remember(block: Block) -> None:
    """Hand the accumulated impulses to the next step."""
    after, to, table = block.after, block.scratch.constraints, block.table

    def write(k):
        c = to.acting[k]
        after.contact_normal_impulse[c] = to.impulse[c, 0]
        after.contact_tangent_impulse[c] = to.impulse[c, 1]

    each(GROUPS, lambda group: each(table.start[group] + to.counts[group], write, first=table.start[group]))


def _geometry(to: Constraints, c: Scalar) -> tuple[Vec, Vec]:
    n_x, n_y, p_x, p_y = to.geometry[c]
    return Vec(n_x, n_y), Vec(p_x, p_y)


def _levers(motion_a: Array, motion_b: Array, normal: Vec, point: Vec) -> Levers:
    r_a, r_b = point - position(motion_a), point - position(motion_b)
    return Levers(normal, r_a.cross(normal), r_b.cross(normal), r_a.dot(normal), r_b.dot(normal))


def _solve_one(block: Block, c: Scalar, segment: Scalar) -> None:
    """The accumulated impulses that bring a contact to its target, clamped to push and to the friction cone.

    Only in the lanes in which the contact belongs to the batch whose turn it is.
    """
    bodies, to, table = block.scratch.bodies, block.scratch.constraints, block.table
    a, b, mine, kept = table.a[c], table.b[c], to.batch[c] == table.turn[segment], table.kept[c]
    n, point = _geometry(to, c)
    target, friction, mass, inertia_a, inertia_b = to.effort[c]
    before_normal, before_tangent = to.impulse[c]
    motion_a, motion_b = bodies.motion[a], bodies.motion[b]
    lever = _levers(motion_a, motion_b, n, point)
    mass_normal = 1 / nonzero(mass + inertia_a * jnp.square(lever.cross_a) + inertia_b * jnp.square(lever.cross_b))
    mass_tangent = 1 / nonzero(mass + inertia_a * jnp.square(lever.dot_a) + inertia_b * jnp.square(lever.dot_b))
    # how a normal impulse changes the tangential velocity
    coupling = inertia_a * lever.cross_a * lever.dot_a + inertia_b * lever.cross_b * lever.dot_b

    v, w_a, w_b = velocity(motion_b) - velocity(motion_a), motion_a[4], motion_b[4]
    approach = v.dot(n) + w_b * lever.cross_b - w_a * lever.cross_a
    normal = jnp.maximum(before_normal + mass_normal * (target - approach), 0.0)
    slide = v.x * n.y - v.y * n.x - w_b * lever.dot_b + w_a * lever.dot_a - (normal - before_normal) * coupling
    limit = friction * normal
    tangent = jnp.clip(before_tangent - mass_tangent * slide, -limit, limit)
    # the padding defect forgets the accumulated impulses of some pairs: kept is 0
    to.impulse[c] = jnp.stack(
        [jnp.where(mine, normal * kept, before_normal), jnp.where(mine, tangent * kept, before_tangent)]
    )
    _push(bodies, a, b, lever, mine, (normal - before_normal, tangent - before_tangent))


def _push(
    bodies: Bodies, a: Scalar, b: Scalar, lever: Levers, mine: Bool[Array, " lane"], impulse: tuple[Array, Array]
) -> None:
    """Push both bodies of a contact apart, in the lanes that it is `mine` in; `impulse`: normal and tangent, N s."""
    n, (normal, tangent) = lever.normal, impulse
    only = lambda x: jnp.where(mine, x, 0.0)
    x, y = only(normal * n.x + tangent * n.y), only(normal * n.y - tangent * n.x)
    bodies.push[a] += jnp.stack([-x, -y, only(tangent * lever.dot_a - normal * lever.cross_a)])
    bodies.push[b] += jnp.stack([x, y, only(normal * lever.cross_b - tangent * lever.dot_b)])
