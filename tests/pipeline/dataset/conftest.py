"""The reader opened on the shared split."""

from pathlib import Path

import pytest

from levelproof.pipeline.dataset.dataset import Dataset, open


@pytest.fixture(scope="session")
def data(split: Path) -> Dataset:
    return open(split)
