"""Polished witnesses: how steps to the goal are compared, and that polish is what shortens them."""

import numpy as np
import pytest

from benchmarks.polish import POLISH, Lengths, lengths, masters_excess, means, summary


def test_masters_are_held_against_the_most_polished() -> None:
    of = Lengths(np.array([40, 80]), np.array([[40, 60], [30, 50], [20, 50]]), np.array([30, 40]))
    assert means(of) == [60, 50, 40, 35, 35]
    assert masters_excess(of).tolist() == pytest.approx([0.5, -0.2])
    told = summary(of)
    assert (told["levels"], told["default"], told["masters"]) == (2, 60, 35)
    assert told["polished"] == {str(budget): steps for budget, steps in zip(POLISH, (50, 40, 35), strict=True)}
    assert told["masters_excess"] == pytest.approx(0.15)


@pytest.mark.campaign
def test_polish_makes_nothing_longer() -> None:
    of = lengths("s", 20_000, 8)
    assert len(of.default)
    assert (np.diff(np.concatenate([of.default[None], of.polished]), axis=0) <= 0).all()
