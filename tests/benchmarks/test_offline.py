"""The benchmark of offline reinforcement learning, on a small split and ten updates."""

from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.offline import CLONES, METHODS, made_by, run
from tests.pipeline.made import played_split

pytestmark = pytest.mark.campaign


def test_all_ways_learn_and_are_measured(tmp_path: Path) -> None:
    for library in ("torchrl", "minari", "h5py"):
        pytest.importorskip(library)
    split = played_split(tmp_path / "data")
    words = ["offline", str(split), "--updates", "10", "--seeds", "1", "--measured", "16", "--folder"]
    args = parser("offline").parse_args([*words, str(tmp_path / "runs")])
    report = run(args)
    names = [row[0] for row in report.tables[0].rows]
    assert names == [*METHODS, *CLONES, "random", "sticky random"]
    assert all(float(row[2]) > 0 for row in report.tables[0].rows[: len(METHODS)])
    assert report.notes[-1].endswith("`levelproof generate` made the split.")
    assert run(args).tables == report.tables, "finished networks and evaluations are kept"


def test_split_without_a_note_has_no_command(tmp_path: Path) -> None:
    assert made_by(tmp_path) == ""
    split = played_split(tmp_path / "data")
    assert made_by(split) == " `levelproof generate` made the split."
