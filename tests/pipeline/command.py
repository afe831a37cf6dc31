"""Running the command `levelproof`: in its own process as users do, or in this one, which has compiled already."""

import contextlib
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Thread
from typing import IO, Any, TypeVar
from unittest.mock import patch

from levelproof.pipeline.cli.main import main
from tests.pace import patience, wait_until

ROOT = Path(__file__).parents[2]
COMMAND_SECONDS = 600  # limit of a whole command
TINY = ("levels=4", "unit=1", "budget=5k")  # four real units with two updates each

T = TypeVar("T")


def start(
    arguments: Sequence[str], cwd: Path, address: str = "", module: str = "levelproof", **options: Any
) -> subprocess.Popen[str]:
    """Start the command in its own process group, so that Ctrl-C can be sent to the whole group, as a terminal does.

    Args:
        arguments: command-line arguments.
        cwd: working folder.
        address: RAY_ADDRESS; empty: unset.
        module: program to run instead of the command.
        options: further arguments of `Popen`.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    environment.pop("RAY_ADDRESS", None)
    environment |= {"RAY_ADDRESS": address} if address else {}
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        cwd=cwd,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        **options,
    )


def run(arguments: Sequence[str], cwd: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    process = start(arguments, cwd, **options)
    out, err = process.communicate(timeout=patience(COMMAND_SECONDS))
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def here(arguments: Sequence[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command in this process, for tests of what it does and prints, not of how it starts and ends."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd),
        patch.dict(os.environ, COLUMNS="200"),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        code = main(arguments)
    return subprocess.CompletedProcess(["levelproof", *arguments], code, out.getvalue(), err.getvalue())


def heed_ctrl_c() -> None:
    """Handle SIGINT as a command in a terminal's foreground; a shell's background jobs and their children ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def until(condition: Callable[[], T], process: subprocess.Popen[str]) -> T:
    """Wait until the condition holds, and return its value; if it never does, fail with the process's output."""

    def value() -> T:
        result = condition()
        assert result or process.poll() is None, f"the command ended early: {process.communicate()}"
        return result

    try:
        return wait_until(value, COMMAND_SECONDS, process.args)
    except AssertionError as error:
        process.kill()
        raise AssertionError(f"{error}; it wrote {process.communicate()}") from None


def line_of(process: subprocess.Popen[str], stream: IO[str] | None) -> str:
    """Return the next line that a process writes to `stream`; if it writes none, fail with its other output."""
    assert stream is not None
    lines = list[str]()
    reader = Thread(target=lambda: lines.append(stream.readline()), daemon=True)
    reader.start()
    reader.join(patience(COMMAND_SECONDS))
    if not any(lines):
        process.kill()
        raise AssertionError(f"{process.args} wrote no line, but {process.communicate(timeout=patience(60))}")
    return lines[0]


def wait_for_child(child: int) -> int:
    """Return the exit code of a forked process; -N: signal N ended it. Raise AssertionError if it hangs."""
    end = time.monotonic() + patience(COMMAND_SECONDS)
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            raise AssertionError("the forked process hangs")
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(ended[1])


def assert_refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """Check that a command ended with this exit code and one sentence that contains `words`, without a traceback."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("Error: ")]
    for word in words:
        assert word in sentence
    assert sentence.endswith((".", ")"))


def descendants(process: int) -> set[int]:
    """Return all processes below this one; Ray's have sessions of their own, but are its children."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and (state := status(int(entry.name))):
            parents[int(entry.name)] = int(state[1])
    processes, below = set(), {process}
    while below:
        below = {pid for pid, parent in parents.items() if parent in below}
        processes |= below
    return processes


def status(pid: int) -> list[str] | None:
    """Return state, parent, ... of a process; None if it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None


def title(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").decode(errors="replace")
    except OSError:
        return ""


def listening(pids: set[int]) -> dict[str, str]:
    """Return the addresses at which these processes listen, as in Linux's /proc/net, with each process's title."""
    sockets = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            for entry in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    sockets[os.readlink(entry)] = title(pid)
    rows = [row.split() for kind in ("tcp", "tcp6") for row in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]]
    return {row[1]: sockets[f"socket:[{row[9]}]"] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets}
