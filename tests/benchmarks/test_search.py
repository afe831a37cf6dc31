"""The benchmark of a longer search: its counts, and that a stopped run resumes."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import search
from benchmarks.search import curve, doublings, remainder, result, unsolved, upper

STEPS = np.array([16_384, 60_000, 900_000, -1, 400_000, -1])


def test_result_has_shares_and_bounds_the_next_doubling() -> None:
    summary = result("s", STEPS, 1_000_000)
    assert summary["unsolved"] == pytest.approx(2 / 6)
    assert summary["interval"][0] < 2 / 6 < summary["interval"][1]
    assert summary["last_doubling"] == 1
    assert summary["next_doubling_at_most"] == pytest.approx(4.744 / 6, abs=1e-3)  # Garwood's table: 4.744 of 1
    assert upper(0) == pytest.approx(-np.log(0.05))
    assert [int(unsolved(STEPS, n).sum()) for n in (16_383, 16_384, 500_000, 1_000_000)] == [6, 5, 3, 2]
    assert doublings(100_000) == [25_000, 50_000, 100_000]


def test_tables_allow_different_env_steps_per_size() -> None:
    steps, max_steps = {"s": STEPS, "l": STEPS[:4]}, {"s": 800_000, "l": 400_000}
    rows = {cells[0]: list(cells[1:]) for cells in curve(steps, max_steps).rows}
    assert rows["800,000"] == ["50.0%", "-"]
    assert rows["400,000"] == ["50.0%", "50.0%"]
    assert [cells[1] for cells in remainder(steps, max_steps).rows] == ["800,000", "400,000"]


@pytest.mark.campaign
def test_searched_resumes_from_kept_searches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed run resumes from what it kept, a longer run from the shorter one, with equal results."""
    once = search.searched("s", 20_000, 64, 65_536, tmp_path / "once")
    assert 0 < (once < 0).sum() < len(once)
    short = search.searched("s", 20_000, 64, 32_768, tmp_path / "twice")
    assert np.array_equal(short, np.where(once <= 32_768, once, -1))
    pickles = sorted((tmp_path / "twice").rglob("*.pickle"))
    for path in pickles[:2]:
        path.unlink()
    searched_ids: list[int] = []
    advanced = search.advanced
    monkeypatch.setattr(
        search, "advanced", lambda levels, ids, *more: searched_ids.extend(ids) or advanced(levels, ids, *more)
    )
    assert np.array_equal(search.searched("s", 20_000, 64, 65_536, tmp_path / "twice"), once)
    assert {int(path.stem) for path in pickles[:2]} <= set(searched_ids)
    assert len(set(searched_ids)) <= 2 + (short < 0).sum(), "levels with a success are not searched again"
