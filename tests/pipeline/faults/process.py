"""The command `levelproof` in a forked process with its own forks, and the faults that hit them.

Nothing here computes with JAX, because a process that has started JAX cannot fork. So `crew` replaces training, and
records that the engine would re-simulate for another density are looked up in the ready-made results.
"""

import errno
import mmap
import os
import resource
import select
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import datetime, timedelta
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levelproof.configs import compose
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.jobs import inline, unit
from levelproof.pipeline.store import density, event_files, leases, requests, seal, shard
from tests.pace import patience
from tests.pipeline.faults import crew
from tests.pipeline.faults.effects import Effects, Tell
from tests.pipeline.faults.schedules import LEVELS

HANGS = 60.0  # s after which a command is taken to hang
HELD = 0.5  # maximum s for which a worker that has outlived its driver waits for the next command
SLOW, FOR = 0.02, 10  # s that each slow write takes, and their number
DAY = 86_400.0  # s
BESIDE_ROWS = 4  # rows of a fragment that is sealed during a job
TORN = "a kill within a write"
MIN_LIMIT = 4096  # bytes; smallest limit on a file's size, so that the command's output fits
SPARE, MORTAL = 2, 10  # number of workers if one dies, and if all do
ERRORS = {"no space": errno.ENOSPC, "input/output error": errno.EIO, "read-only": errno.EROFS}
DRIVER, WORKER, HAPPENED, DRIVER_PID, WORKER_PID = range(5)  # indices in shared memory; the first two count effects
ROLES = {"driver": DRIVER, "worker": WORKER}


class Happening(NamedTuple):
    """A fault in one of a command's processes."""

    fault: str = ""
    whose: str = "driver"
    at: int = 0  # number of an effect, or bytes of a file
    when: Callable[[str, str], bool] | None = None  # instead of `at`: condition on an effect's kind and path


class Command:
    """One run of the command, in its own session."""

    def __init__(
        self,
        words: list[str],
        below: Path,
        output: Path,
        happening: Happening,
        log: Path | None = None,
        beside: bool = False,
    ) -> None:
        """Its standard streams go to `output`; a `log` records its effects on files `below`."""
        self.shared = memoryview(mmap.mmap(-1, 64)).cast("q")
        self.control, theirs = socket.socketpair()
        reads, alive = os.pipe()  # the read end reports end of file when the last forked process ends
        self._alive: int | None = reads
        self._output, self._end = output, time.monotonic() + patience(HANGS)
        self._code: int | None = None
        self.pid = os.fork()
        if self.pid:
            theirs.close()
            os.close(alive)
            return
        code = 70
        try:
            os.setsid()
            self.shared[DRIVER_PID] = os.getpid()
            _redirect(output)
            _prepare(below, happening, log, beside, theirs, self.shared)
            code = main(words)
            sys.stdout.flush()
            sys.stderr.flush()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)

    def over(self) -> bool:
        """Whether the process itself has ended; its worker may still run."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
            if time.monotonic() > self._end:
                self.kill()
                raise AssertionError(f"the command hangs: {self.output()}")
        return self._code is not None

    def wait(self) -> int:
        """Wait for its end; return the exit code, negative for a signal. Raise AssertionError if it hangs."""
        while not self.over():
            time.sleep(0.002)
        assert self._code is not None
        return self._code

    def asks(self) -> bool:
        """Whether one of its processes has reached the awaited effect."""
        try:
            return bool(self.control.recv(1, socket.MSG_DONTWAIT))
        except OSError:
            return False

    def ended(self) -> None:
        """Wait until all its forked processes have ended, too."""
        while self._alive is not None:
            if select.select([self._alive], [], [], patience(HANGS))[0]:
                os.close(self._alive)
                self._alive = None
                self.control.close()
            else:
                self.kill()
                raise AssertionError(f"a worker hangs: {self.output()}")

    def kill(self) -> None:
        os.killpg(self.pid, signal.SIGKILL)

    def end(self) -> None:
        """Kill whatever still runs of it, after a failed check."""
        if self._alive is not None:
            with suppress(ProcessLookupError):
                self.kill()
            self.wait()
            self.ended()

    def output(self) -> str:
        return self._output.read_text()


def _redirect(output: Path) -> None:
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
    os.environ["COLUMNS"] = "400"


def _prepare(
    below: Path, happening: Happening, log: Path | None, beside: bool, control: socket.socket, shared: memoryview
) -> None:
    """Set up this newly forked process as the command's, with its fault and its workers."""
    if beside:
        seal.ROWS = BESIDE_ROWS
    if happening.fault in (TORN, "files that grow too large"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (max(happening.at, MIN_LIMIT), resource.RLIM_INFINITY))
        kills = happening.fault == TORN
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if kills else signal.SIG_IGN)
        shared[HAPPENED] = 1
    mine = lambda role: _tell(happening, control, shared) if happening.whose == role else None
    effects = Effects(below, _counted(shared, DRIVER, mine("driver")), log)

    def begin_worker(tell: Tell | None) -> None:
        shared[WORKER_PID] = os.getpid()
        effects.count, effects.tell = 0, _counted(shared, WORKER, tell)

    for number in range(MORTAL if happening.fault == TORN else SPARE):
        crew.fork_worker(partial(begin_worker, None if number else mine("worker")))


