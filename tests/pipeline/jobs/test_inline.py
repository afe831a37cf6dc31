"""The executor in the command's own process: threads compile its programs side by side, then make its levels."""

import io
import re
import time
from collections.abc import Callable
from pathlib import Path
from threading import Barrier, Lock
from typing import Any

import pytest
from rich.console import Console

from levelproof.experts.steps import EnvSteps
from levelproof.pipeline.errors import Exit, StoreFailure, UserError
from levelproof.pipeline.jobs import inline, worker
from levelproof.pipeline.jobs.inline import Handle, _compile_side_by_side, _work
from levelproof.pipeline.jobs.progress import STOPPING, Board, Tally
from levelproof.pipeline.jobs.schedule import Order, Round, Summary, UnitOutcome, WorkUnit, schedule
from levelproof.pipeline.stopping import Stop
from tests.pace import patience
from tests.pipeline.command import TINY, here

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
    board.refresh = lambda every=0.0, working=True: Board.refresh(board, 0.0, working)
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


class Companion:
    """A worker that needs another one at work at the same time; in the place of `Worker`."""

    def __init__(self, met: Barrier, during: Callable[[], None] = lambda: None) -> None:
        """`during` is called in each round."""
        self._met, self._during = met, during
        self._units: list[WorkUnit] = []

    def work(self, order: Order, seconds: float, ended: Callable[[], bool]) -> Round:
        self._units += order.units
        self._met.wait(patience(60))
        self._during()
        return Round([], {}, wants=0) if ended() else self._round()

    def leave(self) -> Round:
        return self._round(leaves=True)

    def _round(self, leaves: bool = False) -> Round:
        summary = lambda unit: Summary(len(unit.level_ids), 0, EnvSteps())
        outcomes, self._units = [UnitOutcome(unit, summary(unit)) for unit in self._units], []
        return Round(outcomes, {}, wants=1, leaves=leaves)


def made(during: Callable[[], None], stop: Stop) -> tuple[list[int], str]:
    """Make eight levels with two workers; return the ids of those that were committed, and what the board shows."""
    met, text, committed = Barrier(CORES), io.StringIO(), []
    board = Board(Tally(8, 0, 0), Console(file=text))
    workers: Any = {Handle(number): Companion(met, during) for number in range(CORES)}
    settle = lambda outcomes: committed.extend(i for outcome in outcomes for i in outcome.unit.level_ids)
    _work(workers, schedule(range(8), [], 8, 4, False), settle, board, stop)
    return sorted(committed), text.getvalue()


def test_workers_make_levels_at_once() -> None:
    assert made(lambda: None, Stop())[0] == [*range(8)]


def test_workers_commit_what_they_can_before_a_stop() -> None:
    stop = Stop()
    committed, text = made(stop.asked.set, stop)
    assert committed == [0, 1, 2, 3, 4, 5], "a unit each, and half of what is left"
    assert STOPPING in text


@pytest.mark.parametrize(("error", "code"), [(UserError("Why."), Exit.INPUT), (StoreFailure("Why."), Exit.FAILED)])
def test_fatal_error_of_a_worker_decides_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: Exit
) -> None:
    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(worker, "begin_unit", fail)
    done = here(["generate", *TINY, "executor=inline"], tmp_path)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (code, "Error: Why.")


def test_failure_in_a_worker_ends_the_job() -> None:
    def fail() -> None:
        raise OSError("a defect")

    with pytest.raises(OSError, match="a defect"):
        made(fail, Stop())
