"""What `generate` says at its end."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from levelproof.experts.steps import EnvSteps
from levelproof.pipeline.jobs.generate import _spent
from levelproof.pipeline.store.manifest import Manifest


@pytest.mark.parametrize(
    ("made", "training"),
    [
        ([0, 1], "20% in training on solved levels, 60% in training on unsolved levels"),
        ([0], "80% in training on solved levels"),
        ([1], "80% in training on unsolved levels"),
    ],
)
def test_spent_shares_training_by_the_labels_of_the_levels_of_this_run(made: list[int], training: str) -> None:
    table = pa.table({"level_id": [0, 1], "label": ["solved", "unsolved"], "env_steps": [100, 300]})
    spent = EnvSteps(searched=100, trained=800, evaluated=60, idle=40)
    assert _spent(Manifest(Path("split"), (), table, {}), np.array(made), spent) == (
        f"1,000 env steps: 10% in searches, {training}, 6% in evaluations, 4% in empty slots."
    )
