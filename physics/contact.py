"""The contact constraint: non-penetration with friction, by accumulated impulses (Catto's sequential impulses).

All contacts of a solver batch read the same velocities; what they do to a body adds up.
Facts: `jax2d.collision.resolve_collision`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from physics.body import Bodies, place, velocity, yield_all, yield_one
from physics.lanes import Ref, anywhere, each, when
from physics.pairs import GROUPS, Table
from physics.types import FIXED_POLYGONS, Manifold, Model, Params, State
from physics.vector import Vec, nonzero, spin

NONE = -1.0  # instead of a batch


class Contact(NamedTuple):
    """One contact of a pair of bodies, as geometry finds it; leaves [lane]."""

    active: Array
    normal: Vec  # from the pair's first body to its second
    penetration: Array  # m
    point: Vec  # m, in the world


class Constraints(NamedTuple):
    """References, one row a contact. Only rows of contacts that act in any lane are ever read.

    A group are the first points of polygon pairs, their second points, circle-polygon pairs, or pairs of circles.
    """

    geometry: Ref  # [contact, 4, lane]: normal x, y, point x, y
    effort: Ref  # [contact, 5, lane]: target (m/s along the normal), friction, both inverse masses, inverse inertias
    impulse: Ref  # [contact, 2, lane]: accumulated, normal and tangent, N s
    batch: Ref  # [contact, lane]: number of the solver batch; NONE where it does not push
    touching: Ref  # [kind, lane]: how many pairs of a kind touch
    acting: Ref  # numbers of the contacts that push in any lane, each group from the place of its first contact
    counts: Ref  # [group]: how many these are
    listed: Ref  # the same, by solver batch
    ends: Ref  # [segment + 1]: where each batch begins and ends in `listed`


class Arms(NamedTuple):
    """Geometry of a contact; r goes from a body's centre to the contact point."""

    cross_a: Array  # r x n
    cross_b: Array
    dot_a: Array  # r . n; the tangent is (n.y, -n.x), so r x t = -(r . n)
    dot_b: Array


def clear(constraints: Constraints, after: State) -> None:
    """No contact acts, none is remembered."""

    def blank(ref):
        def one(i):
            ref[i] = jnp.zeros_like(ref[i])

        return one

    for ref in (after.contact_active, after.contact_normal_impulse, after.contact_tangent_impulse):
        each(ref.shape[0], blank(ref))
    for ref in (constraints.touching, constraints.counts):
        each(ref.shape[0], blank(ref))


def rank(constraints: Constraints, kind: int, contacts: list[Contact]) -> Float[Array, " lane"]:
    """The how-manieth touching pair of its kind a pair is, from 1: it touches where any of its contacts is active."""
    touching = functools.reduce(jnp.logical_or, (contact.active for contact in contacts))
    so_far = constraints.touching[kind] + touching
    constraints.touching[kind] = so_far
    return so_far


def bounce(model: Model, bodies: Bodies, a, b, contact: Contact) -> Float[Array, " lane"]:
    """Velocity along the normal that restitution asks for, m/s."""

    def point_velocity(body):
        motion = bodies.motion[body]
        return velocity(motion) + spin(motion[4], contact.point - place(motion))

    approach = (point_velocity(b) - point_velocity(a)).dot(contact.normal)
    return approach * jnp.minimum(model.restitution[a], model.restitution[b])


def see_nothing(seen: Manifold) -> None:
    """No contact is active."""

    def blank(c):
        for ref in (seen.active, seen.normal, seen.penetration, seen.point, seen.restitution_velocity):
            ref[c] = jnp.zeros_like(ref[c])

    each(seen.active.shape[0], blank)


def see(seen: Manifold, model: Model, bodies: Bodies, c, table: Table, contact: Contact) -> None:
    """Write a contact down, zero where it is not active."""
    keep = lambda x: jnp.where(contact.active, x, 0.0)
    seen.active[c] = contact.active
    seen.normal[c] = keep(jnp.stack([*contact.normal]))
    seen.penetration[c] = keep(contact.penetration)
    seen.point[c] = keep(jnp.stack([*contact.point]))
    seen.restitution_velocity[c] = keep(bounce(model, bodies, table.a[c], table.b[c], contact))


