"""Schedules of faults: afterwards, the same command ends in the same bytes as if nothing had gone wrong.

They run in a process that has not started JAX, because it forks.
"""

import subprocess
import sys

import pytest

from tests.pipeline.command import ROOT

EACH = 65


def run(first: int, count: int) -> None:
    words = [sys.executable, "-W", "ignore", "-m", "tests.pipeline.faults", str(first), str(count)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    failed = [part.partition("\n\n")[0] for part in done.stdout.split("FAILED ")[1:]]
    assert (done.returncode, failed) == (0, []), done.stderr[-2000:]
    assert f"{count} schedules, 0 failed" in done.stdout


def test_some_schedules_change_nothing() -> None:
    run(10_000, 20)


@pytest.mark.campaign
@pytest.mark.parametrize("first", range(0, 8 * EACH, EACH))
def test_five_hundred_schedules_change_nothing(first: int) -> None:
    run(first, EACH)
