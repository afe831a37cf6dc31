"""The page of levels that only a long search solves: its counts agree, and each solution replays."""

import numpy as np
import pytest

from benchmarks import late
from benchmarks.__main__ import parser
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.sampler import sample_levels


@pytest.mark.campaign
def test_page_describes_levels_that_the_short_search_misses() -> None:
    args = parser("late").parse_args(["late", "--size", "s", "--levels", "96", "--pictures", "2"])
    report = late.run(args)
    everything, *_ = kinds = report.tables[0].rows
    undecided, early, of_all = int(everything[1]), int(everything[2].split()[0]), int(everything[3])
    assert 0 < early + of_all <= undecided <= 96
    thrusters = [row for row in kinds if "thruster" in row[0]]
    assert [sum(int(row[column].split()[0]) for row in thrusters) for column in (1, 2, 3)] == [undecided, early, of_all]
    assert len(report.results) == min(2, of_all)
    for row in report.results:
        level = sample_levels(np.array([row["level"]], np.int32), size_of("s"))
        assert row["bodies"] == late.bodies_of(level)[0] == 3
        assert 0 <= row["changes of the action"] < row["steps to goal"] <= 256
