"""Which levels come next: each curriculum is an initial state, a draw, and what it learns of levels meanwhile.

A curriculum sees levels as indices into a table. Random levels have no table but a sampler, and their indices are ids:
so a curriculum of random levels keeps only ids, however large levels are. `learnability`, `replay` and `evolve` have a
module each.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.levelgen.sampling.sampler import Sampler
from levelproof.levelgen.task.lanes import LevelTable, Table

State = Any  # what a curriculum knows, a pytree; () if nothing
# From levels, env steps and a key to the episodes that end in each level, and how many of them are solved
Attempt = Callable[[Int[Array, " level"], int, Key[Array, ""]], tuple[Array, Array]]


class EndedEpisodes(NamedTuple):
    """EndedEpisodes of all lanes and cores in one update; of those that are not done, what they are so far."""

    done: Bool[Array, " episode"]
    level_index: Int[Array, " episode"]
    gained: Float[Array, " episode"]  # reward
    value: Float[Array, " episode"]  # mean of the critic's values of its states


class Curriculum(NamedTuple):
    """Which levels come next. All functions but `breed` are pure, and all but `draw` get equal arguments on every core.

    Programs are kept by their curriculum: make the same one for equal settings.
    """

    begin: Callable[[], State]
    draw: Callable[[Table, State, Key[Array, ""], int], Int[Array, " lane"]]  # the next level of each lane
    learn: Callable[[State, EndedEpisodes], State] = lambda state, ended: state  # after every update
    table: Callable[[Table, State], Table] = lambda table, state: table  # with the levels that the state adds
    every: int = 0  # updates between calls of `measure` or `breed`; 0: never
    measure: Callable[[Table, Attempt, Key[Array, ""]], State] | None = None  # attempts levels
    breed: Callable[[State, np.random.Generator], State] | None = None  # makes levels; runs on the host


def fresh(table: Table, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    """Draw levels evenly: of a sampler those that are never measured on, of a table any."""
    if isinstance(table, Sampler):
        return table.draw_ids(key, (lanes,))
    assert isinstance(table, LevelTable)
    assert table.start is not None
    return jax.random.randint(key, (lanes,), 0, table.start.timestep.shape[-1])


UNIFORM = Curriculum(lambda: (), lambda table, state, key, lanes: fresh(table, key, lanes))
