"""The contact constraint: non-penetration with friction, solved by sequential impulses.

**Velocity.** Bodies a and b touch at the point p, with the unit normal n from a to b. A body's point moves with
v + w x r, where r = p - centre, so the bodies approach each other along n with

    u = (v_b + w_b x r_b - v_a - w_a x r_a) . n        m/s; negative: they approach

**Impulse.** A normal impulse j at p adds -j n to the momentum of a and j n to that of b, and changes u by K j:

    K = 1/m_a + 1/m_b + (r_a x n)^2 / I_a + (r_b x n)^2 / I_b        1/kg; 1/K is the effective mass

so j = (target - u) / K brings this one contact to its target velocity. The target has two parts. Position correction
(Baumgarte) undoes a share of the penetration: contact_bias / dt * max(penetration - slop, 0). The slop stays, so that a
resting contact is found again in the next step instead of flickering. Restitution adds -e u0, with u0 the velocity
before the solver starts and e the smaller coefficient of the two bodies.

**Accumulation.** One contact's impulse disturbs its neighbours, so `solve` passes over all of them ten times. Each pass
clamps the *sum* of a contact's impulses to j >= 0, not the increment: a later pass may take back an earlier one's
excess. Friction does the same along the tangent t = (n.y, -n.x), where Coulomb's cone bounds the sum by
|j_t| <= friction * j. Friction combines as sqrt((f a)^2 + (f b)^2), f = base_friction.

**Warm starting.** A contact that was active in the last step starts from the impulses that it ended with there. A stack
at rest then starts from its solution, where ten passes from zero would let it sag.

**Batches.** All contacts of a solver batch read the same velocities, and their impulses add up (Jacobi); batches follow
one another (Gauss-Seidel). The reference batches pairs this way for its accelerator, so batches are part of its result.

Sources: E. Catto, "Fast and Simple Physics using Sequential Impulses", GDC 2006, and Box2D-Lite, for the method;
`jax2d.collision.resolve_collision` for the constants and the order. Joints move bodies within an iteration, so each
pass recomputes the lever arms r; Box2D-Lite computes them once a step.
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

NO_BATCH = -1.0  # the contact does not push in this lane


class Contact(NamedTuple):
    """One contact of a pair of bodies, as collision detection finds it; leaves [lane]."""

    active: Array
    normal: Vec  # from the pair's first body to its second
    penetration: Array  # m
    point: Vec  # m, in the world


class Levers(NamedTuple):
    """Lever arms of a contact; r goes from a body's centre to the contact point."""

    normal: Vec  # n
    cross_a: Array  # r x n
    cross_b: Array
    dot_a: Array  # r . n; the tangent is (n.y, -n.x), so r x t = -(r . n)
    dot_b: Array


def clear(block: Block) -> None:
    """Reset all contacts: none pushes, none is remembered, none is recorded as active."""
    constraints, after, contacts = block.scratch.constraints, block.after, block.contacts

    def blank(ref):
        def one(i):
            ref[i] = jnp.zeros_like(ref[i])

        return one

    kept = after.contact_active, after.contact_normal_impulse, after.contact_tangent_impulse
    for ref in (*kept, constraints.touching, constraints.counts):
        each(ref.shape[0], blank(ref))
    if contacts is not None:

        def blank_all(c):
            for ref in (
                contacts.active,
                contacts.normal,
                contacts.penetration,
                contacts.point,
                contacts.restitution_velocity,
            ):
                ref[c] = jnp.zeros_like(ref[c])

        each(contacts.active.shape[0], blank_all)


def count_touching(block: Block, kind: int, contacts: list[Contact]) -> Float[Array, " lane"]:
    """Count the pair, if touching, for its kind; return the running count.

    A pair touches in the lanes in which any of its contacts is active. The count decides its solver batch.
    """
    touching = functools.reduce(jnp.logical_or, (contact.active for contact in contacts))
    so_far = block.scratch.constraints.touching[kind] + touching
    block.scratch.constraints.touching[kind] = so_far
    return so_far


def bounce(block: Block, a: Scalar, b: Scalar, contact: Contact) -> Float[Array, " lane"]:
    """Return e u0, m/s: the approach velocity times the smaller restitution (negative where the bodies approach)."""
    model, bodies = block.model, block.scratch.bodies

    def point_velocity(body):
        motion = bodies.motion[body]
        return velocity(motion) + spin(motion[4], contact.point - position(motion))

    approach = (point_velocity(b) - point_velocity(a)).dot(contact.normal)
    return approach * jnp.minimum(model.restitution[a], model.restitution[b])


