"""The search before experts train: its successes, and their cost in env steps."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.labels import Source
from levelproof.experts.ledger import Ledger
from levelproof.experts.search.search import Searching
from levelproof.experts.search.stage import SearchResult
from levelproof.experts.witness.success import Success, no_success
from levelproof.levelgen.level import Level

STILL_GREW_AFTER = 0.75  # share of a search: a new cell after it suggests that a longer search would find more


class SearchFindings(NamedTuple):
    """Results of the search, on the host, level first."""

    success: Success
    source: list[Source]  # of the success, or of the one that training may find
    search_steps: Int[np.ndarray, " level"]  # 0: not searched
    cells: Int[np.ndarray, " level"]  # that the search reached
    still_grew: Bool[np.ndarray, " level"]  # whether the archive was growing when the search ended


def nothing_found(count: int) -> SearchFindings:
    """Return an empty `SearchFindings` for levels that were not searched."""
    zeros = np.zeros(count, np.int64)
    return SearchFindings(no_success(count), [Source.EXPLORATION] * count, zeros, zeros.copy(), zeros.astype(bool))


def row_of(found: SearchFindings, index: int) -> SearchFindings:
    """Select one level."""
    arrays = jax.tree.map(lambda x: x[index : index + 1], found._replace(source=()))
    return arrays._replace(source=[found.source[index]])


def joined(parts: Sequence[SearchFindings], order: Int[np.ndarray, " level"]) -> SearchFindings:
    """Concatenate the parts, then reorder their levels."""
    arrays = jax.tree.map(lambda *xs: np.concatenate(xs)[order], *(part._replace(source=()) for part in parts))
    source = [source for part in parts for source in part.source]
    return arrays._replace(source=[source[i] for i in order])


class LevelSearch:
    """Levels whose search runs in the search slots that all units of a worker share."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"], searching: Searching) -> None:
        """
        Args:
            levels: the levels, on the host.
            level_ids: their ids, the seeds of all randomness.
            searching: where levels are searched, perhaps beside those of other units.
        """
        self.found = nothing_found(len(level_ids))
        self._searching = searching
        self._job = searching.submit(levels, level_ids) if searching.config.env_steps and len(level_ids) else None
        self.ledger = Ledger(len(level_ids))  # of the search, once it has ended

    @property
    def env_steps(self) -> int:
        """Env steps searched so far."""
        return self._job.env_steps if self._job else int(self.found.search_steps.sum())

    @property
    def waiting(self) -> Int[np.ndarray, " index"]:
        """Indices of the levels whose search has not begun."""
        return np.array(self._searching.waiting(self._job) if self._job else [], int)

    def withdraw(self, indices: Int[np.ndarray, " index"]) -> None:
        """Skip the search of these levels, which must not have begun."""
        if self._job:
            self._searching.withdraw(self._job, indices.tolist())

    def ended(self) -> bool:
        """Return whether no level is left to search; if so, `found` and `ledger` hold the results."""
        if self._job and not self._job.left:
            self._take(self._searching.result(self._job))
            self.ledger = self._job.ledger
            self._job = None
        return self._job is None

    def _take(self, searched: SearchResult) -> None:
        found = self.found
        found.success.action[:], found.success.length[:] = searched.success
        found.source[:] = [Source.SEARCH if length else Source.EXPLORATION for length in found.success.length]
        found.search_steps[:] = searched.env_steps + searched.varied
        found.cells[:] = searched.cells
        found.still_grew[:] = searched.grew > STILL_GREW_AFTER * np.asarray(searched.env_steps)
