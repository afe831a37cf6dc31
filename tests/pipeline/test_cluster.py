"""A level that kills whatever worker has it, on real Ray workers: the others are done all the same."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.manifest import read_manifest
from pipeline.schedule import COMPANY
from tests.pipeline.command import ROOT

LEVELS, DEADLY = 8, 2


@pytest.mark.slow
def test_a_level_that_kills_its_worker_takes_no_other_with_it(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.pipeline.fragile", str(DEADLY)]
    settings = ["generate", f"levels={LEVELS}", "unit=1", "budget=5k"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("RAY_ADDRESS", None)
    done = subprocess.run([*command, *settings], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "raylet" not in done.stdout + done.stderr
    split = tmp_path / "data/5k/s"
    assert read_manifest(split).level_ids.tolist() == [i for i in range(LEVELS) if i != DEADLY]
    (note,) = (split / "quarantine").iterdir()
    assert "The worker died" in note.read_text()
    assert f"Given up: level {DEADLY}, for the reason in data/5k/s/quarantine/{note.name}" in done.stdout
    deaths = [line for line in done.stderr.splitlines() if "The worker died" in line]
    assert len(deaths) == len(COMPANY), done.stderr  # a line each, however many levels it took
    assert deaths[-1].startswith(f"Level {DEADLY} failed")
    assert deaths[-1].endswith(": given up.")
