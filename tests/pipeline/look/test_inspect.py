"""Questions about a manifest: what a condition chooses, and that nothing more is read than it takes."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from experts.labels import Label, unsolved_reason
from pipeline.jobs.schedule import WorkUnit
from pipeline.jobs.unit import commit
from pipeline.look.inspect import inspect, survey
from pipeline.read.select import columns_in
from pipeline.store import manifest
from pipeline.store.layout import split_path
from pipeline.store.manifest import Fragment, read_fragment
from pipeline.store.schema import COLUMNS
from tests.pipeline.made import made_job, made_result, made_split, made_verdict

LABELS = [Label.SOLVED, Label.TRIVIAL, Label.UNSOLVED, Label.UNSOLVABLE]


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("data"), [LABELS] * 3)


@pytest.mark.parametrize(
    ("condition", "labels"),
    [
        ("sticky_success_rate > 0.4", {"solved": 3}),  # trivial levels have no such rate
        ("moved_success_rate IS NULL", {"trivial": 3, "unsolved": 3, "unsolvable": 3}),
        ("best_return > -1e30", {"solved": 3}),
        ("list_max(learning_curve) > 0.4", {"solved": 3, "trivial": 3, "unsolvable": 3, "unsolved": 3}),
        ("learning_curve[1] > 0.4", {}),
    ],
)
def test_what_has_no_number_is_neither_above_nor_below_one(split: Path, condition: str, labels: dict) -> None:
    assert survey(split, condition)["labels"] == labels


def test_only_the_columns_of_the_question_are_read(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And of the few rows that are shown, the fragments that have them."""
    read: list[tuple[int, int]] = []

    def counted(path: Path, columns: Sequence[str], *how: Any) -> tuple[Fragment, pa.Table]:
        fragment, table = read_fragment(path, columns, *how)
        read.append((table.num_rows, table.num_columns))
        assert set(table.column_names) == set(columns)
        return fragment, table

    monkeypatch.setattr(manifest, "read_fragment", counted)
    facts = survey(split, "env_steps > 0 AND level_id >= 4", rows=2)
    assert [row["level_id"] for row in facts["rows"]] == [4, 5]
    assert facts["rows"][0].keys() == set(COLUMNS.names)
    assert sorted(read) == [(4, 3)] * 3 + [(4, 10)] * 3 + [(4, len(COLUMNS))]


@pytest.mark.parametrize(
    ("where", "columns"),
    [
        (None, []),
        ("level_id < 3", ["level_id"]),
        ("\"Label\" = 'solved' AND versions.jax > env_steps", ["label", "env_steps", "versions"]),
        ("COLUMNS(*) IS NOT NULL", COLUMNS.names),
        ("env_steps = (SELECT max(x) FROM manifest AS m(x))", COLUMNS.names),
    ],
)
def test_columns_of_a_condition(where: str | None, columns: list[str]) -> None:
    assert columns_in(where) == columns


def test_experts_that_diverged_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job, ids = made_job(str(tmp_path), "levels=3"), [0, 1, 2]
    split = split_path(job.out, job.budget, job.size)
    split.mkdir(parents=True)
    reasons = [unsolved_reason(8, True, False, diverged) for diverged in (None, 1024, 2048)]
    verdicts = [made_verdict(Label.UNSOLVED, label_reason=reason) for reason in reasons]
    result = dataclasses.replace(made_result(ids, [Label.UNSOLVED] * 3), verdicts=verdicts)
    commit(job, split, WorkUnit(tuple(ids)), result)
    assert survey(split)["diverged"] == 2
    assert survey(split, "level_id < 2")["diverged"] == 1
    inspect(split, None, 0, as_json=False)
    assert "experts that diverged:           2\n" in capsys.readouterr().out
