"""The search before experts train: its successes, and their cost in env steps."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.labels import Source
from levelproof.experts.search.search import SearchResult
from levelproof.experts.witness.success import Success, no_success

STILL_GREW_AFTER = 0.75  # share of a search: a new cell after it suggests that a longer search would find more


class SearchFindings(NamedTuple):
    """Results of the search, on the host, level first."""

    success: Success
    source: list[Source]  # of the success, or of the one that training may find
    search_steps: Int[np.ndarray, " level"]  # 0: not searched
    cells: Int[np.ndarray, " level"]  # cells that the search reached
    still_grew: Bool[np.ndarray, " level"]  # whether the archive was growing when the search ended


def nothing_found(count: int) -> SearchFindings:
    """Return an empty `SearchFindings` for levels that were not searched."""
    zeros = np.zeros(count, np.int64)
    return SearchFindings(no_success(count), [Source.EXPLORATION] * count, zeros, zeros.copy(), zeros.astype(bool))


def row_of(findings: SearchFindings, index: int) -> SearchFindings:
    """Select one level."""
    arrays = jax.tree.map(lambda x: x[index : index + 1], findings._replace(source=()))
    return arrays._replace(source=[findings.source[index]])


def joined(parts: Sequence[SearchFindings], order: Int[np.ndarray, " level"]) -> SearchFindings:
    """Concatenate the parts, then reorder their levels."""
    arrays = jax.tree.map(lambda *xs: np.concatenate(xs)[order], *(part._replace(source=()) for part in parts))
    source = [source for part in parts for source in part.source]
    return arrays._replace(source=[source[i] for i in order])


def findings_of(searched: SearchResult) -> SearchFindings:
    """Return what training and verdicts take from the search."""
    source = [Source.SEARCH if length else Source.EXPLORATION for length in searched.success.length]
    explored, varied, cells, grew, shortened = (np.asarray(x, np.int64) for x in searched[1:])
    env_steps = explored + varied + shortened
    return SearchFindings(searched.success, source, env_steps, cells, grew > STILL_GREW_AFTER * explored)
