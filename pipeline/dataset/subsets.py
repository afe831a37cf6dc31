"""The subsets train and validation, split by content hash, so that copies of a level are never in both."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from levelproof.pipeline.errors import Failure, UserError

SUBSETS = TRAIN, VALIDATION = "train", "validation"
DIGITS = 8  # taken from the end of a content hash, because ids of level files use the start


def check_share(share: float) -> None:
    """Raise UserError unless 0 <= share <= 1."""
    if not 0 <= share <= 1:
        raise UserError(f"The share of validation is {share}: use a number from 0 to 1.")


def in_subset(content_hashes: Sequence[str], subset: str | None, share: float) -> Bool[np.ndarray, " level"]:
    """Return which levels are in a subset (None: all); `share` of all hashes belong to validation.

    Depends only on the level's hash and the share. A larger share keeps all levels that are already in validation.

    Raises:
        UserError: the subset does not exist.
        Failure: a hash is invalid.
    """
    if subset is None:
        return np.ones(len(content_hashes), bool)
    if subset not in SUBSETS:
        raise UserError(f"There is no subset {subset!r}: choose {' or '.join(SUBSETS)}, or None for both.")
    try:
        drawn = np.frombuffer(bytes.fromhex("".join(content_hash[-DIGITS:] for content_hash in content_hashes)), ">u4")
    except ValueError:
        drawn = np.zeros(0, ">u4")
    if len(drawn) != len(content_hashes):
        raise Failure("The manifest has invalid content hashes: run `levelproof verify` on its split.")
    return (drawn < share * 16**DIGITS) == (subset == VALIDATION)
