"""What a job tells of itself while it runs, for whoever watches its split from elsewhere."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Scheduler, UnitOutcome
from levelproof.pipeline.store.events import Event, new_run, tell

EVERY = 5.0  # s between two states that are told
MOST = 500  # events that are kept, the latest; and before them how the run began


class Events:
    """The account of one run: how it began, what happened lately, how it is now."""

    def __init__(
        self, tally: Tally, scheduler: Scheduler, command: str, tell: Callable[[Sequence[Event]], None]
    ) -> None:
        """`tell` makes all events known, in place of those before."""
        self._tally, self._scheduler, self._tell = tally, scheduler, tell
        self._began = _event("started", command=command, levels=tally.levels, done=tally.done, solved=tally.solved)
        self._latest: deque[Event] = deque(maxlen=MOST)
        self._failures, self._told_at = 0, -math.inf

    def ended(self, outcome: UnitOutcome, given_up: bool = False) -> None:
        """An attempt at a unit has ended."""
        of = outcome.summary
        if of:
            about: dict[str, Any] = {"levels": of.levels, "solved": of.solved, "seconds": of.seconds._asdict()}
            self._latest.append(_event("committed", unit=outcome.unit.name, **about))
            return
        self._failures += 1
        self._latest.append(
            _event("quarantined" if given_up else "failed", unit=outcome.unit.name, cause=outcome.cause[:200])
        )

    def look(self, rate: float, left: float | None) -> None:
        """Tell how it is, if that is due: at `rate` env steps/s, with `left` s to go."""
        if time.monotonic() - self._told_at >= EVERY:
            self._told_at = time.monotonic()
            self._tell([self._began, *self._latest, self._state("progress", rate, left)])

    def over(self, how: str) -> None:
        self._tell([self._began, *self._latest, self._state("ended", 0.0, None) | {"how": how}])

    def _state(self, event: str, rate: float, left: float | None) -> dict[str, Any]:
        tally, now = self._tally, time.monotonic()
        silent: dict[str, list[float]] = defaultdict(list)
        for worker, of in self._scheduler.workers.items():
            silent[getattr(worker, "host", str(worker))].append(round(max(0.0, now - of.heard), 1))
        return _event(
            event,
            levels=tally.levels,
            done=tally.done,
            solved=tally.solved,
            env_steps=tally.steps,
            spent={kind: int(steps) for kind, steps in tally.spent._asdict().items()},
            seconds={stage: round(float(seconds), 3) for stage, seconds in tally.seconds._asdict().items()},
            rate=round(rate),
            left=None if left is None else round(left),
            failures=self._failures,
            quarantined=len(self._scheduler.quarantined),
            workers={host: {"count": len(of), "silent": max(of)} for host, of in silent.items()},
        )


def _event(event: str, **facts: Any) -> dict[str, Any]:
    return {"time": round(time.time(), 1), "event": event, **facts}


@contextmanager
def telling(
    split: Path, board: Board, scheduler: Scheduler, command: str, log: Callable[[Sequence[Event]], None]
) -> Iterator[Events]:
    """Tells what happens meanwhile, beside the split's data and to `log`, and how it ended.

    Raises:
        OSError: the disk refuses.
    """
    run = new_run(split)

    def tell_both(events: Sequence[Event]) -> None:
        tell(run, events)
        log(events)

    events = Events(board.tally, scheduler, command, tell_both)
    events.look(0.0, None)
    board.watchers.append(events.look)
    how = "failed"
    try:
        yield events
        how = "done"
    except KeyboardInterrupt:
        how = "stopped"
        raise
    finally:
        events.over(how)
