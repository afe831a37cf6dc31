"""Comparison of two splits of the same levels: what only one solved, at what cost, and whether that is significant."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.stats import binomtest

from levelproof.experts.labels import Label
from levelproof.experts.ledger import Ledger
from levelproof.pipeline.dataset.sample import SAMPLE
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.look import cost
from levelproof.pipeline.look.diff import compare, diff, exact_p
from levelproof.pipeline.store.layout import split_path
from tests.pipeline.made import made_job, made_result, made_split
from tests.pipeline.verify.forged import forge

S, U, T = Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL
HERE, THERE = [S, S, U, T, U, S], [S, U, S, T, U, S, S]  # only the second split has the last level


def split_of(folder: Path, labels: list[Label], budget: str = "64k", steps: int = 17, seed: int = 0) -> Path:
    """A split of levels with these labels, ids from 0."""
    job, ids = made_job(str(folder), "size=s", f"budget={budget}"), list(range(len(labels)))
    split = split_path(job.out, job.budget, job.size)
    split.mkdir(parents=True)
    result = made_result(ids, labels)
    cost = {"env_steps": 100 * steps, "search_steps": 5}
    verdicts = [
        replace(verdict, **cost, steps_to_goal=steps + i if verdict.label == S else None)
        for i, verdict in enumerate(result.verdicts)
    ]
    ledger = Ledger(len(ids))
    for i in ids:
        ledger.put("training", i, 2.0 * steps)
    commit(job, split, WorkUnit(tuple(ids)), replace(result, verdicts=verdicts, ledger=ledger))
    return split


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two splits of the same levels, of one number, because the levels of `made_result` depend on their number."""
    folder = tmp_path_factory.mktemp("data")
    return split_of(folder, [*HERE, U], "64k"), split_of(folder, THERE, "256k", steps=16)


def test_compare_counts_levels_solved_in_each_split(splits: tuple[Path, Path]) -> None:
    facts = compare(*splits)
    assert facts["levels"] == 7
    assert facts["solved"] == [{"solved": 3, "tried": 6}, {"solved": 4, "tried": 6}]
    assert (facts["only"], facts["only_rows"]) == ([1, 2], [[1], [2, 6]])
    assert (facts["both"], facts["neither"], facts["p"]) == (3, 1, 1.0)  # `both` includes the trivial level
    assert facts["labels"]["unsolved"] == {"solved": 2, "unsolved": 1}
    assert facts["settings"] == {"budget": (64_000, 256_000)}


def test_compare_prices_each_extra_solved_level(splits: tuple[Path, Path]) -> None:
    facts = compare(*splits)
    assert [side["seconds"]["training"] for side in facts["cost"]] == [7 * 34, 7 * 32]
    assert [side["env_steps"] for side in facts["env_steps"]] == [7 * 1700, 7 * 1600]
    assert facts["env_steps_for_one_more"] == -700
    rest = [sum(side["seconds"].values()) - side["seconds"]["training"] for side in facts["cost"]]  # as measured
    assert facts["seconds_for_one_more"] == pytest.approx(-14 + rest[1] - rest[0])
    assert facts["steps_to_goal"]["shorter"] == facts["steps_to_goal"]["levels"] == 2
    assert facts["steps_to_goal"]["median_change"] == -1


def test_seconds_of_cores_and_gpus_are_not_subtracted(
    splits: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = iter(("core", "GPU"))
    monkeypatch.setattr(cost, "cost_of", lambda rows, known=cost.cost_of: known(rows) | {"of": next(kinds)})
    diff(*splits, None, 1, as_json=False)
    assert "seconds" not in capsys.readouterr().out


@pytest.mark.slow
def test_costs_that_seeds_leave_behind_are_not_zero(capsys: pytest.CaptureFixture[str]) -> None:
    diff(SAMPLE, SAMPLE, "level_id < 20", 1, as_json=False)
    assert "env steps" not in capsys.readouterr().out
    assert compare(SAMPLE, SAMPLE, "level_id < 20")["env_steps"] == [None, None]


@pytest.mark.parametrize(("one", "other"), [(0, 0), (0, 5), (3, 9), (40, 40), (812, 900), (0, 4000)])
def test_exact_p_agrees_with_scipy(one: int, other: int) -> None:
    assert exact_p(one, other) == pytest.approx(binomtest(one, one + other).pvalue if one + other else 1.0, abs=1e-12)


def test_diff_prints_words_or_json(splits: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    diff(*splits, None, 1, as_json=False)
    output = capsys.readouterr().out
    assert "7 levels are in both." in output
    assert f"Solved only in {splits[1]}: 2, ..." in output
    diff(*splits, "level_id < 2", 1, as_json=True)
    assert json.loads(capsys.readouterr().out)["levels"] == 2


def test_levels_that_share_half_of_a_signature_are_compared(splits: tuple[Path, Path], tmp_path: Path) -> None:
    near = shutil.copytree(splits[0], tmp_path / "near")
    forge(near, lambda row: row.update(content_hash="c1:other", signature=["n1:other", row["signature"][0]]), [3])
    assert compare(near, splits[1])["levels"] == 7
    forge(near, lambda row: row.update(signature=["n1:other", "n1:another"]), [3])
    with pytest.raises(UserError, match=r"^Level 3 differs between"):
        compare(near, splits[1])


def test_compare_refuses_different_levels(splits: tuple[Path, Path], tmp_path: Path) -> None:
    other = made_split(tmp_path / "fewer", [[S, S]])
    with pytest.raises(UserError, match=r"^Level 0 differs between .*: give two splits of one size"):
        compare(splits[0], other)
    with pytest.raises(UserError, match=r" have no level in common"):
        compare(splits[0], splits[1], "level_id > 99")
