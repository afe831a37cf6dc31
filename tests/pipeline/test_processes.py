"""Other processes of a command: their results, their errors, and their ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.processes import in_another_process, other_processes
from tests.pace import wait_until
from tests.pipeline.command import ROOT

PREPARED: list[int] = []
LONG = 600.0  # s
SLEEP = f"""
import multiprocessing, sys, time
from pathlib import Path
from levelproof.pipeline.processes import other_processes
with other_processes(2) as run:
    run(time.sleep, [{LONG}] * 9)
    Path(sys.argv[1]).write_text(" ".join(str(child.pid) for child in multiprocessing.active_children()) + " .")
    time.sleep({LONG})
"""


def interrupted() -> str:
    os.kill(os.getpid(), signal.SIGINT)  # as a terminal does to all processes of a command
    return "alive"


def prepare(number: int) -> None:
    PREPARED.append(number)


def refused_at(limit: int, number: int) -> tuple[int, list[int]]:
    if number == limit:
        raise UserError(f"{number} is too much: choose less.")
    time.sleep(0.2 * (number == 0))  # so that later ones end first
    return number, PREPARED


def test_another_process_leaves_ctrl_c_to_its_command() -> None:
    assert in_another_process(interrupted) == "alive"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_another_process_that_dies_is_reported() -> None:
    with pytest.raises(Failure, match="A process of this command died"):
        in_another_process(os.abort)


def test_results_come_in_order_from_prepared_processes() -> None:
    with other_processes(2, prepare, 7) as run:
        assert list(run(partial(refused_at, 9), range(3))) == [(number, [7]) for number in range(3)]
    assert not multiprocessing.active_children()


def fail_beside_others() -> None:
    with other_processes(2) as run:
        run(time.sleep, [LONG])
        list(run(partial(refused_at, 3), range(1000)))


def test_error_of_a_process_ends_those_at_work() -> None:
    with pytest.raises(UserError, match="3 is too much: choose less"):
        fail_beside_others()
    assert not multiprocessing.active_children()


def lose_one(number: signal.Signals) -> None:
    with other_processes(2) as run:
        list(run(time.sleep, [0.5] * 4))  # both have begun
        answers = run(time.sleep, [LONG] * 9)
        os.kill(multiprocessing.active_children()[0].pid or 0, number)
        list(answers)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_death_of_one_process_ends_those_at_work_and_is_reported(number: signal.Signals) -> None:
    """As where memory runs out: a pool alone would wait for the others."""
    with pytest.raises(Failure, match="A process of this command died"):
        lose_one(number)
    wait_until(lambda: not multiprocessing.active_children(), 20)


def stopped() -> None:
    with other_processes(2) as run:
        run(time.sleep, [LONG] * 9)
        raise KeyboardInterrupt


def test_stop_ends_processes_at_work() -> None:
    with pytest.raises(KeyboardInterrupt):
        stopped()
    wait_until(lambda: not multiprocessing.active_children(), 20)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    environment, told = os.environ | {"PYTHONPATH": str(ROOT)}, tmp_path / "pids"
    parent = subprocess.Popen([sys.executable, "-c", SLEEP, str(told)], env=environment)
    try:
        *words, _ = wait_until(lambda: told.exists() and told.read_text().split(), 60)
    finally:
        parent.kill()
    assert len(words) == 2
    wait_until(lambda: not any(runs(Path(f"/proc/{word}/cmdline")) for word in words), 20)


def runs(cmdline: Path) -> bool:
    try:
        return cmdline.read_bytes() != b""  # empty: it has ended, and nobody has asked how
    except (FileNotFoundError, ProcessLookupError):
        return False