def prepare(
    model: Model, before: State, after: State, bodies: Bodies, to: Constraints, c, group: int,
    rank: Float[Array, " lane"], table: Table, contact: Contact, params: Params,
) -> None:  # fmt: skip
    """Contact c as a constraint, pushing with what it remembers of the last step's impulses."""
    a, b = table.a[c], table.b[c]
    mass_a, mass_b = model.inverse_mass[a], model.inverse_mass[b]
    acts = contact.active & model.collides[a, b] & ((mass_a != 0) | (mass_b != 0))
    after.contact_active[c] = contact.active

    def constrain():
        keep = lambda x: jnp.where(acts, x, 0.0)
        excess = jnp.maximum(contact.penetration - params.slop, 0.0)
        target = params.contact_bias / params.dt * excess - bounce(model, bodies, a, b, contact)
        rough = lambda body: jnp.square(model.friction[body] * params.base_friction)
        friction = jnp.sqrt(rough(a) + rough(b))
        inertia = [keep(model.inverse_inertia[body]) for body in (a, b)]
        to.geometry[c] = keep(jnp.stack([*contact.normal, *contact.point]))
        to.effort[c] = jnp.stack([keep(target), keep(friction), keep(mass_a + mass_b), *inertia])
        remembered = acts & before.contact_active[c]
        last = jnp.stack([before.contact_normal_impulse[c], before.contact_tangent_impulse[c]])
        impulse = jnp.where(remembered, last, 0.0)
        to.impulse[c] = impulse
        to.batch[c] = jnp.where(acts, rank, NONE)  # until `share_out` knows the batch
        to.acting[table.start[group] + to.counts[group]] = c
        to.counts[group] += 1
        normal, point = _geometry(to, c)
        arm = _arms(bodies.motion[a], bodies.motion[b], normal, point)
        _push(bodies, a, b, acts, normal, arm, impulse[0], impulse[1])

    when(anywhere(acts), constrain)


def share_out(to: Constraints, table: Table) -> None:
    """Share the contacts that act out into solver batches.

    The reference sorts the pairs of a kind stably, those that do not touch first, and the pair at sorted place p
    belongs to batch p mod batches: the k-th of A touching pairs among N stands at place N - A + k.
    """

    def place(group):
        kind, batches = table.kind[group], table.batches[group]
        first = table.pairs[group] - to.touching[kind] - 1

        def one(k):
            c = to.acting[k]
            place = first + to.batch[c]
            turn = place - batches * jnp.floor((place + 0.5) / batches)  # exact: whole numbers
            to.batch[c] = jnp.where(to.batch[c] == NONE, NONE, turn)

        each(table.start[group] + to.counts[group], one, first=table.start[group])

    def fill(s, filled):
        group, turn = table.group[s], table.turn[s]

        def list_if_in(k, filled):
            c = to.acting[k]
            to.listed[filled] = c  # the next one takes its place if it is in another batch
            return filled + anywhere(to.batch[c] == turn)

        first = table.start[group]
        filled = jax.lax.fori_loop(first, first + to.counts[group], list_if_in, filled)
        to.ends[s + 1] = filled
        return filled

    each(GROUPS, place)
    to.ends[0] = jnp.int32(0)
    jax.lax.fori_loop(0, table.segments, fill, jnp.int32(0))


