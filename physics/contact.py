"""The contact constraint: non-penetration with friction, by accumulated impulses (Catto's sequential impulses).

One *sweep* lets every contact of a solver batch read the same velocities and adds up their changes.
Facts: `jax2d.collision.resolve_collision`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics.motion import incidence
from physics.pairs import PairKind
from physics.types import Manifold, Model, Params, State
from physics.vector import Vec, nonzero, rows, vec


class Contact(NamedTuple):
    """One contact of every pair of a kind; constant over a step. Zero where it may not act."""

    pair: PairKind
    batch: Int[Array, "pair lane"] | None  # solver batch; None where there is only one
    normal: Vec
    point: Vec
    target: Float[Array, "pair lane"]  # m/s along the normal that the constraint asks for
    friction: Float[Array, "pair lane"]


class Arms(NamedTuple):
    """Geometry of a contact for the present positions; r goes from a body's centre to the contact point."""

    cross_a: Array  # r x n
    cross_b: Array
    dot_a: Array  # r . n; the tangent is (n.y, -n.x), so r x t = -(r . n)
    dot_b: Array
    mass_normal: Array  # effective masses
    mass_tangent: Array
    coupling: Array  # how a normal impulse changes the tangential velocity


def prepare(
    model: Model,
    state: State,
    manifold: Manifold,
    pair: PairKind,
    at: slice,
    touching: Bool[Array, "pair lane"],
    params: Params,
) -> tuple[Contact, Float[Array, "2 pair lane"]]:
    """The contacts `at` of a manifold as constraints, with their warm-start impulses (normal, tangent; N s).

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
        batch=_batch(touching, pair) if pair.batches > 1 else None,
        normal=vec(manifold.normal[at]).map(keep),
        point=vec(manifold.point[at]).map(keep),
        target=keep(target),
        friction=keep(jnp.sqrt(rough(pair.a) + rough(pair.b))),
    )
    remembered = acts & state.contact_active[at]
    impulses = jnp.stack([state.contact_normal_impulse[at], state.contact_tangent_impulse[at]])
    return contact, jnp.where(remembered, impulses, 0.0)


def _batch(touching: Bool[Array, "pair lane"], pair: PairKind) -> Int[Array, "pair lane"]:
    """Solver batch of each touching pair.

    The reference sorts pairs stably, inactive first, and the pair at sorted place p belongs to batch
    p mod n_batches. Among touching pairs, the k-th therefore stands at place (pairs - touching + k).
    """
    rank = jnp.cumsum(touching, axis=0, dtype=jnp.int32)
    place = len(pair) - 1 - rank[-1:] + rank
    return place % pair.batches


def arms(model: Model, position: Float[Array, "body 2 lane"], contact: Contact) -> Arms:
    """Geometry for the present positions (joints move bodies inside an iteration)."""
    n, pair = contact.normal, contact.pair
    r_a, r_b = (contact.point - vec(rows(position, body)) for body in (pair.a, pair.b))
    cross_a, cross_b, dot_a, dot_b = r_a.cross(n), r_b.cross(n), r_a.dot(n), r_b.dot(n)
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


def sweep(
    inverse_masses: Float[Array, "body 3 lane"],
    velocity: Float[Array, "body 3 lane"],
    contact: Contact,
    arm: Arms,
    impulse: Float[Array, "2 pair lane"],
    params: Params,
) -> tuple[Float[Array, "body 3 lane"], Float[Array, "2 pair lane"]]:
    """One pass over all solver batches of a kind."""
    for batch in range(contact.pair.batches):
        now = _solve(velocity, contact, arm, impulse)
        if contact.batch is not None:
            now = jnp.where(contact.batch == batch, now, impulse)
        velocity = velocity + inverse_masses * push(contact, arm, now - impulse, len(velocity))
        impulse = now
    if params.faithful_padding and contact.pair.padded:
        impulse = jnp.where(jnp.arange(len(contact.pair))[:, None] == len(contact.pair) - 1, 0.0, impulse)
    return velocity, impulse


def _solve(
    velocity: Float[Array, "body 3 lane"], contact: Contact, arm: Arms, impulse: Float[Array, "2 pair lane"]
) -> Float[Array, "2 pair lane"]:
    """The accumulated impulses that bring each contact to its target, clamped to push and to the friction cone."""
    n, pair = contact.normal, contact.pair
    a, b = rows(velocity, pair.a), rows(velocity, pair.b)
    v, w_a, w_b = Vec(b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]), a[:, 2], b[:, 2]
    approach = v.dot(n) + w_b * arm.cross_b - w_a * arm.cross_a
    normal = jnp.maximum(impulse[0] + arm.mass_normal * (contact.target - approach), 0.0)
    slide = v.x * n.y - v.y * n.x - w_b * arm.dot_b + w_a * arm.dot_a - (normal - impulse[0]) * arm.coupling
    limit = contact.friction * normal
    tangent = jnp.clip(impulse[1] - arm.mass_tangent * slide, -limit, limit)
    return jnp.stack([normal, tangent])


def push(contact: Contact, arm: Arms, impulse: Float[Array, "2 pair lane"], bodies: int) -> Float[Array, "body 3 lane"]:
    """What each body gets when both bodies of every contact are pushed apart; contributions add up."""
    n, pair = contact.normal, contact.pair
    normal, tangent = impulse
    force = Vec(normal * n.x + tangent * n.y, normal * n.y - tangent * n.x)
    on_a = jnp.stack([-force.x, -force.y, tangent * arm.dot_a - normal * arm.cross_a], axis=1)
    on_b = jnp.stack([force.x, force.y, normal * arm.cross_b - tangent * arm.dot_b], axis=1)
    each = jnp.concatenate([on_a, on_b])
    total = jnp.matmul(incidence(bodies, (*pair.a, *pair.b)), each.reshape(len(each), -1))
    return total.reshape(bodies, 3, -1)
