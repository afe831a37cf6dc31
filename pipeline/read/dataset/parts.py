"""Train and validation, told apart by what levels consist of: copies of a level never lie on both sides."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from levelproof.pipeline.errors import Failure, UserError

PARTS = TRAIN, VALIDATION = "train", "validation"
DIGITS = 8  # at the end of a content hash; its first ones make ids of level files


def check_share(share: float) -> None:
    """Raises UserError where it is none."""
    if not 0 <= share <= 1:
        raise UserError(f"The share of validation is {share}: give a number from 0 to 1.")


def in_part(content_hashes: Sequence[str], part: str | None, share: float) -> Bool[np.ndarray, " level"]:
    """Which levels are in a part (None: all are); `share` of all hashes is validation.

    It depends on a level's hash and the share alone. With a larger share, what was validation still is.

    Raises:
        UserError: there is no such part.
        Failure: a hash is none.
    """
    if part is None:
        return np.ones(len(content_hashes), bool)
    if part not in PARTS:
        raise UserError(f"There is no part {part!r}: choose {' or '.join(PARTS)}, or None for both.")
    try:
        drawn = np.frombuffer(bytes.fromhex("".join(of[-DIGITS:] for of in content_hashes)), ">u4")
    except ValueError:
        drawn = np.zeros(0, ">u4")
    if len(drawn) != len(content_hashes):
        raise Failure("The manifest has content hashes that are none: run `levelproof verify` on its split.")
    return (drawn < share * 16**DIGITS) == (part == VALIDATION)
