"""Queries on a manifest: what a condition selects, and which columns and rows are read."""

import csv
import dataclasses
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image
from rich.console import Console

from levelproof.experts.labels import Cause, Label, unsolved_reason
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.dataset.sample import SAMPLE
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.look import entities, query
from levelproof.pipeline.look.entities import count_entities, solved_by_entities
from levelproof.pipeline.look.facts import print_facts
from levelproof.pipeline.look.inspect import inspect, survey
from levelproof.pipeline.look.plot import plot
from levelproof.pipeline.look.query import SHOWN, RowQuery, write_csv
from levelproof.pipeline.look.reasons import kind_of_reason
from levelproof.pipeline.read import levels as levels_module
from levelproof.pipeline.read.select import columns_in
from levelproof.pipeline.store import manifest
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.fragment import Fragment, read_fragment
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.made import made_job, made_result, made_split, made_verdict

LABELS = [Label.SOLVED, Label.TRIVIAL, Label.UNSOLVED, Label.UNSOLVABLE]


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("data"), [LABELS] * 3)


@pytest.mark.parametrize(
    ("condition", "labels"),
    [
        ("sticky_success_rate > 0.4", {"solved": 3}),  # trivial levels have no such rate
        ("perturbed_success_rate IS NULL", {"trivial": 3, "unsolved": 3, "unsolvable": 3}),
        ("best_return > -1e30", {"solved": 3}),
        ("list_max(learning_curve) > 0.4", {"solved": 3, "trivial": 3, "unsolvable": 3, "unsolved": 3}),
        ("learning_curve[1] > 0.4", {}),
    ],
)
def test_condition_excludes_rows_without_a_value(split: Path, condition: str, labels: dict) -> None:
    assert survey(split, RowQuery(condition))["labels"] == labels


