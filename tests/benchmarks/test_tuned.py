"""The benchmark of training on handmade levels, on policies of three updates."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.tuned import run

pytestmark = pytest.mark.campaign
TINY = ("ppo.environments=64", "ppo.horizon=32", "ppo.minibatches=4")


def test_policies_are_trained_on_the_levels_that_they_play(tmp_path: Path) -> None:
    words = ["tuned", "--sizes", "s", "--env-steps", str(3 * 64 * 32 * 4), "--folder", str(tmp_path), "--set", *TINY]
    args = parser("tuned").parse_args(words)
    report = run(args)
    rows = report.tables[0].rows
    assert [row[1] for row in rows] == ["random", "sticky random", "not trained on them", "tuned", "from scratch"]
    assert [row[2] for row in rows] == ["", "", "0", "24,576", "24,576"]
    assert all(each["rates"]["all"]["policy, sampled"]["levels"] == 10 for each in report.results)
    assert run(args).tables == report.tables, "finished training and evaluations are kept"
