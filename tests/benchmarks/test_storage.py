"""The benchmark of storage: sparser densities take fewer bytes, on any machine."""

import argparse
from pathlib import Path

import pytest

from benchmarks import storage
from tests.pipeline.made import played_split


@pytest.mark.campaign
def test_storage_measures_every_density_of_a_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "SECONDS", 0.01)
    monkeypatch.setattr(storage, "BATCH", 2)
    report = storage.run(argparse.Namespace(split=[played_split(tmp_path)]))
    assert [result["density"] for result in report.results] == ["full", "resume", "witness"]
    sizes = [result["bytes_per_transition"] for result in report.results]
    assert sizes == sorted(sizes, reverse=True)
    assert [result["of_full"] for result in report.results] == [size / sizes[0] for size in sizes]
    assert all(rate > 0 for result in report.results for rate in result["read_per_second"].values())