def test_survey_reads_only_needed_columns(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For the rows shown, it reads only their fragments."""
    read: list[tuple[int, int]] = []

    def counted(path: Path, columns: Sequence[str], *how: Any) -> tuple[Fragment, pa.Table]:
        fragment, table = read_fragment(path, columns, *how)
        read.append((table.num_rows, table.num_columns))
        assert set(table.column_names) == set(columns)
        return fragment, table

    monkeypatch.setattr(manifest, "read_fragment", counted)
    facts = survey(split, RowQuery("env_steps > 0 AND level_id >= 4", limit=2))
    assert [row["level_id"] for row in facts["rows"]] == [4, 5]
    assert facts["rows"][0].keys() == set(COLUMNS.names)
    assert sorted(read) == [(4, 15)] * 3 + [(4, len(COLUMNS))]


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
def test_columns_in_lists_the_columns_of_a_condition(where: str | None, columns: list[str]) -> None:
    assert columns_in(where) == columns


def test_survey_counts_diverged_experts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job, ids = made_job(str(tmp_path), "levels=3"), [0, 1, 2]
    split = split_path(job.out, job.budget, job.size)
    split.mkdir(parents=True)
    reasons = [unsolved_reason(8, False, cause, 1024) for cause in (Cause.NONE, Cause.DIVERGED, Cause.DIVERGED)]
    verdicts = [made_verdict(Label.UNSOLVED, label_reason=reason) for reason in reasons]
    result = dataclasses.replace(made_result(ids, [Label.UNSOLVED] * 3), verdicts=verdicts)
    commit(job, split, WorkUnit(tuple(ids)), result)
    assert survey(split)["diverged"] == 2
    assert survey(split, RowQuery("level_id < 2"))["diverged"] == 1
    inspect(split, RowQuery(limit=0), as_json=False)
    assert "experts that diverged:           2\n" in capsys.readouterr().out


def test_survey_sorts_and_limits_rows(split: Path) -> None:
    rows = survey(split, RowQuery(columns=["label", "level_id"], sort="steps_to_goal DESC", limit=4))["rows"]
    assert rows == [
        {"label": label, "level_id": level_id}
        for label, level_id in [("solved", 0), ("solved", 4), ("solved", 8), ("trivial", 1)]  # null comes last
    ]
    with pytest.raises(UserError, match=r"^Cannot sort by 'no_such' "):
        survey(split, RowQuery(sort="no_such"))
    with pytest.raises(UserError, match=r"^There is no column 'labels': choose from level_id, "):
        survey(split, RowQuery(columns=["labels"]))


def test_write_csv_writes_all_rows(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Block by block; lists and structs are JSON."""
    monkeypatch.setattr(query, "BLOCK", 5)
    write_csv(split, RowQuery("label != 'trivial'", sort="level_id DESC"), text := io.StringIO())
    read = list(csv.DictReader(text.getvalue().splitlines()))
    assert [int(row["level_id"]) for row in read] == [11, 10, 8, 7, 6, 4, 3, 2, 0]
    assert list(read[0]) == COLUMNS.names
    assert json.loads(read[0]["learning_curve"]) == [None, 0.5]
    assert json.loads(read[0]["versions"])["sampler"] == SAMPLER_VERSION
    assert (read[0]["witness"], read[2]["witness"], read[2]["steps_to_goal"]) == ("", "sampled", "17")
    write_csv(split, RowQuery(columns=["row", "label"], limit=1), text := io.StringIO())
    assert text.getvalue() == "row,label\n0,solved\n"


def test_survey_counts_reasons_witnesses_and_steps(split: Path) -> None:
    facts = survey(split)
    assert facts["reasons"] == {label: {"made for a test": 3} for label in LABELS}
    assert facts["witness"] == {"sampled": 3}
    assert [facts[f"{stage}_steps"] for stage in ("env", "search", "evaluation")] == [12 * 4096, 0, 0]
    low, high = facts["solve_interval"]
    assert 0.15 < low < facts["solve_rate"] == 0.5 < high < 0.85
    assert kind_of_reason("doing nothing reaches the goal in 12 env steps, or 1,024") == (
        "doing nothing reaches the goal in N env steps, or N"
    )


def test_solved_by_entities_resamples_levels_from_ids(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No shard is read."""
    monkeypatch.setattr(levels_module, "read_rows", None)
    monkeypatch.setattr(entities, "SAMPLED", 8)
    facts = solved_by_entities(read_manifest(split, ["label"]), np.arange(12))
    assert (facts["sampled"], facts["of"], facts["levels"]) == (8, 12, 4)
    levels = sample_levels(np.arange(12), SIZES["s"])
    for name, counts in count_entities(levels).items():
        assert set(facts[name]) <= {str(count) for count in counts}
        assert sum(share["tried"] for share in facts[name].values()) == 4


def test_inspect_reports_the_rest_without_a_level_file(
    split: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(*_: object) -> None:
        raise Failure("the file is missing")

    monkeypatch.setattr(entities, "levels_of", missing)
    inspect(split, RowQuery(limit=0), as_json=False)
    assert "solved, by entities:             the file is missing\n" in capsys.readouterr().out


def test_print_facts_wraps_to_the_terminal(split: Path) -> None:
    facts = survey(split)
    facts["reasons"]["solved"] = {"a reason of many words " * 9: 3}
    narrow = Console(file=io.StringIO(), width=70, force_terminal=True, highlight=False, color_system=None)
    print_facts(facts, SHOWN, narrow)
    assert all(len(line.rstrip()) <= 70 for line in narrow.file.getvalue().splitlines())  # type: ignore[attr-defined]
    wide = Console(file=io.StringIO(), highlight=False)
    print_facts(facts, SHOWN, wide)
    assert "a reason of many words " * 9 in wide.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["split.svg", "split.png"])
def test_plot_draws_histograms_and_curves(
    split: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    plot(split, RowQuery(), tmp_path / name)
    output = capsys.readouterr().out
    assert output.startswith(f"{tmp_path / name}: steps to goal, ")
    assert "solved levels, success rate" in output
    if name.endswith("svg"):
        assert f"{split}: 12 levels" in (tmp_path / name).read_text()
    else:
        with Image.open(tmp_path / name) as picture:
            assert picture.width > 1000
    plot(SAMPLE, RowQuery(where="level_id < 20"), tmp_path / name)
    assert "env steps" not in capsys.readouterr().out, "seeds leave costs behind"
    plot(SAMPLE, RowQuery(where="label = 'trivial'"), tmp_path / name)
    assert "success rate" not in capsys.readouterr().out, "these levels have no expert"
    with pytest.raises(UserError, match=r"must end in \.svg or \.png"):
        plot(split, RowQuery(), tmp_path / "split.pdf")
    with pytest.raises(UserError, match="nothing to draw"):
        plot(split, RowQuery("level_id < 0"), tmp_path / name)
