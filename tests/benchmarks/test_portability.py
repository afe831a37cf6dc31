"""Witnesses in the reference: how they are counted, and that the reference plays our actions."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.portability import Played, measured, result, rows


def test_result_has_shares_and_intervals() -> None:
    portability, reached = np.array([[1, 1, 0.5], [0, 0.5, 0.25]]), np.array([[True, False, True], [False] * 3])
    document = result("s", 8, Played(portability, reached))
    assert (document["levels"], document["witnesses"]) == (8, 3)
    chosen, first = document["chosen"], document["first"]
    assert chosen["reach_the_goal"] == pytest.approx(2 / 3)
    assert chosen["survive_all"] == pytest.approx(2 / 3)
    assert chosen["reach_the_goal_of_those"] == 0.5
    assert chosen["interval"][0] < 2 / 3 < chosen["interval"][1]
    assert (first["reach_the_goal"], first["survive_all"]) == (0, 0)
    assert np.isnan(first["reach_the_goal_of_those"])
    assert [row[:4] for row in rows(document)] == [["s", "3", "chosen", "66.7%"], ["s", "3", "first", "0.0%"]]


@pytest.mark.campaign
def test_most_witnesses_reach_the_goal_in_the_reference(reference: Path) -> None:
    played = measured(reference, "s", 8, 20_000)
    assert played.reached.shape == played.portability.shape
    assert played.reached[0].mean() > 0.5
