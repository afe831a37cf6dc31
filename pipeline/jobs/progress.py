"""What people see while a job runs: a bar on a terminal, plain lines elsewhere. On stderr. Knows nothing of workers."""

import time
from collections import deque
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

from pipeline.jobs.schedule import Summary, WorkUnit

LINE_EVERY = 30.0  # s between plain lines
LINE_AFTER = 2.0  # s between one and the next commit that is told; the last commit always is
RATE_OVER = 20.0  # s over which env steps/s are averaged


@dataclass
class Tally:
    """How far a job is."""

    levels: int  # wanted
    done: int  # committed, those of earlier runs included
    solved: int
    running: dict[WorkUnit, tuple[int, float, int]] = field(default_factory=dict)  # env steps, levels, solved
    env_steps: int = 0  # of this run's committed units, of training
    evaluated: int = 0  # env steps of their evaluations
    idle: int = 0  # env steps in their slots without a level
    history: deque[tuple[float, int]] = field(default_factory=deque)  # time, env steps of this run

    def __post_init__(self) -> None:
        self.at_start = self.share
        self.first = time.monotonic()

    def ended(self, unit: WorkUnit, summary: Summary | None) -> None:
        """A unit was committed, or an attempt at it failed (`None`)."""
        self.running.pop(unit, None)
        if summary:
            self.done += summary.levels
            self.solved += summary.solved
            self.env_steps += summary.env_steps
            self.evaluated += summary.evaluated
            self.idle += summary.idle

    def tick(self, now: float) -> None:
        """Note where the job is at time `now`, s. The clock starts with the first env step: compiling is no pace."""
        steps = self.env_steps + sum(steps for steps, _, _ in self.running.values())
        if not steps:  # nothing yet: the clock has not started
            self.first = now
            self.history.clear()
        self.history.append((now, steps))
        while now - self.history[0][0] > RATE_OVER and len(self.history) > 2:
            self.history.popleft()

    @property
    def share(self) -> float:
        """Of the whole job, 0 to 1; levels under way count by the part of their budget that they have had."""
        return min(1.0, (self.done + sum(levels for _, levels, _ in self.running.values())) / self.levels)

    @property
    def trained(self) -> int:
        """Levels that are decided, committed or not."""
        return self.done + int(sum(levels for _, levels, _ in self.running.values()))

    @property
    def solved_so_far(self) -> int:
        return self.solved + sum(solved for _, _, solved in self.running.values())

    @property
    def rate(self) -> float:
        """Env steps per second, lately."""
        (begin, low), (end, high) = self.history[0], self.history[-1]
        return max(0.0, (high - low) / (end - begin)) if end > begin else 0.0

    def left(self, now: float) -> float | None:
        """Seconds left at this run's pace; None: unknown yet."""
        gained = self.share - self.at_start
        if gained <= 0 or now <= self.first:
            return None
        return (now - self.first) * (1 - self.share) / gained

    def text(self, now: float) -> str:
        left = self.left(now)
        pace = f"{self.rate:,.0f} env steps/s"
        if self.trained == self.levels:
            tail = "done" if self.done == self.levels else "writing"
        elif left is None:
            tail = f"{pace} · {'...' if self.rate else 'compiling'}"
        else:
            tail = f"{pace} · about {duration(left)} left"
        return f"{self.trained}/{self.levels} levels · {self.solved_so_far} solved · {tail}"


def say(console: Console, text: str) -> None:
    """A line that stays, as it is."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


class Display:
    """A bar on a terminal, plain lines now and then elsewhere."""

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._console, self._line_at = console, 0.0
        self._bar = Progress(
            BarColumn(), *columns, TextColumn("{task.description}"), TimeElapsedColumn(), console=console
        )
        self._task = self._bar.add_task("starting", total=1)

    def shown(self) -> AbstractContextManager[object]:
        return self._bar if self._console.is_terminal else nullcontext()

    def draw(self, completed: float, total: float, text: str, line: str, every: float = LINE_EVERY) -> None:
        """Bring the bar up to date, or say `line`, if none was said in the last `every` seconds."""
        now = time.monotonic()
        if self._console.is_terminal:
            self._bar.update(self._task, completed=completed, total=total, description=text)
        elif now - self._line_at >= every:
            self._line_at = now
            self.say(line)

    def say(self, text: str) -> None:
        """A line that stays."""
        say(self._console, text)


class Board(Display):
    """Shows a Tally."""

    def __init__(self, tally: Tally, console: Console) -> None:
        super().__init__(console, TaskProgressColumn())
        self.tally = tally

    def refresh(self, every: float = LINE_EVERY) -> None:
        """Draw anew; cheap enough to call often."""
        now = time.monotonic()
        self.tally.tick(now)
        text = self.tally.text(now)
        self.draw(self.tally.share, 1.0, text, text, every)

    def ended(self, unit: WorkUnit, summary: Summary | None) -> None:
        self.tally.ended(unit, summary)
        if summary:
            self.refresh(0.0 if self.tally.done == self.tally.levels else LINE_AFTER)


def duration(seconds: float) -> str:
    """`45 s`, `3 min`, `2.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
