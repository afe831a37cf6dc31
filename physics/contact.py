"""The contact constraint: non-penetration with friction, by accumulated impulses (Catto's sequential impulses).

All contacts of a solver batch read the same velocities; what they do to a body adds up.
Facts: `jax2d.collision.resolve_collision`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from physics.motion import Bodies, Motion, add, take
from physics.pairs import PairKind
from physics.types import Manifold, Model, Params, State
from physics.vector import Vec, nonzero, rows, vec


class Contact(NamedTuple):
    """One contact of each of some pairs; constant over a step. Zero where it may not act. Leaves [pair, lane]."""

    a: Bodies
    b: Bodies
    normal: Vec
    point: Vec
    target: Array  # m/s along the normal that the constraint asks for
    friction: Array
    mass: Array  # both bodies' inverse masses
    inertia_a: Array  # inverse
    inertia_b: Array
    kept: Array  # 0 where the padding defect forgets the accumulated impulses, else 1
    batch: Array | None  # solver batch; None: all are in one


def prepare(
    model: Model,
    state: State,
    manifold: Manifold,
    pair: PairKind,
    at: slice,
    batch: Int[Array, "pair lane"] | None,
    params: Params,
) -> tuple[Contact, Float[Array, "2 pair lane"]]:
    """The contacts `at` of a manifold as constraints, with their warm-start impulses (normal, tangent; N s)."""
    active = manifold.active[at]
    mass_a, mass_b = rows(model.inverse_mass, pair.a), rows(model.inverse_mass, pair.b)
    collides = jnp.stack([model.collides[a, b] for a, b in zip(pair.a, pair.b, strict=True)])
    acts = active & collides & ~((mass_a == 0) & (mass_b == 0))
    keep = lambda x: jnp.where(acts, x, 0.0)
    excess = jnp.maximum(manifold.penetration[at] - params.slop, 0.0)
    target = params.contact_bias / params.dt * excess - manifold.restitution_velocity[at]
    rough = lambda body: jnp.square(rows(model.friction, body) * params.base_friction)
    forgotten = params.faithful_padding and pair.padded
    last = jnp.arange(len(pair))[:, None] == len(pair) - 1
    contact = Contact(
        a=pair.a,
        b=pair.b,
        normal=vec(manifold.normal[at]).map(keep),
        point=vec(manifold.point[at]).map(keep),
        target=keep(target),
        friction=keep(jnp.sqrt(rough(pair.a) + rough(pair.b))),
        mass=keep(mass_a + mass_b),
        inertia_a=keep(rows(model.inverse_inertia, pair.a)),
        inertia_b=keep(rows(model.inverse_inertia, pair.b)),
        kept=jnp.where(last & forgotten, 0.0, jnp.ones_like(target)),
        batch=batch,
    )
    remembered = acts & state.contact_active[at]
    impulses = jnp.stack([state.contact_normal_impulse[at], state.contact_tangent_impulse[at]])
    return contact, jnp.where(remembered, impulses, 0.0)


class Arms(NamedTuple):
    """Geometry of a contact; r goes from a body's centre to the contact point."""

    cross_a: Array  # r x n
    cross_b: Array
    dot_a: Array  # r . n; the tangent is (n.y, -n.x), so r x t = -(r . n)
    dot_b: Array


def arms(position: Float[Array, "body 2 lane"], contact: Contact) -> Arms:
    """Geometry for the present positions (joints move bodies inside an iteration)."""
    n = contact.normal
    r_a, r_b = (contact.point - vec(take(position, body)) for body in (contact.a, contact.b))
    return Arms(r_a.cross(n), r_b.cross(n), r_a.dot(n), r_b.dot(n))


def solve(
    motion: Motion, contact: Contact, impulse: Float[Array, "2 pair lane"], batch: int = 0
) -> tuple[Float[Array, "2 pair lane"], Float[Array, "body 3 lane"]]:
    """The accumulated impulses that bring each contact to its target, clamped to push and to the friction cone.

    Only contacts of solver batch `batch` change, where there are several.

    Returns:
        The new accumulated impulses, and what their changes do to each body.
    """
    arm, n = arms(motion.position, contact), contact.normal
    inertia_a, inertia_b = contact.inertia_a, contact.inertia_b
    mass_normal = 1 / nonzero(contact.mass + inertia_a * jnp.square(arm.cross_a) + inertia_b * jnp.square(arm.cross_b))
    mass_tangent = 1 / nonzero(contact.mass + inertia_a * jnp.square(arm.dot_a) + inertia_b * jnp.square(arm.dot_b))
    # how a normal impulse changes the tangential velocity
    coupling = inertia_a * arm.cross_a * arm.dot_a + inertia_b * arm.cross_b * arm.dot_b

    a, b = take(motion.velocity, contact.a), take(motion.velocity, contact.b)
    v, w_a, w_b = Vec(b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]), a[:, 2], b[:, 2]
    approach = v.dot(n) + w_b * arm.cross_b - w_a * arm.cross_a
    normal = jnp.maximum(impulse[0] + mass_normal * (contact.target - approach), 0.0)
    slide = v.x * n.y - v.y * n.x - w_b * arm.dot_b + w_a * arm.dot_a - (normal - impulse[0]) * coupling
    limit = contact.friction * normal
    tangent = jnp.clip(impulse[1] - mass_tangent * slide, -limit, limit)
    now = jnp.stack([normal, tangent])
    kept = now * contact.kept
    if contact.batch is not None:
        mine = contact.batch == batch
        now, kept = jnp.where(mine, now, impulse), jnp.where(mine, kept, impulse)
    return kept, push(contact, arm, now - impulse, len(motion.velocity))


def push(contact: Contact, arm: Arms, impulse: Float[Array, "2 pair lane"], bodies: int) -> Float[Array, "body 3 lane"]:
    """What each body gets when both bodies of every contact are pushed apart."""
    n, (normal, tangent) = contact.normal, impulse
    force = Vec(normal * n.x + tangent * n.y, normal * n.y - tangent * n.x)
    on_a = jnp.stack([-force.x, -force.y, tangent * arm.dot_a - normal * arm.cross_a], axis=1)
    on_b = jnp.stack([force.x, force.y, normal * arm.cross_b - tangent * arm.dot_b], axis=1)
    return add(bodies, contact.a, on_a, contact.b, on_b)
