"""The environment for learners that step many lanes: batch axis last, levels by index into a table.

`jax.vmap(env.step)` carries every lane's level through every step. Here a lane's state is only its episode and its
level's index; a lane copies the level's arrays from the table only when it starts an episode. The learner chooses the
next level of each lane, so a step takes no key and draws nothing.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Level, on_device
from levelproof.levelgen.sampling.sampler import FRESH_IDS, Sampler
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.environment import CONTROLS, Environment, EnvParams, info_of
from levelproof.levelgen.task.fresh import renewed
from levelproof.levelgen.task.observe.kinds import constant_features, observe
from levelproof.levelgen.task.rules import TaskState
from levelproof.physics.types import Size


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LevelTable:
    """Levels to start episodes in, or the levels that lanes play; level axis last."""

    level: Level  # the constant arrays of the level; `state` is None
    start: TaskState | None  # first state of an episode in each level; None for levels that lanes play
    features: Float[Array, "feature level"]  # constant part of the symbolic-flat observation; no rows for other types

    @property
    def size(self) -> Size:
        return self.level.size


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExtendedTable:
    """Random levels by id, plus extra levels that may change while lanes play.

    An index below FIRST_EXTRA is a level id; FIRST_EXTRA + i is column i % len(levels) of `levels`, so successive
    levels of one column can have distinct indices.
    """

    sampler: Sampler
    levels: Level

    @property
    def size(self) -> Size:
        return self.sampler.size


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LaneState:
    """The episodes under way, without their levels' constant arrays."""

    now: TaskState
    level_index: Int[Array, " lane"]  # into the table


FIRST_EXTRA = FRESH_IDS  # first index that is not a level id
Table = LevelTable | Sampler | ExtendedTable
LaneStep = tuple[Any, LaneState, LevelTable, Float[Array, " lane"], Bool[Array, " lane"], dict[str, Any]]


@dataclass(frozen=True, eq=False)
class Lanes:
    """An environment (`levelproof.make`) stepped in lanes: its rules, actions and observations, batch axis last.

    `table` is computed once from parameters. `reset` starts episodes and returns `played`: each lane's own columns of
    the table, which every `step` takes and returns. `take` returns these columns for any level indices.

    Do not map `reset` and `step` with `jax.vmap`: give them more lanes instead. `Environment` can be mapped.
    """

    env: Environment

    def table(self, params: EnvParams | None = None) -> Table:
        """Build the table of the levels of `params`; a Sampler is its own table, indexed by level id.

        Raises:
            ValueError: there are no levels, or the level axis is not the last one.
        """
        levels = (params or self.env.default_params).levels
        return levels if isinstance(levels, Sampler) else self._table(on_device(levels))

    def _table(self, level: Level) -> LevelTable:
        features = constant_features(self.env.observation_type, level)
        return LevelTable(_constant(level), task.reset(level), features)

    def take(self, table: Table, level_index: Int[Array, " lane"]) -> LevelTable:
        """Return the table's columns at `level_index`, one for each lane."""
        return replace(self._columns(table, level_index), start=None)

    def _columns(self, table: Table, level_index: Int[Array, " lane"]) -> LevelTable:
        if isinstance(table, Sampler):
            return self._table(table.lanes(level_index))
        if isinstance(table, ExtendedTable):
            extra, sampled = level_index >= FIRST_EXTRA, table.sampler.lanes(level_index % FIRST_EXTRA)
            column = (level_index - FIRST_EXTRA) % len(table.levels)
            chosen = jax.tree.map(lambda x, y: jnp.where(extra, x[..., column], y), table.levels, sampled)
            return self._table(chosen)
        return jax.tree.map(lambda x: x[..., level_index], table)

    def reset(self, table: Table, level_index: Int[Array, " lane"]) -> tuple[Any, LaneState, LevelTable]:
        """Start an episode in every lane; return (observation, state, played)."""
        level_index = jnp.asarray(level_index, jnp.int32)  # as in the states of `step`, so that scans can carry them
        columns = self._columns(table, level_index)
        played, state = replace(columns, start=None), LaneState(_start_of(columns), level_index)
        return self.observe(state, played), state, played

    def step(
        self, table: Table, played: LevelTable, state: LaneState, action: Array, next_index: Int[Array, " lane"]
    ) -> LaneStep:
        """Take one env step in every lane; return (observation, state, played, reward, done, info).

        Args:
            table: all levels.
            played: each lane's level, as `reset` or the previous step returned it.
            state: the episodes under way.
            action: actions of the environment's type, lanes last: int [lane], int [6, lane] or float [6, lane].
            next_index: index in the table of the level that a lane starts if this step ends its episode; for a
                Sampler, the level's id; ExtendedTable says what it is there.

        `info` has the entries of `Environment.step`, lanes last. No gradient flows through the world.

        Raises:
            ValueError: the action has another shape.
            TypeError: it has integers instead of floats, or floats instead of integers.
        """
        env, level = self.env, played.level
        if action.shape[-1:] != state.level_index.shape:
            raise ValueError(f"actions have shape {action.shape}, but there are {len(state.level_index)} lanes")
        state, action = jax.lax.stop_gradient((state, action))
        driven = CONTROLS[env.action_type](level, action)
        now, result, closing, _ = task.advance_driven(level, state.now, driven, env.rules)
        info = info_of(result, closing, state.level_index)
        after = replace(state, now=now)
        if env.final_observation:
            info["final_observation"] = self.observe(after, played)
        if env.auto_reset:
            after = LaneState(now, jnp.where(result.done, next_index.astype(jnp.int32), state.level_index))
            after, played = self._started(table, played, after, result.done)
        return self.observe(after, played), after, played, result.reward, result.done, info

    def observe(self, state: LaneState, played: LevelTable) -> Any:
        """Return the observation of each lane, lanes last."""
        return observe(self.env.observation_type, played.level, state.now.state, played.features)

    def _started(
        self, table: Table, played: LevelTable, state: LaneState, done: Bool[Array, " lane"]
    ) -> tuple[LaneState, LevelTable]:
        """Start the levels at `state.level_index` in the lanes that are done."""
        before = replace(played, start=state.now)
        columns = renewed(done, state.level_index, lambda ids: self._columns(table, ids), before)
        return replace(state, now=_start_of(columns)), replace(columns, start=None)


def _constant(level: Level) -> Level:
    return replace(level, state=None)  # pyright: ignore[reportArgumentType]


def _start_of(columns: LevelTable) -> TaskState:
    """Return the first states in columns that have them."""
    return columns.start  # pyright: ignore[reportReturnType]
