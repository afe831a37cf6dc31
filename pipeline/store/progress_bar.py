"""Progress of long work: on a terminal a bar, elsewhere a line every LINE_EVERY seconds."""

import time
from collections.abc import Iterator
from threading import Lock
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_EVERY = 30.0  # s between plain lines
ON_TERMINAL = Lock()  # held by the bar on the terminal: a bar nested in its block, such as a read's, would overwrite it


def say(console: Console | None, text: str) -> None:
    """Print a permanent line verbatim; `console` None: no output."""
    if console:
        console.print(text, highlight=False, markup=False, soft_wrap=True)


class TextBar:
    """Text of a `with` block: beside a bar on a terminal, elsewhere a line now and then; `console` None: no output."""

    def __init__(
        self, console: Console | None, text: str, total: int, completed: int = 0, transient: bool = False
    ) -> None:
        """`transient`: the bar shows the remaining time, and vanishes at the end."""
        self.line_at = time.monotonic()  # s, of the last line
        self._console, self._quiet, self._shows = console, console is None or not console.is_interactive, False
        clock = TimeRemainingColumn() if transient else TimeElapsedColumn()
        columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"), clock
        self._bar = Progress(*columns, console=console, transient=transient, disable=self._quiet)
        self._task = self._bar.add_task(text, total=total, completed=completed)

    def __enter__(self) -> Self:
        self._shows = not self._quiet and ON_TERMINAL.acquire(blocking=False)
        if self._shows:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._shows:
            self._bar.stop()
            ON_TERMINAL.release()

    def show(self, completed: float, text: str, every: float = LINE_EVERY, keep: bool = False) -> None:
        """Update the bar, or print a line unless one was printed in the last `every` seconds; `keep`: print anyway."""
        self._bar.update(self._task, completed=completed, description=text)
        now = time.monotonic()
        if keep or (self._quiet and now - self.line_at >= every):
            self.line_at = now
            say(self._console, text)


class ProgressBar(TextBar):
    """Counts finished items, and shows their pace."""

    def __init__(self, what: str, total: int, console: Console | None) -> None:
        super().__init__(console, "", max(total, 1), transient=True)
        self._what = what

    @property
    def completed(self) -> int:
        """Number of finished items."""
        return int(self._bar.tasks[0].completed)

    def advance(self, count: int) -> None:
        """Add `count` finished items."""
        self._bar.advance(self._task, count)
        (task,) = self._bar.tasks
        pace = f" · {task.speed:,.0f}/s" if task.speed else ""  # unknown after a pause
        left = f" · about {task.time_remaining:,.0f} s left" if self._quiet and task.time_remaining else ""
        self.show(task.completed, f"{task.completed:,.0f}/{task.total:,.0f} {self._what}{pace}{left}")


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
