"""A split to look at, which no test writes to; folders of tests may replace it by their own."""

from pathlib import Path

import pytest

from tests.pipeline.made import played_split


@pytest.fixture(scope="session")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played_split(tmp_path_factory.mktemp("data"))
