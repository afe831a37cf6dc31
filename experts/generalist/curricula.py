"""A curriculum chooses each new episode's level: its state decides the draw, and learns from the episodes that ended.

A curriculum sees levels as indices into a table. For random levels the table is a sampler and the index is the level's
id, so only ids are stored; `evolve` also stores the levels that it edits. `learnability`, `replay` and `evolve` have
their own modules.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.levelgen.sampling.sampler import Sampler
from levelproof.levelgen.task.lanes import LevelTable, Table

State = Any  # what a curriculum knows, a pytree; () if nothing
# (level indices, env steps, key) -> (episodes that ended in each level, number of them solved)
Attempt = Callable[[Int[Array, " level"], int, Key[Array, ""]], tuple[Array, Array]]


class EndedEpisodes(NamedTuple):
    """One entry per action and lane of an update, of all cores; the other fields mean something only where `done`."""

    done: Bool[Array, " episode"]
    level_index: Int[Array, " episode"]
    gained: Float[Array, " episode"]  # reward
    expected: Float[Array, " episode"]  # reward so far plus the critic's value, mean over its states


class Curriculum(NamedTuple):
    """Which levels come next. All functions but `breed` are pure, and all but `draw` get equal arguments on every core.

    Compiled programs are cached by curriculum: return the identical object for equal settings.
    """

    begin: Callable[[], State]
    draw: Callable[[Table, State, Key[Array, ""], int], Int[Array, " lane"]]  # the next level of each lane
    learn: Callable[[State, EndedEpisodes], State] = lambda state, ended: state  # after every update
    table: Callable[[Table, State], Table] = lambda table, state: table  # adds the levels that the state holds
    every: int = 0  # updates between calls of `measure` or `breed`; 0: never
    measure: Callable[[Table, Attempt, Key[Array, ""]], State] | None = None  # attempts levels
    breed: Callable[[State, np.random.Generator], State] | None = None  # makes levels; runs on the host
    facts: Callable[[State], Mapping[str, float]] = lambda state: {}  # metrics of the state; runs on the host


def fresh(table: Table, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    """Draw levels uniformly: of a sampler ids below FRESH_IDS, which no policy is measured on; of a table any level."""
    if isinstance(table, Sampler):
        return table.draw_ids(key, (lanes,))
    assert isinstance(table, LevelTable)
    assert table.start is not None
    return jax.random.randint(key, (lanes,), 0, table.start.timestep.shape[-1])


def chance(share: float, key: Key[Array, ""], lanes: int) -> Bool[Array, " lane"]:
    """Draw which lanes belong to a share of all, each independently."""
    return jax.random.uniform(key, (lanes,)) < share


UNIFORM = Curriculum(lambda: (), lambda table, state, key, lanes: fresh(table, key, lanes))
