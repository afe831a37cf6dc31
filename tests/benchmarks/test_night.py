"""The long run, on a small scale."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.night import memory_of, run
from tests.pace import wait_until


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_of_counts_a_process_and_its_descendants() -> None:
    child = "x = bytes([1]) * 50_000_000; input()"
    script = f"import subprocess, sys; subprocess.run([sys.executable, '-c', '{child}'])"
    process = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE)
    try:
        wait_until(lambda: memory_of(process.pid)["ray"] >= 40_000_000, 30, "its child takes too little memory")
        measured = memory_of(process.pid)
        assert 1_000_000 < measured["driver"] < 40_000_000 < measured["ray"]
        assert (measured["workers"], measured["worker_count"]) == (0, 0)
    finally:
        process.communicate(b"\n")
    assert memory_of(process.pid)["driver"] == 0
    assert memory_of(os.getpid())["driver"] > 0


@pytest.mark.campaign
def test_night_generates_seals_and_verifies(tmp_path: Path) -> None:
    arguments = ["night", "--levels", "256", "--budget", "4k", "--every", "0.5", "--out", str(tmp_path / "data")]
    report = run(parser("night").parse_args(arguments))
    (measured,) = report.results
    assert (
        measured["files"] == sum(path.is_file() for path in (tmp_path / "data").rglob("[!.]*")) - 1
    )  # without the event log
    assert {sample["step"] for sample in measured["samples"]} == {"generate", "seal", "verify"}
    assert min(measured["memory"].values()) > 0
    for name, draw in report.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
