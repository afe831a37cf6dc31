"""What tests of the benches share."""

from pathlib import Path

import numpy as np
import pytest

from levelproof.levelgen.files.kinetix import state_to_kinetix
from tests.golden.load import HERE, load


@pytest.fixture(scope="session")
def level_file(tmp_path_factory) -> Path:
    """Golden states as the reference's arrays: levels that need not be sampled first."""
    of = load(HERE / "s.npz")
    path = tmp_path_factory.mktemp("levels") / "levels.npz"
    fields = state_to_kinetix(of.level, of.state, np.zeros_like(of.timestep), np.full_like(of.last_distance, -1))
    np.savez(path, **{name: values[:16] for name, values in fields.items()})  # pyright: ignore[reportArgumentType]
    return path
