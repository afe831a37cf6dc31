"""Progress of a job: a bar or plain lines on stderr, and gauges. Knows nothing of workers or Ray."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from levelproof.experts.steps import NO_SECONDS, EnvSteps, Seconds, Totals
from levelproof.pipeline.jobs.schedule import Round, Summary, WorkUnit
from levelproof.pipeline.store.progress_bar import LINE_EVERY, TextBar, say
from levelproof.pipeline.words import duration, many

LINE_AFTER = 2.0  # s between plain lines that report commits; the last commit is always reported
STOPPING = "Stopping once decided levels are committed; press Ctrl-C to quit now."
PACE_OVER = 60.0  # s over which env steps/s and the remaining time are averaged
PACE_EVERY = 1.0  # minimum s between two samples of the pace: the quotient of closer ones is meaningless


@dataclass
class Tally:
    """Counts of a job's progress."""

    levels: int  # wanted
    done: int  # committed, including those of earlier runs
    solved: int
    running: dict[WorkUnit, Totals] = field(default_factory=dict)
    spent: EnvSteps = field(default_factory=EnvSteps)  # env steps spent on this run's committed units
    seconds: Seconds = NO_SECONDS  # workers' time on the same units
    unsealed: int = 0  # groups of fragments that are left to seal after the last commit
    compiled: tuple[int, int] = (0, 0)  # programs that workers have compiled before they begin, and all of them

    def follow(self, round: Round) -> None:
        """Account for a worker's round. The caller passes units that ended to `ended` itself."""
        self.forget(cut.unit for cut in round.cuts)
        self.running.update(round.totals)

    def forget(self, units: Iterable[WorkUnit]) -> None:
        """Discard the progress of units that no longer run."""
        for unit in units:
            self.running.pop(unit, None)

    def ended(self, unit: WorkUnit, summary: Summary | None) -> None:
        """Account for a unit that was committed, or whose attempt failed (`summary` is None)."""
        self.running.pop(unit, None)
        if summary:
            self.done += summary.levels
            self.solved += summary.solved
            self.spent = EnvSteps(*map(sum, zip(self.spent, summary.spent, strict=True)))
            self.seconds = Seconds(*map(sum, zip(self.seconds, summary.seconds, strict=True)))

    @property
    def steps(self) -> int:
        """Env steps of this run, committed or not."""
        return self.spent.shown + sum(unit.env_steps for unit in self.running.values())

    @property
    def share(self) -> float:
        """Finished share of the job, 0 to 1; a running level counts by the share of its budget that it has used."""
        return min(1.0, (self.done + sum(unit.levels for unit in self.running.values())) / self.levels)

    @property
    def decided(self) -> int:
        """Levels that are decided, committed or not; running ones count by their share of the budget, rounded down."""
        return self.done + int(sum(unit.levels for unit in self.running.values()))

    @property
    def solved_so_far(self) -> int:
        return self.solved + sum(unit.solved for unit in self.running.values())

    def text(self, rate: float, left: float | None) -> str:
        """Describe the progress, at `rate` env steps/s and with `left` s to go (None: not known yet)."""
        pace, (compiled, programs) = f"{rate:,.0f} env steps/s", self.compiled
        if self.unsealed:
            tail = f"sealing, {many(self.unsealed, 'group')} of fragments left"
        elif self.decided == self.levels:
            tail = "done" if self.done == self.levels else "writing"
        elif left is None:
            of_them = f", {compiled} of {programs} programs" if compiled < programs else ""
            tail = f"{pace} · {'...' if self.steps else f'compiling{of_them}'}"
        else:
            tail = f"{pace} · about {duration(left)} left"
        return f"{self.decided:,}/{self.levels:,} levels · {self.solved_so_far:,} solved · {tail}"


class Board:
    """Shows a Tally: a bar on a terminal, plain lines now and then elsewhere."""

    def __init__(self, tally: Tally, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self.tally, self._console = tally, console
        self._bar = TextBar(console, "starting", 1)
        self._bar.line_at = 0.0  # the first refresh prints a line
        # For estimates only; they begin with the first env steps of this run, so compiling does not count
        self._pace = Progress(get_time=clock, speed_estimate_period=PACE_OVER, disable=True)
        self._steps = self._pace.add_task("env steps", total=None)
        self._levels = self._pace.add_task("levels", total=tally.levels, completed=tally.done)
        self._paced_at = -PACE_EVERY
        self._unsaved = False  # whether the user knows that experts could not be saved
        self.watchers: list[Callable[[float, float | None], None]] = []  # get env steps/s and s to go, at each refresh

    def shown(self) -> TextBar:
        """Return the bar, for a `with` block."""
        return self._bar

    def refresh(self, every: float = LINE_EVERY, working: bool = True) -> None:
        """Update the bar, or print a line unless one was printed in the last `every` seconds.

        If no worker is `working`, there is no pace, whatever it was before.
        """
        steps, levels = self._pace.tasks
        if self.tally.steps != steps.completed and self._pace.get_time() - self._paced_at >= PACE_EVERY:
            self._paced_at = self._pace.get_time()
            self._pace.update(self._steps, completed=self.tally.steps)
            self._pace.update(self._levels, completed=self.tally.share * self.tally.levels)
        rate, left = (steps.speed or 0.0, levels.time_remaining) if working else (0.0, None)
        for watcher in self.watchers:
            watcher(rate, left)
        self._bar.show(self.tally.share, self.tally.text(rate, left), every)

    def say(self, text: str) -> None:
        """Print a permanent line."""
        say(self._console, text)

    def follow(self, round: Round) -> None:
        """Pass a worker's round to the tally; say once if its experts cannot be saved."""
        self.tally.follow(round)
        if round.unsaved and not self._unsaved:
            self.say(f"Unfinished experts cannot be saved ({round.unsaved}): if this run is stopped, they start again.")
            self._unsaved = True

    def sealing(self, groups: int) -> None:
        """Show the number of groups of fragments that are left to seal after the last commit; 0 ends this."""
        if groups or self.tally.unsealed:
            self.tally.unsealed = groups
            self.refresh(working=False)

    def ended(self, unit: WorkUnit, summary: Summary | None) -> None:
        """Pass an attempt to the tally, and show the new numbers if it committed levels."""
        self.tally.ended(unit, summary)
        if summary:
            self.refresh(0.0 if self.tally.done == self.tally.levels else LINE_AFTER)


class Meters:
    """Prometheus gauges of one split's progress, exported through the cluster's own metrics."""

    def __init__(self, split: Path, gauge: Callable[[str, str, tuple[str, ...]], Any]) -> None:
        """`gauge` creates a gauge from its name, its description and the names of its tags."""
        self._split = {"split": "/".join(split.parts[-2:])}
        meanings = {"levels": "levels committed", "solved": "solved levels", "env_steps": "env steps of this run"}
        self._gauges = {name: gauge(f"levelproof_{name}", what, ("split",)) for name, what in meanings.items()}

    def show(self, tally: Tally) -> None:
        for name, value in {"levels": tally.done, "solved": tally.solved, "env_steps": tally.steps}.items():
            self._gauges[name].set(value, self._split)
