"""The benchmark of data that teaches, on clones of two updates."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.teaching import run

pytestmark = pytest.mark.campaign


def test_policies_learn_from_the_same_levels_and_at_the_same_cost(tmp_path: Path) -> None:
    kinds = "masters", "label", "masters, noisy rollouts"
    numbers = {"levels": 64, "cost": 20, "updates": 2, "cost-updates": 2, "seeds": 1, "measured": 8}
    words = [word for name, number in numbers.items() for word in (f"--{name}", str(number))]
    args = parser("teaching").parse_args(["teaching", "--data", *kinds, *words, "--folder", str(tmp_path)])
    report = run(args)
    same, cost = (table.rows for table in report.tables)
    assert [row[0] for row in same] == [row[0] for row in cost] == [*kinds]
    assert len({row[1] for row in same}) == 1
    assert 30 <= int(same[0][1]) <= 45, "some 40 of 64 levels are solved"
    masters, label, noisy = same
    assert masters[2:5] == noisy[2:5]
    assert float(masters[3]) > float(label[3]) > 0, "experts cost more than a short search"
    assert int(cost[1][1]) > int(cost[0][1]) > 0, "as many core-seconds find more labels"
    assert run(args).tables == report.tables, "finished policies and evaluations are kept"
