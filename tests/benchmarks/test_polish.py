"""Polished witnesses: the comparison of steps to the goal, and that polishing never lengthens."""

import numpy as np
import pytest

from benchmarks.polish import POLISH, Lengths, lengths, masters_excess, means, summary


def test_masters_excess_compares_with_the_longest_polish() -> None:
    sample = Lengths(np.array([40, 80]), np.array([[40, 60], [30, 50], [20, 50]]), np.array([30, 40]))
    assert means(sample) == [60, 50, 40, 35, 35]
    assert masters_excess(sample).tolist() == pytest.approx([0.5, -0.2])
    document = summary(sample)
    assert (document["levels"], document["default"], document["masters"]) == (2, 60, 35)
    assert document["polished"] == {str(budget): steps for budget, steps in zip(POLISH, (50, 40, 35), strict=True)}
    assert document["masters_excess"] == pytest.approx(0.15)


@pytest.mark.campaign
def test_polish_never_lengthens_a_witness() -> None:
    sample = lengths("s", 20_000, 8)
    assert len(sample.default)
    assert (np.diff(np.concatenate([sample.default[None], sample.polished]), axis=0) <= 0).all()
