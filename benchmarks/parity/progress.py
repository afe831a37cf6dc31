"""Progress of the campaign on stderr: a bar on a terminal, otherwise a plain line every LINE_EVERY seconds."""

import time
from contextlib import AbstractContextManager, nullcontext

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

LINE_EVERY = 30.0  # s between plain lines


class Board:
    """Progress display that counts blocks of worlds."""

    def __init__(self, console: Console) -> None:
        self._console, self._line_at = console, 0.0
        columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task("starting", total=1)
        self._done = self._blocks = 0

    def shown(self) -> AbstractContextManager[object]:
        return self._bar if self._console.is_terminal else nullcontext()

    def more(self, blocks: int) -> None:
        """Add blocks to the total."""
        self._blocks += blocks
        self._show("starting")

    def tick(self, what: str, more: int = 0) -> None:
        """Count a finished block; add `more` blocks to the total."""
        self._done, self._blocks = self._done + 1, self._blocks + more
        self._show(what)

    def _show(self, what: str) -> None:
        if self._console.is_terminal:
            self._bar.update(self._task, completed=self._done, total=self._blocks, description=what)
        elif time.monotonic() - self._line_at >= LINE_EVERY:
            self._line_at = time.monotonic()
            self._console.print(f"{self._done}/{self._blocks} blocks · {what}", highlight=False, markup=False)
