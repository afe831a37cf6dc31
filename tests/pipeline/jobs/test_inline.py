"""The executor in the command's own process: programs compile side by side before the levels come."""

import io
import re
import time
from threading import Barrier, Lock
from typing import Any

from rich.console import Console

from levelproof.pipeline.jobs import inline
from levelproof.pipeline.jobs.inline import _compile_side_by_side
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.stopping import Stop
from tests.pace import patience

CORES, PROGRAMS = 2, 6


class Meeting:
    """Programs that compile only in pairs, at the same time; in the place of `Ahead`."""

    def __init__(self, stop: Stop | None = None) -> None:
        """`stop` is requested once the first pair has met."""
        self._met, self._lock, self._stop = Barrier(CORES), Lock(), stop
        self.number, self.compiling = 0, 0.0

    @property
    def left(self) -> bool:
        return self.number < PROGRAMS

    @property
    def compiled(self) -> tuple[int, int]:
        return self.number, PROGRAMS

    def compile_next(self) -> tuple[int, int] | None:
        with self._lock:
            if not self.left:
                return None
            self.number, self.compiling = self.number + 1, self.compiling + 1.0
        self._met.wait(patience(60))
        time.sleep(inline.POLL)
        if self._stop:
            self._stop.asked.set()
        return self.compiled


def compiled(ahead: Any, stop: Stop) -> tuple[float, str]:
    """Compile a job's programs; return the threads' seconds, and what the board shows."""
    text = io.StringIO()
    board = Board(Tally(64, 0, 0), Console(file=text))
    board.refresh = lambda every=0.0: Board.refresh(board, 0.0)
    return _compile_side_by_side(ahead, CORES, board, stop), text.getvalue()


def test_threads_compile_different_programs_at_once_and_the_board_counts_them() -> None:
    seconds, text = compiled(Meeting(), Stop())
    assert seconds == PROGRAMS
    assert re.search(rf"compiling, \d of {PROGRAMS} programs", text)


def test_stop_ends_compiling_after_the_current_programs() -> None:
    stop = Stop()
    ahead = Meeting(stop)
    compiled(ahead, stop)
    assert CORES <= ahead.number < PROGRAMS


def test_nothing_starts_if_every_program_is_compiled() -> None:
    ahead = Meeting()
    ahead.number = PROGRAMS
    assert compiled(ahead, Stop()) == (0.0, "")
