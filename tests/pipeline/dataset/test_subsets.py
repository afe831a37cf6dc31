"""`in_subset`: train and validation depend on content hashes alone."""

import hashlib

import numpy as np
import pyarrow as pa
import pytest

from levelproof.pipeline.dataset.subsets import check_share, in_subset
from levelproof.pipeline.errors import Failure, UserError

HASHES = [f"c1:{hashlib.sha256(str(i).encode()).hexdigest()[:32]}" for i in range(5000)]


def test_in_subset_puts_each_level_and_its_copies_in_one_subset() -> None:
    train, validation = in_subset(HASHES, "train", 0.1), in_subset(HASHES, "validation", 0.1)
    assert (train ^ validation).all()
    assert 0.08 < validation.mean() < 0.12
    assert np.array_equal(in_subset(HASHES[::-1], "train", 0.1), train[::-1])
    assert np.array_equal(in_subset([HASHES[7]] * 3, "train", 0.1), [train[7]] * 3)


def test_in_subset_is_the_same_in_every_version() -> None:
    """Else levels that one version validates on were trained on by another."""
    first = np.flatnonzero(in_subset(HASHES, "validation", 0.1))[:12]
    assert first.tolist() == [6, 7, 32, 46, 48, 60, 65, 74, 75, 84, 121, 122]


def test_in_subset_takes_columns_of_arrow() -> None:
    column = pa.chunked_array([HASHES[:7], HASHES[7:]])
    expected = [int(content_hash[-8:], 16) < 0.1 * 2**32 for content_hash in HASHES]
    assert in_subset(column, "validation", 0.1).tolist() == expected


def test_in_subset_keeps_validation_levels_when_the_share_grows() -> None:
    assert not (in_subset(HASHES, "validation", 0.1) & in_subset(HASHES, "train", 0.3)).any()
    assert in_subset(HASHES, "validation", 1).all()
    assert in_subset(HASHES, "train", 0).all()


def test_in_subset_and_check_share_reject_invalid_arguments() -> None:
    with pytest.raises(UserError, match="There is no subset 'test': choose train or validation"):
        in_subset(HASHES, "test", 0.1)
    with pytest.raises(UserError, match=r"The share of validation is 1\.5"):
        check_share(1.5)


@pytest.mark.parametrize("invalid", ["c1:no number", "c1:12 4567", ""])
def test_in_subset_reports_invalid_hashes(invalid: str) -> None:
    with pytest.raises(Failure, match="invalid content hashes"):
        in_subset([HASHES[0], invalid], "train", 0.1)
