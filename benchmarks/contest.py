"""Contestants: groups of processes that get ready one group after another and then run in turns."""

import json
import statistics
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import IO

from benchmarks.oracle import tell
from benchmarks.reference.serve import MARK
from levelproof.pipeline.errors import Failure


@dataclass(frozen=True)
class Entry:
    """A contestant: what to start. All its processes run at the same time."""

    name: str
    commands: Sequence[Sequence[str]]
    environment: Mapping[str, str]
    steps: int  # env steps of all processes in one run


@dataclass
class Score:
    """What a contestant did."""

    entry: Entry
    compile_seconds: float = 0.0
    rates: list[float] = field(default_factory=list)  # env steps/s of each run
    goals: float = 0.0  # reached in all runs
    episodes: float = 0.0  # ended in all runs
    finite: bool = True

    @property
    def rate(self) -> float:
        """Median over the runs."""
        return statistics.median(self.rates)


def compete(entries: Sequence[Entry], repeats: int) -> list[Score]:
    """Start every contestant, then let each run once, `repeats` times in turns.

    Raises:
        Failure: a process ends early.
    """
    with ExitStack() as stack:

        def make(entry: Entry, command: Sequence[str]) -> Process:
            return Process(command, entry.environment, stack, stack.enter_context(tempfile.TemporaryFile("w+")))

        teams = [[make(entry, command) for command in entry.commands] for entry in entries]
        scores = []
        for entry, team in zip(entries, teams, strict=True):  # compiles undisturbed
            tell(f"{entry.name}: compiling ...")
            for process in team:
                process.wake()
            ready = [process.answer() for process in team]
            scores.append(Score(entry, max(facts["compile_seconds"] for facts in ready)))
        for _ in range(repeats):
            for score, team in zip(scores, teams, strict=True):
                _run_once(score, team)
                tell(f"{score.entry.name}: {score.rates[-1]:,.0f} env steps/s")
    return scores


@dataclass
class Process:
    """A process that speaks the protocol of `serve`; it ends with `stack`."""

    command: Sequence[str]
    environment: Mapping[str, str]
    stack: ExitStack
    errors: IO[str]

    def wake(self) -> None:
        pipe = subprocess.PIPE
        self.running = subprocess.Popen(
            self.command, stdin=pipe, stdout=pipe, stderr=self.errors, env=dict(self.environment), text=True
        )
        self.stack.callback(_end, self.running)

    def go(self, request: str = "") -> None:
        assert self.running.stdin is not None
        with suppress(BrokenPipeError):  # it died: `answer` says so
            self.running.stdin.write(f"{request}\n")
            self.running.stdin.flush()

    def answer(self) -> dict:
        assert self.running.stdout is not None
        for line in self.running.stdout:
            if line.startswith(MARK):
                return json.loads(line.removeprefix(MARK))
        self.errors.seek(0)
        reason = (self.errors.read().strip().splitlines() or ["no message"])[-1]
        raise Failure(
            f"A process of the bench ended early ({reason}): run it alone to see more: {' '.join(self.command)}"
        )


def _run_once(score: Score, team: Sequence[Process]) -> None:
    for process in team:
        process.go()
    answers = [process.answer() for process in team]
    score.rates.append(score.entry.steps / max(facts["seconds"] for facts in answers))
    score.goals += sum(facts["goal"] for facts in answers)
    score.episodes += sum(facts["done"] for facts in answers)
    score.finite &= all(facts["finite"] for facts in answers)


def _end(process: subprocess.Popen) -> None:
    process.kill()
    with suppress(BrokenPipeError):
        process.communicate()
