"""A level's archive: for each cell one state that was reached, and the actions that reach it.

All arrays have the level axis first, and levels are independent. Weights of choices are integers, so that their sums
have no rounding that could depend on the number of levels computed together.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16, UInt32

from levelproof.experts.search.cells import cell_key
from levelproof.experts.search.config import SearchConfig

ONE = 65_536  # weight of an entry that was never chosen


class ReachedStates(NamedTuple):
    """States that were reached: entries of the archive, or new states of lanes."""

    feature: Float[Array, "level entry feature"]  # features that tell states apart (`experts.search.cells`)
    state: Float[Array, "level entry word"]  # the whole state (`experts.search.rows`)
    code: UInt16[Array, "level entry step"]  # codes of the actions from the level's start
    steps: Int[Array, "level entry"]  # number of these actions
    distance: Float[Array, "level entry"]  # m, gap between green and blue


class Archive(NamedTuple):
    """Entries of each level, in no order; unused entries hold arbitrary values."""

    entry: ReachedStates
    used: Bool[Array, "level entry"]
    key: UInt32[Array, "level entry"]  # key of its cell
    visits: Int[Array, "level entry"]  # times it was chosen
    width: Float[Array, " level"]  # m, width of a cell
    cells: Int[Array, " level"]  # total number of cells entered


def new_archive(start: ReachedStates, config: SearchConfig) -> Archive:
    """Return archives that hold the levels' first states alone, [level, 1, ...]."""
    count, entries = len(start.steps), config.entries
    widen = lambda x: jnp.pad(x, [(0, 0), (0, entries - 1)] + [(0, 0)] * (x.ndim - 2))
    width, entry = jnp.full(count, config.width, jnp.float32), jax.tree.map(widen, start)
    used = jnp.broadcast_to(jnp.arange(entries) == 0, (count, entries))
    ones = jnp.ones(count, jnp.int32)
    return Archive(entry, used, keys_of(entry.feature, width), jnp.zeros((count, entries), jnp.int32), width, ones)


def keys_of(
    feature: Float[Array, "level entry feature"], width: Float[Array, " level"]
) -> UInt32[Array, "level entry"]:
    """Return the keys of the states' cells."""
    return jax.vmap(cell_key)(feature, width)


def choose(archive: Archive, uniform: Float[Array, "level 3 lane"], config: SearchConfig) -> Int[Array, "level lane"]:
    """Choose an entry for each lane: rarely chosen ones more often, sometimes the nearer to the goal of two draws."""
    weight = jnp.where(archive.used, jnp.maximum(ONE // (1 + archive.visits), 1), 0)
    total = jnp.cumsum(weight, axis=-1)

    def drawn(uniform: Float[Array, "level lane"]) -> Int[Array, "level lane"]:
        at = (uniform * total[:, -1:]).astype(jnp.int32)
        return jnp.minimum((at[:, None, :] >= total[:, :, None]).sum(1), config.entries - 1)

    one, other = drawn(uniform[:, 0]), drawn(uniform[:, 1])
    distance = lambda chosen: jnp.take_along_axis(archive.entry.distance, chosen, axis=1)
    return jnp.where((uniform[:, 2] < config.nearer) & (distance(other) < distance(one)), other, one)


def visit(archive: Archive, chosen: Int[Array, "level lane"], active: Bool[Array, " level"]) -> Archive:
    """Count the chosen entries of active levels."""
    counts = (chosen[:, :, None] == jnp.arange(archive.used.shape[1])).sum(1)
    return archive._replace(visits=archive.visits + jnp.where(active[:, None], counts, 0))


def insert(archive: Archive, new: ReachedStates, valid: Bool[Array, "level lane"], config: SearchConfig) -> Archive:
    """Insert states of new cells, or reached in fewer env steps; widen the cells if the archive is full."""
    key = keys_of(new.feature, archive.width)
    slot, fits = jax.vmap(slots_for)(archive.used, archive.key, archive.entry.steps, key, new.steps, valid)
    level = jnp.arange(len(key))[:, None]
    put = lambda old, new: old.at[level, slot].set(new, mode="drop")
    used = put(archive.used, True)
    archive = archive._replace(
        entry=jax.tree.map(put, archive.entry, new),
        used=used,
        key=put(archive.key, key),
        visits=put(archive.visits, 0),
        cells=archive.cells + (used & ~archive.used).sum(-1),
    )
    return widen(archive, ~fits, config)


def slots_for(
    used: Bool[Array, " entry"],
    known: UInt32[Array, " entry"],
    known_steps: Int[Array, " entry"],
    key: UInt32[Array, " lane"],
    steps: Int[Array, " lane"],
    valid: Bool[Array, " lane"],
) -> tuple[Int[Array, " lane"], Bool[Array, ""]]:
    """Return the index of each lane's state in one level's archive (past the end: none), and whether all new cells fit.

    A state has an index if its cell is new and fits, or if it reached a known cell in fewer env steps.
    """
    nowhere, number = len(used), jnp.arange(len(used))[:, None]
    old = jnp.where(used[:, None] & (known[:, None] == key), number + 1, 0).sum(0) - 1  # -1: new cell
    first = valid & ~beaten(key, steps, valid)
    fresh = first & (old < 0)
    free = jnp.where(used, nowhere, jnp.cumsum(~used) - 1)
    turn = jnp.cumsum(fresh) - 1
    empty = jnp.where(free[:, None] == turn, number, 0).sum(0)
    fits = turn < (~used).sum()
    sooner = first & (old >= 0) & (steps < known_steps[old])
    slot = jnp.where(fresh & fits, empty, jnp.where(sooner, old, nowhere))
    return slot, (fits | ~fresh).all()


def beaten(
    key: UInt32[Array, " entry"], steps: Int[Array, " entry"], valid: Bool[Array, " entry"]
) -> Bool[Array, " entry"]:
    """Return whether another state has the same cell in fewer env steps, or in as many and a lower index."""
    other, number = lambda x: x[:, None], jnp.arange(len(key))
    sooner = (other(steps) < steps) | ((other(steps) == steps) & (other(number) < number))
    return ((other(key) == key) & sooner & other(valid)).any(0)


def widen(archive: Archive, full: Bool[Array, " level"], config: SearchConfig) -> Archive:
    """Widen the cells of full archives; if entries then share a cell, keep the one reached in the fewest env steps."""

    def wider(archive: Archive) -> tuple:
        width = jnp.where(full, archive.width * config.growth, archive.width)
        wide = keys_of(archive.entry.feature, width)
        key = jnp.where(full[:, None], wide, archive.key)  # hashed once: another program may round features otherwise
        return archive.used & ~jax.vmap(beaten)(key, archive.entry.steps, archive.used), key, width

    small = lambda archive: (archive.used, archive.key, archive.width)
    used, key, width = jax.lax.cond(full.any(), wider, small, archive)
    return archive._replace(used=used, key=key, width=width)