def record(block: Block, c: Scalar, contact: Contact) -> None:
    """Record a contact in `block.contacts`, if the caller asked for contacts; zero in inactive lanes."""
    contacts, table = block.contacts, block.table
    if contacts is None:
        return
    keep = lambda x: jnp.where(contact.active, x, 0.0)
    contacts.active[c] = contact.active
    contacts.normal[c] = keep(jnp.stack([*contact.normal]))
    contacts.penetration[c] = keep(contact.penetration)
    contacts.point[c] = keep(jnp.stack([*contact.point]))
    contacts.restitution_velocity[c] = keep(bounce(block, table.a[c], table.b[c], contact))


def prepare(
    block: Block, params: Params, c: Scalar, contact: Contact, group: int, so_far: Float[Array, " lane"]
) -> None:
    """Prepare contact c as a constraint and warm-start it.

    Args:
        c: index of the contact.
        group: index of its group (`pairs.KIND_OF_GROUP`).
        so_far: running count of touching pairs, from `count_touching`.
    """
    model, a, b = block.model, block.table.a[c], block.table.b[c]
    mass_a, mass_b = model.inverse_mass[a], model.inverse_mass[b]
    acts = contact.active & model.collides[a, b] & ((mass_a != 0) | (mass_b != 0))
    block.after.contact_active[c] = contact.active
    keep = lambda x: jnp.where(acts, x, 0.0)

    def constrain():
        before, bodies, constraints = block.inputs.before, block.scratch.bodies, block.scratch.constraints
        excess = jnp.maximum(contact.penetration - params.slop, 0.0)
        target = params.contact_bias / params.dt * excess - bounce(block, a, b, contact)
        rough = lambda body: jnp.square(model.friction[body] * params.base_friction)
        friction = jnp.sqrt(rough(a) + rough(b))
        inertia = [keep(model.inverse_inertia[body]) for body in (a, b)]
        constraints.geometry[c] = keep(jnp.stack([*contact.normal, *contact.point]))
        constraints.effort[c] = jnp.stack([keep(target), keep(friction), keep(mass_a + mass_b), *inertia])
        remembered = acts & before.contact_active[c]  # where the contact acted in the last step and does now
        last = jnp.stack([before.contact_normal_impulse[c], before.contact_tangent_impulse[c]])
        impulse = jnp.where(remembered, last, 0.0)
        constraints.impulse[c] = impulse
        # The count stands in until `assign_batches` knows the batch
        constraints.batch[c] = jnp.where(acts, so_far, NO_BATCH)
        constraints.acting[block.table.start[group] + constraints.counts[group]] = c
        constraints.counts[group] += 1
        normal, point = _geometry(constraints, c)
        lever = _levers(bodies.motion[a], bodies.motion[b], normal, point)
        _push(bodies, a, b, lever, acts, (impulse[0], impulse[1]))

    when(anywhere(acts), constrain)


def assign_batches(block: Block) -> None:
    """Assign each contact that pushes to its solver batch, and list the contacts of every batch.

    The reference sorts the pairs of a kind stably, those that do not touch first, and puts the pair of rank p, from 0,
    into batch p mod batches. If A of N pairs touch, the k-th of these, k from 1, has rank N - A + k - 1. So arithmetic
    replaces the sort.
    """
    constraints, table = block.scratch.constraints, block.table

    def assign(group):
        kind, batches = table.kind[group], table.batches[group]
        first = table.pairs[group] - constraints.touching[kind] - 1

        def one(k):
            c = constraints.acting[k]
            rank = first + constraints.batch[c]
            turn = rank - batches * jnp.floor((rank + 0.5) / batches)  # rank mod batches, exact for these integers
            constraints.batch[c] = jnp.where(constraints.batch[c] == NO_BATCH, NO_BATCH, turn)

        each(table.start[group] + constraints.counts[group], one, first=table.start[group])

    def fill(s, filled):
        group, turn = table.group[s], table.turn[s]

        def list_if_in(k, filled):
            c = constraints.acting[k]
            constraints.listed[filled] = c  # overwritten by the next contact if no lane has c in this batch
            return filled + anywhere(constraints.batch[c] == turn)

        first = table.start[group]
        filled = jax.lax.fori_loop(first, first + constraints.counts[group], list_if_in, filled)
        constraints.ends[s + 1] = filled
        return filled

    each(GROUPS, assign)
    constraints.ends[0] = jnp.int32(0)
    jax.lax.fori_loop(0, table.segments, fill, jnp.int32(0))


