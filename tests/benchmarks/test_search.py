"""What a longer search would find: how it is counted, and that a run goes on where it was stopped."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import search
from benchmarks.search import doublings, result, searched, unsolved, upper

STEPS = np.array([16_384, 60_000, 900_000, -1, 400_000, -1])


def test_shares_and_what_more_would_find() -> None:
    of = result("s", STEPS, 1_000_000)
    assert of["unsolved"] == pytest.approx(2 / 6)
    assert of["interval"][0] < 2 / 6 < of["interval"][1]
    assert of["last_doubling"] == 1
    assert of["next_doubling_at_most"] == pytest.approx(4.744 / 6, abs=1e-3)  # Garwood's table: 4.744 of 1
    assert upper(0) == pytest.approx(-np.log(0.05))
    assert [int(unsolved(STEPS, n).sum()) for n in (16_383, 16_384, 500_000, 1_000_000)] == [6, 5, 3, 2]
    assert doublings(100_000) == [25_000, 50_000, 100_000]


@pytest.mark.campaign
def test_a_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LEVELPROOF_CACHE_DIR", str(tmp_path))
    whole = searched("s", 20_000, 64, 32_768)
    (log,) = tmp_path.glob("search-*.jsonl")
    lines = log.read_text().splitlines(keepends=True)
    assert len(lines) > 2
    log.write_text("".join(lines[:2]))
    asked = []
    looked = search.search
    monkeypatch.setattr(search, "search", lambda levels, ids, *more: asked.extend(ids) or looked(levels, ids, *more))
    assert np.array_equal(searched("s", 20_000, 64, 32_768), whole)
    assert len(asked) == len(lines) - 2
