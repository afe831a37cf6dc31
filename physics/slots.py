"""Kinds of pairs too many for two solver batches: only those that touch are solved, moved together into slots.

The reference sorts pairs stably, inactive first, and the pair at sorted place p belongs to batch p mod batches. So
the k-th of A touching pairs among N stands at place N - A + k, and batch t holds every `batches`-th touching pair.
Slots keep that order: [batch, chunk, slot, lane], CHUNK slots a chunk, and as many chunks are solved as the fullest
lane needs.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from physics import vector
from physics.contact import Contact, solve
from physics.motion import Motion
from physics.pairs import PairKind
from physics.types import SOLVER_BATCH
from physics.vector import Vec, stored

CHUNK = 4  # slots solved by one kernel; more: wasted where few bodies touch, less: more kernels
SLOTS_FROM = 3  # solver batches; with fewer, solving all pairs in every batch costs less than moving them
CHUNKS = SOLVER_BATCH // CHUNK  # of a full batch


class Slots(NamedTuple):
    """Where the touching pairs of a kind went."""

    pair: Int[Array, "batch chunk slot lane"]  # number of the pair in the slot; the number of pairs: empty
    used: Int[Array, ""]  # chunks of each batch that hold any pair, in any lane
    slot: Int[Array, "pair lane"]  # flat number of the slot of a touching pair
    touching: Bool[Array, "pair lane"]


class SlottedContacts(NamedTuple):
    """The contacts of a kind, in slots."""

    slots: Slots
    rows: Float[Array, "batch chunk slot row lane"]  # of each contact: all its numbers, so that a chunk loads at once


def batches_of(touching: Bool[Array, "pair lane"], pair: PairKind) -> Int[Array, "pair lane"]:
    """Solver batch of each touching pair."""
    rank = jnp.cumsum(touching, axis=0, dtype=jnp.int32)
    return (len(pair) - rank[-1] + rank - 1) % pair.batches


def assign(touching: Bool[Array, "pair lane"], pair: PairKind) -> Slots:
    """Slots for the pairs of a kind that touch."""
    batches, pairs = pair.batches, len(pair)
    rank = jnp.cumsum(touching, axis=0, dtype=jnp.int32)
    place = pairs - rank[-1] + rank - 1  # of a touching pair
    first = pairs - rank[-1]  # place of the first touching pair
    batch = jnp.arange(batches, dtype=jnp.int32)[:, None, None]
    turn = jnp.arange(CHUNKS * CHUNK, dtype=jnp.int32)[:, None]
    k = turn * batches + (batch - first) % batches  # the slot takes the k-th touching pair, from 0
    # as many pairs come before it; a sum over an axis would leave the vector units
    number = functools.reduce(jnp.add, ((row <= k).astype(jnp.int32) for row in rank))
    in_batch = (place - first) // batches
    return Slots(
        pair=stored(number.astype(jnp.float32)).astype(jnp.int32).reshape(batches, CHUNKS, CHUNK, -1),
        used=(-(-rank[-1].max() // batches) + CHUNK - 1) // CHUNK,
        slot=place % batches * (CHUNKS * CHUNK) + in_batch,
        touching=touching,
    )


def move(slots: Slots, contact: Contact) -> SlottedContacts:
    """The contacts of all pairs to their slots."""
    body = lambda index: jnp.asarray(index, jnp.float32)[:, None]
    leaves = jax.tree.leaves(contact._replace(a=body(contact.a), b=body(contact.b)))
    rows = stored(jnp.stack(jnp.broadcast_arrays(*leaves)))
    return SlottedContacts(slots, gather(slots, jnp.moveaxis(rows, 0, 1)))


def gather(slots: Slots, x: Float[Array, "pair row lane"]) -> Float[Array, "batch chunk slot row lane"]:
    """Rows of the pairs in the slots, zero in empty slots."""
    pairs, (*places, lanes) = len(x), slots.pair.shape
    number = slots.pair.reshape(-1, lanes)
    rows = vector.gather(x, jnp.minimum(number, pairs - 1))
    return jnp.where(number[:, None] < pairs, rows, 0.0).reshape(*places, -1, lanes)


def _contact(rows: Float[Array, "slot row lane"]) -> Contact:
    a, b, n_x, n_y, p_x, p_y, *rest = jnp.moveaxis(rows, 1, 0)
    return Contact(a.astype(jnp.int32), b.astype(jnp.int32), Vec(n_x, n_y), Vec(p_x, p_y), *rest, batch=None)


def sweep(
    masses: Float[Array, "body 3 lane"],
    motion: Motion,
    contacts: SlottedContacts,
    impulse: Float[Array, "batch chunk slot 2 lane"],
) -> tuple[Motion, Float[Array, "batch chunk slot 2 lane"]]:
    """One pass over all solver batches, chunk by chunk."""

    def solve_batch(velocity, batch):
        rows, impulse = batch
        base = Motion(motion.position, velocity)  # what every contact of the batch reads

        def solve_chunk(chunk, carry):
            velocity, impulse = carry
            here = _contact(stored(rows[chunk]))
            now, change = solve(base, here, jnp.moveaxis(impulse[chunk], 1, 0))
            return velocity + masses * change, impulse.at[chunk].set(jnp.moveaxis(now, 0, 1))

        return jax.lax.fori_loop(0, contacts.slots.used, solve_chunk, (velocity, impulse))

    velocity, impulse = jax.lax.scan(solve_batch, motion.velocity, (contacts.rows, impulse))
    return Motion(motion.position, velocity), impulse


def scatter(slots: Slots, impulse: Float[Array, "batch chunk slot 2 lane"]) -> Float[Array, "2 pair lane"]:
    """Impulses back from the slots to their pairs; zero for pairs that do not touch."""
    flat = impulse.reshape(-1, *impulse.shape[-2:])
    found = vector.gather(flat, jnp.where(slots.touching, slots.slot, 0))
    return jnp.moveaxis(jnp.where(slots.touching[:, None], found, 0.0), 1, 0)
