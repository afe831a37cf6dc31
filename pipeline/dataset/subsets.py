"""The subsets train and validation, told apart by what levels consist of: copies of a level are never in both."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from levelproof.pipeline.errors import Failure, UserError

SUBSETS = TRAIN, VALIDATION = "train", "validation"
DIGITS = 8  # at the end of a content hash; its first ones make ids of level files


def check_share(share: float) -> None:
    """Raises UserError where it is none."""
    if not 0 <= share <= 1:
        raise UserError(f"The share of validation is {share}: give a number from 0 to 1.")


def in_subset(content_hashes: Sequence[str], subset: str | None, share: float) -> Bool[np.ndarray, " level"]:
    """Which levels are in a subset (None: all are); `share` of all hashes is validation.

    It depends on a level's hash and the share alone. With a larger share, what was validation still is.

    Raises:
        UserError: there is no such subset.
        Failure: a hash is none.
    """
    if subset is None:
        return np.ones(len(content_hashes), bool)
    if subset not in SUBSETS:
        raise UserError(f"There is no subset {subset!r}: choose {' or '.join(SUBSETS)}, or None for both.")
    try:
        drawn = np.frombuffer(bytes.fromhex("".join(one[-DIGITS:] for one in content_hashes)), ">u4")
    except ValueError:
        drawn = np.zeros(0, ">u4")
    if len(drawn) != len(content_hashes):
        raise Failure("The manifest has content hashes that are none: run `levelproof verify` on its split.")
    return (drawn < share * 16**DIGITS) == (subset == VALIDATION)
