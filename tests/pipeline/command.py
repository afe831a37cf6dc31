"""The command `levelproof` as people run it, in a process of its own."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
TINY = ("levels=4", "unit=1", "budget=5k")  # four real units with two updates each


def start(arguments: Sequence[str], cwd: Path, address: str = "", **options: Any) -> subprocess.Popen[str]:
    """Start it in a process group of its own, so that Ctrl-C can be sent as a terminal sends it: to the whole group.

    With an `address`, on the Ray cluster that is there.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    environment.pop("RAY_ADDRESS", None)
    environment |= {"RAY_ADDRESS": address} if address else {}
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline.cli", *arguments],
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
    out, err = process.communicate(timeout=300)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def assert_refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """It ended with this exit code and one sentence that has these words, without a traceback."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("Error: ")]
    for word in words:
        assert word in sentence
    assert sentence.endswith((".", ")"))
