"""Rows of a program in which levels are advanced side by side: when one leaves the next of the queue comes in."""

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

Rows = Any  # what a program advances: a dataclass, its `levels` with their axis last, all else level-first


class SearchResult(NamedTuple):
    """What came of some levels, level first."""

    success: Success  # length 0: none was found
    env_steps: Int[Array, " level"]  # of all lanes, those that shorten a success included
    varied: Int[Array, " level"]  # env steps in which what came nearest was varied
    cells: Int[Array, " level"]  # that were reached; each as wide as cells were then
    grew: Int[Array, " level"]  # env steps when the last cell was reached


class SearchJob:
    """Levels that came together, and what is known of each so far."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"], nothing: SearchResult) -> None:
        self.levels, self.level_ids, self.known = levels, level_ids, nothing
        self.left = len(level_ids)  # levels that are searched, or wait for it
        self.ledger = Ledger(len(level_ids))

    @property
    def env_steps(self) -> int:
        """So far."""
        return int(self.known.env_steps.sum() + self.known.varied.sum())


@dataclass(frozen=True)
class Entrant:
    """A level that has a row, or waits for one."""

    sought: SearchJob
    index: int  # of the level there
    known: Any = None  # what its row begins with beside the level, as numpy arrays


class Stage:
    """An exception leaves it useless: its arrays were used up."""

    def __init__(self, width: int) -> None:
        self.waiting: deque[Entrant] = deque()
        self.at: list[Entrant | None] = [None] * width  # of each row
        self.rows: Rows = None  # there once the first level has come

    @property
    def present(self) -> int:
        """Levels that have a row, or wait for one."""
        return len(self.waiting) + sum(at is not None for at in self.at)

    def step(
        self,
        begin: Callable[[Level, Int[np.ndarray, " row"], Any], Rows],
        advance: Callable[[Rows], Rows],
        look: Callable[[Rows], tuple[Bool[Array, " row"], Any]],
    ) -> Iterator[tuple[int, Entrant, Any]]:
        """Advance all rows, and tell of each level that has one what is seen of it now: its row, it, and that.

        Args:
            begin: rows, from levels, their ids and what else is known of them.
            advance: them.
            look: which of them are done, and what is told of each, level first.
        """
        with lap() as took:
            self._enter(begin)
            self.rows = advance(self.rows)
            done, seen = jax.device_get(look(self.rows))
        busy = [(row, entrant) for row, entrant in enumerate(self.at) if entrant]
        of_row = took.seconds / len(self.at)
        # Empty rows are those of one that is there, so that their cost is counted once
        busy[-1][1].sought.ledger.add("idle", Lap(of_row * (len(self.at) - len(busy)), took.compiling))
        for row, entrant in busy:
            entrant.sought.ledger.put("search", entrant.index, of_row)
            if done[row]:
                self.at[row] = None
            yield row, entrant, jax.tree.map(lambda x, row=row: x[row], seen)

    def _enter(self, begin: Callable[[Level, Int[np.ndarray, " row"], Any], Rows]) -> None:
        """Let levels that wait take the rows that others left."""
        empty = [row for row, at in enumerate(self.at) if not at][: len(self.waiting)]
        if not empty:
            return
        for row in empty:
            self.at[row] = self.waiting.popleft()
        some = [entrant or self.at[empty[0]] for entrant in self.at]
        of_row = [(take(of.sought.levels, np.array([of.index])), of.sought.level_ids[of.index]) for of in some if of]
        levels = jax.tree.map(lambda *xs: np.concatenate(xs, -1), *(level for level, _ in of_row))
        known = jax.tree.map(lambda *xs: np.stack(xs), *(of.known for of in some if of))
        fresh = begin(levels, np.array([level_id for _, level_id in of_row]), known)
        comes = np.isin(np.arange(len(some)), empty)
        self.rows = fresh if self.rows is None else entered(self.rows, fresh, comes)


@partial(jax.jit, donate_argnames="rows")
def entered(rows: Rows, fresh: Rows, comes: Bool[Array, " row"]) -> Rows:
    """The rows, some of them taken by fresh ones."""
    first = lambda old, new: jnp.where(comes.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    last = lambda old, new: jnp.where(comes, new, old)
    levels = jax.tree.map(last, rows.levels, fresh.levels)
    return replace(jax.tree.map(first, replace(rows, levels=None), replace(fresh, levels=None)), levels=levels)