def solve(block: Block) -> None:
    """Run one pass over the contacts, batch by batch.

    A batch only adds to `push`; bodies yield to its impulses when the batch is over. If a batch has few contacts, only
    their bodies yield, else all do: the result is the same, but the loop is shorter.
    """
    bodies, constraints, table = block.scratch.bodies, block.scratch.constraints, block.table

    def batch(s):
        def one(k):
            _solve_one(block, constraints.listed[k], s)

        def yield_both(k):
            for body in (table.a[constraints.listed[k]], table.b[constraints.listed[k]]):
                when(body >= FIXED_POLYGONS, functools.partial(yield_one, block, body))

        first, end = constraints.ends[s], constraints.ends[s + 1]
        each(end, one, first=first)
        few = 2 * (end - first) < bodies.motion.shape[0] - FIXED_POLYGONS
        when(few, lambda: each(end, yield_both, first=first))
        when(~few, lambda: yield_all(block))

    each(table.segments, batch)


def remember(block: Block) -> None:
    """Store the accumulated impulses for the warm start of the next step."""
    after, constraints, table = block.after, block.scratch.constraints, block.table

    def write(k):
        c = constraints.acting[k]
        after.contact_normal_impulse[c] = constraints.impulse[c, 0]
        after.contact_tangent_impulse[c] = constraints.impulse[c, 1]

    each(GROUPS, lambda group: each(table.start[group] + constraints.counts[group], write, first=table.start[group]))


def _geometry(constraints: Constraints, c: Scalar) -> tuple[Vec, Vec]:
    n_x, n_y, p_x, p_y = constraints.geometry[c]
    return Vec(n_x, n_y), Vec(p_x, p_y)


def _levers(motion_a: Array, motion_b: Array, normal: Vec, point: Vec) -> Levers:
    r_a, r_b = point - position(motion_a), point - position(motion_b)
    return Levers(normal, r_a.cross(normal), r_b.cross(normal), r_a.dot(normal), r_b.dot(normal))


def _solve_one(block: Block, c: Scalar, segment: Scalar) -> None:
    """Bring contact c to its target velocity, with accumulated impulses clamped to j >= 0 and to the friction cone.

    Acts in the lanes in which the contact belongs to the batch of this segment; other lanes keep their impulses.
    """
    bodies, constraints, table = block.scratch.bodies, block.scratch.constraints, block.table
    a, b, mine, kept = table.a[c], table.b[c], constraints.batch[c] == table.turn[segment], table.kept[c]
    n, point = _geometry(constraints, c)
    target, friction, mass, inertia_a, inertia_b = constraints.effort[c]
    before_normal, before_tangent = constraints.impulse[c]
    motion_a, motion_b = bodies.motion[a], bodies.motion[b]
    lever = _levers(motion_a, motion_b, n, point)
    mass_normal = 1 / nonzero(mass + inertia_a * jnp.square(lever.cross_a) + inertia_b * jnp.square(lever.cross_b))
    mass_tangent = 1 / nonzero(mass + inertia_a * jnp.square(lever.dot_a) + inertia_b * jnp.square(lever.dot_b))
    # Friction is solved after the normal impulse, but from the velocities before it: `coupling` is the change of
    # tangential velocity per unit of normal impulse, which turns the bodies
    coupling = inertia_a * lever.cross_a * lever.dot_a + inertia_b * lever.cross_b * lever.dot_b

    v, w_a, w_b = velocity(motion_b) - velocity(motion_a), motion_a[4], motion_b[4]
    approach = v.dot(n) + w_b * lever.cross_b - w_a * lever.cross_a
    normal = jnp.maximum(before_normal + mass_normal * (target - approach), 0.0)
    slide = v.x * n.y - v.y * n.x - w_b * lever.dot_b + w_a * lever.dot_a - (normal - before_normal) * coupling
    limit = friction * normal
    tangent = jnp.clip(before_tangent - mass_tangent * slide, -limit, limit)
    # kept is 0 for the pairs whose accumulated impulses the reference's padding defect resets (docs/physics.md)
    constraints.impulse[c] = jnp.stack(
        [jnp.where(mine, normal * kept, before_normal), jnp.where(mine, tangent * kept, before_tangent)]
    )
    _push(bodies, a, b, lever, mine, (normal - before_normal, tangent - before_tangent))


def _push(
    bodies: Bodies, a: Scalar, b: Scalar, lever: Levers, mine: Bool[Array, " lane"], impulse: tuple[Array, Array]
) -> None:
    """Add a contact's impulses to both bodies, in the lanes where `mine` holds.

    Args:
        impulse: along the normal and along the tangent, N s.
    """
    n, (normal, tangent) = lever.normal, impulse
    only = lambda x: jnp.where(mine, x, 0.0)
    x, y = only(normal * n.x + tangent * n.y), only(normal * n.y - tangent * n.x)
    bodies.push[a] += jnp.stack([-x, -y, only(tangent * lever.dot_a - normal * lever.cross_a)])
    bodies.push[b] += jnp.stack([x, y, only(normal * lever.cross_b - tangent * lever.dot_b)])
