"""`levelproof columns`: what people read about the manifest's columns."""

import json
from pathlib import Path

import pyarrow as pa
import pytest

from levelproof.pipeline.cli.columns import as_markdown
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.store.columns import DESCRIBED, ManifestColumn

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("of", DESCRIBED, ids=lambda of: of.name)
def test_every_column_says_what_it_means(of: ManifestColumn) -> None:
    assert len(of.meaning) > 8
    assert "|" not in of.meaning + of.null  # cells of a table
    parts = [part.name for part in of.type] if pa.types.is_struct(of.type) else []
    assert all(part in of.meaning for part in parts)


def test_all_columns_are_listed_on_a_narrow_screen(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["columns"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    text = " ".join(out.split())
    assert all(f"{of.name} {of.text} ({of.type_name}" in text for of in DESCRIBED)


def test_a_word_chooses(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["columns", "Goal_", "--json"]) == 2
    assert "No column has the word 'Goal_'" in capsys.readouterr().err
    assert main(["columns", "_to_Goal", "--json"]) == 0
    (column,) = json.loads(capsys.readouterr().out)
    assert (column["name"], column["type"], column["unit"]) == ("steps_to_goal", "int32", "env steps")


def test_the_page_in_the_docs_is_this_list() -> None:
    page = (DOCS / "columns.md").read_text()
    assert page == as_markdown(), "levelproof columns --markdown > docs/columns.md"
