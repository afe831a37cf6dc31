"""What people see while the campaign runs, on stderr: a bar on a terminal, plain lines elsewhere."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

LINE_EVERY = 30.0  # s between plain lines


class Board:
    """Counts blocks of worlds."""

    def __init__(self, console: Console) -> None:
        self._console, self._line_at = console, 0.0
        columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task("starting", total=0)

    @contextmanager
    def shown(self) -> Iterator["Board"]:
        if not self._console.is_terminal:
            yield self
            return
        with self._bar:
            yield self

    def more(self, blocks: int) -> None:
        """There are so many more blocks to do."""
        self._bar.update(self._task, total=(self._bar.tasks[0].total or 0) + blocks)

    def tick(self, what: str, more: int = 0) -> None:
        """A block is done; of `more` nobody knew."""
        self.more(more)
        self._bar.update(self._task, advance=1, description=what)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._line_at > LINE_EVERY:
            self._line_at, task = now, self._bar.tasks[0]
            self._console.print(f"{task.completed:.0f}/{task.total:.0f} blocks · {what}", highlight=False)
