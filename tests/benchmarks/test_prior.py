"""The page of attempts before the search, on a split of a few levels."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import parser
from benchmarks.prior import run, undecided
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.made import honest_split

pytestmark = pytest.mark.campaign


def test_counts_and_seconds_are_those_of_the_manifest(tmp_path: Path) -> None:
    split = honest_split(tmp_path / "data", 32, 1)
    args = parser("prior").parse_args(["prior", str(split), "--attempts", "64"])
    (one,) = run(args).results
    table = require_manifest(split, ["label", "seconds"]).table
    labels = table["label"].to_pylist()
    assert (one["solved"], one["unsolved"]) == (labels.count("solved"), labels.count("unsolved"))
    assert 0 < one["found_of_solved"] <= one["solved"]
    assert 0 <= one["searching_found"] <= one["searching"] <= one["everything"]
    assert one["everything"] == pytest.approx(sum(sum(row.values()) for row in table["seconds"].to_pylist()))


def test_first_levels_are_those_of_the_lowest_ids(tmp_path: Path) -> None:
    split = honest_split(tmp_path / "data", 32, 1)
    everything, some = undecided(split, None), undecided(split, 16)
    np.testing.assert_array_equal(some.level_ids, everything.level_ids[everything.level_ids < 16])
