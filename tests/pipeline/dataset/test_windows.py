"""`Windows`: consecutive windows that cover a record."""

import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.errors import UserError


@pytest.mark.parametrize(
    ("length", "per_record", "last"), [(None, 1, 256), (256, 1, 256), (64, 4, 64), (100, 3, 56), (1, 256, 1)]
)
def test_windows_cover_a_record_without_overlap(length: int | None, per_record: int, last: int) -> None:
    windows = Windows.of(length)
    assert windows.per_record == per_record
    which, first = windows.locate(np.arange(2 * per_record))
    assert which.tolist() == [0] * per_record + [1] * per_record
    record = np.stack([np.arange(RECORD_STEPS), np.arange(RECORD_STEPS) + 1000])
    cut = windows.cut({"record/x": record[which], "level/x": which}, first)
    mask = windows.mask(first)
    assert mask.shape == cut["record/x"].shape == (2 * per_record, windows.length)
    assert np.array_equal(cut["record/x"][mask], record.ravel())
    assert mask[per_record - 1].sum() == last
    assert (cut["record/x"][~mask] % 1000 == RECORD_STEPS - 1).all()
    assert np.array_equal(cut["level/x"], which)


@pytest.mark.parametrize("length", [0, -3, 257, 2.0])
def test_windows_reject_an_invalid_length(length) -> None:
    with pytest.raises(UserError, match=f"A window cannot have {length} steps"):
        Windows.of(length)


def test_window_length_may_be_of_numpy() -> None:
    assert type(Windows.of(np.int64(32)).length) is int  # pyright: ignore[reportArgumentType]
