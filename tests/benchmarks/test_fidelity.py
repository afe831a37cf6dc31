"""The comparison of samplers, on samples whose answer is known."""

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.fidelity import SizeReport, compare, p_value, summarise, summary, table
from benchmarks.statistics import holm

Draw = Callable[[np.random.Generator, int], np.ndarray]
SAME: list[Draw] = [
    lambda rng, n: rng.normal(size=n),
    lambda rng, n: rng.integers(0, 5, n),
    lambda rng, n: rng.integers(0, 1000, n),
    lambda rng, n: rng.random(n) < 0.3,
]
OTHER: list[Draw] = [
    lambda rng, n: rng.normal(0.1, size=n),
    lambda rng, n: rng.integers(0, 6, n),
    lambda rng, n: rng.integers(0, 900, n),
    lambda rng, n: rng.random(n) < 0.35,
]


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator for each test, so that no test's samples depend on which tests ran before."""
    return np.random.default_rng(0)


@pytest.mark.campaign
@pytest.mark.parametrize("draw", SAME)
def test_p_value_is_rarely_small_for_equal_distributions(draw: Draw, rng: np.random.Generator) -> None:
    p = np.array([p_value(draw(rng, 2000), draw(rng, 2000)) for _ in range(300)], float)
    assert (p < 0.01).mean() < 0.035
    assert 0.3 < np.median(p) < 0.75


@pytest.mark.parametrize(("draw", "other"), list(zip(SAME, OTHER, strict=True)))
def test_p_value_is_small_for_different_distributions(draw: Draw, other: Draw, rng: np.random.Generator) -> None:
    assert (p_value(draw(rng, 20_000), other(rng, 20_000)) or 0) < 1e-6


def test_p_value_handles_constant_empty_and_rare_values() -> None:
    assert p_value(np.ones(9), np.ones(7)) is None
    assert p_value(np.array([]), np.array([])) is None
    assert p_value(np.array([]), np.arange(3).repeat(50)) == 0
    assert p_value(np.array([0] * 500 + [1]), np.array([0] * 500 + [2])) == 1  # too rare to tell


def test_holm_corrects_p() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_compare_finds_the_only_different_statistic(rng: np.random.Generator) -> None:
    same = {f"same {i}": rng.normal(size=(2, 5000)) for i in range(50)}
    ours, theirs = ({name: pair[side] for name, pair in same.items()} for side in (0, 1))
    ours |= {"level role": np.repeat([0, 1], 2500), "never": np.array([]), "constant": np.zeros(10)}
    theirs |= {"level role": np.repeat([0, 1], (2000, 3000)), "never": np.array([]), "constant": np.zeros(10)}
    compared = compare(ours, theirs)
    assert [name for name, c in compared.items() if c.corrected is not None and c.corrected < 1e-3] == ["level role"]
    assert "never" not in compared
    assert compared["constant"].p is None
    assert compared["level role"].ours == "0: 50.0%"
    assert compared["level role"].theirs == "1: 60.0%"


def test_summarise_shows_a_mean_or_a_share() -> None:
    assert summarise("thruster power", np.array([1.0, 2.0])) == "1.5"
    assert summarise("joint fixed", np.array([True, False, False, False])) == "25.00%"
    assert summarise("joint fixed", np.array([])) == "none"


def test_tables_show_every_statistic_and_the_verdict() -> None:
    ours = {"level role": np.repeat([0, 1], 500), "only here": np.arange(50.0)}
    report = SizeReport("s", 1000, compare(ours, {**ours, "level role": np.repeat([0, 1], (400, 600))}))
    rows = {row[0]: row[1:] for row in table([report, SizeReport("m", 9, {})]).rows}
    assert rows["only here"][-1] == "same"
    assert rows["only here"][3:6] == ["", "", ""]
    assert rows["level role"][:2] == ["0: 50.0%", "1: 60.0%"]
    assert rows["level role"][-1] == "differs: s"
    assert ["differ (corrected p < 0.001)", "1"] in summary([report]).rows
