"""First episodes played again, and the records that repeat them.

A record whose later episodes have the actions of the first one repeats it, bit for bit, because every episode starts in
the level's first state. So the first episode is simulated, and the rest is copied.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.resume import checksum, paths_of
from levelproof.experts.witness.witness import record_of
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.observe.kinds import ObservationType, changing_features, constant_features, join
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold

# Lanes of a block, which ends with its longest episode: with more, lanes of few episodes would wait for the last one;
# with fewer, a step of the engine would cost more per lane.
FEW_LANES, MANY_LANES = 16, 128
MANY = 512  # episodes from which on blocks have MANY_LANES, because neighbours in length differ little
LENGTHS = (64, RECORD_STEPS)  # env steps that a block has room for: one program for each


class PlayedEpisodes(NamedTuple):
    """First episodes: their env steps are the rows of arrays, one episode after another, in the given order."""

    fields: dict[str, np.ndarray]  # arrays of `Record` by path, [row, ...]
    observation: Any  # of the state before each action, [row, ...]; None if not requested
    checksum: UInt32[np.ndarray, " level"]  # of `checksum_of`
    reaches: Bool[np.ndarray, " level"]  # whether the episode ends at its last step and not before, at the goal


class _PlayedBlock(NamedTuple):
    """Episodes of a block; what lies after the last step of an episode has no meaning."""

    rows: tuple[dict[str, Array], Any]  # fields by path, and what the observation has of the state, [step, lane, ...]
    constant: Float[Array, "lane feature"]  # what the observation has of the level
    checksum: UInt32[Array, " lane"]
    reaches: Bool[Array, " lane"]


class _PlayingBlock(NamedTuple):
    step: Int[Array, ""]
    now: TaskState
    manifold: Any
    end: TaskState  # before the last action of the episode, once there
    reaches: Bool[Array, " lane"]
    rows: Any


def play_episodes(
    level: Level,
    action: Int[np.ndarray, "256 6 level"],
    steps: Int[np.ndarray, " level"],
    rules: TaskParams,
    fields: frozenset[str],
    observation: ObservationType | None = None,
) -> PlayedEpisodes:
    """Play first episodes, those of similar length side by side.

    Args:
        level: levels, level axis last.
        action: the actions, of any integer type.
        steps: lengths of the episodes, env steps, 1 to 256.
        rules: the task's rules.
        fields: paths of `Record` to return; anything else is not kept.
        observation: type of the observation to return; None: none.
    """
    count, first, total = len(steps), np.cumsum(steps) - steps, int(steps.sum())
    size = MANY_LANES if count >= MANY else FEW_LANES
    order = np.argsort(steps, kind="stable")[np.concatenate([*blocks(count, size)])]
    ordered = take((level, steps.astype(np.int32)), order)
    sums, reaches = np.zeros(count, np.uint32), np.zeros(count, bool)
    rows: Any = None
    constants: list[np.ndarray] = []
    for start in range(0, len(order), size):
        mine = order[start : start + size]
        room = next(length for length in LENGTHS if length >= steps[mine[-1]])
        its_level, its_steps = take(ordered, slice(start, start + size))
        its_action = take(action[:room], mine)
        made: _PlayedBlock = jax.device_get(_play_block(its_level, its_action, its_steps, rules, fields, observation))
        sums[mine], reaches[mine] = made.checksum, made.reaches
        if rows is None:
            rows = jax.tree.map(lambda x: np.empty((total, *x.shape[2:]), x.dtype), made.rows)
        constants.append(np.asarray(made.constant))
        mine = mine[: count - start]  # without padding
        lane, step = _each_step(steps[mine])
        row, place = first[mine][lane] + step, step * size + lane
        for to, source in zip(jax.tree.leaves(rows), jax.tree.leaves(made.rows), strict=True):
            to[row] = source.reshape(-1, *source.shape[2:]).take(place, 0)
    made_fields, shown = rows
    if observation is not None:
        constant = np.concatenate(constants)[np.argsort(order[:count])]  # in the given order
        shown = join(observation, level.size, constant, shown, _each_step(steps)[0])
    return PlayedEpisodes(made_fields, shown, sums, reaches)


def _each_step(steps: Int[np.ndarray, " level"]) -> tuple[Int[np.ndarray, " row"], Int[np.ndarray, " row"]]:
    """Return the episode and the step of each row of episodes of these lengths, one episode after another."""
    episode = np.repeat(np.arange(len(steps)), steps)
    return episode, np.arange(len(episode)) - (np.cumsum(steps) - steps)[episode]


@partial(jax.jit, static_argnames=("rules", "fields", "observation"))
def _play_block(
    level: Level,
    action: Int[Array, "step 6 lane"],
    steps: Int[Array, " lane"],
    rules: TaskParams,
    fields: frozenset[str],
    observation: ObservationType | None,
) -> _PlayedBlock:
    with_contacts = any(name.startswith("manifold/") for name in fields)
    action = action.astype(jnp.int32)

    def row(now: TaskState, manifold: Any, taken: Array, outcome: Any) -> Any:
        made = paths_of(record_of(level, now, manifold, taken, outcome))
        kept = {name: x for name, x in made.items() if name in fields}
        shown = None if observation is None else changing_features(observation, level, now.state)
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), (kept, shown))

    def act(playing: _PlayingBlock) -> _PlayingBlock:
        step, now = playing.step, playing.now
        after, outcome, _, contacts = task.advance_driven(
            level, now, controls(level, action[step]), rules, with_contacts
        )
        last = step == steps - 1
        right = (outcome.done == last) & (outcome.goal == last)
        put = lambda x, new: jax.lax.dynamic_update_index_in_dim(x, new, step, 0)
        rows = jax.tree.map(put, playing.rows, row(now, playing.manifold, action[step], outcome))
        end = jax.tree.map(lambda x, before: jnp.where(last, x, before), now, playing.end)
        return _PlayingBlock(step + 1, after, contacts, end, playing.reaches & (right | (step >= steps)), rows)

    start = task.reset(level)
    contacts = zeros_of(Manifold, level.size, len(steps)) if with_contacts else None
    shapes = jax.eval_shape(lambda: row(start, contacts, action[0], task.step(level, start, action[0], rules)[1]))
    empty = jax.tree.map(lambda x: jnp.zeros((len(action), *x.shape), x.dtype), shapes)
    begun = _PlayingBlock(jnp.int32(0), start, contacts, start, jnp.ones(len(steps), bool), empty)
    over = jax.lax.while_loop(lambda playing: playing.step < steps.max(), act, begun)
    sums, constant = _checksum(start, over.end, steps), constant_features(observation, level)
    return _PlayedBlock(over.rows, constant.T, sums, over.reaches)


def _checksum(start: TaskState, end: TaskState, steps: Any) -> Any:
    """Checksum the first state of an episode and the one before its last action, without a time axis."""
    row = steps.astype(np.int32)[None]
    sums = [checksum(jax.tree.map(lambda x: x[None], state), at)[0] for state, at in ((start, row * 0), (end, row - 1))]
    return sums[0] + sums[1]


def checksum_of(states: TaskState, steps: Int[np.ndarray, " level"]) -> UInt32[np.ndarray, " level"]:
    """Checksum the first state of each record and the one before the last action of its first episode.

    Args:
        states: of the records, [256, ..., level].
        steps: lengths of the first episodes, env steps.
    """
    lanes = np.arange(len(steps))
    start = jax.tree.map(lambda x: np.asarray(x)[0], states)
    end = jax.tree.map(lambda x: np.moveaxis(np.moveaxis(np.asarray(x), -1, 1)[steps - 1, lanes], 0, -1), states)
    return _checksum(start, end, steps)


def repeat_episodes(rows: np.ndarray, steps: Int[np.ndarray, " level"]) -> np.ndarray:
    """Fill records [level, 256, ...] with copies of their first episodes, rows [row, ...] one episode after another."""
    first = np.cumsum(steps) - steps
    return rows[first[:, None] + np.arange(RECORD_STEPS) % steps[:, None]]
