"""The comparison of samplers: its statistics on samples of which the answer is known."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.fidelity import SizeReport, compare, p_value, summarise, summary, table
from benchmarks.statistics import holm

RNG = np.random.default_rng(0)
Draw = Callable[[int], np.ndarray]
SAME: list[Draw] = [
    lambda n: RNG.normal(size=n),
    lambda n: RNG.integers(0, 5, n),
    lambda n: RNG.integers(0, 1000, n),
    lambda n: RNG.random(n) < 0.3,
]
OTHER: list[Draw] = [
    lambda n: RNG.normal(0.1, size=n),
    lambda n: RNG.integers(0, 6, n),
    lambda n: RNG.integers(0, 900, n),
    lambda n: RNG.random(n) < 0.33,
]


@pytest.mark.campaign
@pytest.mark.parametrize("draw", SAME)
def test_p_is_rarely_small_where_nothing_differs(draw: Draw) -> None:
    p = np.array([p_value(draw(2000), draw(2000)) for _ in range(300)], float)
    assert (p < 0.01).mean() < 0.035
    assert 0.3 < np.median(p) < 0.75


@pytest.mark.parametrize(("draw", "other"), list(zip(SAME, OTHER, strict=True)))
def test_p_is_small_where_something_differs(draw: Draw, other: Draw) -> None:
    assert (p_value(draw(20_000), other(20_000)) or 0) < 1e-6


def test_p_at_the_edges() -> None:
    assert p_value(np.ones(9), np.ones(7)) is None
    assert p_value(np.array([]), np.array([])) is None
    assert p_value(np.array([]), np.arange(3).repeat(50)) == 0
    assert p_value(np.array([0] * 500 + [1]), np.array([0] * 500 + [2])) == 1  # too rare to tell


def test_holm() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_compare_finds_the_one_that_differs() -> None:
    same = {f"same {i}": RNG.normal(size=(2, 5000)) for i in range(50)}
    ours, theirs = ({name: pair[side] for name, pair in same.items()} for side in (0, 1))
    ours |= {"level role": np.repeat([0, 1], 2500), "never": np.array([]), "constant": np.zeros(10)}
    theirs |= {"level role": np.repeat([0, 1], (2000, 3000)), "never": np.array([]), "constant": np.zeros(10)}
    found = compare(ours, theirs)
    assert [name for name, c in found.items() if c.corrected is not None and c.corrected < 1e-3] == ["level role"]
    assert "never" not in found
    assert found["constant"].p is None
    assert found["level role"].ours == "0: 50.0%"
    assert found["level role"].theirs == "1: 60.0%"


def test_told() -> None:
    assert summarise("thruster power", np.array([1.0, 2.0])) == "1.5"
    assert summarise("joint fixed", np.array([True, False, False, False])) == "25.00%"
    assert summarise("joint fixed", np.array([])) == "none"


def test_tables() -> None:
    ours = {"level role": np.repeat([0, 1], 500), "only here": np.arange(50.0)}
    report = SizeReport("s", 1000, compare(ours, {**ours, "level role": np.repeat([0, 1], (400, 600))}))
    rows = {row[0]: row[1:] for row in table([report, SizeReport("m", 9, {})]).rows}
    assert rows["only here"][-1] == "same"
    assert rows["only here"][3:6] == ["", "", ""]
    assert rows["level role"][:2] == ["0: 50.0%", "1: 60.0%"]
    assert rows["level role"][-1] == "differs: s"
    assert ["differ (corrected p < 0.001)", "1"] in summary([report]).rows
