"""Edits of a trajectory, drawn from random bits: a stretch is held, left out, delayed or resampled.

A trajectory is the codes of its actions (`experts.search.play`) and its length in env steps.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt16, UInt32

from levelproof.experts.search.play import CODES, WITHOUT, Arena
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS

MAX_HALVINGS = 6  # stretches range from a whole trajectory to a 64th of it
Scalar = Int[Array, ""] | int


class Draws(IntEnum):
    """Searches that edit trajectories, each with its own random numbers.

    Go-Explore folds its env steps into the same key: 0, then many more than these.
    """

    SHORTEN = 1
    POLISH = 2
    STRENGTHEN = 3
    VARY = 4


class Edit(NamedTuple):
    """One edit; parts of 0 steps have no effect."""

    held: Scalar = 0  # first step of a stretch that repeats its first action
    held_steps: Scalar = 0
    moved: Scalar = 0  # first step of the rest, which is played sooner or later
    sooner: Scalar = 0  # env steps, which are left out; negative: later, and the rest's first action is held until then
    resampled: Scalar = 0  # first step of a stretch
    resampled_steps: Scalar = 0
    entries: Scalar = 0  # bits: entries of the stretch's actions that are replaced
    fresh: Scalar = 0  # code of an action that has the new values of these entries


def draw(
    draws: Draws, level_ids: Int[Array, " level"], number: Int[Array, "*level"], count: int, lanes: int
) -> UInt32[Array, "level count lane"]:
    """Draw `count` random numbers per lane for round `number` of each level."""

    def one(level_id: Int[Array, ""], number: Int[Array, ""]) -> UInt32[Array, "count lane"]:
        key = jax.random.fold_in(key_for(level_id, Stream.SEARCH), int(draws))
        return jax.random.bits(jax.random.fold_in(key, number), (count, lanes))

    return jax.vmap(one)(level_ids, jnp.broadcast_to(number, level_ids.shape))


def below(bits: UInt32[Array, "*lane"], bound: Scalar) -> Int[Array, "*lane"]:
    """Map random bits to integers below a bound; 0 if the bound is 0."""
    return (bits % jnp.maximum(bound, 1).astype(jnp.uint32)).astype(jnp.int32)


def stretch(bits: UInt32[Array, ""], length: Int[Array, ""]) -> Int[Array, ""]:
    """Draw the env steps of a stretch: those of the trajectory, halved a few times."""
    return jnp.maximum(length >> below(bits, MAX_HALVINGS + 1), 1)


def some_of(live: Bool[Array, "6"], bits: UInt32[Array, ""]) -> Int[Array, ""]:
    """Choose each live entry of an action with probability 1/2, perhaps none, as `Edit.entries`."""
    return (live * (1 << jnp.arange(ACTIONS))).sum() & bits.astype(jnp.int32)


def shortening(length: Int[Array, ""], bits: UInt32[Array, "draw"], live: Bool[Array, "6"]) -> Edit:
    """Leave out a stretch (in a quarter of cases, at the beginning); in half of all cases also hold one."""
    first = jnp.where(bits[0] >> 30 == 0, 0, below(bits[1], length))
    held_steps = jnp.where(bits[0] >> 31 == 1, stretch(bits[4], length), 0)
    return Edit(below(bits[3], length), held_steps, first, stretch(bits[2], length))


def variation(length: Int[Array, ""], bits: UInt32[Array, "draw"], live: Bool[Array, "6"]) -> Edit:
    """Resample live entries for a stretch in half of cases; shorten in three quarters of these and in all others."""
    resamples, shortens = bits[6] >> 31 == 1, (bits[6] >> 29) % 4 > 0
    edit = jax.tree.map(lambda x: jnp.where(shortens | ~resamples, x, 0), shortening(length, bits, live))
    return edit._replace(
        resampled=below(bits[7], length),
        resampled_steps=jnp.where(resamples, stretch(bits[8], length), 0),
        entries=some_of(live, bits[6]),
        fresh=bits[9] % CODES,
    )


def edited(code: UInt16[Array, " step"], last: Scalar, edit: Edit) -> UInt16[Array, " step"]:
    """Apply an edit; the action at step `last` is repeated to the end."""
    step = jnp.arange(len(code))
    within = lambda first, steps: (step >= first) & (step < first + steps)
    source = jnp.where(within(edit.held, edit.held_steps), edit.held, step)
    source = jnp.where(source >= edit.moved, jnp.maximum(source + edit.sooner, edit.moved), source)
    code, rest = code[jnp.minimum(source, last)], jnp.array(WITHOUT)[edit.entries]
    fresh = jnp.asarray(edit.fresh, jnp.uint16) - rest[edit.fresh]
    return jnp.where(within(edit.resampled, edit.resampled_steps), rest[code] + fresh, code)


def edits(
    drawn: Callable[..., Edit],
    code: UInt16[Array, "level step"],
    length: Int[Array, " level"],
    bits: UInt32[Array, "level draw lane"],
    ring: Arena,
) -> UInt16[Array, "level lane step"]:
    """Edit each level's trajectory, differently for each of its lanes; `drawn` is `shortening` or `variation`."""
    one = lambda code, length, bits, live: edited(code, jnp.maximum(length - 1, 0), drawn(length, bits, live))
    live = ring.live.T.reshape(len(code), -1, ACTIONS)
    return jax.vmap(jax.vmap(one, (None, None, -1, 0)))(code, length, bits, live)
