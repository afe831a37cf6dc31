"""The page of policies beside published agents, on a few of the levels that the reference writes."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.agents import run
from levelproof import load_policy

pytestmark = pytest.mark.campaign


def test_report_compares_policies_on_published_levels(tmp_path: Path, reference: Path) -> None:
    words = ["agents", "builtin:s", "--sizes", "s", "--levels", "8", "--folder", str(tmp_path)]
    report = run(parser("agents").parse_args(words))
    random, handmade = report.tables
    assert [row[0] for row in random.rows] == ["doing nothing", "random", "sticky random", "**builtin:s**"]
    origin = load_policy("builtin:s").origin
    assert random.rows[-1][1] == f"{origin['env_steps']:,}, a split of s"
    assert any("witnesses of 24,389 levels" in note for note in report.notes)
    assert [row[0] for row in handmade.rows] == [row[0] for row in random.rows], "published rates are of all levels"
    assert run(parser("agents").parse_args(words)).results == report.results
