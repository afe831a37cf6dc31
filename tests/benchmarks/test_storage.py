"""What a transition takes in each density: smaller ones take less, whatever the machine."""

import argparse
from pathlib import Path

import pytest

from benchmarks import storage
from tests.pipeline.made import played_split


@pytest.mark.campaign
def test_every_density_of_a_split_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "SECONDS", 0.01)
    monkeypatch.setattr(storage, "BATCH", 2)
    report = storage.run(argparse.Namespace(split=[played_split(tmp_path)]))
    assert [of["density"] for of in report.results] == ["full", "resume", "witness"]
    sizes = [of["bytes_per_transition"] for of in report.results]
    assert sizes == sorted(sizes, reverse=True)
    assert [of["of_full"] for of in report.results] == [size / sizes[0] for size in sizes]
    assert all(rate > 0 for of in report.results for rate in of["read_per_second"].values())
