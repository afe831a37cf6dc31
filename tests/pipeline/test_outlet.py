"""Commands whose reader leaves: they finish their work, and their exit code reports the result. Real pipes."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.look.watch import STATE
from levelproof.pipeline.outlet import Outlet
from levelproof.pipeline.store.event_files import new_run, write_events
from levelproof.pipeline.store.locks import only_writer
from tests.pace import patience
from tests.pipeline.command import COMMAND_SECONDS, ROOT
from tests.pipeline.made import made_split


@pytest.fixture
def unread() -> Iterator[int]:
    """Yield the write end of a pipe whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """Return a split of random bits, in which `verify` finds much to report."""
    return made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED]])


def levelproof(*arguments: str | bytes, **streams: Any) -> subprocess.CompletedProcess[str]:
    """Run the command unbuffered: each print is a write, as for a report larger than the buffer."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "levelproof", *arguments]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    return subprocess.run(
        command, env=environment, text=True, timeout=patience(COMMAND_SECONDS), check=False, **streams
    )


@pytest.mark.slow
def test_verify_keeps_its_exit_code_when_its_reader_leaves(split: Path, unread: int) -> None:
    done = levelproof("verify", str(split), stdout=unread)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr


def test_error_keeps_its_exit_code_when_its_reader_leaves(tmp_path: Path, unread: int) -> None:
    assert levelproof("status", str(tmp_path / "nowhere"), stderr=unread).returncode == 2


def test_closed_stdout_is_not_an_error(split: Path) -> None:
    command = f"{sys.executable} -m levelproof status {split} >&-"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", command], env=environment, capture_output=True, text=True, check=False, timeout=patience(1800)
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("output", ["--json", "--csv"])
def test_results_for_a_closed_stdout_are_not_an_error(split: Path, output: str) -> None:
    command = f"{sys.executable} -m levelproof inspect {split} {output} >&- 2>&-"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", command], env=environment, check=False, timeout=patience(1800))
    assert done.returncode == 0


def test_paths_that_are_not_utf_8_are_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8:strict")  # as in most locales, but not in C
    out = tmp_path / "caf\udce9.png"  # a byte that is not UTF-8
    done = levelproof("sample", "size=s", "levels=1", "-o", os.fsencode(out))
    assert (done.returncode, done.stderr) == (0, "")
    assert "caf\\udce9.png: level" in done.stdout
    assert out.exists()


def test_full_disk_below_stdout_is_an_error(split: Path) -> None:
    with open("/dev/full", "w") as full:
        done = levelproof("status", str(split), stdout=full)
    assert done.returncode == 1
    assert done.stderr.startswith("Error: OSError")


@pytest.mark.slow
def test_full_disk_below_stderr_ends_no_command(split: Path, tmp_path: Path) -> None:
    """Messages are lost, but neither results nor the exit code."""
    with open("/dev/full", "w") as full:
        assert levelproof("status", str(tmp_path / "nowhere"), stderr=full).returncode == 2
        done = levelproof("seal", str(split), stderr=full)
    assert done.returncode == 0
    assert "it has 2 levels in 1 fragment now" in done.stdout


def test_outlet_of_stderr_drops_output_after_any_error() -> None:
    with open("/dev/full", "w") as full:
        outlet = Outlet(full, OSError)
        for _ in range(3):
            assert outlet.write("x\n") == 2
            outlet.flush()
    assert not outlet.has_reader


@pytest.mark.slow
def test_watch_ends_when_its_reader_leaves(split: Path, unread: int) -> None:
    """It ends although the run that it watches continues."""
    workers = {"a machine": {"count": 2, "silent": 1.5}}
    numbers = dict.fromkeys(STATE - {"workers"}, 1)
    write_events(new_run(split), [{"time": time.time(), "event": "progress", "workers": workers, **numbers}])
    with only_writer(split, print):
        done = levelproof("status", str(split), "--watch", "--json", stdout=unread)
    assert (done.returncode, done.stderr) == (0, "")
