"""The split that `python -m benchmarks manifest` makes is valid, and the timed commands work on it."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import manifest as benchmark
from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.look.inspect import survey
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.manifest import read_manifest
from tests.pace import patience


def test_made_split_is_sealed_and_resembles_a_real_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "ROWS", 900)
    benchmark.made_split(tmp_path, 2000)
    split, messages = tmp_path / "128k" / "s", list[str]()
    clean(split, messages.append)
    manifest = read_manifest(split)
    assert not messages
    assert [(fragment.rows, fragment.sealed) for fragment in manifest.fragments] == [
        (900, True),
        (900, True),
        (200, True),
    ]
    facts = survey(split)
    assert facts["levels"] == 2000
    assert facts["labels"].keys() == {"solved", "trivial", "unsolvable", "unsolved"}
    assert facts["duplicates"]["near"]["levels"] == 11
    assert facts["bytes_per_transition"] > 0.95 * benchmark.TRAJECTORY / RECORD_STEPS


@pytest.mark.campaign
def test_manifest_benchmark_times_every_command(tmp_path: Path) -> None:
    """Runs in its own process, because a forked child briefly has its parent's memory, which counts."""
    command = [sys.executable, "-m", "benchmarks", "manifest", "--levels", "3000", "--split", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=patience(1800))
    assert done.returncode == 0, done.stderr
    assert all(
        f"| levelproof {name} |" in done.stdout for name in ("status", "inspect", "generate, until the first unit")
    )
