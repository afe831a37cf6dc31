"""Train and validation are told apart by content alone."""

import hashlib

import numpy as np
import pytest

from levelproof.pipeline.dataset.subsets import check_share, in_subset
from levelproof.pipeline.errors import Failure, UserError

HASHES = [f"c1:{hashlib.sha256(str(i).encode()).hexdigest()[:32]}" for i in range(5000)]


def test_every_level_is_on_one_side_and_copies_with_it() -> None:
    train, validation = in_subset(HASHES, "train", 0.1), in_subset(HASHES, "validation", 0.1)
    assert (train ^ validation).all()
    assert 0.08 < validation.mean() < 0.12
    assert np.array_equal(in_subset(HASHES[::-1], "train", 0.1), train[::-1])
    assert np.array_equal(in_subset([HASHES[7]] * 3, "train", 0.1), [train[7]] * 3)
    assert in_subset(HASHES, None, 0.1).all()


def test_a_larger_share_keeps_what_was_held_out() -> None:
    assert not (in_subset(HASHES, "validation", 0.1) & in_subset(HASHES, "train", 0.3)).any()
    assert in_subset(HASHES, "validation", 1).all()
    assert in_subset(HASHES, "train", 0).all()


def test_what_is_no_part_is_refused() -> None:
    with pytest.raises(UserError, match="There is no subset 'test': choose train or validation"):
        in_subset(HASHES, "test", 0.1)
    with pytest.raises(UserError, match=r"The share of validation is 1\.5"):
        check_share(1.5)


@pytest.mark.parametrize("odd", ["c1:no number", "c1:12 4567", ""])
def test_a_hash_that_is_none_is_a_sentence(odd: str) -> None:
    with pytest.raises(Failure, match="content hashes that are none"):
        in_subset([HASHES[0], odd], "train", 0.1)
