"""The benchmark of data that teaches, on clones of two updates."""

import re
from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from benchmarks.teaching import run

pytestmark = pytest.mark.campaign


def test_clones_learn_from_the_same_levels(tmp_path: Path) -> None:
    words = ["teaching", "--data", "default", "label", "--levels", "64", "--updates", "2", "--seeds", "1"]
    args = parser("teaching").parse_args([*words, "--measured", "8", "--folder", str(tmp_path)])
    report = run(args)
    default, label = report.tables[0].rows
    assert (default[0], label[0]) == ("default", "label")
    assert float(default[1]) > float(label[1]) > 0, "experts cost more than a short search"
    common = re.search(r"the same (\d+) levels", report.notes[0])
    assert common
    assert 30 <= int(common[1]) <= 45, "some 40 of 64 levels are solved"
    assert run(args).tables == report.tables, "finished clones and evaluations are kept"
