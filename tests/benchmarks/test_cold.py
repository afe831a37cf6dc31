"""The first run's benchmark, on a few levels without training."""

import os
import subprocess
import sys

import pytest

from benchmarks.__main__ import parser
from benchmarks.cold import COLD, FULL, WARM, core_seconds, reported, run
from benchmarks.report import Run, as_page
from tests.pace import wait_until

SMALL = ("levels=4", "unit=4", "procedure=label", "search.env_steps=0", "executor=inline", "workers=1")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_core_seconds_counts_a_process_and_its_descendants() -> None:
    child = "import time; begun = time.process_time()\\nwhile time.process_time() < begun + 0.5: pass\\ninput()"
    process = subprocess.Popen(
        [sys.executable, "-c", f"import subprocess, sys; subprocess.run([sys.executable, '-c', '''{child}'''])"],
        stdin=subprocess.PIPE,
    )
    try:
        # Less than it takes: the system counts its time in ticks
        wait_until(lambda: sum(core_seconds(process.pid).values()) > 0.3, 60, "the child's CPU time")
        assert process.poll() is None
        assert len(core_seconds(process.pid)) == 2
    finally:
        process.communicate(b"\n")
    assert core_seconds(os.getpid())[os.getpid()] > 0


def test_report_has_medians_and_names_missed_targets() -> None:
    jobs = {COLD: [], WARM: [], FULL: ["levels=512"]}
    walls = {COLD: (50.0, 20.0, 25.0), WARM: (9.0, 12.0, 11.0), FULL: (100.0, 100.0, 100.0)}
    measured = lambda wall: {"wall": wall, "core_seconds": 2 * wall, "levels": wall / 2, "compiling": 0.25}
    results = [
        {"run": run, "job": job, "calibration": 1.0 + run, **measured(walls[job][run])}
        for run in range(3)
        for job in jobs
    ]
    page = as_page(report := reported(jobs, results), Run.now("cold", ["cold"], report))
    assert "| cold | defaults | 25.0 | 50.0 | 12.5 | 25% |" in page
    assert "| larger | `levels=512` | 100.0 |" in page
    assert "Medians of 3 runs" in page
    assert "took 2.00 s" in page
    assert "Missed: warm takes 11 s, not 10; the larger job spends 25% on compiling, not 10%." in page


@pytest.mark.campaign
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_cold_job_compiles_and_warm_job_loads() -> None:
    cold, warm = run(parser("cold").parse_args(["cold", "--runs", "1", "--larger", "", "--", *SMALL])).results
    assert [cold["job"], warm["job"]] == [COLD, WARM]
    assert 0 < warm["levels"] < warm["core_seconds"]
    assert warm["levels"] * warm["compiling"] < cold["levels"] * cold["compiling"] / 2
    assert 0 < cold["calibration"] == warm["calibration"]
