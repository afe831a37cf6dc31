"""`levelproof columns`: descriptions of the manifest's columns."""

import json
from pathlib import Path

import pyarrow as pa
import pytest

from levelproof.pipeline.cli.columns import as_markdown
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.store.columns import DESCRIBED

DOCS = Path(__file__).parents[3] / "docs"


def test_each_column_has_a_meaning() -> None:
    assert [column.name for column in DESCRIBED if len(column.meaning) <= 8] == []
    assert [column.name for column in DESCRIBED if "|" in column.meaning + column.null] == []  # cells of a table


def test_meaning_of_a_column_names_its_parts() -> None:
    assert [
        f"{column.name}.{part.name}"
        for column in DESCRIBED
        if pa.types.is_struct(column.type)
        for part in column.type
        if part.name not in column.meaning
    ] == []


def test_columns_lists_all_on_a_narrow_screen(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["columns"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    text = " ".join(out.split())
    assert all(f"{column.name} {column.text} ({column.type_name}" in text for column in DESCRIBED)


def test_columns_selects_by_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["columns", "Goal_", "--json"]) == 2
    assert "No column contains the word 'Goal_'" in capsys.readouterr().err
    assert main(["columns", "_to_Goal", "--json"]) == 0
    (column,) = json.loads(capsys.readouterr().out)
    assert (column["name"], column["type"], column["unit"]) == ("steps_to_goal", "int32", "env steps")


def test_docs_page_equals_the_list_of_columns() -> None:
    page = (DOCS / "columns.md").read_text()
    assert page == as_markdown(), "levelproof columns --markdown > docs/columns.md"