def _counted(shared: memoryview, role: int, tell: Tell | None) -> Tell:
    def count(number: int, kind: str, path: str) -> None:
        shared[role] += 1
        if tell:
            tell(number, kind, path)

    return count


def _tell(happening: Happening, control: socket.socket, shared: memoryview) -> Tell:
    """Return a function that causes the fault in the process that is about to cause the chosen effect."""
    fault, _, at, when = happening
    code = next((code for name, code in ERRORS.items() if name in fault), 0)

    def tell(number: int, kind: str, path: str) -> None:
        now = number == at if when is None else when(kind, path)
        if now:
            shared[HAPPENED] = 1
        if now and fault == "a kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif now and fault in ("a kill of all", "loss of power"):
            os.killpg(0, signal.SIGKILL)
        elif now and fault == "a kill of the driver, the worker goes on":
            os.kill(shared[DRIVER_PID], signal.SIGKILL)
            _ask(control, patience(HELD))
        elif now and fault in ("a second command", "go on"):
            _ask(control, patience(HANGS) if fault == "a second command" else 0.0)
        elif now and fault == "a clock that goes back":
            _set_clock_back()
        elif fault == "slow writes" and at <= number < at + FOR:
            time.sleep(SLOW)
        elif code and kind != "lock" and (now or ("from then on" in fault and number > at)):
            raise OSError(code, os.strerror(code), path)

    return tell


def _ask(control: socket.socket, seconds: float) -> None:
    """Report that the awaited effect is reached, and wait up to `seconds` for an answer."""
    control.send(b"!")
    if seconds:
        control.settimeout(seconds)
        with suppress(TimeoutError):
            control.recv(1)


def _set_clock_back() -> None:
    now = time.time

    class Earlier(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:  # pyright: ignore[reportIncompatibleMethodOverride]
            return datetime.now(tz) - timedelta(seconds=DAY)

    time.time = lambda: now() - DAY
    event_files.datetime = Earlier  # type: ignore[misc]


def set_up() -> None:
    """Prepare this process for forking commands: replace what uses JAX, and import and cache what all forks need."""
    inline.run = crew.run
    unit.device = lambda: "cpu: none"
    compose.compose_job = cache_of(compose.compose_job)
    for name in (
        "levelproof.pipeline.jobs.generate",
        "levelproof.pipeline.jobs.regenerate",
        "levelproof.pipeline.jobs.seal",
    ):
        import_module(name)
    import_module("obstore.store")
    for first in range(0, LEVELS, 2):
        for experts in (False, True):
            crew.result_of((first, first + 1), experts)
    stored = {}
    for first in range(0, LEVELS, 2):
        result = crew.result_of((first, first + 1), True)
        arrays = unit.shard_arrays(result.levels, result.record, [0, 1])
        stored |= {arrays["record/action"][..., i].tobytes(): (arrays, i) for i in (0, 1)}
    shard.restored = _looked_up(stored)
    retries = {
        "retry_timeout": timedelta(seconds=patience(0.5)),
        "backoff": {"init_backoff": timedelta(milliseconds=5)},
    }
    requests.RETRIES |= retries
    leases.POLL, leases.RENEWAL, leases.SILENCE = 0.02, 0.2, patience(3.0)  # a slow writer is not a dead one


def cache_of(function: Callable) -> Callable:
    """Cache a function of one list."""
    known = cache(function)
    return lambda values: known(tuple(values))


def _looked_up(stored: Mapping[bytes, tuple[Mapping[str, np.ndarray], int]]) -> Callable[..., density.Restored]:
    def restored(arrays: Mapping[str, np.ndarray], wanted: Any, _: Any) -> density.Restored:
        action = arrays["record/action"]
        sources = [stored[action[..., i].tobytes()] for i in range(action.shape[-1])]
        fields = {field.name: np.stack([whole[field.name][..., i] for whole, i in sources], -1) for field in wanted}
        return density.Restored(fields, np.full(len(sources), -1))

    return restored
