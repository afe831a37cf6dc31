"""The reference's trajectories, converted to our types and back: every field, bit for bit."""

import numpy as np
import pytest

from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.read.kinetix.records import dtype_of, fields_of, trajectories_of
from tests.pipeline.read.kinetix.folder import GOLDEN, OTHERS, SOLVED, to_ours, trajectories_in

UNREAD = "env_state/circle/vertices"  # drawn by the reference, otherwise unread


def assert_same_except_unread(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Compare all bits of all fields; of UNREAD, allow the two other values that the reference stores."""
    assert set(ours.dtype.names or ()) == set(theirs.dtype.names or ())
    for name in theirs.dtype.names or ():
        assert ours.dtype[name] == theirs.dtype[name], name
        if name != UNREAD:
            assert ours[name].tobytes() == theirs[name].tobytes(), name
    vertices = ours[UNREAD].reshape(-1, 8), theirs[UNREAD].reshape(-1, 8)
    same = (vertices[0] == vertices[1]).all(-1)
    differing = set(map(tuple, np.abs(vertices[1][~same]).astype(float).round(2).tolist()))
    assert differing <= {(0.1, 0.05) * 4, (0.05, 0.1) * 4}
    assert same.mean() > 0.4


@pytest.mark.parametrize("size", SIZES)
def test_trajectories_of_restores_golden_trajectories(size: str) -> None:
    theirs = trajectories_in(GOLDEN / size)
    assert theirs.dtype.itemsize == dtype_of(SIZES[size]).itemsize
    assert_same_except_unread(trajectories_of(*to_ours(theirs)), theirs)


@pytest.mark.parametrize("size", ["s", *(pytest.param(size, marks=pytest.mark.campaign) for size in "ml")])
def test_replay_matches_golden_trajectories(size: str) -> None:
    """From the same levels and actions, every field of the first steps is equal or nearly so."""
    level, record = to_ours(trajectories_in(GOLDEN / size))
    again = replay(level, record.action)
    solved = succeeds(np.asarray(again.done), np.asarray(again.goal))
    assert solved[:SOLVED].mean() >= 0.8
    assert not solved[SOLVED:].any()
    assert len(solved) == SOLVED + OTHERS
    ours, theirs = fields_of(level, again), fields_of(level, record)
    for name, x in theirs.items():
        first = x[:, :8], ours[name][:, :8]
        if x.dtype == np.float32:
            # the reference stores where a joint was before its bodies moved
            np.testing.assert_allclose(*first, atol=0.1 if "joint/global" in name else 1e-3, err_msg=name)
        else:
            np.testing.assert_array_equal(*first, err_msg=name)
