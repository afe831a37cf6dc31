"""Trajectories that come with levelproof, as a seed file: to try a learner before anything is generated."""

from collections.abc import Sequence
from pathlib import Path

from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.differing import KEEP

SAMPLE = Path(__file__).parent / "sample.parquet"  # manifests/README.md says how it is made


def sample_data(
    where: str | None = None, columns: Sequence[str] | str = (), validation: float = 0.1, differing: str = KEEP
) -> Dataset:
    """Open the trajectories that come with levelproof: levels 0 to 9,999 of size s, labelled at 256k env steps.

    Nothing is downloaded. Levels and trajectories are simulated when they are read (docs/seeds.md).

    Args:
        where: as in `levelproof.open`.
        columns: as in `levelproof.open`.
        validation: as in `levelproof.open`.
        differing: as in `levelproof.open`.

    Raises:
        UserError: no trajectory meets the condition, or the condition, a column or the share is invalid.
    """
    return Dataset(SAMPLE, where, columns, validation, differing)
