"""Batches of trajectories or windows, batch axis first."""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.environment import EnvState
from levelproof.physics.types import Size, State
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.fields import tree_of

TRUNCATED = "record/truncated"  # `timed_out`, a name among those of fields
T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Trajectories or windows as a pytree of numpy arrays [batch, time, ...]; no batch axis for a single trajectory.

    Copy an array before you write to it: some are read-only.

    Step t holds the observation, the action taken from it, and the reward and flags of that action. A record is 256
    steps with automatic reset: the step after one that is `done` is the first of the level's next episode.

    Attributes:
        level_id: ids of the levels, int64 [batch].
        first: step of the record at which each window starts, int64 [batch].
        mask: bool [batch, time]; False for padding, whose steps repeat others, and for levels that are left out
            (`levelproof.open`).
        observation: of the requested type, [batch, time, ...] (`symbolic_flat`: float32 [batch, time,
            feature]); None if none was requested.
        action: multi-discrete codes (`levelgen.task.actions`), int32 [batch, time, 6].
        action_mask: entries of an action to which an unfixed joint or a thruster is bound, bool [batch, time, 6].
        reward: float32 [batch, time].
        done: whether the step ended its episode, bool [batch, time].
        terminated: whether the task ended it, so that the value of what follows is 0, bool [batch, time].
        truncated: whether the time limit ended it, so that learners bootstrap from the state reached, bool [batch,
            time].
        goal: whether the step reached the goal, bool [batch, time].
        fields: the other requested fields by name.
    """

    level_id: Int[np.ndarray, " batch"]
    first: Int[np.ndarray, " batch"]
    mask: Bool[np.ndarray, "batch time"]
    observation: Any
    action: Int[np.ndarray, "batch time 6"]
    action_mask: Bool[np.ndarray, "batch time 6"]
    reward: Float[np.ndarray, "batch time"]
    done: Bool[np.ndarray, "batch time"]
    terminated: Bool[np.ndarray, "batch time"]
    truncated: Bool[np.ndarray, "batch time"]
    goal: Bool[np.ndarray, "batch time"]
    fields: dict[str, np.ndarray]

    @property
    def state(self) -> State:
        """States before each action, [batch, time, ...]. Raise UserError unless `record/state` was read."""
        return self._tree(State, "record/state/")

    @property
    def record(self) -> Record:
        """Records, [batch, time, ...]. Raise UserError unless `record` was read."""
        return self._tree(Record, "record/")

    @property
    def level(self) -> Level:
        """Levels, [batch, ...]. Raise UserError unless `level` was read."""
        return self._tree(Level, "level/")

    def _tree(self, kind: type[T], path: str) -> T:
        try:
            return tree_of(kind, self.fields, path)
        except KeyError as error:
            raise UserError(f"The field {error.args[0]} was not read: pass fields=[{path[:-1]!r}].") from None


def batch_of(
    arrays: Mapping[str, np.ndarray],
    level_id: Int[np.ndarray, " batch"],
    first: Int[np.ndarray, " batch"],
    mask: Bool[np.ndarray, "batch time"],
    observation: Any,
    live: Bool[np.ndarray, "batch time 6"],
    fields: Iterable[str],
) -> Batch:
    """Make a batch of arrays by field name, TRUNCATED among them; `live` is its `action_mask`."""
    done, truncated = arrays["record/done"], arrays[TRUNCATED]
    return Batch(
        level_id=level_id,
        first=first,
        mask=mask,
        observation=observation,
        action=arrays["record/action"],
        action_mask=live,
        reward=arrays["record/reward"],
        done=done,
        terminated=done & ~truncated,
        truncated=truncated,
        goal=arrays["record/goal"],
        fields={name: arrays[name] for name in fields},
    )


def expand_fields(fields: Iterable[str], size: Size) -> list[str]:
    """Expand prefixes such as `record/state` to the names of all fields below them; drop duplicates.

    Raises:
        UserError: a field does not exist.
    """
    known, chosen = [field.name for field in table_for(size)], []
    for prefix in [fields] if isinstance(fields, str) else fields:
        matches = [name for name in known if name == prefix or name.startswith(f"{prefix}/")]
        if not matches:
            near = difflib.get_close_matches(prefix, [*known, "record/state", "record", "level"], n=1, cutoff=0.3)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise UserError(f"There is no field {prefix!r}{hint}: levelproof.Record and levelproof.Level list them.")
        chosen += matches
    return list(dict.fromkeys(chosen))


def whole_numbers(values: ArrayLike, what: str) -> Int[np.ndarray, "..."]:
    """Convert to int64. Raise UserError if these are not integers, such as a mask or fractions."""
    given = np.asarray(values)
    if given.size and given.dtype.kind not in "iu":
        way = "pass np.flatnonzero(mask) in place of a mask" if given.dtype.kind == "b" else "convert them to integers"
        raise UserError(f"The {what} must be integers, not of the type {given.dtype}: {way}.")
    return given.astype(np.int64)


def in_a_row(values: ArrayLike, what: str, count: int | None = None) -> Int[np.ndarray, " item"]:
    """Convert integers [item] to int64; a scalar counts as `count` of them, by default one.

    Raises:
        UserError: they are not integers, have several axes, or are neither one nor `count`.
    """
    given = whole_numbers(values, what)
    if given.ndim > 1 or (given.ndim and count is not None and len(given) not in (1, count)):
        wanted = "one axis" if count is None else f"the shape [{count}], as the indices"
        raise UserError(f"The {what} have the shape {[*given.shape]}: they must have {wanted}.")
    return np.broadcast_to(given, count) if count is not None else np.atleast_1d(given)


def require_steps(steps: np.ndarray) -> None:
    """Raise UserError unless all of these are steps of a record."""
    if ((steps < 0) | (steps >= RECORD_STEPS)).any():
        raise UserError(f"There are no steps {steps.tolist()} in a record: use steps from 0 to {RECORD_STEPS - 1}.")


def timed_out(
    done: Bool[np.ndarray, "item time"], goal: Bool[np.ndarray, "item time"], limit: int
) -> Bool[np.ndarray, "item time"]:
    """Return at which steps of whole records the time limit (env steps) ended an episode short of its goal."""
    steps = np.arange(done.shape[1])
    starts = np.where(done, steps + 1, 0)[:, :-1]  # first step of the episode after each end
    start = np.maximum.accumulate(np.pad(starts, [(0, 0), (1, 0)]), 1)
    return done & ~goal & (steps - start + 1 >= limit)


def state_in(
    arrays: dict[str, np.ndarray], indices: Int[np.ndarray, "*items"], steps: Int[np.ndarray, "*items"]
) -> EnvState:
    """Return environment states as jax arrays, one for each item; their `level_index` is the item's index.

    Args:
        arrays: of levels and their whole records by field name, one of each per item, flat.
        indices: of trajectories.
        steps: env steps within the records.
    """
    rows = np.arange(indices.size)
    now = {name: x[rows, steps.ravel()] for name, x in arrays.items() if name.startswith("record/")}
    level = replace(tree_of(Level, arrays, "level/"), state=tree_of(State, now, "record/state/"))
    counts = indices.ravel().astype(np.int32), np.zeros(indices.size, np.int32)
    parts = level, now["record/timestep"], now["record/last_distance"], *counts
    return EnvState(*jax.tree.map(lambda x: jnp.asarray(x.reshape((*indices.shape, *x.shape[1:]))), parts))
