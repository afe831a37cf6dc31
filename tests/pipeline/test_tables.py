"""Tables are whole wherever they are printed."""

import io

import pytest
from rich.console import Console
from rich.table import Table

from levelproof.pipeline.tables import console_for_tables, folded

PATH = "/data/experiments/" + "x" * 150 + "/128k/s"


def table() -> Table:
    table = Table("level_id", box=None)
    table.add_column("file", no_wrap=True)
    table.add_row("7", PATH)
    return table


def test_long_cell_is_whole_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    console_for_tables().print(folded(table()))
    header, row = capsys.readouterr().out.splitlines()
    assert row.split() == ["7", PATH]
    assert len(header) < 200


def test_long_cell_continues_on_the_next_lines_of_a_terminal() -> None:
    text = io.StringIO()
    Console(file=text, width=80, force_terminal=True, color_system=None).print(folded(table()))
    _, first, *others = text.getvalue().splitlines()
    assert "".join([first.split()[1], *(line.strip() for line in others)]) == PATH
