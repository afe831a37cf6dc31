"""The contact constraint: non-penetration with friction, by accumulated impulses (Catto's sequential impulses).

One *sweep* lets every contact of a solver batch read the same velocities and adds up their changes.
Facts: `jax2d.collision.resolve_collision`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics.motion import Motion, add_rows
from physics.pairs import PairKind
from physics.types import Manifold, Model, Params, State
from physics.vector import Vec, nonzero, rows, vec


class Impulse(NamedTuple):
    """Accumulated over the iterations of a step, N s."""

    normal: Float[Array, "pair lane"]
    tangent: Float[Array, "pair lane"]


class Contact(NamedTuple):
    """One contact of every pair of a kind; constant over a step. Zero where it may not act."""

    pair: PairKind
    acts: Bool[Array, "pair lane"]
    batch: Int[Array, "pair lane"] | None  # solver batch; None where there is only one
    normal: Vec
    point: Vec
    target: Float[Array, "pair lane"]  # m/s along the normal that the constraint asks for
    friction: Float[Array, "pair lane"]


class Arms(NamedTuple):
    """Geometry of a contact for the present positions: r x n, r . n, effective masses."""

    cross_a: Array
    cross_b: Array
    dot_a: Array
    dot_b: Array
    mass_normal: Array
    mass_tangent: Array
    coupling: Array  # how a normal impulse changes the tangential velocity


def prepare(
    model: Model, state: State, manifold: Manifold, pair: PairKind, at: slice, touching: Bool[Array, "pair lane"], params: Params
) -> tuple[Contact, Impulse]:
    """The contacts `at` of a manifold as constraints, with their warm-start impulses.

    `touching` says which pairs have any active contact: they decide the solver batches.
    """
    active = manifold.active[at]
    mass_a, mass_b = rows(model.inverse_mass, pair.a), rows(model.inverse_mass, pair.b)
    collides = jnp.stack([model.collides[a, b] for a, b in zip(pair.a, pair.b, strict=True)])
    acts = active & collides & ~((mass_a == 0) & (mass_b == 0))
    keep = lambda x: jnp.where(acts, x, 0.0)
    excess = jnp.maximum(manifold.penetration[at] - params.slop, 0.0)
    target = params.contact_bias / params.dt * excess - manifold.restitution_velocity[at]
    rough = lambda body: jnp.square(rows(model.friction, body) * params.base_friction)
    contact = Contact(
        pair=pair,
        acts=acts,
        batch=_batch(touching, pair) if pair.batches > 1 else None,
        normal=vec(manifold.normal[at]).map(keep),
        point=vec(manifold.point[at]).map(keep),
        target=keep(target),
        friction=jnp.sqrt(rough(pair.a) + rough(pair.b)),
    )
    remembered = acts & state.contact_active[at]
    impulse = Impulse(
        jnp.where(remembered, state.contact_normal_impulse[at], 0.0),
        jnp.where(remembered, state.contact_tangent_impulse[at], 0.0),
    )
    return contact, impulse


def _batch(touching: Bool[Array, "pair lane"], pair: PairKind) -> Int[Array, "pair lane"]:
    """Solver batch of each touching pair.

    The reference sorts pairs stably, inactive first, and the pair at sorted place p belongs to batch
    p mod n_batches. Among touching pairs, the k-th therefore stands at place (pairs - touching + k).
    """
    rank = jnp.cumsum(touching, axis=0, dtype=jnp.int32)
    place = len(pair) - 1 - rank[-1:] + rank
    return place % pair.batches


def warm_start(model: Model, motion: Motion, contact: Contact, impulse: Impulse) -> Motion:
    """Apply the impulses that the last step ended with."""
    return _apply(model, motion, contact, _arms_only(motion, contact), impulse)


def _arms_only(motion: Motion, contact: Contact) -> tuple[Array, Array, Array, Array]:
    n, pair = contact.normal, contact.pair
    r_a = contact.point - motion.position.map(lambda x: rows(x, pair.a))
    r_b = contact.point - motion.position.map(lambda x: rows(x, pair.b))
    return r_a.cross(n), r_b.cross(n), r_a.dot(n), r_b.dot(n)


def arms(model: Model, motion: Motion, contact: Contact) -> Arms:
    """Geometry for the present positions (joints move bodies inside an iteration)."""
    cross_a, cross_b, dot_a, dot_b = _arms_only(motion, contact)
    pair = contact.pair
    mass = rows(model.inverse_mass, pair.a) + rows(model.inverse_mass, pair.b)
    turn_a, turn_b = rows(model.inverse_inertia, pair.a), rows(model.inverse_inertia, pair.b)
    return Arms(
        cross_a,
        cross_b,
        dot_a,
        dot_b,
        1 / nonzero(mass + turn_a * cross_a * cross_a + turn_b * cross_b * cross_b),
        1 / nonzero(mass + turn_a * dot_a * dot_a + turn_b * dot_b * dot_b),
        turn_a * cross_a * dot_a + turn_b * cross_b * dot_b,
    )


def sweep(model: Model, motion: Motion, contact: Contact, arm: Arms, impulse: Impulse, params: Params) -> tuple[Motion, Impulse]:
    """One pass over all solver batches of a kind."""
    for batch in range(contact.pair.batches):
        now = _solve(motion, contact, arm, impulse)
        if contact.batch is not None:
            mine = contact.batch == batch
            now = Impulse(jnp.where(mine, now.normal, impulse.normal), jnp.where(mine, now.tangent, impulse.tangent))
        change = Impulse(now.normal - impulse.normal, now.tangent - impulse.tangent)
        motion = _apply(model, motion, contact, arm[:4], change)
        impulse = now
    if params.faithful_padding and contact.pair.padded:
        impulse = Impulse(*(x.at[-1].set(0.0) for x in impulse))
    return motion, impulse


def _solve(motion: Motion, contact: Contact, arm: Arms, impulse: Impulse) -> Impulse:
    """The accumulated impulses that bring each contact to its target, clamped to push and to the friction cone."""
    n, pair, w = contact.normal, contact.pair, motion.angular_velocity
    v = motion.velocity.map(lambda x: rows(x, pair.b) - rows(x, pair.a))
    w_a, w_b = rows(w, pair.a), rows(w, pair.b)
    approach = v.dot(n) + w_b * arm.cross_b - w_a * arm.cross_a
    normal = jnp.maximum(impulse.normal + arm.mass_normal * (contact.target - approach), 0.0)
    # the tangent is (n.y, -n.x), so r x t = -(r . n)
    slide = v.x * n.y - v.y * n.x - w_b * arm.dot_b + w_a * arm.dot_a - (normal - impulse.normal) * arm.coupling
    limit = contact.friction * normal
    tangent = jnp.clip(impulse.tangent - arm.mass_tangent * slide, -limit, limit)
    return Impulse(normal, tangent)


def _apply(model: Model, motion: Motion, contact: Contact, arm: tuple, impulse: Impulse) -> Motion:
    """Push both bodies of every contact apart by an impulse; changes add up."""
    n, pair, bodies = contact.normal, contact.pair, model.inverse_mass.shape[0]
    cross_a, cross_b, dot_a, dot_b = arm
    push = Vec(impulse.normal * n.x + impulse.tangent * n.y, impulse.normal * n.y - impulse.tangent * n.x)
    turn_a = impulse.tangent * dot_a - impulse.normal * cross_a
    turn_b = impulse.normal * cross_b - impulse.tangent * dot_b
    total = lambda at_a, at_b: add_rows(bodies, [(pair.a, at_a), (pair.b, at_b)])
    return Motion(
        motion.position,
        motion.velocity + push.map(lambda p: model.inverse_mass * total(-p, p)),
        motion.angular_velocity + model.inverse_inertia * total(turn_a, turn_b),
    )


