"""Locks on several kinds of file systems, and messages during waits."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.schedule import Order, UnitOutcome, WorkUnit
from levelproof.pipeline.jobs.worker import Worker
from levelproof.pipeline.store import leases, locks
from levelproof.pipeline.store.layout import COMMIT_LOCK
from levelproof.pipeline.store.leases import LeaseLost
from levelproof.pipeline.store.locks import (
    LockRefused,
    committing,
    is_written,
    only_trainer,
    only_writer,
    without_commits,
)
from levelproof.pipeline.store.quarantine import give_up
from levelproof.pipeline.store.split import writing
from tests.pace import patience
from tests.pipeline.command import ROOT, heed_ctrl_c, line_of, start
from tests.pipeline.made import made_job


def test_committing_is_shared(tmp_path: Path) -> None:
    with committing(tmp_path), committing(tmp_path):
        pass
    with without_commits(tmp_path, print):
        pass


def test_committing_refuses_workers_of_an_earlier_writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that was deleted and created again does not let them commit, either."""
    monkeypatch.setattr(leases, "_served", {})
    worker = Path(os.path.relpath(tmp_path))  # another process may know it by this path
    with only_writer(tmp_path, print):
        leases.serve(worker, leases.served(tmp_path))
    with committing(worker):
        pass
    for _ in range(2):
        with only_writer(tmp_path, print):
            with pytest.raises(LeaseLost, match="Another command has taken over"), committing(worker):
                pytest.fail("it would commit")
            with committing(tmp_path):
                pass
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()


def test_removed_folder_of_a_split_is_lost_and_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "_served", {})
    split = tmp_path / "s"
    split.mkdir()
    with only_writer(split, print):
        shutil.rmtree(split)
        with pytest.raises(LeaseLost, match="or its folder was removed"), committing(split):
            pytest.fail("it would commit")
        with pytest.raises(LeaseLost):
            give_up(split, (3, 4), "Failed 3 times")
    assert not split.exists()


def test_only_trainer_notices_that_its_folder_was_recreated(tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    folder.mkdir()
    with only_trainer(folder) as require_ours:
        require_ours()
        shutil.rmtree(folder)
        with pytest.raises(Failure, match="policy was removed"):
            require_ours()
        folder.mkdir()
        with only_trainer(folder) as theirs:
            theirs()
            with pytest.raises(Failure, match="removed or recreated"):
                require_ours()


# NFS implements `flock` by byte-range locks; so does this process, which holds one until its input ends
HOLDER = """
import fcntl, pathlib, sys
fcntl.flock = fcntl.lockf
from levelproof.pipeline.store import locks
with getattr(locks, sys.argv[1])(*[pathlib.Path(sys.argv[2]), print][: 1 + (sys.argv[1] == "only_writer")]):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held_elsewhere(lock: str, split: Path) -> Iterator[subprocess.Popen[str]]:
    program = [sys.executable, "-c", HOLDER, lock, str(split)]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as holder:
        assert line_of(holder, holder.stdout) == "held\n"
        yield holder


@pytest.mark.slow
def test_locks_exclude_on_nfs_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "flock", fcntl.lockf)
    monkeypatch.setattr(locks, "PATIENCE", 0.1)
    monkeypatch.setattr(locks, "NOTICE", 0.1)
    with held_elsewhere("only_writer", tmp_path):
        assert is_written(tmp_path)
        with pytest.raises(UserError, match="Another levelproof command"), only_writer(tmp_path, print):
            pass
    assert not is_written(tmp_path)
    with only_writer(tmp_path, print):
        pass
    messages: list[str] = []
    with held_elsewhere("committing", tmp_path) as worker:

        def then_end_it(text: str) -> None:
            messages.append(text)
            worker.communicate()

        with committing(tmp_path):
            pass
        with without_commits(tmp_path, then_end_it):
            assert worker.returncode == 0
    assert len(messages) == 1


@pytest.mark.parametrize("refused", [fcntl.LOCK_SH, fcntl.LOCK_EX])
def test_writing_refuses_a_file_system_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: int
) -> None:
    flock = fcntl.flock

    def without(file: Any, how: int) -> None:
        if how & refused:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", without)
    with (
        pytest.raises(UserError, match=r"does not support locks \(No locks available\): choose a folder .* out=NAME"),
        writing(made_job(str(tmp_path / "data")), print),
    ):
        pytest.fail("something would have trained")


def test_workers_without_locks_stop_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise LockRefused("no locks here")

    monkeypatch.setattr("levelproof.pipeline.jobs.worker.begin_unit", refuse)
    unit = WorkUnit((0,))
    (ended,) = Worker(made_job(), tmp_path).work(Order([unit]), 1.0).outcomes
    assert ended == UnitOutcome(unit, reason=ended.reason, fatal="no locks here", kind=UserError)


def test_without_commits_reports_its_wait_and_can_be_stopped(tmp_path: Path) -> None:
    split = tmp_path / "data/5k/s"
    split.mkdir(parents=True)
    with committing(split):
        process = start(["generate", "budget=5k", "executor=inline"], tmp_path, preexec_fn=heed_ctrl_c)
        message = line_of(process, process.stderr)
        assert "Waiting for a worker of an earlier run" in message
        assert f"data/5k/s/{COMMIT_LOCK}" in message
        assert "fuser" in message
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=patience(60))
    assert process.returncode == Exit.INTERRUPTED
    assert err == ""
