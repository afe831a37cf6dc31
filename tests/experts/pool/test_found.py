"""What training and verdicts take from a search."""

from typing import Any

import numpy as np

from levelproof.experts.labels import Source
from levelproof.experts.pool.found import findings_of
from levelproof.experts.search.search import SearchResult
from levelproof.experts.witness.success import Success


def test_findings_say_whether_a_search_still_grew_in_its_last_quarter() -> None:
    """Of its own env steps: those of variations and of shortening count only as its cost."""
    length: Any = np.array([0, 7, 0])
    columns: Any = [1000, 1000, 2000], [500, 0, 500], [3, 4, 5], [751, 750, 1499], [0, 64, 0]
    success = Success(np.zeros((3, 256, 6), np.int8), length)  # pyright: ignore
    findings = findings_of(SearchResult(success, *map(np.array, columns)))
    assert findings.still_grew.tolist() == [True, False, False]
    assert findings.search_steps.tolist() == [1500, 1064, 2500]
    assert findings.cells.tolist() == [3, 4, 5]
    assert findings.source == [Source.EXPLORATION, Source.SEARCH, Source.EXPLORATION]
