"""What a longer search would find: how it is counted, and that a run goes on where it was stopped."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import search
from benchmarks.search import curve, doublings, more, result, unsolved, upper

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


def test_sizes_may_be_searched_for_different_env_steps() -> None:
    found, most = {"s": STEPS, "l": STEPS[:4]}, {"s": 800_000, "l": 400_000}
    rows = {cells[0]: list(cells[1:]) for cells in curve(found, most).rows}
    assert rows["800,000"] == ["50.0%", "-"]
    assert rows["400,000"] == ["50.0%", "50.0%"]
    assert [cells[1] for cells in more(found, most).rows] == ["800,000", "400,000"]


@pytest.mark.campaign
def test_a_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed one with what it had kept, a longer one where the shorter one ended: the same as at once."""
    once = search.searched("s", 20_000, 64, 65_536, tmp_path / "once")
    assert 0 < (once < 0).sum() < len(once)
    short = search.searched("s", 20_000, 64, 32_768, tmp_path / "twice")
    assert np.array_equal(short, np.where(once <= 32_768, once, -1))
    kept = sorted((tmp_path / "twice").rglob("*.pickle"))
    for path in kept[:2]:
        path.unlink()
    asked: list[int] = []
    advanced = search.advanced
    monkeypatch.setattr(
        search, "advanced", lambda levels, ids, *more: asked.extend(ids) or advanced(levels, ids, *more)
    )
    assert np.array_equal(search.searched("s", 20_000, 64, 65_536, tmp_path / "twice"), once)
    assert {int(path.stem) for path in kept[:2]} <= set(asked)
    assert len(set(asked)) <= 2 + (short < 0).sum(), "levels with a success are not searched again"
