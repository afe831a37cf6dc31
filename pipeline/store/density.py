"""Densities: which fields of records a shard keeps, and how the others are recomputed.

`full` keeps every field. `resume` keeps states, so that an episode can continue from any of them; one env step from
each gives the other fields. `witness` keeps the level, the actions, the ends of episodes, a key frame every `key_every`
env steps of an episode, and checksums of all states; the engine simulates the rest again. If this machine's states do
not match the checksums, each key frame resets them to the stored ones, and states in between are this machine's.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.resume import KnownStates, Moves, checksum, resume, timesteps
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskState
from levelproof.physics.types import State
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.formats import WIDE, Encoding, FieldSpec

MOVES = "record/action", "record/done", "record/goal"
LAST_DISTANCE = "record/last_distance"
STATE = "record/state/"
KEY = "key/"  # in place of `record/`: a field of the key frames
CHECKSUM = "checksum"  # of each run of `Encoding.key_every` rows

FieldsAndFirst = tuple[dict[str, np.ndarray], Int[np.ndarray, " level"]]  # fields; first row that differs, or -1


class Restored(NamedTuple):
    """The requested fields, and where they may differ from the stored record."""

    arrays: dict[str, np.ndarray]
    unlike: Int[np.ndarray, " level"]  # first row whose state may differ from the stored one; -1: none


def kept(arrays: Mapping[str, np.ndarray], encoding: Encoding) -> dict[str, np.ndarray]:
    """Return what a shard stores of all fields (level axis last; time first except in `level/` fields)."""
    if encoding.density == "full":
        return dict(arrays)
    stored = {name: x for name, x in arrays.items() if name.startswith("level/") or name in MOVES}
    states = {name: x for name, x in arrays.items() if name.startswith(STATE)}
    if encoding.density == "resume":
        return stored | states
    states[LAST_DISTANCE] = arrays[LAST_DISTANCE]
    at, there = key_rows(arrays["record/done"], encoding.key_every)
    for name, x in states.items():
        frames = np.take_along_axis(x, _along(at, x), 0)
        stored[KEY + name.removeprefix("record/")] = np.where(_along(there, x), frames, np.zeros_like(frames))
    states, rows = task_states(arrays, STATE, arrays[WIDE]), np.arange(RECORD_STEPS)[:, None]
    stored[CHECKSUM] = in_runs(checksum(states, rows), encoding)
    return stored


def needed(wanted: Iterable[str], stored: Iterable[str]) -> set[str]:
    """Return the stored fields from which `restored` copies or computes the wanted ones."""
    wanted, stored = set(wanted), set(stored)
    missing = wanted - stored
    if missing - {WIDE}:
        return stored
    return (wanted & stored) | ({"record/done"} if missing else set())


def restored(stored: Mapping[str, np.ndarray], wanted: Iterable[FieldSpec], encoding: Encoding) -> Restored:
    """Return the wanted fields, copied or computed from the fields that `needed` names."""
    specs = {field.name: field for field in wanted}
    arrays = {name: stored[name] for name in specs if name in stored}
    if WIDE in specs and WIDE not in stored:
        arrays[WIDE] = timesteps(stored["record/done"])
    missing = [name for name in specs if name not in arrays]
    levels = next(iter(stored.values())).shape[-1]
    unlike = np.full(levels, -1)
    if missing and levels:
        paths = frozenset(name.removeprefix("record/") for name in missing)
        recomputed, unlike = (_from_states if encoding.density == "resume" else _from_actions)(stored, encoding, paths)
        arrays |= {name: recomputed[name.removeprefix("record/")] for name in missing}
    elif missing:
        arrays |= {name: np.empty((specs[name].steps, *specs[name].shape, 0), specs[name].dtype) for name in missing}
    return Restored({name: arrays[name] for name in specs}, unlike)


def _from_states(stored: Mapping[str, np.ndarray], encoding: Encoding, paths: frozenset[str]) -> FieldsAndFirst:
    """Compute missing fields of `resume` with one env step from every state."""
    level, moves = _played(stored)
    states = KnownStates(tree_of(State, stored, STATE), None, np.ones_like(moves.done))
    made = resume(level, moves, states, encoding.rules, paths)
    return made.fields, _first(~made.agrees)


def _from_actions(stored: Mapping[str, np.ndarray], encoding: Encoding, paths: frozenset[str]) -> FieldsAndFirst:
    """Compute missing fields of `witness` by replay; levels whose states differ are replayed from their key frames."""
    level, moves = _played(stored)
    at, there = key_rows(moves.done, encoding.key_every)
    frames = task_states(stored, KEY + "state/", np.take_along_axis(timesteps(moves.done), at, 0))
    made = resume(level, moves, None, encoding.rules, paths)
    assert made.checksum is not None
    runs = in_runs(made.checksum, encoding) != stored[CHECKSUM]
    wrong = np.repeat(runs, encoding.key_every, 0) | ~made.agrees
    led_elsewhere = there & (np.take_along_axis(made.checksum, at, 0) != checksum(frames, at))
    wrong |= _placed(led_elsewhere, at)
    unlike = _first(wrong)
    if len(lanes := np.flatnonzero(unlike >= 0)):
        level, moves, frames, at, there = take((level, moves, frames, at, there), lanes)
        state, distance = jax.tree.map(lambda x: _placed(x, at), (frames.state, frames.last_distance))
        again = resume(level, moves, KnownStates(state, distance, _placed(there, at)), encoding.rules, paths)
        for name, values in made.fields.items():
            values[..., lanes] = again.fields[name]
    return made.fields, unlike


def _played(stored: Mapping[str, np.ndarray]) -> tuple[Level, Moves]:
    return tree_of(Level, stored, "level/"), Moves(*(stored[name] for name in MOVES))


def task_states(arrays: Mapping[str, np.ndarray], path: str, timestep: Any) -> TaskState:
    """Collect the states and last distances below `path`, [row, ..., level]."""
    distance: Any = arrays[path.removesuffix("state/") + "last_distance"]
    return TaskState(tree_of(State, arrays, path), timestep, distance)


def key_rows(
    done: Bool[np.ndarray, "256 level"], every: int
) -> tuple[Int[np.ndarray, "key level"], Bool[np.ndarray, "key level"]]:
    """Return the rows of key frames, and a mask of which exist: every `every` env steps of an episode.

    The start of an episode needs none: it is the level's own state.
    """
    timestep = timesteps(done)
    key = (timestep % every == 0) & (timestep > 0)
    at = np.argsort(~key, axis=0, kind="stable")[: (RECORD_STEPS - 1) // every]
    return at, np.take_along_axis(key, at, 0)


def in_runs(sums: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Sum each run of `key_every` rows, modulo 2**32; [run, level]."""
    runs = RECORD_STEPS // encoding.key_every
    return sums.reshape(runs, encoding.key_every, sums.shape[-1]).sum(1, dtype=np.uint32)


def _placed(frames: np.ndarray, at: Int[np.ndarray, "key level"]) -> np.ndarray:
    """Scatter key frames [key, ..., level] to their rows, with zeros elsewhere."""
    rows = np.zeros((RECORD_STEPS, *frames.shape[1:]), frames.dtype)
    np.put_along_axis(rows, _along(at, frames), frames, 0)
    return rows


def _along(at: Int[np.ndarray, "key level"], values: np.ndarray) -> np.ndarray:
    """Reshape row indices to broadcast over the components of `values` [row, ..., level]."""
    return at.reshape(len(at), *(1,) * (values.ndim - 2), at.shape[-1])


def _first(wrong: Bool[np.ndarray, "256 level"]) -> Int[np.ndarray, " level"]:
    """Return each level's first wrong row; -1: none."""
    return np.where(wrong.any(0), wrong.argmax(0), -1)
