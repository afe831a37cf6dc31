"""What people see while the campaign runs, on stderr."""

from rich.console import Console
from rich.progress import MofNCompleteColumn

from pipeline.jobs.progress import Display


class Board(Display):
    """Counts blocks of worlds."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, MofNCompleteColumn())
        self._done = self._blocks = 0

    def more(self, blocks: int) -> None:
        """There are so many more blocks to do."""
        self._blocks += blocks
        self._show("starting")

    def tick(self, what: str, more: int = 0) -> None:
        """A block is done; of `more` nobody knew."""
        self._done, self._blocks = self._done + 1, self._blocks + more
        self._show(what)

    def _show(self, what: str) -> None:
        self.draw(self._done, self._blocks, what, f"{self._done}/{self._blocks} blocks · {what}")
