"""The page of policies beside published agents, on a few of the levels that the reference writes."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.agents import run

pytestmark = pytest.mark.campaign


def test_policies_stand_beside_published_agents(tmp_path: Path, reference: Path) -> None:
    words = ["agents", "builtin:s", "--sizes", "s", "--levels", "8", "--folder", str(tmp_path)]
    report = run(parser("agents").parse_args(words))
    random, handmade = report.tables
    assert [row[0] for row in random.rows][-3:] == ["**builtin:s**", "sfl-paper", "sfl-1m-envs"]
    assert random.rows[-3][1] == "5,734,400, s"
    assert [row[-1] for row in handmade.rows[-2:]] == ["42%", "70%"]
    assert run(parser("agents").parse_args(words)).results == report.results
