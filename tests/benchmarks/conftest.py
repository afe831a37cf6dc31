"""Fixtures of the benchmarks' tests."""

from pathlib import Path

import numpy as np
import pytest

from levelproof.levelgen.files.kinetix import state_to_kinetix
from tests.golden.load import golden


@pytest.fixture(scope="session")
def level_file(tmp_path_factory) -> Path:
    """Golden states as the reference's arrays, so that no level must be sampled."""
    sample = golden("s")
    path = tmp_path_factory.mktemp("levels") / "levels.npz"
    fields = state_to_kinetix(
        sample.level, sample.state, np.zeros_like(sample.timestep), np.full_like(sample.last_distance, -1)
    )
    np.savez(path, **{name: values[:16] for name, values in fields.items()})  # pyright: ignore[reportArgumentType]
    return path
