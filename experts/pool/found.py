"""What is known of levels before their experts train: successes, and what it took to look for them."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.labels import Source
from levelproof.experts.ledger import Ledger
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.scout import scout
from levelproof.experts.search.search import Searching
from levelproof.experts.search.stage import Searched
from levelproof.experts.witness.success import Success, no_success
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

STILL = 0.75  # of a search: a cell that is new after so much of it says that more of it would find more


class Found(NamedTuple):
    """On the host, level first."""

    success: Success
    source: list[Source]  # of the success; where there is none, of the one that training may find
    scout_steps: Int[np.ndarray, " level"]
    search_steps: Int[np.ndarray, " level"]  # 0: it was not searched
    cells: Int[np.ndarray, " level"]  # that its search reached
    still_grew: Bool[np.ndarray, " level"]  # its archive, at the end of its search


def nothing_found(count: int) -> Found:
    """Of levels in which nobody has looked."""
    zeros = np.zeros(count, np.int64)
    return Found(no_success(count), [Source.EXPLORATION] * count, zeros, zeros.copy(), zeros.copy(), zeros.astype(bool))


def row_of(found: Found, index: int) -> Found:
    """Of one of its levels."""
    arrays = jax.tree.map(lambda x: x[index : index + 1], found._replace(source=()))
    return arrays._replace(source=[found.source[index]])


def joined(parts: Sequence[Found], order: Int[np.ndarray, " level"]) -> Found:
    """Of the levels of all parts one after another, in another order."""
    arrays = jax.tree.map(lambda *xs: np.concatenate(xs)[order], *(part._replace(source=()) for part in parts))
    source = [source for part in parts for source in part.source]
    return arrays._replace(source=[source[i] for i in order])


class Looking:
    """Levels in which scouts have looked, and in which a search goes on where they found nothing."""

    def __init__(
        self,
        levels: Level,
        level_ids: Int[np.ndarray, " level"],
        procedure: Procedure,
        rules: TaskParams,
        searching: Searching,
    ) -> None:
        """
        Args:
            levels: on the host.
            level_ids: their ids, the seeds of all randomness.
            procedure: how long to look.
            rules: of the task.
            searching: where levels are searched, perhaps beside others.
        """
        scouted = scout(levels, level_ids, procedure.scout, rules)
        source = [Source.SCOUT if length else Source.EXPLORATION for length in scouted.success.length]
        self.found = nothing_found(len(level_ids))._replace(
            success=scouted.success, source=source, scout_steps=scouted.env_steps
        )
        self._left = np.flatnonzero(scouted.success.length == 0)
        some = take(levels, self._left), level_ids[self._left]
        self._searching = searching
        self._sought = searching.submit(*some) if procedure.search.env_steps and len(self._left) else None
        self.ledger = Ledger(len(level_ids))  # of the search, once it has ended

    @property
    def env_steps(self) -> int:
        """So far, of scouts and search."""
        searched = self._sought.env_steps if self._sought else int(self.found.search_steps.sum())
        return int(self.found.scout_steps.sum()) + searched

    @property
    def waiting(self) -> Int[np.ndarray, " index"]:
        """Indices of its levels whose search has not begun."""
        return self._left[self._searching.waiting(self._sought)] if self._sought else self._left[:0]

    def withdraw(self, indices: Int[np.ndarray, " index"]) -> None:
        """Do not search levels whose search has not begun."""
        if self._sought:
            self._searching.withdraw(self._sought, np.flatnonzero(np.isin(self._left, indices)).tolist())

    def ended(self) -> bool:
        """Whether nothing is left to search: then `found` has what came of it."""
        if self._sought and not self._sought.left:
            self._take(self._searching.result(self._sought))
            self.ledger.take(self._sought.ledger, self._left)
            self._sought = None
        return self._sought is None

    def _take(self, searched: Searched) -> None:
        """Put in what the search found."""
        found, left = self.found, self._left
        put = lambda whole, part: whole.__setitem__(left, part)
        jax.tree.map(put, found.success, searched.success)
        put(found.search_steps, searched.env_steps + searched.varied)
        put(found.cells, searched.cells)
        put(found.still_grew, searched.grew > STILL * np.asarray(searched.env_steps))
        for i in left[np.asarray(searched.success.length) > 0]:
            found.source[i] = Source.SEARCH
