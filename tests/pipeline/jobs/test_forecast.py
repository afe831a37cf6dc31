"""Forecasts: the coverage of their intervals, how they scale, and the number of files after sealing."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from levelproof.experts.labels import Label
from levelproof.pipeline.jobs.forecast import PerWitness, Sample, forecast
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.jobs.sizing import unit_levels
from levelproof.pipeline.store.merge import FILE_BYTES
from levelproof.pipeline.store.seal import ROWS
from levelproof.pipeline.store.shard import stored_bytes
from tests.pipeline.made import made_split


def sample(busy: np.ndarray, solved: np.ndarray, **changes: object) -> Sample:
    defaults = {"device": "core", "workers": 2, "wall": 60.0, "once": 5.0, "compiling": 20.0, "row_bytes": 200.0}
    stored = {"full": PerWitness(10_000.0, 5)}
    return Sample(**(defaults | {"busy": busy, "solved": solved, "witnessed": solved, "stored": stored} | changes))  # pyright: ignore[reportArgumentType]


def test_forecast_intervals_cover_nine_of_ten_outcomes() -> None:
    rng, held, widths = np.random.default_rng(0), 0, []
    for _ in range(400):
        seconds = rng.gamma(0.4, 2.0, 4256)
        cost = forecast(sample(seconds[:256], seconds[:256] < 1), 4000, 2, 32)
        truth = seconds[256:].sum() / 2 + 5
        held += cost.wall.low <= truth <= cost.wall.high
        widths.append((cost.wall.high - cost.wall.low) / truth)
    assert 340 <= held <= 385
    assert np.median(widths) < 0.5


def test_forecast_scales_with_levels_and_workers() -> None:
    seconds = np.tile([0.5, 1.5], 100)
    cost = forecast(sample(seconds, seconds < 1), 6_000_000, 64, 32)
    assert cost.wall.expected == pytest.approx(6_000_000 / 64 + 5)
    assert cost.hours.expected == pytest.approx(cost.wall.expected * 64 / 3600)
    assert cost.solved.expected == 3_000_000
    assert cost.seconds_per_solved
    assert cost.seconds_per_solved.expected == pytest.approx(2.0, rel=1e-3)
    assert cost.bytes["full"].expected == 3_000_000 * 10_000 + 6_000_000 * 200
    rows = ROWS // 2
    assert cost.files["full"] == 60 * (1 + 1 + 5 * (1 + -(-rows // 8192))) + 2
    assert FILE_BYTES / 10_000 <= 8192
    assert forecast(sample(seconds, np.zeros(200, bool)), 100, 2, 32).seconds_per_solved is None


def test_forecast_unit_equals_the_schedulers_unless_it_is_set() -> None:
    half = sample(np.full(50, 0.5), np.ones(50, bool))
    for levels, workers in (6_000_000, 64), (1000, 8), (3, 2):
        assert forecast(half, levels, workers, 32).unit == unit_levels(0.5, levels, workers, 32)
    cost = forecast(half, 6_000_000, 64, 32, 7)
    assert (cost.unit, cost.unit_seconds) == (7, 3.5)


def test_forecast_files_equal_those_that_sealing_makes(tmp_path: Path) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED]] * 4)
    seal_split(split, None, Console(quiet=True))
    (shard,) = (split / "shards").iterdir()
    stored = PerWitness(stored_bytes(shard) / 4, sum(entry.is_dir() for entry in shard.iterdir()))
    solved = np.tile([True, False], 4)
    cost = forecast(sample(np.ones(8), solved, stored={"full": stored}), 8, 2, 32)
    files = [path for path in split.rglob("[!.]*") if path.is_file()]
    assert cost.files["full"] == len(files), files