def solve(model: Model, bodies: Bodies, to: Constraints, table: Table) -> None:
    """One pass over the contacts, batch by batch."""

    def batch(s):
        def one(k):
            c = to.listed[k]
            _solve_one(bodies, to, c, table.a[c], table.b[c], to.batch[c] == table.turn[s], table.kept[c])

        def yield_both(k):
            for body in (table.a[to.listed[k]], table.b[to.listed[k]]):
                when(body >= FIXED_POLYGONS, functools.partial(yield_one, model, bodies, body))

        first, end = to.ends[s], to.ends[s + 1]
        each(end, one, first=first)
        few = 2 * (end - first) < bodies.motion.shape[0] - FIXED_POLYGONS
        when(few, lambda: each(end, yield_both, first=first))
        when(~few, lambda: yield_all(model, bodies))

    each(table.segments, batch)


def remember(after: State, to: Constraints, table: Table) -> None:
    """Hand the accumulated impulses to the next step."""

    def write(k):
        c = to.acting[k]
        after.contact_normal_impulse[c] = to.impulse[c, 0]
        after.contact_tangent_impulse[c] = to.impulse[c, 1]

    each(GROUPS, lambda group: each(table.start[group] + to.counts[group], write, first=table.start[group]))


def _geometry(to: Constraints, c) -> tuple[Vec, Vec]:
    n_x, n_y, p_x, p_y = to.geometry[c]
    return Vec(n_x, n_y), Vec(p_x, p_y)


def _arms(motion_a: Array, motion_b: Array, normal: Vec, point: Vec) -> Arms:
    r_a, r_b = point - place(motion_a), point - place(motion_b)
    return Arms(r_a.cross(normal), r_b.cross(normal), r_a.dot(normal), r_b.dot(normal))


def _solve_one(bodies: Bodies, to: Constraints, c, a, b, mine: Bool[Array, " lane"], kept: Float[Array, ""]) -> None:
    """The accumulated impulses that bring a contact to its target, clamped to push and to the friction cone."""
    n, point = _geometry(to, c)
    target, friction, mass, inertia_a, inertia_b = to.effort[c]
    before_normal, before_tangent = to.impulse[c]
    motion_a, motion_b = bodies.motion[a], bodies.motion[b]
    arm = _arms(motion_a, motion_b, n, point)
    mass_normal = 1 / nonzero(mass + inertia_a * jnp.square(arm.cross_a) + inertia_b * jnp.square(arm.cross_b))
    mass_tangent = 1 / nonzero(mass + inertia_a * jnp.square(arm.dot_a) + inertia_b * jnp.square(arm.dot_b))
    # how a normal impulse changes the tangential velocity
    coupling = inertia_a * arm.cross_a * arm.dot_a + inertia_b * arm.cross_b * arm.dot_b

    v, w_a, w_b = velocity(motion_b) - velocity(motion_a), motion_a[4], motion_b[4]
    approach = v.dot(n) + w_b * arm.cross_b - w_a * arm.cross_a
    normal = jnp.maximum(before_normal + mass_normal * (target - approach), 0.0)
    slide = v.x * n.y - v.y * n.x - w_b * arm.dot_b + w_a * arm.dot_a - (normal - before_normal) * coupling
    limit = friction * normal
    tangent = jnp.clip(before_tangent - mass_tangent * slide, -limit, limit)
    # the padding defect forgets the accumulated impulses of some pairs: kept is 0
    to.impulse[c] = jnp.stack(
        [jnp.where(mine, normal * kept, before_normal), jnp.where(mine, tangent * kept, before_tangent)]
    )
    _push(bodies, a, b, mine, n, arm, normal - before_normal, tangent - before_tangent)


def _push(bodies: Bodies, a, b, mine: Array, n: Vec, arm: Arms, normal: Array, tangent: Array) -> None:
    """Push both bodies of a contact apart, in the lanes that it is `mine` in."""
    only = lambda x: jnp.where(mine, x, 0.0)
    x, y = only(normal * n.x + tangent * n.y), only(normal * n.y - tangent * n.x)
    bodies.push[a] += jnp.stack([-x, -y, only(tangent * arm.dot_a - normal * arm.cross_a)])
    bodies.push[b] += jnp.stack([x, y, only(normal * arm.cross_b - tangent * arm.dot_b)])
