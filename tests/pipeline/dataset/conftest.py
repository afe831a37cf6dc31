"""A small real split, shared by the tests of this folder, which only read it."""

from pathlib import Path

import pytest

from levelproof.pipeline.dataset.dataset import Dataset, open
from tests.pipeline.made import played_split


@pytest.fixture(scope="session")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played_split(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="session")
def data(split: Path) -> Dataset:
    return open(split)
