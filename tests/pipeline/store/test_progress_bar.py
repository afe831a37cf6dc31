"""Progress bars, and the lines in their place where there is no terminal."""

import io
from itertools import count
from types import SimpleNamespace

import pytest
from rich.console import Console

from levelproof.pipeline.store import progress_bar
from levelproof.pipeline.store.progress_bar import LINE_EVERY, ProgressBar, TextBar, shown_blocks


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let LINE_EVERY pass from one update to the next."""
    monkeypatch.setattr(progress_bar, "time", SimpleNamespace(monotonic=count(0.0, LINE_EVERY).__next__))


@pytest.mark.usefixtures("slow")
def test_line_has_no_rate_before_one_is_known() -> None:
    text = io.StringIO()
    with ProgressBar("levels", 100, Console(file=text)) as bar:
        bar.advance(10)
        bar.advance(20)
    first, second = text.getvalue().splitlines()
    assert first == "10/100 levels"
    assert second.startswith("30/100 levels · ")
    assert "/s · about " in second


@pytest.mark.usefixtures("slow")
def test_blocks_are_counted_in_items_and_only_if_many() -> None:
    text = io.StringIO()
    assert [*shown_blocks(10, 4, "levels", Console(file=text))] == [0, 4, 8]
    assert [line.split(" · ")[0] for line in text.getvalue().splitlines()] == [f"{n}/10 levels" for n in (4, 8, 10)]
    few = io.StringIO()
    assert [*shown_blocks(10, 4, "levels", Console(file=few), least=11)] == [0, 4, 8]
    assert [*shown_blocks(0, 4, "levels", Console(file=few))] == []
    assert not few.getvalue()


def test_a_file_gets_kept_lines_and_one_every_half_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    now, text = [0.0], io.StringIO()
    monkeypatch.setattr(progress_bar, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with TextBar(Console(file=text), "compiling", 100) as bar:
        for update in range(1, 101):
            now[0] += 1.0
            bar.show(update, f"update {update}", keep=update == 40)
    assert text.getvalue().splitlines() == ["update 30", "update 40", "update 70", "update 100"]


def test_bar_within_a_bar_is_not_drawn() -> None:
    """Two would move one cursor."""
    outer, inner = (Console(file=io.StringIO(), force_terminal=True) for _ in range(2))
    with ProgressBar("rows", 2, outer) as bar:
        bar.advance(1)
        with ProgressBar("fragments", 2, inner) as other:
            other.advance(1)
        bar.advance(1)
    assert not inner.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    with ProgressBar("fragments", 2, inner) as other:
        other.advance(1)
    for console in (outer, inner):
        assert console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
