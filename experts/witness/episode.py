"""First episodes played again, and the records that repeat them.

A record whose later episodes have the actions of the first one repeats it, bit for bit, because every episode starts in
the level's first state. So the first episode is simulated, and the rest is copied.
"""

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.resume import checksum, paths_of
from levelproof.experts.witness.witness import record_of
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import controls
from levelproof.levelgen.task.fresh import renewed
from levelproof.levelgen.task.observe.kinds import ObservationType, changing_features, constant_features, join
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Manifold

# A lane that ends its episode begins another, so that none waits for the longest one. Few episodes are not enough for
# that in many lanes, and in few lanes a step of the engine costs more per lane.
FEW_LANES, MANY_LANES = 16, 128
FEW, MANY = 64, 512  # episodes: up to FEW have a small program; from MANY on there are MANY_LANES
AT_ONCE = 2 * MANY  # maximum number of episodes played together
STEPS = 256  # maximum env steps per lane in one call of a program
STEPS_WITH_STATES = 128  # a state of l has 2 kB, with its contacts 6 kB
STEPS_WITH_PIXELS = 8  # an image has 188 kB


class PlayedEpisodes(NamedTuple):
    """First episodes: their env steps are the rows of arrays, one episode after another, in the given order."""

    fields: dict[str, np.ndarray]  # arrays of `Record` by path, [row, ...]
    observation: Any  # of the state before each action, [row, ...]; None if not requested
    checksum: UInt32[np.ndarray, " level"]  # of `checksum_of`
    reaches: Bool[np.ndarray, " level"]  # whether the episode ends at its last step and not before, at the goal


class _Moves(NamedTuple):
    """What to play: arrays [row, ...] of env steps, or [step, lane, ...], where zeros stand for lanes that wait."""

    episode: Int[Any, "..."]
    step: Int[Any, "..."]  # since the episode's start
    first: Bool[Any, "..."]  # whether the episode begins with it
    last: Bool[Any, "..."]
    action: Int[Any, "... 6"]


class _Playing(NamedTuple):
    """What lanes carry from one step to the next."""

    level: Level  # of the episode that each lane plays; its `state` is None
    now: TaskState
    manifold: Any  # of the physics step that led there, zero at an episode's start; None if no field needs it


class _Rows(NamedTuple):
    """What was played: arrays [row, ...] of env steps, or [step, lane, ...]."""

    fields: dict[str, Any]  # by path
    changing: Any  # `changing_features` of the observation; None if none is requested
    checksum: Any  # of the state before the action
    right: Any  # whether the step is as recorded: the last one ends its episode at the goal, no other one ends it


