"""The subsets train and validation, split by content hash, so that copies of a level are never in both."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool

from levelproof.pipeline.errors import Failure, UserError

SUBSETS = TRAIN, VALIDATION = "train", "validation"
DIGITS = 8  # taken from the end of a content hash, because ids of level files use the start


def check_share(share: float) -> None:
    """Raise UserError unless 0 <= share <= 1."""
    if not 0 <= share <= 1:
        raise UserError(f"The share of validation is {share}: use a number from 0 to 1.")


def in_subset(content_hashes: Sequence[str] | pa.ChunkedArray, subset: str, share: float) -> Bool[np.ndarray, " level"]:
    """Return which levels are in a subset; `share` of all hashes belong to validation.

    Depends only on the level's hash and the share. A larger share keeps all levels that are already in validation.

    Raises:
        UserError: the subset does not exist.
        Failure: a hash is invalid.
    """
    if subset not in SUBSETS:
        raise UserError(f"There is no subset {subset!r}: choose {' or '.join(SUBSETS)}, or None for both.")
    # In Arrow, because millions of Python strings take gigabytes
    in_arrow = isinstance(content_hashes, pa.ChunkedArray)
    hashes = content_hashes if in_arrow else pa.chunked_array([content_hashes], pa.string())
    ends = pc.call_function("utf8_slice_codeunits", [hashes], pc.SliceOptions(-DIGITS)).combine_chunks()
    digits = pc.call_function("binary_join", [pa.ListArray.from_arrays([0, len(ends)], ends), ""])[0].as_py()
    try:
        drawn = np.frombuffer(bytes.fromhex(digits), ">u4")
    except ValueError:
        drawn = np.zeros(0, ">u4")
    if len(drawn) != len(content_hashes):
        raise Failure("The manifest has invalid content hashes: run `levelproof verify` on its split.")
    return (drawn < share * 16**DIGITS) == (subset == VALIDATION)
