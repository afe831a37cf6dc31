"""Events that a job records while it runs, so that other processes can watch its split."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Scheduler, UnitOutcome
from levelproof.pipeline.store.event_files import Event, new_run, write_events

EVERY = 5.0  # s between two published states
MAX_EVENTS = 500  # latest events that are kept, besides the start of the run


class Events:
    """The events of one run: its start, the latest attempts, and its current state."""

    def __init__(
        self, tally: Tally, scheduler: Scheduler, command: str, publish: Callable[[Sequence[Event]], None]
    ) -> None:
        """Each call of `publish` receives all events to keep, and replaces those of the last call."""
        self._tally, self._scheduler, self._publish = tally, scheduler, publish
        self._began = _event("started", command=command, levels=tally.levels, done=tally.done, solved=tally.solved)
        self._latest: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._failures, self._published_at = 0, -math.inf

    def ended(self, outcome: UnitOutcome, given_up: bool = False) -> None:
        """Record an attempt at a unit that has ended."""
        if summary := outcome.summary:
            facts = {"levels": summary.levels, "solved": summary.solved, "seconds": summary.seconds._asdict()}
            self._latest.append(_event("committed", unit=outcome.unit.name, **facts))
            return
        self._failures += 1
        self._latest.append(
            _event("quarantined" if given_up else "failed", unit=outcome.unit.name, cause=outcome.cause[:200])
        )

    def refresh(self, rate: float, left: float | None) -> None:
        """Publish the current state if that is due: at `rate` env steps/s, with `left` s to go."""
        if time.monotonic() - self._published_at >= EVERY:
            self._published_at = time.monotonic()
            self._publish([self._began, *self._latest, self._state("progress", rate, left)])

    def over(self, how: str) -> None:
        """Publish how the run ended: "done", "stopped" or "failed"."""
        self._publish([self._began, *self._latest, self._state("ended", 0.0, None) | {"how": how}])

    def _state(self, event: str, rate: float, left: float | None) -> dict[str, Any]:
        tally, now = self._tally, time.monotonic()
        silent: dict[str, list[float]] = defaultdict(list)  # s since the last report, of each worker by host
        for worker, assignment in self._scheduler.workers.items() if not tally.unsealed else ():  # none runs any more
            silent[getattr(worker, "host", str(worker))].append(round(max(0.0, now - assignment.heard), 1))
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
            unsealed=tally.unsealed,
            workers={host: {"count": len(seconds), "silent": max(seconds)} for host, seconds in silent.items()},
        )


def _event(event: str, **facts: Any) -> dict[str, Any]:
    return {"time": round(time.time(), 1), "event": event, **facts}


@contextmanager
def recording(
    split: Path, board: Board, scheduler: Scheduler, command: str, log: Callable[[Sequence[Event]], None]
) -> Iterator[Events]:
    """Record the events of the `with` block and how it ended, beside the split's data and in `log`.

    Raises:
        OSError: a write failed.
    """
    run = new_run(split)

    def publish(events: Sequence[Event]) -> None:
        write_events(run, events)
        log(events)

    events = Events(board.tally, scheduler, command, publish)
    events.refresh(0.0, None)
    board.watchers.append(events.refresh)
    how = "failed"
    try:
        yield events
        how = "done"
    except KeyboardInterrupt:
        how = "stopped"
        raise
    finally:
        events.over(how)
