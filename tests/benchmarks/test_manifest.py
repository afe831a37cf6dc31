"""The split that `python -m benchmarks manifest` makes is one, and the commands that it times work on it."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import manifest as benchmark
from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.look.inspect import survey
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.manifest import read_manifest


def test_its_split_is_sealed_and_like_a_real_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "ROWS", 900)
    benchmark.made_split(tmp_path, 2000)
    split, said = tmp_path / "128k" / "s", list[str]()
    clean(split, said.append)
    manifest = read_manifest(split)
    assert not said
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
def test_it_times_every_command(tmp_path: Path) -> None:
    """By a process of its own: what a process starts has that one's memory for a moment, and it counts."""
    words = [sys.executable, "-m", "benchmarks", "manifest", "--levels", "3000", "--split", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(
        f"| levelproof {word} |" in done.stdout for word in ("status", "inspect", "generate, until the first unit")
    )
