"""The reference's own trajectories, as ours and back again: every field, bit for bit."""

import numpy as np
import pytest

from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.read.kinetix.records import dtype_of, fields_of, trajectories_of
from tests.pipeline.read.kinetix.folder import GOLDEN, OTHERS, SOLVED, ours_of, trajectories_in

UNREAD = "env_state/circle/vertices"  # the reference draws it, and nothing reads it


def assert_same_but_for_what_is_drawn(ours: np.ndarray, theirs: np.ndarray) -> None:
    """All bits of all fields; of circles' vertices those that most circles have."""
    assert set(ours.dtype.names or ()) == set(theirs.dtype.names or ())
    for name in theirs.dtype.names or ():
        assert ours.dtype[name] == theirs.dtype[name], name
        if name != UNREAD:
            assert ours[name].tobytes() == theirs[name].tobytes(), name
    of_circles = ours[UNREAD].reshape(-1, 8), theirs[UNREAD].reshape(-1, 8)
    same = (of_circles[0] == of_circles[1]).all(-1)
    other = set(map(tuple, np.abs(of_circles[1][~same]).astype(float).round(2).tolist()))
    assert other <= {(0.1, 0.05) * 4, (0.05, 0.1) * 4}
    assert same.mean() > 0.4


@pytest.mark.parametrize("size", SIZES)
def test_what_the_reference_stored_comes_back(size: str) -> None:
    theirs = trajectories_in(GOLDEN / size)
    assert theirs.dtype.itemsize == dtype_of(SIZES[size]).itemsize
    assert_same_but_for_what_is_drawn(trajectories_of(*ours_of(theirs)), theirs)


@pytest.mark.parametrize("size", ["s", *(pytest.param(size, marks=pytest.mark.campaign) for size in "ml")])
def test_what_we_play_is_what_the_reference_played(size: str) -> None:
    """From its levels, under its actions: at the first steps every field is the same or nearly so."""
    level, record = ours_of(trajectories_in(GOLDEN / size))
    again = replay(level, record.action)
    solved = succeeds(np.asarray(again.done), np.asarray(again.goal))
    assert solved[:SOLVED].mean() >= 0.8
    assert not solved[SOLVED:].any()
    assert len(solved) == SOLVED + OTHERS
    ours, theirs = fields_of(level, again), fields_of(level, record)
    for name, x in theirs.items():
        first = x[:, :8], ours[name][:, :8]
        if x.dtype == np.float32:
            # the reference remembers where a joint was before bodies moved on
            np.testing.assert_allclose(*first, atol=0.1 if "joint/global" in name else 1e-3, err_msg=name)
        else:
            np.testing.assert_array_equal(*first, err_msg=name)
