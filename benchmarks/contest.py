"""Contestants of a race: groups of processes that compile one group at a time and then run in turns."""

import json
import statistics
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import IO

from benchmarks.oracle import log
from benchmarks.reference.serve import MARK
from levelproof.pipeline.errors import Failure


@dataclass(frozen=True)
class Entry:
    """A contestant, as the commands to start; all its processes run concurrently."""

    name: str
    commands: Sequence[Sequence[str]]
    environment: Mapping[str, str]
    steps: int  # env steps of all processes in one run


@dataclass
class Score:
    """Measurements of a contestant."""

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
    """Start every contestant, then let them run in turns, `repeats` times each.

    Raises:
        Failure: a process ends early.
    """
    with ExitStack() as stack:

        def make(entry: Entry, command: Sequence[str]) -> Process:
            return Process(command, entry.environment, stack, stack.enter_context(tempfile.TemporaryFile("w+")))

        teams = [[make(entry, command) for command in entry.commands] for entry in entries]
        scores = []
        for entry, team in zip(entries, teams, strict=True):  # one at a time, so that nothing disturbs compiling
            log(f"{entry.name}: compiling ...")
            for process in team:
                process.start()
            ready = [process.answer() for process in team]
            scores.append(Score(entry, max(facts["compile_seconds"] for facts in ready)))
        for _ in range(repeats):
            for score, team in zip(scores, teams, strict=True):
                _run_once(score, team)
                log(f"{score.entry.name}: {score.rates[-1]:,.0f} env steps/s")
    return scores


@dataclass
class Process:
    """A process that speaks the protocol of reference/serve.py; killed when `stack` closes."""

    command: Sequence[str]
    environment: Mapping[str, str]
    stack: ExitStack
    errors: IO[str]

    def start(self) -> None:
        pipe = subprocess.PIPE
        self.running = subprocess.Popen(
            self.command, stdin=pipe, stdout=pipe, stderr=self.errors, env=dict(self.environment), text=True
        )
        self.stack.callback(_end, self.running)

    def send(self, request: str = "") -> None:
        assert self.running.stdin is not None
        with suppress(BrokenPipeError):  # the process died: `answer` raises
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
            f"A process of the benchmark ended early ({reason}): run it alone to see more: {' '.join(self.command)}"
        )


def _run_once(score: Score, team: Sequence[Process]) -> None:
    for process in team:
        process.send()
    answers = [process.answer() for process in team]
    score.rates.append(score.entry.steps / max(facts["seconds"] for facts in answers))
    score.goals += sum(facts["goal"] for facts in answers)
    score.episodes += sum(facts["done"] for facts in answers)
    score.finite &= all(facts["finite"] for facts in answers)


def _end(process: subprocess.Popen) -> None:
    process.kill()
    with suppress(BrokenPipeError):
        process.communicate()
