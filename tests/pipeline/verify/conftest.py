"""A split whose rows are true, and a copy of it to forge."""

import shutil
from pathlib import Path

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.made import honest_split
from tests.pipeline.verify.forged import UNIT, UNITS


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = honest_split(tmp_path_factory.mktemp("data"), UNIT, UNITS)
    assert set(read_manifest(path, ["label"]).labels) == set(Label)
    return path


@pytest.fixture
def split(honest: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(honest, tmp_path / "s"))