def play_episodes(
    level: Level,
    action: Int[np.ndarray, "256 6 level"],
    steps: Int[np.ndarray, " level"],
    rules: TaskParams,
    fields: frozenset[str],
    observation: ObservationType | None = None,
) -> PlayedEpisodes:
    """Play first episodes side by side.

    Args:
        level: levels, level axis last.
        action: the actions, of any integer type.
        steps: lengths of the episodes, env steps, 1 to 256.
        rules: the task's rules.
        fields: paths of `Record` to return; anything else is not kept.
        observation: type of the observation to return; None: none.
    """
    ends = np.cumsum(steps)
    first, rows = ends - steps, None
    constants: list[np.ndarray] = []
    groups = -(-len(steps) // AT_ONCE)  # of nearly equal size; if there are several, each has at least MANY
    edges = [len(steps) * group // groups for group in range(groups + 1)]
    for some in itertools.starmap(slice, itertools.pairwise(edges)):
        mine = slice(first[some.start], ends[some][-1])
        levels, moves = _table(take(level, some)), _moves_of(action[..., some], steps[some])
        for where, played in _play_together(levels, moves, rules, fields, observation):
            if rows is None:
                rows = jax.tree.map(lambda x: np.empty((ends[-1], *x.shape[1:]), x.dtype), played)
            for to, source in zip(jax.tree.leaves(rows), jax.tree.leaves(played), strict=True):
                to[mine][where] = source
        if observation is not None:
            constants.append(np.asarray(_constant_features(levels, observation))[: len(steps[some])])
    assert rows is not None, "there is at least one episode of at least one step"
    shown = rows.changing
    if observation is not None:
        episode = np.repeat(np.arange(len(steps)), steps)
        shown = join(observation, level.size, np.concatenate(constants), shown, episode)
    sums = rows.checksum[first] + rows.checksum[ends - 1]
    return PlayedEpisodes(rows.fields, shown, sums, np.logical_and.reduceat(rows.right, first))


def _table(level: Level) -> Level:
    """Copy levels to the device, padded, so that three programs serve any number of them."""
    count = len(level)
    room = FEW if count <= FEW else MANY if count < MANY else AT_ONCE
    return _on_device(take(level, np.minimum(np.arange(room), count - 1)))


_on_device = jax.jit(lambda level: level)  # `jax.device_put` takes four times as long for so many small arrays


def _moves_of(action: Int[np.ndarray, "256 6 level"], steps: Int[np.ndarray, " level"]) -> _Moves:
    """Return the env steps of episodes, one episode after another."""
    episode = np.repeat(np.arange(len(steps), dtype=np.int32), steps)
    step = np.arange(len(episode), dtype=np.int32) - (np.cumsum(steps) - steps).astype(np.int32)[episode]
    return _Moves(episode, step, step == 0, step == steps[episode] - 1, action[step, :, episode])


def _play_together(
    levels: Level, moves: _Moves, rules: TaskParams, fields: frozenset[str], observation: ObservationType | None
) -> Iterator[tuple[Int[np.ndarray, " row"], _Rows]]:
    """Play episodes; yield some rows and which ones they are, until all are played."""
    lanes = MANY_LANES if len(levels) > MANY else FEW_LANES
    begin, lane = (x[moves.episode] for x in _places(moves.step[moves.last] + 1, lanes))
    time, length = begin + moves.step, _turn_length(fields, observation)
    playing, idle = _waiting(levels, lanes, fields), len(time)
    padded = jax.tree.map(lambda x: np.concatenate([x, np.zeros_like(x[:1])]), moves)  # the last row is for idle lanes
    for start in range(0, int(time.max()) + 1, length):
        where = np.flatnonzero((time >= start) & (time < start + length))
        at, mine = time[where] - start, lane[where]
        rows = np.full((length, lanes), idle)
        rows[at, mine] = where
        turn = jax.tree.map(lambda x, rows=rows: x.take(rows, 0), padded)
        playing, played = _play_turn(levels, playing, turn, at.max() + 1, rules, fields, observation)
        of_rows = lambda x, place=at * lanes + mine: x.reshape(-1, *x.shape[2:]).take(place, 0)
        yield where, jax.tree.map(of_rows, jax.device_get(played))


def _places(
    steps: Int[np.ndarray, " level"], lanes: int
) -> tuple[Int[np.ndarray, " level"], Int[np.ndarray, " level"]]:
    """Return when each episode begins and in which lane: the longest first, in the lane that is free first."""
    begin, lane = np.zeros_like(steps), np.zeros_like(steps)
    free = [(0, number) for number in range(lanes)]  # a heap: when each lane is free
    for episode in np.argsort(-steps, kind="stable").tolist():
        begin[episode], lane[episode] = free[0]
        heapq.heapreplace(free, (int(begin[episode] + steps[episode]), free[0][1]))
    return begin, lane


def _turn_length(fields: frozenset[str], observation: ObservationType | None) -> int:
    """Return how many env steps per lane one call of a program plays; a call keeps room for that many rows."""
    if observation == ObservationType.PIXELS:
        return STEPS_WITH_PIXELS
    return STEPS_WITH_STATES if any(name.startswith(("state/", "manifold/")) for name in fields) else STEPS


@partial(jax.jit, static_argnames=("lanes", "fields"))
def _waiting(levels: Level, lanes: int, fields: frozenset[str]) -> _Playing:
    """Return lanes that have not begun an episode."""
    return jax.tree.map(jnp.zeros_like, _first_of(take(levels, slice(lanes)), fields))


def _first_of(level: Level, fields: frozenset[str]) -> _Playing:
    """Return episodes that begin in levels."""
    contacts = None
    if any(name.startswith("manifold/") for name in fields):
        contacts = zeros_of(Manifold, level.size, len(level))
    return _Playing(replace(level, state=None), task.reset(level), contacts)  # pyright: ignore[reportArgumentType]


_constant_features = jax.jit(lambda level, kind: constant_features(kind, level).T, static_argnums=1)


@partial(jax.jit, static_argnames=("rules", "fields", "observation"), donate_argnames="playing")
def _play_turn(
    levels: Level,
    playing: _Playing,
    moves: _Moves,
    count: Int[Array, ""],
    rules: TaskParams,
    fields: frozenset[str],
    observation: ObservationType | None,
) -> tuple[_Playing, _Rows]:
    """Play `count` env steps of each lane; rows after them have no meaning."""

    def act(lanes: _Playing, move: _Moves) -> tuple[_Playing, _Rows]:
        taken = move.action.T.astype(jnp.int32)
        begun = lambda episode: _first_of(take(levels, episode), fields)
        level, now, manifold = renewed(move.first, move.episode, begun, lanes)
        driven, with_contacts = controls(level, taken), manifold is not None
        after, outcome, _, contacts = task.advance_driven(level, now, driven, rules, with_contacts)
        made = paths_of(record_of(level, now, manifold, taken, outcome))
        kept = {name: x for name, x in made.items() if name in fields}
        shown = None if observation is None else changing_features(observation, level, now.state)
        kept, shown = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), (kept, shown))
        sums = checksum(jax.tree.map(lambda x: x[None], now), move.step[None])[0]
        right = (outcome.done == move.last) & (outcome.goal == move.last)
        return _Playing(level, after, contacts), _Rows(kept, shown, sums, right)

    def turn(step: Int[Array, ""], carry: tuple[_Playing, _Rows]) -> tuple[_Playing, _Rows]:
        lanes, made = act(carry[0], jax.tree.map(lambda x: x[step], moves))
        put = lambda x, new: jax.lax.dynamic_update_index_in_dim(x, new, step, 0)
        return lanes, jax.tree.map(put, carry[1], made)

    shapes = jax.eval_shape(act, playing, jax.tree.map(lambda x: x[0], moves))[1]
    empty = jax.tree.map(lambda x: jnp.zeros((len(moves.step), *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(0, count, turn, (playing, empty))


def checksum_of(states: TaskState, steps: Int[np.ndarray, " level"]) -> UInt32[np.ndarray, " level"]:
    """Checksum the first state of each record and the one before the last action of its first episode.

    Args:
        states: of the records, [256, ..., level].
        steps: lengths of the first episodes, env steps.
    """
    lanes, total = np.arange(len(steps)), np.zeros(len(steps), np.uint32)
    for row in (np.zeros_like(steps), steps - 1):
        at_row = lambda x, row=row: np.moveaxis(np.moveaxis(np.asarray(x), -1, 1)[row, lanes], 0, -1)[None]
        total += checksum(jax.tree.map(at_row, states), row[None])[0]
    return total


def repeated_rows(steps: Int[np.ndarray, " level"]) -> Int[np.ndarray, "level 256"]:
    """Return which row each step of a record copies, where rows are first episodes of `steps`, one after another."""
    first = np.cumsum(steps) - steps
    return first[:, None] + np.arange(RECORD_STEPS) % steps[:, None]
