"""Two splits of the same levels: what only one of them solved, at what cost, and whether that may be chance."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.stats import binomtest

from levelproof.experts.labels import Label
from levelproof.experts.ledger import Ledger
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.look.diff import compare, diff, exact_p
from levelproof.pipeline.store.layout import split_path
from tests.pipeline.made import made_job, made_result, made_split

S, U, T = Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL
HERE, THERE = [S, S, U, T, U, S], [S, U, S, T, U, S, S]  # the last level is only there


def split_of(folder: Path, labels: list[Label], budget: str = "64k", steps: int = 17, seed: int = 0) -> Path:
    """Of levels with these labels, ids from 0."""
    job, ids = made_job(str(folder), "size=s", f"budget={budget}"), list(range(len(labels)))
    split = split_path(job.out, job.budget, job.size)
    split.mkdir(parents=True)
    result = made_result(ids, labels)
    cost = {"env_steps": 100 * steps, "scout_steps": 5}
    verdicts = [
        replace(of, **cost, steps_to_goal=steps + i if of.label == S else None) for i, of in enumerate(result.verdicts)
    ]
    ledger = Ledger(len(ids))
    for i in ids:
        ledger.put("training", i, 2.0 * steps)
    commit(job, split, WorkUnit(tuple(ids)), replace(result, verdicts=verdicts, ledger=ledger))
    return split


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same random bits are the levels of both: `made_result` of fewer levels has other ones."""
    folder = tmp_path_factory.mktemp("data")
    return split_of(folder, [*HERE, U], "64k"), split_of(folder, THERE, "256k", steps=16)


def test_who_solved_what(splits: tuple[Path, Path]) -> None:
    facts = compare(*splits)
    assert facts["levels"] == 7
    assert facts["solved"] == [{"solved": 3, "tried": 6}, {"solved": 4, "tried": 6}]
    assert (facts["only"], facts["only_rows"]) == ([1, 2], [[1], [2, 6]])
    assert (facts["both"], facts["neither"], facts["p"]) == (3, 1, 1.0)  # the trivial one is solved in both
    assert facts["labels"]["unsolved"] == {"solved": 2, "unsolved": 1}
    assert facts["settings"] == {"budget": (64_000, 256_000)}


def test_what_the_difference_costs(splits: tuple[Path, Path]) -> None:
    facts = compare(*splits)
    assert [of["seconds"]["training"] for of in facts["cost"]] == [7 * 34, 7 * 32]
    assert [of["env_steps"] for of in facts["env_steps"]] == [7 * 1700, 7 * 1600]
    assert facts["env_steps_for_one_more"] == -700
    assert facts["seconds_for_one_more"] == pytest.approx(-14, abs=1)  # and what writing took
    assert facts["steps_to_goal"]["shorter"] == facts["steps_to_goal"]["levels"] == 2
    assert facts["steps_to_goal"]["median_change"] == -1


@pytest.mark.parametrize(("one", "other"), [(0, 0), (0, 5), (3, 9), (40, 40), (812, 900), (0, 4000)])
def test_p_is_that_of_scipy(one: int, other: int) -> None:
    assert exact_p(one, other) == pytest.approx(binomtest(one, one + other).pvalue if one + other else 1.0, abs=1e-12)


def test_it_is_told_in_words(splits: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    diff(*splits, None, 1, as_json=False)
    told = capsys.readouterr().out
    assert "7 levels are in both." in told
    assert f"Solved only in {splits[1]}: 2, ..." in told
    diff(*splits, "level_id < 2", 1, as_json=True)
    assert json.loads(capsys.readouterr().out)["levels"] == 2


def test_other_levels_are_refused_in_a_sentence(splits: tuple[Path, Path], tmp_path: Path) -> None:
    other = made_split(tmp_path / "fewer", [[S, S]])
    with pytest.raises(UserError, match=r"^Level 0 differs between .*: give two splits of one size"):
        compare(splits[0], other)
    with pytest.raises(UserError, match=r" have no level in common"):
        compare(splits[0], splits[1], "level_id > 99")
