"""Fixtures of the benchmarks' tests."""

from pathlib import Path

import numpy as np
import pytest

from levelproof.levelgen.files.kinetix import state_to_kinetix
from tests.golden.load import HERE, load


@pytest.fixture(scope="session")
def level_file(tmp_path_factory) -> Path:
    """Golden states as the reference's arrays, so that no level must be sampled."""
    golden = load(HERE / "s.npz")
    path = tmp_path_factory.mktemp("levels") / "levels.npz"
    fields = state_to_kinetix(
        golden.level, golden.state, np.zeros_like(golden.timestep), np.full_like(golden.last_distance, -1)
    )
    np.savez(path, **{name: values[:16] for name, values in fields.items()})  # pyright: ignore[reportArgumentType]
    return path
