"""A split for tests that only read; a folder of tests may define its own."""

from pathlib import Path

import pytest

from tests.pipeline.made import played_split


@pytest.fixture(scope="session")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played_split(tmp_path_factory.mktemp("data"))
