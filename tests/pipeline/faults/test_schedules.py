"""Fault schedules: after any fault, the same command ends in the same bytes as an undisturbed run.

They run in another process, which has not started JAX, because it forks.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.pace import patience
from tests.pipeline.command import ROOT
from tests.pipeline.faults.effects import lose_power

EACH = 65
FIRST, SOME = 10_000, 4  # these run by default


def run(first: int, count: int) -> None:
    words = [sys.executable, "-W", "ignore", "-m", "tests.pipeline.faults", str(first), str(count)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=patience(1800))
    failed = [part.partition("\n\n")[0] for part in done.stdout.split("FAILED ")[1:]]
    assert (done.returncode, failed) == (0, []), done.stderr[-2000:]
    assert f"{count} schedules, 0 failed" in done.stdout


@pytest.mark.slow
def test_some_fault_schedules_change_nothing() -> None:
    run(FIRST, SOME)


def test_lose_power_ignores_a_half_written_log_line(tmp_path: Path) -> None:
    log, kept, gone = tmp_path / "log", tmp_path / "kept", tmp_path / "gone"
    line = lambda path: f"\nwrite\t{path}\t{path}\t\tFalse\twhole"
    outcomes = set()
    for end in range(len(line(kept)) + 1):
        kept.write_text("kept")
        gone.write_text("gone")
        log.write_text(line(kept)[:end] + line(gone))
        for seed in range(8):
            lose_power(log, seed)
        assert not gone.exists()
        outcomes |= {(end, kept.exists())}
    assert outcomes == {(end, end < len(line(kept))) for end in range(len(line(kept)) + 1)}


@pytest.mark.campaign
@pytest.mark.parametrize("first", range(0, 8 * EACH, EACH))
def test_five_hundred_fault_schedules_change_nothing(first: int) -> None:
    run(first, EACH)


@pytest.mark.campaign
def test_further_fault_schedules_change_nothing() -> None:
    run(FIRST + SOME, 12)
