"""SIGTERM and Ctrl-C end a command in time, whatever it is doing. Real signals."""

import os
import re
import signal
from pathlib import Path

import pytest

from levelproof.pipeline.stopping import GRACE, HASTE, stoppable
from tests.pace import patience
from tests.pipeline.command import COMMAND_SECONDS, descendants, line_of, start, title, until
from tests.pipeline.slow_seal import HUNG

BOTH = (signal.SIGTERM, signal.SIGINT)


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.slow
@pytest.mark.parametrize("beside", ["1", "0"])
def test_sigterm_ends_a_job_whose_seal_hangs(tmp_path: Path, beside: str) -> None:
    process = start([str(tmp_path), "1", beside], tmp_path, module="tests.pipeline.slow_seal")
    assert line_of(process, process.stdout) == f"{HUNG}\n"
    process.terminate()
    try:
        _, err = process.communicate(timeout=patience(COMMAND_SECONDS / 10))
    finally:
        process.kill()
    assert process.returncode == 130, err


@pytest.mark.parametrize("number", BOTH)
def test_signal_raises_keyboard_interrupt_outside_a_heeded_block(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in BOTH]
    with pytest.raises(KeyboardInterrupt), stoppable() as stop:
        send(number)
    assert stop.asked.is_set()
    assert [signal.getsignal(each) for each in BOTH] == before
    stop.clock.join(patience(COMMAND_SECONDS))
    assert not stop.clock.is_alive(), "the timer would end this process"


@pytest.mark.parametrize("number", BOTH)
def test_first_signal_only_sets_asked_in_a_heeded_block(number: signal.Signals) -> None:
    heeded = False
    with pytest.raises(KeyboardInterrupt), stoppable() as stop:  # noqa: PT012
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # Ray, too, sets its own handler
        with stop.heeded():
            send(number)
            assert stop.asked.is_set()
            assert 0 < stop.grace <= GRACE
            heeded = True
        pytest.fail("the block's end did not raise KeyboardInterrupt")
    assert heeded


def test_second_signal_interrupts_a_heeded_block() -> None:
    with pytest.raises(KeyboardInterrupt), stoppable() as stop, stop.heeded():  # noqa: PT012
        send(signal.SIGTERM)
        send(signal.SIGINT)
        pytest.fail("the second signal was ignored")
    assert stop.clock.interval == HASTE, "threads that nothing interrupts would hold the process for longer"
    stop.clock.join(patience(COMMAND_SECONDS))
    assert not stop.clock.is_alive(), "the timer would end this process"


@pytest.mark.campaign
def test_driver_cancels_rounds_to_stop(tmp_path: Path) -> None:
    """Otherwise a worker would learn of the stop only at the end of its round."""
    alone = ("search.env_steps=0", "stop.rule=budget")  # so that experts train long
    command = ["generate", "levels=8", "unit=1", "budget=100M", "workers=1", "executor=ray", *alone]
    process = start(command, tmp_path, module="tests.pipeline.long_rounds")
    busy = "ray::WorkerActor.work"
    until(lambda: any(title(pid).startswith(busy) for pid in descendants(process.pid)), process)
    process.terminate()
    try:
        _, err = process.communicate(timeout=patience(COMMAND_SECONDS / 4))
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert re.search(r"Stopped: [0-8] of 8 levels committed", err), err
