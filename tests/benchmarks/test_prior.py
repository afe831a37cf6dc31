"""The page of attempts before the search, on a split of a few levels."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import parser
from benchmarks.prior import run, undecided
from levelproof import UserError
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.command import here

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("prior")
    done = here(["generate", "levels=32", "budget=5k", "procedure=label", "executor=inline"], folder)
    assert done.returncode == 0, done.stderr
    return folder / "data/5k/s"


def test_counts_and_seconds_are_those_of_the_manifest(split: Path) -> None:
    args = parser("prior").parse_args(["prior", str(split), "--attempts", "64"])
    (one,) = run(args).results
    table = require_manifest(split, ["label", "seconds"]).table
    labels = table["label"].to_pylist()
    assert (one["solved"], one["unsolved"]) == (labels.count("solved"), labels.count("unsolved"))
    assert 0 < one["found_of_solved"] <= one["solved"]
    assert 0 <= one["searching_found"] <= one["searching"] <= one["everything"]
    assert one["everything"] == pytest.approx(sum(sum(row.values()) for row in table["seconds"].to_pylist()))


def test_first_levels_are_those_of_the_lowest_ids(split: Path) -> None:
    everything, some = undecided(split, None), undecided(split, 16)
    np.testing.assert_array_equal(some.level_ids, everything.level_ids[everything.level_ids < 16])


def test_policies_are_one_or_as_many_as_splits(split: Path) -> None:
    args = parser("prior").parse_args(["prior", str(split), "--policy", "builtin:s", "builtin:m"])
    with pytest.raises(UserError, match="names 2 policies: name one, or one for each split"):
        run(args)
