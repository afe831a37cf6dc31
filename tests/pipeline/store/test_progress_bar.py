"""The progress bar of long reads, where there is no terminal."""

import io

import pytest
from rich.console import Console

from levelproof.pipeline.store import progress_bar
from levelproof.pipeline.store.progress_bar import ProgressBar


def test_line_has_no_rate_before_one_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_bar, "LINE_EVERY", 0.0)
    text = io.StringIO()
    with ProgressBar("levels", 100, Console(file=text)) as bar:
        bar.advance(10)
        bar.advance(20)
    first, second = text.getvalue().splitlines()
    assert first == "10/100 levels"
    assert second.startswith("30/100 levels · ")
    assert "/s · about " in second
