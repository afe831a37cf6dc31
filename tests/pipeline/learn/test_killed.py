"""Runs of `clone`, `train` and `distill`, killed for real, continue to the same bytes, compiled as users compile."""

import json
import signal
from pathlib import Path

import pytest

from tests.pipeline.command import run, start, until

pytestmark = pytest.mark.slow

TINY = ("network.width=16", "network.depth=1")
RUNS = {
    "clone": (
        "SPLIT", "where=", "interval=20", "train.updates=200", "train.batch=128", "played=0", "validation=0.3",
        "pool=8", "refresh=7",
    ),
    "train": (
        "levels=SPLIT", "where=label = 'solved'", "interval=1", "cores=2", "ppo.environments=64", "ppo.minibatches=4",
        "ppo.horizon=32", f"ppo.env_steps={10 * 64 * 32}", "ppo.repeat=1",
    ),
    "distill": (
        "SPLIT", "interval=2", "train.updates=20", "train.batch=32", "episodes=8", "states=16", "buffer=256",
        "teachers.witness=2", "teachers.random=8", "teachers.learner=1",
    ),
}  # fmt: skip
LINES = 10  # of metrics, one beside each checkpoint
TIMES = ("seconds", "per_second")  # ends of the names of metrics that no run repeats


@pytest.mark.parametrize(("command", "number"), [*((name, signal.SIGKILL) for name in RUNS), ("clone", signal.SIGTERM)])
def test_run_that_was_killed_or_stopped_continues_bit_for_bit(
    command: str, number: signal.Signals, split: Path, tmp_path: Path
) -> None:
    words = [command, "-o", "policy", *(word.replace("SPLIT", str(split)) for word in RUNS[command])]
    words += TINY
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for folder in (whole, broken):
        folder.mkdir()
    done = run(words, whole)
    assert done.returncode == 0, done.stderr
    process = start(words, broken)
    until(lambda: len(lines(broken)) >= 2, process)  # there is a checkpoint, and the run goes on
    process.send_signal(number)
    process.communicate()
    assert process.returncode == (130 if number == signal.SIGTERM else -number), "it had ended before"
    saved = len(lines(broken))
    assert saved < LINES
    done = run(words, broken)
    assert done.returncode == 0, done.stderr
    for name in ("policy.safetensors", "checkpoint.safetensors", "config.json"):
        assert (broken / "policy" / name).read_bytes() == (whole / "policy" / name).read_bytes(), name
    between = number == signal.SIGTERM and json.loads(lines(broken)[saved - 1])["bc/updates"] % 20
    assert len(lines(broken)) == LINES + bool(between)
    assert repeatable(lines(broken)[-1]) == repeatable(lines(whole)[-1])


def lines(folder: Path) -> list[str]:
    """Return the complete lines of a run's metrics."""
    path = folder / "policy" / "metrics.jsonl"
    return path.read_text().splitlines(keepends=True) if path.exists() else []


def repeatable(line: str) -> dict[str, float]:
    return {name: number for name, number in json.loads(line).items() if not name.endswith(TIMES)}
