"""Recomputation of records: from a level, its actions and a checksum of every state, or from states along the way.

On the machine and versions that made a record by `experts.witness.witness.replay`, the bits are the same.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array, Bool, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import onwards, record_of
from levelproof.levelgen.batching import block_size, by_blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.rules import StepResult, TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold, State

MAX_LANES = 256  # levels that are played side by side
# constants of `checksum`
GOLDEN, MIX_A, MIX_B = (np.uint32(x) for x in (0x9E3779B9, 0x85EBCA6B, 0xC2B2AE35))


class Moves(NamedTuple):
    """Actions of a record, and the ends of its episodes."""

    action: Int[np.ndarray, "256 6 level"]
    done: Bool[np.ndarray, "256 level"]
    goal: Bool[np.ndarray, "256 level"]


class KnownStates(NamedTuple):
    """Stored states of a record, which replace the simulated ones."""

    state: State  # [256, ..., level]
    last_distance: Any  # m, [256, level]; None: as simulated
    known: Bool[np.ndarray, "256 level"]  # which states are stored


class Resumed(NamedTuple):
    """Result of playing a record again."""

    fields: dict[str, Any]  # arrays of `Record`, by their paths: [256, ..., level]
    checksum: UInt32[np.ndarray, "256 level"] | None  # of each row's state, if simulated from the start
    agrees: Bool[np.ndarray, "256 level"]  # whether each step ends its episode as recorded


def resume(
    level: Level, moves: Moves, states: KnownStates | None, rules: TaskParams, fields: frozenset[str]
) -> Resumed:
    """Play a record again; its episodes end where the record says.

    Args:
        level: levels, level axis last.
        moves: actions and episode ends of their records.
        states: stored states; None: only the start is known.
        rules: the task's rules.
        fields: paths of `Record` to return; anything else is not computed.
    """
    count = moves.action.shape[-1]
    given = level, moves, states, timesteps(moves.done)
    resumed = lambda lanes: _resume_block(*take(given, lanes), rules, fields)
    return by_blocks(resumed, count, block_size(count, MAX_LANES))


@partial(jax.jit, static_argnames=("rules", "fields"))
def _resume_block(
    level: Level, moves: Moves, states: KnownStates | None, timestep, rules: TaskParams, fields: frozenset[str]
) -> Resumed:
    with_contacts = any(name.startswith("manifold/") for name in fields)

    def act(carry, given):
        now, manifold = carry
        (action, done, goal), states, timestep, row = given
        if states is not None:
            distance = now.last_distance if states.last_distance is None else states.last_distance
            known = TaskState(states.state, timestep, distance)
            now = jax.tree.map(lambda x, y: jnp.where(states.known, x, y), known, now)
        after, outcome, _, contacts = task.advance_driven(level, now, controls(level, action), rules, with_contacts)
        agrees = (outcome.done == done) & (outcome.goal == goal)
        made = record_of(level, now, manifold, action, StepResult(outcome.reward, done, goal))
        wanted = {name: x for name, x in paths_of(made).items() if name in fields}
        sums = None if states else checksum(jax.tree.map(lambda x: x[None], now), row[None, None])[0]
        return onwards(level, after, contacts, done), Resumed(wanted, sums, agrees)

    start = task.reset(level)
    contacts = zeros_of(Manifold, level.size, len(start.timestep)) if with_contacts else None
    return jax.lax.scan(act, (start, contacts), (moves, states, timestep, jnp.arange(RECORD_STEPS)))[1]


def timesteps(done: Bool[np.ndarray, "256 level"]) -> Int[np.ndarray, "256 level"]:
    """Return env steps since the episode's start, from the ends of episodes."""
    row = np.arange(RECORD_STEPS, dtype=np.int32)[:, None]
    begins = np.concatenate([np.ones_like(done[:1]), done[:-1]])
    return row - np.maximum.accumulate(np.where(begins, row, 0), axis=0)


def checksum(states: TaskState, rows: Any) -> Any:
    """Checksum every bit of each state and its position in the record; works on numpy and JAX arrays.

    The words of a state, in the order of `TaskState`, are each mixed with their index in the record, then added. A
    change of one word always changes the sum; any other change does so with probability 1 - 2^-32.

    Args:
        states: states of some rows, [row, ..., lane].
        rows: indices of these rows in the record, int [row, lane]; one lane stands for all.

    Returns:
        uint32 [row, lane].
    """
    words = [_words(x) for x in jax.tree.leaves(states)]
    number = rows.astype(np.uint32) * np.uint32(sum(x.shape[1] for x in words))
    total = np.uint32(0)
    for x in words:
        numbers = number[:, None] + np.arange(x.shape[1], dtype=np.uint32)[:, None]
        total += mixed(x ^ (numbers * GOLDEN)).sum(1, dtype=np.uint32)
        number = number + np.uint32(x.shape[1])
    return total


def _words(x: Any) -> Any:
    """View states as words, uint32 [row, word, lane]."""
    bits = x.view(np.uint32) if x.dtype == np.float32 else x.astype(np.uint32)
    return bits.reshape(len(x), int(np.prod(x.shape[1:-1])), x.shape[-1])


def mixed(x: Any) -> Any:
    """Apply the finalizer of MurmurHash3: a bijection in which every input bit flips about half of the output bits."""
    x = (x ^ (x >> 16)) * MIX_A
    x = (x ^ (x >> 13)) * MIX_B
    return x ^ (x >> 16)


def paths_of(record: Any) -> dict[str, Array]:
    """Return a record's arrays by path, in order."""
    leaves, _ = tree_flatten_with_path(record)
    return {keystr(keys, simple=True, separator="/"): leaf for keys, leaf in leaves}
