"""Search slots: rows of one program that advances levels side by side; when a level leaves, the next one enters."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.ledger import Lap, Ledger, lap
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level

Rows = Any  # state of all search slots: a dataclass, its `levels` with the level axis last, all else level-first


class SearchResult(NamedTuple):
    """Results of some levels, level first."""

    success: Success  # length 0: none
    env_steps: Int[Array, " level"]  # of all lanes, including those that shorten a success
    varied: Int[Array, " level"]  # env steps of variations
    cells: Int[Array, " level"]  # cells reached, at the width of their time
    grew: Int[Array, " level"]  # env steps when the last cell was reached


class SearchJob:
    """Levels submitted together, and the results of each so far."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"], nothing: SearchResult) -> None:
        self.levels, self.level_ids, self.known = levels, level_ids, nothing
        self.left = len(level_ids)  # levels in search slots or waiting
        self.ledger = Ledger(len(level_ids))

    @property
    def env_steps(self) -> int:
        """Env steps so far."""
        return int(self.known.env_steps.sum() + self.known.varied.sum())


@dataclass(frozen=True)
class Entrant:
    """A level in a search slot, or waiting for one."""

    job: SearchJob
    index: int  # of the level in the job
    known: Any = None  # data that its search starts with besides the level, as numpy arrays


class Stage:
    """Search slots and their queue; unusable after an exception, because its arrays were donated."""

    def __init__(self, width: int) -> None:
        self.waiting: deque[Entrant] = deque()
        self.at: list[Entrant | None] = [None] * width  # level in each search slot
        self.rows: Rows = None  # None until the first level arrives

    @property
    def present(self) -> int:
        """Number of levels in search slots or waiting."""
        return len(self.waiting) + sum(at is not None for at in self.at)

    def step(
        self,
        begin: Callable[[Level, Int[np.ndarray, " row"], Any], Rows],
        advance: Callable[[Rows], Rows],
        look: Callable[[Rows], tuple[Bool[Array, " row"], Any]],
    ) -> Iterator[tuple[int, Entrant, Any]]:
        """Advance all search slots; yield each level in them as (slot, entrant, result so far).

        Args:
            begin: makes the state of slots from levels, their ids and `Entrant.known`.
            advance: advances the state of all slots.
            look: returns which levels are done, and the results of all, level first.
        """
        with lap() as took:
            self._enter(begin)
            self.rows = advance(self.rows)
            done, seen = jax.device_get(look(self.rows))
        busy = [(row, entrant) for row, entrant in enumerate(self.at) if entrant]
        of_row = took.seconds / len(self.at)
        # charge empty slots to one present job, so that they count once
        busy[-1][1].job.ledger.add("idle", Lap(of_row * (len(self.at) - len(busy)), took.compiling))
        for row, entrant in busy:
            entrant.job.ledger.put("search", entrant.index, of_row)
            if done[row]:
                self.at[row] = None
            yield row, entrant, jax.tree.map(lambda x, row=row: x[row], seen)

    def _enter(self, begin: Callable[[Level, Int[np.ndarray, " row"], Any], Rows]) -> None:
        """Move waiting levels into empty search slots."""
        empty = [row for row, at in enumerate(self.at) if not at][: len(self.waiting)]
        if not empty:
            return
        for row in empty:
            self.at[row] = self.waiting.popleft()
        some = [entrant or self.at[empty[0]] for entrant in self.at]
        of_row = [
            (take(entrant.job.levels, np.array([entrant.index])), entrant.job.level_ids[entrant.index])
            for entrant in some
            if entrant
        ]
        levels = jax.tree.map(lambda *xs: np.concatenate(xs, -1), *(level for level, _ in of_row))
        known = jax.tree.map(lambda *xs: np.stack(xs), *(entrant.known for entrant in some if entrant))
        fresh = begin(levels, np.array([level_id for _, level_id in of_row]), known)
        comes = np.isin(np.arange(len(some)), empty)
        self.rows = fresh if self.rows is None else entered(self.rows, fresh, comes)


@partial(jax.jit, donate_argnames="rows")
def entered(rows: Rows, fresh: Rows, comes: Bool[Array, " row"]) -> Rows:
    """Replace the rows in which `comes` is true with fresh ones."""
    first = lambda old, new: jnp.where(comes.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    last = lambda old, new: jnp.where(comes, new, old)
    levels = jax.tree.map(last, rows.levels, fresh.levels)
    return replace(jax.tree.map(first, replace(rows, levels=None), replace(fresh, levels=None)), levels=levels)
