"""Progress bar of long reads and writes: on a terminal a bar, elsewhere a line every LINE_EVERY seconds."""

import time
from collections.abc import Iterator
from threading import Lock
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

LINE_EVERY = 30.0  # s between plain lines
ON_TERMINAL = Lock()  # held by the bar on the terminal: a bar nested in its block, such as a read's, would overwrite it


class ProgressBar:
    """Progress display of a `with` block; `console` None: no output."""

    def __init__(self, what: str, total: int, console: Console | None) -> None:
        self._what, self._console, self._line_at = what, console, time.monotonic()
        self._quiet = console is None or not console.is_interactive
        columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"), TimeRemainingColumn()
        self._bar = Progress(*columns, console=console, transient=True, disable=self._quiet)
        self._task = self._bar.add_task("", total=max(total, 1))
        self._shows = False

    def __enter__(self) -> "ProgressBar":
        self._shows = not self._quiet and ON_TERMINAL.acquire(blocking=False)
        if self._shows:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._shows:
            self._bar.stop()
            ON_TERMINAL.release()

    @property
    def completed(self) -> int:
        """Number of finished items."""
        return int(self._bar.tasks[0].completed)

    def advance(self, count: int) -> None:
        """Add `count` finished items."""
        if self._console is None:
            return
        self._bar.advance(self._task, count)
        (task,) = self._bar.tasks
        pace = f" · {task.speed:,.0f}/s" if task.speed else ""  # unknown after a pause
        text = f"{task.completed:,.0f}/{task.total:,.0f} {self._what}{pace}"
        self._bar.update(self._task, description=text)
        if self._quiet and time.monotonic() - self._line_at >= LINE_EVERY:
            self._line_at = time.monotonic()
            left = f" · about {task.time_remaining:,.0f} s left" if task.time_remaining else ""
            self._console.print(text + left, highlight=False, markup=False, soft_wrap=True)


def shown_blocks(count: int, size: int, what: str, console: Console | None = None, least: int = 0) -> Iterator[int]:
    """Yield the first of every `size` of `count` items, and show how many are done.

    Args:
        count: number of items.
        size: items per block.
        what: what the items are, in the plural.
        console: where to show it (default: standard error).
        least: smallest count that is shown.
    """
    shown = (console or Console(stderr=True)) if count >= least else None
    with ProgressBar(what, count, shown) as bar:
        for first in range(0, count, size):
            yield first
            bar.advance(min(size, count - first))
