"""The split that `python -m benchmarks manifest` makes is one, and the commands that it times work on it."""

from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks import manifest as benchmark
from experts.config import RECORD_STEPS
from pipeline.look.inspect import survey
from pipeline.store.leftovers import clean
from pipeline.store.manifest import read_manifest


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
def test_it_times_every_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["manifest", "--levels", "3000", "--split", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert all(f"| levelproof {word} |" in told for word in ("status", "inspect", "generate, until the first unit"))
